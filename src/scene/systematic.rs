//! Systematic errors of sensor and stage in internal units (mm, rad, s).

use super::file::SceneFile;
use super::resolver::Resolver;
use super::systematic_table::{DriftTable, StageErrorTable, StageErrorsTable, SystematicTable};
use crate::error::Result;
use crate::math::DVec3;
use serde::Serialize;

/// Effect of an error on the sensor or the stage. Axes are numbered 0, 1, 2.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub enum ErrorEffect {
    /// Rotation of the laser about an axis of its frame, rad.
    LaserTurn(usize),
    /// Rotation of the camera about an axis of its frame, rad.
    CameraTurn(usize),
    /// Displacement of the camera along an axis of its frame, mm.
    CameraShift(usize),
    /// Displacement of the head along its z axis, mm.
    Height,
    /// Relative change of the focal length.
    FocalLength,
    /// Relative change of the laser power.
    LaserPower,
    /// Angle between a ray of the fan and the laser plane, rad.
    RayAngle,
    /// Displacement of a point along the motion that an error of the row causes, mm.
    Row,
    /// Displacement of the stage along an axis: travel, horizontal, vertical, mm.
    StageShift(usize),
    /// Relative error of the travel.
    StageScale,
    /// Rotation of the stage about an axis, rad.
    StageTurn(usize),
}

impl ErrorEffect {
    /// Returns whether each camera of a head has its own error.
    pub fn is_of_camera(self) -> bool {
        matches!(
            self,
            ErrorEffect::CameraTurn(_)
                | ErrorEffect::CameraShift(_)
                | ErrorEffect::FocalLength
                | ErrorEffect::Row
        )
    }
}

/// Correlation of an error between two points of a run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub enum ErrorCorrelation {
    /// The error is constant.
    Constant,
    /// Over time, with this correlation time, s.
    Time(f64),
    /// Sinusoidal in time, with this frequency, Hz.
    Sinusoidal(f64),
    /// Over the travel, with this correlation length, mm.
    Travel(f64),
    /// Over the fan angle, with this correlation angle, rad.
    Fan(f64),
    /// Proportional to the square of the fan angle, relative to its value at this angle, rad.
    Bow(f64),
    /// Over x and z of the laser frame, with these correlation lengths, mm.
    Field([f64; 2]),
}

/// Systematic error with a normal distribution.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SystematicError {
    /// Name of the source in budgets. Errors of several axes have one name.
    pub name: &'static str,
    /// Effect.
    pub effect: ErrorEffect,
    /// Standard deviation in the unit of the effect.
    pub standard_deviation: f64,
    /// Correlation over the run.
    pub correlation: ErrorCorrelation,
}

/// Systematic errors of sensor and stage.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Systematic {
    /// Independent errors; empty if the scene has none.
    pub errors: Vec<SystematicError>,
    /// Centre of the rotations of the stage, in the frame of the moving body, mm.
    pub pivot: DVec3,
}

impl Systematic {
    /// Returns whether the scene has no systematic errors.
    pub fn is_none(&self) -> bool {
        self.errors.is_empty()
    }
}

const URAD: f64 = 1e-6;
const UM: f64 = 1e-3;
const PERCENT: f64 = 1e-2;

/// Reads the errors of both tables.
struct ErrorTableReader<'a> {
    resolver: &'a Resolver<'a>,
    temperature_k: f64,
    errors: Vec<SystematicError>,
}

