//! Predicted uncertainties against what is true.

use crate::effort::extent;
use crate::intervals;
use crate::program;
use lasertrace::frame::Blur;
use lasertrace::inspect::cloud::CloudPoint;
use lasertrace::inspect::features::PointErrors;
use lasertrace::profile::Flags;
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;

use crate::random::Random;

/// A line of σ ≈ 4 px on grains of 1.6 px, twelve of them across the line, with shot
/// and read noise; so dim that no grain saturates.
fn scene(part: &str, [start, step]: [f64; 2], finder: &str, speckle: bool) -> Scene {
    let text = format!(
        r#"
seed = 1
speckle = {speckle}
[part]
{part}
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
black_level_dn = 20
read_noise_e = 10
[scan]
direction = [0, 1, 0]
start_mm = [0, {start}, 0]
step_mm = {step}
frames = 36
[measure]
peak_estimator = "{finder}"
"#
    );
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.toml");
    std::fs::write(&path, text).unwrap();
    Scene::load(&path).unwrap()
}

const PLANE: &str = "plane = { size_mm = [24, 24] }\nrotation_deg = [8, 5, 0]";
const SPHERE: &str =
    "sphere = { radius_mm = 10, chordal_deviation_um = 0.5 }\nposition_mm = [0, 0, -10]";

/// Points of all frames of `seeds` scans.
fn points(mut scene: Scene, seeds: u64) -> Vec<CloudPoint> {
    let mut points = Vec::new();
    for seed in 1..=seeds {
        scene.seed = seed;
        let simulation = Simulation::new(&scene).unwrap();
        let mut taken = Vec::new();
        for frame in 0..scene.scan.frames {
            let counts = simulation.image(frame);
            taken.extend(simulation.measure(frame, &counts).1);
        }
        simulation.apply_cross_frame_flags(0..scene.scan.frames, &mut taken);
        points.append(&mut taken);
    }
    points
}

/// What the errors of unflagged points are, in predicted standard uncertainties.
struct Errors {
    points: usize,
    /// Share of the points that carry no flag.
    unflagged: f64,
    coverage: f64,
    rms: f64,
}

fn errors(points: &[CloudPoint], error: impl Fn(&CloudPoint) -> f64) -> Errors {
    let kept = points.iter().filter(|p| p.flags.is_empty());
    let z: Vec<f64> = kept.map(|p| error(p) / p.u_deviation).collect();
    let n = z.len() as f64;
    Errors {
        points: z.len(),
        unflagged: n / points.len() as f64,
        coverage: z.iter().filter(|z| z.abs() <= 1.96).count() as f64 / n,
        rms: (z.iter().map(|z| z * z).sum::<f64>() / n).sqrt(),
    }
}

/// Two columns have the same grain, and the pattern of a seed, 256 grains wide, repeats up to three
/// times over the rows of its frames. A seed therefore has 2250 independent points of 13 000. The
/// bounds are three standard errors plus 0.5 % of coverage and 1.4 % of the rms, to which the law of
/// centroid noise holds: 1 % and 3 % for eight seeds. The triangles of the sphere are up to 0.5 µm
/// below it, 1/25 of the uncertainty.
#[test]
fn intervals_of_95_percent_hold_the_truth_of_plane_and_sphere() {
    let seeds = extent(3, 8);
    let independent = 2250.0 * seeds as f64;
    let bounds = [
        0.005 + 3.0 * (0.0475 / independent).sqrt(),
        0.014 + 3.0 / (2.0 * independent).sqrt(),
    ];
    let plane = points(scene(PLANE, [-9.0, 0.5], "centroid", true), seeds);
    let plane = errors(&plane, |p| p.position.z);
    let sphere = points(scene(SPHERE, [-3.5, 0.2], "centroid", true), seeds);
    let sphere = errors(&sphere, |p| p.position.length() - 10.0);
    for (name, found) in [("plane", plane), ("sphere", sphere)] {
        let Errors {
            points,
            unflagged,
            coverage,
            rms,
        } = found;
        let text = format!("{name}: {points} points, {unflagged}, {coverage}, {rms}");
        println!("{text}");
        assert!(
            points >= 12_500 * seeds as usize && unflagged > 0.95,
            "{text}"
        );
        assert!((coverage - 0.95).abs() < bounds[0], "{text}");
        assert!((rms - 1.0).abs() < bounds[1], "{text}");
    }
}

