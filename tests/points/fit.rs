//! Fits of a sensor to recordings: generated maps and images of known sensors, and real maps.

use crate::control;
use crate::random::Random;
use crate::real_recordings::MAPS;
use lasertrace::error::Result;
use lasertrace::math::normal_quantile;
use lasertrace::profile::Smooth;
use lasertrace::scene::Scene;
use lasertrace::study::{FitSummary, FittedValue, fit};
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// Columns and profiles of generated maps: 25 blocks of 48 by 48 points in each half.
const SIZE: [usize; 2] = [240, 480];
const STEP_MM: f64 = 0.1;

fn normal(random: &mut Random) -> f64 {
    normal_quantile(random.between(0.0, 1.0))
}

/// Sensor and surface of a generated map.
#[derive(Debug, Clone)]
struct MapSensor {
    half_width_68_um: f64,
    /// Correlation of the noise of adjacent columns before the filter.
    columns: f64,
    /// Correlation of the noise of adjacent profiles.
    profiles: f64,
    /// Weights of the output filter.
    filter: Vec<f64>,
    /// Standard deviation of a Gaussian filter, columns.
    gaussian: Option<f64>,
    /// Sq in µm and autocorrelation length in mm.
    topography: Option<[f64; 2]>,
    rounding_um: f64,
}

/// Weights of two terms with unit sum of squares and a correlation at a lag of 1.
fn moving_sum(correlation: f64) -> [f64; 2] {
    let angle = 0.5 * (2.0 * correlation).asin();
    [angle.cos(), angle.sin()]
}

/// Returns a field with a Gaussian autocorrelation that is 0.2 at a distance of `length` points: white noise,
/// convolved with a Gaussian of variance length²/(4·ln 5) along both axes.
fn gaussian_field([wide, high]: [usize; 2], sq: f64, length: f64, random: &mut Random) -> Vec<f64> {
    let variance = length * length / (4.0 * 5f64.ln());
    let reach = (6.0 * variance.sqrt()).ceil() as usize;
    let weight = |i: usize| (-0.5 * (i as f64 - reach as f64).powi(2) / variance).exp();
    let weights: Vec<f64> = (0..=2 * reach).map(weight).collect();
    let norm = weights.iter().map(|w| w * w).sum::<f64>();
    let (wider, higher) = (wide + 2 * reach, high + 2 * reach);
    let white: Vec<f64> = (0..wider * higher).map(|_| normal(random)).collect();
    let sum = |values: &[f64], first: usize, step: usize| {
        let values = weights
            .iter()
            .enumerate()
            .map(|(i, w)| w * values[first + i * step]);
        values.sum::<f64>()
    };
    let rows = (0..higher).flat_map(|y| (0..wide).map(move |x| (x, y)));
    let along: Vec<f64> = rows.map(|(x, y)| sum(&white, y * wider + x, 1)).collect();
    let points = (0..high).flat_map(|y| (0..wide).map(move |x| (x, y)));
    points
        .map(|(x, y)| sq * sum(&along, y * wide + x, wide) / norm)
        .collect()
}

impl MapSensor {
    fn drawn(random: &mut Random) -> MapSensor {
        let widths = [1, 3, 5, 0];
        let width = widths[random.choice(4)];
        let gaussian = (width == 0).then(|| random.between(1.0, 2.0));
        let filter = match gaussian {
            None => vec![1.0 / width as f64; width],
            Some(sigma) => {
                let weight = |k: i32| (-0.5 * (f64::from(k) / sigma).powi(2)).exp();
                let total: f64 = (-8..=8).map(weight).sum();
                (-8..=8).map(|k| weight(k) / total).collect()
            }
        };
        let reduction = filter.iter().map(|w| w * w).sum::<f64>().sqrt();
        let half_width_68_um = random.scale(5.0, 60.0) / reduction;
        let some = |random: &mut Random, low, high| match random.choice(2) {
            0 => 0.0,
            _ => random.between(low, high),
        };
        let sq = random.between(0.6, 1.5) * half_width_68_um * reduction;
        // The fit does not separate a correlation of columns from a Gaussian filter, and states it.
        let columns = match gaussian {
            Some(_) => 0.0,
            None => some(random, 0.15, 0.4),
        };
        MapSensor {
            half_width_68_um,
            columns,
            profiles: some(random, 0.15, 0.4),
            filter,
            gaussian,
            topography: (random.choice(2) > 0).then(|| [sq, random.between(3.0, 6.0) * STEP_MM]),
            rounding_um: random.between(0.05, 0.2) * half_width_68_um,
        }
    }

