//! The plan is made for what the sensor sees of a part: the same for a small part and for
//! that part within a large one, whatever the path; and what is in view is told.

mod sensor;

use self::sensor::{COLUMNS, MESH, Quads, Sensor, rectangle, write_quads};
use crate::random::Random;
use lasertrace::accel::Accel;
use lasertrace::math::{DVec2, DVec3};
use lasertrace::plan::ModelConfig;
use lasertrace::plan::visible_line::VisibleLine;
use lasertrace::run::{Simulation, part_in_view, scene_plan};
use lasertrace::scene::Scene;
use std::fmt::Write;
use std::fs;

fn in_view(scene: &Scene) -> VisibleLine {
    let accel = Accel::build(&scene.mesh, 1).unwrap();
    part_in_view(scene, &accel.with_copies(scene.copies.clone()).unwrap())
}

/// What a plan says of the line's image.
fn line(plan: &ModelConfig) -> [f64; 4] {
    [
        plan.line_half_width_px,
        plan.px_per_mm,
        plan.defocus_blur_px,
        plan.beam_cutoff_radii,
    ]
}

/// Parts around the patch that reach `far` mm: to one side each, with a pillar at the end
/// and a floor below; and a frame that is hollow in the middle, the patch in one of its
/// bars.
fn large_parts(sensor: &Sensor, far: f64) -> Vec<Quads> {
    let (x, y) = (sensor.width, 0.2 * sensor.width);
    let pillar = |a: DVec2, b: DVec2| {
        let at = |p: DVec2, z: f64| p.extend(z);
        let top = far / 3.0;
        [at(a, 0.0), at(b, 0.0), at(b, top), at(a, top)]
    };
    let floor = rectangle([-far, far], [-far, far], -far);
    let side = |plate, a, b| vec![sensor.patch(), plate, pillar(a, b), floor];
    let d = DVec2::new;
    vec![
        side(rectangle([x, far], [-y, y], 0.0), d(far, -y), d(far, y)),
        side(rectangle([-far, -x], [-y, y], 0.0), d(-far, -y), d(-far, y)),
        side(rectangle([-x, x], [y, far], 0.0), d(-x, far), d(x, far)),
        side(rectangle([-x, x], [-far, -y], 0.0), d(-x, -far), d(x, -far)),
        vec![
            sensor.patch(),
            rectangle([-far, -x], [-y, y], 0.0),
            rectangle([x, far], [-y, y], 0.0),
            rectangle([-far, -far + y], [y, far], 0.0),
            rectangle([far - y, far], [y, far], 0.0),
            rectangle([-far, far], [far, far + y], 0.0),
        ],
    ]
}

/// What is planned for the patch alone is the width of its line by the beam's and the
/// pinhole's equations, and is planned for it within parts of 10 and 100 times the
/// measuring range; images of both have the same peaks, none of them flagged.
#[test]
fn a_patch_and_the_same_patch_within_a_large_part_have_one_plan() {
    let mut random = Random::new(11);
    for _ in 0..4 {
        let sensor = Sensor::random(&mut random);
        let (_folder, alone) = sensor.load_quads(&vec![sensor.patch()], &sensor.few_frames());
        let patch = Simulation::new(&alone).unwrap();
        let width_at = |i: usize| {
            let x = sensor.width * (i as f64 / 1000.0 - 0.5);
            let p = DVec3::new(x, 0.0, -sensor.standoff);
            let width = sensor.radius(p.length());
            // Towards the laser frame's y axis.
            let moved = sensor.image(p - DVec3::Y * width) - sensor.image(p);
            sensor.sees(p).then_some(moved.length())
        };
        let widths: Vec<f64> = (0..=1000).filter_map(width_at).collect();
        let least = widths.iter().copied().fold(f64::INFINITY, f64::min);
        let most = widths.iter().copied().fold(0.0, f64::max);
        // 1024 rays in each frame: the least of them is within a few of their distances
        // of the least of all, and widths vary smoothly.
        let planned = patch.plan.line_half_width_px;
        let error = (most - least) / 100.0 + 1e-6;
        assert!((planned - least).abs() < error, "{planned} {least} {most}");

        let counts = patch.counts(1, &patch.irradiance(1));
        let (expected, _) = patch.measure(1, &counts);
        assert!(expected.len() as f64 > 0.9 * COLUMNS);
        assert!(expected.iter().all(|peak| peak.flags.is_valid()));
        for times in [10.0, 100.0] {
            for (kind, quads) in large_parts(&sensor, times * sensor.width)
                .into_iter()
                .enumerate()
            {
                let (_folder, scene) = sensor.load_quads(&quads, &sensor.few_frames());
                let large = Simulation::new(&scene).unwrap();
                // The same rays meet the same triangle, each point in f64.
                for (a, b) in line(&patch.plan).into_iter().zip(line(&large.plan)) {
                    assert!((a - b).abs() <= 1e-9 * a.abs(), "{kind} × {times}: {a} {b}");
                }
                let counts = large.counts(1, &large.irradiance(1));
                let (peaks, _) = large.measure(1, &counts);
                assert_eq!(peaks.len(), expected.len(), "{kind} × {times}");
                assert!(peaks.iter().all(|peak| peak.flags.is_valid()));
            }
        }
    }
}

