//! Scenes and the simulation of their frames.

use crate::buffers::{Plain, addresses, check_disjoint, one, same_number, set, text, write};
use crate::cast::pool;
use crate::environment::Environment;
use crate::handles::{self, Handle};
use crate::status::{Failure, Outcome, enter, lasertrace_status};
use lasertrace_core::inspect::cloud::CloudPoint;
use lasertrace_core::profile::{Flags, Peak};
use lasertrace_core::{Scene, Simulation};
use rayon::ThreadPool;
use rayon::prelude::*;
use std::ffi::{c_char, c_int, c_void};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;

/// Validated scene: part, sensor and path.
pub struct lasertrace_scene {
    _opaque: (),
}

impl Handle for lasertrace_scene {
    type Object = Scene;
    const NAME: &'static str = "lasertrace_scene";
}

/// Scene prepared for the simulation of frames. Owns its data; its scene may be freed.
pub struct lasertrace_simulation {
    _opaque: (),
}

/// Object referenced by a [`lasertrace_simulation`].
pub struct Simulator {
    pub simulation: Simulation,
    pub pool: ThreadPool,
}

impl Handle for lasertrace_simulation {
    type Object = Simulator;
    const NAME: &'static str = "lasertrace_simulation";
}

/// Dimensions that determine the size of the frame buffers.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct lasertrace_size {
    /// Number of pixels along the laser line.
    pub columns: u32,
    /// Number of pixels perpendicular to the laser line.
    pub rows: u32,
    /// Number of frames of the scan.
    pub frames: u32,
}

/// Value of `found`: the column contains no line.
pub const LASERTRACE_PROFILE_NOTHING: u32 = 0;
/// Value of `found`: a line was detected. Row, intensity, height, width and flags are set.
pub const LASERTRACE_PROFILE_LINE: u32 = 1;
/// Value of `found`: a point was computed. Position, uncertainties and deviation are set as well.
pub const LASERTRACE_PROFILE_POINT: u32 = 2;

/// A pixel of the line is saturated.
pub const LASERTRACE_FLAG_SATURATED: u32 = 1;
/// The column contains more than one line.
pub const LASERTRACE_FLAG_MULTIPLE_PEAKS: u32 = 2;
/// The line is wider than the other lines of the frame.
pub const LASERTRACE_FLAG_WIDE: u32 = 4;
/// The line is much lower than the other lines of the frame, or close to the noise.
pub const LASERTRACE_FLAG_LOW_SIGNAL: u32 = 8;
/// The line is cut off by the image border.
pub const LASERTRACE_FLAG_IMAGE_BORDER: u32 = 16;
/// The line is next to an occlusion or a discontinuity.
pub const LASERTRACE_FLAG_DISCONTINUITY: u32 = 32;
/// The stated uncertainty is outside its range of validity.
pub const LASERTRACE_FLAG_UNCERTAINTY_NOT_VALID: u32 = 64;
/// The line may be a reflection.
pub const LASERTRACE_FLAG_SUSPECTED_REFLECTION: u32 = 128;

const _: () = {
    assert!(LASERTRACE_FLAG_SATURATED == Flags::SATURATED.bits() as u32);
    assert!(LASERTRACE_FLAG_MULTIPLE_PEAKS == Flags::MULTIPLE_PEAKS.bits() as u32);
    assert!(LASERTRACE_FLAG_WIDE == Flags::WIDE.bits() as u32);
    assert!(LASERTRACE_FLAG_LOW_SIGNAL == Flags::LOW_SIGNAL.bits() as u32);
    assert!(LASERTRACE_FLAG_IMAGE_BORDER == Flags::IMAGE_BORDER.bits() as u32);
    assert!(LASERTRACE_FLAG_DISCONTINUITY == Flags::DISCONTINUITY.bits() as u32);
    assert!(LASERTRACE_FLAG_UNCERTAINTY_NOT_VALID == Flags::UNCERTAINTY_NOT_VALID.bits() as u32);
    assert!(LASERTRACE_FLAG_SUSPECTED_REFLECTION == Flags::SUSPECTED_REFLECTION.bits() as u32);
    // The flag INTERPOLATED is not used, because gaps in single frames are not filled.
    assert!(Flags::all().bits() == 255 | Flags::INTERPOLATED.bits());
};

