//! `Simulation`, its frames and their contents.

use crate::arrays::Point;
use crate::recent::{Measured, Recent};
use crate::scene::Scene;
use crate::{Error, raised, threads};
use lasertrace::Simulation as Core;
use lasertrace::camera::Counts;
use lasertrace::inspect::cloud::CloudPoint;
use lasertrace::math::Rigid;
use lasertrace::profile::Flags;
use lasertrace::run::RunControl;
use numpy::{Element, PyArray1, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::{PyDict, PyRange, PyRangeMethods};
use rayon::prelude::*;
use std::collections::{HashMap, VecDeque};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Returns the flags of points by name.
pub fn flags() -> HashMap<&'static str, u16> {
    let named = Flags::all().iter_names();
    named.map(|(name, flag)| (name, flag.bits())).collect()
}

/// A scene prepared for the simulation of frames: hierarchy, plan and speckle are computed.
///
/// >>> simulation = Simulation(Scene.load("scenes/bracket/scene.toml"))
/// >>> frame = simulation.frame(90)
/// >>> frame.image.shape, frame.image.dtype
/// ((512, 1280), dtype('uint16'))
/// >>> for frame in simulation.frames(range(80, 90)):
/// ...     print(frame.number, len(frame.points))
///
/// Each frame depends only on its index; the result is independent of the order and the number of
/// threads. A simulation may be used by several Python threads.
///
/// `threads` is the number of worker threads; None uses all available ones. `progress(fraction)` is
/// called repeatedly while the hierarchy of the part is built, with the completed fraction, 0 to 1.
/// An exception raised by it, and Ctrl-C, cancel the construction.
#[pyclass(frozen, module = "lasertrace")]
pub struct Simulation {
    recent: Arc<Recent>,
    scene: Py<Scene>,
    threads: usize,
}

/// Function that recreates a simulation and its arguments, for pickle.
type Reduced = (Py<PyAny>, (Py<Scene>, usize));

#[pymethods]
impl Simulation {
    #[new]
    #[pyo3(signature = (scene, *, threads = None, progress = None))]
    fn new(
        py: Python<'_>,
        scene: Py<Scene>,
        threads: Option<&Bound<'_, PyAny>>,
        progress: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Simulation> {
        let threads = threads::wanted(threads)?;
        let core = &scene.get().core;
        // Completed fraction as the bits of an f64.
        let built = AtomicU64::new(0);
        let tell = || match progress {
            Some(progress) => progress
                .call1((f64::from_bits(built.load(Relaxed)),))
                .map(drop),
            None => Ok(()),
        };
        let made = threads::run_telling(py, threads, tell, |stop| {
            let building = |share: f64| {
                built.fetch_max(share.to_bits(), Relaxed);
            };
            let control = RunControl {
                progress: &|_| {},
                setup_progress: Some(&building),
                notice: None,
                stop,
            };
            Core::watched(core, &control)
        })?;
        Ok(Simulation {
            recent: Arc::new(Recent::new(made.map_err(raised)?)),
            scene,
            threads,
        })
    }

    /// Support pickle with the scene and the number of threads. The hierarchy is built again.
    fn __reduce__(&self, py: Python<'_>) -> PyResult<Reduced> {
        let make = py.import("lasertrace")?.getattr("_unpickled_simulation")?;
        Ok((make.unbind(), (self.scene.clone_ref(py), self.threads)))
    }

    /// The simulated scene.
    #[getter]
    fn scene(&self, py: Python<'_>) -> Py<Scene> {
        self.scene.clone_ref(py)
    }

    /// Simulated effects with method and reason: a list of (effect, method, reason).
    #[getter]
    fn plan(&self) -> Vec<(String, String, String)> {
        let effects = self.recent.core.plan.effects.iter();
        let words = effects.map(|e| {
            (
                e.effect.name().to_owned(),
                e.method.to_string(),
                e.why.to_string(),
            )
        });
        words.collect()
    }

    /// Simulate one frame; indices start at 0.
    fn frame(&self, py: Python<'_>, number: &Bound<'_, PyAny>) -> PyResult<Frame> {
        let number = self.checked(number)?;
        let core = &self.recent.core;
        let taken = threads::run(py, self.threads, |_| Taken::new(core, number))?;
        taken.frame(py, &self.recent, self.threads)
    }

    /// Return the points of the frames from `start` to `stop` - 1; by default of the complete scan.
    ///
    /// The structured array has the records of Frame.points. The points are those of `lasertrace
    /// scan` with `--frames START..STOP`, with its flags and with the profile filters of the scene.
    #[pyo3(signature = (start = None, stop = None))]
    fn points<'py>(
        &self,
        py: Python<'py>,
        start: Option<&Bound<'py, PyAny>>,
        stop: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let core = &self.recent.core;
        let first = start.map_or(Ok(0), |start| self.checked(start))?;
        let end = match stop {
            None => core.scene.scan.frames,
            Some(stop) => {
                let found = stop.extract::<u32>().ok();
                let end = found.filter(|&end| end > first && end <= core.scene.scan.frames);
                end.ok_or_else(|| {
                    Error::new_err(format!(
                        "stop: found {stop}, expected a whole number from {} to {}",
                        first + 1,
                        core.scene.scan.frames
                    ))
                })?
            }
        };
        let points = threads::run(py, self.threads, |stop| {
            let of = |frame: u32| match stop.load(Relaxed) {
                true => Ok(Vec::new()),
                false => Ok(core.profile(frame).1),
            };
            let points = (first..end).into_par_iter().map(&of);
            let points = points.collect::<Result<Vec<_>, lasertrace::Error>>()?;
            core.scan_points(&(first..end), points.concat(), of)
        })?;
        let points = points.map_err(raised)?;
        Ok(PyArray1::from_vec(py, points.iter().map(record).collect()).into_any())
    }

