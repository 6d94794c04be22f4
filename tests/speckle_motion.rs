//! How patterns of rendered frames move and change from frame to frame, at several
//! windows of the sensor, against waves with exact paths.

use glam::DQuat;
use lasertrace::batch::Simulation;
use lasertrace::math::rng::{Key, Purpose};
use lasertrace::math::{DMat3, DVec2, DVec3, Rigid};
use lasertrace::scene::Scene;
use lasertrace::speckle::motion::{Motion, Source, SurfaceView};
use lasertrace::speckle::wave_motion::{MotionCase, MotionRow, WaveSampling, measure_motions};

const WAVELENGTH: f64 = 660e-6;
/// Pixels a grain.
const PIXELS: f64 = 4.0;

/// How the part moves from frame to frame, in the world.
#[derive(Debug, Clone, Copy)]
enum Step {
    Way(DVec3),
    Turn {
        point: DVec3,
        axis: DVec3,
        degrees: f64,
    },
}

/// A plane through the origin, lit from a point and seen by a camera that looks at the
/// origin.
#[derive(Debug, Clone, Copy)]
struct Geometry {
    /// Turns of the plane about x, y, z.
    part_deg: [f64; 3],
    laser: DVec3,
    camera: DVec3,
    /// Direction that the sensor's columns show.
    columns: DVec3,
    focal_length: f64,
    f_number: f64,
    focus: f64,
    step: Step,
    resolution: [usize; 2],
}

impl Geometry {
    fn magnification(&self) -> f64 {
        self.focal_length / (self.focus - self.focal_length)
    }

    fn pupil(&self) -> f64 {
        self.focal_length / self.f_number
    }

    fn pitch(&self) -> f64 {
        WAVELENGTH * self.magnification() * self.focus / self.pupil() / PIXELS
    }

    fn normal(&self) -> DVec3 {
        let angles = DVec3::from(self.part_deg).map(f64::to_radians);
        Rigid::from_euler_xyz(angles, DVec3::ZERO).vector(DVec3::Z)
    }

    fn scene(&self, speckle: bool) -> Scene {
        let vector = |v: DVec3| format!("[{:?}, {:?}, {:?}]", v.x, v.y, v.z);
        let scan = match self.step {
            Step::Way(way) => format!("direction = {}\nstep_mm = {:?}", vector(way), way.length()),
            Step::Turn {
                point,
                axis,
                degrees,
            } => format!(
                "rotary = {{ axis_point_mm = {}, axis_direction = {}, step_deg = {degrees:?} }}",
                vector(point),
                vector(axis)
            ),
        };
        let text = format!(
            r#"
seed = 3
speckle = {speckle}
[part]
plane = {{ size_mm = [60, 60] }}
reflectance = 0.6
rotation_deg = {:?}
[laser]
wavelength_nm = 660
power_mw = 20
waist_radius_um = 5
waist_distance_mm = 0
position_mm = {}
direction = {}
[camera]
focal_length_mm = {:?}
f_number = {:?}
focus_distance_mm = {:?}
resolution_px = {:?}
pixel_pitch_um = {:?}
position_mm = {}
look_at_mm = [0, 0, 0]
columns = {}
exposure_ms = 0.05
quantum_efficiency = 0.5
gain_dn_per_e = 0.2
bit_depth = 16
full_well_e = 300000
[scan]
moves = "part"
frames = 3
{scan}
"#,
            self.part_deg,
            vector(self.laser),
            vector(-self.laser),
            self.focal_length,
            self.f_number,
            self.focus,
            self.resolution,
            self.pitch() * 1e3,
            vector(self.camera),
            vector(self.columns),
        );
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.toml");
        std::fs::write(&path, text).unwrap();
        Scene::load(&path).unwrap()
    }

    /// Point of the plane that the pixel sees in the world.
    fn seen(&self, scene: &Scene, pixel: DVec2) -> DVec3 {
        let direction = (scene.head_from_camera).vector(scene.camera.direction(pixel));
        let normal = self.normal();
        self.camera - direction * (normal.dot(self.camera) / normal.dot(direction))
    }

    /// Step of the part at a point.
    fn motion(&self, point: DVec3) -> Motion {
        match self.step {
            Step::Way(part) => Motion {
                part,
                ..Motion::default()
            },
            Step::Turn {
                point: pivot,
                axis,
                degrees,
            } => {
                let rotation = axis.normalize() * degrees.to_radians();
                let turned = DMat3::from_quat(DQuat::from_scaled_axis(rotation));
                Motion {
                    part: turned * (point - pivot) + pivot - point,
                    rotation,
                    ..Motion::default()
                }
            }
        }
    }

    fn case(&self, scene: &Scene, pixel: DVec2) -> MotionCase {
        let point = self.seen(scene, pixel);
        MotionCase {
            name: format!("{pixel}"),
            view: SurfaceView {
                point,
                normal: self.normal(),
                source: Source::Point(self.laser),
                pupil_centre: self.camera,
                pupil_diameter: self.pupil(),
                image_x: scene.head_from_camera.rotation.x_axis,
                focus_distance: self.focus,
                magnification: self.magnification(),
            },
            motion: self.motion(point),
        }
    }
}

/// A frame's speckle, mean 1.
struct Image {
    values: Vec<f64>,
    width: usize,
}

