//! Light of glossy surfaces in images: over a pixel, over the pupil, and out of focus.

use crate::cameras;
use glam::UVec2;
use lasertrace::accel::{Accel, TriangleClusters};
use lasertrace::camera::Camera;
use lasertrace::frame::{
    Blur, DefocusSettings, PixelQuadrature, PoseView, Sampling, TracedRegion, irradiance,
};
use lasertrace::laser::{Beam, CUTOFF_RADII, Fan, FanProfile, Laser};
use lasertrace::math::{Aperture, DVec2, DVec3, Rigid};
use lasertrace::mesh::{Mesh, shapes};
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use lasertrace::surface::{Conductor, Ggx, Lambert, Lay, LayeredBrdf, Lobe, Surface};
use std::path::Path;
use std::sync::Arc;

fn metal(along: f64, across: f64) -> Surface {
    let lobe = Lobe::Metal(Conductor::new(
        1.6575,
        9.2238,
        Ggx {
            alpha_u: along,
            alpha_v: across,
        },
    ));
    Surface::Layered(Arc::new(LayeredBrdf {
        lobes: vec![(1.0, lobe)],
        lay: Some(Lay::Along(DVec3::X)),
    }))
}

/// A sheet from above on a part, seen from 45° at 150 mm.
struct Setup {
    mesh: Mesh,
    laser: Laser,
    camera: Camera,
    /// Degrees from the sheet to the camera, at −y.
    triangulation: f64,
}

impl Setup {
    fn new(mesh: Mesh, f_number: f64) -> Setup {
        let mut camera = cameras::camera();
        camera.lens.focal_length = 50.0;
        camera.lens.focus_distance = 150.0;
        camera.lens.f_number = f_number;
        camera.sensor.resolution = UVec2::new(64, 300);
        camera.sensor.pixel_pitch = 0.005;
        let beam = Beam {
            wavelength: 660e-6,
            power_mw: 5.0,
            waist_radius: 0.03,
            waist_distance: 150.0,
            m_squared: 1.0,
        };
        let fan = Fan {
            angle: 0.1,
            profile: FanProfile::Uniform,
        };
        Setup {
            mesh,
            laser: Laser {
                beam,
                fan: Some(fan),
            },
            camera,
            triangulation: 45.0,
        }
    }

    fn eye(&self) -> DVec3 {
        let (sin, cos) = self.triangulation.to_radians().sin_cos();
        DVec3::new(0.0, -sin, cos) * 150.0
    }

    fn image(&self, surface: &Surface, sampling: Sampling, blur: Blur, per_side: u32) -> Vec<f32> {
        let accel = Accel::build(&self.mesh.clone().into(), 1).unwrap();
        let clusters = TriangleClusters::new(&self.mesh);
        let looking = |from: DVec3| Rigid::from_z_and_x(from, -from, DVec3::X).unwrap();
        let view = PoseView {
            accel: &accel,
            surface: surface.clone().into(),
            laser: &self.laser,
            part_from_laser: looking(DVec3::Z * 150.0),
            camera: &self.camera,
            part_from_camera: looking(self.eye()),
            speckle: None,
            grid: PixelQuadrature::Gauss { per_side },
            sampling,
            beam_cutoff_radii: CUTOFF_RADII,
            lens: DefocusSettings {
                blur,
                reach: if blur == Blur::None { 0 } else { 128 },
                line_sigma: 1.0,
                narrowest_sigma: 1.0,
            },
            indirect: None,
            stop: None,
        };
        let lit = irradiance(&view, &TracedRegion::Lit(&clusters)).dense();
        assert!(lit == irradiance(&view, &TracedRegion::All).dense());
        lit
    }

    /// Centroid (row) and sum of the light in the middle column, of 20 rows to either side of the centroid: the
    /// tails of diffraction fall as 1/x², so that a window to one side of a line would pull its centroid.
    fn line(&self, image: &[f32]) -> (f64, f64) {
        let columns = self.camera.sensor.resolution.x as usize;
        let column: Vec<f32> = image
            .iter()
            .skip(columns / 2)
            .step_by(columns)
            .copied()
            .collect();
        let (mut centre, mut half) = (150.0, 150.0);
        for _ in 0..100 {
            let (mut sum, mut first) = (0.0, 0.0);
            for (row, &e) in column.iter().enumerate() {
                let from = (row as f64).max(centre - half);
                let to = (row as f64 + 1.0).min(centre + half);
                let light = e as f64 * (to - from).max(0.0);
                sum += light;
                first += light * (from + to) / 2.0;
            }
            let last = std::mem::replace(&mut centre, first / sum);
            if half == 20.0 && (centre - last).abs() < 1e-6 {
                return (centre, sum);
            }
            half = 20.0;
        }
        panic!("no line")
    }
}

