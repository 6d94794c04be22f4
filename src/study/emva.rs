//! Image sets of a sensor for the tool of reference of EMVA 1288.

use super::sensor_scene::SensorScene;
use crate::camera::Sensor;
use crate::error::{Error, Result, printable};
use crate::frame::{Irradiance, Readout};
use crate::math::rng::{Key, Purpose};
use crate::report::picture::encode_counts;
use crate::run::output_folder::{Names, OutputFolder};
use crate::run::{Control, files};
use rayon::prelude::*;
use serde::Serialize;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use toml::{Table, Value};

/// Images of a level for noise, and for patterns: those of more than two the tool takes for patterns.
const PAIR: u64 = 2;
const STACK: u64 = 50;
/// Pixels of a side at most: enough for a thousandth of each figure.
const LARGEST_SIDE: u32 = 512;
/// Level at which patterns are measured, as a share of saturation.
const MIDDLE: f64 = 0.5;

/// Shares of saturation at which noise is measured: 50 even steps, and finer where noise breaks down.
fn levels() -> impl Iterator<Item = f64> {
    let even = (1..=50).map(|i| 0.9 * f64::from(i) / 50.0);
    even.chain((1..=30).map(|i| 0.9 + 0.005 * f64::from(i)))
}

/// Images that [`emva`] writes.
pub fn emva_images() -> u64 {
    2 * PAIR * levels().count() as u64 + 2 * STACK
}

/// `emva.json`: what was put into the images, in the units of EMVA 1288.
#[derive(Debug, Serialize)]
pub struct EmvaSummary {
    /// The sensor's file, or a scene.
    #[serde(serialize_with = "printable::in_json")]
    pub sensor: PathBuf,
    /// What the tool reads.
    #[serde(serialize_with = "printable::in_json")]
    pub descriptor: PathBuf,
    /// Files of images.
    pub images: u64,
    /// Columns and rows of each.
    pub resolution: [u32; 2],
    /// nm.
    pub wavelength_nm: f64,
    /// Percent.
    pub quantum_efficiency_percent: f64,
    /// Counts an electron.
    pub gain_dn_per_e: f64,
    /// Temporal noise without exposure, electrons.
    pub read_noise_e: f64,
    /// Electrons at which counts rise no more: the full well, or where the scale ends before.
    pub saturation_e: f64,
    /// Electrons.
    pub dsnu_e: f64,
    /// Percent.
    pub prnu_percent: f64,
    /// Electrons a second.
    pub dark_current_e_per_s: f64,
    /// What keeps the tool from finding these; empty for a sensor as the standard wants it.
    pub warnings: Vec<String>,
}

/// One level of light at one exposure, and how often it is taken.
struct Series {
    exposure_ms: f64,
    lit: bool,
    images: u64,
}

/// Up to an exposure of `longest_ms`, at which the sensor saturates.
fn all_series(longest_ms: f64) -> Vec<Series> {
    let both = |exposure_ms: f64, images: u64| {
        [true, false].map(|lit| Series {
            exposure_ms,
            lit,
            images,
        })
    };
    let rising = levels().flat_map(|level| both(level * longest_ms, PAIR));
    rising.chain(both(MIDDLE * longest_ms, STACK)).collect()
}

/// Writes `images/*.png`, `EMVA1288descriptor.txt` and `emva.json`: series at constant light over rising exposures up to beyond saturation, at
/// the exposure of the sensor's file, each with one in the dark. Errors: a sensor without noise; files.
#[expect(clippy::too_many_lines, reason = "one image set after the other")]
pub fn emva<'a>(
    sensor: &Path,
    seed: Option<u64>,
    out: impl Into<OutputFolder<'a>>,
    control: &Control,
) -> Result<EmvaSummary> {
    let base = SensorScene::read(sensor)?;
    let size = Value::Array(vec![Value::Float(1.0); 2]);
    let plate = Table::from_iter([("size_mm".to_owned(), size)]);
    let mut scene = base.with_part("plane", Value::Table(plate))?;
    scene.seed = seed.unwrap_or(scene.seed);
    let wavelength = scene.laser.beam.wavelength;
    let camera = &mut scene.camera.sensor;
    // The standard measures a single one.
    camera.shorter.clear();
    camera.resolution = camera.resolution.min(glam::UVec2::splat(LARGEST_SIDE));
    let Some(noise) = camera.noise else {
        let expected = "a sensor with noise: without it there is nothing to find";
        return Err(base.wrong("camera.read_noise_e", "", expected));
    };
    let scale = (f64::from(camera.max_count()) - camera.black_level_dn) / camera.gain_dn_per_e;
    let saturation_e = scale.min(camera.full_well_e);
    // So that the exposure of the file saturates it.
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
            let key = Key::new(scene.seed, Purpose::SensorNoise)
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
    // Last, so that it names images that are there.
    files::sync_all(out)?;
    files::write_bytes(&summary.descriptor, text.as_bytes())?;
    files::write_json(&out.join("emva.json"), &summary)?;
    Ok(summary)
}

/// What of the sensor the standard does not take.
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
