//! One scene, looked at with changing values.

use super::refused::{Answer, Refused};
use super::values::{Base, Files, Values};
use crate::camera::Counts;
use crate::error::{Error, Result};
use crate::frame::unless_stopped;
use crate::inspect::cloud::CloudPoint;
use crate::math::{Aabb, DVec3};
use crate::report::live::Slider;
use crate::report::picture::{encode_counts, for_eyes};
use crate::report::viewer::{Layer, Under, Viewer, layers};
use crate::run::report::{Limits, point_modes, point_values};
use crate::run::{Control, Simulation, check_frame, check_ready, check_text, drawing};
use crate::scene::Scene;
use rayon::ThreadPool;
use serde::Serialize;
use serde_json::Value;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

/// More triangles are not drawn, but as many places of the surface.
const MOST_TRIANGLES: usize = 200_000;

/// A scene, and what is kept of it from one request to the next.
pub struct Session {
    pool: ThreadPool,
    base: Base,
    own: Arc<Simulation>,
    /// The last that was made for a final picture, and the text of its scene.
    last: Mutex<(String, Arc<Simulation>)>,
    bounds: Aabb,
}

/// A picture of a frame and its profile.
#[derive(Serialize)]
pub struct Picture {
    /// Whether it is one to see while values change, or the one that `render` makes.
    pub draft: bool,
    /// Frame of the scan.
    pub frame: u32,
    /// Of the image, px.
    pub columns: usize,
    /// Of the image, px.
    pub rows: usize,
    /// Time that it took to make, ms.
    pub took_ms: f64,
    /// Exposure that it has, which may follow from the light.
    pub exposure_ms: f64,
    /// Greatest count, and that of a full pixel.
    pub counts: [u16; 2],
    /// Points of the profile, and those of them without a flag.
    pub points: [usize; 2],
    /// Each line found: column and row, px.
    pub line: Vec<[f64; 2]>,
    /// Points as the page's 3D view takes them.
    pub layers: Value,
    /// 8 bits a pixel, brightened, row by row.
    #[serde(skip)]
    pub image: Vec<u8>,
}

/// What `check` says of the scene with the values.
#[derive(Serialize)]
pub struct CheckPage {
    /// Empty for a good scene.
    pub warnings: Vec<String>,
    /// As the command prints it.
    pub text: String,
    /// SVG; empty if there is nothing to draw.
    pub drawing: String,
}

impl Session {
    /// Builds the hierarchy and plans the scene, while `control` watches; frames are taken by the threads of `pool`.
    ///
    /// # Errors
    /// As of [`Simulation::watched`].
    pub fn new(
        scene: &Scene,
        files: Files,
        pool: ThreadPool,
        control: &Control,
    ) -> Result<Session> {
        let base = Base::new(scene, files)?;
        let own = Arc::new(pool.install(|| Simulation::watched(scene, control))?);
        let text = base.text(&Values::default());
        let text = text.map_err(|refused| Error::Usage(refused.message))?;
        let box_of_part = own.accel.bounds();
        // Points may lie a little off the part.
        let around = DVec3::splat(0.05 * box_of_part.size().max_element());
        Ok(Session {
            pool,
            base,
            last: Mutex::new((text, own.clone())),
            bounds: Aabb::new(box_of_part.min - around, box_of_part.max + around),
            own,
        })
    }

    /// The scene as it was given.
    pub fn scene(&self) -> &Scene {
        &self.own.scene
    }

    /// What the page lets one drag.
    pub fn sliders(&self) -> Vec<Slider> {
        self.base.sliders(self.scene())
    }

    /// Runs on the session's threads.
    pub fn install<T: Send>(&self, work: impl FnOnce() -> T + Send) -> T {
        self.pool.install(work)
    }

    /// The part under the points.
    pub fn viewer(&self) -> Viewer {
        Viewer {
            look: [0.6, 0.6],
            under: Some(Under::part(&self.own.accel, MOST_TRIANGLES, self.bounds)),
            layers: Vec::new(),
        }
    }

