use super::*;
use crate::accel::Accel;
use crate::camera::{Camera, fixture};
use crate::frame::{PixelQuadrature, Sampling, footprint, light};
use crate::laser::{Beam, CUTOFF_RADII, Fan, FanProfile, Laser};
use crate::math::rng::Purpose;
use crate::math::{DVec3, Rigid};
use crate::mesh::{Mesh, shapes};
use crate::surface::{
    Conductor, Ggx, Lambert, LayeredBrdf, Lobe, Material, Materials, Mirror, Surface,
};
use glam::UVec2;
use std::sync::Arc;

/// Returns the selected walls (x < 0, x > 0) of z = |x|, |x| ≤ 20, |y| ≤ 20 mm.
fn walls(wanted: [bool; 2]) -> Arc<Mesh> {
    let corner = |x: f64, y: f64| DVec3::new(x, y, x.abs());
    let positions = [-20.0, 0.0, 20.0]
        .iter()
        .flat_map(|&x| [corner(x, -20.0), corner(x, 20.0)])
        .collect();
    let triangles = [[[0, 2, 3], [0, 3, 1]], [[2, 4, 5], [2, 5, 3]]];
    let triangles = triangles.iter().zip(wanted).filter(|(_, wanted)| *wanted);
    Arc::new(Mesh {
        positions,
        triangles: triangles.flat_map(|(wall, _)| *wall).collect(),
    })
}

/// Returns a pinhole camera with a field of view of 14° over 320 columns.
fn pinhole() -> Camera {
    let mut camera = fixture();
    camera.lens.focus_distance = 190.0;
    camera.lens.f_number = camera.lens.focal_length / 1e-3;
    camera.sensor.resolution = UVec2::new(320, 240);
    camera.sensor.pixel_pitch = camera.lens.image_distance() * 7f64.to_radians().tan() / 160.0;
    camera
}

/// Returns a laser plane with the given half angle (rad) from an aperture of zero width. Its 1/e²
/// half width is 0.1232 mm at 200 mm.
fn sheet(half: f64) -> Laser {
    let wavelength = 1e-9;
    Laser {
        beam: Beam {
            wavelength,
            power_mw: 1.0,
            waist_radius: wavelength / std::f64::consts::PI / (0.1232 / 200.0),
            waist_distance: 0.0,
            m_squared: 1.0,
        },
        fan: Some(Fan {
            angle: 2.0 * half,
            profile: FanProfile::Uniform,
        }),
    }
}

struct IndirectSetup {
    accel: Accel,
    laser: Laser,
    part_from_laser: Rigid,
    camera: Camera,
    part_from_camera: Rigid,
    surface: Materials,
    line: bool,
}

fn looking(from: DVec3, at: DVec3, x: DVec3) -> Rigid {
    Rigid::from_z_and_x(from, at - from, x).unwrap()
}

impl IndirectSetup {
    /// Builds a groove with the laser at (0, 0, 200) and the camera at (0, −100, 170), aimed at (0,
    /// 0, 8).
    fn groove(surface: impl Into<Materials>, half: f64) -> IndirectSetup {
        IndirectSetup {
            accel: Accel::build(&walls([true; 2]), 1).unwrap(),
            laser: sheet(half),
            part_from_laser: looking(DVec3::Z * 200.0, DVec3::ZERO, DVec3::X),
            camera: pinhole(),
            part_from_camera: looking(DVec3::new(0.0, -100.0, 170.0), DVec3::Z * 8.0, DVec3::X),
            surface: surface.into(),
            line: false,
        }
    }

