//! Scenes, and the frames a sensor takes of them.

use crate::buffers::{Plain, addresses, apart, one, same_number, set, text, write};
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

/// A scene that was read and found right: part, sensor and path.
pub struct lasertrace_scene {
    _opaque: (),
}

impl Handle for lasertrace_scene {
    type Object = Scene;
    const NAME: &'static str = "lasertrace_scene";
}

/// A scene made ready to take frames. Owns all it needs: its scene may be freed.
pub struct lasertrace_simulation {
    _opaque: (),
}

/// What a [`lasertrace_simulation`] stands for.
pub struct Simulator {
    simulation: Simulation,
    pool: ThreadPool,
}

impl Handle for lasertrace_simulation {
    type Object = Simulator;
    const NAME: &'static str = "lasertrace_simulation";
}

/// What the buffers for frames are sized by.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct lasertrace_size {
    /// Pixels along the laser's line.
    pub columns: u32,
    /// Pixels across it.
    pub rows: u32,
    /// Frames of the scan.
    pub frames: u32,
}

/// What a column of a profile holds: nothing; a line that the sensor saw; and its point.
pub const LASERTRACE_PROFILE_NOTHING: u32 = 0;
/// Row, intensity, height, width and flags are set.
pub const LASERTRACE_PROFILE_LINE: u32 = 1;
/// And position, uncertainties and deviation.
pub const LASERTRACE_PROFILE_POINT: u32 = 2;

/// A pixel of the line is saturated.
pub const LASERTRACE_FLAG_SATURATED: u32 = 1;
/// The column holds another line.
pub const LASERTRACE_FLAG_DOUBLE: u32 = 2;
/// Wider than the frame's other lines.
pub const LASERTRACE_FLAG_WIDE: u32 = 4;
/// Much lower than the frame's other lines, or little above the noise.
pub const LASERTRACE_FLAG_WEAK: u32 = 8;
/// Cut off by the border of the sensor.
pub const LASERTRACE_FLAG_BORDER: u32 = 16;
/// At an occlusion or a jump.
pub const LASERTRACE_FLAG_EDGE: u32 = 32;
/// Its uncertainty is not known to hold.
pub const LASERTRACE_FLAG_OUTSIDE: u32 = 64;
/// Possibly a reflection.
pub const LASERTRACE_FLAG_GHOST: u32 = 128;

const _: () = {
    assert!(LASERTRACE_FLAG_SATURATED == Flags::SATURATED.bits() as u32);
    assert!(LASERTRACE_FLAG_DOUBLE == Flags::DOUBLE.bits() as u32);
    assert!(LASERTRACE_FLAG_WIDE == Flags::WIDE.bits() as u32);
    assert!(LASERTRACE_FLAG_WEAK == Flags::WEAK.bits() as u32);
    assert!(LASERTRACE_FLAG_BORDER == Flags::BORDER.bits() as u32);
    assert!(LASERTRACE_FLAG_EDGE == Flags::EDGE.bits() as u32);
    assert!(LASERTRACE_FLAG_OUTSIDE == Flags::OUTSIDE.bits() as u32);
    assert!(LASERTRACE_FLAG_GHOST == Flags::GHOST.bits() as u32);
    // The points of one frame fill no gaps.
    assert!(Flags::all().bits() == 255 | Flags::FILLED.bits());
};

/// What was measured in one column of a frame. What is not set is 0.
#[repr(C)]
#[derive(Clone, Copy, Default)]
pub struct lasertrace_profile_point {
    /// mm, in the part's frame.
    pub position: [f64; 3],
    /// Standard uncertainty of the position, mm.
    pub sigma: f64,
    /// Signed distance to the CAD, mm; positive outside the material.
    pub deviation: f64,
    /// Standard uncertainty of the deviation, mm.
    pub deviation_sigma: f64,
    /// Row of the line; pixel j covers j to j + 1.
    pub row: f64,
    /// Sum of the line's counts above background.
    pub intensity: f64,
    /// Counts above background of its highest pixel.
    pub height: f64,
    /// Standard deviation of the line across its length, px.
    pub width: f64,
    /// Number of the frame.
    pub frame: u32,
    /// Number of the column.
    pub column: u32,
    /// LASERTRACE_FLAG_... added up.
    pub flags: u32,
    /// LASERTRACE_PROFILE_...
    pub found: u32,
}