    /// Simulate all frames and evaluate the features of the scene.
    ///
    /// Return a list with one dict per [[feature]], equal to `features` in `summary.json` of
    /// `lasertrace scan`:
    ///
    /// - `name` and `kind`; `points`, `flagged`, `near_edge` and `outliers`, the numbers of points
    ///   that are used or excluded
    /// - `problem`, the reason why there are no values, otherwise None
    /// - `lower_bound`, true if the scene has no systematic errors of sensor and stage
    /// - `quantities`: a list of dicts with `name` (with the unit, mm or deg), `nominal`, `measured`,
    ///   `deviation`, `standard_uncertainty`, `expanded_uncertainty` (k = 2), `sources`,
    ///   `tolerance`, `conformance` ("conforms", "does-not-conform", "undecided" or None),
    ///   `u_over_t` and `smallest_tolerance`
    fn features<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let core = &self.recent.core;
        let features = threads::run(py, self.threads, |stop| {
            core.scanned_features(&RunControl {
                progress: &|_| {},
                setup_progress: None,
                notice: None,
                stop,
            })
        })?;
        let json = serde_json::to_string(&features.map_err(raised)?);
        let json = json.map_err(|error| Error::new_err(error.to_string()))?;
        py.import("json")?.call_method1("loads", (json,))
    }

    /// Return an iterator over frames, given by a range or list of indices; by default all frames.
    ///
    /// Frames are simulated in batches of one per thread. `progress(done, total)` is called before
    /// each frame is returned. An exception raised by it, and Ctrl-C, end the loop. No frame is
    /// lost: the next call of next() continues with the same frame.
    #[pyo3(signature = (numbers = None, *, progress = None))]
    fn frames(
        &self,
        numbers: Option<&Bound<'_, PyAny>>,
        progress: Option<Py<PyAny>>,
    ) -> PyResult<Frames> {
        let (total, left) = self.numbers(numbers)?;
        Ok(Frames {
            recent: self.recent.clone(),
            threads: self.threads,
            total,
            progress,
            state: Mutex::new(Some(State {
                left,
                next: VecDeque::new(),
                done: 0,
            })),
            kept: Mutex::default(),
        })
    }

    /// Number of frames of the scan.
    fn __len__(&self) -> usize {
        self.recent.core.scene.scan.frames as usize
    }

    fn __repr__(&self) -> String {
        let path = self.recent.core.scene.path.display();
        format!(
            "<lasertrace.Simulation of {path}: {} frames>",
            self.__len__()
        )
    }
}

