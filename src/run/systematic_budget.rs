//! Contributions of the systematic errors to a height and to means of heights.

use super::simulation::Simulation;
use super::surface_view::surface_view;
use super::systematic::{ErrorShift, SystematicErrors};
use crate::math::{DVec2, DVec3};
use serde::Serialize;
use std::collections::BTreeMap;

/// Number of columns and of profiles of the means.
const SIDE: u32 = 100;

/// Contributions of the systematic errors of sensor and stage to the height of a surface
/// perpendicular to the beam, at the centre of the field.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct SystematicBudget {
    /// True if the scene has no systematic errors. Uncertainties of means are then lower bounds.
    pub lower_bound: bool,
    /// Contributions, one per source.
    pub sources: Vec<SystematicSource>,
}

/// Contribution of a source: standard uncertainties of the height, µm.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SystematicSource {
    /// Name of the source.
    pub name: &'static str,
    /// Value for a point.
    pub point_um: f64,
    /// Value for the mean over 100 columns of a profile.
    pub mean_100_um: f64,
    /// Value for the mean over 100 columns of 100 profiles.
    pub mean_10000_um: f64,
}

impl SystematicBudget {
    /// Returns the budget of a simulation.
    pub(crate) fn of(simulation: &Simulation) -> SystematicBudget {
        let Some(errors) = simulation.systematic.as_deref() else {
            return SystematicBudget {
                lower_bound: true,
                sources: Vec::new(),
            };
        };
        let sums = [(1, 1), (SIDE, 1), (SIDE, SIDE)]
            .map(|(columns, profiles)| variances(simulation, errors, columns, profiles));
        let [point, profile, all] = sums;
        let um = |variances: &SourceVariances, name: &str| {
            1e3 * variances.get(name).copied().unwrap_or(0.0).sqrt()
        };
        let mut names: Vec<&'static str> = Vec::new();
        for error in 0..errors.len() {
            if !names.contains(&errors.name(error)) {
                names.push(errors.name(error));
            }
        }
        let source = |name: &'static str| SystematicSource {
            name,
            point_um: um(&point, name),
            mean_100_um: um(&profile, name),
            mean_10000_um: um(&all, name),
        };
        SystematicBudget {
            lower_bound: false,
            sources: names.into_iter().map(source).collect(),
        }
    }

    /// Returns the budget as text, one line per source.
    pub fn text(&self) -> String {
        if self.lower_bound {
            return "  none given: uncertainties of means are lower bounds\n".to_owned();
        }
        let mut text = format!(
            "  {:<28}{:>12}{:>18}{:>20}\n",
            "height, µm", "one point", "mean of 100", "mean of 10 000"
        );
        for source in &self.sources {
            text += &format!(
                "  {:<28}{:>12.3}{:>18.3}{:>20.3}\n",
                source.name, source.point_um, source.mean_100_um, source.mean_10000_um
            );
        }
        text
    }
}

type SourceVariances = BTreeMap<&'static str, f64>;

/// Returns the variances of the mean height over columns and profiles, mm², by source.
fn variances(
    simulation: &Simulation,
    errors: &SystematicErrors,
    columns: u32,
    profiles: u32,
) -> SourceVariances {
    let scene = &simulation.scene;
    let up = -scene.head_from_laser.rotation.z_axis;
    let center = scene
        .head_from_camera
        .inverse()
        .point(surface_view(scene, None).point);
    let Some(center) = scene.camera.project(center) else {
        return SourceVariances::new();
    };
    let middle = f64::from(scene.scan.frames / 2);
    let mut sums: BTreeMap<(usize, u64), f64> = BTreeMap::new();
    let n = f64::from(columns * profiles);
    for profile in 0..profiles {
        let place = middle + f64::from(profile) - f64::from(profiles / 2);
        let part_from_head = scene.part_from_head_at(place);
        let normal: DVec3 = part_from_head.vector(up);
        for column in 0..columns {
            let pixel = center + DVec2::X * (f64::from(column) - f64::from(columns / 2));
            let Some(jacobian) = simulation.calibration.point_jacobian(pixel) else {
                continue;
            };
            for ErrorShift { error, shift } in
                errors.shifts(pixel, &jacobian, place, &part_from_head)
            {
                let height = normal.dot(shift) / n;
                errors.nodes(error, place, jacobian.point, &mut |node, weight| {
                    *sums.entry((error, node)).or_default() += height * weight;
                });
            }
        }
    }
    let mut by_name = SourceVariances::new();
    for ((error, _), sum) in sums {
        *by_name.entry(errors.name(error)).or_default() += sum * sum;
    }
    by_name
}