/// Measurement in one column of a frame. Unset fields are 0.
#[repr(C)]
#[derive(Clone, Copy, Default)]
pub struct lasertrace_profile_point {
    /// Position in the part frame, mm.
    pub position: [f64; 3],
    /// Standard uncertainty of the position, mm.
    pub u_position: f64,
    /// Signed distance to the CAD surface, mm; positive outside the material.
    pub deviation: f64,
    /// Standard uncertainty of the deviation, mm.
    pub u_deviation: f64,
    /// Standard deviation of the position without speckle and calibration, mm.
    pub repeatability: f64,
    /// Correlation length of the errors along the profile, mm.
    pub correlation_length: f64,
    /// Correlation length of the errors along the scan, mm.
    pub scan_correlation_length: f64,
    /// Row of the line; pixel j covers j to j + 1.
    pub row: f64,
    /// Sum of the line's counts above the background.
    pub intensity: f64,
    /// Counts above the background of the highest pixel.
    pub height: f64,
    /// Standard deviation of the line profile along the column, px.
    pub line_sigma_px: f64,
    /// Index of the frame.
    pub frame: u32,
    /// Index of the column.
    pub column: u32,
    /// Sum of LASERTRACE_FLAG_... values.
    pub flags: u32,
    /// Contents: LASERTRACE_PROFILE_...
    pub found: u32,
}

// SAFETY: numbers without padding: thirteen f64 and four u32 are 120 bytes.
unsafe impl Plain for lasertrace_profile_point {}
const _: () = assert!(size_of::<lasertrace_profile_point>() == 120);

/// Output buffers for frames. A buffer that is NULL with length 0 is not filled. Each other buffer
/// holds all frames of the call, one after the other.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct lasertrace_frames {
    /// Sensor counts in row-major order: frames * rows * columns elements.
    pub images: *mut u16,
    /// Number of elements of `images`.
    pub image_length: usize,
    /// Depth at the pixel centres along the camera axis, mm, in row-major order; INFINITY where no
    /// surface is visible: frames * rows * columns elements.
    pub depths: *mut f32,
    /// Number of elements of `depths`.
    pub depth_length: usize,
    /// Measurements, one element per column: frames * columns elements.
    pub profiles: *mut lasertrace_profile_point,
    /// Number of elements of `profiles`.
    pub profile_length: usize,
}

/// Progress callback, called after each frame on the thread that called
/// lasertrace_simulation_frames(). `done` and `total` are the completed and requested numbers of
/// frames, `user` is the pointer given by the caller. A non-zero return value stops the simulation.
/// The function must return normally, without longjmp or C++ exceptions.
pub type lasertrace_progress =
    Option<unsafe extern "C" fn(done: u32, total: u32, user: *mut c_void) -> c_int>;

/// Reads a scene file (TOML, see docs/keys.md) and its mesh. Returns LASERTRACE_STATUS_INPUT for
/// an error in one of them; the message contains file, line and key.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lasertrace_scene_load(
    path: *const c_char,
    out: *mut *mut lasertrace_scene,
) -> lasertrace_status {
    enter("lasertrace_scene_load", || {
        // SAFETY: guaranteed by the caller.
        unsafe {
            set("out", out, std::ptr::null_mut())?;
            let path = Path::new(text("path", path)?);
            set("out", out, handles::give(Scene::load(path)?))
        }
    })
}