/// Limits of the domain: lines of few pixels, of few grains and of fine grain. The stated
/// uncertainty may differ from the scatter by 5 % (law of first order) and three standard errors of the
/// rms. Grains of 7 px leave 1625 independent points of the 13 824 of a seed. The coverage may be the
/// coverage of such errors, widened by three of its standard errors.
#[test]
fn intervals_hold_the_truth_up_to_the_domains_edges() {
    let seeds = extent(3, 8);
    let independent = 1625.0 * seeds as f64;
    let bound = 0.05 + 3.0 / (2.0 * independent).sqrt();
    let slack = 3.0 * (0.0475 / independent).sqrt();
    for (waist_um, f_number, exposure_ms) in [
        (20.0, 5.6, 0.01),
        (25.0, 9.0, 0.02),
        (43.0, 2.8, 0.004),
        (120.0, 36.0, 0.45),
    ] {
        let mut scene = scene(PLANE, [-9.0, 0.5], "centroid", true);
        scene.laser.beam.waist_radius = waist_um * 1e-3;
        scene.camera.lens.f_number = f_number;
        scene.camera.sensor.exposure_ms = exposure_ms;
        scene.camera.sensor.gain_dn_per_e = 0.1;
        scene.camera.sensor.full_well_e = 40_000.0;
        // The sums are of a sharp line; `tests/frames/lens.rs` has others.
        scene.methods.defocus_model = Some(Blur::None);
        let found = errors(&points(scene, seeds), |p| p.position.z);
        let text = format!(
            "{waist_um} µm at f/{f_number}: {} points, {}, {}, {}",
            found.points, found.unflagged, found.coverage, found.rms
        );
        println!("{text}");
        assert!(found.unflagged > 0.9, "{text}");
        assert!((found.rms - 1.0).abs() < bound, "{text}");
        let held = |rms: f64| libm::erf(1.96 / rms / 2f64.sqrt());
        let range = held(1.0 + bound) - slack..=held(1.0 - bound) + slack;
        assert!(range.contains(&found.coverage), "{text} for {range:?}");
    }
}

/// On a slope towards the camera the line is up to twice as wide as on a surface across
/// the beam, on one away from it half as wide; windows and predictions follow. 13 824
/// points, 2 500 of them independent, give the coverage a standard error of 0.45 %.
#[test]
fn intervals_hold_the_truth_on_slopes() {
    for tilt in [-20, 30, 50] {
        let part = format!("plane = {{ size_mm = [24, 40] }}\nrotation_deg = [{tilt}, 0, 0]");
        let scene = scene(&part, [-1.8, 0.1], "centroid", true);
        let found = errors(&points(scene, 1), |p| p.deviation);
        let text = format!("{tilt}°: {}, {}", found.coverage, found.rms);
        println!("{text}");
        assert!(found.points > 10_000, "{text}");
        assert!((0.935..=0.965).contains(&found.coverage), "{text}");
    }
}