fn images(geometry: &Geometry, frames: &[u32], slips: Option<bool>) -> (Scene, Vec<Image>) {
    let (scene, plain) = (geometry.scene(true), geometry.scene(false));
    let with = Simulation::new(&scene).unwrap();
    println!("{:?}", with.plan.effects.last());
    let without = Simulation::new(&plain).unwrap();
    let image = |&frame: &u32| {
        let (a, b) = (
            with.irradiance(frame).dense(),
            without.irradiance(frame).dense(),
        );
        let values = a.iter().zip(&b).map(|(a, b)| *a as f64 / *b as f64);
        Image {
            values: values.collect(),
            width: geometry.resolution[0],
        }
    };
    let images = frames.iter().map(image).collect();
    drop(with);
    (scene, images)
}

/// Covariance of `a` around `centre` (so many pixels to each side) with `b` so much
/// further.
fn covariance(a: &Image, b: &Image, centre: [i64; 2], half: i64, lag: [i64; 2]) -> f64 {
    let (mut sum, mut sums) = (0.0, [0.0; 2]);
    let n = (2 * half + 1).pow(2) as f64;
    for y in centre[1] - half..=centre[1] + half {
        for x in centre[0] - half..=centre[0] + half {
            let p = a.values[y as usize * a.width + x as usize];
            let q = b.values[(y + lag[1]) as usize * b.width + (x + lag[0]) as usize];
            sum += p * q;
            sums[0] += p;
            sums[1] += q;
        }
    }
    sum / n - sums[0] * sums[1] / (n * n)
}

/// Displacement (pixels) of the highest correlation, and that.
fn moved(a: &Image, b: &Image, centre: [i64; 2], half: i64, near: DVec2) -> (DVec2, f64) {
    let start = [near.x.round() as i64, near.y.round() as i64];
    let at = |lag: [i64; 2]| covariance(a, b, centre, half, lag);
    let lags = (-4..=4).flat_map(|y| (-4..=4).map(move |x| [start[0] + x, start[1] + y]));
    let (top, best) = lags
        .map(|lag| (at(lag), lag))
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .unwrap();
    let vertex = |axis: usize| {
        let by = |step: i64| {
            let mut lag = best;
            lag[axis] += step;
            at(lag)
        };
        let (low, high) = (by(-1), by(1));
        let bend = low + high - 2.0 * top;
        let x = 0.5 * (low - high) / bend;
        (x, -0.125 * (low - high).powi(2) / bend)
    };
    let ((x, up), (y, more)) = (vertex(0), vertex(1));
    let there = [centre[0] + best[0], centre[1] + best[1]];
    let variance = covariance(a, a, centre, half, [0, 0]) * covariance(b, b, there, half, [0, 0]);
    let place = DVec2::new(best[0] as f64 + x, best[1] as f64 + y);
    (place, (top + up + more) / variance.sqrt())
}

fn show(name: &str, geometry: &Geometry) {
    let (scene, images) = images(geometry, &[0, 1, 2], None);
    let [w, h] = geometry.resolution.map(|n| n as i64);
    let half = 60;
    for centre in [
        [w / 2, h / 2],
        [half + 25, h / 2],
        [w - half - 25, h / 2],
        [w / 2, half + 25],
        [w / 2, h - half - 25],
    ] {
        let pixel = DVec2::new(centre[0] as f64 + 0.5, centre[1] as f64 + 0.5);
        let case = geometry.case(&scene, pixel);
        let shift = lasertrace::speckle::motion::speckle_shift(&case.view, &case.motion);
        let phase =
            lasertrace::speckle::motion::defocus_phase(&case.view, &case.motion, WAVELENGTH);
        let law = lasertrace::speckle::motion::overlap_correlation_defocused(shift.delta, phase);
        let expected = DVec2::new(shift.sensor.x, -shift.sensor.y) / geometry.pitch();
        let (found, gamma) = moved(&images[0], &images[1], centre, half, expected);
        let (found2, gamma2) = moved(&images[1], &images[2], centre, half, expected);
        println!(
            "{name} {centre:?}: {found:.2} {found2:.2} for {expected:.2}; gamma {gamma:.3} {gamma2:.3} for {law:.3} ({:.3} {phase:.2})",
            shift.delta
        );
    }
}

#[test]
fn look() {
    let axial = Geometry {
        part_deg: [0.0, 15.0, 0.0],
        laser: DVec3::new(85.505, 0.0, 234.923),
        camera: DVec3::new(58.8524, 161.69566, 245.7456),
        columns: DVec3::new(-0.925185, -0.1750385, 0.33674),
        focal_length: 50.0,
        f_number: 5.0,
        focus: 300.0,
        step: Step::Way(DVec3::new(0.1961747, 0.5389855, 0.819152) * 0.406),
        resolution: [500, 400],
    };
    show("axial", &axial);
    let rotz = Geometry {
        step: Step::Turn {
            point: DVec3::new(8.0, 3.0, 0.0),
            axis: DVec3::Z,
            degrees: 0.1,
        },
        ..axial
    };
    show("rotz", &rotz);
    let near = Geometry {
        focus: 290.0,
        ..axial
    };
    show("axial near", &near);
    let far = Geometry {
        focus: 315.0,
        ..axial
    };
    show("axial far", &far);
    let defocus = Geometry {
        part_deg: [10.0, -12.0, 30.0],
        laser: DVec3::new(-115.70177, 0.0, 137.888),
        camera: DVec3::new(-28.90879, 79.42625, 181.261557),
        columns: DVec3::new(-0.4932879, 0.7650746, -0.41391770),
        focal_length: 35.0,
        f_number: 5.8333333,
        focus: 190.0,
        step: Step::Turn {
            point: DVec3::new(0.0, 0.02, 0.0),
            axis: DVec3::new(1.0, -0.4, 0.3),
            degrees: 0.12,
        },
        resolution: [500, 400],
    };
    show("rot_defocus", &defocus);
    show(
        "rot_defocus far",
        &Geometry {
            focus: 212.0,
            ..defocus
        },
    );
}
