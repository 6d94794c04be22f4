//! A calibration as a laboratory would make it: a flat target of dots, carried to
//! known places by a stage, is seen in ambient light and with the laser line on it.

use crate::camera::Distortion;
use crate::camera::Sensor;
use crate::error::{Error, InputError, Place, Result, printable};
use crate::math::rng::{Key, Purpose};
use crate::math::{DMat3, DVec2, DVec3, Rigid};
use crate::mesh::{Mesh, shapes};
use crate::profile::{
    Adjustment, Calibration, Dot, LinePoint, Observations, PARAMETERS, Parameters, Peak, adjust,
    find_peaks,
};
use crate::report::residual_picture::residual_picture;
use crate::run::error_model::perfect_calibration;
use crate::run::need::require_study;
use crate::run::output_folder::{Names, OutputFolder};
use crate::run::simulation::Simulation;
use crate::run::{Control, files};
use crate::scene::{ScanPath, Scene};
use rand_distr::{Distribution, StandardNormal};
use serde::Serialize;
use std::f64::consts::PI;
use std::path::PathBuf;
use std::sync::Arc;

/// Poses of the target.
pub const VIEWS: u32 = 10;
/// By which it is turned about its axes in them, one pair after the other.
const TILTS_DEG: [[f64; 2]; 5] = [
    [0.0, 0.0],
    [20.0, 0.0],
    [0.0, 20.0],
    [-20.0, 0.0],
    [0.0, -20.0],
];
/// Dots across the image, and the radius of their images.
const DOTS_ACROSS: f64 = 14.0;
const DOT_RADIUS_PX: f64 = 5.0;
/// Dark rim around a dot over which its centroid is taken as well.
const RIM_PX: f64 = 2.0;

/// `summary.json`.
#[derive(Debug, Serialize)]
pub struct CalibrationSummary {
    /// The scene file.
    #[serde(serialize_with = "printable::in_json")]
    pub scene: PathBuf,
    /// Poses of the target.
    pub views: u32,
    /// Dots seen in all views.
    pub dots: usize,
    /// Columns with a line in all views.
    pub line_points: usize,
    /// Noise of a dot's coordinates, px, as it was drawn.
    pub dot_sigma_px: f64,
    /// Noise of a peak's row, px, estimated from the residuals.
    pub line_sigma_px: f64,
    /// Steps that the adjustment took.
    pub iterations: usize,
    /// One for each estimated parameter.
    pub parameters: Vec<ParameterResult>,
    /// Of all errors together, by the estimated covariance; its mean and standard
    /// deviation are n and √2n for n parameters.
    pub chi_squared: f64,
    /// Root mean square over the sensor of how far points of the laser plane are
    /// measured from where they are, and as the covariance predicts.
    pub point_error_um: f64,
    /// As the covariance predicts it.
    pub point_uncertainty_um: f64,
    /// What the images were made with.
    pub true_values: Calibration,
    /// What was found.
    pub estimates: Calibration,
    /// Where the estimates were written.
    #[serde(serialize_with = "printable::in_json")]
    pub calibration: PathBuf,
    /// Where the picture of the residuals was written.
    #[serde(serialize_with = "printable::in_json")]
    pub picture: PathBuf,
}

/// An estimated parameter beside the truth.
#[derive(Debug, Serialize)]
pub struct ParameterResult {
    /// Its name, with its unit.
    pub parameter: &'static str,
    /// Estimate minus true value.
    pub error: f64,
    /// From the covariance, in the parameter's unit.
    pub standard_uncertainty: f64,
    /// Their ratio.
    pub normalised_error: f64,
}

/// Writes `calibration.json`, `residuals.svg` and `summary.json` to `out`. The
/// scene's own part and scan play no role; its calibration is not used.
pub fn calibrate<'a>(
    mut scene: Scene,
    out: impl Into<OutputFolder<'a>>,
    control: &Control,
) -> Result<CalibrationSummary> {
    require_study(&scene)?;
    scene.tolerance_um = None; // it was stated for the part
    let truth = perfect_calibration(&scene);
    let key = Key::new(scene.seed, Purpose::Calibration);
    let path = scene.path.clone();
    let impossible = |expected: &str| -> Error {
        let found = "a sensor that cannot be calibrated";
        InputError::new(&path, Place::File, found, expected).into()
    };
    let targets = targets(&truth).map_err(|e| impossible(&e))?;
    let dot_sigma_px = dot_sigma(&scene.camera.sensor);
    let width = field_width(&truth, &targets);
    let mut observations = Observations::default();
    for (i, target) in targets.iter().enumerate() {
        let key = key.with(i as u64);
        observations
            .dots
            .extend(dots(&truth, target, width, dot_sigma_px, key));
    }
    let names = ["summary.json", "calibration.json", "residuals.svg"];
    let folder = out.into().claim(&scene.inputs, &Names::of(names))?;
    let [summary_file, calibration, picture] = names.map(|name| folder.path.join(name));
    for name in names {
        folder.remove(name)?;
    }
    scene.mesh = Arc::new(board(width).map_err(|expected| impossible(&expected))?);
    scene.copies = [Rigid::IDENTITY].into();
    (scene.calibration, scene.scan) = (None, ScanPath::at_rest());
    for (i, target) in targets.iter().enumerate() {
        control.check()?;
        scene.part_at_rest = *target;
        // Other grains and noise in each view.
        scene.seed = key.with(i as u64).bits(0);
        observations.line.extend(line(&scene, target, control)?);
        (control.progress)(1 + i as u64);
    }
    let adjustment = adjust(&assembled(&truth, key), &observations).map_err(|reason| {
        InputError::new(
            &path,
            Place::File,
            reason,
            "a sensor that the views determine",
        )
    })?;
    let found = &adjustment.calibration;
    let [point_error_um, point_uncertainty_um] = point_errors(found, &truth);
    let summary = CalibrationSummary {
        scene: path,
        views: VIEWS,
        dots: observations.dots.len(),
        line_points: observations.line.len(),
        dot_sigma_px,
        line_sigma_px: adjustment.line_sigma_px,
        iterations: adjustment.iterations,
        parameters: results(&adjustment, &truth),
        chi_squared: found.chi_squared(&truth).map_or(f64::MAX, |(chi2, _)| chi2),
        point_error_um,
        point_uncertainty_um,
        true_values: truth,
        estimates: found.clone(),
        calibration,
        picture,
    };
    let svg = residual_picture(&observations, &adjustment);
    files::write_bytes(&summary.picture, svg.as_bytes())?;
    files::write_json(&summary.calibration, found)?;
    files::write_json(&summary_file, &summary)?;
    Ok(summary)
}

