//! Values that the page controls, and the resulting scene file.

use super::refused::{HttpResult, ViewError};
use crate::accel::Backend;
use crate::error::{Error, Result};
use crate::math::{DMat3, DVec3, Rigid};
use crate::report::live::Slider;
use crate::run::surface_view::surface_view;
use crate::scene::{Scene, change_files, set_value, value_at};
use serde::Deserialize;
use std::path::Path;
use toml::{Table, Value};

/// Request parameters of the page: a frame, and values that replace values of the scene. Absent
/// values are unchanged.
#[derive(Debug, Clone, Copy, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SliderValues {
    /// Frame of the scan.
    pub frame: u32,
    /// Exposure time, ms.
    pub exposure_ms: Option<f64>,
    /// F-number of the lens.
    pub f_number: Option<f64>,
    /// Power of the laser, mW.
    pub power_mw: Option<f64>,
    /// Triangulation angle, degrees. It is measured at the point where the optical axis intersects
    /// the laser plane, between the laser axis and the line to the camera.
    pub angle_deg: Option<f64>,
    /// Translation of the head along x of the world frame, mm.
    pub x_mm: Option<f64>,
    /// Translation of the head along y of the world frame, mm.
    pub y_mm: Option<f64>,
    /// Translation of the head along z of the world frame, mm.
    pub z_mm: Option<f64>,
    /// Rotation of the head about its x axis, degrees. Rotations are applied about x, then y, then
    /// z.
    pub rx_deg: Option<f64>,
    /// Rotation of the head about its y axis, degrees.
    pub ry_deg: Option<f64>,
    /// Rotation of the head about its z axis, degrees.
    pub rz_deg: Option<f64>,
}

/// Values of a scene file, and the poses of laser and camera that they define.
pub struct Base {
    table: Table,
    head_from_laser: Rigid,
    head_from_camera: Rigid,
    /// Intersection of the optical axis with the laser plane, head frame, mm.
    middle: DVec3,
    start: DVec3,
}

/// Form of the file names in a saved scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Files {
    /// Absolute paths: the scene may be saved in any folder.
    ByFullPath,
    /// Names as given: the scene may be sent to the service again.
    AsGiven,
}

/// Keys of positions in the head frame. The next constant lists keys of directions.
const POSITIONS: [&str; 3] = [
    "laser.position_mm",
    "camera.position_mm",
    "camera.look_at_mm",
];
const DIRECTIONS: [&str; 3] = [
    "laser.direction",
    "laser.line.direction",
    "camera.column_axis",
];
/// Ratio between the scene's value and either end of its slider, for positive values.
const RATIOS: f64 = 32.0;

impl Base {
    /// Creates the base from a scene that was read from a file. Changes after reading are included
    /// in its values.
    pub fn new(scene: &Scene, files: Files) -> Result<Base> {
        let mut table = Table::clone(&scene.values);
        let folder = scene.path.parent().unwrap_or(Path::new(""));
        if files == Files::ByFullPath {
            change_files(&mut table, &mut |name| {
                let path = std::path::absolute(folder.join(&*name));
                *name = path.map_or(name.clone(), |path| path.to_string_lossy().into_owned());
            });
        }
        table.insert("seed".to_owned(), Value::Integer(scene.seed as i64));
        let mut base = Base {
            table,
            head_from_laser: scene.head_from_laser,
            head_from_camera: scene.head_from_camera * Rigid::translation(scene.camera.position()),
            middle: surface_view(scene, None).point,
            start: scene.scan.start,
        };
        if scene.methods.ray_backend.is_some() || scene.accel != Backend::default() {
            let name = Value::try_from(scene.accel).expect("a name is TOML");
            set(&mut base.table, "model.ray_backend", Some(name))?;
        }
        Ok(base)
    }

    /// Returns the sliders, with their start values from a scene with a fixed exposure time.
    pub fn sliders(&self, scene: &Scene) -> Vec<Slider> {
        let range = |key, label, start, ends, ratios| Slider {
            key,
            label,
            start,
            ends,
            ratios,
        };
        let above_zero = |key, label, start: f64| {
            range(key, label, start, [start / RATIOS, start * RATIOS], true)
        };
        let size = scene.bounds().size().max_element();
        let moved = |key, label| range(key, label, 0.0, [-size, size], false);
        let turned = |key, label| range(key, label, 0.0, [-45.0, 45.0], false);
        let [middle, last] = [scene.scan.frames / 2, scene.scan.frames - 1].map(f64::from);
        vec![
            range("frame", "frame", middle, [0.0, last], false),
            above_zero(
                "exposure_ms",
                "exposure, ms",
                scene.camera.sensor.exposure_ms,
            ),
            range(
                "f_number",
                "f-number",
                scene.camera.lens.f_number,
                [1.0, 64.0],
                true,
            ),
            above_zero("power_mw", "laser power, mW", scene.laser.beam.power_mw),
            range(
                "angle_deg",
                "triangulation angle, °",
                self.angle().to_degrees(),
                [5.0, 75.0],
                false,
            ),
            moved("x_mm", "head moved along x, mm"),
            moved("y_mm", "along y, mm"),
            moved("z_mm", "along z, mm"),
            turned("rx_deg", "head turned about x, °"),
            turned("ry_deg", "about y, °"),
            turned("rz_deg", "about z, °"),
        ]
    }

