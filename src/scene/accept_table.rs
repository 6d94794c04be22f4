//! The acceptance test of a sensor, as its file or a scene has it.

use super::resolver::Resolver;
use crate::error::Result;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Artefacts, counts and limits of the acceptance test that `lasertrace accept` predicts. What is left out follows
/// from the measuring volume.
#[derive(Debug, Clone, Default, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct AcceptTable {
    /// Way of the scans: the third side of the measuring volume. Default: as long as the volume is wide.
    pub travel_mm: Option<f64>,
    /// Diameter of the spheres. Default: 0.15 of the volume's diagonal, or less where the range is short.
    pub sphere_mm: Option<f64>,
    /// Between the centres of the two spheres of a ball bar. Default: 0.9 of the most that fits.
    pub spacing_mm: Option<f64>,
    /// Side of the square plate. Default: 0.8 of the volume's width or length.
    pub plate_mm: Option<f64>,
    /// Tilt of the plate in two of its five places. Default: 20, or less where the range is short.
    pub plate_tilt_deg: Option<f64>,
    /// Half angle of the cap that is measured of a sphere, about its top. Default: 45.
    pub cap_deg: Option<f64>,
    /// Profiles across a sphere's cap and across a plate. Default: 25.
    pub profiles: Option<u32>,
    /// Heights over the measuring range for linearity and repeatability. Default: 11.
    pub heights: Option<u32>,
    /// Times that each height is measured for repeatability. Default: 10.
    pub repeats: Option<u32>,
    /// Share of the points that flatness leaves out. Default: 0.3.
    pub left_out_percent: Option<f64>,
    /// Expanded uncertainty (k = 2) of the artefacts' calibrated values: the guard band. Default: 1.
    pub artefact_um: Option<f64>,
    /// Largest permissible values. Default of each: a thousandth of the measuring range, of
    /// repeatability a tenth of that.
    pub limits_um: LimitsTable,
}

/// Largest permissible values of an acceptance test.
#[derive(Debug, Clone, Copy, Default, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LimitsTable {
    /// P_F of 25 representative points.
    pub probing_form: Option<f64>,
    /// P_F as the smallest shell that holds 95 % of all points.
    pub probing_form_d95: Option<f64>,
    /// P_S, of either sign.
    pub probing_size: Option<f64>,
    /// SD, of either sign.
    pub sphere_spacing: Option<f64>,
    /// F.
    pub flatness: Option<f64>,
    /// Indicated minus true height, of either sign.
    pub linearity: Option<f64>,
    /// Standard deviation of a height that is measured again.
    pub z_repeatability: Option<f64>,
}

impl Resolver<'_> {
    /// Refuses what no test can have; what does not fit the volume is refused where that is known.
    pub(super) fn accept(&self, table: &AcceptTable) -> Result<()> {
        let limits = &table.limits_um;
        let above_zero = [
            (table.travel_mm, "travel_mm"),
            (table.sphere_mm, "sphere_mm"),
            (table.spacing_mm, "spacing_mm"),
            (table.plate_mm, "plate_mm"),
            (limits.probing_form, "limits_um.probing_form"),
            (limits.probing_form_d95, "limits_um.probing_form_d95"),
            (limits.probing_size, "limits_um.probing_size"),
            (limits.sphere_spacing, "limits_um.sphere_spacing"),
            (limits.flatness, "limits_um.flatness"),
            (limits.linearity, "limits_um.linearity"),
            (limits.z_repeatability, "limits_um.z_repeatability"),
        ];
        for (value, key) in above_zero {
            if let Some(value) = value {
                self.positive(value, &format!("accept.{key}"))?;
            }
        }
        let bounded = [
            (table.plate_tilt_deg, "plate_tilt_deg", [0.0, 60.0]),
            (table.cap_deg, "cap_deg", [20.0, 80.0]),
            (table.left_out_percent, "left_out_percent", [0.0, 50.0]),
            (table.artefact_um, "artefact_um", [0.0, 1e6]),
            (table.profiles.map(f64::from), "profiles", [3.0, 10_000.0]),
            (table.heights.map(f64::from), "heights", [2.0, 1000.0]),
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
