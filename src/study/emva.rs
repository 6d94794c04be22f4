//! Image sets of a sensor for the EMVA 1288 reference tool.

use super::sensor_scene::SensorScene;
use crate::camera::Sensor;
use crate::error::{Error, Result, printable};
use crate::frame::{Irradiance, Readout};
use crate::math::rng::{Purpose, RngKey};
use crate::report::picture::encode_counts;
use crate::run::output_folder::{Names, OutputFolder};
use crate::run::{RunControl, files};
use rayon::prelude::*;
use serde::Serialize;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use toml::{Table, Value};

/// Number of images per level: two for noise, more for pixel patterns. The tool treats levels with
/// more than two images as pattern measurements.
const PAIR: u64 = 2;
const STACK: u64 = 50;
/// Largest number of pixels per side. It gives every figure to about 0.1 %.
const LARGEST_SIDE: u32 = 512;
/// Level at which patterns are measured, as a fraction of saturation.
const MIDDLE: f64 = 0.5;

/// Returns the levels of the noise measurement as fractions of saturation. There are 50 uniform
/// steps up to 0.9, then smaller steps where the noise decreases at saturation.
fn levels() -> impl Iterator<Item = f64> {
    let even = (1..=50).map(|i| 0.9 * f64::from(i) / 50.0);
    even.chain((1..=30).map(|i| 0.9 + 0.005 * f64::from(i)))
}

/// Returns the number of images that [`emva`] writes.
pub fn emva_images() -> u64 {
    2 * PAIR * levels().count() as u64 + 2 * STACK
}

/// Content of `emva.json`: the true parameters of the images, in the units of EMVA 1288.
#[derive(Debug, Serialize)]
pub struct EmvaSummary {
    /// Path of the sensor file or scene.
    #[serde(serialize_with = "printable::in_json")]
    pub sensor: PathBuf,
    /// Path of the descriptor file that the tool reads.
    #[serde(serialize_with = "printable::in_json")]
    pub descriptor: PathBuf,
    /// Number of image files.
    pub images: u64,
    /// Columns and rows of each image.
    pub resolution: [u32; 2],
    /// Wavelength, nm.
    pub wavelength_nm: f64,
    /// Quantum efficiency, percent.
    pub quantum_efficiency_percent: f64,
    /// Gain, counts per electron.
    pub gain_dn_per_e: f64,
    /// Temporal noise at zero exposure, electrons.
    pub read_noise_e: f64,
    /// Saturation, electrons: the full well, or the end of the count scale if that is lower.
    pub saturation_e: f64,
    /// Dark signal non-uniformity, electrons.
    pub dsnu_e: f64,
    /// Photo response non-uniformity, percent.
    pub prnu_percent: f64,
    /// Dark current, electrons per second.
    pub dark_current_e_per_s: f64,
    /// Reasons why the tool will not recover these parameters; empty if the sensor conforms to the
    /// standard's model.
    pub warnings: Vec<String>,
}

/// Images at one light level and exposure time.
struct ImageSeries {
    exposure_ms: f64,
    lit: bool,
    images: u64,
}

/// Returns the series up to the exposure time `longest_ms`, at which the sensor saturates.
fn all_series(longest_ms: f64) -> Vec<ImageSeries> {
    let both = |exposure_ms: f64, images: u64| {
        [true, false].map(|lit| ImageSeries {
            exposure_ms,
            lit,
            images,
        })
    };
    let rising = levels().flat_map(|level| both(level * longest_ms, PAIR));
    rising.chain(both(MIDDLE * longest_ms, STACK)).collect()
}

