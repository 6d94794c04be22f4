//! Scene and sensor of a scan as files in its output folder.

use super::files;
use crate::accel::Backend;
use crate::error::Result;
use crate::scene::{Scene, change_files};
use std::path::{Path, PathBuf};
use toml::{Table, Value};

pub const SCENE: &str = "resolved-scene.toml";
pub const SENSOR: &str = "resolved-sensor.toml";

/// Top-level keys of a sensor file.
const OF_SENSOR: [&str; 5] = [
    "laser",
    "camera",
    "housing_bounds_mm",
    "field_of_view_mm",
    "accept",
];

/// Writes the values of the scene, and the values of its sensor to a second file that the first one
/// names. They include the seed, the exposure, and all values that a data sheet determines. File
/// names are relative to the output folder, so a tree with both can be moved.
pub fn write(scene: &Scene, out: &Path) -> Result<()> {
    let mut table = Table::clone(&scene.values);
    let folder = scene.path.parent().unwrap_or(Path::new(""));
    change_files(&mut table, &mut |name| {
        *name = relative(&folder.join(&*name), out)
            .to_string_lossy()
            .into_owned();
    });
    table.insert("seed".to_owned(), Value::Integer(scene.seed as i64));
    if scene.accel != Backend::default() {
        let model = table.entry("model").or_insert(Value::Table(Table::new()));
        let name = Value::try_from(scene.accel).expect("a name is TOML");
        model
            .as_table_mut()
            .and_then(|model| model.insert("ray_backend".to_owned(), name));
    }
    let cameras = match table.get_mut("camera") {
        Some(Value::Array(list)) => list.iter_mut().collect(),
        one => Vec::from_iter(one),
    };
    let cameras = cameras.into_iter().filter_map(Value::as_table_mut);
    for (camera, scene) in cameras.zip(scene.each_camera()) {
        if scene.auto_exposure.is_none() && camera.remove("exposure").is_some() {
            camera.remove("auto_exposure_target");
            let exposure_ms = scene.camera.sensor.exposure_ms;
            camera.insert("exposure_ms".to_owned(), exposure_ms.into());
        }
    }
    let mut sensor = Table::new();
    for key in OF_SENSOR {
        sensor.extend(table.remove(key).map(|value| (key.to_owned(), value)));
    }
    table.insert("sensor".to_owned(), SENSOR.into());
    for (name, table) in [(SCENE, table), (SENSOR, sensor)] {
        let text = toml::to_string(&table).expect("a scene was TOML");
        files::write_bytes(&out.join(name), text.as_bytes())?;
    }
    Ok(())
}

/// Returns the path of a file relative to a folder.
fn relative(file: &Path, folder: &Path) -> PathBuf {
    let whole = |path: &Path| path.canonicalize().unwrap_or(path.to_owned());
    let above = file.parent().filter(|above| !above.as_os_str().is_empty());
    let [above, folder] = [above.unwrap_or(Path::new(".")), folder].map(whole);
    let pairs = above.components().zip(folder.components());
    let common = pairs.take_while(|(a, b)| a == b).count();
    let up = folder.components().skip(common).map(|_| "..".as_ref());
    let down = above.components().skip(common).map(|part| part.as_os_str());
    up.chain(down).chain(file.file_name()).collect()
}
