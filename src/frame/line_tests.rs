//! The lit curve as light source, compared with path tracing.

use super::*;

/// Returns the mesh of quadrangles, each as two triangles.
fn of_quads(quads: &[[[f64; 3]; 4]]) -> Mesh {
    let mut mesh = Mesh {
        positions: Vec::new(),
        triangles: Vec::new(),
    };
    for quad in quads {
        let first = mesh.positions.len() as u32;
        mesh.positions.extend(quad.map(DVec3::from_array));
        mesh.triangles
            .extend([[0, 1, 2], [0, 2, 3]].map(|corners| corners.map(|corner| first + corner)));
    }
    mesh
}

/// Returns a groove along y with the given angle between its walls, 20 mm wide on either side.
fn groove(degrees: f64) -> Mesh {
    let height = 20.0 / (degrees / 2.0).to_radians().tan();
    let wall = |x: f64| {
        [
            [0.0, -20.0, 0.0],
            [0.0, 20.0, 0.0],
            [x, 20.0, height],
            [x, -20.0, height],
        ]
    };
    of_quads(&[wall(-20.0), wall(20.0)])
}

/// Returns a horizontal rectangle.
fn level(x: [f64; 2], y: [f64; 2], z: f64) -> [[f64; 3]; 4] {
    [
        [x[0], y[0], z],
        [x[1], y[0], z],
        [x[1], y[1], z],
        [x[0], y[1], z],
    ]
}

/// Returns a vertical rectangle over the segment from `a` to `b`.
fn upright(a: [f64; 2], b: [f64; 2], z: [f64; 2]) -> [[f64; 3]; 4] {
    [
        [a[0], a[1], z[0]],
        [b[0], b[1], z[0]],
        [b[0], b[1], z[1]],
        [a[0], a[1], z[1]],
    ]
}

/// Returns a slot along y between two levels; its floor comes first.
fn slot() -> Mesh {
    let wall = |x: f64| upright([x, -20.0], [x, 20.0], [0.0, 8.0]);
    of_quads(&[
        level([-6.0, 6.0], [-20.0, 20.0], 0.0),
        wall(-6.0),
        wall(6.0),
        level([-20.0, -6.0], [-20.0, 20.0], 8.0),
        level([6.0, 20.0], [-20.0, 20.0], 8.0),
    ])
}

/// Returns a bore of 12 sides with a floor.
fn bore() -> Mesh {
    let corner = |i: usize| {
        let (sin, cos) = (i as f64 * 30f64.to_radians()).sin_cos();
        [9.0 * cos, 9.0 * sin]
    };
    let sides = (0..12).map(|i| upright(corner(i), corner(i + 1), [0.0, 8.0]));
    let floor = level([-9.0, 9.0], [-9.0, 9.0], 0.0);
    of_quads(&sides.chain([floor]).collect::<Vec<_>>())
}

fn box_corner() -> Mesh {
    of_quads(&[
        level([-10.0, 20.0], [-20.0, 10.0], 0.0),
        upright([-10.0, -20.0], [-10.0, 10.0], [0.0, 20.0]),
        upright([-10.0, 10.0], [20.0, 10.0], [0.0, 20.0]),
    ])
}

fn pocket() -> Mesh {
    let corners = [[-9.0, -7.0], [9.0, -7.0], [9.0, 7.0], [-9.0, 7.0]];
    let sides = (0..4).map(|i| upright(corners[i], corners[(i + 1) % 4], [0.0, 6.0]));
    let floor = level([-9.0, 9.0], [-7.0, 7.0], 0.0);
    of_quads(&sides.chain([floor]).collect::<Vec<_>>())
}

fn metal(n: f64, k: f64, alpha: f64) -> Surface {
    let facets = Ggx {
        alpha_u: alpha,
        alpha_v: alpha,
    };
    glossy(vec![(1.0, Lobe::Metal(Conductor::new(n, k, facets)))])
}

/// Mean number of electrons per pixel.
const ELECTRONS: f64 = 300.0;

/// Builds a scene with an image of 80 × 60 pixels. The power of the laser gives [`ELECTRONS`].
fn setup(mesh: Mesh, surface: impl Into<Materials>) -> IndirectSetup {
    let mut setup = IndirectSetup::groove(surface, 5f64.to_radians());
    setup.accel = Accel::build(&Arc::new(mesh), 1).unwrap();
    let sensor = &mut setup.camera.sensor;
    sensor.resolution = UVec2::new(80, 60);
    sensor.pixel_pitch *= 4.0;
    let electrons = sensor.electrons_per_irradiance(setup.laser.beam.wavelength);
    let image = setup.ghosts((3, 1 << 14, 0.0), 50).dense();
    let mean = image.iter().map(|&e| f64::from(e)).sum::<f64>() / image.len() as f64;
    setup.laser.beam.power_mw *= ELECTRONS / (electrons * mean);
    setup
}

