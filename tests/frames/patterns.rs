//! Pixels that differ: PRNU, DSNU and dark current in frames and in the uncertainty of points.

use crate::effort::extent;
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;

/// A line of σ ≈ 4 px without speckle, so bright that its pixels' responses outweigh shot noise.
fn scene(camera: &str) -> Scene {
    speckled(camera, false)
}

fn speckled(camera: &str, speckle: bool) -> Scene {
    let text = format!(
        r#"
seed = 1
speckle = {speckle}
[part]
plane = {{ size_mm = [24, 24] }}
reflectance = 0.5
[laser]
wavelength_nm = 660
power_mw = 1
waist_radius_um = 120
waist_distance_mm = 150
position_mm = [0, 0, 150]
direction = [0, 0, -1]
line = {{ fan_deg = 5, profile = "uniform", direction = [1, 0, 0] }}
[camera]
focal_length_mm = 50
f_number = 8
focus_distance_mm = 150
resolution_px = [384, 320]
pixel_pitch_um = 5
position_mm = [0, -106.066017, 106.066017]
look_at_mm = [0, 0, 0]
column_axis = [1, 0, 0]
exposure_ms = 0.05
quantum_efficiency = 0.5
gain_dn_per_e = 0.2
bit_depth = 12
full_well_e = 20000
black_level_dn = 60
read_noise_e = 10
{camera}
[scan]
direction = [0, 1, 0]
step_mm = 0.4
frames = 4
"#
    );
    Scene::parse(&text, "".as_ref()).unwrap()
}

/// Errors of the line's rows over their predicted standard uncertainties, root mean square over seeds and columns; the truth is the
/// row without noise.
fn normalised_error_rms(scene: &Scene, seeds: u64) -> f64 {
    let mut ideal = scene.clone();
    ideal.camera.sensor.noise = None;
    let ideal = Simulation::new(&ideal).unwrap();
    let truth = ideal.peaks(&ideal.image(0)).0;
    let (mut squares, mut count) = (0.0, 0.0);
    for seed in 1..=seeds {
        let mut scene = scene.clone();
        scene.seed = seed;
        let simulation = Simulation::new(&scene).unwrap();
        let (peaks, errors) = simulation.peaks(&simulation.image(0));
        for (peak, error) in peaks.iter().zip(errors) {
            let Some(true_peak) = truth.iter().find(|t| t.column == peak.column) else {
                continue;
            };
            if peak.flags.is_empty() {
                squares += ((peak.row - true_peak.row) / error.sigma).powi(2);
                count += 1.0;
            }
        }
    }
    assert!(count > 350.0 * seeds as f64, "{count}");
    (squares / count).sqrt()
}

/// Pixels of different columns are independent, so n columns have a root mean square with a standard
/// error of 1/√(2n). The bound has five of them. The first-order prediction with errors of 5 % and a
/// line of 4 px contributes 1 %, the bias of the estimator less than 1 %.
#[test]
fn fixed_patterns_are_in_the_uncertainty() {
    let patterns = scene("prnu_percent = 5\ndsnu_e = 30\ndark_current_e_per_s = 1e6");
    let seeds = extent(4, 12);
    let bound = 0.02 + 5.0 / (2.0 * 384.0 * seeds as f64).sqrt();
    for scene in [patterns, scene("")] {
        let ratio = normalised_error_rms(&scene, seeds);
        assert!((ratio - 1.0).abs() < bound, "{ratio}");
    }
}

/// Returns the number of images per scatter.
fn images() -> u32 {
    extent(24, 64)
}

/// Returns the tolerance of [`repeated_over_stated`]. Variances of n images and 300 columns have a
/// relative standard error of √(2/(300·(n − 1))), standard deviations half of it. The tolerance has
/// five of these. Second-order terms in errors of some percent of the line width contribute 2.5 %.
fn tolerance() -> f64 {
    0.025 + 2.5 * (2.0 / (300.0 * f64::from(images() - 1))).sqrt()
}