/// Where the first of a sphere's surface lies on a laser ray is a closed form, and so is
/// whether a convex body hides it from the camera. Its distribution over many frames is
/// met to the bound of Kolmogorov and Smirnov, at a false-alarm rate of 1e-3 (jittered
/// samples stray less), and what is nearer or farther than all that was looked at is at
/// most 20 of as many places, which by chance happens once in e²⁰.
#[test]
fn places_on_a_sphere_are_spread_as_light_on_it_is() {
    let mut random = Random::new(12);
    for _ in 0..3 {
        let sensor = Sensor::random(&mut random);
        let radius = sensor.width * random.between(0.3, 0.8);
        let depth = -random.between(0.6, 1.0) * radius;
        let middle = DVec3::new(random.between(-0.3, 0.3) * sensor.width, 0.0, depth);
        let (frames, z) = (4000, sensor.standoff);
        let step = 3.0 * radius / frames as f64;
        let start = -1.5 * radius;
        let scan = format!(
            "frames = {frames}\nstep_mm = {step}\ndirection = [0, 1, 0]\nstart_mm = [0, {start}, {z}]"
        );
        let part = format!(
            "sphere = {{ radius_mm = {radius}, chordal_deviation_um = 2 }}\nposition_mm = [{}, 0, {depth}]",
            middle.x
        );
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.toml");
        let text = sensor.scene(&part, &scan);
        fs::write(
            &path,
            text.replace("position_mm = [0, 0, 0]\n[laser]", "[laser]"),
        )
        .unwrap();
        let scene = Scene::load(&path).unwrap();
        let seen = in_view(&scene);
        let mut found: Vec<f64> = seen.places.iter().map(|p| p.z).collect();
        let mut truth = Vec::new();
        let half = 30f64.to_radians();
        for frame in (0..frames).step_by(4) {
            let head = DVec3::new(0.0, start + step * frame as f64, z);
            for i in 0..2000 {
                let angle = half * (i as f64 / 999.5 - 1.0);
                let direction = DVec3::new(angle.sin(), 0.0, -angle.cos());
                let off = head - middle;
                let along = off.dot(direction);
                let root = along * along - off.length_squared() + radius * radius;
                if root <= 0.0 {
                    continue;
                }
                let p = direction * (-along - root.sqrt());
                let normal = off + p;
                if sensor.sees(p) && (sensor.camera - p).dot(normal) > 0.0 {
                    truth.push(-p.z);
                }
            }
        }
        found.sort_by(f64::total_cmp);
        truth.sort_by(f64::total_cmp);
        let n = found.len() as f64;
        assert!(n > 1000.0 && truth.len() > 100_000, "{n} {}", truth.len());
        let share = |z: f64| truth.partition_point(|&t| t < z) as f64 / truth.len() as f64;
        let distance = found.iter().enumerate().map(|(i, &z)| {
            let below = share(z);
            (below - i as f64 / n)
                .abs()
                .max((below - (i + 1) as f64 / n).abs())
        });
        let distance = distance.fold(0.0, f64::max);
        assert!(distance < 1.95 / n.sqrt(), "{distance} of {n}");
        assert!(share(found[0]) < 20.0 / n);
        assert!(1.0 - share(*found.last().unwrap()) < 20.0 / n);
    }
}

