//! Scenes drawn from a seed, and how often their stated 95 % intervals hold the truth.

use crate::random::Random;
use lasertrace::inspect::cloud::CloudPoint;
use lasertrace::run::Simulation;
use lasertrace::scene::{PathMotion, Scene};
use std::fmt::Write;

/// Scenes of the long form. Every kind of slope occurs with every kind of processing twice.
pub const SCENES: usize = 40;
/// Probability that a program whose intervals are right fails in any scene.
const FALSE_ALARM: f64 = 1e-3;
/// Distance of laser and camera from the part, mm.
const DISTANCE: f64 = 150.0;
const WAVELENGTH_UM: f64 = 0.66;
const COLUMNS: u32 = 160;
/// Most profiles without speckle in common.
const GROUPS: u32 = 13;

/// What is done to images and profiles.
#[derive(Clone, Copy, PartialEq)]
pub enum Processing {
    None,
    /// Over so many columns.
    Median(u32),
    Mean(u32),
    Average {
        frames: u32,
        /// Distance of two frames across the laser sheet, in standard deviations of its light.
        step: f64,
    },
    Exposures,
    /// Way across the sheet in one exposure, in standard deviations of its light.
    Moving(f64),
}

impl Processing {
    fn drawn(random: &mut Random, i: usize) -> Processing {
        match (i / 4) % 5 {
            0 => Processing::None,
            1 if i < SCENES / 2 => Processing::Median(2 * random.choice(4) as u32 + 3),
            1 if random.between(0.0, 1.0) < 0.5 => Processing::Mean(5),
            1 => Processing::Median(2 * random.choice(4) as u32 + 3),
            2 => Processing::Average {
                frames: 2 + random.choice(4) as u32,
                step: random.scale(0.3, 2.5),
            },
            3 => Processing::Exposures,
            _ => Processing::Moving(random.scale(0.3, 4.0)),
        }
    }

    /// Its keys of `[measure]`.
    fn measure(self) -> String {
        match self {
            Processing::Median(columns) => format!("median_filter_columns = {columns}\n"),
            Processing::Mean(columns) => format!("moving_average_columns = {columns}\n"),
            Processing::Average { frames, .. } => format!("average_frames = {frames}\n"),
            _ => String::new(),
        }
    }
}

/// Lens and line.
struct Optics {
    focal: f64,
    magnification: f64,
    pitch_um: f64,
    f_number: f64,
    grain_px: f64,
    sigma_px: f64,
    blur: f64,
    /// 1/e² radius of the laser, mm.
    waist: f64,
}

impl Optics {
    fn drawn(random: &mut Random, angles: [f64; 2], line: Option<[f64; 2]>) -> Optics {
        let focal = random.between(20.0, 50.0);
        let magnification = focal / (DISTANCE - focal);
        let pitch_um = random.between(4.0, 6.0);
        let grain_px = random.scale(0.7, 3.0);
        let drawn = (grain_px * random.scale(0.7, 5.0)).clamp(0.9, 8.0);
        let sigma_px = line.map_or(drawn, |[grains, _]| grains * grain_px);
        let [cos_laser, cos_camera] = angles.map(|angle| angle.to_radians().cos());
        let half_width = 2e-3 * sigma_px * pitch_um / magnification;
        let blur = match random.choice(3) {
            0 => random.between(-1.5, 1.5),
            _ => 0.0,
        };
        Optics {
            focal,
            magnification,
            pitch_um,
            f_number: grain_px * pitch_um / (WAVELENGTH_UM * (1.0 + magnification)),
            grain_px,
            sigma_px,
            blur: line.map_or(blur, |[_, blur]| blur),
            waist: half_width * cos_laser / cos_camera,
        }
    }