    fn view(&self) -> PoseView<'_> {
        PoseView {
            accel: &self.accel,
            surface: self.surface.clone(),
            laser: &self.laser,
            part_from_laser: self.part_from_laser,
            camera: &self.camera,
            part_from_camera: self.part_from_camera,
            speckle: None,
            grid: PixelQuadrature::Gauss { per_side: 4 },
            sampling: Sampling::Rays,
            beam_cutoff_radii: CUTOFF_RADII,
            lens: DefocusSettings::NONE,
            indirect: None,
            stop: None,
        }
    }

    /// Returns the sum over all pixels of `irradiance` converted to radiance.
    fn radiance(&self, irradiance: &Irradiance) -> f64 {
        let of_row = |row| {
            let pixels = irradiance.row(row);
            let radiance = |(column, e): (usize, f32)| {
                let place = DVec2::new(column as f64, row as f64) + 0.5;
                e as f64 / self.camera.pupil_solid_angle(place)
            };
            pixels.map(radiance).sum::<f64>()
        };
        (0..irradiance.rows()).map(of_row).sum()
    }

    fn direct(&self) -> Irradiance {
        let view = self.view();
        expose(light(&view, footprint(&view, &TracedRegion::All)), &view)
    }

    fn ghosts(&self, (most, from_laser, per_pixel): (u32, u32, f64), seed: u64) -> Irradiance {
        let indirect = IndirectSettings {
            reflections: Reflections {
                most,
                from_laser,
                per_pixel,
                line: self.line,
            },
            key: RngKey::new(seed, Purpose::Reflections),
            coherence_length: f64::INFINITY,
        };
        indirect_irradiance(&self.view(), &TracedRegion::All, &indirect).mean
    }
}

fn glossy(lobes: Vec<(f64, Lobe)>) -> Surface {
    Surface::Layered(Arc::new(LayeredBrdf { lobes, lay: None }))
}

fn matt(reflectance: f64) -> Surface {
    Lambert { reflectance }.into()
}

/// Returns aluminium without multiple scattering between facets.
fn aluminium(alpha: f64) -> Surface {
    let facets = Ggx {
        alpha_u: alpha,
        alpha_v: alpha,
    };
    glossy(vec![(
        1.0,
        Lobe::Metal(Conductor::new(1.6575, 9.2238, facets).single_scattering_only()),
    )])
}

/// Returns the mean of independent values and its standard error.
fn mean(figures: &[f64]) -> (f64, f64) {
    let n = figures.len() as f64;
    let mean = figures.iter().sum::<f64>() / n;
    let variance = figures.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (n - 1.0);
    (mean, (variance / n).sqrt())
}

/// Returns the ratio of all light to direct light in a 90° groove, and its standard error. The
/// laser power is uniform over tan φ up to tan 6°. This distribution is a fan of uniform power per
/// angle minus narrower fans weighted by the derivative of sec²φ: s(6°)·T(6°) − ∫s′(a)·T(a)da.
fn excess(surface: Surface, paths: (u32, u32, f64), images: u64) -> (f64, f64) {
    let half = 6f64.to_radians();
    let parts: Vec<IndirectSetup> = [1.0, 0.75]
        .iter()
        .map(|share| IndirectSetup::groove(surface.clone(), half * share))
        .collect();
    // Weight 2a·s(a) of the complete fan, with s = sec²/(2·tan 6°), and the remaining weight of the
    // narrower fans. All narrower fans are replaced by one of ¾ of the angle, the mean angle of
    // ∫2a·s′ ∝ ∫a²da.
    let whole = half / half.tan() / half.cos().powi(2);
    let shares = [whole, 1.0 - whole];
    let direct: Vec<f64> = parts
        .iter()
        .map(|part| part.radiance(&part.direct()))
        .collect();
    let sum = |of: &[f64]| shares[0] * of[0] + shares[1] * of[1];
    let images: Vec<f64> = (0..images)
        .map(|seed| {
            let indirect = parts
                .iter()
                .map(|part| part.radiance(&part.ghosts(paths, seed)));
            sum(&indirect.collect::<Vec<_>>()) / sum(&direct)
        })
        .collect();
    let (mean, error) = mean(&images);
    (1.0 + mean, error)
}

