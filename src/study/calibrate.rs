//! Simulated laboratory calibration. A stage moves a flat target with dots to known poses. Each is
//! recorded in ambient light and with the laser line.

use crate::camera::{Distortion, Lens, Sensor};
use crate::error::{Error, InputError, Place, Result, printable};
use crate::math::rng::{Purpose, RngKey};
use crate::math::{DMat3, DVec2, DVec3, Rigid};
use crate::mesh::{Mesh, shapes};
use crate::profile::{
    Adjustment, Calibration, Dot, LaserLineObservation, Observations, PARAMETERS, Parameters, Peak,
    adjust,
};
use crate::report::residual_picture::residual_picture;
use crate::run::error_model::perfect_calibration;
use crate::run::memory_estimate::require_study;
use crate::run::output_folder::{Names, OutputFolder};
use crate::run::simulation::Simulation;
use crate::run::{RunControl, files};
use crate::scene::{ScanPath, Scene};
use rand_distr::{Distribution, StandardNormal};
use serde::Serialize;
use std::f64::consts::PI;
use std::path::PathBuf;
use std::sync::Arc;

/// Number of target poses.
pub const VIEWS: u32 = 10;
/// Tilts of the target about its two axes, degrees, used in turn.
const TILTS_DEG: [[f64; 2]; 5] = [
    [0.0, 0.0],
    [20.0, 0.0],
    [0.0, 20.0],
    [-20.0, 0.0],
    [0.0, -20.0],
];
/// Number of dots across the image. The next constant is the radius of a dot's image.
const DOTS_ACROSS: f64 = 14.0;
const DOT_RADIUS_PX: f64 = 5.0;
/// Width of the dark rim around a dot that is included in its centroid window, px.
const RIM_PX: f64 = 2.0;

/// Content of `summary.json`.
#[derive(Debug, Serialize)]
pub struct CalibrationSummary {
    /// Path of the scene file.
    #[serde(serialize_with = "printable::in_json")]
    pub scene: PathBuf,
    /// Number of target poses.
    pub views: u32,
    /// Number of dots observed in all views.
    pub dots: usize,
    /// Number of columns with a line in all views.
    pub line_points: usize,
    /// Simulated noise of a dot's coordinates, standard deviation, px.
    pub dot_sigma_px: f64,
    /// Noise of a peak's row, standard deviation, px, estimated from the residuals.
    pub line_sigma_px: f64,
    /// Number of iterations of the adjustment.
    pub iterations: usize,
    /// Results for each estimated parameter.
    pub parameters: Vec<ParameterResult>,
    /// χ² of all parameter errors with the estimated covariance. Its mean is n and its standard
    /// deviation √2n for n parameters.
    pub chi_squared: f64,
    /// Root mean square over the sensor of the distance between measured and true points of the
    /// laser plane, µm.
    pub point_error_um: f64,
    /// Prediction of `point_error_um` from the covariance, µm.
    pub point_uncertainty_um: f64,
    /// True parameters of the simulated images.
    pub true_values: Calibration,
    /// Estimated parameters.
    pub estimates: Calibration,
    /// Path of the estimated calibration.
    #[serde(serialize_with = "printable::in_json")]
    pub calibration: PathBuf,
    /// Path of the residual plot.
    #[serde(serialize_with = "printable::in_json")]
    pub picture: PathBuf,
}

/// Estimate of one parameter.
#[derive(Debug, Serialize)]
pub struct ParameterResult {
    /// Name with unit.
    pub parameter: &'static str,
    /// Estimate minus true value.
    pub error: f64,
    /// Standard uncertainty from the covariance, in the unit of the parameter.
    pub standard_uncertainty: f64,
    /// Error divided by standard uncertainty.
    pub normalised_error: f64,
}

