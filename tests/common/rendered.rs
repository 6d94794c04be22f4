//! Rendered frames of a plane that moves, and how their speckle correlates.

use glam::DQuat;
use lasertrace::frame::Blur;
use lasertrace::math::{DMat3, DVec2, DVec3, Rigid};
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use lasertrace::speckle::motion::{RigidMotion, Source, SurfaceView};
use lasertrace::wave::motion::MotionCase;

pub const WAVELENGTH: f64 = 660e-6;
/// Pixels a grain.
pub const PIXELS: f64 = 4.0;

/// How the part moves from frame to frame, in the world.
#[derive(Debug, Clone, Copy)]
pub enum Step {
    Way(DVec3),
    Turn {
        point: DVec3,
        axis: DVec3,
        degrees: f64,
    },
}

impl Step {
    pub fn times(self, times: f64) -> Step {
        match self {
            Step::Way(way) => Step::Way(way * times),
            Step::Turn {
                point,
                axis,
                degrees,
            } => Step::Turn {
                point,
                axis,
                degrees: degrees * times,
            },
        }
    }
}

/// A plane through the origin, lit from a point and seen by a camera that looks at the
/// origin.
#[derive(Debug, Clone, Copy)]
pub struct Geometry {
    /// Turns of the plane about x, y, z.
    pub part_deg: [f64; 3],
    pub laser: DVec3,
    pub camera: DVec3,
    /// Direction that the sensor's columns show.
    pub columns: DVec3,
    pub focal_length: f64,
    pub f_number: f64,
    pub focus: f64,
    /// From the first to the last frame.
    pub step: Step,
    /// Frames after the first in which the part goes so far; by more than one the scene
    /// leaves it to the plan whether patterns slip.
    pub frames_apart: u32,
    pub resolution: [i64; 2],
}

impl Geometry {
    pub fn magnification(&self) -> f64 {
        self.focal_length / (self.focus - self.focal_length)
    }

    pub fn pupil(&self) -> f64 {
        self.focal_length / self.f_number
    }

    pub fn pitch(&self) -> f64 {
        WAVELENGTH * self.magnification() * self.focus / self.pupil() / PIXELS
    }

    pub fn normal(&self) -> DVec3 {
        let angles = DVec3::from(self.part_deg).map(f64::to_radians);
        Rigid::from_euler_xyz(angles, DVec3::ZERO).vector(DVec3::Z)
    }

    /// The part's way, as keys of the scene.
    fn scan(&self) -> String {
        let vector = |v: DVec3| format!("[{:?}, {:?}, {:?}]", v.x, v.y, v.z);
        let each = 1.0 / self.frames_apart as f64;
        match self.step {
            Step::Way(way) => {
                let length = way.length() * each;
                format!("direction = {}\nstep_mm = {length:?}", vector(way))
            }
            Step::Turn {
                point,
                axis,
                degrees,
            } => format!(
                "rotary = {{ axis_point_mm = {}, axis_direction = {}, step_deg = {:?} }}",
                vector(point),
                vector(axis),
                degrees * each
            ),
        }
    }