    /// Returns heights in counts of the rounding step, profile by profile.
    fn heights(&self, seed: u64) -> Vec<i64> {
        let mut random = Random::new(seed);
        let [columns, profiles] = SIZE;
        let wide = columns + self.filter.len();
        let white: Vec<f64> = (0..(wide + 1) * (profiles + 1))
            .map(|_| normal(&mut random))
            .collect();
        let [[a, b], [c, d]] = [self.columns, self.profiles].map(moving_sum);
        let heights = self.topography.map(|[sq, length]| {
            gaussian_field([wide, profiles], sq, length / STEP_MM, &mut random)
        });
        let at = |x: usize, y: usize| white[y * (wide + 1) + x];
        let raw = |x: usize, y: usize| {
            let in_columns = |y: usize| a * at(x, y) + b * at(x + 1, y);
            let noise = c * in_columns(y) + d * in_columns(y + 1);
            self.half_width_68_um * noise + heights.as_ref().map_or(0.0, |h| h[y * wide + x])
        };
        let tilt = [random.between(-20.0, 20.0), random.between(-20.0, 20.0)];
        let mut counts = Vec::new();
        for y in 0..profiles {
            let profile: Vec<f64> = (0..wide).map(|x| raw(x, y)).collect();
            for x in 0..columns {
                let filtered: f64 = self
                    .filter
                    .iter()
                    .zip(&profile[x..])
                    .map(|(w, z)| w * z)
                    .sum();
                let height = 1e4 + filtered + tilt[0] * x as f64 + tilt[1] * y as f64;
                counts.push((height / self.rounding_um).round() as i64);
            }
        }
        counts
    }

    fn recording(&self, folder: &Path, seed: u64) -> PathBuf {
        let counts = self.heights(seed);
        let rows = counts.chunks(SIZE[0]).map(|row| {
            let fields: Vec<String> = row.iter().map(i64::to_string).collect();
            fields.join(",") + "\n"
        });
        let name = format!("map-{seed}.csv");
        fs::write(folder.join(&name), rows.collect::<String>()).unwrap();
        let keys = format!(
            "z_scale_um = {}\nx_step_mm = {STEP_MM}\ny_step_mm = {STEP_MM}\n",
            self.rounding_um
        );
        recording(folder, &name, &keys)
    }

    /// Returns the true values of the terms that the sensor has.
    fn truth(&self) -> BTreeMap<&'static str, f64> {
        let mut truth =
            BTreeMap::from([("noise of a height before filters", self.half_width_68_um)]);
        let mut add = |name, value: Option<f64>| truth.extend(value.map(|value| (name, value)));
        let some = |value: f64| (value != 0.0).then_some(value);
        add("Gaussian filter, standard deviation", self.gaussian);
        add("correlation of noise between columns", some(self.columns));
        add("correlation of noise between profiles", some(self.profiles));
        add("topography, Sq", self.topography.map(|t| t[0]));
        add(
            "topography, autocorrelation length",
            self.topography.map(|t| t[1]),
        );
        truth
    }
}

fn recording(folder: &Path, file: &str, keys: &str) -> PathBuf {
    let path = folder.join(format!("{file}.toml"));
    fs::write(&path, format!("file = {file:?}\n{keys}")).unwrap();
    path
}

fn sensor(folder: &Path) -> PathBuf {
    let path = folder.join("sensor.toml");
    let text = "[laser]\nwavelength_nm = 660\n[camera]\nbit_depth = 12\nblack_level_dn = 0\n";
    fs::write(&path, text).unwrap();
    path
}

fn fitted(folder: &Path, recordings: &[PathBuf]) -> Result<FitSummary> {
    fitted_from(&sensor(folder), folder, recordings)
}

/// Fits a sensor file and writes the results to `out` in `folder`.
pub fn fitted_from(sensor: &Path, folder: &Path, recordings: &[PathBuf]) -> Result<FitSummary> {
    let out = folder.join("out");
    fit(sensor, recordings, out.as_path(), &control())
}

/// Relative standard deviation of the brightness of generated lines. Shot noise increases it by less than 1 %, and
/// its interval is wider than 10 %.
const CONTRAST: f64 = 0.1;

/// Line images of a known camera.
#[derive(Debug, Clone)]
struct LineSensor {
    black_level_dn: f64,
    gain_dn_per_e: f64,
    read_noise_e: f64,
    /// Standard deviation of the line at the first and the last column, px.
    sigma_px: [f64; 2],
    peak_dn: f64,
    second_line: bool,
}

impl LineSensor {
    fn drawn(random: &mut Random) -> LineSensor {
        LineSensor {
            black_level_dn: random.between(30.0, 120.0),
            gain_dn_per_e: random.scale(0.1, 1.0),
            read_noise_e: random.between(8.0, 30.0),
            sigma_px: [random.between(1.5, 3.0), random.between(1.5, 3.0)],
            peak_dn: random.between(1200.0, 2500.0),
            second_line: false,
        }
    }

