//! Tracing only what may see lit surface gives the bytes of tracing everything.

use crate::cameras;
use crate::effort::extent;
use crate::random::Random;
use glam::UVec2;
use lasertrace::accel::{Accel, TriangleClusters};
use lasertrace::camera::{Camera, Distortion};
use lasertrace::frame::{
    DefocusSettings, PixelQuadrature, PoseView, Sampling, Speckle, SpeckleSource, TracedRegion,
    irradiance,
};
use lasertrace::laser::{Beam, CUTOFF_RADII, Fan, FanProfile, Laser};
use lasertrace::math::Aperture;
use lasertrace::math::{Aabb, DVec2, DVec3, Rigid};
use lasertrace::mesh::{self, Mesh, shapes};
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use lasertrace::speckle::frame_field::{FrameFields, PupilPosition};
use lasertrace::speckle::lookup::Coherence;
use lasertrace::speckle::pattern::PatternSpec;
use lasertrace::surface::{Conductor, Ggx, Lambert, Lay, LayeredBrdf, Lobe, Surface};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// All that a view borrows.
struct Setup {
    laser: Laser,
    part_from_laser: Rigid,
    camera: Camera,
    part_from_camera: Rigid,
    samples_per_side: u32,
    sampling: Sampling,
    beam_cutoff_radii: f64,
    speckle: bool,
}

fn camera(resolution: UVec2, pitch: f64, focus_distance: f64, tilt: DVec2) -> Camera {
    let mut camera = cameras::camera();
    camera.sensor.resolution = resolution;
    camera.sensor.pixel_pitch = pitch;
    camera.lens.focus_distance = focus_distance;
    camera.tilt = tilt;
    camera
}

impl Setup {
    /// Laser and camera anywhere, mostly turned towards the part.
    fn random(bounds: &Aabb, random: &mut Random) -> Setup {
        let size = bounds.size().max_element();
        let pose = |random: &mut Random| loop {
            // Now and then amid the part, so that some of it is behind.
            let far = if random.choice(8) == 0 {
                0.3
            } else {
                random.scale(0.7, 10.0)
            };
            let origin = bounds.center() + random.direction() * far * size;
            let target = bounds.center() + random.vector(0.35) * bounds.size();
            let pose = Rigid::from_z_and_x(origin, target - origin, random.direction());
            if let Some(pose) = pose {
                return (pose, (target - origin).length());
            }
        };
        let (part_from_laser, laser_distance) = pose(random);
        let (part_from_camera, camera_distance) = pose(random);
        let fan = match random.choice(3) {
            0 => None,
            kind => Some(Fan {
                angle: random.between(0.02, 2.0),
                profile: [FanProfile::Uniform, FanProfile::Gaussian][kind - 1].clone(),
            }),
        };
        let waist_radius = size * random.scale(1e-3, 0.03);
        let wavelength = 660e-6;
        let beam = Beam {
            wavelength,
            power_mw: 5.0,
            waist_radius,
            waist_distance: laser_distance * random.between(-0.5, 1.5),
            // From a beam that hardly widens to 0.3 rad.
            m_squared: (random.scale(1e-3, 0.3) * waist_radius * std::f64::consts::PI / wavelength)
                .max(1.0),
        };
        let resolution = match random.choice(6) {
            0 => UVec2::new(1, 1),
            1 => UVec2::new(1, 1 + random.choice(90) as u32),
            _ => UVec2::new(1 + random.choice(150) as u32, 1 + random.choice(90) as u32),
        };
        let focus_distance = 25.0 * random.between(1.5, 9.0);
        let image_distance = 25.0 * focus_distance / (focus_distance - 25.0);
        let width = size / camera_distance * image_distance * random.scale(0.3, 3.0);
        // A wide sensor is tilted less: it must stay in front of the lens.
        let most = 0.9 * (image_distance / width).atan();
        let tilt = match random.choice(2) {
            0 => DVec2::ZERO,
            _ => DVec2::new(random.between(-most, most), random.between(-most, most)) * 0.5,
        };
        let pitch = width / resolution.max_element() as f64;
        Setup {
            laser: Laser { beam, fan },
            part_from_laser,
            camera: camera(resolution, pitch, focus_distance, tilt),
            part_from_camera,
            samples_per_side: 1 + random.choice(4) as u32,
            // Mostly as plans have it.
            sampling: match random.choice(4) {
                0 => Sampling::Rays,
                1 => Sampling::PlaneCut,
                _ => Sampling::Planes,
            },
            beam_cutoff_radii: random.between(1.5, CUTOFF_RADII),
            speckle: random.choice(2) == 0,
        }
    }
}

