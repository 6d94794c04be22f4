//! `Scene`: created from a file, text or dict; values changed by key.

use crate::{Error, raised, threads, values};
use lasertrace::Error as CoreError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

/// A scene to be simulated: part, laser, camera and path. Scenes are immutable.
///
/// >>> scene = Scene.load("scenes/bracket/scene.toml")
/// >>> scene.frames, scene.resolution
/// (219, (1280, 512))
/// >>> open_lens = scene.with_values({"camera.f_number": 4, "speckle": False})
///
/// docs/keys.md describes all keys. An invalid scene raises lasertrace.Error,
/// which states the key, the value found and the value expected.
#[pyclass(frozen, module = "lasertrace")]
pub struct Scene {
    pub core: lasertrace::Scene,
    text: String,
}

type Watched<'a> = &'a (dyn Fn(f64) -> lasertrace::Result<()> + Sync);

/// Reads a scene and checks for Ctrl-C meanwhile.
fn read(
    py: Python<'_>,
    how: impl FnOnce(Watched) -> lasertrace::Result<lasertrace::Scene> + Send,
) -> PyResult<lasertrace::Scene> {
    let threads = threads::wanted(None)?;
    threads::run(py, threads, |stop| how(&|_| go_on(stop)))?.map_err(raised)
}

/// Returns an error after Ctrl-C, which ends the operation that is watched.
pub fn go_on(stop: &AtomicBool) -> lasertrace::Result<()> {
    match stop.load(Relaxed) {
        true => Err(CoreError::Interrupted),
        false => Ok(()),
    }
}

impl Scene {
    fn of_text(py: Python<'_>, text: String, folder: &Path) -> PyResult<Scene> {
        let core = read(py, |_| lasertrace::Scene::parse(&text, folder))?;
        Ok(Scene { core, text })
    }

    fn of_table(py: Python<'_>, table: &toml::Table, folder: &Path) -> PyResult<Scene> {
        let text = toml::to_string(table);
        let text = text.map_err(|error| Error::new_err(format!("not a scene: {error}")))?;
        Scene::of_text(py, text, folder)
    }
}

#[pymethods]
impl Scene {
    /// Read a scene from a file (TOML).
    ///
    /// Relative file names in the scene are resolved in the folder of this file.
    #[staticmethod]
    fn load(py: Python<'_>, path: PathBuf) -> PyResult<Scene> {
        let core = read(py, |watch| lasertrace::Scene::load_watched(&path, watch))?;
        let text = std::fs::read_to_string(&path)
            .map_err(|error| raised(CoreError::io("read", &path)(error)))?;
        Ok(Scene { core, text })
    }

    /// Read a scene from text (TOML).
    ///
    /// Relative file names are resolved in `folder`, by default the working folder.
    #[staticmethod]
    #[pyo3(signature = (text, folder = None))]
    fn parse(py: Python<'_>, text: String, folder: Option<PathBuf>) -> PyResult<Scene> {
        Scene::of_text(py, text, &folder.unwrap_or_default())
    }

    /// Create a scene from nested dicts with the keys of a scene file: {"seed": 1, "camera":
    /// {...}}.
    ///
    /// NumPy numbers and arrays are accepted. Keys with the value None are ignored.
    #[staticmethod]
    #[pyo3(signature = (values, folder = None))]
    fn from_dict(
        py: Python<'_>,
        values: &Bound<'_, PyDict>,
        folder: Option<PathBuf>,
    ) -> PyResult<Scene> {
        Scene::of_table(py, &values::table(values)?, &folder.unwrap_or_default())
    }

    /// Return a scene with changed values, given by dotted keys: {"camera.f_number": 4}.
    ///
    /// A number in a key is the index of a list element ("camera.position_mm.2"). None removes a
    /// key, and a dict replaces a complete table.
    fn with_values(&self, py: Python<'_>, values: &Bound<'_, PyDict>) -> PyResult<Scene> {
        let table = self.text.parse::<toml::Table>();
        let table = table.map_err(|error| Error::new_err(format!("not TOML: {error}")))?;
        let folder = self.core.path.parent().unwrap_or(Path::new(""));
        Scene::of_table(py, &values::change(table, values)?, folder)
    }

    /// The scene as text (TOML).
    #[getter]
    fn text(&self) -> &str {
        &self.text
    }

    /// Number of frames of the scan.
    #[getter]
    fn frames(&self) -> u32 {
        self.core.scan.frames
    }

    /// Image size of the camera: (columns, rows).
    #[getter]
    fn resolution(&self) -> (u32, u32) {
        self.core.camera.sensor.resolution.into()
    }

    /// One scene per camera, in the order of the list [[camera]].
    ///
    /// Simulation accepts scenes of one camera only.
    #[getter]
    fn cameras(&self) -> PyResult<Vec<Scene>> {
        let of = |core: &lasertrace::Scene| {
            let text = toml::to_string(&*core.values);
            let text = text.map_err(|error| Error::new_err(format!("not a scene: {error}")))?;
            let core = core.clone();
            Ok(Scene { core, text })
        };
        match &*self.core.cameras {
            [] => Ok(vec![Scene {
                core: self.core.clone(),
                text: self.text.clone(),
            }]),
            cameras => cameras.iter().map(of).collect(),
        }
    }

    /// Support pickle with the text and the folder of the scene. Its files are read again.
    fn __reduce__(&self, py: Python<'_>) -> PyResult<(Py<PyAny>, (String, PathBuf))> {
        let folder = self.core.path.parent().unwrap_or(Path::new(""));
        // Another process may have a different working folder.
        let folder = std::path::absolute(folder.join("."))?;
        let make = py.import("lasertrace")?.getattr("_unpickled_scene")?;
        Ok((make.unbind(), (self.text.clone(), folder)))
    }

    fn __repr__(&self) -> String {
        let (columns, rows) = self.resolution();
        format!(
            "<lasertrace.Scene {}: {}, {} frames of {columns} × {rows} pixels>",
            self.core.path.display(),
            self.core.part,
            self.frames()
        )
    }
}
