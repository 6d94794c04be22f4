//! What is done to profiles before they are delivered, and sensors measured as data sheets measure them, through the program.

#![cfg(unix)]

use crate::effort::extent;
use crate::program::{folder_with, run};
use std::fs;
use std::path::Path;

/// A line of σ ≈ 4 px on grains of 1.6 px on a tilted plane, with shot and read noise.
fn scene(measure: &str) -> String {
    format!(
        "seed = 1\nspeckle = true\n[part]\nplane = {{ size_mm = [24, 24] }}\nrotation_deg = [8, 5, 0]\nreflectance = 0.5\n\
         [laser]\nwavelength_nm = 660\npower_mw = 1\nwaist_radius_um = 120\nwaist_distance_mm = 150\n\
         position_mm = [0, 0, 150]\ndirection = [0, 0, -1]\n\
         line = {{ fan_deg = 5, profile = \"uniform\", direction = [1, 0, 0] }}\n\
         [camera]\nfocal_length_mm = 50\nf_number = 8\nfocus_distance_mm = 150\nresolution_px = [384, 320]\n\
         pixel_pitch_um = 5\nposition_mm = [0, -106.066017, 106.066017]\nlook_at_mm = [0, 0, 0]\ncolumn_axis = [1, 0, 0]\n\
         exposure_ms = 0.05\nquantum_efficiency = 0.5\ngain_dn_per_e = 0.2\nbit_depth = 12\nfull_well_e = 20000\n\
         black_level_dn = 20\nread_noise_e = 10\n\
         [scan]\ndirection = [0, 1, 0]\nstart_mm = [0, -9, 0]\nstep_mm = 0.5\nframes = 36\n[measure]\n{measure}"
    )
}

/// A row of `profiles.npy`.
struct Point {
    frame: u32,
    deviation: f64,
    u_deviation: f64,
    sigma: f64,
    repeatability: f64,
    correlation_length: f64,
    flags: u16,
}

fn points(folder: &Path) -> Vec<Point> {
    let bytes = fs::read(folder.join("profiles.npy")).unwrap();
    let start = 10 + u16::from_le_bytes([bytes[8], bytes[9]]) as usize;
    let point = |row: &[u8]| {
        let float = |i: usize| f64::from_le_bytes(row[8 + 8 * i..16 + 8 * i].try_into().unwrap());
        Point {
            frame: u32::from_le_bytes(row[..4].try_into().unwrap()),
            deviation: float(6),
            sigma: float(7),
            u_deviation: float(8),
            repeatability: float(9),
            correlation_length: float(10),
            flags: u16::from_le_bytes(row[104..106].try_into().unwrap()),
        }
    };
    bytes[start..].chunks_exact(106).map(point).collect()
}

fn scanned(measure: &str) -> Vec<Point> {
    scanned_as(&scene(measure))
}

fn scanned_as(scene: &str) -> Vec<Point> {
    let folder = folder_with(scene);
    let (code, _, stderr) = run(folder.path(), &["scan", "scene.toml", "-o", "out"]);
    assert_eq!(code, 0, "{stderr}");
    points(&folder.path().join("out"))
}

