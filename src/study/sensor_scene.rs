//! Sensor from a sensor file or a scene, combined with parts that are created for a study.

use crate::error::input_file::{self, LARGEST_TEXT};
use crate::error::{Error, InputError, Place, Result};
use crate::scene::Scene;
use std::path::{Path, PathBuf};
use toml::{Table, Value};

/// Keys of `[part]` that define shape and pose, and not light scattering.
const SHAPE: [&str; 8] = [
    "mesh",
    "plane",
    "sphere",
    "cylinder",
    "step_block",
    "instances",
    "position_mm",
    "rotation_deg",
];
/// Keys of `[scan]` that define the path, and not the exposure.
const PATH: [&str; 10] = [
    "frames",
    "moving_body",
    "step_mm",
    "direction",
    "start_mm",
    "rotary",
    "poses",
    "poses_columns",
    "hand_eye",
    "frame_times",
];

/// Sensor file, or the sensor, surface and measurement settings of a scene.
pub struct SensorScene {
    path: PathBuf,
    /// Values of the scene, without the part's shape and the path.
    table: Table,
}

impl SensorScene {
    /// Reads a file. Returns an error with the source location if it is not a sensor file or a
    /// scene.
    pub fn read(path: &Path) -> Result<SensorScene> {
        let expected = "a scene or a sensor's file (TOML)";
        let described = input_file::read_text(path, LARGEST_TEXT, expected).ok();
        let table = described.and_then(|text| text.parse::<Table>().ok());
        let is_sensor = |table: &Table| !table.contains_key("part") && !table.contains_key("scan");
        let table = match table {
            Some(table) if !is_sensor(&table) => {
                // Loading the file reports its mistakes with line numbers.
                Scene::load(path)?;
                scene_without(table)
            }
            Some(_) => of_sensor(path)?,
            // The file is not TOML; loading it returns the error.
            None => {
                Scene::load(path)?;
                Table::new()
            }
        };
        Ok(SensorScene {
            path: path.to_owned(),
            table,
        })
    }

    /// Returns a scene of one frame with a part of this shape and the head at the world origin.
    pub fn with_part(&self, shape: &str, value: Value) -> Result<Scene> {
        let mut table = self.table.clone();
        if let Some(Value::Table(part)) = table.get_mut("part") {
            part.insert(shape.to_owned(), value);
        }
        let folder = self.path.parent().unwrap_or(Path::new(""));
        let text = toml::to_string(&table).expect("what was TOML is TOML");
        let mut scene = Scene::parse(&text, folder)?;
        scene.path = self.path.clone();
        Ok(scene)
    }

    /// Returns an error for the value of a key. An empty `found` means that the key is missing.
    pub fn wrong(&self, key: &str, found: impl Into<String>, expected: impl Into<String>) -> Error {
        let mut mistake = InputError::new(&self.path, Place::File, found, expected);
        mistake.key = Some(key.to_owned());
        mistake.into()
    }
}

fn scene_without(mut table: Table) -> Table {
    for (name, keys) in [("part", SHAPE.as_slice()), ("scan", PATH.as_slice())] {
        if let Some(Value::Table(inner)) = table.get_mut(name) {
            inner.retain(|key, _| !keys.contains(&key));
        }
    }
    if let Some(Value::Table(scan)) = table.get_mut("scan") {
        scan.extend(at_rest());
    }
    table
}

/// Returns a scene of a sensor file, with speckle and a part of reflectance 0.5.
fn of_sensor(path: &Path) -> Result<Table> {
    let name = path.file_name().and_then(|name| name.to_str());
    let name = name.ok_or_else(|| {
        let expected =
            "a UTF-8 name, because scene files contain UTF-8 paths only; rename the file";
        InputError::new(path, Place::File, "a name that is not UTF-8", expected)
    })?;
    let mut table = Table::new();
    table.insert("seed".into(), Value::Integer(1));
    table.insert("speckle".into(), Value::Boolean(true));
    table.insert("sensor".into(), Value::String(name.into()));
    let part = Table::from_iter([("reflectance".to_owned(), Value::Float(0.5))]);
    table.insert("part".into(), Value::Table(part));
    table.insert("scan".into(), Value::Table(at_rest()));
    Ok(table)
}

fn at_rest() -> Table {
    Table::from_iter([
        ("frames".to_owned(), Value::Integer(1)),
        ("step_mm".to_owned(), Value::Float(0.0)),
        (
            "direction".to_owned(),
            Value::Array(vec![
                Value::Float(0.0),
                Value::Float(1.0),
                Value::Float(0.0),
            ]),
        ),
    ])
}