/// Simulates a calibration, and writes `calibration.json`, `residuals.svg` and `summary.json` to
/// `out`. Part, scan and calibration of the scene are not used.
pub fn calibrate<'a>(
    mut scene: Scene,
    out: impl Into<OutputFolder<'a>>,
    control: &RunControl,
) -> Result<CalibrationSummary> {
    require_study(&scene)?;
    scene.tolerance_um = None; // it was stated for the part
    let truth = perfect_calibration(&scene);
    let key = RngKey::new(scene.seed, Purpose::Calibration);
    let path = scene.path.clone();
    let impossible = |expected: &str| -> Error {
        let found = "a sensor that cannot be calibrated";
        InputError::new(&path, Place::File, found, expected).into()
    };
    let targets = targets(&truth, &scene.camera.lens).map_err(|e| impossible(&e))?;
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
    // The stated errors do not include calibration errors that this study finds.
    scene.systematic = Default::default();
    for (i, target) in targets.iter().enumerate() {
        control.check()?;
        scene.part_at_rest = *target;
        // Speckle and noise are independent in each view.
        scene.seed = key.with(i as u64).bits(0);
        observations.line.extend(line(&scene, target, control)?);
        (control.progress)(1 + i as u64);
    }
    let adjustment = adjust(&initial_guess(&truth, key), &observations).map_err(|reason| {
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

/// Returns the poses of the target (head_from_target). Its centre moves down the laser plane over
/// most of the image. Its normal bisects the directions to camera and laser, apart from the tilts.
/// Returns an error if the camera does not see the laser plane across the complete image, and for
/// telecentric lenses, which have no centre of projection.
fn targets(nominal: &Calibration, lens: &Lens) -> std::result::Result<Vec<Rigid>, String> {
    if lens.telecentric {
        return Err("a lens that is not telecentric".to_owned());
    }
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
            // Direction within the laser plane, on the side of the camera.
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

/// Returns the target for a field of view of this width.
fn board(width: f64) -> std::result::Result<Mesh, String> {
    shapes::plane(DVec2::splat(4.0 * width)).map_err(|wrong| {
        let expected = wrong.expected;
        format!(
            "a camera whose field at the laser plane, a quarter of the target's side, is {expected}"
        )
    })
}

/// Returns the largest width of the camera's field of view over the targets, mm.
fn field_width(nominal: &Calibration, targets: &[Rigid]) -> f64 {
    let camera = &nominal.camera;
    let angle =
        camera.resolution.as_dvec2().max_element() * camera.pixel_pitch / camera.principal_distance;
    let eye = nominal.head_from_camera.translation;
    let far = targets.iter().map(|t| t.translation.distance(eye));
    far.fold(0.0, f64::max) * angle
}

/// Returns the standard deviation of a dot's centroid in each direction, px. Noise sources are shot
/// noise, dark noise and rounding to counts, for a dot at half the highest count:
///
/// ```text
/// σ² = (N·πρ⁴/4 + (σ_d² + 1/(12·K²))·πW⁴/4) / (N·πρ²)²
/// ```
///
/// N is the number of electrons per pixel within the radius ρ, and W is the radius of the window.
/// σ² is the variance of Σx·n over the window, divided by the square of Σn.
fn dot_sigma(sensor: &Sensor) -> f64 {
    let highest = (sensor.max_count() as f64 - sensor.black_level_dn) / sensor.gain_dn_per_e;
    let level = 0.5 * highest.min(sensor.full_well_e);
    let shot = sensor.noise.map_or(0.0, |_| level);
    let even = sensor.dark_variance_e();
    let quarter = |radius: f64| PI * radius.powi(4) / 4.0;
    let moment = shot * quarter(DOT_RADIUS_PX) + even * quarter(DOT_RADIUS_PX + RIM_PX);
    moment.sqrt() / (level * PI * DOT_RADIUS_PX.powi(2))
}

/// Returns the dots of the target that are completely in the image.
fn dots(truth: &Calibration, target: &Rigid, width: f64, sigma_px: f64, key: RngKey) -> Vec<Dot> {
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
            let mut random = key.with(n as u64).counter_stream();
            let noise = [(); 2].map(|()| StandardNormal.sample(&mut random));
            whole.then(|| Dot {
                position,
                pixel: pixel + DVec2::from(noise) * sigma_px,
                sigma_px,
            })
        })
        .collect()
}

/// Returns the laser line on the target, detected in a simulated image.
fn line(scene: &Scene, target: &Rigid, control: &RunControl) -> Result<Vec<LaserLineObservation>> {
    let simulation = Simulation::watched(scene, control)?;
    let counts = simulation.counts_near_light(0, &simulation.irradiance(0));
    let resolution = scene.camera.sensor.resolution;
    let mut peaks = simulation.peaks(&counts).0;
    let plan = &simulation.plan;
    // Grains are independent beyond the first zero of their correlation, 1.22 h. One pixel is added
    // for the pixel width.
    let apart = 1 + (1.22 * plan.grain.speckle_extent_px[0]).ceil() as u32;
    // The peak of a line that the image border cuts is displaced.
    let border = 4.0 * plan.line_half_width_px + 1.0;
    let inside = |row: f64| row > border && row < resolution.y as f64 - border;
    // Spurious peaks due to noise have a small fraction of the line's light.
    let light = |peak: &Peak| peak.intensity;
    peaks.sort_by(|a, b| light(a).total_cmp(&light(b)));
    let faint = peaks.get(peaks.len() / 2).map_or(0.0, light) / 4.0;
    Ok(peaks
        .iter()
        .filter(|p| p.column % apart == 0 && inside(p.row) && p.intensity > faint)
        .map(|p| LaserLineObservation {
            target_point: target.translation,
            target_normal: target.rotation.z_axis,
            pixel: DVec2::new(p.column as f64 + 0.5, p.row),
        })
        .collect())
}

/// Returns the design parameters of a sensor, the start values of its calibration. The assembled
/// sensor deviates from them by these tolerances (standard deviations). Distortion is unknown
/// before calibration.
fn initial_guess(truth: &Calibration, key: RngKey) -> Calibration {
    let mut tolerances: Parameters = [0.0; PARAMETERS.len()];
    tolerances[0] = 0.005 * truth.camera.principal_distance;
    tolerances[1..3].fill(5.0);
    tolerances[8..11].fill(3e-3);
    tolerances[11..14].fill(0.3);
    tolerances[14..].copy_from_slice(&[0.3, 3e-3, 3e-3]);
    let mut random = key.with(u64::MAX).counter_stream();
    let by = tolerances.map(|t| {
        let normal: f64 = StandardNormal.sample(&mut random);
        t * normal
    });
    let mut nominal = truth.perturbed(&by);
    nominal.camera.distortion = truth
        .camera
        .distortion
        .map(|_| Distortion::new_unchecked([0.0; 3], [0.0; 2]));
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

/// Returns two root mean squares over 9 × 9 sensor positions, µm. The first is of the distance
/// between measured and true points, and the second of its standard uncertainty.
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
