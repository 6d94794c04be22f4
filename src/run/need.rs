//! What cannot but run out of memory, by arithmetic.

use crate::error::{InputError, Place, Result};
use crate::inspect::coverage::HeadPose;
use crate::mesh::memory;
use crate::scene::Scene;

/// Bytes a pixel takes while its frame is in work: its count, and for a picture the
/// counts row by row, these as bytes, and the file, which noise makes as large.
const COUNT: u64 = 2;
const PICTURE: u64 = 3 * 2;
/// Bytes a pixel takes in `render`: the truth (36), twice while its parts are written
/// (60), light, counts and picture.
const RENDERED: u64 = 36 + 60 + 4 + COUNT + PICTURE;

/// Bytes of a frame in the report, whatever was measured in it.
pub(crate) const POSE: u64 = size_of::<HeadPose>() as u64;
/// Frames that are in work at the same time.
pub(crate) fn at_once(frames: u64) -> u64 {
    frames.min(rayon::current_num_threads() as u64)
}

/// Bytes of so many images in work.
pub(crate) fn images(scene: &Scene, count: u64) -> u64 {
    let picture = if scene.write_frames { PICTURE } else { 0 };
    count * pixels(scene) * (COUNT + picture)
}

fn pixels(scene: &Scene) -> u64 {
    let [columns, rows] = scene.camera.sensor.resolution.to_array();
    u64::from(columns) * u64::from(rows)
}

fn sensor(scene: &Scene) -> String {
    let [columns, rows] = scene.camera.sensor.resolution.to_array();
    format!("of {columns} × {rows} pixels")
}

/// Refuses what cannot but run out of memory: `count` images of the scene in work.
pub(crate) fn require_images(scene: &Scene, count: u64) -> Result<()> {
    let work = format!("{count} images {} at once", sensor(scene));
    memory::require(work, images(scene, count), memory::available())
}

/// Most pixels of a sensor whose images a study takes by the hundred.
const STUDIED_PIXELS: u64 = 1 << 26;

/// Refuses sensors of which hundreds of images take hours.
pub(crate) fn require_study(scene: &Scene) -> Result<()> {
    let found = pixels(scene);
    if found <= STUDIED_PIXELS {
        return Ok(());
    }
    let mut mistake = InputError::new(
        &scene.path,
        Place::File,
        format!("a sensor {}, {found} in all", sensor(scene)),
        format!(
            "at most {STUDIED_PIXELS} pixels, as this command takes hundreds of images: read fewer rows \
             (camera.read_rows) or bin pixels (camera.binning)"
        ),
    );
    mistake.key = Some("camera.resolution_px".to_owned());
    Err(mistake.into())
}

/// The same of a whole scan: its images, if it takes any, and the poses of its report.
pub(crate) fn require_scan(scene: &Scene, frames: u64, takes_images: bool) -> Result<()> {
    let images = match takes_images {
        true => images(scene, at_once(frames)),
        false => 0,
    };
    let work = format!(
        "a scan of {frames} frames, {} images {} at once and {POSE} bytes a frame in the report,",
        at_once(frames),
        sensor(scene)
    );
    memory::require(work, images + frames * POSE, memory::available())
}

/// The same of so many rays in a file, each of so many bytes.
#[cfg(feature = "service")]
pub(crate) fn require_rays(count: u64, bytes: u64) -> Result<()> {
    let work = format!("a file of up to {count} rays, {bytes} bytes each,");
    memory::require(work, count.saturating_mul(bytes), memory::available())
}

/// The same of a frame with its truth.
pub(crate) fn require_render(scene: &Scene) -> Result<()> {
    let work = format!(
        "a frame {} with its truth, {RENDERED} bytes a pixel,",
        sensor(scene)
    );
    memory::require(work, RENDERED * pixels(scene), memory::available())
}