impl ErrorTableReader<'_> {
    /// Checks a standard deviation. The upper limit allows all errors that are small compared with
    /// the sensor, to which the first-order propagation applies.
    fn deviation(&self, value: f64, key: &str, unit: f64) -> Result<f64> {
        let most = match unit {
            UM => 1e3,
            PERCENT => 5.0,
            _ => 1e4,
        };
        self.resolver.within(value, key, [0.0, most])?;
        Ok(value * unit)
    }

    fn length(&self, value: f64, key: &str) -> Result<f64> {
        self.resolver.within(value, key, [1e-3, 1e9])
    }

    fn add(
        &mut self,
        name: &'static str,
        effects: &[ErrorEffect],
        standard_deviation: f64,
        correlation: ErrorCorrelation,
    ) {
        if standard_deviation > 0.0 {
            self.errors
                .extend(effects.iter().map(|&effect| SystematicError {
                    name,
                    effect,
                    standard_deviation,
                    correlation,
                }));
        }
    }

    /// Adds an error of the sensor.
    fn drift(
        &mut self,
        table: Option<DriftTable>,
        (key, name, unit): (&str, &'static str, f64),
        effects: &[ErrorEffect],
    ) -> Result<()> {
        let Some(table) = table else { return Ok(()) };
        let key = format!("systematic.{key}");
        let constant = format!("{key}.standard_deviation");
        let constant = self.deviation(table.standard_deviation, &constant, unit)?;
        let thermal = format!("{key}.per_kelvin");
        let thermal_by = self.deviation(table.per_kelvin, &thermal, unit)?;
        self.resolver.check(
            thermal_by == 0.0 || self.temperature_k > 0.0,
            &thermal,
            "systematic.temperature_k above 0 with it: the standard deviation of the temperature",
        )?;
        let correlation = match table.correlation_time_s {
            None => ErrorCorrelation::Constant,
            Some(time) => {
                let key = format!("{key}.correlation_time_s");
                ErrorCorrelation::Time(self.resolver.within(time, &key, [1e-6, 1e12])?)
            }
        };
        let all = constant.hypot(thermal_by * self.temperature_k);
        self.deviation(all / unit, &thermal, unit)?;
        self.add(name, effects, all, correlation);
        Ok(())
    }

    /// Adds an error of the stage.
    fn stage(
        &mut self,
        table: Option<StageErrorTable>,
        (key, name, unit): (&str, &'static str, f64),
        effects: &[ErrorEffect],
    ) -> Result<()> {
        let Some(table) = table else { return Ok(()) };
        let key = format!("scan.systematic.{key}");
        let size = format!("{key}.standard_deviation");
        let size = self.deviation(table.standard_deviation, &size, unit)?;
        let correlation = match table.correlation_length_mm {
            None => ErrorCorrelation::Constant,
            Some(length) => {
                let key = format!("{key}.correlation_length_mm");
                ErrorCorrelation::Travel(self.length(length, &key)?)
            }
        };
        self.add(name, effects, size, correlation);
        Ok(())
    }

    /// Adds the errors of laser, camera and head.
    fn sensor(&mut self, sensor: &SystematicTable) -> Result<()> {
        use ErrorEffect::*;
        let drifts = [
            (
                sensor.laser_pointing_urad,
                ("laser_pointing_urad", "laser pointing", URAD),
                &[LaserTurn(0)][..],
            ),
            (
                sensor.laser_rotation_urad,
                ("laser_rotation_urad", "laser rotation", URAD),
                &[LaserTurn(2)],
            ),
            (
                sensor.camera_rotation_urad,
                ("camera_rotation_urad", "camera rotation", URAD),
                &[CameraTurn(0), CameraTurn(1), CameraTurn(2)],
            ),
            (
                sensor.camera_position_um,
                ("camera_position_um", "camera position", UM),
                &[CameraShift(0), CameraShift(1), CameraShift(2)],
            ),
            (
                sensor.height_um,
                ("height_um", "height of the head", UM),
                &[Height],
            ),
        ];
        for (table, key, effects) in drifts {
            self.drift(table, key, effects)?;
        }
        let constants = [
            (
                sensor.focal_length_percent,
                ("focal_length_percent", "focal length", PERCENT),
                FocalLength,
            ),
            (
                sensor.laser_power_percent,
                ("laser_power_percent", "laser power", PERCENT),
                LaserPower,
            ),
        ];
        for (table, key, effect) in constants {
            let table = table.map(|table| DriftTable {
                standard_deviation: table.standard_deviation,
                per_kelvin: table.per_kelvin,
                correlation_time_s: None,
            });
            self.drift(table, key, &[effect])?;
        }
        Ok(())
    }

    /// Adds the errors of the stage.
    fn stages(&mut self, stage: &StageErrorsTable) -> Result<()> {
        use ErrorEffect::*;
        let stages = [
            (
                stage.encoder_um,
                ("encoder_um", "encoder", UM),
                &[StageShift(0)][..],
            ),
            (
                stage.straightness_um,
                ("straightness_um", "straightness of the stage", UM),
                &[StageShift(1), StageShift(2)],
            ),
            (
                stage.pitch_urad,
                ("pitch_urad", "pitch of the stage", URAD),
                &[StageTurn(1)],
            ),
            (
                stage.yaw_urad,
                ("yaw_urad", "yaw of the stage", URAD),
                &[StageTurn(2)],
            ),
            (
                stage.roll_urad,
                ("roll_urad", "roll of the stage", URAD),
                &[StageTurn(0)],
            ),
        ];
        for (table, key, effects) in stages {
            self.stage(table, key, effects)?;
        }
        Ok(())
    }
}

impl Resolver<'_> {
    /// Returns the systematic errors. `fan` is the full angle of the fan; `None` for a point laser.
    pub(super) fn systematic(&self, file: &SceneFile, fan: Option<f64>) -> Result<Systematic> {
        let sensor = file.systematic.clone().unwrap_or_default();
        let key = "systematic.temperature_k";
        let temperature_k = self.within(sensor.temperature_k, key, [0.0, 1e3])?;
        let mut read = ErrorTableReader {
            resolver: self,
            temperature_k,
            errors: Vec::new(),
        };
        read.sensor(&sensor)?;
        self.field_errors(&sensor, fan, &mut read)?;
        let stage = file.scan.systematic.clone().unwrap_or_default();
        let key = "scan.systematic.step_ppm";
        let step = self.within(stage.step_ppm, key, [0.0, 1e4])? * 1e-6;
        read.add(
            "step of the stage",
            &[ErrorEffect::StageScale],
            step,
            ErrorCorrelation::Constant,
        );
        read.stages(&stage)?;
        let pivot = self.lengths(stage.pivot_mm, "scan.systematic.pivot_mm")?;
        Ok(Systematic {
            errors: read.errors,
            pivot: pivot.into(),
        })
    }

    /// Adds the errors that depend on the position in the laser plane, and the vibration.
    fn field_errors(
        &self,
        sensor: &SystematicTable,
        fan: Option<f64>,
        read: &mut ErrorTableReader,
    ) -> Result<()> {
        let line = "no errors of the laser line for a point laser (without laser.line)";
        if let Some(table) = sensor.line_straightness_urad {
            let key = "systematic.line_straightness_urad";
            self.check(fan.is_some(), key, line)?;
            let size = format!("{key}.standard_deviation");
            let size = read.deviation(table.standard_deviation, &size, URAD)?;
            let key = format!("{key}.correlation_deg");
            let angle = self.within(table.correlation_deg, &key, [1e-3, 1e6])?;
            read.add(
                "straightness of the line",
                &[ErrorEffect::RayAngle],
                size,
                ErrorCorrelation::Fan(angle.to_radians()),
            );
        }
        let key = "systematic.line_bow_urad";
        let bow = read.deviation(sensor.line_bow_urad, key, URAD)?;
        self.check(bow == 0.0 || fan.is_some(), key, line)?;
        read.add(
            "bow of the line",
            &[ErrorEffect::RayAngle],
            bow,
            ErrorCorrelation::Bow(fan.unwrap_or(1.0) / 2.0),
        );
        if let Some(table) = sensor.residual_um {
            let key = "systematic.residual_um";
            let size = format!("{key}.standard_deviation");
            let size = read.deviation(table.standard_deviation, &size, UM)?;
            let x = read.length(table.correlation_x_mm, &format!("{key}.correlation_x_mm"))?;
            let z = read.length(table.correlation_z_mm, &format!("{key}.correlation_z_mm"))?;
            read.add(
                "residual calibration error",
                &[ErrorEffect::Row],
                size,
                ErrorCorrelation::Field([x, z]),
            );
        }
        if let Some(table) = sensor.vibration_um {
            let key = "systematic.vibration_um";
            let size = format!("{key}.standard_deviation");
            let size = read.deviation(table.standard_deviation, &size, UM)?;
            let key = format!("{key}.frequency_hz");
            let frequency = self.within(table.frequency_hz, &key, [1e-6, 1e9])?;
            read.add(
                "vibration",
                &[ErrorEffect::Height],
                size,
                ErrorCorrelation::Sinusoidal(frequency),
            );
        }
        Ok(())
    }
}