    fn recording(&self, folder: &Path, seed: u64) -> PathBuf {
        let mut random = Random::new(seed);
        let [columns, rows] = [640u32, 64u32];
        let brightness: Vec<f64> = (0..columns)
            .map(|_| 1.0 + CONTRAST * normal(&mut random))
            .collect();
        let names: Vec<String> = (0..2).map(|i| format!("line-{seed}-{i}.png")).collect();
        for name in &names {
            let mut image = image::ImageBuffer::<image::Luma<u16>, Vec<u16>>::new(columns, rows);
            for x in 0..columns {
                let at = f64::from(x) / f64::from(columns - 1);
                let sigma = self.sigma_px[0] + (self.sigma_px[1] - self.sigma_px[0]) * at;
                let line = 30.3 + 3.0 * at;
                for y in 0..rows {
                    // The mean of the line over a pixel, by its error function.
                    let edge = |row: f64| libm::erf((row - line) / sigma / 2f64.sqrt());
                    let fraction = (edge(f64::from(y) + 1.0) - edge(f64::from(y))) / 2.0;
                    let area = self.peak_dn * sigma * std::f64::consts::TAU.sqrt();
                    let mut signal = area * fraction * brightness[x as usize];
                    if self.second_line {
                        signal += 0.6
                            * self.peak_dn
                            * (-0.5 * ((f64::from(y) - 50.0) / 1.5).powi(2)).exp();
                    }
                    let electrons = signal / self.gain_dn_per_e;
                    let noise =
                        (electrons + self.read_noise_e.powi(2)).sqrt() * normal(&mut random);
                    let count = self.black_level_dn + signal + self.gain_dn_per_e * noise;
                    image.put_pixel(x, y, image::Luma([count.round().clamp(0.0, 4095.0) as u16]));
                }
            }
            image.save(folder.join(name)).unwrap();
        }
        let path = folder.join(format!("line-{seed}.toml"));
        fs::write(&path, format!("images = {names:?}\n")).unwrap();
        path
    }

    fn truth(&self) -> BTreeMap<&'static str, f64> {
        let [first, last] = self.sigma_px;
        BTreeMap::from([
            ("black level", self.black_level_dn),
            ("gain", self.gain_dn_per_e),
            ("read noise", self.read_noise_e),
            ("standard deviation of the line, first column", first),
            (
                "standard deviation of the line, middle column",
                (first + last) / 2.0,
            ),
            ("standard deviation of the line, last column", last),
            ("speckle contrast of the line", CONTRAST),
        ])
    }
}

/// Recordings of a sphere whose profiles end at a threshold, and of a step with a blurred edge.
#[derive(Debug, Clone)]
struct PartSensor {
    noise_mm: f64,
    radius_mm: f64,
    /// Cosine of the slope at which profiles end.
    threshold: f64,
    step_mm: f64,
    edge_sigma_mm: f64,
}

impl PartSensor {
    fn drawn(random: &mut Random) -> PartSensor {
        PartSensor {
            noise_mm: random.scale(0.005, 0.03),
            radius_mm: random.between(6.0, 10.0),
            threshold: random.between(0.3, 0.6),
            step_mm: random.between(1.0, 3.0),
            edge_sigma_mm: random.between(0.15, 0.4),
        }
    }

    fn recordings(&self, folder: &Path, seed: u64) -> [PathBuf; 2] {
        let mut random = Random::new(seed);
        let size = (2.0 * self.radius_mm / STEP_MM) as usize;
        let [x, y] = [0, 1].map(|_| self.radius_mm + STEP_MM * random.between(-0.5, 0.5));
        let sphere = |[column, profile]: [f64; 2], noise: f64| {
            let [dx, dy] = [column * STEP_MM - x, profile * STEP_MM - y];
            let cosine = (1.0 - (dx * dx + dy * dy) / self.radius_mm.powi(2))
                .max(0.0)
                .sqrt();
            // The noise is along the normal, so that its effect on the distance does not depend on the slope.
            (cosine > self.threshold).then_some(self.radius_mm * cosine + noise / cosine)
        };
        let edge = random.between(5.0, 7.0);
        let step = |[column, profile]: [f64; 2], noise: f64| {
            let u = (column * STEP_MM - edge - 0.04 * profile * STEP_MM) / self.edge_sigma_mm;
            let edge = 0.5 * (1.0 + libm::erf(u / 2f64.sqrt()));
            Some(0.01 * column * STEP_MM + self.step_mm * edge + noise)
        };
        [
            self.recording(folder, ("sphere", seed), [size, size], &mut random, &sphere),
            self.recording(folder, ("step", seed), [120, 96], &mut random, &step),
        ]
    }

