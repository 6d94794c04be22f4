//! Acceptance tests whose outcome follows from geometry.

#![cfg(unix)]

use crate::effort::extent;
use crate::program::{assert_error, run};
use lasertrace::inspect::acceptance::{Characteristic, PlaceResult};
use lasertrace::inspect::artefact::{Sphere, plane_residuals, shortest_interval};
use lasertrace::math::{DVec2, DVec3, Rigid};
use lasertrace::run::{RunControl, Simulation};
use lasertrace::scene::Scene;
use lasertrace::study::{Acceptance, Artefact};
use std::cell::Cell;
use std::fs;
use std::sync::atomic::AtomicBool;
use tempfile::TempDir;

/// Of the triangles of spheres of less than 10 mm.
const CHORD_UM: f64 = 0.1;
static STOP: AtomicBool = AtomicBool::new(false);
const CONTROL: RunControl = RunControl {
    progress: &|_| {},
    setup_progress: None,
    notice: None,
    stop: &STOP,
};

/// A sensor without noise of few pixels, counts of 16 bits; `more` is laid over it.
fn sensor(more: &str) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let text = format!(
        "[data_sheet]\nstand_off_mm = 80\nmeasuring_range_mm = 40\nfield_near_mm = 36\nfield_far_mm = 48\n\
         points_per_profile = 320\ntriangulation_deg = 30\nwavelength_nm = 660\npixel_pitch_um = 11\n\
         line_width_um = 240\n{more}"
    );
    fs::write(folder.path().join("sensor.toml"), text).unwrap();
    folder
}

const ACCEPT: &str =
    "[accept]\nprofiles = 25\nheight_steps = 5\nrepeats = 2\nexcluded_percent = 0\n";

/// Without noise and speckle; counts as fine as there are.
fn quiet(scene: &mut Scene) {
    scene.speckle = None;
    let sensor = &mut scene.camera.sensor;
    sensor.noise = None;
    sensor.bit_depth = 16;
    sensor.gain_dn_per_e = 6.0;
    scene.auto_exposure = Some(0.8);
}

fn laid_out(folder: &TempDir, change: impl Fn(&mut Scene)) -> Acceptance {
    let file = folder.path().join("sensor.toml");
    Acceptance::with(&file, None, &CONTROL, change).unwrap()
}

fn found(acceptance: &Acceptance) -> Vec<Characteristic> {
    acceptance.characteristics(1, &CONTROL).unwrap()
}

fn of<'a>(all: &'a [Characteristic], symbol: &str) -> &'a Characteristic {
    all.iter().find(|c| c.symbol == symbol).unwrap()
}

fn value(place: &PlaceResult) -> f64 {
    place.spread.unwrap().mean_um
}

/// How far the centroid of a line of standard deviation `sigma` lies off a sphere (mm along z, the beam upwards) at `normal`, to
/// second order. In one column light at y off the laser plane lies at x + κy, κ = v_x/v_y of the direction v to the camera,
/// at the height z′y + z″y²/2 over that in the plane; it is seen at −y·v_z/v_y more, and received in proportion to n·v; and a
/// column as wide as `column` sees the mean of its bend:
///
/// ```text
/// σ²·(z″/2 + (z′ − v_z/v_y)·(n·v)′/(n·v)) + column²/24·∂²z/∂x²
/// ```
fn line_width_bias(normal: DVec3, radius: f64, v: DVec3, sigma: f64, column: f64) -> f64 {
    let slope_along = |d: DVec2| -normal.truncate().dot(d) / normal.z;
    // |d|² + z′² + z·z″ = 0 on a sphere.
    let bend_along =
        |d: DVec2| -(d.length_squared() + slope_along(d).powi(2)) / (radius * normal.z);
    let across = DVec2::new(v.x / v.y, 1.0);
    let slope = slope_along(across);
    let received = across.extend(slope).dot(v) / radius / normal.dot(v);
    sigma.powi(2) * (bend_along(across) / 2.0 + (slope - v.z / v.y) * received)
        + column.powi(2) / 24.0 * bend_along(DVec2::X)
}