/// A strip that the line meets in ten of 200 000 frames of a straight way, in five of each
/// turn, or in seven of 5000 listed poses; through lenses with and without distortion.
#[test]
fn a_part_is_found_wherever_on_its_path_it_is_in_view() {
    let mut random = Random::new(13);
    for i in 0..3 {
        let mut sensor = Sensor::random(&mut random);
        sensor.k1 = [0.0, -0.1, 0.1][i];
        let (x, z) = (sensor.width / 4.0, sensor.standoff);

        let before = random.choice(199_000) as u32;
        let y = before as f64 * 0.01 + 0.005;
        let strip = vec![rectangle([-x, x], [y, y + 0.1], 0.0)];
        let scan = format!(
            "frames = 200000\nstep_mm = 0.01\ndirection = [0, 1, 0]\nstart_mm = [0, 0, {z}]"
        );
        let (_folder, scene) = sensor.load_quads(&strip, &scan);
        let frames: Vec<u32> = (before + 1..=before + 10).collect();
        assert_eq!(in_view(&scene).frames, frames);

        let axis = 2.0 * sensor.width;
        let y = axis * 0.25f64.to_radians();
        let strip = vec![rectangle([-x, x], [-y, y], 0.0)];
        let scan = format!(
            "moving_body = \"part\"\nframes = 18000\nstart_mm = [0, 0, {z}]\nrotary = {{ axis_point_mm = \
             [0, 0, -{axis}], axis_direction = [1, 0, 0], step_deg = 0.1 }}"
        );
        let (_folder, scene) = sensor.load_quads(&strip, &scan);
        let frames: Vec<u32> = (0..18000u32).filter(|k| (k + 2) % 3600 < 5).collect();
        assert_eq!(in_view(&scene).frames, frames);

        let mut frames: Vec<u32> = (0..7).map(|_| random.choice(5000) as u32).collect();
        frames.sort();
        frames.dedup();
        let mut poses = "x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\n".to_owned();
        for frame in 0..5000 {
            let off = if frames.contains(&frame) { 0 } else { 100_000 };
            writeln!(poses, "{off},0,{z},0,0,0").unwrap();
        }
        let folder = tempfile::tempdir().unwrap();
        write_quads(&folder, &strip);
        fs::write(folder.path().join("poses.csv"), poses).unwrap();
        let (_folder, scene) = sensor.load_in(folder, MESH, "poses = \"poses.csv\"");
        assert_eq!(in_view(&scene).frames, frames);
    }
}

/// Copies that the line meets in one of fifty frames of 200 000, at equal distances as
/// frames have: with none of 1024 frames among them once in 1e9.
#[test]
fn copies_far_apart_are_not_stepped_over() {
    let mut random = Random::new(14);
    for _ in 0..3 {
        let sensor = Sensor::random(&mut random);
        let (x, z) = (sensor.width / 4.0, sensor.standoff);
        let folder = tempfile::tempdir().unwrap();
        write_quads(&folder, &vec![rectangle([-x, x], [0.0, 1.0], 0.0)]);
        let mut poses = "x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\n".to_owned();
        let first = random.between(0.0, 48.0);
        for i in 0..40 {
            writeln!(poses, "0,{},0,0,0,0", first + 50.0 * i as f64).unwrap();
        }
        fs::write(folder.path().join("copies.csv"), poses).unwrap();
        let scan = format!(
            "frames = 200000\nstep_mm = 0.01\ndirection = [0, 1, 0]\nstart_mm = [0, 0, {z}]"
        );
        let part = format!("{MESH}\ninstances = \"copies.csv\"");
        let (_folder, scene) = sensor.load_in(folder, &part, &scan);
        let frames = in_view(&scene).frames;
        assert!(!frames.is_empty());
        for frame in frames {
            let beyond = (frame as f64 * 0.01 - first).rem_euclid(50.0);
            assert!(beyond < 1.0 + 1e-6, "{frame}: {beyond}");
        }
    }
}

