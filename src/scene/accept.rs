//! Validation of the acceptance test.

use super::accept_table::AcceptTable;
use super::resolver::Resolver;
use crate::error::Result;

impl Resolver<'_> {
    /// Rejects values that no test can have. Values that do not fit the measuring volume are
    /// rejected later, where the volume is known.
    pub(super) fn accept(&self, table: &AcceptTable) -> Result<()> {
        let limits = &table.mpe_um;
        let above_zero = [
            (table.travel_mm, "travel_mm"),
            (table.sphere_diameter_mm, "sphere_diameter_mm"),
            (table.ball_bar_length_mm, "ball_bar_length_mm"),
            (table.plate_side_mm, "plate_side_mm"),
            (limits.probing_form, "mpe_um.probing_form"),
            (limits.probing_form_d95, "mpe_um.probing_form_d95"),
            (limits.probing_size, "mpe_um.probing_size"),
            (limits.sphere_spacing, "mpe_um.sphere_spacing"),
            (limits.flatness, "mpe_um.flatness"),
            (limits.linearity, "mpe_um.linearity"),
            (limits.z_repeatability, "mpe_um.z_repeatability"),
        ];
        for (value, key) in above_zero {
            if let Some(value) = value {
                self.positive(value, &format!("accept.{key}"))?;
            }
        }
        let bounded = [
            (table.plate_tilt_deg, "plate_tilt_deg", [0.0, 60.0]),
            (table.cap_half_angle_deg, "cap_half_angle_deg", [20.0, 80.0]),
            (table.excluded_percent, "excluded_percent", [0.0, 50.0]),
            (
                table.artefact_expanded_uncertainty_um,
                "artefact_expanded_uncertainty_um",
                [0.0, 1e6],
            ),
            (table.profiles.map(f64::from), "profiles", [3.0, 10_000.0]),
            (
                table.height_steps.map(f64::from),
                "height_steps",
                [2.0, 1000.0],
            ),
            (table.repeats.map(f64::from), "repeats", [2.0, 10_000.0]),
        ];
        for (value, key, [least, most]) in bounded {
            let holds = value.is_none_or(|value| (least..=most).contains(&value));
            let expected = format!("a number from {least} to {most}");
            self.check(holds, &format!("accept.{key}"), &expected)?;
        }
        Ok(())
    }
}