/// head_from_target for each view: the target's middle goes down the laser plane
/// across most of the image; it faces half-way between camera and laser, give or
/// take the tilts. Errors: the laser plane is not seen all over the image.
fn targets(nominal: &Calibration) -> std::result::Result<Vec<Rigid>, String> {
    let size = nominal.camera.resolution.as_dvec2();
    let columns = nominal.head_from_camera.rotation.x_axis;
    let normal = nominal.head_from_camera.vector(nominal.plane_normal);
    (0..VIEWS)
        .map(|i| {
            let share = 0.15 + 0.7 * i as f64 / (VIEWS - 1) as f64;
            let seen = nominal.point_at(size * DVec2::new(0.5, share));
            let point = seen.ok_or("the laser plane before the camera all over the image")?;
            let middle = nominal.head_from_camera.point(point);
            let to_camera = (nominal.head_from_camera.translation - middle).normalize();
            // Within the laser plane, on the camera's side.
            let to_laser = (to_camera - normal * normal.dot(to_camera)).normalize();
            let facing = Rigid::from_z_and_x(middle, to_camera + to_laser, columns)
                .ok_or("a camera that does not look along the laser line")?;
            let [x, y] = TILTS_DEG[i as usize % TILTS_DEG.len()].map(f64::to_radians);
            Ok(Rigid {
                rotation: facing.rotation * DMat3::from_rotation_y(y) * DMat3::from_rotation_x(x),
                ..facing
            })
        })
        .collect::<std::result::Result<_, &str>>()
        .map_err(str::to_owned)
}

/// The target, for a field of this width.
fn board(width: f64) -> std::result::Result<Mesh, String> {
    shapes::plane(DVec2::splat(4.0 * width)).map_err(|wrong| {
        let expected = wrong.expected;
        format!(
            "a camera whose field at the laser plane, a quarter of the target's side, is {expected}"
        )
    })
}

/// Widest view of the camera across a target, mm.
fn field_width(nominal: &Calibration, targets: &[Rigid]) -> f64 {
    let camera = &nominal.camera;
    let angle =
        camera.resolution.as_dvec2().max_element() * camera.pixel_pitch / camera.principal_distance;
    let eye = nominal.head_from_camera.translation;
    let far = targets.iter().map(|t| t.translation.distance(eye));
    far.fold(0.0, f64::max) * angle
}

/// Standard deviation, in each direction, of the centroid of a dot of half the
/// highest count by shot noise, noise in the dark and rounding to counts, pixels:
///
/// ```text
/// σ² = (N·πρ⁴/4 + (σ_d² + 1/(12·K²))·πW⁴/4) / (N·πρ²)²
/// ```
///
/// with N electrons a pixel within radius ρ and a window of radius W: the variance
/// of Σx·n over the window over the square of Σn.
fn dot_sigma(sensor: &Sensor) -> f64 {
    let highest = (sensor.max_count() as f64 - sensor.black_level_dn) / sensor.gain_dn_per_e;
    let level = 0.5 * highest.min(sensor.full_well_e);
    let shot = sensor.noise.map_or(0.0, |_| level);
    let even = sensor.dark_variance_e();
    let quarter = |radius: f64| PI * radius.powi(4) / 4.0;
    let moment = shot * quarter(DOT_RADIUS_PX) + even * quarter(DOT_RADIUS_PX + RIM_PX);
    moment.sqrt() / (level * PI * DOT_RADIUS_PX.powi(2))
}