// SAFETY: numbers without gaps: ten f64 and four u32 are 96 bytes.
unsafe impl Plain for lasertrace_profile_point {}
const _: () = assert!(size_of::<lasertrace_profile_point>() == 96);

/// Where frames are written to. A buffer that is NULL, with length 0, is not wanted; one that
/// is wanted holds all frames of the call, one after the other.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct lasertrace_frames {
    /// Counts of the sensor, row by row: frames * rows * columns.
    pub images: *mut u16,
    /// Number of elements.
    pub image_length: usize,
    /// Distance along the camera's axis of what each pixel's centre sees, mm, row by row;
    /// INFINITY where that is nothing: frames * rows * columns.
    pub depths: *mut f32,
    /// Number of elements.
    pub depth_length: usize,
    /// What was measured, one element a column: frames * columns.
    pub profiles: *mut lasertrace_profile_point,
    /// Number of elements.
    pub profile_length: usize,
}

/// Called after a frame on the thread that called lasertrace_simulation_frames(), with the
/// number of frames done and asked for and the pointer that was given; anything but 0
/// stops. It must return: no longjmp and no C++ exception out of it.
pub type lasertrace_progress =
    Option<unsafe extern "C" fn(done: u32, total: u32, user: *mut c_void) -> c_int>;

/// Reads a scene from a file (TOML, see docs/manual.md) and the mesh it names.
/// LASERTRACE_STATUS_INPUT for a mistake in one; the message names file, line and key.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lasertrace_scene_load(
    path: *const c_char,
    out: *mut *mut lasertrace_scene,
) -> lasertrace_status {
    enter("lasertrace_scene_load", || {
        // SAFETY: by the caller's word.
        unsafe {
            set("out", out, std::ptr::null_mut())?;
            let path = Path::new(text("path", path)?);
            set("out", out, handles::give(Scene::load(path)?))
        }
    })
}

/// The same of a scene given as text; files it names are sought in `folder`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lasertrace_scene_parse(
    toml: *const c_char,
    folder: *const c_char,
    out: *mut *mut lasertrace_scene,
) -> lasertrace_status {
    enter("lasertrace_scene_parse", || {
        // SAFETY: by the caller's word.
        unsafe {
            set("out", out, std::ptr::null_mut())?;
            let folder = Path::new(text("folder", folder)?);
            let scene = Scene::parse(text("toml", toml)?, folder)?;
            set("out", out, handles::give(scene))
        }
    })
}

/// Frees a scene. NULL is nothing to free, and LASERTRACE_STATUS_OK.
#[unsafe(no_mangle)]
pub extern "C" fn lasertrace_scene_free(scene: *mut lasertrace_scene) -> lasertrace_status {
    enter("lasertrace_scene_free", || handles::free(scene))
}

/// How large a scene's frames are and how many its scan has.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lasertrace_scene_size(
    scene: *const lasertrace_scene,
    out: *mut lasertrace_size,
) -> lasertrace_status {
    enter("lasertrace_scene_size", || {
        let scene = handles::find(scene)?;
        // SAFETY: by the caller's word.
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

/// Plans a scene and builds all that its frames share. `threads`: 0 for one a core, at most
/// 1024. LASERTRACE_STATUS_RESOURCES for too little memory.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lasertrace_simulation_new(
    scene: *const lasertrace_scene,
    threads: u32,
    out: *mut *mut lasertrace_simulation,
) -> lasertrace_status {
    enter("lasertrace_simulation_new", || {
        // SAFETY: by the caller's word.
        unsafe { set("out", out, std::ptr::null_mut())? };
        let scene = handles::find(scene)?;
        let pool = pool(threads)?;
        let simulation = pool.install(|| Simulation::new(&scene))?;
        let simulator = handles::give(Simulator { simulation, pool });
        // SAFETY: by the caller's word.
        unsafe { set("out", out, simulator) }
    })
}

/// Frees a simulation. NULL is nothing to free, and LASERTRACE_STATUS_OK.
#[unsafe(no_mangle)]
pub extern "C" fn lasertrace_simulation_free(
    simulation: *mut lasertrace_simulation,
) -> lasertrace_status {
    enter("lasertrace_simulation_free", || handles::free(simulation))
}

/// Takes `frame_count` frames from number `first_frame` on, many at once, and writes what of
/// them is wanted. A frame depends on its number alone, and is to the byte that of
/// `lasertrace render`. Flags are those of the frame by itself; a scan takes some back that
/// its neighbours explain.
///
/// `progress` may be NULL. If it stops, the status is LASERTRACE_STATUS_STOPPED, and frames
/// that were not taken hold nothing: counts 0, depths INFINITY, profiles of
/// LASERTRACE_PROFILE_NOTHING.
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
        // SAFETY: by the caller's word; all bytes are values of its numbers and addresses.
        let wanted = unsafe { one("frames", frames)? };
        let columns = columns as usize;
        let pixels = columns * rows as usize;
        // SAFETY: by the caller's word.
        let work = unsafe { buffers(wanted, frame_count as usize, pixels, columns)? };
        simulator.take(first_frame, frame_count, work, |done| {
            progress.is_some_and(|report| {
                // SAFETY: by the caller's word.
                callers.during(|| unsafe { report(done, frame_count, user) } != 0)
            })
        })
    })
}