    /// Keys of the camera and the laser, and their description.
    fn lens(&self, random: &mut Random) -> (String, String) {
        // To first order, the blur diameter is f/F·m·Δ/s for a defocus Δ at the distance s.
        let defocus = self.blur * self.sigma_px * self.pitch_um * 1e-3 * self.f_number * DISTANCE
            / (self.focal * self.magnification);
        let mut lens = format!("focus_distance_mm = {}\n", DISTANCE + defocus);
        let mut extras = String::new();
        match random.choice(4) {
            0 => {
                let tilt = [random.between(-15.0, 15.0), random.between(-15.0, 15.0)];
                let _ = writeln!(lens, "tilt_deg = {tilt:?}");
                let _ = write!(extras, "tilt {:.0}°, {:.0}° ", tilt[0], tilt[1]);
            }
            1 if self.blur == 0.0 => {
                lens = "focus = \"laser-plane\"\n".to_owned();
                extras += "Scheimpflug ";
            }
            _ => {}
        }
        if random.choice(3) == 0 {
            // Up to 2 % at the middle of the sensor's side.
            let radius = f64::from(COLUMNS / 2) * self.pitch_um * 1e-3 / self.focal;
            let k1 = random.between(-0.02, 0.02) / radius.powi(2);
            let p1 = random.between(-0.01, 0.01) / radius;
            let _ = writeln!(lens, "distortion = {{ k1 = {k1}, p1 = {p1} }}");
            extras += "distortion ";
        }
        match random.choice(4) {
            0 => {
                lens += "aperture_shape = \"square\"\n";
                extras += "square pupil ";
            }
            1 => {
                lens += "aperture_shape = { ellipse = 0.7 }\n";
                extras += "elliptic pupil ";
            }
            _ => {}
        }
        (lens, extras)
    }
}

/// A plane that is scanned within itself. Angles in degrees.
struct Plane {
    tilt: f64,
    camera_to_laser: f64,
    step: f64,
    frames: u32,
}

impl Plane {
    /// All tables but `[measure]`.
    fn scene(&self, random: &mut Random, optics: &Optics, lens: &str, speckle: bool) -> String {
        let &Plane { step, frames, .. } = self;
        let patterns = [1, 1, 1, 3][random.choice(4)];
        // Rows a column, so that the line crosses pixels everywhere.
        let climb = random.between(0.05, 0.15) * if random.choice(2) == 0 { 1.0 } else { -1.0 };
        let full_well = random.scale(8e3, 3e4);
        let angle = self.camera_to_laser.to_radians();
        let turn = (climb / angle.sin()).atan();
        // Across the sheet within the plane, whose normal is (cos t·sin β, −sin t, cos t·cos β).
        let tilt = self.tilt.to_radians();
        let [cos, sin] = [tilt.cos() * turn.cos(), tilt.sin()];
        let [cos, sin] = [cos, sin].map(|part| part / cos.hypot(sin));
        // The plane's own axis across the sheet runs aside where it is turned.
        let long = 60.0 + 2.0 * step * f64::from(frames);
        let wide = long * tilt.tan().abs().max(1.0);
        let Optics {
            focal,
            f_number,
            pitch_um,
            ..
        } = optics;
        format!(
            "[part]\nplane = {{ size_mm = [{wide}, {long}] }}\nrotation_deg = [{tilt}, {turn}, 0]\nreflectance = 0.5\n\
             [laser]\nwavelength_nm = 660\npower_mw = 5\nwaist_radius_um = {waist_um}\nwaist_distance_mm = {DISTANCE}\n\
             incoherent_modes = {patterns}\nposition_mm = [0, 0, {DISTANCE}]\ndirection = [0, 0, -1]\n\
             line = {{ fan_deg = 6, profile = \"uniform\", direction = [1, 0, 0] }}\n\
             [camera]\nfocal_length_mm = {focal}\nf_number = {f_number}\n{lens}\
             resolution_px = [{COLUMNS}, 256]\npixel_pitch_um = {pitch_um}\n\
             position_mm = [0, {y}, {z}]\nlook_at_mm = [0, 0, 0]\ncolumn_axis = [1, 0, 0]\n\
             exposure = \"auto\"\nauto_exposure_target = {share}\nquantum_efficiency = 0.5\n\
             gain_dn_per_e = {gain}\nbit_depth = 12\nfull_well_e = {full_well}\nblack_level_dn = 40\n\
             read_noise_e = {read_noise}\nprnu_percent = {prnu}\ndsnu_e = {dsnu}\n\
             [scan]\ndirection = [0, {cos}, {sin}]\nstep_mm = {step}\nframes = {frames}\n",
            tilt = self.tilt,
            turn = turn.to_degrees(),
            waist_um = 1e3 * optics.waist,
            y = -DISTANCE * angle.sin(),
            z = DISTANCE * angle.cos(),
            // With speckle grains far brighter than the line's middle must not saturate.
            share = if speckle { 0.12 } else { 0.5 },
            gain = 4000.0 / full_well,
            read_noise = random.scale(3.0, 20.0),
            prnu = random.between(0.0, 1.0),
            dsnu = random.between(0.0, 5.0),
        )
    }
}

