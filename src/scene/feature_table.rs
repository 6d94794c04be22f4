//! Features of the part in a scene file, and their validation.

use super::file::{array, optional_array};
use super::resolver::Resolver;
use crate::error::Result;
use crate::inspect::features::{FeatureKind, FeatureSpec, Relation, Section, Selection, Shape};
use crate::math::{Aabb, DVec3};
use schemars::JsonSchema;
use serde::Deserialize;
use std::collections::BTreeMap;

/// Feature of the part that is evaluated from the measured points.
///
/// An element or a profile has a CAD face, selected by `point_mm`, `bounds_mm` or `group`, or by
/// several of them. A relation names two other features in `between`.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FeatureTable {
    /// Name in the results. Names are unique.
    pub name: String,
    /// Kind of the feature.
    pub kind: FeatureKindName,
    /// Point of the CAD surface, in the part's frame. The face grows from it over edges up to
    /// `crease_deg`.
    #[serde(default, deserialize_with = "optional_array")]
    pub point_mm: Option<[f64; 3]>,
    /// Angle between neighbouring triangles at which the face ends. Default: 1 for planes and
    /// lines, 30 for other kinds.
    pub crease_deg: Option<f64>,
    /// Lower and upper corner of a box in the part's frame that contains the triangles.
    #[serde(default, deserialize_with = "optional_array")]
    pub bounds_mm: Option<[[f64; 3]; 2]>,
    /// Group of the triangles, as in `part.surfaces`.
    pub group: Option<String>,
    /// Smallest distance of the points from the edges of the face. Default: two beam radii (1/e²).
    pub margin_mm: Option<f64>,
    /// Percentage of the points that is excluded as outliers: the points with the largest
    /// residuals. Default: 0.
    #[serde(default)]
    pub outlier_percent: f64,
    /// Whether the form (flatness, straightness, roundness, cylindricity) is evaluated by the
    /// minimum zone. Default: false, or true if `tolerance` contains `form_mm`.
    #[serde(default)]
    pub form: bool,
    /// Normal of the section plane of a line through `point_mm`.
    #[serde(default, deserialize_with = "optional_array")]
    pub section_normal: Option<[f64; 3]>,
    /// Width of the section of a line. Default: 1.
    pub section_width_mm: Option<f64>,
    /// Names of the two features of a relation: the reference first.
    #[serde(default, deserialize_with = "optional_array")]
    pub between: Option<[String; 2]>,
    /// Lower and upper limit of the deviation from the CAD, by quantity: for example `diameter_mm =
    /// [-0.05, 0.05]`. Default: none.
    #[serde(default)]
    pub tolerance: BTreeMap<String, Limits>,
}

/// Lower and upper limit.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
pub struct Limits(#[serde(deserialize_with = "array")] pub [f64; 2]);

/// Kind of a feature.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum FeatureKindName {
    /// Plane: `offset_mm`, `tilt_deg`, `form_mm`.
    Plane,
    /// Line in a section of a plane: `offset_mm`, `tilt_deg`, `form_mm`.
    Line,
    /// Circle through the wall of a hole or a shaft: `diameter_mm`, `x_mm`, `y_mm`, `z_mm`,
    /// `displacement_mm`, `form_mm`.
    Circle,
    /// Cylinder: as circle, and `tilt_deg`.
    Cylinder,
    /// Sphere: as circle.
    Sphere,
    /// Cone: as cylinder, with the apex angle `angle_deg` instead of the diameter.
    Cone,
    /// Profile of a surface: `profile_mm`.
    Profile,
    /// Height of the second plane above the first: `height_mm`.
    StepHeight,
    /// Distance of two features: `distance_mm`.
    Distance,
    /// Angle between two features: `angle_deg`.
    Angle,
    /// Gap between two faces, and height of the second above the first: `gap_mm`, `flush_mm`.
    GapFlush,
}

impl FeatureKindName {
    fn shape(self) -> Option<Shape> {
        Some(match self {
            FeatureKindName::Plane => Shape::Plane,
            FeatureKindName::Line => Shape::Line,
            FeatureKindName::Circle => Shape::Circle,
            FeatureKindName::Cylinder => Shape::Cylinder,
            FeatureKindName::Sphere => Shape::Sphere,
            FeatureKindName::Cone => Shape::Cone,
            _ => return None,
        })
    }

    fn relation(self) -> Option<Relation> {
        Some(match self {
            FeatureKindName::StepHeight => Relation::StepHeight,
            FeatureKindName::Distance => Relation::Distance,
            FeatureKindName::Angle => Relation::Angle,
            FeatureKindName::GapFlush => Relation::GapFlush,
            _ => return None,
        })
    }
}

impl Resolver<'_> {
    /// Returns the features. `groups` are the names of the groups of the nominal mesh.
    pub(super) fn features(
        &self,
        tables: &[FeatureTable],
        groups: &std::collections::BTreeSet<&str>,
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
        groups: &std::collections::BTreeSet<&str>,
        i: usize,
    ) -> Result<FeatureKind> {
        let key = |of: &str| format!("feature.{i}.{of}");
        self.check(
            table.between.is_none(),
            &key("between"),
            "a kind with two features: step-height, distance, angle or gap-flush",
        )?;
        let is_selected =
            table.point_mm.is_some() || table.bounds_mm.is_some() || table.group.is_some();
        self.check(
            is_selected,
            &format!("feature.{i}"),
            "point_mm, bounds_mm or group, which select the CAD face",
        )?;
        let shape = table.kind.shape();
        let flat = matches!(shape, Some(Shape::Plane | Shape::Line));
        let crease = table.crease_deg.unwrap_or(if flat { 1.0 } else { 30.0 });
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
        let selection = Selection {
            point: table.point_mm.map(DVec3::from),
            crease: crease.to_radians(),
            bounds: table
                .bounds_mm
                .map(|corners| Aabb::of(corners.map(DVec3::from))),
            group: table.group.clone(),
            margin: table.margin_mm,
            outliers: outliers / 100.0,
        };
        let Some(shape) = shape else {
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