/// Values of a sphere's first place: P_F of 25 points, D95 and P_S, as measured and as the bias of the line's width alone makes
/// them, µm.
fn measured_and_predicted(folder: &TempDir) -> [[f64; 3]; 2] {
    let mut acceptance = laid_out(folder, quiet);
    acceptance.placings.truncate(2);
    let all = found(&acceptance);
    let measured = ["P_F", "P_F D95%", "P_S"].map(|symbol| value(&of(&all, symbol).places[0]));

    let placing = &acceptance.placings[0];
    let text = "seed = 1\nspeckle = false\nsensor = \"sensor.toml\"\n[part]\nplane = { size_mm = [1, 1] }\nreflectance = 0.5\n\
                [scan]\nframes = 1\nstep_mm = 1\ndirection = [0, 1, 0]\n";
    let scene = Scene::parse(text, folder.path()).unwrap();
    let laser_from_camera = scene.head_from_laser.inverse() * scene.head_from_camera;
    let eye = placing
        .laser_from_artefact
        .inverse()
        .point(laser_from_camera.translation);
    let radius = acceptance.artefacts.sphere_diameter_mm / 2.0;
    let half_angle = acceptance.artefacts.cap_half_angle_deg.to_radians();
    let sigma = scene.laser.beam.radius(placing.middle_mm[2] - radius) / 2.0;
    let field = (48.0 - 36.0) / 40.0 * (placing.middle_mm[2] - radius - 80.0) + 36.0;
    let column = field / f64::from(scene.camera.sensor.resolution.x);
    // Columns are many, and the profiles' first and last touch the cap's rim; what is beyond by 1/20 counts too.
    let (mut points, profiles) = (Vec::new(), acceptance.artefacts.profiles);
    let (rim, beyond) = (half_angle.sin(), (1.05 * half_angle).sin());
    for column_of in -100..=100 {
        for profile in 0..profiles {
            let y = 2.0 * f64::from(profile) / f64::from(profiles - 1) - 1.0;
            let at = DVec2::new(f64::from(column_of) / 100.0 * beyond, y * rim);
            if at.length() > beyond {
                continue;
            }
            let normal = at.extend((1.0 - at.length_squared()).sqrt());
            let place = normal * radius;
            // The head has moved as far.
            let eye = eye + DVec3::Y * place.y;
            let v = (eye - place).normalize();
            points.push(place + DVec3::Z * line_width_bias(normal, radius, v, sigma, column));
        }
    }
    let fitted = Sphere::fit(&points).unwrap();
    let range = |points: &[DVec3], share: f64| {
        let residuals = points.iter().map(|&p| fitted.residual(p)).collect();
        shortest_interval(residuals, share).unwrap() * 1e3
    };
    let of_25: Vec<DVec3> = fitted
        .representative(&points, DVec3::Z, half_angle)
        .into_iter()
        .flatten()
        .collect();
    let size = 2e3 * (fitted.radius - radius);
    [measured, [range(&of_25, 1.0), range(&points, 0.95), size]]
}

/// Of a sensor of fine pixels, so that no line is narrow for them, and waves so short that the lens widens nothing.
fn fine_sensor(line_width_um: u32, more: &str) -> TempDir {
    let folder = sensor(&format!("{ACCEPT}{more}"));
    let file = folder.path().join("sensor.toml");
    let text = fs::read_to_string(&file).unwrap();
    let line = format!("line_width_um = {line_width_um}");
    let text = text
        .replace("points_per_profile = 320", "points_per_profile = 1280")
        .replace("pixel_pitch_um = 11", "pixel_pitch_um = 2.75")
        .replace("wavelength_nm = 660", "wavelength_nm = 200")
        .replace("line_width_um = 240", &line);
    fs::write(file, text).unwrap();
    folder
}