/// Of images with speckle and noise: 95 % intervals hold the plane after each filter, and after all of them. Independent points
/// are as many as the stated correlation leaves of 14 000, a quarter of them or fewer: 4·√(0.95·0.05/n). What is stated is good to 3 %
/// (`tests/points/uncertainty.rs`), of a median to 5 % more: 0.23 of that of the intervals.
#[test]
fn filtered_clouds_hold_the_truth() {
    let plain = scanned("");
    let pitch = 12.0 / 384.0;
    let rows = [
        ("", 0.03),
        ("moving_average_columns = 7\n", 0.03),
        ("gaussian_filter_columns = 2\n", 0.03),
        ("median_filter_columns = 7\n", 0.08),
        ("resample_spacing_um = 100\n", 0.03),
        ("average_frames = 4\n", 0.03),
        (
            "outlier_threshold_um = 400\naverage_frames = 3\nmax_gap_mm = 1\nmoving_average_columns = 5\nresample_spacing_um = 150\n",
            0.03,
        ),
    ];
    // The short form has no filter, the median and all filters.
    for (measure, errors) in rows.into_iter().step_by(extent(3, 1)) {
        let found = scanned(measure);
        let valid: Vec<&Point> = found.iter().filter(|p| p.flags == 0).collect();
        assert!(
            valid.len() as f64 > 0.9 * found.len() as f64,
            "{measure}: {} of {}",
            valid.len(),
            found.len()
        );
        let step = if measure.contains("resample") {
            0.1
        } else {
            pitch
        };
        let held = |p: &&&Point| p.deviation.abs() <= 1.96 * p.u_deviation;
        let share = valid.iter().filter(held).count() as f64 / valid.len() as f64;
        let mean = |of: &dyn Fn(&Point) -> f64| {
            valid.iter().map(|p| of(p)).sum::<f64>() / valid.len() as f64
        };
        let length = mean(&|p| p.correlation_length);
        let independent = valid.len() as f64 / (length / step).max(1.0);
        let tolerance = 4.0 * (0.0475 / independent).sqrt() + 0.23 * errors;
        let text = format!(
            "{measure:?}: {share:.4} ± {tolerance:.4} of {}, σ {:.2} µm, noise {:.2} µm, alike over {:.1} µm",
            valid.len(),
            1e3 * mean(&|p| p.sigma),
            1e3 * mean(&|p| p.repeatability),
            1e3 * length
        );
        println!("{text}");
        assert!((share - 0.95).abs() < tolerance, "{text}");
        // Nothing makes what is stated larger.
        let before = plain.iter().map(|p| p.sigma).sum::<f64>() / plain.len() as f64;
        assert!(mean(&|p| p.sigma) < 1.01 * before, "{text}");
        assert!(found.is_sorted_by_key(|p| p.frame), "{measure}");
    }
}

/// Frames so near to each other that speckle is much the same in them: four of them in 0.4 of the beam's radius each, where the
/// closed form says 0.55 from frame to frame. Were they taken as independent, what is stated would be 1.6 times less, and hold 0.78. Of 36
/// means of 384 columns a quarter is independent.
#[test]
fn frames_with_the_same_speckle_are_not_independent() {
    let near = scene("average_frames = 4\n")
        .replace("step_mm = 0.5\nframes = 36", "step_mm = 0.05\nframes = 144")
        .replace("[0, -9, 0]", "[0, -3.6, 0]");
    let found = scanned_as(&near);
    let valid: Vec<&Point> = found.iter().filter(|p| p.flags == 0).collect();
    let held = |p: &&&Point| p.deviation.abs() <= 1.96 * p.u_deviation;
    let share = valid.iter().filter(held).count() as f64 / valid.len() as f64;
    let tolerance = 4.0 * (4.0 * 0.0475 / valid.len() as f64).sqrt() + 0.23 * 0.05;
    println!("{share:.4} ± {tolerance:.4} of {}", valid.len());
    assert!(
        (share - 0.95).abs() < tolerance,
        "{share} of {}",
        valid.len()
    );
}

/// The summary says what was done, and both scatters; a piece of the scan has whole groups of frames.
#[test]
fn what_was_done_is_said() {
    let folder = folder_with(&scene("average_frames = 4\nmoving_average_columns = 5\n"));
    let (code, stdout, stderr) = run(
        folder.path(),
        &[
            "--json",
            "scan",
            "scene.toml",
            "-o",
            "out",
            "--frames",
            "8..16",
        ],
    );
    assert_eq!(code, 0, "{stderr}");
    let summary: serde_json::Value = serde_json::from_str(&stdout).unwrap();
    assert_eq!(summary["filters"]["average_frames"], 4);
    assert_eq!(summary["filters"]["smooth"]["mean"], 5);
    let said = &summary["uncertainty"];
    let [sigma, noise, length] = [
        "median_sigma_um",
        "median_repeatability_um",
        "median_correlation_length_um",
    ]
    .map(|key| said[key].as_f64().unwrap());
    assert!(0.0 < noise && noise < sigma && length > 0.0, "{said}");
    let report = fs::read_to_string(folder.path().join("out/report.html")).unwrap();
    assert!(report.contains("mean of 4 frames, then mean of 5 columns"));
    assert!(
        report.contains("standard deviation over positions")
            && report.contains("repeatability (static)")
    );
    // The piece has the points of the whole.
    let piece = points(&folder.path().join("out"));
    let (code, _, stderr) = run(folder.path(), &["scan", "scene.toml", "-o", "whole"]);
    assert_eq!(code, 0, "{stderr}");
    let whole = points(&folder.path().join("whole"));
    let same: Vec<&Point> = whole
        .iter()
        .filter(|p| (8..16).contains(&p.frame))
        .collect();
    assert_eq!(same.len(), piece.len());
    assert!(
        same.iter()
            .zip(&piece)
            .all(|(a, b)| a.deviation == b.deviation && a.flags == b.flags)
    );
    let (code, _, stderr) = run(
        folder.path(),
        &["scan", "scene.toml", "-o", "out", "--frames", "3..16"],
    );
    assert_eq!(code, 64);
    assert!(
        stderr.contains("expected them to begin and end at multiples of 4"),
        "{stderr}"
    );
}