/// Why no light is seen is told apart; the plan is then for all that the sensor could
/// see, no wider a line than that of a patch in the middle of it.
#[test]
fn where_nothing_is_seen_the_plan_says_what_could_be() {
    let mut random = Random::new(15);
    for _ in 0..3 {
        let sensor = Sensor::random(&mut random);
        let (w, s) = (sensor.width, sensor.standoff);
        let few = sensor.few_frames();
        let [
            (_a, patch),
            (_b, beside),
            (_c, around),
            (_d, below),
            (_e, hidden),
        ] = [
            vec![sensor.patch()],
            vec![rectangle([-w, w], [w, 2.0 * w], 0.0)],
            vec![
                rectangle([-9.0 * w, -8.0 * w], [-w, w], 0.0),
                rectangle([8.0 * w, 9.0 * w], [-w, w], 0.0),
            ],
            vec![
                rectangle([-w, w], [-w, w], -5.0 * w),
                rectangle([8.0 * w, 9.0 * w], [-w, w], 0.0),
            ],
            vec![
                sensor.patch(),
                [(-w, 0.0), (w, 0.0), (w, 0.5 * s), (-w, 0.5 * s)]
                    .map(|(x, z)| DVec3::new(3.0 * x, -0.2, z)),
            ],
        ]
        .map(|quads| sensor.load_quads(&quads, &few));
        let seen = in_view(&patch);
        assert!(seen.places.len() > 1000 && seen.frames == [0, 1, 2]);
        let planned = scene_plan(&patch).unwrap();
        let counts = |scene| {
            let seen: VisibleLine = in_view(scene);
            assert!(seen.places.is_empty() && seen.frames.is_empty());
            [seen.rays, seen.met, seen.on_sensor].map(|count| count > 0)
        };
        assert_eq!(counts(&beside), [false, false, false]);
        assert_eq!(counts(&around), [true, false, false]);
        assert_eq!(counts(&below), [true, true, false]);
        assert_eq!(counts(&hidden), [true, true, true]);
        for scene in [&beside, &around, &below, &hidden] {
            let plan = scene_plan(scene).unwrap();
            assert!(line(&plan).iter().all(|x| x.is_finite() && *x > 0.0));
            assert!(plan.line_half_width_px <= planned.line_half_width_px);
            assert!(plan.defocus_blur_px >= planned.defocus_blur_px);
        }
    }
}

/// A beam without a fan: what is within its radius, on a patch within a large part and off the
/// part.
#[test]
fn a_beam_is_looked_for_within_its_radius() {
    let mut random = Random::new(16);
    let sensor = Sensor::random(&mut random);
    let spot = |quads: &Quads| {
        let folder = tempfile::tempdir().unwrap();
        write_quads(&folder, quads);
        let text = sensor.scene(MESH, &sensor.few_frames());
        let fan = text.lines().find(|l| l.starts_with("line = ")).unwrap();
        let path = folder.path().join("scene.toml");
        fs::write(&path, text.replace(fan, "")).unwrap();
        let scene = Scene::load(&path).unwrap();
        let radius = scene.laser.beam.radius(sensor.standoff);
        (in_view(&scene), scene_plan(&scene).unwrap(), radius)
    };
    let (seen, plan, radius) = spot(&vec![sensor.patch()]);
    assert_eq!(seen.frames, [0, 1, 2]);
    let off = |place: &DVec3| place.truncate().length();
    assert!(seen.places.iter().any(|place| off(place) < 1e-9));
    // Within the disc, and of evenly spread ones one in ten outside of 0.95 of its radius.
    let furthest = seen.places.iter().map(off).fold(0.0, f64::max);
    assert!(
        (0.95..1.0 + 1e-6).contains(&(furthest / radius)),
        "{furthest} {radius}"
    );
    for quads in large_parts(&sensor, 100.0 * sensor.width) {
        for (a, b) in line(&plan).into_iter().zip(line(&spot(&quads).1)) {
            assert!((a - b).abs() <= 1e-9 * a.abs(), "{a} {b}");
        }
    }
    let w = sensor.width;
    let (seen, nothing, _) = spot(&vec![rectangle([w, 2.0 * w], [-w, w], 0.0)]);
    assert!(seen.rays == 0 && line(&nothing).iter().all(|x| x.is_finite()));
    assert!(nothing.line_half_width_px <= plan.line_half_width_px);
}