/// Indirect light in a groove agrees with radiosity and Monte Carlo results of other programs, for
/// up to two and three bounces. The tolerance is the uncertainty of these results plus five
/// standard errors of eight images. By Student's t, it fails once in 600 cases. The standard errors
/// are at most a hundredth of the indirect light.
#[test]
fn a_groove_is_as_bright_as_others_have_it() {
    let paths = |most| (most, 1 << 15, 0.0);
    for (surface, most, expected, known) in [
        (matt(0.5), 2, 1.1193, 0.0002),
        (matt(0.5), 3, 1.1364, 0.0002),
        (aluminium(0.2), 2, 10.89, 0.01),
        (aluminium(0.2), 3, 11.35, 0.02),
    ] {
        let (found, error) = excess(surface, paths(most), 8);
        println!("{most} reflections: {found:.4} ± {error:.4}, expected {expected}");
        assert!(
            (found - expected).abs() < known + 5.0 * error,
            "{found} ± {error}, {expected}"
        );
        assert!(error < 0.01 * (expected - 1.0), "{error}");
    }
}

/// All connection strategies together give the light of light paths only. With few light paths,
/// camera paths have the largest weights. The tolerance is five standard errors of both results. By
/// Student's t with at least seven degrees of freedom, it fails once in 600 cases for each of four
/// pairs. The standard errors are small enough to detect a fifth of the light that is lost or
/// counted twice.
#[test]
fn every_way_to_find_a_path_has_the_same_light() {
    let paint = || {
        let facets = Ggx {
            alpha_u: 0.15,
            alpha_v: 0.15,
        };
        glossy(vec![
            (0.5, Lobe::Metal(Conductor::new(1.6575, 9.2238, facets))),
            (0.2, Lobe::Mirror(Mirror { reflectance: 0.8 })),
            (0.3, Lobe::Diffuse(Lambert { reflectance: 0.5 })),
        ])
    };
    let setup = IndirectSetup::groove(paint(), 5f64.to_radians());
    let total = |paths| {
        let images: Vec<f64> = (0..8)
            .map(|seed| setup.radiance(&setup.ghosts(paths, seed)))
            .collect();
        mean(&images)
    };
    // Light paths connected to the pupil cannot find the view of the camera into a mirror.
    let some = total((4, 1 << 14, 0.25));
    let few = total((4, 1 << 12, 0.5));
    let many = total((4, 1 << 15, 0.1));
    println!("{some:?} {few:?} {many:?}");
    for (a, b) in [(some, few), (some, many), (few, many)] {
        let error = f64::hypot(a.1, b.1);
        assert!((a.0 - b.0).abs() < 5.0 * error, "{a:?} {b:?}");
        assert!(5.0 * error < a.0 / 5.0, "{error}");
    }
    let rough = IndirectSetup::groove(aluminium(0.4), 5f64.to_radians());
    let total = |paths| {
        let images: Vec<f64> = (0..8)
            .map(|seed| rough.radiance(&rough.ghosts(paths, seed)))
            .collect();
        mean(&images)
    };
    let laser = total((4, 1 << 15, 0.0));
    let both = total((4, 1 << 12, 0.5));
    let error = f64::hypot(laser.1, both.1);
    assert!((laser.0 - both.0).abs() < 5.0 * error, "{laser:?} {both:?}");
    assert!(5.0 * error < laser.0 / 5.0, "{error}");
}

/// Mirrors a point at the plane of the right or left wall.
fn mirrored(p: DVec3, right: bool) -> DVec3 {
    match right {
        true => DVec3::new(p.z, p.y, p.x),
        false => DVec3::new(-p.z, p.y, -p.x),
    }
}

