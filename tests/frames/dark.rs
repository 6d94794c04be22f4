//! Dark pixels that nobody looks at are not drawn, and nothing is found otherwise than if each
//! had been drawn by itself.

use lasertrace::Simulation;
use lasertrace::camera::{Counts, ImageColumns};
use lasertrace::frame::Irradiance;
use lasertrace::math::rng::{Purpose, RngKey};
use lasertrace::profile::{Flags, Peak, PeakFinder, PeakSelection, PeakSettings, find_peaks};
use lasertrace::scene::Scene;
use std::collections::{BTreeMap, BTreeSet};

/// In the middle of the scan.
const FRAME: u32 = 4;

/// The plane of the scenes, so small that half of the columns are dark, under a laser of this power (mW), with
/// these lines in place of the sensor's.
fn simulation(power: f64, sensor: &str) -> Simulation {
    let text = include_str!("../../scenes/plane/scene.toml")
        .replace("size_mm = [20, 20]", "size_mm = [3, 3]")
        .replace("power_mw = 5", &format!("power_mw = {power}"))
        .replace(
            "gain_dn_per_e = 0.2\nbit_depth = 12\nfull_well_e = 20000",
            sensor,
        );
    Simulation::new(&Scene::parse(&text, "".as_ref()).unwrap()).unwrap()
}

/// Two electrons of dark current: the tail of their noise is far longer than a normal one's, so that
/// it passes for a line some twice in a frame.
const LONG_TAILED: &str = "gain_dn_per_e = 2\nbit_depth = 12\nfull_well_e = 2000\nblack_level_dn = 10\n\
                           read_noise_e = 0.3\ndark_current_e_per_s = 4e4";

/// Power (mW) of which a line has some ten times the electrons of dark current.
const FAINT: f64 = 0.03;

/// The image of which each pixel is drawn by itself, from the sensor's law and nothing else. No two frames share
/// random numbers of dark pixels.
fn pixel_by_pixel(simulation: &Simulation, light: &Irradiance, frame: u32) -> Counts {
    let scene = &simulation.scene;
    let sensor = &scene.camera.sensor;
    let per_irradiance = sensor.electrons_per_irradiance(scene.laser.beam.wavelength);
    let key = RngKey::new(scene.seed, Purpose::SensorNoise).with(u64::from(frame));
    let light = light.dense();
    let counts = light
        .iter()
        .zip(0..)
        .map(|(&e, pixel)| sensor.count(f64::from(e) * per_irradiance, key.with(pixel)));
    Counts::of_rows(&counts.collect::<Vec<_>>(), sensor.resolution.x as usize)
}

/// How often, or how much, of each kind there is in a frame whose line has these rows.
fn tally(peaks: &[Peak], rows: &BTreeMap<u32, f64>) -> BTreeMap<String, f64> {
    let mut tally = BTreeMap::new();
    let mut add = |name: String, value: f64| *tally.entry(name).or_insert(0.0) += value;
    for peak in peaks {
        let off = rows.get(&peak.column).map(|row| peak.row - row);
        match off.filter(|off| off.abs() < 8.0) {
            Some(off) => {
                add("points".into(), 1.0);
                add("off".into(), off);
                add("off, squared".into(), off * off);
                add("width".into(), peak.sigma);
                add("height".into(), peak.height);
                add("background's noise".into(), peak.noise);
                add("its square".into(), peak.noise * peak.noise);
                for (flag, _) in peak.flags.iter_names() {
                    add(format!("points with {flag}"), 1.0);
                }
            }
            None => {
                add("false lines".into(), 1.0);
                add(format!("false lines of {:.0} counts", peak.height), 1.0);
                add("width of false lines".into(), peak.sigma);
                add("row of false lines".into(), peak.row);
                for (flag, _) in peak.flags.iter_names() {
                    add(format!("false lines with {flag}"), 1.0);
                }
            }
        }
    }
    tally
}