/// A plane under a sensor, both random.
pub struct DrawnScene {
    /// Angles between the plane's normal and the laser, and the camera, degrees.
    angles: [f64; 2],
    /// Standard deviation of the line and length of a grain, px.
    sigma_px: f64,
    grain_px: f64,
    /// Diameter of the lens blur over `sigma_px`.
    blur: f64,
    speckle: bool,
    processing: Processing,
    /// Distance of independent frames or groups of frames, in frames.
    stride: u32,
    extras: String,
    text: String,
    share: f64,
}

impl DrawnScene {
    /// Scene `i` of those of a seed.
    pub fn new(seed: u64, i: usize) -> DrawnScene {
        DrawnScene::with_line(seed, i, None)
    }

    /// Scene `i` with a line of the given number of grains, and a blur of the given number of its standard deviations.
    pub fn with_line(seed: u64, i: usize, line: Option<[f64; 2]>) -> DrawnScene {
        let mut random = Random::new(1000 * seed + i as u64);
        let camera_to_laser = random.between(20.0, 50.0);
        let tilt = match i % 4 {
            0 => random.between(-20.0, 35.0),
            1 => random.between(60.0, 80.0),
            2 => camera_to_laser - random.between(60.0, 78.0),
            _ => camera_to_laser - random.between(78.0, 85.0),
        };
        let processing = Processing::drawn(&mut random, i);
        let speckle = random.between(0.0, 1.0) < 0.85;
        let angles = [tilt, tilt - camera_to_laser].map(f64::abs);
        let optics = Optics::drawn(&mut random, angles, line);
        let (lens, extras) = optics.lens(&mut random);
        // Far enough apart for grains of their own.
        let apart = 12.0;
        let (across, stride) = match processing {
            Processing::Average { frames, step } => {
                let groups = (apart / step / f64::from(frames)).ceil() as u32;
                (step, groups.max(1) * frames)
            }
            _ => (apart, 1),
        };
        let plane = Plane {
            tilt,
            camera_to_laser,
            step: across * optics.waist / 2.0 / angles[0].to_radians().cos(),
            frames: GROUPS * stride,
        };
        let text = format!(
            "seed = 1\nspeckle = {speckle}\n{}[measure]\n{}",
            plane.scene(&mut random, &optics, &lens, speckle),
            processing.measure(),
        );
        DrawnScene {
            angles,
            sigma_px: optics.sigma_px,
            grain_px: optics.grain_px,
            blur: optics.blur,
            speckle,
            processing,
            stride,
            extras: match text.contains("incoherent_modes = 3") {
                true => extras + "3 patterns",
                false => extras,
            },
            text,
            share: 1.0 / apart,
        }
    }