/// The mirror wall produces two lines of indirect light on and from the diffuse wall, which a
/// tilted laser plane illuminates. One is the line of the mirrored laser on the diffuse wall. The
/// other is the mirror image of the diffuse wall's line. Both equal direct light in a mirrored
/// scene, with tolerances of 0.01 px in position and 1 % in flux.
#[test]
fn a_mirror_shows_ghosts_where_mirrored_scenes_have_lines() {
    const REFLECTANCE: f64 = 0.9;
    const ALBEDO: f64 = 0.5;
    const SIDE: u32 = 160;
    let kind = |surface| Material {
        topography: None,
        name: None,
        surface,
        degree_of_polarisation: 1.0,
    };
    let mirror = Mirror {
        reflectance: REFLECTANCE,
    };
    let kinds = vec![
        kind(matt(ALBEDO)),
        kind(glossy(vec![(1.0, Lobe::Mirror(mirror))])),
    ];
    let half = 2.5f64.to_radians();
    let askew = DVec3::new(1.0, 0.35, 0.0);
    let mut setup = IndirectSetup::groove(Materials::new(kinds, vec![0, 0, 1, 1]), half);
    setup.camera.sensor.resolution = UVec2::splat(SIDE);
    setup.part_from_laser = looking(DVec3::Z * 200.0, DVec3::ZERO, askew);
    let found = setup.ghosts((2, 1 << 18, 64.0), 1).dense();
    let matt_wall = walls([true, false]);
    let behind = Mesh {
        positions: (matt_wall.positions.iter())
            .map(|&p| mirrored(p, true))
            .collect(),
        triangles: matt_wall.triangles.clone(),
    };
    let reflected = looking(
        mirrored(DVec3::Z * 200.0, true),
        DVec3::ZERO,
        mirrored(askew, true),
    );
    // Mirrored laser on the diffuse wall, and the mirrored diffuse wall with the mirrored laser.
    let mirrored_walls = [
        (matt_wall.clone(), reflected),
        (Arc::new(behind), reflected),
    ];
    for (mesh, part_from_laser) in mirrored_walls {
        let scene = IndirectSetup {
            accel: Accel::build(&mesh, 1).unwrap(),
            laser: sheet(half),
            part_from_laser,
            camera: setup.camera.clone(),
            part_from_camera: setup.part_from_camera,
            surface: matt(ALBEDO * REFLECTANCE).into(),
            line: false,
        };
        assert_line(&found, &scene.direct().dense(), SIDE as usize);
    }
}

/// Compares two images in the lit area of the second one and two pixels around it. The flux of the
/// first image must agree within 1 %. The light-weighted mean of its centroid offsets per column
/// must be below 0.01 px.
fn assert_line(found: &[f32], expected: &[f32], side: usize) {
    let brightest = expected.iter().fold(0.0f32, |most, &e| e.max(most));
    let (mut flux, mut moved) = ([0.0; 2], 0.0);
    for column in 0..side {
        let (mut light, mut rows) = ([0.0; 2], [0.0; 2]);
        for row in 0..side {
            let near = (row.saturating_sub(2)..(row + 3).min(side))
                .any(|row| expected[row * side + column] > 1e-3 * brightest);
            for (k, image) in [found, expected].iter().enumerate().filter(|_| near) {
                let e = image[row * side + column] as f64;
                light[k] += e;
                rows[k] += e * row as f64;
            }
        }
        flux = [flux[0] + light[0], flux[1] + light[1]];
        if light[0] > 0.0 && light[1] > 0.0 {
            moved += (rows[0] / light[0] - rows[1] / light[1]) * light[1];
        }
    }
    let (ratio, moved) = (flux[0] / flux[1], moved / flux[1]);
    println!("flux {ratio:.4}, moved by {moved:.5} px");
    assert!((ratio - 1.0).abs() < 0.01, "{ratio}");
    assert!(moved.abs() < 0.01, "{moved}");
}