#[test]
fn filters_that_cannot_be_are_refused() {
    for (measure, words) in [
        (
            "moving_average_columns = 4\n",
            "measure.moving_average_columns: found 4, expected an odd number of columns from 3 to 101",
        ),
        (
            "gaussian_filter_columns = 0.1\n",
            "measure.gaussian_filter_columns: found 0.1, expected a standard deviation of 0.3 to 25 columns",
        ),
        (
            "moving_average_columns = 3\ngaussian_filter_columns = 1\n",
            "measure.gaussian_filter_columns: found 1, expected one of moving_average_columns, median_filter_columns and",
        ),
        (
            "moving_average_columns = 3\nmedian_filter_columns = 3\n",
            "measure.median_filter_columns: found 3, expected one of moving_average_columns and median_filter_columns",
        ),
        (
            "average_frames = 40\n",
            "measure.average_frames: found 40, expected from 1 to 1000, and no more than the scan's 36 frames",
        ),
        (
            "resample_spacing_um = 0.1\n",
            "measure.resample_spacing_um: found 0.1, expected a quarter of the distance of two columns or more, 2.500 µm",
        ),
        (
            "threshold_dn = 0\n",
            "measure.threshold_dn: found 0, expected a number of counts > 0 and below 4000",
        ),
        (
            "threshold_dn = 4000\n",
            "measure.threshold_dn: found 4000, expected a number of counts > 0 and below 4000",
        ),
        (
            "outlier_threshold_um = -1\n",
            "measure.outlier_threshold_um: found -1, expected a finite number > 0",
        ),
        (
            "max_gap_mm = nan\n",
            "measure.max_gap_mm: found nan, expected a finite number > 0",
        ),
    ] {
        let folder = folder_with(&scene(measure));
        let (code, _, stderr) = run(folder.path(), &["check", "scene.toml"]);
        assert_eq!(code, 65, "{stderr}");
        assert!(stderr.contains(words), "{measure}: {stderr}");
    }
}

/// The detection threshold of the scene decides which lines are found: the higher it is the fewer
/// points there are, and none lies below it.
#[test]
fn a_threshold_decides_which_lines_are_found() {
    let counts = [
        "",
        "threshold_dn = 100\n",
        "threshold_dn = 400\n",
        "threshold_dn = 3500\n",
    ];
    let counts = counts.map(|measure| scanned(measure).len());
    assert!(counts[0] > counts[1] && counts[1] > counts[2], "{counts:?}");
    assert!(counts[2] > 100 && counts[3] < 100, "{counts:?}");
}

const SENSOR: &str = "[data_sheet]\nstand_off_mm = 60\nmeasuring_range_mm = 16\nfield_near_mm = 9\nfield_far_mm = 11\n\
     points_per_profile = 384\ntriangulation_deg = 30\nwavelength_nm = 660\npower_mw = 5\nf_number = 5.6\npixel_pitch_um = 5.5\n";