    fn scene(&self, seed: u64) -> Scene {
        let mut scene = Scene::parse(&self.text, "".as_ref())
            .unwrap_or_else(|error| panic!("{error}: {}", self.text));
        scene.seed = seed;
        // A way within the exposure belongs to a given one, as several exposures do.
        let exposed = Simulation::new(&scene)
            .unwrap()
            .scene
            .camera
            .sensor
            .exposure_ms;
        scene.auto_exposure = None;
        scene.camera.sensor.exposure_ms = exposed;
        match self.processing {
            Processing::Exposures => {
                // The line fills the longest exposure in its middle.
                let sensor = &mut scene.camera.sensor;
                sensor.exposure_ms = exposed * 6.0;
                sensor.shorter = vec![3.0, 9.0];
            }
            Processing::Moving(way) => {
                scene.scan.exposure_share = Some(way * self.share);
                scene.scan.motion_samples = 8;
            }
            _ => {}
        }
        scene
    }

    /// The points of `groups` independent profiles of a seed.
    pub fn points(&self, seed: u64, groups: u32) -> Vec<CloudPoint> {
        let scene = self.scene(seed);
        let simulation = Simulation::new(&scene).unwrap();
        let average = measure_frames(self.processing);
        let frames: Vec<u32> = (0..groups)
            .flat_map(|group| (0..average).map(move |i| (group, i)))
            .map(|(group, i)| group * self.stride.max(average) + i)
            .collect();
        let mut points: Vec<CloudPoint> = frames
            .iter()
            .flat_map(|&frame| simulation.take(frame).2)
            .collect();
        simulation.apply_cross_frame_flags(frames.iter().copied(), &mut points);
        simulation.filtered_points(points)
    }

    /// The same scene under another processing.
    pub fn processed(self, processing: Processing) -> DrawnScene {
        let measure = self.text.find("[measure]").unwrap();
        let text = format!(
            "{}[measure]\n{}",
            &self.text[..measure],
            processing.measure()
        );
        DrawnScene {
            processing,
            text,
            ..self
        }
    }

    /// Mean square of the mean of so many neighbouring profiles over what the correlation along the scan gives for it, and
    /// over what independent profiles would have; the distance of frames across the sheet is `step` standard deviations of its light.
    pub fn means_over_profiles(&self, step: f64, count: u32, seeds: u64) -> [f64; 2] {
        let mut sums = [0.0; 3];
        for seed in 1..=seeds {
            let mut scene = self.scene(seed);
            let PathMotion::Linear { step: way } = &mut scene.scan.motion else {
                unreachable!("scenes of this file are scanned in a straight line");
            };
            *way *= step * self.share;
            let simulation = Simulation::new(&scene).unwrap();
            let points: Vec<CloudPoint> = (0..count).flat_map(|f| simulation.take(f).2).collect();
            let rho = simulation.correlation_over_profiles(&points);
            let at = |apart: u32| rho.get(apart as usize).copied().unwrap_or(0.0);
            let pairs = (0..count).flat_map(|a| (0..count).map(move |b| a.abs_diff(b)));
            let factor = pairs.map(at).sum::<f64>() / f64::from(count * count);
            for column in 0..COLUMNS {
                let of_column = points
                    .iter()
                    .filter(|p| p.column == column && p.flags.is_empty());
                let of_column: Vec<&CloudPoint> = of_column.collect();
                if of_column.len() == count as usize {
                    let n = f64::from(count);
                    let mean = of_column.iter().map(|p| p.deviation).sum::<f64>() / n;
                    let square = of_column.iter().map(|p| p.u_deviation.powi(2)).sum::<f64>() / n;
                    sums[0] += mean * mean;
                    sums[1] += square * factor;
                    sums[2] += square / n;
                }
            }
        }
        [sums[0] / sums[1], sums[0] / sums[2]]
    }