    /// Returns the position of the camera relative to `middle`: along the laser's y axis, and
    /// against the beam direction.
    fn camera(&self) -> [f64; 2] {
        let up = self.head_from_camera.translation - self.middle;
        let laser = &self.head_from_laser.rotation;
        [up.dot(laser.y_axis), -up.dot(laser.z_axis)]
    }

    /// Returns the triangulation angle of the scene, rad.
    fn angle(&self) -> f64 {
        let [beside, up] = self.camera();
        beside.abs().atan2(up)
    }

    /// Returns the scene with these values as TOML text.
    pub fn text(&self, values: &SliderValues) -> HttpResult<String> {
        let mut table = self.table.clone();
        if let Some(exposure) = values.exposure_ms {
            for other in ["exposure", "auto_exposure_target"] {
                // Ignore the error if the key is absent.
                let _ = set(&mut table, &format!("camera.{other}"), None);
            }
            set(&mut table, "camera.exposure_ms", Some(exposure.into()))?;
        }
        let plain = [
            ("camera.f_number", values.f_number),
            ("laser.power_mw", values.power_mw),
        ];
        for (key, value) in plain {
            if let Some(value) = value {
                set(&mut table, key, Some(value.into()))?;
            }
        }
        let moved = given("mm", [values.x_mm, values.y_mm, values.z_mm])?;
        if moved != DVec3::ZERO {
            set(&mut table, "scan.start_mm", Some(list(self.start + moved)))?;
        }
        let turn = given("deg", [values.rx_deg, values.ry_deg, values.rz_deg])?;
        let turned = Rigid::from_euler_xyz(turn.map(f64::to_radians), DVec3::ZERO);
        let swung = self.swung(values.angle_deg)?;
        if turn == DVec3::ZERO && swung == Rigid::IDENTITY {
            return Ok(toml::to_string(&table).expect("a scene was TOML"));
        }
        for key in POSITIONS.into_iter().chain(DIRECTIONS) {
            let Some(old) = value_at(&mut table, key) else {
                continue;
            };
            let Some(place) = vector(old) else { continue };
            let camera = if key.starts_with("camera") {
                swung
            } else {
                Rigid::IDENTITY
            };
            let motion = turned * camera;
            *old = list(match POSITIONS.contains(&key) {
                true => motion.point(place),
                false => motion.vector(place),
            });
        }
        Ok(toml::to_string(&table).expect("a scene was TOML"))
    }

    /// Returns the rotation of the camera about the laser line, through `middle`, that gives this
    /// triangulation angle.
    fn swung(&self, angle_deg: Option<f64>) -> HttpResult<Rigid> {
        let Some(angle) = angle_deg.filter(|&angle| angle != self.angle().to_degrees()) else {
            return Ok(Rigid::IDENTITY);
        };
        if !(1.0..=89.0).contains(&angle) {
            return Err(ViewError::value(
                "angle_deg",
                angle,
                "an angle from 1 to 89 degrees",
            ));
        }
        // A positive rotation about x moves the camera from the beam axis towards y.
        let side = if self.camera()[0] < 0.0 { -1.0 } else { 1.0 };
        let by = (angle.to_radians() - self.angle()) * side;
        let rotation = DMat3::from_axis_angle(self.head_from_laser.rotation.x_axis, by);
        Ok(Rigid {
            rotation,
            translation: self.middle - rotation * self.middle,
        })
    }
}

fn set(table: &mut Table, key: &str, value: Option<Value>) -> Result<()> {
    let mut root = Value::Table(std::mem::take(table));
    let done = set_value(&mut root, key, value);
    if let Value::Table(changed) = root {
        *table = changed;
    }
    done.map_err(Error::Usage)
}

/// Returns a list of three numbers as a vector.
fn vector(value: &Value) -> Option<DVec3> {
    let number = |value: &Value| value.as_float().or(value.as_integer().map(|n| n as f64));
    let numbers: Option<Vec<f64>> = value.as_array()?.iter().map(number).collect();
    Some(DVec3::from_array(numbers?.try_into().ok()?))
}

fn list(vector: DVec3) -> Value {
    Value::Array(vector.to_array().map(Value::Float).to_vec())
}

/// Returns three values as a vector, with 0 for absent values.
fn given(unit: &str, values: [Option<f64>; 3]) -> HttpResult<DVec3> {
    let axes = match unit {
        "mm" => ["x_mm", "y_mm", "z_mm"],
        _ => ["rx_deg", "ry_deg", "rz_deg"],
    };
    for (axis, value) in axes.into_iter().zip(values) {
        if let Some(value) = value.filter(|value| !value.is_finite() || value.abs() > 1e6) {
            return Err(ViewError::value(
                axis,
                value,
                "a number from -1000000 to 1000000",
            ));
        }
    }
    Ok(DVec3::from_array(values.map(Option::unwrap_or_default)))
}