    /// The scene file with these values. Errors: values that cannot be.
    pub fn scene_file(&self, values: &Values) -> Answer<String> {
        let text = self.base.text(values)?;
        self.changed(&text, values)?;
        Ok(format!(
            "# Saved from `lasertrace view`. Its picture: lasertrace render THIS_FILE --frame {} -o DIR\n{text}",
            values.frame
        ))
    }

    fn changed(&self, text: &str, values: &Values) -> Answer<Scene> {
        let scene = self.own.scene.of_same_part(text.to_owned())?;
        check_frame(&scene, values.frame).map_err(|_| {
            let last = scene.scan.frames - 1;
            let expected = format!("a frame of the scan, 0 to {last}");
            Refused::value("frame", f64::from(values.frame), &expected)
        })?;
        Ok(scene)
    }

    /// A picture to see while values change. Errors: values that cannot be; [`Refused::superseded`] soon after `stop`
    /// is set.
    pub fn draft(&self, values: &Values, stop: &Arc<AtomicBool>) -> Answer<Picture> {
        let start = Instant::now();
        let scene = self.changed(&self.base.text(values)?, values)?;
        // What is stated of errors changes little from one value to the next.
        let last = self.kept().1.clone();
        let simulation = last.draft(&scene, values.frame, stop)?;
        let picture = || self.picture(&simulation, values.frame, true, start);
        unless_stopped(picture).ok_or_else(Refused::superseded)
    }

    /// The picture that `render` makes of the saved scene. Errors: values that cannot be.
    pub fn last(&self, values: &Values) -> Answer<Picture> {
        let start = Instant::now();
        let simulation = self.simulation(values)?;
        Ok(self.picture(&simulation, values.frame, false, start))
    }

    /// Its file: PNG, 16 bits a pixel. Errors: values that cannot be.
    pub fn png(&self, values: &Values) -> Answer<Vec<u8>> {
        let simulation = self.simulation(values)?;
        let max_count = simulation.scene.camera.sensor.max_count();
        Ok(encode_counts(&simulation.image(values.frame), max_count))
    }

    /// What `check` says. Errors: values that cannot be.
    pub fn check(&self, values: &Values) -> Answer<CheckPage> {
        let start = Instant::now();
        let simulation = self.simulation(values)?;
        let never = AtomicBool::new(false);
        let control = Control {
            progress: &|_| {},
            building: None,
            stop: &never,
        };
        let checked = check_ready(&simulation, start.elapsed().as_secs_f64(), &control)?;
        Ok(CheckPage {
            warnings: checked.warnings.iter().map(|w| w.message.clone()).collect(),
            text: check_text(&checked),
            drawing: drawing(&checked).unwrap_or_default(),
        })
    }

    /// The simulation that a run would make, kept for the next who asks for the same.
    fn simulation(&self, values: &Values) -> Answer<Arc<Simulation>> {
        let text = self.base.text(values)?;
        let scene = self.changed(&text, values)?;
        {
            let kept = self.kept();
            if kept.0 == text {
                return Ok(kept.1.clone());
            }
        }
        let simulation = Arc::new(self.own.of_same_part(&scene)?);
        *self.kept() = (text, simulation.clone());
        Ok(simulation)
    }

    fn kept(&self) -> MutexGuard<'_, (String, Arc<Simulation>)> {
        self.last.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn picture(&self, simulation: &Simulation, frame: u32, draft: bool, start: Instant) -> Picture {
        let sensor = &simulation.scene.camera.sensor;
        let image = simulation.image(frame);
        // What a scan makes of the frame.
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
        let layer = Layer {
            positions: shown.iter().map(|p| p.position).collect(),
            values: point_values(&shown),
            modes: point_modes(&shown, &Limits::of(points)),
        };
        layers(&[layer], Some(self.bounds))
    }
}

fn greatest(image: &Counts) -> u16 {
    image.by_column().iter().copied().max().unwrap_or(0)
}
