//! Checks of a scene before a scan.

use super::ambient_limit::AmbientLimit;
use super::assessment::Assessment;
use super::files;
use super::forecast::{ResourceEstimate, forecast_of};
use super::output_folder::{Names, OutputFolder};
use super::sensor_drawing::sensor_drawing;
use super::sensor_figures::{PartSections, SensorFigures, cuts};
use super::setup;
use super::simulation::Simulation;
use super::systematic_budget::SystematicBudget;
use super::warning_kind::Warning;
use super::warnings::{PreScanCheck, foreseen_of, of_the_forecast};
use super::{RunControl, TraceMode};
use crate::error::{Error, Result};
#[cfg(feature = "cli")]
use crate::math::{DMat3, DVec3, Rigid};
use crate::plan::rules::ModelConfig;
use crate::scene::Scene;
use serde::Serialize;
use std::time::Instant;

/// Plan of a scene, forecast of its scan, and problems.
#[derive(Serialize)]
pub struct CheckReport {
    /// Scene with its exposure set.
    #[serde(skip)]
    pub scene: Scene,
    /// Simulated effects, with method and reason.
    pub plan: ModelConfig,
    /// Forecast of the complete scan.
    pub forecast: ResourceEstimate,
    /// Data sheet of the sensor; `null` if the camera sees no laser light.
    pub sensor: Option<SensorFigures>,
    /// Fractions of surface and light, and the path.
    pub assessment: Assessment,
    /// Ambient light, and the illuminance at which it doubles the repeatability.
    pub ambient: AmbientLimit,
    /// Systematic errors of sensor and stage, and their effect on heights.
    pub systematic: SystematicBudget,
    /// Cross-sections of the part in the light.
    #[serde(skip)]
    pub cuts: PartSections,
    /// Problems; empty for a good scene.
    pub warnings: Vec<Warning>,
}

/// Plans a scene and searches the entire path of its scan for problems.
///
/// # Errors
/// [`crate::error::Error::Memory`] if no frame fits into memory; errors of `control`.
pub fn check(scene: &Scene, control: &RunControl) -> Result<CheckReport> {
    let start = Instant::now();
    let simulation = setup::simulation(scene, TraceMode::Footprint, control)?;
    check_ready(&simulation, start.elapsed().as_secs_f64(), control)
}

/// Checks the scene of a sensor's file ([`Scene::of_sensor`]). Its plane is placed at the centre of
/// the measuring range, perpendicular to the beam.
///
/// # Errors
/// As [`check`].
#[cfg(feature = "cli")]
pub fn check_sensor(mut scene: Scene, control: &RunControl) -> Result<CheckReport> {
    let figures = {
        let (scene, accel) = setup::hierarchy_watched(&scene, control)?;
        SensorFigures::of_sensor(&scene, &accel)
    };
    if let Some(figures) = figures {
        let [near, far] = figures.ends();
        let world_from_laser = scene.world_from_head(0) * scene.head_from_laser;
        scene.part_at_rest = Rigid {
            // The plane faces the laser.
            rotation: world_from_laser.rotation * DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)),
            translation: world_from_laser.point(DVec3::Z * ((near + far) / 2.0)),
        };
    }
    check(&scene, control)
}

/// Checks the scene of a simulation; `preparing` is the time to build the simulation, s.
pub(crate) fn check_ready(
    simulation: &Simulation,
    preparing: f64,
    control: &RunControl,
) -> Result<CheckReport> {
    let frames = 0..simulation.scene.scan.frames;
    let forecast = forecast_of(simulation, &frames, preparing, control)?;
    let PreScanCheck {
        sensor,
        assessment,
        mut warnings,
    } = foreseen_of(simulation, frames);
    let light = sensor.as_ref().and_then(|sensor| sensor.light);
    let median = light.map(|light| light.median);
    warnings.extend(of_the_forecast(&simulation.scene, &forecast));
    Ok(CheckReport {
        scene: simulation.scene.clone(),
        plan: simulation.plan.clone(),
        forecast,
        sensor,
        assessment,
        ambient: AmbientLimit::of(simulation, median),
        systematic: SystematicBudget::of(simulation),
        cuts: cuts(&simulation.scene, &simulation.accel),
        warnings,
    })
}

/// Writes `sensor.svg` to a folder: a drawing of the sensor to scale, with the part.
///
/// # Errors
/// A camera that sees no laser light; a file that cannot be written.
pub fn draw_sensor<'a>(checked: &CheckReport, out: impl Into<OutputFolder<'a>>) -> Result<()> {
    let Some(drawing) = drawing(checked) else {
        let nothing = "the camera sees nothing of the laser's light: there is no sensor to draw";
        return Err(Error::Usage(nothing.to_owned()));
    };
    let names = Names::of(["sensor.svg"]);
    let out = out.into().claim(&checked.scene.inputs, &names)?.path;
    files::write_bytes(&out.join("sensor.svg"), drawing.as_bytes())
}

/// Returns the drawing as SVG; `None` if the camera sees no laser light.
pub(crate) fn drawing(checked: &CheckReport) -> Option<String> {
    let sensor = checked.sensor.as_ref()?;
    Some(sensor_drawing(sensor, &checked.cuts))
}