/// Returns the sums over the quarters of the image and over the complete image, for eight seeds.
fn sums(setup: &IndirectSetup, paths: u32, seed: u64) -> [Vec<f64>; 5] {
    let mut sums = [const { Vec::new() }; 5];
    for seed in seed..seed + 8 {
        let image = setup.ghosts((3, paths, 0.0), seed).dense();
        let mut of_image = [0.0; 5];
        for (pixel, &e) in image.iter().enumerate() {
            let [column, row] = [pixel % 80, pixel / 80];
            of_image[column / 40 + 2 * (row / 30)] += f64::from(e);
            of_image[4] += f64::from(e);
        }
        sums.iter_mut()
            .zip(of_image)
            .for_each(|(sums, sum)| sums.push(sum));
    }
    sums
}

/// Light with up to three bounces agrees with path tracing, in all quarters of the image.
///
/// The tolerance is five standard errors of eight images each, and 0.7 % for the interpolation: an
/// eighth of the noise of 300 electrons. By Student's t with 14 degrees of freedom, one of 40
/// comparisons fails without the second term with a probability below 1 %. Standard errors are at
/// most 3 % of the light in the complete image, so a sixth of the light cannot be lost.
fn compare_with_path_tracing(names: &[&str]) {
    let aluminium = metal(1.6575, 9.2238, 0.2);
    let kind = |surface| Material {
        topography: None,
        name: None,
        surface,
        degree_of_polarisation: 1.0,
    };
    for &name in names {
        let setup = match name {
            "60°" => setup(groove(60.0), metal(1.6575, 9.2238, 0.08)),
            "75°" => setup(groove(75.0), metal(2.9, 3.1, 0.4)),
            "90°" => setup(groove(90.0), matt(0.5)),
            "110°" => setup(groove(110.0), metal(0.22, 3.75, 0.15)),
            "slot" => {
                let two = vec![kind(matt(0.5)), kind(aluminium.clone())];
                let two = Materials::new(two, vec![0, 0, 1, 1, 1, 1, 0, 0, 0, 0]);
                setup(slot(), two)
            }
            "bore" => setup(bore(), aluminium.clone()),
            "corner" => setup(box_corner(), aluminium.clone()),
            _ => setup(pocket(), aluminium.clone()),
        };
        let traced = sums(&setup, 1 << 16, 0);
        let line = IndirectSetup {
            line: true,
            ..setup
        };
        let found = sums(&line, 1 << 16, 100);
        let whole = mean(&traced[4]).0;
        for (quarter, (traced, found)) in traced.iter().zip(&found).enumerate() {
            let ((a, a_error), (b, b_error)) = (mean(traced), mean(found));
            let error = f64::hypot(a_error, b_error);
            println!("{name} {quarter}: {a:.4} ± {a_error:.4}, {b:.4} ± {b_error:.4}");
            assert!((a - b).abs() < 5.0 * error + 0.007 * a, "{name} {quarter}");
            assert!(error < 0.03 * whole, "{name} {quarter}: {error}");
        }
    }
}

#[test]
fn the_lit_curve_has_the_light_of_path_tracing() {
    compare_with_path_tracing(&["75°", "slot", "corner"]);
}

#[test]
#[ignore = "half a minute; part of make verify"]
fn the_lit_curve_has_the_light_of_path_tracing_in_more_scenes() {
    compare_with_path_tracing(&["60°", "90°", "110°", "bore", "pocket"]);
}

/// Interpolated images have the light of samples in each pixel, for nodes with equal positions.
///
/// Simpson's rule over a pixel has an error of at most (4·5e-5 − 0.013)/3 = −0.4 % by the Poisson
/// summation of narrow lobes. The tolerance is this error plus five standard errors of eight images.
/// By Student's t with seven degrees of freedom, one of two comparisons fails without the first term
/// with a probability below 0.5 %.
#[test]
fn interpolated_light_is_that_of_samples() {
    for (name, setup) in [
        ("60°", setup(groove(60.0), metal(1.6575, 9.2238, 0.08))),
        ("corner", setup(box_corner(), metal(1.6575, 9.2238, 0.2))),
    ] {
        let view = setup.view();
        let eye = ThinLens::new(&view);
        let deviation = |seed| {
            let key = RngKey::new(seed, Purpose::Reflections);
            let line = LineSource::new(&view, key.with(3)).unwrap();
            let imager = LineImager::new((&view, &eye), &line, 2, key.with(4));
            let image = imager.image(&TracedRegion::All, false).irradiance;
            let [found, expected] =
                [image, imager.sampled(32)].map(|image| image.into_iter().map(f64::from).sum());
            let (found, expected): (f64, f64) = (found, expected);
            found / expected - 1.0
        };
        let (deviation, error) = mean(&(0..8).map(deviation).collect::<Vec<_>>());
        println!("{name}: {deviation:.5} ± {error:.5}");
        assert!(deviation.abs() < 0.004 + 5.0 * error, "{name} {deviation}");
        assert!(error < 2e-3, "{name} {error}");
    }
}