/// The dots of the target that the camera sees whole.
fn dots(truth: &Calibration, target: &Rigid, width: f64, sigma_px: f64, key: Key) -> Vec<Dot> {
    let camera_from_head = truth.head_from_camera.inverse();
    let size = truth.camera.resolution.as_dvec2();
    let rim = DVec2::splat(DOT_RADIUS_PX + RIM_PX);
    let across = DOTS_ACROSS as i32;
    let grid = (-across..=across).flat_map(|j| (-across..=across).map(move |i| (i, j)));
    grid.enumerate()
        .filter_map(|(n, (i, j))| {
            let on_target = DVec3::new(i as f64, j as f64, 0.0) * (width / DOTS_ACROSS);
            let position = target.point(on_target);
            let pixel = truth.camera.project(camera_from_head.point(position))?;
            let whole = pixel.cmpge(rim).all() && pixel.cmple(size - rim).all();
            let mut random = key.with(n as u64).stream();
            let noise = [(); 2].map(|()| StandardNormal.sample(&mut random));
            whole.then(|| Dot {
                position,
                pixel: pixel + DVec2::from(noise) * sigma_px,
                sigma_px,
            })
        })
        .collect()
}

/// The laser line on the target, by the sensor's own image and peaks.
fn line(scene: &Scene, target: &Rigid, control: &Control) -> Result<Vec<LinePoint>> {
    let simulation = Simulation::watched(scene, control)?;
    let counts = simulation.counts_near_light(0, &simulation.irradiance(0));
    let resolution = scene.camera.sensor.resolution;
    let mut peaks = find_peaks(&counts, &simulation.peak_settings());
    let plan = &simulation.plan;
    // Grains are independent from the first zero of their correlation on, 1.22 h,
    // and a pixel further as pixels have a width.
    let apart = 1 + (1.22 * plan.grain.speckle_extent_px[0]).ceil() as u32;
    // A line that the border cuts has its peak elsewhere.
    let border = 4.0 * plan.line_half_width_px + 1.0;
    let inside = |row: f64| row > border && row < resolution.y as f64 - border;
    // Noise is sometimes a peak, of a small part of the line's light.
    let light = |peak: &Peak| peak.intensity;
    peaks.sort_by(|a, b| light(a).total_cmp(&light(b)));
    let faint = peaks.get(peaks.len() / 2).map_or(0.0, light) / 4.0;
    Ok(peaks
        .iter()
        .filter(|p| p.column % apart == 0 && inside(p.row) && p.intensity > faint)
        .map(|p| LinePoint {
            target_point: target.translation,
            target_normal: target.rotation.z_axis,
            pixel: DVec2::new(p.column as f64 + 0.5, p.row),
        })
        .collect())
}

/// What is known of a sensor before it is calibrated: how it was designed. It was
/// assembled to within these tolerances (standard deviations); its distortion is
/// unknown.
fn assembled(truth: &Calibration, key: Key) -> Calibration {
    let mut tolerances: Parameters = [0.0; PARAMETERS.len()];
    tolerances[0] = 0.005 * truth.camera.principal_distance;
    tolerances[1..3].fill(5.0);
    tolerances[8..11].fill(3e-3);
    tolerances[11..14].fill(0.3);
    tolerances[14..].copy_from_slice(&[0.3, 3e-3, 3e-3]);
    let mut random = key.with(u64::MAX).stream();
    let by = tolerances.map(|t| {
        let normal: f64 = StandardNormal.sample(&mut random);
        t * normal
    });
    let mut nominal = truth.perturbed(&by);
    nominal.camera.distortion = truth
        .camera
        .distortion
        .map(|_| Distortion::unchecked([0.0; 3], [0.0; 2]));
    nominal
}

fn results(adjustment: &Adjustment, truth: &Calibration) -> Vec<ParameterResult> {
    let found = &adjustment.calibration;
    let (missing, sigma) = (found.difference(truth), found.standard_uncertainties());
    (0..PARAMETERS.len())
        .filter(|&i| sigma[i] > 0.0)
        .map(|i| ParameterResult {
            parameter: PARAMETERS[i],
            error: -missing[i],
            standard_uncertainty: sigma[i],
            normalised_error: -missing[i] / sigma[i],
        })
        .collect()
}

/// Root mean square, over 9 × 9 places of the sensor, of the distance of measured
/// points from the true ones, and of the standard uncertainty of that distance, µm.
fn point_errors(found: &Calibration, truth: &Calibration) -> [f64; 2] {
    let size = found.camera.resolution.as_dvec2();
    let (mut squares, mut variances, mut n) = (0.0, 0.0, 0.0f64);
    for i in 0..81 {
        let pixel = size * DVec2::new((i % 9) as f64 + 0.5, (i / 9) as f64 + 0.5) / 9.0;
        let at = (found.point_jacobian(pixel), truth.point_at(pixel));
        if let (Some(measured), Some(point)) = at {
            let point = truth.head_from_camera.point(point);
            squares += measured.point.distance_squared(point);
            let covariance = found.point_covariance(&measured);
            variances += covariance.x_axis.x + covariance.y_axis.y + covariance.z_axis.z;
            n += 1.0;
        }
    }
    [squares, variances].map(|sum| 1e3 * (sum / n.max(1.0)).sqrt())
}