/// Planes seen at 60, 70, 80 and 85° from their normal, and three drawn from a seed that are also
/// turned about the scan's direction: errors are as large as stated, and DISCONTINUITY is on no point but
/// where the line or the scan ends. The centroid's law is good to 5 %; 13 824 points, 2 500 of them
/// independent, give the rms a standard error of 1.4 % and the coverage one of 0.45 %, three of
/// which lie on top.
#[test]
fn intervals_hold_the_truth_at_grazing_views() {
    let mut random = Random::new(7);
    let turned = (0..3).map(|_| [random.between(-40.0, -15.0), random.between(-12.0, 12.0)]);
    let tilted = [-15.0, -25.0, -35.0, -40.0].map(|about_x| [about_x, 0.0]);
    for [x, y] in tilted.into_iter().chain(turned) {
        let part = format!("plane = {{ size_mm = [40, 80] }}\nrotation_deg = [{x}, {y}, 0]");
        let mut scene = scene(&part, [-1.8, 0.1], "centroid", true);
        scene.laser.beam.waist_radius = 0.2;
        // Seen at 85° one is behind a lens by a coarser law: LIMITS.md.
        scene.methods.defocus_model = Some(Blur::None);
        let points = points(scene, 1);
        let found = errors(&points, |p| p.deviation);
        let text = format!(
            "{x:.1}°, {y:.1}°: {} points, {}, {}",
            found.points, found.coverage, found.rms
        );
        println!("{text}");
        assert!((found.rms - 1.0).abs() < 0.09, "{text}");
        assert!((0.924..=0.975).contains(&found.coverage), "{text}");
        // Two beam radii are four frames; one more for the beam's own spread.
        let inner = |p: &&CloudPoint| (5..31).contains(&p.frame) && (1..383).contains(&p.column);
        let share = |suspected: &dyn Fn(&CloudPoint) -> bool| {
            let inner = points.iter().filter(inner);
            inner.filter(|p| suspected(p)).count() as f64 / points.len() as f64
        };
        // A point with another flag leaves the two beside it and the two of its column, in the
        // frames before and after, without a neighbour; and one in a million lies further off
        // its neighbours' line than 4.9 of its standard deviations.
        let other = share(&|p| {
            !p.flags
                .difference(Flags::DISCONTINUITY | Flags::UNCERTAINTY_NOT_VALID)
                .is_empty()
        });
        let edges = share(&|p| p.flags.contains(Flags::DISCONTINUITY));
        assert!(edges <= 5.0 * other + 1e-3, "{text}: {edges} {other}");
    }
}

/// Without speckle, shot noise, read noise and rounding are what is left: 0.02 px.
/// 13 824 independent points give the rms a standard error of 0.6 %, five of which
/// are 3 %; the finders' biases, which depend on the line's place in its pixel and
/// are counted as if they did not, and the neighbours' common width another 5 %.
/// Centroid, relative to the laser plane, of the light on a plane that is inclined by `tilt` to the
/// laser and seen by a camera at `angle`, mm along the laser plane at the point.
///
/// The plane is z = y·tan(tilt), the laser plane is y = 0, and the light of the fan from z = R falls as
/// the distance from there. The camera at (-R·sin, R·cos) looks at the origin; a pixel at the angle φ
/// from its axis sees the plane at the distance y(φ).
fn centroid_of_inclined_light(tilt: f64, angle: f64, waist: f64) -> f64 {
    let eye = [-R * angle.sin(), R * angle.cos()];
    let (along, cross) = ([angle.sin(), -angle.cos()], [angle.cos(), angle.sin()]);
    let lit = |u: f64| {
        let ray = [along[0] + u * cross[0], along[1] + u * cross[1]];
        let t = (eye[0] * tilt.tan() - eye[1]) / (ray[1] - ray[0] * tilt.tan());
        let [y, z] = [eye[0] + t * ray[0], eye[1] + t * ray[1]];
        (-2.0 * (y / waist).powi(2)).exp() * R / (R - z)
    };
    let n = 20_000;
    let reach = 6.0 * waist / R;
    let (mut sum, mut moment) = (0.0, 0.0);
    for i in 0..=2 * n {
        let u = reach * (f64::from(i) / f64::from(n) - 1.0);
        sum += lit(u);
        moment += u * lit(u);
    }
    // On the laser plane, y = 0, the ray at u is at z = -u·R/(sin + u·cos) to first order in u.
    moment / sum * R / angle.sin()
}

/// Distance of laser and camera, mm.
const R: f64 = 150.0;