/// A sensor file alone. Repeatability: 32 images of some 350 columns, 1/√(2·31·350) = 0.7 %, four of which and 4 % of the law;
/// place to place: 20 frames of as many columns, a third of them independent: 1.5 %, four of which and 5 % of the law, which has no second
/// order; means of 100 columns: 60 of them, 9 %, four of which. Heights are true to four standard uncertainties and the finder's own
/// 0.002 px.
#[test]
fn a_sensor_is_measured_over_its_range() {
    let folder = folder_with(&scene(""));
    fs::write(folder.path().join("sensor.toml"), SENSOR).unwrap();
    let (code, stdout, stderr) = run(
        folder.path(),
        &["--json", "uncertainty", "sensor.toml", "-o", "out"],
    );
    assert_eq!(code, 0, "{stderr}");
    let sheet: serde_json::Value = serde_json::from_str(&stdout).unwrap();
    let places = sheet["places"].as_array().unwrap();
    assert_eq!(places.len(), 9);
    // In columns: the resolution does not jump over the range.
    let edge = |place: &serde_json::Value| {
        place["edge_response_10_90_um"].as_f64().unwrap() / place["um_per_px"][0].as_f64().unwrap()
    };
    let edges: Vec<f64> = places.iter().map(edge).collect();
    println!("{edges:?}");
    for pair in edges.windows(2) {
        assert!((pair[1] / pair[0] - 1.0).abs() < 0.25, "{edges:?}");
    }
    for place in places {
        let ratio = |key: &str| {
            let figure = &place[key];
            figure["found_um"].as_f64().unwrap() / figure["predicted_um"].as_f64().unwrap()
        };
        let text = format!(
            "{:.1} mm: repeatability {:.3}, place to place {:.3}, of 100 columns {:.3}, of 10 profiles {:.3}, {place}",
            place["distance_mm"],
            ratio("repeatability"),
            ratio("spatial_std"),
            ratio("moving_average_100_columns"),
            ratio("mean_of_profiles")
        );
        println!("{text}");
        assert!((ratio("repeatability") - 1.0).abs() < 0.07, "{text}");
        assert!((ratio("spatial_std") - 1.0).abs() < 0.11, "{text}");
        assert!(
            (ratio("moving_average_100_columns") - 1.0).abs() < 0.42,
            "{text}"
        );
        assert!((ratio("mean_of_profiles") - 1.0).abs() < 0.2, "{text}");
        let [mean, u] = [0, 1].map(|i| place["linearity_um"][i].as_f64().unwrap());
        let z = place["um_per_px"][1].as_f64().unwrap();
        assert!(mean.abs() < 4.0 * u + 0.004 * z, "{text}");
        // A column's own light rises within one column, and what the lens adds is finer than two.
        let edge = place["edge_response_10_90_um"].as_f64().unwrap()
            / place["um_per_px"][0].as_f64().unwrap();
        assert!((0.5..2.0).contains(&edge), "{edge} {text}");
    }
    assert!(
        folder.path().join("out/sheet.svg").exists()
            && folder.path().join("out/sheet.json").exists()
    );
    let (code, _, stderr) = run(
        folder.path(),
        &["uncertainty", "sensor.toml", "--static", "-o", "out"],
    );
    assert_eq!(code, 64);
    assert!(stderr.contains("expected a scene"), "{stderr}");
}

/// The noise of a frame drawn anew 64 times: 384 columns are independent of each other, and 95 % intervals hold the mean in 95 of
/// 100 but for 4·√(0.95·0.05/24 000) = 0.6 %, and 4 % of what is stated: 1 %.
#[test]
fn the_same_place_again_scatters_as_stated() {
    let folder = folder_with(&scene(""));
    let arguments = [
        "--json",
        "uncertainty",
        "scene.toml",
        "--static",
        "--frame",
        "18",
        "-o",
        "out",
    ];
    let (code, stdout, stderr) = run(folder.path(), &arguments);
    assert_eq!(code, 0, "{stderr}");
    let found: serde_json::Value = serde_json::from_str(&stdout).unwrap();
    assert_eq!(found["fixed_speckle"], true);
    let coverage = found["coverage"].as_f64().unwrap();
    println!("{coverage} of {}", found["points"]);
    assert!((coverage - 0.95).abs() < 0.016, "{coverage}");
}