    pub fn scene(&self, speckle: bool) -> Scene {
        let vector = |v: DVec3| format!("[{:?}, {:?}, {:?}]", v.x, v.y, v.z);
        // Named, as the plan leaves out what changes correlations by little.
        let slips = speckle && self.frames_apart == 1;
        let plan = ["", "[model]\nlocal_speckle_motion = true"][usize::from(slips)];
        let (frames, scan) = (self.frames_apart + 2, self.scan());
        let text = format!(
            r#"
seed = 3
speckle = {speckle}
{plan}
[part]
plane = {{ size_mm = [160, 160] }}
reflectance = 0.6
rotation_deg = {:?}
[laser]
wavelength_nm = 660
power_mw = 20
waist_radius_um = 1
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
column_axis = {}
exposure_ms = 0.05
quantum_efficiency = 0.5
gain_dn_per_e = 0.2
bit_depth = 16
full_well_e = 300000
[scan]
moving_body = "part"
frames = {frames}
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
    pub fn seen(&self, scene: &Scene, pixel: DVec2) -> DVec3 {
        let direction = (scene.head_from_camera).vector(scene.camera.direction(pixel));
        let normal = self.normal();
        self.camera - direction * (normal.dot(self.camera) / normal.dot(direction))
    }

    /// Step of the part at a point.
    pub fn motion(&self, point: DVec3) -> RigidMotion {
        match self.step {
            Step::Way(part) => RigidMotion {
                part,
                ..RigidMotion::default()
            },
            Step::Turn {
                point: pivot,
                axis,
                degrees,
            } => {
                let rotation = axis.normalize() * degrees.to_radians();
                let turned = DMat3::from_quat(DQuat::from_scaled_axis(rotation));
                RigidMotion {
                    part: turned * (point - pivot) + pivot - point,
                    rotation,
                    ..RigidMotion::default()
                }
            }
        }
    }

    pub fn resolution_middle(&self) -> DVec2 {
        DVec2::from(self.resolution.map(|n| n as f64 / 2.0))
    }

    pub fn case(&self, scene: &Scene, pixel: DVec2) -> MotionCase {
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

/// Light of a frame with speckle over that without.
pub struct Image {
    pub values: Vec<f64>,
    pub width: i64,
}

impl Image {
    /// Mean, and standard deviation over it.
    pub fn moments(&self) -> (f64, f64) {
        let n = self.values.len() as f64;
        let mean = self.values.iter().sum::<f64>() / n;
        let square = self.values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n;
        (mean, square.sqrt() / mean)
    }
}

pub fn images(geometry: &Geometry, frames: [u32; 2], blur: Blur) -> [Image; 2] {
    images_of(|speckle| geometry.scene(speckle), frames, blur)
}

/// Those of a scene with and without speckle.
pub fn images_of(scene: impl Fn(bool) -> Scene, frames: [u32; 2], blur: Blur) -> [Image; 2] {
    let [with, without] = [true, false].map(|speckle| {
        let mut scene = scene(speckle);
        scene.methods.defocus_model = Some(blur).filter(|_| speckle);
        let simulation = Simulation::new(&scene).unwrap();
        frames.map(|frame| simulation.irradiance(frame).dense())
    });
    let width = scene(false).camera.sensor.resolution.x as i64;
    [0, 1].map(|k| {
        let both = with[k].iter().zip(&without[k]);
        Image {
            values: both.map(|(a, b)| *a as f64 / *b as f64).collect(),
            width,
        }
    })
}

/// Pixels from the middle of a window to its sides, and blocks along a side.
pub const HALF: i64 = 60;
const BLOCKS: i64 = 4;

/// Sums over a block of p, q, p², q², p·q.
type Sums = [f64; 5];

/// Sums over each block of `a`'s window around `centre` and `b`'s so much further.
fn blocks(a: &Image, b: &Image, centre: [i64; 2], lag: [i64; 2]) -> Vec<Sums> {
    let side = 2 * HALF / BLOCKS;
    let block = |k: i64| {
        let first = [k % BLOCKS, k / BLOCKS].map(|k| k * side - HALF);
        let mut sums = [0.0; 5];
        for y in centre[1] + first[1]..centre[1] + first[1] + side {
            for x in centre[0] + first[0]..centre[0] + first[0] + side {
                let p = a.values[(y * a.width + x) as usize];
                let q = b.values[((y + lag[1]) * b.width + x + lag[0]) as usize];
                for (sum, value) in sums.iter_mut().zip([p, q, p * p, q * q, p * q]) {
                    *sum += value;
                }
            }
        }
        sums
    };
    (0..BLOCKS * BLOCKS).map(block).collect()
}

/// Correlation coefficient over all blocks but one.
fn correlation(blocks: &[Sums], left_out: Option<usize>) -> f64 {
    let kept = (blocks.iter().enumerate()).filter(|(k, _)| Some(*k) != left_out);
    let mut sums = [0.0; 5];
    let mut n = 0.0;
    for (_, block) in kept {
        n += (2 * HALF / BLOCKS).pow(2) as f64;
        (sums.iter_mut().zip(block)).for_each(|(sum, value)| *sum += value);
    }
    let [p, q, pp, qq, pq] = sums.map(|sum| sum / n);
    (pq - p * q) / ((pp - p * p) * (qq - q * q)).sqrt()
}

/// Displacement and correlation with their standard errors.
pub struct Found {
    pub pixels: DVec2,
    pub pixels_error: DVec2,
    pub gamma: f64,
    pub gamma_error: f64,
}

/// The peak of the correlation near the expected place, by the vertex of a paraboloid
/// through the highest value and its neighbours; standard errors by leaving out one of
/// sixteen blocks at a time (Tukey 1958).
pub fn moved(images: &[Image; 2], centre: [i64; 2], near: DVec2) -> Found {
    let [a, b] = images;
    let start = [near.x.round() as i64, near.y.round() as i64];
    let at = |lag: [i64; 2]| blocks(a, b, centre, lag);
    let lags = (-4..=4).flat_map(|y| (-4..=4).map(move |x| [start[0] + x, start[1] + y]));
    let (_, best) = lags
        .map(|lag| (correlation(&at(lag), None), lag))
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .unwrap();
    let [x, y] = best;
    let five = [[x, y], [x - 1, y], [x + 1, y], [x, y - 1], [x, y + 1]].map(at);
    let peak = |left_out| {
        let [top, left, right, up, down] = [0, 1, 2, 3, 4].map(|k| correlation(&five[k], left_out));
        let vertex = |low: f64, high: f64| {
            let bend = low + high - 2.0 * top;
            (
                0.5 * (low - high) / bend,
                -0.125 * (low - high).powi(2) / bend,
            )
        };
        let ((dx, more_x), (dy, more_y)) = (vertex(left, right), vertex(up, down));
        (
            DVec2::new(x as f64 + dx, y as f64 + dy),
            top + more_x + more_y,
        )
    };
    let (pixels, gamma) = peak(None);
    let n = (BLOCKS * BLOCKS) as f64;
    let (mut place_square, mut gamma_square) = (DVec2::ZERO, 0.0);
    for block in 0..(BLOCKS * BLOCKS) as usize {
        let (place, value) = peak(Some(block));
        place_square += (place - pixels) * (place - pixels) * ((n - 1.0) / n);
        gamma_square += (value - gamma).powi(2) * (n - 1.0) / n;
    }
    Found {
        pixels,
        pixels_error: DVec2::new(place_square.x.sqrt(), place_square.y.sqrt()),
        gamma,
        gamma_error: gamma_square.sqrt(),
    }
}