/// Perspective skews the image of a wide line on an inclined plane. The centroid is corrected for
/// it. Without noise, the points deviate by less than a twentieth of the shift, which is summed here
/// from the light along a column; terms of second order in the line width are 15·(κσ)² < 5 % of
/// it, where 3κσ² is the shift and σ the width.
#[test]
fn perspective_does_not_shift_points() {
    let random = &mut Random::new(11);
    for _ in 0..4 {
        let angle = random.between(25.0, 45.0);
        let tilt = -random.between(15.0, 35.0);
        let waist = 0.6;
        let [a, t] = [angle, tilt].map(f64::to_radians);
        let text = format!(
            "seed = 1\nspeckle = false\n[part]\nplane = {{ size_mm = [60, 60] }}\nrotation_deg = [{tilt}, 0, 0]\nreflectance = 0.5\n\
             [laser]\nwavelength_nm = 660\npower_mw = 1\nwaist_radius_um = 600\nwaist_distance_mm = {R}\n\
             position_mm = [0, 0, {R}]\ndirection = [0, 0, -1]\n\
             line = {{ fan_deg = 6, profile = \"uniform\", direction = [1, 0, 0] }}\n\
             [camera]\nfocal_length_mm = 30\nf_number = 32\nfocus_distance_mm = {R}\n\
             resolution_px = [64, 512]\npixel_pitch_um = 5\nposition_mm = [0, {y}, {z}]\n\
             look_at_mm = [0, 0, 0]\ncolumn_axis = [1, 0, 0]\nexposure = \"auto\"\nauto_exposure_target = 0.8\n\
             quantum_efficiency = 0.5\ngain_dn_per_e = 1\nbit_depth = 16\nfull_well_e = 65000\n\
             [scan]\ndirection = [0, 1, 0]\nstep_mm = 0.1\nframes = 1\n[model]\ndefocus_model = \"none\"\n",
            y = -R * a.sin(),
            z = R * a.cos(),
        );
        let simulation = Simulation::new(&Scene::parse(&text, "".as_ref()).unwrap()).unwrap();
        let points = simulation.take(0).2;
        assert!(points.len() > 50, "{}", points.len());
        let mean = points.iter().map(|p| p.deviation).sum::<f64>() / points.len() as f64;
        // The deviation is perpendicular to the plane, the shift along the laser plane.
        let shift = centroid_of_inclined_light(t, a, waist) * t.cos();
        println!("{angle} {tilt}: {mean} of {shift}");
        assert!(
            mean.abs() < 0.05 * shift.abs(),
            "{angle} {tilt}: {mean} of {shift}"
        );
    }
}

#[test]
fn every_finder_errs_as_predicted_in_noise() {
    for finder in [
        "centroid",
        "log-parabola",
        "gaussian-fit",
        "derivative-zero",
    ] {
        let mut scene = scene(PLANE, [-9.0, 0.5], finder, false);
        // Behind the lens, the interval of derivative-zero is 9 % too wide: LIMITS.md.
        scene.methods.defocus_model = Some(Blur::None);
        let points = points(scene, 1);
        let found = errors(&points, |p| p.position.z);
        let text = format!(
            "{finder}: {} {} {}",
            found.points, found.coverage, found.rms
        );
        println!("{text}");
        assert!(
            found.unflagged > 0.99 && (found.rms - 1.0).abs() < 0.08,
            "{text}"
        );
    }
}

/// What the prediction is not valid for is flagged: fully developed speckle for
/// finders of a shape, and lines of less than two grains.
#[test]
fn outside_its_domain_a_prediction_is_flagged() {
    let outside = |scene: Scene| {
        let points = points(scene, 1);
        points
            .iter()
            .all(|p| p.flags.contains(Flags::UNCERTAINTY_NOT_VALID))
            && !points.is_empty()
    };
    let mut fit = scene(PLANE, [-9.0, 0.5], "gaussian-fit", true);
    fit.scan.frames = 1;
    assert!(outside(fit));
    let mut narrow = scene(PLANE, [-9.0, 0.5], "centroid", true);
    narrow.scan.frames = 1;
    narrow.camera.lens.f_number = 90.0;
    narrow.camera.sensor.exposure_ms = 3.0;
    assert!(outside(narrow));
}