/// Reads a scene from text (TOML). Relative file names are resolved in `folder`. Errors are the
/// errors of lasertrace_scene_load().
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lasertrace_scene_parse(
    toml: *const c_char,
    folder: *const c_char,
    out: *mut *mut lasertrace_scene,
) -> lasertrace_status {
    enter("lasertrace_scene_parse", || {
        // SAFETY: guaranteed by the caller.
        unsafe {
            set("out", out, std::ptr::null_mut())?;
            let folder = Path::new(text("folder", folder)?);
            let scene = Scene::parse(text("toml", toml)?, folder)?;
            set("out", out, handles::give(scene))
        }
    })
}

/// Frees a scene. NULL is ignored and returns LASERTRACE_STATUS_OK.
#[unsafe(no_mangle)]
pub extern "C" fn lasertrace_scene_free(scene: *mut lasertrace_scene) -> lasertrace_status {
    enter("lasertrace_scene_free", || handles::free(scene))
}

/// Writes the frame size and the number of frames of a scene to `out`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lasertrace_scene_size(
    scene: *const lasertrace_scene,
    out: *mut lasertrace_size,
) -> lasertrace_status {
    enter("lasertrace_scene_size", || {
        let scene = handles::find(scene)?;
        // SAFETY: guaranteed by the caller.
        unsafe { set("out", out, size(&scene)) }
    })
}

fn size(scene: &Scene) -> lasertrace_size {
    let [columns, rows] = scene.camera.sensor.resolution.to_array();
    lasertrace_size {
        columns,
        rows,
        frames: scene.scan.frames,
    }
}

/// Creates a simulation: plans the scene and builds the data common to all frames. `threads` is at
/// most 1024; 0 selects one per core. Returns LASERTRACE_STATUS_RESOURCES if memory is
/// insufficient.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lasertrace_simulation_new(
    scene: *const lasertrace_scene,
    threads: u32,
    out: *mut *mut lasertrace_simulation,
) -> lasertrace_status {
    enter("lasertrace_simulation_new", || {
        // SAFETY: guaranteed by the caller.
        unsafe { set("out", out, std::ptr::null_mut())? };
        let scene = handles::find(scene)?;
        let pool = pool(threads)?;
        let simulation = pool.install(|| Simulation::new(&scene))?;
        let simulator = handles::give(Simulator { simulation, pool });
        // SAFETY: guaranteed by the caller.
        unsafe { set("out", out, simulator) }
    })
}

/// Frees a simulation. NULL is ignored and returns LASERTRACE_STATUS_OK.
#[unsafe(no_mangle)]
pub extern "C" fn lasertrace_simulation_free(
    simulation: *mut lasertrace_simulation,
) -> lasertrace_status {
    enter("lasertrace_simulation_free", || handles::free(simulation))
}

/// Simulates `frame_count` frames in parallel, starting with index `first_frame`, and fills the
/// buffers of `frames`. A frame depends only on its index and is byte-identical to the output of
/// `lasertrace render`.
///
/// Flags equal the flags of `lasertrace scan` with the same frames. DISCONTINUITY depends on
/// neighbouring frames. For profiles, neighbours outside the call are simulated too, so a call with
/// many frames is faster than many calls. SUSPECTED_REFLECTION by lines of sight requires all
/// frames of the scan in one call. Profile filters of the scene are not applied.
///
/// `progress` may be NULL. If it stops the simulation, the status is LASERTRACE_STATUS_STOPPED.
/// Frames that were not simulated contain counts 0, depths INFINITY and profiles with
/// LASERTRACE_PROFILE_NOTHING. The flags of the other frames do not consider neighbouring frames.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lasertrace_simulation_frames(
    simulation: *const lasertrace_simulation,
    first_frame: u32,
    frame_count: u32,
    frames: *const lasertrace_frames,
    progress: lasertrace_progress,
    user: *mut c_void,
) -> lasertrace_status {
    let callers = Environment::current();
    enter("lasertrace_simulation_frames", || {
        let simulator = handles::find(simulation)?;
        let lasertrace_size {
            columns,
            rows,
            frames: in_scan,
        } = size(&simulator.simulation.scene);
        if frame_count == 0 || u64::from(first_frame) + u64::from(frame_count) > in_scan.into() {
            return Err(Failure::argument(format!(
                "found frames {first_frame} and so on, {frame_count} of them, expected some of \
                 the scan's frames 0 to {}",
                in_scan - 1
            )));
        }
        // SAFETY: guaranteed by the caller. The struct consists of numbers and addresses, for which
        // every bit pattern is valid.
        let wanted = unsafe { one("frames", frames)? };
        let columns = columns as usize;
        let pixels = columns * rows as usize;
        // SAFETY: guaranteed by the caller.
        let work = unsafe { buffers(wanted, frame_count as usize, pixels, columns)? };
        simulator.take(first_frame, frame_count, work, |done| {
            progress.is_some_and(|report| {
                // SAFETY: guaranteed by the caller.
                callers.during(|| unsafe { report(done, frame_count, user) } != 0)
            })
        })
    })
}