/// Points, their flags and false lines, in number and height, against images drawn pixel by pixel, over 400 frames
/// of one light. If both have one law, the difference of a frame is as likely as its negative, whatever
/// it is; its sum is then above 5 times the root of the sum of squares with a chance of at most
/// 2·exp(−25/2) = 7.5e-6 (Hoeffding 1963): of some 60 tallies together 5e-4 at most. What is counted
/// less than 20 times can hardly differ so far, and is not held against anything.
#[test]
fn nothing_is_found_otherwise_than_in_images_drawn_pixel_by_pixel() {
    let simulation = simulation(FAINT, LONG_TAILED);
    let light = simulation.irradiance(FRAME);
    let settings = simulation.peak_settings();
    // Where the line is, by the mean of many images.
    let mut sums: BTreeMap<u32, Vec<f64>> = BTreeMap::new();
    for frame in 0..20 {
        let image = simulation.counts_near_light(1000 + frame, &light);
        for peak in find_peaks(&image, &settings) {
            sums.entry(peak.column).or_default().push(peak.row);
        }
    }
    let rows: BTreeMap<u32, f64> = sums
        .into_iter()
        .filter(|(_, rows)| rows.len() > 15)
        .map(|(column, mut rows)| {
            rows.sort_by(f64::total_cmp);
            (column, rows[rows.len() / 2])
        })
        .collect();
    assert!((200..400).contains(&rows.len()), "{} columns", rows.len());

    let mut differences: BTreeMap<String, [f64; 3]> = BTreeMap::new();
    for frame in 0..400 {
        let near = simulation.counts_near_light(frame, &light);
        let whole = pixel_by_pixel(&simulation, &light, frame);
        let [near, whole] = [&near as &dyn ImageColumns, &whole]
            .map(|image| tally(&find_peaks(image, &settings), &rows));
        let names: BTreeSet<String> = near.keys().chain(whole.keys()).cloned().collect();
        for name in names {
            let of = |tally: &BTreeMap<String, f64>| tally.get(&name).copied().unwrap_or(0.0);
            let (a, b) = (of(&near), of(&whole));
            let sums = differences.entry(name).or_default();
            sums[0] += a;
            sums[1] += b;
            sums[2] += (a - b).powi(2);
        }
    }
    let of = |name: &str| differences[name];
    assert!(of("false lines")[1] > 300.0, "{:?}", of("false lines"));
    assert!(of("points with MULTIPLE_PEAKS")[1] > 100.0);
    let heights = differences.keys().filter(|name| name.ends_with("counts"));
    let frequent = heights.filter(|name| of(name)[1] >= 20.0).count();
    assert!(frequent >= 3, "{frequent} heights");
    for (name, [near, whole, squares]) in &differences {
        let bound = 5.0 * squares.sqrt();
        println!("{name}: {near} near light, {whole} pixel by pixel, bound {bound:.1}");
        assert!(
            (near - whole).abs() <= bound,
            "{name}: {near} {whole}, bound {bound}"
        );
    }
}

fn all_settings(settings: PeakSettings) -> impl Iterator<Item = PeakSettings> {
    let choices = [
        PeakSelection::Strongest,
        PeakSelection::First,
        PeakSelection::Last,
    ];
    PeakFinder::ALL.into_iter().flat_map(move |finder| {
        choices.map(|choice| PeakSettings {
            finder,
            choice,
            ..settings
        })
    })
}

/// An image drawn near its light has the peaks of the same image with all its pixels, to the byte: for each
/// finder and choice, on sensors whose noise passes for lines, whose pixels differ, and without noise.
#[test]
fn peaks_near_light_are_those_of_the_whole_image() {
    let sensors = [
        (FAINT, LONG_TAILED),
        (
            5.0,
            "gain_dn_per_e = 0.5\nbit_depth = 8\nfull_well_e = 500\nread_noise_e = 4\nprnu_percent = 2",
        ),
        (
            5.0,
            "gain_dn_per_e = 0.5\nbit_depth = 10\nfull_well_e = 2000\nread_noise_e = 4\ndsnu_e = 3",
        ),
        (
            5.0,
            "gain_dn_per_e = 0.2\nbit_depth = 12\nfull_well_e = 20000",
        ),
    ];
    let mut false_lines = 0;
    for (power, sensor) in sensors {
        let simulation = simulation(power, sensor);
        for frame in [0, FRAME, 8] {
            let light = simulation.irradiance(frame);
            let whole = simulation.counts(frame, &light);
            for settings in all_settings(simulation.peak_settings()) {
                let near = simulation.counts_near_light(frame, &light);
                let peaks = find_peaks(&near, &settings);
                assert_eq!(
                    peaks,
                    find_peaks(&whole, &settings),
                    "{sensor} {settings:?}"
                );
                assert!(peaks.len() > 200, "{sensor}: {} lines", peaks.len());
                false_lines += peaks
                    .iter()
                    .filter(|p| p.flags.contains(Flags::MULTIPLE_PEAKS))
                    .count();
                // Columns that were drawn as a whole by then are as they would have been.
                assert_eq!(near.into_counts(), whole);
            }
            let (image, peaks, points) = simulation.take(frame);
            let image = image.unwrap();
            assert_eq!(image, whole);
            assert_eq!((peaks, points), simulation.measure(frame, &image));
        }
    }
    assert!(false_lines > 10, "{false_lines}");
}

/// What is said of the pixels of a column that are not drawn is what they are.
#[test]
fn times_of_counts_are_those_of_the_column() {
    let simulation = simulation(FAINT, LONG_TAILED);
    let light = simulation.irradiance(FRAME);
    let image = simulation.counts_near_light(FRAME, &light);
    let mut drawn_in_all = 0;
    for number in 0..image.columns() {
        let column = image.column(number);
        let mut times = BTreeMap::new();
        let (first, drawn) = column.drawn();
        drawn
            .iter()
            .for_each(|&count| *times.entry(count).or_insert(0) += 1);
        column.undrawn_histogram(&mut |count, more| *times.entry(count).or_insert(0) += more);
        let whole = column.materialise();
        let mut expected = BTreeMap::new();
        let counts = whole.between(0..whole.rows());
        counts
            .iter()
            .for_each(|&count| *expected.entry(count).or_insert(0) += 1);
        assert_eq!(times, expected, "column {number}");
        assert_eq!(&counts[first..][..drawn.len()], drawn);
        drawn_in_all += drawn.len();
    }
    // Some 30 rows of light and 32 beside it in half of 640 columns of 300.
    assert!(drawn_in_all < 640 * 300 / 4, "{drawn_in_all}");
}