/// Grains of half a pixel on a line of less than 1.5: what is stated has 15 % of the
/// variance added and may be so much too large, never too small. 1 % of the coverage is
/// three standard errors of 13 824 points, two columns to a grain.
#[test]
fn intervals_of_fine_grain_on_narrow_lines_are_wide_enough() {
    for waist in [0.02, 0.03] {
        let mut fine = scene(PLANE, [-9.0, 0.5], "centroid", true);
        fine.camera.lens.f_number = 2.8;
        fine.laser.beam.waist_radius = waist;
        fine.camera.sensor.exposure_ms = 0.002;
        let found = errors(&points(fine, 1), |p| p.position.z);
        let text = format!(
            "{}: {}, {}, {}",
            waist, found.unflagged, found.coverage, found.rms
        );
        println!("{text}");
        assert!(found.unflagged > 0.9, "{text}");
        assert!((0.94..=0.975).contains(&found.coverage), "{text}");
        assert!((0.90..=1.03).contains(&found.rms), "{text}");
    }
}

/// The command writes what it found, and its numbers are those of its columns.
#[test]
fn the_monte_carlo_command_compares_scatter_with_prediction() {
    // Wide enough for the domain: σ = 1.2 px.
    let text =
        program::scene(program::PLANE).replace("waist_radius_um = 300", "waist_radius_um = 900");
    let folder = program::folder_with(&text);
    let arguments = [
        "uncertainty",
        "scene.toml",
        "-o",
        "out",
        "--seeds",
        "6",
        "--json",
    ];
    let (code, stdout, stderr) = program::run(folder.path(), &arguments);
    assert_eq!(code, 0, "{stderr}");
    let summary: serde_json::Value = serde_json::from_str(&stdout).unwrap();
    let columns = summary["columns"].as_array().unwrap();
    assert!(columns.len() > 32, "{}", columns.len());
    let sum = |key: &str| {
        columns
            .iter()
            .map(|c| c[key].as_f64().unwrap())
            .sum::<f64>()
    };
    let coverage = summary["coverage"].as_f64().unwrap();
    assert!((sum("covered") / sum("seeds") - coverage).abs() < 1e-9);
    // 6 × 64 errors and a line a third of a pixel from its bounds: only that both
    // tell of the same noise.
    let ratio = sum("monte_carlo_px") / sum("predicted_px");
    assert!((0.7..1.3).contains(&ratio), "{ratio}");
    let svg = std::fs::read_to_string(folder.path().join("out/uncertainty.svg")).unwrap();
    assert!(svg.contains("hold the truth") && !svg.contains("NaN"));
    program::assert_error(
        folder.path(),
        &["uncertainty", "scene.toml", "-o", "out", "--frame", "3"],
        64,
        &["frame 3", "frames 0 to 2"],
    );
}

/// Scenes 0 to 39 of a seed, in which every slope up to 85° occurs with every processing: 95 % intervals of independent
/// columns hold the truth in 94 to 96 of 100, all scenes together, and in no scene does the exact
/// binomial interval exclude 95 %, at a false alarm rate of 0.001 over all scenes. The environment
/// variable `INTERVALS_SEED` selects other scenes.
#[test]
#[ignore = "minutes: `make verify` writes its table to docs/intervals.md"]
fn intervals_hold_the_truth_in_forty_scenes() {
    let seed = std::env::var("INTERVALS_SEED").map_or(43, |seed| seed.parse().unwrap());
    hold_in_scenes(seed, &(0..intervals::SCENES).collect::<Vec<_>>(), 2, 12);
}