/// Parts of the buffers for one frame; a part is empty if it is not requested.
struct Piece<'a> {
    image: &'a mut [u16],
    depth: &'a mut [f32],
    profile: &'a mut [lasertrace_profile_point],
}

/// Splits the buffers into parts for each frame.
///
/// # Safety
/// Pointers must point to the given number of elements.
unsafe fn buffers<'a>(
    wanted: &lasertrace_frames,
    frames: usize,
    pixels: usize,
    columns: usize,
) -> Outcome<Vec<Piece<'a>>> {
    let &lasertrace_frames {
        images,
        image_length,
        depths,
        depth_length,
        profiles,
        profile_length,
    } = wanted;
    let length = |name: &str, is_null: bool, length: usize, each: usize| {
        let expected = if is_null {
            0
        } else {
            frames.saturating_mul(each)
        };
        same_number(name, length, expected)
    };
    length("image_length", images.is_null(), image_length, pixels)?;
    length("depth_length", depths.is_null(), depth_length, pixels)?;
    length(
        "profile_length",
        profiles.is_null(),
        profile_length,
        columns,
    )?;
    if images.is_null() && depths.is_null() && profiles.is_null() {
        return Err(Failure::argument("frames: found no buffer, expected one"));
    }
    check_disjoint(&[
        ("images", addresses(images, image_length)),
        ("depths", addresses(depths, depth_length)),
        ("profiles", addresses(profiles, profile_length)),
    ])?;
    // SAFETY: guaranteed by the caller, and the buffers do not overlap.
    let (images, depths, profiles) = unsafe {
        (
            write("images", images, image_length)?,
            write("depths", depths, depth_length)?,
            write("profiles", profiles, profile_length)?,
        )
    };
    let mut images = images.chunks_mut(pixels);
    let mut depths = depths.chunks_mut(pixels);
    let mut profiles = profiles.chunks_mut(columns);
    let piece = |_| Piece {
        image: images.next().unwrap_or_default(),
        depth: depths.next().unwrap_or_default(),
        profile: profiles.next().unwrap_or_default(),
    };
    Ok((0..frames).map(piece).collect())
}

impl Simulator {
    /// Simulates frames on the threads of the simulator. The calling thread calls `stop` after each
    /// frame. On a thread of the pool, `stop` could block the work that it waits for.
    fn take(
        &self,
        first: u32,
        count: u32,
        mut pieces: Vec<Piece>,
        stop: impl Fn(u32) -> bool,
    ) -> Outcome {
        let stopped = AtomicBool::new(false);
        let stopped = &stopped;
        let (tell, told) = mpsc::channel();
        self.pool.in_place_scope(|scope| {
            scope.spawn(move |_| {
                let numbered = pieces.par_iter_mut().enumerate();
                // Frames are distributed one at a time, because a frame is a large unit of work.
                let measured = numbered.with_max_len(1).map(|(i, piece)| {
                    if stopped.load(Ordering::Relaxed) {
                        piece.blank();
                        return Vec::new();
                    }
                    let points = piece.fill(&self.simulation, first + i as u32);
                    // The receiver no longer exists after a stop.
                    let _ = tell.send(());
                    points
                });
                let points = measured.collect::<Vec<_>>().concat();
                if !stopped.load(Ordering::Relaxed) {
                    self.set_flags(first, &mut pieces, points);
                }
            });
            let mut done = 0;
            for () in told {
                done += 1;
                if !stopped.load(Ordering::Relaxed) && stop(done) {
                    stopped.store(true, Ordering::Relaxed);
                }
            }
        });
        match stopped.load(Ordering::Relaxed) {
            false => Ok(()),
            true => Err(Failure {
                status: lasertrace_status::Stopped,
                message: format!("the progress function stopped the {count} frames"),
            }),
        }
    }
}

