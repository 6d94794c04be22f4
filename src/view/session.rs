//! Session of the live view: one scene with changing values.

use super::refused::{HttpResult, ViewError};
use super::values::{Base, Files, SliderValues};
use crate::camera::Counts;
use crate::error::{Error, Result};
use crate::frame::unless_stopped;
use crate::inspect::cloud::CloudPoint;
use crate::math::{Aabb, DVec3};
use crate::report::live::Slider;
use crate::report::picture::{encode_counts, for_eyes};
use crate::report::viewer::{Under, Viewer, ViewerLayer, layers};
use crate::run::report::{ColorLimits, point_modes, point_values};
use crate::run::{RunControl, Simulation, check_frame, check_ready, check_text, drawing};
use crate::scene::Scene;
use rayon::ThreadPool;
use serde::Serialize;
use serde_json::Value;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

/// Maximum number of triangles in the 3D view. Larger meshes are represented by this number of
/// surface points.
const MOST_TRIANGLES: usize = 200_000;

/// A scene, with the state that is reused between requests.
pub struct Session {
    pool: ThreadPool,
    base: Base,
    own: Arc<Simulation>,
    /// Text of a scene, and its simulation for the most recent final image.
    last: Mutex<(String, Arc<Simulation>)>,
    bounds: Aabb,
}

/// Image of a frame with its profile.
#[derive(Serialize)]
pub struct Picture {
    /// True for a draft, which is shown while values change; false for the image that `render`
    /// produces.
    pub draft: bool,
    /// Frame of the scan.
    pub frame: u32,
    /// Number of columns of the image.
    pub columns: usize,
    /// Number of rows of the image.
    pub rows: usize,
    /// Computing time, ms.
    pub took_ms: f64,
    /// Exposure time, ms, which may be set automatically.
    pub exposure_ms: f64,
    /// Maximum count of the image, and saturation count.
    pub counts: [u16; 2],
    /// Number of points of the profile, and number of points without a flag.
    pub points: [usize; 2],
    /// Column and row of every detected line, px.
    pub line: Vec<[f64; 2]>,
    /// Points in the format of the page's 3D view.
    pub layers: Value,
    /// Brightened image, 8 bits per pixel, in row-major order.
    #[serde(skip)]
    pub image: Vec<u8>,
}

/// Report of `check` for the scene with the current values.
#[derive(Serialize)]
pub struct CheckPage {
    /// Warnings; empty for a scene without problems.
    pub warnings: Vec<String>,
    /// Report as printed by the command.
    pub text: String,
    /// Drawing as SVG; empty if there is nothing to draw.
    pub drawing: String,
}

impl Session {
    /// Builds the hierarchy and plans the scene, with progress and cancellation by `control`.
    /// Frames are computed by the threads of `pool`.
    ///
    /// # Errors
    /// Returns the errors of [`Simulation::watched`].
    pub fn new(
        scene: &Scene,
        files: Files,
        pool: ThreadPool,
        control: &RunControl,
    ) -> Result<Session> {
        let base = Base::new(scene, files)?;
        let own = Arc::new(pool.install(|| Simulation::watched(scene, control))?);
        let text = base.text(&SliderValues::default());
        let text = text.map_err(|refused| Error::Usage(refused.message))?;
        let box_of_part = own.accel.bounds();
        // Points may lie slightly outside the part.
        let around = DVec3::splat(0.05 * box_of_part.size().max_element());
        Ok(Session {
            pool,
            base,
            last: Mutex::new((text, own.clone())),
            bounds: Aabb::new(box_of_part.min - around, box_of_part.max + around),
            own,
        })
    }

    /// Returns the scene as loaded.
    pub fn scene(&self) -> &Scene {
        &self.own.scene
    }

    /// Returns the sliders of the page.
    pub fn sliders(&self) -> Vec<Slider> {
        self.base.sliders(self.scene())
    }

    /// Runs `work` on the session's threads.
    pub fn install<T: Send>(&self, work: impl FnOnce() -> T + Send) -> T {
        self.pool.install(work)
    }

    /// Returns the 3D view of the part, without points.
    pub fn viewer(&self) -> Viewer {
        Viewer {
            look: [0.6, 0.6],
            under: Some(Under::part(&self.own.accel, MOST_TRIANGLES, self.bounds)),
            layers: Vec::new(),
        }
    }

    /// Returns the scene file with these values. Returns an error for invalid values.
    pub fn scene_file(&self, values: &SliderValues) -> HttpResult<String> {
        let text = self.base.text(values)?;
        self.changed(&text, values)?;
        Ok(format!(
            "# Saved from `lasertrace view`. Its picture: lasertrace render THIS_FILE --frame {} -o DIR\n{text}",
            values.frame
        ))
    }

