//! Validation of the features of the part.

use super::feature_table::{FeatureKindName, FeatureTable, Limits};
use super::resolver::Resolver;
use crate::error::Result;
use crate::inspect::features::{FeatureKind, FeatureSpec, Relation, Section, Selection, Shape};
use crate::math::{Aabb, DVec3};
use std::collections::{BTreeMap, BTreeSet};

impl Resolver<'_> {
    /// Returns the features. `groups` are the names of the groups of the nominal mesh.
    pub(super) fn features(
        &self,
        tables: &[FeatureTable],
        groups: &BTreeSet<&str>,
    ) -> Result<Vec<FeatureSpec>> {
        let mut features: Vec<FeatureSpec> = Vec::new();
        for (i, table) in tables.iter().enumerate() {
            let key = |of: &str| format!("feature.{i}.{of}");
            let unique = !features.iter().any(|other| other.name == table.name);
            let expected = "a name that no other feature has, not empty";
            self.check(unique && !table.name.is_empty(), &key("name"), expected)?;
            let kind = match table.kind.relation() {
                Some(relation) => self.relation(table, relation, tables, i)?,
                None => self.element(table, groups, i)?,
            };
            let known = kind.quantities();
            let mut tolerance = BTreeMap::new();
            for (name, Limits([lower, upper])) in &table.tolerance {
                let key = key(&format!("tolerance.{name}"));
                let expected = format!("one of {}", known.join(", "));
                self.check(known.contains(&name.as_str()), &key, &expected)?;
                let ordered = lower < upper && lower.is_finite() && upper.is_finite();
                let expected = "a lower limit and an upper one above it: [-0.05, 0.05]";
                self.check(ordered, &key, expected)?;
                tolerance.insert(name.clone(), [*lower, *upper]);
            }
            features.push(FeatureSpec {
                name: table.name.clone(),
                kind,
                tolerance,
            });
        }
        Ok(features)
    }

    fn element(
        &self,
        table: &FeatureTable,
        groups: &BTreeSet<&str>,
        i: usize,
    ) -> Result<FeatureKind> {
        let key = |of: &str| format!("feature.{i}.{of}");
        self.check(
            table.between.is_none(),
            &key("between"),
            "a kind with two features: step-height, distance, angle or gap-flush",
        )?;
        let selection = self.selection(table, groups, i)?;
        let Some(shape) = table.kind.shape() else {
            return Ok(FeatureKind::Profile { selection });
        };
        let section = match (shape, table.section_normal, table.point_mm) {
            (Shape::Line, Some(normal), Some(point)) => Some(Section {
                point: point.into(),
                normal: self.direction(normal, &key("section_normal"))?,
                width: self.positive(
                    table.section_width_mm.unwrap_or(1.0),
                    &key("section_width_mm"),
                )?,
            }),
            (Shape::Line, None, _) => return Err(self.source.missing(&key("section_normal"))),
            (Shape::Line, _, None) => return Err(self.source.missing(&key("point_mm"))),
            _ => None,
        };
        Ok(FeatureKind::Element {
            shape,
            selection,
            section,
            form: table.form || table.tolerance.contains_key("form_mm"),
        })
    }

    /// Returns the face and the selection of points of an element or a profile.
    fn selection(
        &self,
        table: &FeatureTable,
        groups: &BTreeSet<&str>,
        i: usize,
    ) -> Result<Selection> {
        let key = |of: &str| format!("feature.{i}.{of}");
        let is_selected =
            table.point_mm.is_some() || table.bounds_mm.is_some() || table.group.is_some();
        self.check(
            is_selected,
            &format!("feature.{i}"),
            "point_mm, bounds_mm or group, which select the CAD face",
        )?;
        let default = table.kind.shape().map_or(30.0, Shape::crease_deg);
        let crease = table.crease_deg.unwrap_or(default);
        self.check(
            crease > 0.0 && crease < 180.0,
            &key("crease_deg"),
            "an angle > 0 and < 180",
        )?;
        if let Some(point) = table.point_mm {
            self.lengths(point, &key("point_mm"))?;
        }
        if let Some([lower, upper]) = table.bounds_mm {
            self.lengths(lower, &key("bounds_mm"))?;
            self.lengths(upper, &key("bounds_mm"))?;
            let ordered = lower.iter().zip(&upper).all(|(a, b)| a <= b);
            let expected = "a lower corner and an upper one: [[-5, -5, 0], [5, 5, 20]]";
            self.check(ordered, &key("bounds_mm"), expected)?;
        }
        if let Some(group) = &table.group {
            let names = groups.iter().copied().collect::<Vec<_>>().join(", ");
            let expected = match names.is_empty() {
                true => "no group, as the mesh file names none".to_owned(),
                false => format!("one of {names}"),
            };
            self.check(groups.contains(group.as_str()), &key("group"), &expected)?;
        }
        if let Some(margin) = table.margin_mm {
            self.check(margin >= 0.0, &key("margin_mm"), "a length of 0 or more")?;
            self.lengths([margin], &key("margin_mm"))?;
        }
        let outliers = table.outlier_percent;
        self.check(
            (0.0..50.0).contains(&outliers),
            &key("outlier_percent"),
            "a number from 0 to below 50",
        )?;
        Ok(Selection {
            point: table.point_mm.map(DVec3::from),
            crease: crease.to_radians(),
            bounds: table
                .bounds_mm
                .map(|corners| Aabb::of(corners.map(DVec3::from))),
            group: table.group.clone(),
            margin: table.margin_mm,
            outliers: outliers / 100.0,
        })
    }

    fn relation(
        &self,
        table: &FeatureTable,
        relation: Relation,
        tables: &[FeatureTable],
        i: usize,
    ) -> Result<FeatureKind> {
        let key = format!("feature.{i}.between");
        let Some(names) = &table.between else {
            return Err(self.source.missing(&key));
        };
        let mut of = [0; 2];
        for (index, name) in of.iter_mut().zip(names) {
            let found = tables
                .iter()
                .position(|other| other.name == *name && other.kind.shape().is_some());
            let expected = "names of two features with an element, such as planes or cylinders";
            let Some(found) = found else {
                return Err(self.source.input_error(&key, expected));
            };
            *index = found;
        }
        let planes = of.iter().all(|&j| tables[j].kind == FeatureKindName::Plane);
        let needs_planes = matches!(relation, Relation::StepHeight | Relation::GapFlush);
        self.check(planes || !needs_planes, &key, "names of two planes")?;
        let directed = of
            .iter()
            .all(|&j| !matches!(tables[j].kind, FeatureKindName::Sphere));
        self.check(
            directed || relation != Relation::Angle,
            &key,
            "names of two features with a direction; a sphere has none",
        )?;
        Ok(FeatureKind::Relation { relation, of })
    }
}
