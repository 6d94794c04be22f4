//! Statistics of recorded height maps, and their comparison with a simulated scan.

use crate::control;
use crate::random::Random;
use lasertrace::inspect::HeightMap;
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use lasertrace::study::{
    Comparison, PATCH_STATISTICS, RecordedMap, Recording, SampledStatistics, compare,
    patch_statistics,
};
use std::fs;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

const SIZE: [usize; 2] = [240, 192];

fn normal(random: &mut Random) -> f64 {
    let radius = (-2.0 * random.between(1e-12, 1.0).ln()).sqrt();
    radius * random.between(0.0, std::f64::consts::TAU).cos()
}

/// Returns a plane with noise of `sigma` µm. Each height is the mean of `columns` independent values of
/// adjacent columns and `profiles` of adjacent profiles.
fn noisy_plane(seed: u64, sigma: f64, columns: usize, profiles: usize) -> HeightMap {
    let mut random = Random::new(seed);
    let [width, height] = [SIZE[0] + columns, SIZE[1] + profiles];
    let white: Vec<f64> = (0..width * height).map(|_| normal(&mut random)).collect();
    let mut heights = Vec::new();
    for y in 0..SIZE[1] {
        for x in 0..SIZE[0] {
            let parts = (0..profiles).flat_map(|j| (0..columns).map(move |i| (i, j)));
            let sum: f64 = parts.map(|(i, j)| white[(y + j) * width + x + i]).sum();
            let noise = 1e-3 * sigma * sum / ((columns * profiles) as f64).sqrt();
            heights.push(5.0 + 0.01 * x as f64 - 0.02 * y as f64 + noise);
        }
    }
    HeightMap {
        columns: SIZE[0],
        rows: SIZE[1],
        x_step: 0.1,
        y_step: 0.1,
        heights,
    }
}

/// Expected value of the correlation at a lag after removal of a parabola from each profile of 48 points,
/// from the covariance R·Σ·R of the residuals.
fn expected_along(columns: usize, lag: usize) -> f64 {
    use nalgebra::DMatrix;
    const N: usize = 48;
    let design = DMatrix::from_fn(N, 3, |i, j| (i as f64 / N as f64 - 0.5).powi(j as i32));
    let inverse = (design.transpose() * &design).try_inverse().unwrap();
    let rest = DMatrix::identity(N, N) - &design * inverse * design.transpose();
    let overlap =
        |i: usize, j: usize| columns.saturating_sub(i.abs_diff(j)) as f64 / columns as f64;
    let covariance = &rest * DMatrix::from_fn(N, N, overlap) * &rest;
    let mean =
        |lag: usize| (0..N - lag).map(|i| covariance[(i, i + lag)]).sum::<f64>() / (N - lag) as f64;
    mean(lag) / mean(0)
}

/// Scatter and correlations of planes with known noise. The flattest quarter of 63 patches of 2304 points
/// has a scatter below the mean by 1.3 standard deviations of a patch, 1.3·√(m/2/2304) of it for m
/// correlated points, and a standard error of half a standard deviation: 5 % are allowed for m ≤ 9. The
/// standard error of a correlation over 16 patches is 1/√(16·2304/m/2), of which 5 are allowed.
#[test]
fn statistics_of_noise_are_those_of_its_law() {
    for (seed, columns, profiles) in [(1, 1, 1), (2, 3, 1), (3, 1, 2), (4, 3, 3)] {
        let map = noisy_plane(seed, 20.0, columns, profiles);
        let found = patch_statistics(&map, 7).unwrap();
        let [scatter, _, one, two, across] = found.values[..] else {
            panic!("{found:?}");
        };
        assert_eq!(found.evaluated, 9 * 7);
        assert!((scatter / 20.0 - 1.0).abs() < 0.05, "{scatter}");
        let error = 5.0 / (16.0 * 2304.0 / (columns * profiles) as f64 / 2.0).sqrt();
        for (found, lag) in [(one, 1), (two, 2)] {
            let expected = expected_along(columns, lag);
            assert!(
                (found - expected).abs() < error,
                "{columns}, {lag}: {found} {expected}"
            );
        }
        let expected = (profiles - 1) as f64 / profiles as f64;
        assert!((across - expected).abs() < error, "{across} {expected}");
    }
}