    fn recording(
        &self,
        folder: &Path,
        (part, seed): (&str, u64),
        [columns, profiles]: [usize; 2],
        random: &mut Random,
        height: &dyn Fn([f64; 2], f64) -> Option<f64>,
    ) -> PathBuf {
        let mut text = String::new();
        for profile in 0..profiles {
            let mut fields = Vec::new();
            for column in 0..columns {
                let noise = self.noise_mm * normal(random);
                let z = height([column as f64, profile as f64], noise);
                fields.push(z.map_or(String::new(), |z| format!("{z:.6}")));
            }
            text += &(fields.join(",") + "\n");
        }
        let name = format!("{part}-{seed}.csv");
        fs::write(folder.join(&name), text).unwrap();
        let keys = format!(
            "z_scale_um = 1000\nx_step_mm = {STEP_MM}\ny_step_mm = {STEP_MM}\npart = {part:?}\n"
        );
        recording(folder, &name, &keys)
    }

    fn truth(&self) -> BTreeMap<&'static str, f64> {
        BTreeMap::from([
            ("radius of the part", self.radius_mm),
            (
                "threshold relative to the line at normal incidence",
                self.threshold,
            ),
            ("height of the step", self.step_mm),
            (
                "lateral resolution, standard deviation of an edge",
                self.edge_sigma_mm,
            ),
        ])
    }
}

/// Intervals of fits that contain the truth, by parameter, and the numbers of misfits and of parameters
/// without a value.
#[derive(Default)]
struct Coverage {
    held: BTreeMap<&'static str, [u32; 2]>,
    unreported: BTreeMap<&'static str, u32>,
    misfits: u32,
}

impl Coverage {
    fn add(&mut self, summary: &FitSummary, truth: &BTreeMap<&'static str, f64>) {
        for (&name, &truth) in truth {
            let Some(value) = summary.values.iter().find(|value| value.name == name) else {
                *self.unreported.entry(name).or_default() += 1;
                continue;
            };
            let held = self.held.entry(name).or_default();
            held[1] += 1;
            held[0] += u32::from((value.interval[0]..=value.interval[1]).contains(&truth));
        }
        self.misfits += u32::from(!summary.misfits.is_empty());
    }

    fn pooled(&self) -> [u32; 2] {
        self.held
            .values()
            .fold([0, 0], |sum, held| [sum[0] + held[0], sum[1] + held[1]])
    }
}

fn coverage(sensors: u64) -> Coverage {
    let mut coverage = Coverage::default();
    for seed in 0..sensors {
        let folder = TempDir::new().unwrap();
        let folder = folder.path();
        let mut random = Random::new(9000 + seed);
        let (map, line) = (
            MapSensor::drawn(&mut random),
            LineSensor::drawn(&mut random),
        );
        let part = PartSensor::drawn(&mut random);
        let mut recordings = vec![map.recording(folder, seed), line.recording(folder, seed)];
        recordings.extend(part.recordings(folder, seed));
        let summary = fitted(folder, &recordings).unwrap();
        let mut truth = map.truth();
        truth.extend(line.truth());
        truth.extend(part.truth());
        let filter = summary
            .values
            .iter()
            .find(|value| value.name == "moving average");
        let filter = filter.map_or(1, |value| value.value as usize);
        println!(
            "{seed}: filter {filter} of {}; {:?}",
            map.filter.len(),
            summary.misfits
        );
        for value in &summary.values {
            let truth = truth.get(value.name);
            println!(
                "    {:<50}{:9.4} {:?} {truth:?}",
                value.name, value.value, value.interval
            );
        }
        coverage.add(&summary, &truth);
    }
    coverage
}

/// Returns the probability of at most `count` successes of `n` with a probability `p`.
fn binomial_tail(count: u32, n: u32, p: f64) -> f64 {
    let mut term = (1.0 - p).powi(n as i32);
    let mut sum = term;
    for k in 1..=count {
        term *= f64::from(n - k + 1) / f64::from(k) * p / (1.0 - p);
        sum += term;
    }
    sum
}

/// The intervals of five sensors contain the truth as often as a probability of 95 % allows (0.001), and
/// misfits are as rare as a probability of 5 % allows.
#[test]
fn intervals_contain_the_parameters_of_generated_sensors() {
    let coverage = coverage(5);
    let [held, all] = coverage.pooled();
    assert!(all >= 55, "{all}");
    assert!(binomial_tail(held, all, 0.95) > 0.001, "{held} of {all}");
    assert!(coverage.misfits <= 2, "{}", coverage.misfits);
}