    /// Half the mean square of the difference of two images of a place, nothing moved, over what is stated of it.
    pub fn repeats(&self, places: u32) -> f64 {
        let scene = self.scene(1);
        let simulation = Simulation::new(&scene).unwrap();
        let mut sums = [0.0; 2];
        for frame in 0..places {
            let light = simulation.irradiance(frame);
            let images = [1, 2].map(|draw| {
                let counts = simulation.counts(frame + 1000 * draw, &light);
                simulation.filtered_points(simulation.measure(frame, &counts).1)
            });
            let valid = images.map(|points| {
                let mut columns = vec![None; COLUMNS as usize];
                for point in points.into_iter().filter(|p| p.flags.is_empty()) {
                    columns[point.column as usize] = Some(point);
                }
                columns
            });
            // A row that has a flag in one image only makes another window of it: that is no noise of rows.
            let half = 5;
            for column in half..COLUMNS as usize - half {
                let window = column - half..=column + half;
                let whole = window.clone().all(|i| valid.iter().all(|v| v[i].is_some()));
                if let (true, Some(a), Some(b)) = (whole, valid[0][column], valid[1][column]) {
                    sums[0] += a.position.distance_squared(b.position) / 2.0;
                    sums[1] += (a.repeatability.powi(2) + b.repeatability.powi(2)) / 2.0;
                }
            }
        }
        sums[0] / sums[1]
    }

    /// Counts the independent intervals that hold the truth, in `seeds · groups` groups of profiles.
    ///
    /// The line lies on the same pixels in every frame. Without speckle, errors by the pixel pattern are a large part of the
    /// uncertainty. Only one profile of each sensor is then independent: the second of three, which has neighbours.
    pub fn held(&self, seeds: u64, groups: u32) -> Held {
        let mut held = Held::default();
        if self.speckle {
            for seed in 1..=seeds {
                held.add(&self.points(seed, groups));
            }
            return held;
        }
        for seed in 1..=seeds * u64::from(groups) {
            let mut points = self.points(seed, 3);
            let mut frames: Vec<u32> = points.iter().map(|point| point.frame).collect();
            frames.sort_unstable();
            frames.dedup();
            if let [_, second, _] = frames[..] {
                points.retain(|point| point.frame == second);
                held.add(&points);
            }
        }
        held
    }
}

fn measure_frames(processing: Processing) -> u32 {
    match processing {
        Processing::Average { frames, .. } => frames,
        _ => 1,
    }
}

/// Intervals of points a correlation length apart.
#[derive(Default, Clone, Copy)]
pub struct Held {
    pub points: usize,
    pub unflagged: usize,
    pub independent: u64,
    pub held: u64,
    /// Of squares of errors over what is stated, of all unflagged points.
    squares: f64,
    /// Of errors over what is stated, of these points.
    errors: f64,
    sigma: f64,
}

impl Held {
    fn add(&mut self, points: &[CloudPoint]) {
        self.points += points.len();
        let mut lengths: Vec<f64> = points
            .windows(2)
            .filter(|p| p[0].frame == p[1].frame && p[0].column + 1 == p[1].column)
            .map(|p| p[1].correlation_length / p[0].position.distance(p[1].position))
            .collect();
        if lengths.is_empty() {
            return;
        }
        let middle = lengths.len() / 2;
        let columns = *lengths.select_nth_unstable_by(middle, f64::total_cmp).1;
        let stride = columns.ceil().max(1.0) as u32;
        for point in points.iter().filter(|p| p.flags.is_empty()) {
            let z = point.deviation / point.u_deviation;
            self.unflagged += 1;
            self.squares += z * z;
            self.errors += z;
            self.sigma += point.u_deviation;
            if point.column % stride == 0 {
                self.independent += 1;
                self.held += u64::from(z.abs() <= 1.96);
            }
        }
    }