fn moved(mut mesh: Mesh, z: f64) -> Mesh {
    mesh.positions.iter_mut().for_each(|p| p.z += z);
    mesh
}

/// A plane in the part's xy plane, moved along z.
fn plane(z: f64) -> Mesh {
    moved(shapes::plane(DVec2::splat(30.0)).unwrap(), z)
}

/// One ray a pixel is trusted where the lobe is even over it, and is what many rays have: to the
/// 1 % by which the lobe may vary over a pixel, in places; and where the lobe is too narrow, or the part curved,
/// each sample has its ray, and images are the same.
#[test]
fn one_ray_is_trusted_as_far_as_the_lobe_is_even() {
    let both = |setup: &Setup, surface: &Surface| {
        [Sampling::Planes, Sampling::Rays]
            .map(|sampling| setup.image(surface, sampling, Blur::None, 3))
    };
    let mut setup = Setup::new(plane(0.0), 8.0);
    // The sheet mirrored into the camera: the peak of the lobe.
    for triangulation in [45.0, 3.0] {
        setup.triangulation = triangulation;
        for (along, across) in [(0.3, 0.3), (0.05, 0.05), (0.02, 0.3)] {
            let [planes, rays] = both(&setup, &metal(along, across));
            let brightest = rays.iter().copied().fold(0.0, f32::max);
            for (a, b) in planes.iter().zip(&rays) {
                assert!((a - b).abs() <= 0.01 * b + 1e-5 * brightest, "{a} {b}");
            }
            assert!(planes != rays);
        }
    }
    setup.triangulation = 3.0;
    let [planes, rays] = both(&setup, &metal(0.01, 0.01));
    assert!(planes == rays && rays.iter().any(|&e| e > 0.0));
    // Facets that for paint are one plane are not for a lobe of half a degree.
    let curved = Setup {
        mesh: moved(shapes::sphere(8.0, 1e-4).unwrap(), -8.0),
        ..Setup::new(plane(0.0), 8.0)
    };
    let [planes, rays] = both(&curved, &metal(0.01, 0.01));
    assert!(planes == rays && rays.iter().any(|&e| e > 0.0));
    let [planes, rays] = both(&curved, &Lambert { reflectance: 0.5 }.into());
    assert!(planes != rays);
}

/// A camera almost in the mirrored beam's way, whose pupil is wider than the lobe: the light is the mean over the
/// pupil, by a fine even grid over it here, and not what its middle has.
#[test]
fn a_lobe_narrower_than_the_pupil_is_averaged_over_it() {
    for aperture in [Aperture::Circle, Aperture::Square, Aperture::Ellipse(0.4)] {
        let mut setup = Setup::new(plane(0.0), 2.8);
        setup.camera.lens.aperture = aperture;
        setup.triangulation = 4.0;
        let facets = Ggx {
            alpha_u: 0.02,
            alpha_v: 0.02,
        };
        let narrow = Conductor::new(1.6575, 9.2238, facets);
        let (_, metal_light) =
            setup.line(&setup.image(&metal(0.02, 0.02), Sampling::Rays, Blur::None, 3));
        let (_, paint) = setup.line(&setup.image(
            &Lambert { reflectance: 1.0 }.into(),
            Sampling::Rays,
            Blur::None,
            3,
        ));
        let eye = setup.eye();
        let side = DVec3::X;
        let up = side.cross(eye.normalize());
        let radius = setup.camera.lens.pupil_diameter() / 2.0;
        let steps = 400;
        let (mut sum, mut count) = (0.0, 0.0);
        for k in 0..steps * steps {
            let at = |k: usize| 2.0 * (k as f64 + 0.5) / steps as f64 - 1.0;
            let u = DVec2::new(at(k % steps), at(k / steps));
            let inside = match aperture {
                Aperture::Square => true,
                _ => u.length() <= 1.0,
            };
            if inside {
                let from = eye + (side * u.x + up * u.y * aperture.ratio()) * radius;
                sum += narrow.bsdf(DVec3::Z, from.normalize());
                count += 1.0;
            }
        }
        let expected = sum / count * std::f64::consts::PI;
        let found = metal_light / paint;
        // The line is 30 µm wide: over it directions turn by 1/100 of the lobe and less, and that cancels but for
        // its square; a rule good to 1e-4, and a grid of 400 steps with a ragged rim, 1e-3.
        assert!(
            (found / expected - 1.0).abs() < 4e-3,
            "{aperture:?} {found} {expected}"
        );
        let middle = narrow.bsdf(DVec3::Z, eye.normalize()) * std::f64::consts::PI;
        assert!(
            (middle / expected - 1.0).abs() > 0.05,
            "{middle} {expected}"
        );
    }
}