/// The long form of [`intervals_contain_the_parameters_of_generated_sensors`].
#[test]
#[ignore = "ten minutes: 200 generated sensors; in tests/verify.sh"]
fn intervals_of_two_hundred_sensors_contain_their_parameters() {
    let coverage = coverage(200);
    let false_alarm = 0.001 / coverage.held.len() as f64;
    for (name, &[held, all]) in &coverage.held {
        println!("| {name} | {held} of {all} |");
        assert!(
            binomial_tail(held, all, 0.95) > false_alarm / 2.0,
            "{name}: {held} of {all}"
        );
        let missed = binomial_tail(all - held, all, 0.05);
        assert!(missed > false_alarm / 2.0, "{name}: {held} of {all}");
    }
    let [held, all] = coverage.pooled();
    println!(
        "pooled: {held} of {all} intervals contain the truth; {} misfits",
        coverage.misfits
    );
    let fraction = f64::from(held) / f64::from(all);
    assert!(
        all >= 2000 && (0.94..=0.96).contains(&fraction),
        "{fraction} of {all}"
    );
    for (name, count) in &coverage.unreported {
        println!("| {name} | no value in {count} of 200 fits |");
    }
    // Correct models are reported as misfits in at most 5 % of the cases.
    assert!(coverage.misfits <= 10, "{}", coverage.misfits);
}

/// Wrong model of a recording, and a word of the misfit.
const WRONG: [&str; 3] = ["covariance", "saturated", "second line"];

/// Returns the misfits of a recording with one wrong model.
fn misfits_of(wrong: usize, seed: u64) -> Vec<String> {
    let folder = TempDir::new().unwrap();
    let folder = folder.path();
    let mut random = Random::new(70 + seed);
    let mut map = MapSensor::drawn(&mut random);
    let line = LineSensor::drawn(&mut random);
    let recording = match wrong {
        0 => {
            // The sharpening filter of some sensors, and one with a memory of several columns.
            map.filter = match seed % 2 {
                0 => vec![-0.3, 0.1, 1.4, 0.1, -0.3],
                _ => (0..40).map(|i| 0.15 * 0.85f64.powi(i)).collect(),
            };
            map.topography = None;
            map.recording(folder, seed)
        }
        1 => LineSensor {
            peak_dn: 6000.0,
            ..line
        }
        .recording(folder, seed),
        _ => LineSensor {
            second_line: true,
            ..line
        }
        .recording(folder, seed),
    };
    let summary = fitted(folder, &[recording]).unwrap();
    let page = fs::read_to_string(&summary.page).unwrap();
    assert!(!page.contains("NaN"));
    for misfit in &summary.misfits {
        assert!(page.contains(misfit.split(':').next().unwrap()), "{misfit}");
    }
    summary.misfits
}

/// A filter that is not in the model, saturated lines and second lines are reported.
#[test]
fn wrong_models_are_misfits() {
    for (wrong, word) in WRONG.iter().enumerate() {
        for seed in 0..2 {
            let misfits = misfits_of(wrong, seed);
            assert!(
                misfits.iter().any(|m| m.contains(word)),
                "{word} {seed}: {misfits:?}"
            );
        }
    }
}

/// The long form of [`wrong_models_are_misfits`]: each wrong model is reported in 90 % of the cases or more.
#[test]
#[ignore = "minutes: 120 recordings; in tests/verify.sh"]
fn forty_recordings_of_each_wrong_model_are_misfits() {
    for (wrong, word) in WRONG.iter().enumerate() {
        let reported =
            (0..40).filter(|&seed| misfits_of(wrong, seed).iter().any(|m| m.contains(word)));
        let reported = reported.count();
        println!("{word}: reported in {reported} of 40 cases");
        assert!(reported >= 36, "{word}: {reported}");
    }
}

