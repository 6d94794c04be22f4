//! Validation of the tolerances of the inspection.

use super::file::InspectTable;
use super::resolver::Resolver;
use crate::error::Result;
use crate::inspect::tolerance::ToleranceBand;
use crate::math::{Aabb, DVec3};

impl Resolver<'_> {
    /// Returns the tolerances. The tolerance outside all regions is first.
    pub(super) fn bands(&self, table: &InspectTable) -> Result<Vec<ToleranceBand>> {
        let mut bands = Vec::new();
        if let Some(limits) = table.tolerance_mm {
            bands.push(ToleranceBand {
                name: "part".to_owned(),
                within: None,
                limits: self.limits(limits, "inspect.tolerance_mm")?,
            });
        }
        for (name, region) in &table.regions {
            let key = |of: &str| format!("inspect.regions.{name}.{of}");
            let [lower, upper] = region.bounds_mm;
            self.lengths(lower, &key("bounds_mm"))?;
            self.lengths(upper, &key("bounds_mm"))?;
            let ordered = lower.iter().zip(&upper).all(|(a, b)| a < b);
            self.check(
                ordered,
                &key("bounds_mm"),
                "a lower corner and an upper one: [[-5, -5, 0], [5, 5, 20]]",
            )?;
            self.check(
                name != "part" || table.tolerance_mm.is_none(),
                &format!("inspect.regions.{name}"),
                "another name; part is what lies in no region",
            )?;
            let limits = match (region.tolerance_mm, table.tolerance_mm) {
                (Some(limits), _) => self.limits(limits, &key("tolerance_mm"))?,
                (None, Some(limits)) => limits,
                (None, None) => return Err(self.source.missing(&key("tolerance_mm"))),
            };
            bands.push(ToleranceBand {
                name: name.clone(),
                within: Some(Aabb::of([lower, upper].map(DVec3::from))),
                limits,
            });
        }
        Ok(bands)
    }

    fn limits(&self, limits: [f64; 2], key: &str) -> Result<[f64; 2]> {
        let [lower, upper] = self.lengths(limits, key)?;
        self.check(
            lower < upper,
            key,
            "a lower limit and an upper one above it: [-0.05, 0.05]",
        )?;
        Ok(limits)
    }
}