    fn changed(&self, text: &str, values: &SliderValues) -> HttpResult<Scene> {
        let scene = self.own.scene.reusing_part(text.to_owned())?;
        check_frame(&scene, values.frame).map_err(|_| {
            let last = scene.scan.frames - 1;
            let expected = format!("a frame of the scan, 0 to {last}");
            ViewError::value("frame", f64::from(values.frame), &expected)
        })?;
        Ok(scene)
    }

    /// Computes a draft, which is shown while values change. Returns an error for invalid values,
    /// and [`ViewError::superseded`] shortly after `stop` is set.
    pub fn preview(&self, values: &SliderValues, stop: &Arc<AtomicBool>) -> HttpResult<Picture> {
        let start = Instant::now();
        let scene = self.changed(&self.base.text(values)?, values)?;
        // The stated uncertainties change little between consecutive values, so the last simulation
        // is reused.
        let last = self.kept().1.clone();
        let simulation = last.preview(&scene, values.frame, stop)?;
        let picture = || self.picture(&simulation, values.frame, true, start);
        unless_stopped(picture).ok_or_else(ViewError::superseded)
    }

    /// Computes the image that `render` produces for the saved scene. Returns an error for invalid
    /// values.
    pub fn last(&self, values: &SliderValues) -> HttpResult<Picture> {
        let start = Instant::now();
        let simulation = self.simulation(values)?;
        Ok(self.picture(&simulation, values.frame, false, start))
    }

    /// Returns the final image as a PNG file, 16 bits per pixel. Returns an error for invalid
    /// values.
    pub fn png(&self, values: &SliderValues) -> HttpResult<Vec<u8>> {
        let simulation = self.simulation(values)?;
        let max_count = simulation.scene.camera.sensor.max_count();
        Ok(encode_counts(&simulation.image(values.frame), max_count))
    }

    /// Returns the report of `check`. Returns an error for invalid values.
    pub fn check(&self, values: &SliderValues) -> HttpResult<CheckPage> {
        let start = Instant::now();
        let simulation = self.simulation(values)?;
        let never = AtomicBool::new(false);
        let control = RunControl {
            progress: &|_| {},
            setup_progress: None,
            notice: None,
            stop: &never,
        };
        let checked = check_ready(&simulation, start.elapsed().as_secs_f64(), &control)?;
        Ok(CheckPage {
            warnings: checked.warnings.iter().map(|w| w.message.clone()).collect(),
            text: check_text(&checked),
            drawing: drawing(&checked).unwrap_or_default(),
        })
    }

    /// Returns the simulation of a normal run. It is cached for the next request with equal values.
    fn simulation(&self, values: &SliderValues) -> HttpResult<Arc<Simulation>> {
        let text = self.base.text(values)?;
        let scene = self.changed(&text, values)?;
        {
            let kept = self.kept();
            if kept.0 == text {
                return Ok(kept.1.clone());
            }
        }
        let simulation = Arc::new(self.own.reusing_part(&scene)?);
        *self.kept() = (text, simulation.clone());
        Ok(simulation)
    }

    fn kept(&self) -> MutexGuard<'_, (String, Arc<Simulation>)> {
        self.last.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn picture(&self, simulation: &Simulation, frame: u32, draft: bool, start: Instant) -> Picture {
        let sensor = &simulation.scene.camera.sensor;
        let image = simulation.image(frame);
        // The frame is evaluated as in a scan.
        let (_, points) = match simulation.plan.geometry_only {
            true => simulation.geometric(frame),
            false => simulation.measure(frame, &image),
        };
        let full = sensor.saturation_count();
        let valid = points.iter().filter(|point| point.is_valid()).count();
        let rows = image.to_rows();
        Picture {
            draft,
            frame,
            columns: image.columns(),
            rows: image.rows(),
            exposure_ms: sensor.exposure_ms,
            counts: [greatest(&image), full],
            points: [points.len(), valid],
            line: (points.iter().map(|p| [f64::from(p.column) + 0.5, p.row])).collect(),
            layers: self.layers(&points),
            image: for_eyes(&rows, sensor.max_count()),
            took_ms: 1e3 * start.elapsed().as_secs_f64(),
        }
    }

    fn layers(&self, points: &[CloudPoint]) -> Value {
        let Aabb { min, max } = self.bounds;
        let inside = |p: &&CloudPoint| p.position.cmpge(min).all() && p.position.cmple(max).all();
        let shown: Vec<&CloudPoint> = points.iter().filter(inside).collect();
        let layer = ViewerLayer {
            positions: shown.iter().map(|p| p.position).collect(),
            values: point_values(&shown),
            modes: point_modes(&shown, &ColorLimits::of(points)),
        };
        layers(&[layer], Some(self.bounds))
    }
}

fn greatest(image: &Counts) -> u16 {
    image.by_column().iter().copied().max().unwrap_or(0)
}