type Numbers = Box<dyn Iterator<Item = u32> + Send>;

impl Simulation {
    fn checked(&self, number: &Bound<'_, PyAny>) -> PyResult<u32> {
        let frames = self.recent.core.scene.scan.frames;
        match number.extract::<u32>() {
            Ok(number) if number < frames => Ok(number),
            _ => Err(Error::new_err(format!(
                "frame {}: expected a whole number from 0 to {}, the frames of {}",
                number.repr()?,
                frames - 1,
                self.recent.core.scene.path.display()
            ))),
        }
    }

    /// Returns the number of requested frames and their indices.
    fn numbers(&self, given: Option<&Bound<'_, PyAny>>) -> PyResult<(usize, Numbers)> {
        let Some(given) = given else {
            let frames = self.recent.core.scene.scan.frames;
            return Ok((frames as usize, Box::new(0..frames)));
        };
        let Ok(total) = given.len() else {
            return Err(Error::new_err(format!(
                "frames: found {}, expected a range or list of numbers",
                given.repr()?
            )));
        };
        if let (Ok(range), true) = (given.cast::<PyRange>(), total > 0) {
            let first = self.checked(&given.get_item(0)?)?;
            self.checked(&given.get_item(total - 1)?)?;
            let step = range.step()?;
            let number = move |i| (first as isize + i as isize * step) as u32;
            return Ok((total, Box::new((0..total).map(number))));
        }
        let numbers = given.try_iter()?.map(|number| self.checked(&number?));
        let numbers = numbers.collect::<PyResult<Vec<u32>>>()?;
        Ok((numbers.len(), Box::new(numbers.into_iter())))
    }
}

/// Iterator over frames; see Simulation.frames.
#[pyclass(frozen, module = "lasertrace")]
pub struct Frames {
    recent: Arc<Recent>,
    threads: usize,
    total: usize,
    progress: Option<Py<PyAny>>,
    /// `None` while a thread simulates frames.
    state: Mutex<Option<State>>,
    /// Frames that were not returned because `progress` raised an exception.
    kept: Mutex<VecDeque<Frame>>,
}

struct State {
    left: Numbers,
    /// Indices of the next frames, with the simulated data if available.
    next: VecDeque<(u32, Option<Taken>)>,
    done: usize,
}

#[pymethods]
impl Frames {
    fn __iter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    fn __next__(&self, py: Python<'_>) -> PyResult<Option<Frame>> {
        let Some(mut state) = self.state().take() else {
            return Err(Error::new_err(
                "another thread is taking these frames: give each thread frames of its own, \
                 simulation.frames(...)",
            ));
        };
        let kept = self.kept().pop_front();
        let frame = match kept {
            Some(kept) => Ok(Some(kept)),
            None => self.take(py, &mut state),
        };
        state.done += usize::from(matches!(frame, Ok(Some(_))));
        let done = state.done;
        *self.state() = Some(state);
        let Some(frame) = frame? else {
            return Ok(None);
        };
        if let Some(progress) = &self.progress
            && let Err(raised) = progress.call1(py, (done, self.total))
        {
            self.kept().push_back(frame);
            if let Some(state) = &mut *self.state() {
                state.done -= 1;
            }
            return Err(raised);
        }
        Ok(Some(frame))
    }

    /// Number of remaining frames.
    fn __length_hint__(&self) -> usize {
        let done = self.state().as_ref().map_or(0, |state| state.done);
        self.total - done
    }
}