/// Scatter of each column's row over images of the same light, over what is stated of it, root mean square over columns.
fn repeated_over_stated(scene: &Scene) -> f64 {
    let images = images();
    let simulation = Simulation::new(scene).unwrap();
    let light = simulation.irradiance(0);
    let mut by_column = vec![Vec::new(); 384];
    for image in 0..images {
        let (peaks, errors) = simulation.peaks(&simulation.counts(image, &light));
        for (peak, error) in peaks
            .iter()
            .zip(errors)
            .filter(|(peak, _)| peak.flags.is_empty())
        {
            by_column[peak.column as usize].push((peak.row, error.noise));
        }
    }
    let (mut found, mut stated, mut columns) = (0.0, 0.0, 0);
    let n = f64::from(images);
    for rows in by_column
        .iter()
        .filter(|rows| rows.len() == images as usize)
    {
        let mean = rows.iter().map(|(row, _)| row).sum::<f64>() / n;
        found += rows
            .iter()
            .map(|(row, _)| (row - mean).powi(2))
            .sum::<f64>()
            / (n - 1.0);
        stated += rows.iter().map(|(_, noise)| noise * noise).sum::<f64>() / n;
        columns += 1;
    }
    assert!(columns > 300, "{columns}");
    f64::sqrt(found / stated)
}

/// DSNU is constant where nothing moves. Speckle darkens the middle of some lines.
#[test]
fn repeatability_is_what_another_image_draws_anew() {
    for (camera, speckle) in [
        ("", false),
        ("dsnu_e = 30", false),
        ("", true),
        ("dsnu_e = 30", true),
    ] {
        let ratio = repeated_over_stated(&speckled(camera, speckle));
        println!("{camera} speckle = {speckle}: {ratio:.4}");
        assert!(
            (ratio - 1.0).abs() < tolerance(),
            "{camera} {speckle} {ratio}"
        );
    }
}

/// A line sixty times as bright, whose middle is full in the longest of three exposures and not in the next: what is stated is of a Gaussian
/// line, and leaves out that read noise counts r² times beside r times the shot noise, 1 % of the standard deviation here. Bounds as above.
#[test]
fn shorter_exposures_are_in_the_repeatability() {
    let mut scene = speckled("", false);
    scene.laser.beam.power_mw = 60.0;
    let single = Simulation::new(&scene).unwrap();
    let highest = *single.image(0).by_column().iter().max().unwrap();
    assert_eq!(highest, scene.camera.sensor.saturation_count());
    scene.camera.sensor.shorter = vec![4.0, 12.5];
    let merged = Simulation::new(&scene).unwrap();
    let (peaks, errors) = merged.peaks(&merged.image(0));
    let (first, last) = (peaks[150], peaks[230]);
    println!(
        "{} counts high, {} px stated",
        first.height, errors[150].noise
    );
    assert!(first.flags.is_empty() && last.flags.is_empty());
    assert!(first.height > 2.0 * 4000.0, "{}", first.height);
    let ratio = repeated_over_stated(&scene);
    println!("merged: {ratio:.4}");
    assert!((ratio - 1.0).abs() < tolerance(), "{ratio}");
}

/// Of two frames of the same place, differences are temporal and the mean keeps the pattern; of
/// another seed the pattern is another. Correlations of n = 122 880 pixels scatter by 1/√n = 0.003.
#[test]
fn patterns_are_those_of_the_seed_in_every_frame_and_for_any_threads() {
    let correlation = |a: &[u16], b: &[u16]| {
        let n = a.len() as f64;
        let mean = |of: &[u16]| of.iter().map(|&c| f64::from(c)).sum::<f64>() / n;
        let (mean_a, mean_b) = (mean(a), mean(b));
        let (mut ab, mut aa, mut bb) = (0.0, 0.0, 0.0);
        for (&x, &y) in a.iter().zip(b) {
            let (x, y) = (f64::from(x) - mean_a, f64::from(y) - mean_b);
            (ab, aa, bb) = (ab + x * y, aa + x * x, bb + y * y);
        }
        ab / (aa * bb).sqrt()
    };
    let mut dark = scene("dsnu_e = 30");
    dark.laser.beam.power_mw = 0.0;
    let frames = |scene: &Scene| {
        let simulation = Simulation::new(scene).unwrap();
        [0, 1].map(|frame| simulation.image(frame).into_by_column())
    };
    let [first, second] = frames(&dark);
    let one = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .unwrap();
    assert_eq!(
        one.install(|| frames(&dark)),
        [first.clone(), second.clone()]
    );
    // K²·DSNU² = 36 of 36 + K²·10² + 1/12 = 40.1 counts².
    let expected = 36.0 / (36.0 + 4.0 + 1.0 / 12.0);
    assert!((correlation(&first, &second) - expected).abs() < 0.015);
    dark.seed = 2;
    let [other, _] = frames(&dark);
    assert!(correlation(&first, &other).abs() < 0.015);
}