/// Of 60 pairs of equal maps, differences are reported in at most the number that a probability of 5 %
/// exceeds once in a thousand times (binomial: 9). A scatter larger by a fifth, and a filter, are reported.
#[test]
fn differences_are_reported_only_between_different_maps() {
    let differs = |a: &SampledStatistics, b: &SampledStatistics| {
        let beyond = 0.01 / PATCH_STATISTICS.len() as f64;
        (0..PATCH_STATISTICS.len()).any(|i| {
            let [low, high] = a.difference(b, i, beyond);
            low > 0.0 || high < 0.0
        })
    };
    let of = |seed, sigma, columns| {
        patch_statistics(&noisy_plane(seed, sigma, columns, 1), seed).unwrap()
    };
    let equal = (0..60).filter(|&i| differs(&of(100 + i, 10.0, 2), &of(200 + i, 10.0, 2)));
    assert!(equal.count() <= 9);
    for seed in 1..4 {
        assert!(differs(&of(seed, 10.0, 2), &of(seed + 10, 12.0, 2)));
        assert!(differs(&of(seed, 10.0, 1), &of(seed + 10, 10.0, 2)));
    }
}

fn recording(folder: &Path, file: &str, keys: &str) -> PathBuf {
    let path = folder.join(format!("{file}.toml"));
    fs::write(
        &path,
        format!("file = {file:?}\nx_step_mm = 0.1\ny_step_mm = 0.2\n{keys}"),
    )
    .unwrap();
    path
}

/// Returns a PLY file of the points with a count. The steps of the grid are 0.1 and 0.2 mm, and a unit of the file
/// is 2 µm.
fn ply([columns, rows]: [usize; 2], count: impl Fn(usize, usize) -> u16) -> String {
    let points = (0..columns * rows).map(|i| (i % columns, i / columns));
    let points = points.filter(|&(x, y)| count(x, y) > 0);
    let lines = points.map(|(x, y)| format!("{} {} {}\n", 50 * x, 100 * y, count(x, y)));
    let lines: Vec<String> = lines.collect();
    let header = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nend_header\n",
        lines.len()
    );
    header + &lines.concat()
}

/// CSV, NPY of both orders, PNG, TIFF and PLY of the same counts are the same map; the value `invalid` is
/// a missing height.
#[test]
fn formats_hold_the_same_map() {
    let folder = TempDir::new().unwrap();
    let folder = folder.path();
    let (columns, rows) = (7, 5);
    let count = |x: usize, y: usize| {
        if (x, y) == (3, 2) {
            0
        } else {
            (100 + 7 * x + 300 * y) as u16
        }
    };
    let row = |y: usize| {
        (0..columns)
            .map(|x| count(x, y).to_string())
            .collect::<Vec<_>>()
            .join(",")
    };
    fs::write(
        folder.join("map.csv"),
        (0..rows).map(|y| row(y) + "\n").collect::<String>(),
    )
    .unwrap();
    let npy = |order: &str, values: Vec<u16>| {
        let mut header =
            format!("{{'descr': '<u2', 'fortran_order': {order}, 'shape': ({rows}, {columns}), }}");
        while (10 + header.len() + 1) % 64 != 0 {
            header.push(' ');
        }
        header.push('\n');
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((header.len() as u16).to_le_bytes());
        bytes.extend(header.as_bytes());
        bytes.extend(values.iter().flat_map(|v| v.to_le_bytes()));
        bytes
    };
    let by_rows = (0..rows)
        .flat_map(|y| (0..columns).map(move |x| count(x, y)))
        .collect::<Vec<_>>();
    let by_columns = (0..columns)
        .flat_map(|x| (0..rows).map(move |y| count(x, y)))
        .collect();
    fs::write(folder.join("c.npy"), npy("False", by_rows.clone())).unwrap();
    fs::write(folder.join("f.npy"), npy("True", by_columns)).unwrap();
    let image =
        image::ImageBuffer::<image::Luma<u16>, _>::from_raw(columns as u32, rows as u32, by_rows);
    let image = image.unwrap();
    image.save(folder.join("map.png")).unwrap();
    image.save(folder.join("map.tif")).unwrap();
    fs::write(folder.join("map.ply"), ply([columns, rows], count)).unwrap();
    for file in ["map.csv", "c.npy", "f.npy", "map.png", "map.tif", "map.ply"] {
        let path = recording(folder, file, "z_scale_um = 2\ninvalid = 0\n");
        let Recording::Map(RecordedMap { map, .. }) = Recording::read(&path).unwrap() else {
            panic!("{file}");
        };
        assert_eq!([map.columns, map.rows], [columns, rows], "{file}");
        for (i, &height) in map.heights.iter().enumerate() {
            match count(i % columns, i / columns) {
                0 => assert!(height.is_nan()),
                count => assert!((height - 2e-3 * f64::from(count)).abs() < 1e-12, "{file}"),
            }
        }
    }
}