/// Out of focus, a lobe that sends more light through one side of the pupil moves the line's centroid by
/// (b/2)·⟨u⟩ (Seitz & Tiziani 1993), in the direction in which light through that side falls beside the rest.
#[test]
fn gloss_moves_a_line_that_is_out_of_focus() {
    for (z, f_number) in [(-2.0, 4.0), (-1.0, 4.0), (1.0, 4.0), (2.0, 4.0), (2.0, 8.0)] {
        let setup = Setup::new(plane(z), f_number);
        let facets = Ggx {
            alpha_u: 0.2,
            alpha_v: 0.2,
        };
        let centroid = |surface: &Surface, blur| {
            setup
                .line(&setup.image(surface, Sampling::Planes, blur, 3))
                .0
        };
        let of = |surface: &Surface| centroid(surface, Blur::Mean) - centroid(surface, Blur::None);
        // What blur moves for other reasons (its tilt over the line) paint has as well.
        let found = of(&metal(0.2, 0.2)) - of(&Lambert { reflectance: 0.5 }.into());
        // To first order the pupil is filled as 1 + g·X, X in mm: ⟨X⟩ = g·D²/16.
        let eye = setup.eye();
        let point = DVec3::Z * z;
        let up = DVec3::X.cross(eye.normalize());
        let lobe = Conductor::new(1.6575, 9.2238, facets);
        let through = |x: f64| lobe.bsdf(DVec3::Z, (eye + up * x - point).normalize()).ln();
        let slope = (through(0.5) - through(-0.5)) / 1.0;
        let lens = &setup.camera.lens;
        let middle = slope * lens.pupil_diameter().powi(2) / 16.0;
        // Similar triangles: from ⟨X⟩ through the point to the plane in focus, and from there through
        // the pupil's middle to the sensor, whose rows rise with `down`.
        let axis = -eye.normalize();
        let distance = axis.dot(point - eye);
        let beside = middle * (1.0 - lens.focus_distance / distance);
        let magnification = lens.image_distance() / lens.focus_distance;
        let rows_along_up = axis.cross(DVec3::X).dot(up);
        let expected = beside * magnification / setup.camera.sensor.pixel_pitch * rows_along_up;
        println!("{z} mm, f/{f_number}: {found:.4} px, closed form {expected:.4}");
        assert!(found.abs() > 0.02, "{found}");
        assert!(
            (found / expected - 1.0).abs() < 0.05,
            "{z} f/{f_number}: {found} {expected}"
        );
    }
}

/// What scenes/metal must give: aluminium 3 mm nearer than the focus is measured where the ray taken for the chief
/// ray, which passes (L_o/L_f − 1)·⟨X⟩ beside the line, meets the laser's plane; paint where it is.
#[test]
fn the_metal_scene_has_its_bias() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/metal");
    let text = std::fs::read_to_string(folder.join("scene.toml")).unwrap();
    let mean = |text: &str| {
        let scene = Scene::parse(text, &folder).unwrap();
        let simulation = Simulation::new(&scene).unwrap();
        let of = |frame| simulation.measure(frame, &simulation.image(frame)).1;
        let points: Vec<_> = (0..scene.scan.frames).flat_map(of).collect();
        assert!(points.len() > 1500, "{}", points.len());
        let heights = points.iter().map(|p| p.position.z * 1e3);
        heights.sum::<f64>() / points.len() as f64
    };
    let facets = Ggx {
        alpha_u: 0.2,
        alpha_v: 0.2,
    };
    // Aluminium at 660 nm, between Rakić's values at 652.25 and 688.81.
    let lobe = Conductor::new(1.627, 7.804, facets);
    let eye = DVec3::new(0.0, -106.066017, 106.066017);
    let point = DVec3::Z * 3.0;
    let up = DVec3::X.cross(eye.normalize());
    let through = |x: f64| lobe.bsdf(DVec3::Z, (eye + up * x - point).normalize()).ln();
    let slope = through(0.5) - through(-0.5);
    let middle = slope * 12.5f64.powi(2) / 16.0;
    let distance = (eye - point).dot(eye.normalize());
    let beside = point + up * (middle * (distance / 150.0 - 1.0));
    let along = (beside - eye) * (-eye.y / (beside.y - eye.y));
    let expected = (eye.z + along.z - point.z) * 1e3;
    let found = mean(&text);
    println!("aluminium: {found:.2} µm, by the closed form {expected:.2} µm");
    let surface = "[part.surface]\nmetal = { name = \"aluminium\", roughness = 0.2 }\n";
    let paint = text
        .replace(surface, "")
        .replace("[part]\n", "[part]\nreflectance = 0.5\n");
    let paint = mean(&paint);
    println!("paint: {paint:.2} µm");
    assert!((found / expected - 1.0).abs() < 0.05, "{found} {expected}");
    assert!(paint.abs() < 0.5, "{paint}");
}