/// Nothing but the chord of the sphere's triangles, the bias of the line's width and the finder's are left of a sensor
/// without noise. What the second order leaves out of the bias is of the order σ²/R² of it, 1e-4 at the top and less than
/// 1/20 on slopes of 1. The finder's bias is up to 0.002 px, on either side; of P_S, for which a cap of 45° tells the
/// radius from the centre by 1 − cos 45°, it counts 1/(1 − cos 45°) times, and twice as of a diameter.
#[test]
fn without_noise_the_line_width_is_left_and_vanishes_with_it() {
    let mut sizes = Vec::new();
    for line_width_um in [160, 100] {
        let folder = fine_sensor(line_width_um, "");
        let [measured, predicted] = measured_and_predicted(&folder);
        // A pixel's width at the far end over the sine of the angle between laser and view.
        let row_um = 48e3 / 1280.0 / 30f64.to_radians().sin();
        let finder = 0.002 * row_um + CHORD_UM;
        let bounds = [2.0, 2.0, 2.0 / (1.0 - 45f64.to_radians().cos())].map(|times| times * finder);
        println!(
            "line of {line_width_um} µm: P_F, D95, P_S {measured:.3?} µm, predicted {predicted:.3?}, bounds {bounds:.3?}"
        );
        for ((measured, predicted), bound) in measured.into_iter().zip(predicted).zip(bounds) {
            let off = (measured - predicted).abs();
            assert!(
                off < bound + 0.05 * predicted.abs(),
                "{measured} {predicted} {bound}"
            );
        }
        sizes.push(predicted[2].abs());
    }
    // (100/160)² = 0.39.
    assert!(sizes[1] < sizes[0] / 2.0, "{sizes:?}");
}

/// The test as laid out but with some artefacts alone.
fn only(mut acceptance: Acceptance, artefact: Artefact) -> Acceptance {
    acceptance
        .placings
        .retain(|placing| placing.artefact == artefact);
    acceptance
}

/// Across near, along the scan, rising across, and the space diagonal.
fn some_bars(acceptance: Acceptance) -> Acceptance {
    let mut acceptance = only(acceptance, Artefact::Sphere);
    let bars = acceptance.placings.chunks(2).enumerate();
    let some = bars.filter(|(bar, _)| bar % extent(4, 2) == 0 && *bar < 8);
    acceptance.placings = some.flat_map(|(_, two)| two.to_vec()).collect();
    acceptance
}

/// Camera and laser plane moved away from the head's origin, which lies in the plane, by a share of their distance make every
/// point's place in its profile larger by that share, while the path is as it is. What the sensor finds without the error,
/// the bias of the line's width, is taken off. A scaled cap is no sphere's any more, and the sphere through it stands off. Caps are taken about
/// the spheres that are found, so both of a bar are alike; but each has more points on the side that looks to the laser, and stands off to the
/// other by about SCALE·R·sin²(cap)·(its place over the distance), R the radius: 5e-3·3 mm·0.18·0.13 = 0.4 µm here, twice for a bar. 1 % of the
/// greatest error is 1.3 µm.
#[test]
fn a_scale_error_of_the_calibration_comes_back_in_sphere_spacing() {
    const SCALE: f64 = 5e-3;
    let folder = fine_sensor(100, "sphere_diameter_mm = 6\ncap_half_angle_deg = 25\n");
    let acceptance = laid_out(&folder, |scene| {
        quiet(scene);
        let mut calibration = Simulation::new(scene).unwrap().calibration;
        calibration.head_from_camera.translation *= 1.0 + SCALE;
        calibration.plane_point *= 1.0 + SCALE;
        scene.calibration = Some(calibration);
    });
    let acceptance = some_bars(acceptance);
    let all = found(&acceptance);
    let spacing = of(&all, "SD");
    let right = found(&some_bars(laid_out(&folder, quiet)));
    let right: Vec<f64> = of(&right, "SD").places.iter().map(value).collect();
    let length = acceptance.artefacts.ball_bar_length_mm;
    assert_eq!(spacing.places.len(), extent(2, 4));
    for ((bar, place), right) in acceptance
        .placings
        .chunks(2)
        .zip(&spacing.places)
        .zip(&right)
    {
        let [a, b] = [0, 1].map(|i| DVec3::from(bar[i].middle_mm));
        let scaled = (b - a) * DVec3::new(1.0 + SCALE, 1.0, 1.0 + SCALE);
        let expected = (scaled.length() - length) * 1e3;
        let bound = 0.01 * SCALE * length * 1e3;
        let found = value(place) - right;
        println!("{}: {found:.3} µm, expected {expected:.3}", place.place);
        assert!(
            (found - expected).abs() < bound,
            "{}: {found} {expected}",
            place.place
        );
    }
}

