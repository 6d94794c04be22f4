//! Validation of the warning thresholds.

use super::resolver::Resolver;
use super::warnings_table::WarningsTable;
use crate::error::Result;

impl Resolver<'_> {
    pub(super) fn warnings(&self, table: &WarningsTable) -> Result<WarningsTable> {
        for (key, value) in [
            ("lost_fraction", table.lost_fraction),
            ("unmeasured_fraction", table.unmeasured_fraction),
            ("hidden_fraction", table.hidden_fraction),
            ("empty_frames_fraction", table.empty_frames_fraction),
        ] {
            let key = format!("warnings.{key}");
            self.check((0.0..=1.0).contains(&value), &key, "a number from 0 to 1")?;
        }
        self.positive(table.duration_h, "warnings.duration_h")?;
        self.positive(table.pass_spacing, "warnings.pass_spacing")?;
        let expected = "a number of at least 1 and at most 1e12";
        let holds = (1.0..=1e12).contains(&table.blur);
        self.check(holds, "warnings.blur", expected)?;
        let holds = (0.0..=1e12).contains(&table.least_step);
        self.check(holds, "warnings.least_step", "a number from 0 to 1e12")?;
        Ok(*table)
    }
}