/// A missing scale, an unknown key, text in a table, an image of 8 bits, an incomplete array and a map of five
/// points each give one message with the file and the found value.
#[test]
fn unusable_recordings_are_refused() {
    let folder = TempDir::new().unwrap();
    let folder = folder.path();
    fs::write(folder.join("text.csv"), "1,2\n3,x\n").unwrap();
    fs::write(folder.join("ragged.csv"), "1,2\n3\n").unwrap();
    fs::write(folder.join("empty.csv"), "").unwrap();
    fs::write(folder.join("gaps.csv"), ",\n,\n").unwrap();
    fs::write(folder.join("five.csv"), "1,2,3,4,5\n").unwrap();
    fs::write(
        folder.join("short.npy"),
        b"\x93NUMPY\x01\x00\xff\xff{'descr'",
    )
    .unwrap();
    image::GrayImage::new(8, 8)
        .save(folder.join("eight.png"))
        .unwrap();
    let scale = "z_scale_um = 1\n";
    let cases = [
        ("five.csv", "", "z_scale_um"),
        ("five.csv", "z_scale_um = 1\nscale = 2\n", "scale"),
        ("five.csv", "z_scale_um = -1\n", "-1"),
        ("text.csv", scale, "\"x\""),
        ("ragged.csv", scale, "ragged.csv:2:"),
        ("empty.csv", scale, "no rows"),
        ("gaps.csv", scale, "no valid height"),
        ("short.npy", scale, "header"),
        ("eight.png", scale, "L8"),
    ];
    for (file, keys, part) in cases {
        let error = Recording::read(&recording(folder, file, keys))
            .unwrap_err()
            .to_string();
        assert!(
            error.contains(part) && !error.contains('\n'),
            "{file}: {error}"
        );
    }
    let error = compared(folder, &recording(folder, "five.csv", scale), (1, ""))
        .unwrap_err()
        .to_string();
    assert!(error.contains("0 areas of 48 by 48 points"), "{error}");
}

const SCENE: &str = "
seed = 1
speckle = true
[part]
plane = { size_mm = [40, 60] }
reflectance = 0.5
[laser]
wavelength_nm = 660
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
auto_exposure_target = 0.12
quantum_efficiency = 0.5
gain_dn_per_e = 0.2
bit_depth = 12
full_well_e = 20000
read_noise_e = 10
[scan]
direction = [0, 1, 0]
step_mm = 0.1
frames = 144
";

fn compared(
    folder: &Path,
    recording: &Path,
    (seed, measure): (u64, &str),
) -> lasertrace::error::Result<Comparison> {
    let mut scene = Scene::parse(&format!("{SCENE}[measure]\n{measure}"), folder).unwrap();
    scene.seed = seed;
    let out = folder.join(format!("out-{seed}"));
    compare(scene, recording, out.as_path(), &control())
}

/// A scan with other seeds, written as a map, does not differ from the simulation. The map with twice the
/// distances from its mean differs in both scatters, and in nothing else. Resampled profiles are compared,
/// too.
#[test]
fn a_simulated_recording_agrees_with_its_simulation() {
    let folder = TempDir::new().unwrap();
    let folder = folder.path();
    let mut scene = Scene::parse(SCENE, folder).unwrap();
    scene.seed = 5;
    let simulation = Simulation::new(&scene).unwrap();
    let mut heights = vec![vec![f64::NAN; 192]; 144];
    for frame in 0..144 {
        for point in simulation.take(frame).2 {
            if point.is_valid() {
                heights[frame as usize][point.column as usize] = point.position.z;
            }
        }
    }
    let write = |name: &str, factor: f64| {
        let field = |z: &f64| {
            if z.is_nan() {
                String::new()
            } else {
                (z * factor).to_string()
            }
        };
        let row = |row: &Vec<f64>| row.iter().map(field).collect::<Vec<_>>().join(",") + "\n";
        fs::write(
            folder.join(name),
            heights.iter().map(row).collect::<String>(),
        )
        .unwrap();
        recording(folder, name, "z_scale_um = 1000\n")
    };
    let same = compared(folder, &write("same.csv", 1.0), (2, "")).unwrap();
    let names = |comparison: &Comparison| -> Vec<&str> {
        comparison
            .statistics
            .iter()
            .filter(|s| s.differs)
            .map(|s| s.name)
            .collect()
    };
    assert_eq!(names(&same), [""; 0], "{same:?}");
    let page = fs::read_to_string(&same.page).unwrap();
    assert!(page.contains("No difference exceeds") && !page.contains("NaN"));
    let double = compared(folder, &write("double.csv", 2.0), (3, "")).unwrap();
    let scatters = PATCH_STATISTICS[..2].iter().map(|s| s.name);
    assert_eq!(names(&double), scatters.collect::<Vec<_>>());
    // Resampled profiles have their own grid, whose points are multiples of the step.
    let same = folder.join("same.csv.toml");
    let resampled = compared(folder, &same, (4, "resample_spacing_um = 50\n")).unwrap();
    let [_, simulated] = resampled.maps.as_ref().unwrap();
    assert!((simulated.x_step_mm - 0.05).abs() < 1e-6, "{simulated:?}");
    assert!(
        simulated.columns < 192 && resampled.evaluated[1] >= 4,
        "{simulated:?}"
    );
}