/// A frame's own pieces of the buffers, each empty if it is not wanted.
struct Piece<'a> {
    image: &'a mut [u16],
    depth: &'a mut [f32],
    profile: &'a mut [lasertrace_profile_point],
}

/// # Safety
/// Pointers lead to as many elements as is said.
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
    apart(&[
        ("images", addresses(images, image_length)),
        ("depths", addresses(depths, depth_length)),
        ("profiles", addresses(profiles, profile_length)),
    ])?;
    // SAFETY: by the caller's word, and they do not overlap.
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
    /// Takes frames on the simulator's threads, while this one asks after each whether to
    /// `stop`. (Called on one of those it could be in the way of what it waits for.)
    fn take(
        &self,
        first: u32,
        count: u32,
        pieces: Vec<Piece>,
        stop: impl Fn(u32) -> bool,
    ) -> Outcome {
        let stopped = AtomicBool::new(false);
        let stopped = &stopped;
        let (tell, told) = mpsc::channel();
        self.pool.in_place_scope(|scope| {
            scope.spawn(move |_| {
                let numbered = pieces.into_par_iter().enumerate();
                // One at a time is given out: a frame is work enough.
                numbered.with_max_len(1).for_each(|(i, piece)| {
                    if stopped.load(Ordering::Relaxed) {
                        piece.blank();
                    } else {
                        piece.fill(&self.simulation, first + i as u32);
                        // Nobody listens who was told to stop.
                        let _ = tell.send(());
                    }
                });
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

impl Piece<'_> {
    fn fill(self, simulation: &Simulation, frame: u32) {
        // A profile from geometry alone comes without an image.
        let image = match (self.profile.is_empty(), self.image.is_empty()) {
            (true, _) => None,
            (false, true) => {
                let (peaks, points) = simulation.profile(frame);
                write_profile(self.profile, frame, &peaks, &points);
                None
            }
            (false, false) => {
                let (image, peaks, points) = simulation.take(frame);
                write_profile(self.profile, frame, &peaks, &points);
                image
            }
        };
        if !self.image.is_empty() {
            let image = image.unwrap_or_else(|| simulation.image(frame));
            self.image.copy_from_slice(&image.to_rows());
        }
        if !self.depth.is_empty() {
            self.depth.copy_from_slice(&simulation.truth(frame).depth);
        }
    }

    fn blank(self) {
        self.image.fill(0);
        self.depth.fill(f32::INFINITY);
        self.profile.fill(lasertrace_profile_point::default());
    }
}

/// One element a column; a column has at most one line, and a line at most one point.
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
            width: peak.sigma,
            flags: peak.flags.bits().into(),
            found: LASERTRACE_PROFILE_LINE,
            ..*out
        };
    }
    for point in points {
        let out = &mut profile[point.column as usize];
        *out = lasertrace_profile_point {
            position: point.position.to_array(),
            sigma: point.sigma,
            deviation: point.deviation,
            deviation_sigma: point.deviation_sigma,
            flags: point.flags.bits().into(),
            found: LASERTRACE_PROFILE_POINT,
            ..*out
        };
    }
}