impl Frames {
    /// Locks the state. The lock is held only briefly and with the GIL.
    fn state(&self) -> MutexGuard<'_, Option<State>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Locks the kept frames. The lock is held only briefly and with the GIL.
    fn kept(&self) -> MutexGuard<'_, VecDeque<Frame>> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the next frame. If it is not available yet, simulates several frames at once. After
    /// an exception, finished frames remain in `state`.
    fn take(&self, py: Python<'_>, state: &mut State) -> PyResult<Option<Frame>> {
        if state.next.front().is_none_or(|(_, taken)| taken.is_none()) {
            let more = self.threads.saturating_sub(state.next.len());
            let numbers = state.left.by_ref().take(more);
            state.next.extend(numbers.map(|number| (number, None)));
            let next = state.next.make_contiguous();
            threads::run(py, self.threads, |stop| {
                next.par_iter_mut().for_each(|(number, taken)| {
                    if taken.is_none() && !stop.load(Relaxed) {
                        *taken = Some(Taken::new(&self.recent.core, *number));
                    }
                });
            })?;
        }
        let Some((_, taken)) = state.next.pop_front() else {
            return Ok(None);
        };
        let taken = taken.expect("it was taken above");
        let frame = taken.frame(py, &self.recent, self.threads)?;
        Ok(Some(frame))
    }
}

/// Simulated data of a frame.
struct Taken {
    number: u32,
    image: Option<Counts>,
    points: Measured,
}

impl Taken {
    fn new(simulation: &Core, number: u32) -> Taken {
        let (image, _, points) = simulation.take(number);
        Taken {
            number,
            image,
            points: Arc::new(points),
        }
    }

    fn frame(self, py: Python<'_>, recent: &Arc<Recent>, threads: usize) -> PyResult<Frame> {
        let image = self.image.map(|image| {
            let shape = [image.columns(), image.rows()];
            let columns = PyArray1::from_vec(py, image.into_by_column()).reshape(shape)?;
            PyResult::Ok(columns.transpose()?.into_any().unbind())
        });
        Ok(Frame {
            number: self.number,
            image: image.transpose()?,
            measured: self.points,
            points: PyOnceLock::new(),
            truth: PyOnceLock::new(),
            recent: recent.clone(),
            threads,
        })
    }
}

fn record(point: &CloudPoint) -> Point {
    Point {
        position: point.position.to_array(),
        u_position: point.u_position,
        deviation: point.deviation,
        u_deviation: point.u_deviation,
        repeatability: point.repeatability,
        correlation_length: point.correlation_length,
        scan_correlation_length: point.scan_correlation_length,
        intensity: point.intensity,
        row: point.row,
        normal: point.normal.to_array(),
        column: point.column,
        frame: point.frame,
        flags: point.flags.bits().into(),
    }
}

/// A simulated frame: sensor image, measured points and ground truth.
#[pyclass(frozen, module = "lasertrace")]
pub struct Frame {
    /// Index of the frame in the scan, starting at 0.
    #[pyo3(get)]
    number: u32,
    /// Sensor counts: uint16, shape (rows, columns), column-major memory layout.
    ///
    /// None if the plan computes profiles from geometry without images.
    #[pyo3(get)]
    image: Option<Py<PyAny>>,
    measured: Measured,
    points: PyOnceLock<Py<PyAny>>,
    truth: PyOnceLock<Py<PyDict>>,
    recent: Arc<Recent>,
    threads: usize,
}

#[pymethods]
impl Frame {
    /// Measured points as a structured array with one record per point, computed on first access.
    ///
    /// - `position` (mm, part frame) and its standard uncertainty `u_position`
    /// - `deviation` from the CAD (mm, positive outside the material) and its standard uncertainty
    ///   `u_deviation`
    /// - `repeatability`, the standard deviation of the position without speckle and calibration,
    ///   and `correlation_length` and `scan_correlation_length` of the errors along the profile and
    ///   along the scan (mm)
    /// - `intensity` (counts)
    /// - `row` and `column` in the image
    /// - `normal` of the CAD surface
    /// - `frame`, the index of the frame
    /// - `flags` (lasertrace.Flag), a bit mask of possible defects, 0 for none
    ///
    /// The flags equal the flags of `lasertrace scan` with only this frame. DISCONTINUITY depends
    /// on neighbouring frames, which are measured too. SUSPECTED_REFLECTION by lines of sight
    /// requires all frames of the scan, and profile filters require complete profiles; see
    /// Simulation.points.
    #[getter]
    fn points(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        let points = self.points.get_or_try_init(py, || {
            let (frame, points) = (self.number, &self.measured);
            let points = self.recent.flagged(py, self.threads, frame, points)?;
            let points = points.iter().map(record).collect();
            PyResult::Ok(PyArray1::from_vec(py, points).into_any().unbind())
        })?;
        Ok(points.clone_ref(py))
    }