/// Radiance in a closed diffuse sphere of reflectance ρ and area A is uniform. After the first
/// bounce, the laser power Φ produces the radiance ρ/π·Φ·ρ/(A·(1 − ρ)). The area is computed from
/// the facets of the mesh, whose chordal deviation is 5 µm at a radius of 10 mm. The tolerance is
/// five standard errors of eight images plus 2·10⁻³.
#[test]
fn a_closed_sphere_integrates() {
    const RHO: f64 = 0.7;
    let mesh = shapes::sphere(10.0, 0.005).unwrap();
    let area: f64 = (0..mesh.triangles.len())
        .map(|i| {
            let [a, b, c] = mesh.triangle(i);
            (b - a).cross(c - a).length() / 2.0
        })
        .sum();
    let mut camera = pinhole();
    camera.sensor.resolution = UVec2::new(64, 48);
    // The field of view is 63° along the columns.
    camera.sensor.pixel_pitch *= 25.0;
    let setup = IndirectSetup {
        accel: Accel::build(&mesh.into(), 1).unwrap(),
        laser: sheet(0.3),
        part_from_laser: looking(DVec3::new(1.0, 2.0, 5.0), DVec3::ZERO, DVec3::X),
        camera,
        part_from_camera: looking(DVec3::new(-2.0, -4.0, 5.0), DVec3::X, DVec3::X),
        surface: matt(RHO).into(),
        line: false,
    };
    let expected = RHO / std::f64::consts::PI * RHO / (area * (1.0 - RHO));
    let images: Vec<f64> = (0..8)
        .map(|seed| setup.radiance(&setup.ghosts((64, 1 << 15, 0.0), seed)) / (64.0 * 48.0))
        .collect();
    let (found, error) = mean(&images);
    println!("{:.4} ± {:.4}", found / expected, error / expected);
    assert!(
        (found - expected).abs() < 5.0 * error + 2e-3 * expected,
        "{found} {expected}"
    );
    assert!(error < 5e-3 * expected, "{error}");
}

/// The result is byte-identical for any number of threads, with all strategies.
#[test]
fn threads_do_not_matter() {
    let mut setup = IndirectSetup::groove(aluminium(0.1), 6f64.to_radians());
    for line in [false, true] {
        setup.line = line;
        let image = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
            pool.build()
                .unwrap()
                .install(|| setup.ghosts((3, 1 << 14, 0.05), 5))
        };
        assert_eq!(image(1), image(3));
    }
}

/// Two paths whose lengths differ by many coherence lengths have the contrast C given by
/// C² = (I₁² + I₂²)/(I₁ + I₂)². A single path, or two paths within the coherence length, have C =
/// 1. For n = 10⁵ pairs, the tolerance is five standard deviations of 1/√n.
#[test]
fn contrast_is_that_of_the_paths_that_meet() {
    let contrast2 = |shares: [f32; 2], apart: f32| {
        let key = RngKey::new(2, Purpose::Reflections);
        let mut pairs = CoherenceEstimator::default();
        for i in 0..100_000 {
            // Each of two paths is sampled with a probability proportional to its light.
            let second = (key.uniform(i) as f32) < shares[1] / (shares[0] + shares[1]);
            pairs.add(1.0, 300.0 + if second { apart } else { 0.0 }, 1.0);
        }
        pairs.contrast().powi(2)
    };
    let bound = 5.0 / 1e5f32.sqrt();
    assert!((contrast2([1.0, 1.0], 10.0) - 0.5).abs() < bound);
    assert!((contrast2([3.0, 1.0], 10.0) - 10.0 / 16.0).abs() < bound);
    assert!((contrast2([1.0, 1.0], 1e-3) - 1.0).abs() < 1e-4);
    assert_eq!(CoherenceEstimator::default().contrast(), 1.0);
}

/// A point in the viewing direction of a sensor position is imaged at that position. The test
/// covers sharp and defocused images, with and without sensor tilt.
#[test]
fn images_are_where_places_look() {
    let setup = IndirectSetup::groove(matt(0.5), 0.1);
    for tilt in [DVec2::ZERO, DVec2::new(0.3, -0.1)] {
        for blur in [Blur::None, Blur::Mean] {
            let camera = Camera { tilt, ..fixture() };
            let mut view = setup.view();
            view.camera = &camera;
            view.lens.blur = blur;
            let eye = ThinLens::new(&view);
            let key = RngKey::new(1, Purpose::Reflections);
            for i in 0..200 {
                let u = |j| key.with(i).uniform(j);
                let place = DVec2::new(u(0), u(1)) * DVec2::new(780.0, 580.0) + 10.0;
                let pupil = eye.pupil_point(DVec2::new(u(2), u(3)));
                let far = pupil.origin + eye.direction(place, &pupil) * (100.0 + 200.0 * u(4));
                let image = eye.image(far, &pupil).expect("on the sensor");
                assert!(
                    (image.place - place).length() < 1e-6,
                    "{place} {}",
                    image.place
                );
            }
        }
    }
}

#[path = "line_tests.rs"]
mod line;