/// A scene whose sensor is the result of a fit.
const SCENE: &str = "
seed = 1
speckle = false
sensor = \"out/sensor.toml\"
[laser]
power_mw = 1
waist_radius_um = 120
waist_distance_mm = 150
position_mm = [0, 0, 150]
direction = [0, 0, -1]
line = { fan_deg = 10, profile = \"uniform\", direction = [1, 0, 0] }
[camera]
focal_length_mm = 25
f_number = 8
focus_distance_mm = 150
resolution_px = [192, 128]
pixel_pitch_um = 5
position_mm = [0, -75, 130]
look_at_mm = [0, 0, 0]
column_axis = [1, 0, 0]
exposure = \"auto\"
quantum_efficiency = 0.5
full_well_e = 20000
[scan]
direction = [0, 1, 0]
step_mm = 0.1
frames = 4
[part]
plane = { size_mm = [40, 60] }
[part.surface]
diffuse = { reflectance = 0.5 }
";

/// The sensor file has the fitted keys and all other keys unchanged. A scene with it and the surface keys is
/// valid.
#[test]
fn the_sensor_file_has_the_fitted_keys() {
    let folder = TempDir::new().unwrap();
    let folder = folder.path();
    let map = MapSensor {
        half_width_68_um: 30.0,
        columns: 0.0,
        profiles: 0.0,
        filter: vec![1.0 / 3.0; 3],
        gaussian: None,
        topography: Some([15.0, 0.5]),
        rounding_um: 4.5,
    };
    let line = LineSensor::drawn(&mut Random::new(5));
    let recordings = [map.recording(folder, 1), line.recording(folder, 1)];
    let summary = fitted(folder, &recordings).unwrap();
    let text = fs::read_to_string(&summary.sensor).unwrap();
    let table: toml::Table = text.parse().unwrap();
    assert_eq!(table["laser"]["wavelength_nm"].as_integer(), Some(660));
    assert_eq!(
        table["measure"]["moving_average_columns"].as_integer(),
        Some(3),
        "{text}"
    );
    let steps = table["measure"]["point_steps_um"].as_array().unwrap();
    assert!((steps[1].as_float().unwrap() - 4.5).abs() < 1e-3);
    let gain = table["camera"]["gain_dn_per_e"].as_float().unwrap();
    assert!((gain / line.gain_dn_per_e - 1.0).abs() < 0.1, "{gain}");
    assert!(
        text.contains("95 %") && text.contains("map-1.csv"),
        "{text}"
    );
    let surface = fs::read_to_string(summary.surface.as_ref().unwrap()).unwrap();
    let scene = Scene::parse(&format!("{SCENE}{surface}"), folder).unwrap();
    assert_eq!(scene.camera.sensor.gain_dn_per_e, gain);
    assert_eq!(scene.measure.filters.smooth, Some(Smooth::Mean(3)));
    assert!(scene.surface.has_topography());
    let surface: toml::Table = surface.parse().unwrap();
    let topography = &surface["part"]["surface"]["topography"];
    assert!((topography["sq_um"].as_float().unwrap() / 15.0 - 1.0).abs() < 0.2);
    assert!((topography["length_mm"].as_float().unwrap() / 0.5 - 1.0).abs() < 0.2);
}

/// Images and the ends of a sphere determine the threshold in counts: the ratio of both values. Its relative
/// uncertainty is at least that of the ratio.
#[test]
fn a_sphere_and_a_line_determine_the_threshold() {
    let folder = TempDir::new().unwrap();
    let folder = folder.path();
    let mut random = Random::new(31);
    let (part, line) = (
        PartSensor::drawn(&mut random),
        LineSensor::drawn(&mut random),
    );
    let [sphere, step] = part.recordings(folder, 3);
    let summary = fitted(folder, &[sphere, step, line.recording(folder, 3)]).unwrap();
    let of = |name: &str| {
        summary
            .values
            .iter()
            .find(|value| value.name == name)
            .unwrap()
    };
    let threshold = of("detection threshold");
    let ratio = of("threshold relative to the line at normal incidence");
    let product = ratio.value * of("height of the line").value;
    assert!((threshold.value / product - 1.0).abs() < 1e-12);
    let relative = |value: &FittedValue| (value.interval[1] - value.value) / value.value;
    assert!(relative(threshold) >= relative(ratio));
    let sensor: toml::Table = fs::read_to_string(&summary.sensor)
        .unwrap()
        .parse()
        .unwrap();
    let written = sensor["measure"]["threshold_dn"].as_float().unwrap();
    // Keys have five significant digits.
    assert!((written / product - 1.0).abs() < 1e-4, "{written}");
    assert!(summary.surface.is_none());
    let page = fs::read_to_string(&summary.page).unwrap();
    assert!(page.contains("lateral resolution") && !page.contains("NaN"));
}

/// Returns values along x with the autocorrelation exp(−(d/L)²) for a `length` L in points and unit variance: white
/// noise, convolved with a Gaussian of variance L²/4.
fn smooth_profile(count: usize, length: f64, random: &mut Random) -> Vec<f64> {
    let variance = length * length / 4.0;
    let reach = (6.0 * variance.sqrt()).ceil() as usize;
    let weight = |i: usize| (-0.5 * (i as f64 - reach as f64).powi(2) / variance).exp();
    let weights: Vec<f64> = (0..=2 * reach).map(weight).collect();
    let norm = weights.iter().map(|w| w * w).sum::<f64>().sqrt();
    let white: Vec<f64> = (0..count + 2 * reach).map(|_| normal(random)).collect();
    let sum = |first: usize| {
        weights
            .iter()
            .zip(&white[first..])
            .map(|(w, v)| w * v)
            .sum::<f64>()
    };
    (0..count).map(|x| sum(x) / norm).collect()
}

/// Planes at three heights determine the residual calibration error over x and z. The intervals are widened by a
/// factor of 2, to 4.4 standard errors of 12 segments (t distribution: a probability of 0.001), as one
/// realisation of the field is tested.
#[test]
fn planes_at_several_heights_determine_the_residual_error() {
    const DEVIATION_UM: f64 = 20.0;
    const LENGTHS_MM: [f64; 2] = [2.0, 12.0];
    let folder = TempDir::new().unwrap();
    let folder = folder.path();
    let mut random = Random::new(12);
    let heights = [100.0, 105.0, 112.0];
    let field = nalgebra::Matrix3::from_fn(|i, j| {
        let distance: f64 = (heights[i] - heights[j]) / LENGTHS_MM[1];
        (-distance * distance).exp()
    });
    let mix = field.cholesky().unwrap().l();
    let independent: Vec<Vec<f64>> = (0..3)
        .map(|_| smooth_profile(SIZE[0] * 2, LENGTHS_MM[0] / STEP_MM, &mut random))
        .collect();
    let mut recordings = Vec::new();
    for (plane, height) in heights.iter().enumerate() {
        let error = |x: usize| {
            let sum: f64 = (0..3).map(|i| mix[(plane, i)] * independent[i][x]).sum();
            1e-3 * DEVIATION_UM * sum
        };
        let profile: Vec<f64> = (0..2 * SIZE[0]).map(|x| height + error(x)).collect();
        let row = |_| {
            let values = profile.iter().map(|z| z + 0.01 * normal(&mut random));
            values
                .map(|z| format!("{z:.5}"))
                .collect::<Vec<_>>()
                .join(",")
                + "\n"
        };
        let text: String = (0..SIZE[1]).map(row).collect();
        let name = format!("plane-{plane}.csv");
        fs::write(folder.join(&name), text).unwrap();
        let keys = format!(
            "z_scale_um = 1000\nx_step_mm = {STEP_MM}\ny_step_mm = {STEP_MM}\npart = \"plane\"\n"
        );
        recordings.push(recording(folder, &name, &keys));
    }
    let summary = fitted(folder, &recordings).unwrap();
    let truth = [
        ("systematic.residual_um.standard_deviation", DEVIATION_UM),
        ("systematic.residual_um.correlation_x_mm", LENGTHS_MM[0]),
        ("systematic.residual_um.correlation_z_mm", LENGTHS_MM[1]),
    ];
    for (key, truth) in truth {
        let value = summary
            .values
            .iter()
            .find(|value| value.key == Some(key))
            .unwrap();
        println!("{key}: {} {:?} {truth}", value.value, value.interval);
        let half = value.interval[1] - value.value;
        assert!((value.value - truth).abs() < 2.0 * half, "{key}: {value:?}");
    }
    // One plane does not determine the length along z, and writes no key.
    let summary = fitted(folder, &recordings[..1]).unwrap();
    assert!(
        summary
            .values
            .iter()
            .all(|value| value.key.is_none_or(|key| !key.starts_with("systematic")))
    );
    assert!(
        summary
            .inseparable
            .iter()
            .any(|text| text.contains("Planes at several distances"))
    );
}

/// An image without a line, a map without a scale, five points, images of two sizes and a scene in place of a
/// sensor each give one sentence.
#[test]
fn unusable_data_are_refused() {
    let folder = TempDir::new().unwrap();
    let folder = folder.path();
    let dark = |name: &str, columns| {
        let image = image::ImageBuffer::from_pixel(columns, 64, image::Luma([100u16]));
        image.save(folder.join(name)).unwrap();
    };
    dark("dark.png", 256);
    dark("narrow.png", 128);
    for name in ["five", "five-region", "five-sphere", "five-step"] {
        fs::write(folder.join(format!("{name}.csv")), "1,2,3,4,5\n").unwrap();
    }
    let steps = "x_step_mm = 0.1\ny_step_mm = 0.1\n";
    let write = |name: &str, text: &str| {
        fs::write(folder.join(name), text).unwrap();
        folder.join(name)
    };
    let cases = [
        (
            write("dark.toml", "images = [\"dark.png\"]\n"),
            "a line in 0 of 256 columns",
        ),
        (
            write("sizes.toml", "images = [\"dark.png\", \"narrow.png\"]\n"),
            "128 by 64 pixels",
        ),
        (write("none.toml", "images = []\n"), "no files"),
        (
            write("other.toml", "images = [\"dark.png\"]\nz_scale_um = 1\n"),
            "z_scale_um",
        ),
        (recording(folder, "five.csv", steps), "z_scale_um"),
        (
            recording(
                folder,
                "five-region.csv",
                &format!("{steps}z_scale_um = 1\ncolumns = [3, 5]\n"),
            ),
            "found [3, 5], expected first and last index, 0 to 4",
        ),
        (
            recording(
                folder,
                "five-sphere.csv",
                &format!("{steps}z_scale_um = 1\npart = \"sphere\"\n"),
            ),
            "0 profiles with 20 or more points on the part",
        ),
        (
            recording(
                folder,
                "five-step.csv",
                &format!("{steps}z_scale_um = 1\npart = \"step\"\n"),
            ),
            "0 profiles with 20 or more points on the part",
        ),
    ];
    for (path, part) in cases {
        let error = fitted(folder, &[path]).unwrap_err().to_string();
        assert!(error.contains(part) && !error.contains('\n'), "{error}");
    }
    let five = recording(folder, "five.csv", &format!("{steps}z_scale_um = 1\n"));
    let error = fitted(folder, &[five]).unwrap_err().to_string();
    assert!(
        error.contains("a map of 5 by 1 points with 0 blocks"),
        "{error}"
    );
}

/// One fit of each real map with flat areas predicts the other half: scatter to 20 %, correlations to 0.15.
#[test]
fn real_maps_are_predicted_by_their_other_half() {
    let data = Path::new("../shared/data/laser");
    if !data.is_dir() {
        println!("NOT TESTED: ../shared/data/laser is absent");
        return;
    }
    for name in MAPS {
        let folder = TempDir::new().unwrap();
        let folder = folder.path();
        let text = fs::read_to_string(data.join(format!("sick_{name}.json"))).unwrap();
        let (recording, _) = converted(folder, &text);
        let summary = fitted(folder, &[recording]).unwrap();
        println!("{name}");
        for value in &summary.values {
            println!(
                "    {:<44}{:9.3} {:?} {}",
                value.name,
                value.value,
                value.interval,
                value.unit.symbol()
            );
        }
        for s in &summary.statistics {
            println!(
                "    {:<34} {:?} {:?} {:.3}",
                s.name, s.fitted_half, s.other_half, s.predicted
            );
        }
        println!("    {:?}", summary.misfits);
        let of = |name: &str| {
            let found = summary.statistics.iter().find(|s| s.name == name).unwrap();
            (found.predicted, found.other_half.unwrap())
        };
        let (predicted, found) = of("scatter_um");
        assert!(
            (predicted / found - 1.0).abs() < 0.2,
            "{name}: {predicted} {found}"
        );
        for correlation in [
            "correlation_of_adjacent_columns",
            "correlation_of_adjacent_profiles",
        ] {
            let (predicted, found) = of(correlation);
            assert!(
                (predicted - found).abs() < 0.15,
                "{name} {correlation}: {predicted} {found}"
            );
        }
    }
}

/// Writes the height map of a SICK file as a 16-bit PNG. Returns the path of the recording and the step of z in
/// mm.
pub fn converted(folder: &Path, text: &str) -> (PathBuf, f64) {
    use base64::Engine;
    let objects: serde_json::Value = serde_json::from_str(text).unwrap();
    let objects = match objects {
        serde_json::Value::Array(list) => list,
        object => vec![object],
    };
    let image = objects
        .iter()
        .find(|object| object["class"] == "Image")
        .unwrap();
    let (image, size) = (&image["data"]["Data"], &image["data"]["PixelSize"]);
    let bytes = image["Pixels"]["data"].as_str().unwrap();
    let bytes = base64::engine::general_purpose::STANDARD
        .decode(bytes)
        .unwrap();
    let big = image["Pixels"]["endian"] == "big";
    let counts = bytes.chunks_exact(2).map(|pair| match big {
        true => u16::from_be_bytes([pair[0], pair[1]]),
        false => u16::from_le_bytes([pair[0], pair[1]]),
    });
    let [width, height] = ["Width", "Height"].map(|key| image[key].as_u64().unwrap() as u32);
    let map = image::ImageBuffer::<image::Luma<u16>, _>::from_raw(
        width,
        height,
        counts.collect::<Vec<u16>>(),
    );
    map.unwrap().save(folder.join("map.png")).unwrap();
    let step = |axis: &str| size[axis].as_f64().unwrap();
    let keys = format!(
        "z_scale_um = {}\nx_step_mm = {}\ny_step_mm = {}\n",
        1e3 * step("z"),
        step("x"),
        step("y")
    );
    (recording(folder, "map.png", &keys), step("z"))
}
