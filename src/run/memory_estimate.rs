//! Refusal of work that exceeds the available memory, by calculation.

use crate::error::{InputError, Place, Result};
use crate::inspect::coverage::SensorPose;
use crate::mesh::memory;
use crate::scene::Scene;

/// Memory per pixel while its frame is in progress, bytes: its count. `PICTURE` adds the counts row
/// by row, their bytes, and the file, which noise makes as large.
const COUNT: u64 = 2;
const PICTURE: u64 = 3 * 2;
/// Memory per pixel of indirect light, bytes: sum and result; two values at each receiver of the lit
/// curve, its image and edges; the list of single pixels with their light.
const INDIRECT: u64 = 8 + 4 + 2 * 4 + 4 + 1 + 8 + 40;
/// Additional memory per pixel for partial coherence, bytes: statistics of path lengths and their
/// contrast, and eight lengths at each receiver and in each pixel.
const PATH_LENGTHS: u64 = 16 + 4 + 2 * 8 * 4;
/// Memory per pixel in `render`, bytes: the truth (36), two copies while its parts are written
/// (60), light, counts and image.
const RENDERED: u64 = 36 + 60 + 4 + COUNT + PICTURE;

/// Memory per frame in the report, bytes, without its points.
pub(crate) const POSE: u64 = size_of::<SensorPose>() as u64;
/// Returns the number of frames that are in progress concurrently.
pub(crate) fn at_once(frames: u64) -> u64 {
    frames.min(rayon::current_num_threads() as u64)
}

/// Returns the memory of `count` images in progress, bytes.
pub(crate) fn images(scene: &Scene, count: u64) -> u64 {
    let picture = if scene.save_images { PICTURE } else { 0 };
    count * pixels(scene) * (COUNT + picture + indirect(scene))
}

/// Returns the memory per pixel of indirect light, bytes; 0 if the scene has none.
fn indirect(scene: &Scene) -> u64 {
    match (scene.considers_indirect_light(), scene.coherence_length_mm) {
        (false, _) => 0,
        (true, None) => INDIRECT,
        (true, Some(_)) => INDIRECT + PATH_LENGTHS,
    }
}

fn pixels(scene: &Scene) -> u64 {
    let [columns, rows] = scene.camera.sensor.resolution.to_array();
    u64::from(columns) * u64::from(rows)
}

fn sensor(scene: &Scene) -> String {
    let [columns, rows] = scene.camera.sensor.resolution.to_array();
    format!("of {columns} × {rows} pixels")
}

/// Refuses `count` concurrent images of the scene that exceed the available memory.
pub(crate) fn require_images(scene: &Scene, count: u64) -> Result<()> {
    let work = format!("{count} images {} at once", sensor(scene));
    memory::require(work, images(scene, count), memory::available())
}

/// Maximum number of pixels of a sensor for studies with hundreds of images.
const STUDIED_PIXELS: u64 = 1 << 26;

/// Refuses sensors for which hundreds of images take hours.
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
             (camera.roi_rows) or bin pixels (camera.binning)"
        ),
    );
    mistake.key = Some("camera.resolution_px".to_owned());
    Err(mistake.into())
}

/// Refuses a scan that exceeds the available memory with its images, if any, and the poses of its
/// report.
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

/// Refuses a file of `count` rays with `bytes` bytes each that exceeds the available memory.
#[cfg(feature = "service")]
pub(crate) fn require_rays(count: u64, bytes: u64) -> Result<()> {
    let work = format!("a file of up to {count} rays, {bytes} bytes each,");
    memory::require(work, count.saturating_mul(bytes), memory::available())
}

/// Refuses a frame with its truth that exceeds the available memory.
pub(crate) fn require_render(scene: &Scene) -> Result<()> {
    let bytes = RENDERED + indirect(scene);
    let work = format!(
        "a frame {} with its truth, {bytes} bytes a pixel,",
        sensor(scene)
    );
    memory::require(work, bytes * pixels(scene), memory::available())
}