/// A laser plane taken for one turned by δ about the line through the head's origin: what is seen at P in the true plane y = 0 is
/// found where the ray from the eye E through P meets y = z·tan δ, E + s·(P − E).
fn seen_in_turned_plane(place: DVec3, eye: DVec3, turn: f64) -> DVec3 {
    let normal = DVec3::new(0.0, 1.0, -turn.tan());
    let s = -normal.dot(eye) / normal.dot(place - eye);
    eye + s * (place - eye)
}

/// A plane's profile stays straight in it, as the two planes are seen in perspective: level plates stay flat, and one that is tilted
/// by τ along the scan becomes a parabola, to first order tan δ·cos τ·sin²τ·(side/2)²/baseline deep from its middle to
/// its ends. Linearity is z′ − z. Found within 1 % of the greatest error and the finder's bias of 0.002 px, of some 0.2 mm; flatness, a range,
/// within 1 % and the range without the error.
#[test]
fn a_wrong_laser_plane_comes_back_in_flatness_and_linearity() {
    const TURN: f64 = 0.05;
    const FINDER_UM: f64 = 0.8;
    let folder = sensor(ACCEPT);
    let known = Cell::new((Rigid::IDENTITY, DVec3::ZERO));
    let mut acceptance = laid_out(&folder, |scene| {
        quiet(scene);
        let mut calibration = Simulation::new(scene).unwrap().calibration;
        let camera_from_head = calibration.head_from_camera.inverse();
        calibration.plane_point = camera_from_head.point(DVec3::ZERO);
        let normal = DVec3::new(0.0, TURN.cos(), -TURN.sin());
        calibration.plane_normal = camera_from_head.vector(normal);
        known.set((
            scene.head_from_laser,
            calibration.head_from_camera.translation,
        ));
        scene.calibration = Some(calibration);
    });
    acceptance
        .placings
        .retain(|placing| placing.artefact != Artefact::Sphere);
    let (head_from_laser, eye) = known.get();
    let right = found(&only(laid_out(&folder, quiet), Artefact::Plate));
    let right: Vec<f64> = of(&right, "F").places.iter().map(value).collect();
    let all = found(&acceptance);
    let middles = |artefact| {
        let placings = acceptance
            .placings
            .iter()
            .filter(move |p| p.artefact == artefact);
        placings.map(move |p| head_from_laser * p.laser_from_artefact)
    };

    let true_heights = middles(Artefact::Height).map(|pose| pose.translation);
    let expected: Vec<f64> = true_heights
        .map(|place| (seen_in_turned_plane(place, eye, TURN).z - place.z) * 1e3)
        .collect();
    let most = expected.iter().fold(0.0, |most: f64, e| most.max(e.abs()));
    assert!(most > 100.0, "{expected:?}");
    for (place, expected) in of(&all, "Linearity").places.iter().zip(&expected) {
        let found = value(place);
        assert!(
            (found - expected).abs() < 0.01 * most + FINDER_UM,
            "{found} {expected}"
        );
    }

    let half = acceptance.artefacts.plate_side_mm / 2.0;
    let flatness = of(&all, "F");
    let places: Vec<f64> = flatness.places.iter().map(value).collect();
    for (pose, (found, right)) in middles(Artefact::Plate).zip(places.iter().zip(&right)) {
        let mut points = Vec::new();
        for i in -50..=50 {
            for j in -50..=50 {
                let on_plate = DVec2::new(f64::from(i), f64::from(j)) * half / 50.0;
                let place = pose.point(on_plate.extend(0.0));
                // The head stands so that its plane holds the place.
                let along = DVec3::Y * place.y;
                points.push(seen_in_turned_plane(place - along, eye, TURN) + along);
            }
        }
        let residuals = plane_residuals(&points).unwrap();
        let expected = shortest_interval(residuals, 1.0).unwrap() * 1e3;
        assert!(
            (found - expected).abs() < 0.01 * expected + right,
            "{places:?} {expected}"
        );
    }
    // What the closed form leaves out is of the order of tan δ times height over baseline, less
    // than 2, and times what the tilt adds, as much: 4·tan δ in all.
    let tilt = acceptance.artefacts.plate_tilt_deg.to_radians();
    let closed = TURN.tan() * tilt.cos() * tilt.sin().powi(2) * half * half / -eye.y * 1e3;
    assert!(
        (places[4] - closed).abs() < 4.0 * TURN.tan() * closed + right[4],
        "{places:?} {closed}"
    );
}