/// Returns grooves, slot, bore, corner and pocket with their surfaces.
fn metal_corners() -> [(&'static str, Mesh, Materials); 8] {
    let aluminium = |alpha: f64| metal(1.6575, 9.2238, alpha);
    [
        ("60° aluminium 0.08", groove(60.0), aluminium(0.08)),
        ("75° iron 0.4", groove(75.0), metal(2.9, 3.1, 0.4)),
        ("90° diffuse", groove(90.0), matt(0.5)),
        ("110° copper 0.15", groove(110.0), metal(0.22, 3.75, 0.15)),
        ("slot, aluminium 0.2", slot(), aluminium(0.2)),
        ("bore, aluminium 0.2", bore(), aluminium(0.2)),
        ("corner, aluminium 0.2", box_corner(), aluminium(0.2)),
        ("pocket, aluminium 0.2", pocket(), aluminium(0.2)),
    ]
    .map(|(name, mesh, surface)| (name, mesh, surface.into()))
}

/// Prints the ratio of error² × time of path tracing and of the lit curve, for images of 320 × 240
/// pixels and one thread. The images of both methods alternate. Errors are standard deviations over
/// seeds: the mean of their squares, and the mean of their squares relative to the sensor noise.
#[test]
#[ignore = "measures times"]
fn gain_over_path_tracing() {
    for (name, mesh, surface) in metal_corners() {
        let mut setup = setup(mesh, surface);
        setup.camera.sensor.resolution *= 4;
        setup.camera.sensor.pixel_pitch /= 4.0;
        setup.laser.beam.power_mw *= 16.0;
        let sensor = &setup.camera.sensor;
        let electrons = sensor.electrons_per_irradiance(setup.laser.beam.wavelength);
        let dark = sensor.dark_variance_e();
        let (mut images, mut times) = ([Vec::new(), Vec::new()], [0.0; 2]);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1);
        let pool = pool.build().unwrap();
        for seed in 0..6 {
            for (method, paths) in [1 << 17, 1 << 14].into_iter().enumerate() {
                setup.line = method == 1;
                let start = std::time::Instant::now();
                let image = pool.install(|| setup.ghosts((3, paths, 0.0), seed).dense());
                times[method] += start.elapsed().as_secs_f64();
                images[method].push(image);
            }
        }
        let errors = images.map(|images| {
            let mut errors = [0.0; 2];
            for pixel in 0..images[0].len() {
                let values = images
                    .iter()
                    .map(|image| f64::from(image[pixel]) * electrons);
                let (mean, error) = mean(&values.collect::<Vec<_>>());
                let variance = error * error * images.len() as f64;
                errors[0] += variance;
                errors[1] += variance / (mean + dark);
            }
            errors.map(|sum| sum / images[0].len() as f64)
        });
        let gain = |which: usize| errors[0][which] / errors[1][which] * times[0] / times[1];
        let view = setup.view();
        let eye = ThinLens::new(&view);
        let key = RngKey::new(0, Purpose::Reflections);
        let line = LineSource::new(&view, key.with(3)).unwrap();
        let imager = LineImager::new((&view, &eye), &line, 3, key.with(4));
        let start = std::time::Instant::now();
        let pairs = pool.install(|| imager.image(&TracedRegion::All, false).pairs) as f64;
        let pair_time = start.elapsed().as_secs_f64() / pairs;
        let path_time = times[0] / 6.0 / f64::from(1 << 17);
        println!(
            "{pairs:.2e} pairs of node and receiver, each {:.4} of a path of {:.2} µs",
            pair_time / path_time,
            1e6 * path_time
        );
        println!(
            "{name}: gain {:.1}, relative to the noise {:.1}; times {:.2} s and {:.2} s; noise {:.2} and {:.2}",
            gain(0),
            gain(1),
            times[0] / 6.0,
            times[1] / 6.0,
            errors[0][1].sqrt(),
            errors[1][1].sqrt()
        );
    }
}