/// The mesh itself is the part.
const UNMOVED: &[Rigid] = &[Rigid::IDENTITY];

/// A part with what is built over it.
struct Part<'m> {
    accel: Accel,
    clusters: TriangleClusters,
    fields: &'m FrameFields,
    surface: Surface,
}

fn fields() -> FrameFields {
    let spec = PatternSpec {
        size: 64,
        texels_per_speckle: 4.0,
        aperture: Aperture::Circle,
        slices: 8,
        seed: 1,
    };
    FrameFields::new(&spec, Coherence::FULL).unwrap()
}

impl<'m> Part<'m> {
    fn new(mesh: &'m Mesh, poses: &[Rigid], fields: &'m FrameFields) -> Part<'m> {
        let accel = Accel::build(&mesh.clone().into(), 1).unwrap();
        Part {
            accel: accel.with_copies(poses).unwrap(),
            clusters: TriangleClusters::new(mesh),
            fields,
            surface: Lambert { reflectance: 0.5 }.into(),
        }
    }

    /// Whether the two images are the same to the bit, and how many pixels are lit.
    fn compare(&self, setup: &Setup) -> (bool, usize) {
        let view = PoseView {
            accel: &self.accel,
            surface: self.surface.clone().into(),
            laser: &setup.laser,
            part_from_laser: setup.part_from_laser,
            camera: &setup.camera,
            part_from_camera: setup.part_from_camera,
            speckle: setup.speckle.then_some(Speckle {
                patterns: SpeckleSource::Frame {
                    fields: self.fields,
                    place: PupilPosition {
                        shift: DVec2::new(5.7, -0.3),
                        defocus: 0.0,
                    },
                },
                map: self.fields.map(2e-4, 60.0),
                displacement: DVec2::new(0.3, -7.0),
                pupil_scale: None,
            }),
            grid: PixelQuadrature::Gauss {
                per_side: setup.samples_per_side,
            },
            sampling: setup.sampling,
            beam_cutoff_radii: setup.beam_cutoff_radii,
            lens: DefocusSettings::NONE,
            indirect: None,
            stop: None,
        };
        same(
            &irradiance(&view, &TracedRegion::All).dense(),
            &irradiance(&view, &TracedRegion::Lit(&self.clusters)).dense(),
        )
    }
}

fn same(all: &[f32], some: &[f32]) -> (bool, usize) {
    let bits = |image: &[f32]| image.iter().map(|e| e.to_bits()).collect::<Vec<_>>();
    (
        bits(all) == bits(some),
        all.iter().filter(|&&e| e != 0.0).count(),
    )
}

/// Loose triangles of very different sizes, slivers among them.
fn soup() -> Mesh {
    let mut random = Random::new(5);
    let mut positions = Vec::new();
    for _ in 0..400 {
        let (at, size) = (random.vector(10.0), random.scale(0.01, 8.0));
        positions.extend((0..3).map(|_| at + random.vector(size)));
    }
    Mesh {
        positions,
        triangles: (0..400).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect(),
    }
}