impl Simulator {
    /// Sets the flags of all points of a call as a scan of its frames does.
    fn set_flags(&self, first: u32, pieces: &mut [Piece], mut points: Vec<CloudPoint>) {
        let frames = first..first + pieces.len() as u32;
        let measured = |frame: u32| Ok(self.simulation.profile(frame).1);
        let compared = self
            .simulation
            .compare_piece(&frames, &mut points, measured);
        compared.expect("the measurement of a frame does not fail");
        for point in points {
            let profile = &mut pieces[(point.frame - first) as usize].profile;
            profile[point.column as usize].flags = point.flags.bits().into();
        }
    }
}

impl Piece<'_> {
    /// Fills the buffers and returns the points of the profile, if it is requested.
    fn fill(&mut self, simulation: &Simulation, frame: u32) -> Vec<CloudPoint> {
        // A profile computed from geometry only has no image.
        let (image, points) = match (self.profile.is_empty(), self.image.is_empty()) {
            (true, _) => (None, Vec::new()),
            (false, true) => {
                let (peaks, points) = simulation.profile(frame);
                write_profile(self.profile, frame, &peaks, &points);
                (None, points)
            }
            (false, false) => {
                let (image, peaks, points) = simulation.take(frame);
                write_profile(self.profile, frame, &peaks, &points);
                (image, points)
            }
        };
        if !self.image.is_empty() {
            let image = image.unwrap_or_else(|| simulation.image(frame));
            self.image.copy_from_slice(&image.to_rows());
        }
        if !self.depth.is_empty() {
            self.depth.copy_from_slice(&simulation.truth(frame).depth);
        }
        points
    }

    fn blank(&mut self) {
        self.image.fill(0);
        self.depth.fill(f32::INFINITY);
        self.profile.fill(lasertrace_profile_point::default());
    }
}

/// Writes one element per column. A column has at most one line, and a line at most one point.
fn write_profile(
    profile: &mut [lasertrace_profile_point],
    frame: u32,
    peaks: &[Peak],
    points: &[CloudPoint],
) {
    for (column, out) in profile.iter_mut().enumerate() {
        *out = lasertrace_profile_point {
            frame,
            column: column as u32,
            found: LASERTRACE_PROFILE_NOTHING,
            ..Default::default()
        };
    }
    for peak in peaks {
        let out = &mut profile[peak.column as usize];
        *out = lasertrace_profile_point {
            row: peak.row,
            intensity: peak.intensity,
            height: peak.height,
            line_sigma_px: peak.sigma,
            flags: peak.flags.bits().into(),
            found: LASERTRACE_PROFILE_LINE,
            ..*out
        };
    }
    for point in points {
        let out = &mut profile[point.column as usize];
        *out = lasertrace_profile_point {
            position: point.position.to_array(),
            u_position: point.u_position,
            deviation: point.deviation,
            u_deviation: point.u_deviation,
            repeatability: point.repeatability,
            correlation_length: point.correlation_length,
            scan_correlation_length: point.scan_correlation_length,
            flags: point.flags.bits().into(),
            found: LASERTRACE_PROFILE_POINT,
            ..*out
        };
    }
}