fn hold_in_scenes(seed: u64, scenes: &[usize], seeds: u64, groups: u32) {
    println!("{}", intervals::HEAD);
    let held: Vec<intervals::Held> = scenes
        .iter()
        .map(|&i| {
            let scene = intervals::DrawnScene::new(seed, i);
            let held = scene.held(seeds, groups);
            println!("{}", intervals::row(i, &scene, &held, scenes.len()));
            held
        })
        .collect();
    let pooled = intervals::Held::pooled(&held);
    let missed = held.iter().filter(|h| !h.holds_95(scenes.len())).count();
    println!(
        "pooled: {} of {} independent intervals hold the truth, {:.4}; {missed} of {} scenes exclude 95 %",
        pooled.held,
        pooled.independent,
        pooled.share(),
        scenes.len()
    );
    assert!(
        held.iter().all(|h| h.independent > 0),
        "a scene without points"
    );
    assert_eq!(missed, 0, "scenes exclude 95 %");
    assert!(pooled.independent < 5000 || (0.94..=0.96).contains(&pooled.share()));
}

/// Six of such scenes of another seed, of every slope and processing.
#[test]
fn intervals_hold_the_truth_in_drawn_scenes() {
    hold_in_scenes(44, &[0, 5, 10, 13, 17, 36], 1, 10);
}

/// Averages over frames of lines with incoherent blur (scene 8 of seed 79), and elliptical pupils at
/// grazing views, whose grains along the column are longer than σ/2 (scenes 11 of seeds 79 and 83).
#[test]
fn intervals_hold_the_truth_in_averages_and_behind_elliptical_pupils() {
    hold_in_scenes(79, &[8, 11], 2, 12);
    hold_in_scenes(83, &[11], 2, 12);
}

/// Defocused lines under coherent blur, with the camera at 77° and 79° to the normal. In such scenes,
/// the speckle field cannot be read in strips: the reference poses would stretch it and displace the
/// lines. The stretch was found in these scenes; the forty drawn scenes include others.
///
/// The law of the blur is accurate to 5 %. For n independent columns, the standard error of the rms is
/// 1/√(2n). The bound of the rms is three of these and 5 %; the bound of the mean is 4/√n.
#[test]
fn errors_of_defocused_lines_at_grazing_views_are_as_stated() {
    for (seed, scene) in [(43, 11), (89, 30)] {
        let scene = intervals::DrawnScene::new(seed, scene);
        let held = scene.processed(intervals::Processing::None).held(5, 12);
        let text = format!(
            "seed {seed}: rms {:.3}, mean {:.3} of {} independent columns",
            held.rms(),
            held.mean(),
            held.independent
        );
        println!("{text}");
        let n = held.independent as f64;
        assert!(n > 2000.0, "{text}");
        assert!(
            (held.rms() - 1.0).abs() < 0.05 + 3.0 / (2.0 * n).sqrt(),
            "{text}"
        );
        assert!(held.mean().abs() < 4.0 / n.sqrt(), "{text}");
    }
}

/// A place measured again, nothing moved, after a median over columns scatters as `repeatability` states. Some 130
/// independent pairs give the ratio of variances a standard error of 12 %; dark columns, whose noise is large, make it
/// nearly twice as large. The bound is three of these.
#[test]
fn medians_repeat_as_stated() {
    for (seed, slope) in [(1, 1), (2, 0), (3, 1)] {
        let scene = intervals::DrawnScene::new(seed, slope);
        let scene = scene.processed(intervals::Processing::Median(7));
        let ratio = scene.repeats(6);
        println!("seed {seed}: {ratio:.3}");
        assert!((ratio - 1.0).abs() < 0.65, "seed {seed}: {ratio}");
    }
}

/// Means over eight neighbouring profiles scatter as the correlation over profiles states: far less than those of independent
/// ones where the line's errors have changed sign. Some 300 independent means give the ratio of variances a
/// standard error of 8 %; that of the law of the correlation is 10 % (`profile::uncertainty`).
#[test]
fn means_over_profiles_are_as_stated() {
    for (seed, step) in [(1, 0.7), (2, 1.2), (3, 1.8), (4, 2.5)] {
        let scene = intervals::DrawnScene::with_line(seed, 0, Some([2.0, 0.0]));
        let [ratio, independent] = scene.means_over_profiles(step, 8, 5);
        println!("seed {seed}, {step} σ: {ratio:.3}, of independent profiles {independent:.3}");
        assert!((ratio - 1.0).abs() < 0.4, "seed {seed}, {step} σ: {ratio}");
    }
}