fn root(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

fn parts() -> Vec<(&'static str, Mesh)> {
    let thin_wall = shapes::step_block(DVec3::new(40.0, 0.05, 15.0), 5.0).unwrap();
    let mut far_off = shapes::sphere(8.0, 0.05).unwrap();
    for p in &mut far_off.positions {
        *p += DVec3::new(3e5, -2e4, 1e3);
    }
    vec![
        (
            "bracket",
            mesh::load(&root("scenes/bracket/bracket.stl"), 1.0).unwrap(),
        ),
        (
            "step block",
            shapes::step_block(DVec3::new(30.0, 20.0, 12.0), 4.0).unwrap(),
        ),
        ("sphere", shapes::sphere(10.0, 0.01).unwrap()),
        ("fine sphere", shapes::sphere(10.0, 2e-4).unwrap()),
        ("cylinder", shapes::cylinder(6.0, 40.0, 0.02).unwrap()),
        ("plane", shapes::plane(DVec2::new(60.0, 40.0)).unwrap()),
        ("thin wall", thin_wall),
        ("far-off sphere", far_off),
        ("soup", soup()),
    ]
}

#[test]
fn random_scenes_are_the_same_to_the_bit() {
    let fields = fields();
    for (i, (name, mesh)) in parts().iter().enumerate() {
        let part = Part::new(mesh, UNMOVED, &fields);
        let (mut lit, mut dark) = (0, 0);
        // Both kinds are among the scenes.
        let [seeds, least_lit, least_dark] = extent([35, 4, 1], [100, 20, 3]);
        for seed in 0..seeds {
            let mut random = Random::new(1000 * i as u64 + seed);
            let (same, pixels) = part.compare(&Setup::random(&part.accel.bounds(), &mut random));
            assert!(same, "{name}, seed {seed}");
            lit += u64::from(pixels > 0);
            dark += u64::from(pixels == 0);
        }
        assert!(
            lit >= least_lit && dark >= least_dark,
            "{name}: {lit} lit, {dark} dark"
        );
    }
}

/// Brushed metal, whose light varies over pixels and over the pupil.
#[test]
fn random_scenes_of_metal_are_the_same_to_the_bit() {
    let fields = fields();
    let facets = Ggx {
        alpha_u: 0.02,
        alpha_v: 0.3,
    };
    let metal = Arc::new(LayeredBrdf {
        lobes: vec![(1.0, Lobe::Metal(Conductor::new(1.66, 7.8, facets)))],
        lay: Some(Lay::About {
            point: DVec3::ZERO,
            axis: DVec3::Z,
        }),
    });
    let mut lit = 0;
    for (i, (name, mesh)) in parts().iter().enumerate() {
        let mut part = Part::new(mesh, UNMOVED, &fields);
        part.surface = Surface::Layered(metal.clone());
        for seed in 0..25 {
            let mut random = Random::new(900_000 + 1000 * i as u64 + seed);
            let (same, pixels) = part.compare(&Setup::random(&part.accel.bounds(), &mut random));
            assert!(same, "{name}, seed {seed}");
            lit += usize::from(pixels > 0);
        }
    }
    assert!(lit >= 45, "{lit} lit");
}

/// Copies of each part, turned any way, that lie apart, touch and stand in each other.
#[test]
fn random_scenes_of_assemblies_are_the_same_to_the_bit() {
    let fields = fields();
    for (i, (name, mesh)) in parts().iter().enumerate() {
        let mut lit = 0;
        let [seeds, least_lit] = extent([20, 5], [60, 15]);
        for seed in 0..seeds {
            let mut random = Random::new(500_000 + 1000 * i as u64 + seed);
            let (count, width) = (1 + random.choice(30), random.scale(0.3, 20.0));
            let bounds = mesh.bounds();
            let poses = (0..count).map(|_| {
                let turn = Rigid::from_euler_xyz(random.vector(3.0), DVec3::ZERO);
                let middle = random.vector(width * bounds.size().max_element());
                Rigid {
                    translation: middle - turn.point(bounds.center()),
                    ..turn
                }
            });
            let poses: Vec<Rigid> = poses.collect();
            let part = Part::new(mesh, &poses, &fields);
            // At one of the copies.
            let aim = bounds.moved(&poses[random.choice(count)]);
            let (same, pixels) = part.compare(&Setup::random(&aim, &mut random));
            assert!(same, "{name}, seed {seed}");
            lit += u64::from(pixels > 0);
        }
        assert!(lit >= least_lit, "{name}: {lit} lit");
    }
}

/// The strongest of these distortions move the sensor's corner by half its distance
/// from the axis; those that fold are not made.
#[test]
fn scenes_seen_through_a_distorting_lens_are_the_same_to_the_bit() {
    let fields = fields();
    for (i, (name, mesh)) in parts().iter().enumerate() {
        let part = Part::new(mesh, UNMOVED, &fields);
        let mut lit = 0;
        for seed in 0..90 {
            let mut random = Random::new(1000 * i as u64 + seed);
            let mut setup = Setup::random(&part.accel.bounds(), &mut random);
            let reach = setup.camera.model().reach().unwrap();
            let strength = random.scale(1e-3, 1.0);
            let distortion = loop {
                let mut share =
                    |power: i32| random.between(-0.3, 0.3) * strength / reach.powi(power);
                let radial = [share(2), share(4), share(6)];
                let tangential = [share(1) * 0.1, share(1) * 0.1];
                if let Ok(distortion) = Distortion::new(radial, tangential, reach) {
                    break distortion;
                }
            };
            setup.camera.lens.distortion = Some(distortion);
            let (same, pixels) = part.compare(&setup);
            assert!(same, "{name}, seed {seed}");
            lit += usize::from(pixels > 0);
        }
        assert!(lit >= 15, "{name}: {lit} lit");
    }
}

/// A camera that looks along a plane 90° to 0.001° from edge-on, and along a face
/// of the step block, with the line across the view and along it.
#[test]
fn surfaces_seen_grazing_are_the_same_to_the_bit() {
    let fields = fields();
    let plane = shapes::plane(DVec2::new(60.0, 40.0)).unwrap();
    let block = shapes::step_block(DVec3::new(30.0, 20.0, 12.0), 4.0).unwrap();
    for (mesh, top) in [(&plane, 0.0), (&block, 12.0)] {
        let part = Part::new(mesh, UNMOVED, &fields);
        let target = DVec3::new(5.0, 0.3, top);
        for degrees in [90.0f64, 30.0, 3.0, 0.3, 0.03, 0.003, 0.001] {
            for (line, kind) in [(DVec3::X, 0), (DVec3::Y, 1), (DVec3::new(1.0, 0.3, 0.0), 2)] {
                let (sin, cos) = degrees.to_radians().sin_cos();
                let eye = target + DVec3::new(0.0, -cos, sin) * 120.0;
                let above = target + DVec3::new(1.0, 2.0, 90.0);
                let setup = Setup {
                    laser: Laser {
                        beam: Beam {
                            wavelength: 660e-6,
                            power_mw: 5.0,
                            waist_radius: 0.1,
                            waist_distance: 80.0,
                            m_squared: 1.5,
                        },
                        fan: [FanProfile::Uniform, FanProfile::Gaussian]
                            .get(kind)
                            .map(|profile| Fan {
                                angle: 0.4,
                                profile: profile.clone(),
                            }),
                    },
                    part_from_laser: Rigid::from_z_and_x(above, target - above, line).unwrap(),
                    camera: camera(UVec2::new(161, 67), 0.05, 120.0, DVec2::new(0.2, 0.0)),
                    part_from_camera: Rigid::from_z_and_x(eye, target - eye, DVec3::X).unwrap(),
                    samples_per_side: 2,
                    sampling: Sampling::Planes,
                    beam_cutoff_radii: CUTOFF_RADII,
                    speckle: false,
                };
                let (same, lit) = part.compare(&setup);
                assert!(same, "{degrees}° {line}");
                // Foreshortened to less than a sample a line may be missed.
                assert!(lit > 0 || degrees < 30.0, "{degrees}° {line}: dark");
            }
        }
    }
}

#[test]
fn frames_of_the_bracket_scene_are_the_same_to_the_bit() {
    let scene = Scene::load(&root("scenes/bracket/scene.toml")).unwrap();
    let footprint = Simulation::new(&scene).unwrap();
    let exhaustive = Simulation::exhaustive(&scene).unwrap();
    for frame in [20, 55, 110, 170, 218] {
        let (same, lit) = same(
            &exhaustive.irradiance(frame).dense(),
            &footprint.irradiance(frame).dense(),
        );
        // The last frame is past the part.
        assert!(
            same && (lit > 1000 || frame == 218),
            "frame {frame}, {lit} lit"
        );
    }
}

/// Parts from elsewhere, as far as they are on this machine.
#[test]
fn random_scenes_of_real_parts_are_the_same_to_the_bit() {
    let folder = root("../shared/data/meshes");
    let Ok(entries) = folder.read_dir() else {
        eprintln!("NOT TESTED: no real parts at {}", folder.display());
        return;
    };
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    let fields = fields();
    let (mut parts, mut lit) = (0, 0);
    for path in paths {
        let Ok(mesh) = mesh::load(&path, 1.0) else {
            continue;
        };
        parts += 1;
        let part = Part::new(&mesh, UNMOVED, &fields);
        for seed in 0..12 {
            let mut random = Random::new(900_000 + seed);
            let (same, pixels) = part.compare(&Setup::random(&part.accel.bounds(), &mut random));
            assert!(same, "{}, seed {seed}", path.display());
            lit += usize::from(pixels > 0);
        }
    }
    assert!(parts > 0 && lit > parts, "{parts} parts, {lit} lit views");
}