/// Writes `images/*.png`, `EMVA1288descriptor.txt` and `emva.json`. Series at constant light have
/// ascending exposure times to beyond saturation, and each has a dark series. Patterns are measured
/// at half saturation. Returns an error for a sensor without noise, and for failed file
/// operations.
#[expect(clippy::too_many_lines, reason = "one image set after the other")]
pub fn emva<'a>(
    sensor: &Path,
    seed: Option<u64>,
    out: impl Into<OutputFolder<'a>>,
    control: &RunControl,
) -> Result<EmvaSummary> {
    let base = SensorScene::read(sensor)?;
    let size = Value::Array(vec![Value::Float(1.0); 2]);
    let plate = Table::from_iter([("size_mm".to_owned(), size)]);
    let mut scene = base.with_part("plane", Value::Table(plate))?;
    scene.seed = seed.unwrap_or(scene.seed);
    let wavelength = scene.laser.beam.wavelength;
    let camera = &mut scene.camera.sensor;
    // The standard applies to a single exposure.
    camera.shorter.clear();
    camera.resolution = camera.resolution.min(glam::UVec2::splat(LARGEST_SIDE));
    let Some(noise) = camera.noise else {
        let expected = "a sensor with noise: without it there is nothing to find";
        return Err(base.wrong("camera.read_noise_e", "", expected));
    };
    let scale = (f64::from(camera.max_count()) - camera.black_level_dn) / camera.gain_dn_per_e;
    let saturation_e = scale.min(camera.full_well_e);
    // The light is chosen to saturate the sensor at the exposure time of the file.
    let longest_ms = camera.exposure_ms;
    let light = saturation_e / camera.electrons_per_irradiance(wavelength);

    let series = all_series(longest_ms);
    let inputs = [&scene.inputs[..], &[sensor.to_owned()]].concat();
    let name = |number: usize, i: u64| format!("{number:03}-{i:02}.png");
    let images = series.iter().enumerate();
    let images =
        images.flat_map(|(number, series)| (0..series.images).map(move |i| name(number, i)));
    let names = images.map(|image| format!("images/{image}"));
    let files = ["EMVA1288descriptor.txt", "emva.json"].map(str::to_owned);
    let out = out
        .into()
        .claim(&inputs, &Names::of(names.chain(files)))?
        .path;
    let folder = out.join("images");
    files::create_own_folder(&folder)?;
    let [columns, rows] = camera.resolution.to_array();
    let mut text = format!("v 4.0\nn {} {columns} {rows}\n", camera.bit_depth);
    let done = AtomicU64::new(0);
    for (number, series) in series.iter().enumerate() {
        let mut sensor = camera.clone();
        sensor.exposure_ms = series.exposure_ms;
        let light = if series.lit { light } else { 0.0 };
        let electrons = light * sensor.electrons_per_irradiance(wavelength);
        let nanoseconds = series.exposure_ms * 1e6;
        let photons = electrons / sensor.quantum_efficiency;
        let _ = match series.lit {
            true => writeln!(text, "b {nanoseconds} {photons}"),
            false => writeln!(text, "d {nanoseconds}"),
        };
        let image = Irradiance::even(sensor.resolution, light as f32);
        let readout = Readout::new(sensor, wavelength, scene.seed);
        (0..series.images).into_par_iter().try_for_each(|i| {
            control.check()?;
            let key = RngKey::new(scene.seed, Purpose::SensorNoise)
                .with(number as u64)
                .with(i);
            let png = encode_counts(&readout.counts(&image, key), camera.max_count());
            files::write_checked_later(&folder.join(name(number, i)), &png, files::PART)?;
            (control.progress)(done.fetch_add(1, Ordering::Relaxed) + 1);
            Ok::<(), Error>(())
        })?;
        for i in 0..series.images {
            let _ = writeln!(text, "i images/{}", name(number, i));
        }
    }
    let summary = EmvaSummary {
        sensor: sensor.to_owned(),
        descriptor: out.join("EMVA1288descriptor.txt"),
        images: emva_images(),
        resolution: [columns, rows],
        wavelength_nm: wavelength * 1e6,
        quantum_efficiency_percent: 100.0 * camera.quantum_efficiency,
        gain_dn_per_e: camera.gain_dn_per_e,
        read_noise_e: noise.read_noise_e,
        saturation_e,
        dsnu_e: noise.dsnu_e,
        prnu_percent: 100.0 * noise.prnu,
        dark_current_e_per_s: noise.dark_current_e_per_s,
        warnings: warnings(camera),
    };
    // The descriptor is written last, when all images that it names exist.
    files::sync_all(out)?;
    files::write_bytes(&summary.descriptor, text.as_bytes())?;
    files::write_json(&out.join("emva.json"), &summary)?;
    Ok(summary)
}

/// Returns the properties of the sensor that the standard does not cover.
fn warnings(sensor: &Sensor) -> Vec<String> {
    let mut warnings = Vec::new();
    let dark = sensor.dark_noise_e() * sensor.gain_dn_per_e;
    let read = sensor.noise.map_or(0.0, |noise| noise.read_noise_e) * sensor.gain_dn_per_e;
    if read < 0.4 {
        warnings.push(format!(
            "Read noise is {read:.2} counts: below 0.4 rounding hides it, and the tool finds another. Raise \
             camera.gain_dn_per_e."
        ));
    }
    if sensor.black_level_dn < 4.0 * dark {
        warnings.push(format!(
            "The black level of {} counts is less than four times the noise in the dark, {dark:.2} counts: counts are cut \
             off at 0. Raise camera.black_level_dn.",
            sensor.black_level_dn
        ));
    }
    warnings
}