    pub fn pooled(all: &[Held]) -> Held {
        all.iter().fold(Held::default(), |a, b| Held {
            points: a.points + b.points,
            unflagged: a.unflagged + b.unflagged,
            independent: a.independent + b.independent,
            held: a.held + b.held,
            squares: a.squares + b.squares,
            errors: a.errors + b.errors,
            sigma: a.sigma + b.sigma,
        })
    }

    pub fn share(&self) -> f64 {
        self.held as f64 / self.independent as f64
    }

    /// The exact interval of the share (Clopper and Pearson 1934), where one of so many excludes the
    /// true share in [`FALSE_ALARM`] of all draws.
    pub fn interval(&self, scenes: usize) -> [f64; 2] {
        let alpha = FALSE_ALARM / scenes as f64 / 2.0;
        let (n, k) = (self.independent, self.held);
        let solve = |low_is_less: &dyn Fn(f64) -> bool| {
            let (mut low, mut high) = (0.0, 1.0);
            for _ in 0..60 {
                let middle = (low + high) / 2.0;
                if low_is_less(middle) {
                    low = middle;
                } else {
                    high = middle;
                }
            }
            low
        };
        let low = match k {
            0 => 0.0,
            // P(X ≥ k) reaches α.
            _ => solve(&|p| 1.0 - at_most(k - 1, n, p) < alpha),
        };
        let high = match k == n {
            true => 1.0,
            false => solve(&|p| at_most(k, n, p) > alpha),
        };
        [low, high]
    }

    pub fn holds_95(&self, scenes: usize) -> bool {
        let [low, high] = self.interval(scenes);
        (low..=high).contains(&0.95)
    }

    pub fn mean(&self) -> f64 {
        self.errors / self.unflagged as f64
    }

    pub fn rms(&self) -> f64 {
        (self.squares / self.unflagged as f64).sqrt()
    }
}

/// P(X ≤ k) of n draws that succeed by chance `p`.
fn at_most(k: u64, n: u64, p: f64) -> f64 {
    let log_factorial = |n: u64| libm::lgamma(n as f64 + 1.0);
    let log = |i: u64| {
        log_factorial(n) - log_factorial(i) - log_factorial(n - i)
            + i as f64 * p.ln()
            + (n - i) as f64 * (-p).ln_1p()
    };
    (0..=k).map(|i| log(i).exp()).sum::<f64>().min(1.0)
}

/// A row of the table; `scenes`: of how many.
pub fn row(i: usize, scene: &DrawnScene, held: &Held, scenes: usize) -> String {
    let [low, high] = held.interval(scenes);
    let processing = match scene.processing {
        Processing::None => "–".to_owned(),
        Processing::Median(columns) => format!("median of {columns} columns"),
        Processing::Mean(columns) => format!("mean of {columns} columns"),
        Processing::Average { frames, step } => {
            format!("average of {frames} frames, {step:.2} σ apart")
        }
        Processing::Exposures => "3 exposures".to_owned(),
        Processing::Moving(way) => format!("moves by {way:.2} σ in an exposure"),
    };
    format!(
        "| {i} | {:.0}°, {:.0}° | {} | {:.2} | {:.2} | {:.2} | {} | {processing} | {:.1} | {} of {} | {:.4} | {low:.3}–{high:.3} | {:.3} | {:.3} | {} |",
        scene.angles[0],
        scene.angles[1],
        if scene.speckle { "yes" } else { "no" },
        scene.sigma_px,
        scene.sigma_px / scene.grain_px,
        scene.blur.abs(),
        scene.extras,
        1e3 * held.sigma / held.unflagged as f64,
        held.held,
        held.independent,
        held.share(),
        held.rms(),
        held.mean(),
        if held.holds_95(scenes) { "yes" } else { "NO" },
    )
}

pub const HEAD: &str = "| scene | normal to laser, camera | speckle | σ, px | σ/h | blur/σ | lens | processing | stated, µm | hold | fraction | exact interval | rms error over stated | mean error over stated | 95 % within |\n\
|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|";