    /// Ground truth at the pixel centres, computed on first access.
    ///
    /// A dict of arrays of shape (rows, columns) or (rows, columns, 3), in the part frame, mm.
    /// `depth` is the distance from the pupil along the camera axis, inf where no surface is
    /// visible. There, `position` and `normal` are 0, and `triangle` and `instance` are
    /// lasertrace.MISS.
    #[getter]
    fn truth(&self, py: Python<'_>) -> PyResult<Py<PyDict>> {
        let truth = self.truth.get_or_try_init(py, || self.look(py))?;
        Ok(truth.clone_ref(py))
    }

    /// Depth map truth["depth"]: float32, shape (rows, columns), mm; inf where no surface is
    /// visible.
    #[getter]
    fn depth(&self, py: Python<'_>) -> PyResult<Option<Py<PyAny>>> {
        let depth = self.truth(py)?.bind(py).get_item("depth")?;
        Ok(depth.map(Bound::unbind))
    }

    /// Pose of the camera: a (4, 4) matrix from camera coordinates to the part frame, mm.
    ///
    /// Camera axes: z along the optical axis, x to higher columns, y to higher rows.
    #[getter]
    fn part_from_camera<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        matrix(py, &self.recent.core.view(self.number).part_from_camera)
    }

    /// Pose of the laser: a (4, 4) matrix from laser coordinates to the part frame, mm.
    ///
    /// Laser axes: z along the beam, x along the line, y perpendicular to the laser plane.
    #[getter]
    fn part_from_laser<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        matrix(py, &self.recent.core.view(self.number).part_from_laser)
    }

    fn __repr__(&self) -> String {
        let points = self.measured.len();
        format!("<lasertrace.Frame {}: {points} points>", self.number)
    }
}

impl Frame {
    fn look(&self, py: Python<'_>) -> PyResult<Py<PyDict>> {
        let core = &self.recent.core;
        let truth = threads::run(py, self.threads, |_| core.truth(self.number))?;
        let [columns, rows] = core.scene.camera.sensor.resolution.to_array();
        let shape = [rows as usize, columns as usize];
        let dict = PyDict::new(py);
        dict.set_item("depth", layer(py, truth.depth, &shape)?)?;
        let vectors = [shape[0], shape[1], 3];
        dict.set_item(
            "position",
            layer(py, truth.position.into_flattened(), &vectors)?,
        )?;
        dict.set_item(
            "normal",
            layer(py, truth.normal.into_flattened(), &vectors)?,
        )?;
        dict.set_item("triangle", layer(py, truth.triangle, &shape)?)?;
        dict.set_item("instance", layer(py, truth.copy, &shape)?)?;
        Ok(dict.unbind())
    }
}

fn layer<'py, T: Element>(
    py: Python<'py>,
    values: Vec<T>,
    shape: &[usize],
) -> PyResult<Bound<'py, PyAny>> {
    crate::arrays::shaped(PyArray1::from_vec(py, values).as_any(), shape)
}

fn matrix<'py>(py: Python<'py>, pose: &Rigid) -> PyResult<Bound<'py, PyAny>> {
    let [x, y, z] = pose.rotation.transpose().to_cols_array_2d();
    let t = pose.translation;
    let rows = [(x, t.x), (y, t.y), (z, t.z), ([0.0; 3], 1.0)];
    let rows = rows.map(|([a, b, c], t)| [a, b, c, t]);
    layer(py, rows.as_flattened().to_vec(), &[4, 4])
}