/// The command: its files, the same for any number of threads, and its refusals.
#[test]
#[ignore = "a minute: cargo test --test program accept -- --ignored"]
fn the_command_predicts_and_refuses() {
    let noisy = "[camera]\nprnu_percent = 1\ndsnu_e = 5\nread_noise_e = 10\n\
                 [accept]\nprofiles = 25\nheights = 2\nrepeats = 3\n[accept.mpe_um]\nflatness = 1e4\nprobing_form = 1e-3\n";
    let folder = sensor(noisy);
    let of = |threads: &str| {
        let arguments = [
            "accept",
            "sensor.toml",
            "--seeds",
            "2",
            "-o",
            "out",
            "--threads",
            threads,
        ];
        let (code, stdout, stderr) = run(folder.path(), &arguments);
        assert_eq!((code, stderr.as_str()), (0, ""), "{stdout}");
        let files = ["accept.json", "report.html"];
        (
            stdout,
            files.map(|file| fs::read_to_string(folder.path().join("out").join(file)).unwrap()),
        )
    };
    let (text, [json, page]) = of("1");
    assert_eq!(of("2").1, [json.clone(), page.clone()]);
    let json: serde_json::Value = serde_json::from_str(&json).unwrap();
    let all = json["characteristics"].as_array().unwrap();
    let decision = |symbol: &str| {
        let one = all.iter().find(|c| c["symbol"] == symbol).unwrap();
        one["decision"].as_str().unwrap().to_owned()
    };
    assert_eq!(
        (all.len(), decision("F"), decision("P_F"), decision("P_S")),
        (
            7,
            "conforms".into(),
            "does-not-conform".into(),
            "no-limit".into()
        )
    );
    assert!(
        text.contains("2 seeds are few") && text.contains("no certificate"),
        "{text}"
    );
    assert!(
        page.contains("no certificate") && page.matches("<svg").count() == 8,
        "{page}"
    );
    assert!(
        !page.contains("http://")
            || page.matches("http").count() == page.matches("http://www.w3.org").count()
    );

    for (table, key) in [
        ("sphere_diameter_mm = 500", "accept.sphere_diameter_mm"),
        ("spacing_mm = 500", "accept.ball_bar_length_mm"),
        ("cap_half_angle_deg = 5", "accept.cap_half_angle_deg"),
        ("mpe_um = { flatness = -1 }", "accept.mpe_um.flatness"),
    ] {
        let folder = sensor(&format!("[accept]\n{table}\n"));
        let arguments = ["accept", "sensor.toml", "-o", "out"];
        assert_error(
            folder.path(),
            &arguments,
            65,
            &["sensor.toml", key, "expected"],
        );
    }
}