/// Lines of 0.7 grains that the lens blurs by 0, 2 and 4 of their standard deviations: errors are as large as stated. Half a
/// thousand independent columns give the rms a standard error of 3 %, three of which lie on the law's 5 %.
#[test]
fn errors_of_blurred_narrow_lines_are_as_stated() {
    for (seed, blur) in [(1, 0.0), (2, 2.0), (3, 4.0), (4, -4.0)] {
        let scene = intervals::DrawnScene::with_line(seed, 0, Some([0.7, blur]));
        let held = scene.held(2, 8);
        let text = format!(
            "seed {seed}, blur of {blur} σ: {:.3} of {}",
            held.rms(),
            held.unflagged
        );
        println!("{text}");
        assert!(
            held.unflagged > 500 && (held.rms() - 1.0).abs() < 0.14,
            "{text}"
        );
    }
}

/// Behind a distorting lens, errors are as stated at any distance from the pose in which a speckle pattern was first seen. The
/// first and the third scene showed a dependence on this distance; the last two were not used to find it. The bound is
/// three standard errors of the rms, 1.1 % each for some 3 800 independent columns, and 3 % for the local scale of the
/// distortion in the field.
#[test]
fn errors_behind_a_distorting_lens_are_as_stated() {
    for (seed, scene) in [(61, 28), (61, 30), (67, 10), (71, 22), (71, 24)] {
        let scene = intervals::DrawnScene::new(seed, scene);
        let held = scene.processed(intervals::Processing::None).held(4, 12);
        let text = format!("seed {seed}: {:.3} of {}", held.rms(), held.unflagged);
        println!("{text}");
        assert!(
            held.unflagged > 7000 && (held.rms() - 1.0).abs() < 0.064,
            "{text}"
        );
    }
}

/// Errors on side faces at 55° to 75° to the light, next to bright top faces, are as stated. Such a
/// face is darker because of its incidence, and no edge truncates the line on it.
///
/// Neighbouring columns are correlated in pairs, so that the standard error of the rms of n points
/// with speckle is 1/√n. Without speckle, the error by the pixel pattern is common to the 12 frames of
/// a sensor, and the standard error is √(6/n). The bound is 5 % for the law and three standard errors.
#[test]
fn errors_on_dark_side_faces_are_as_stated() {
    let sensor = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/sensors/generic-400mm-660nm.toml"
    );
    for (speckle, turn) in [(true, -15), (true, -25), (false, -15), (false, -20)] {
        let mut errors = Vec::new();
        for seed in 1..=4 {
            let text = format!(
                "seed = {seed}\nspeckle = {speckle}\nsensor = \"{sensor}\"\n\
                 [part]\nstep_block = {{ size_mm = [20, 60, 10], step_mm = 1 }}\n\
                 rotation_deg = [0, {turn}, 0]\nreflectance = 0.5\n\
                 [scan]\nframes = 12\nstep_mm = 2\ndirection = [0, 1, 0]\n"
            );
            let simulation = Simulation::new(&Scene::parse(&text, "".as_ref()).unwrap()).unwrap();
            let points = (0..12).flat_map(|frame| simulation.take(frame).2);
            for point in points.filter(|p| p.normal.x > 0.99 && p.flags.is_empty()) {
                let [y, z] = [point.position.y, point.position.z];
                let to_edge = z.min(10.0 - z).min(30.0 - y.abs());
                if to_edge >= simulation.edge_margin(&point) {
                    errors.push(point.deviation / point.u_deviation);
                }
            }
        }
        let n = errors.len() as f64;
        let rms = (errors.iter().map(|e| e * e).sum::<f64>() / n).sqrt();
        let text = format!("speckle {speckle}, {turn}°: rms {rms:.3} of {n} points");
        println!("{text}");
        let standard_error = if speckle { 1.0 / n } else { 6.0 / n }.sqrt();
        assert!(n > 400.0, "{text}");
        assert!((rms - 1.0).abs() < 0.05 + 3.0 * standard_error, "{text}");
    }
}
