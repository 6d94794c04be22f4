//! Data-sheet figures of a sensor, measured on a plane perpendicular to the beam at several
//! distances.

use crate::error::{Error, Result, printable};
use crate::math::{DMat3, DVec2, DVec3, Rigid};
use crate::mesh::Mesh;
use crate::mesh::shapes::{self, InvalidDimension};
use crate::profile::{Flags, Peak, RowUncertainty, sum_of_both_sides};
use crate::report::chart::short;
use crate::report::sheet_plot::{PlottedPlace, sheet_plot};
use crate::run::memory_estimate::require_study;
use crate::run::output_folder::{Names, OutputFolder};
use crate::run::sensor_figures::{FURTHEST_MM, range_that_ends};
use crate::run::setup::hierarchy_watched;
use crate::run::{RunControl, SensorFigures, Simulation, files};
use crate::scene::{MovingBody, PathMotion, ScanPath, Scene};
use crate::speckle::theory::centroid_noise;
use serde::Serialize;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Number of distances from the laser.
const PLACES: usize = 9;
/// Fraction of the range that is excluded at either end, where the image border cuts the line.
const ENDS: f64 = 0.05;
/// Number of frames per distance. Between frames the plane is displaced within itself by
/// [`SHIFT_RADII`] beam radii.
const FRAMES: u32 = 20;
const SHIFT_RADII: f64 = 4.0;
/// Number of images of one surface area with independent noise.
const IMAGES: u32 = 32;
/// Numbers of columns and profiles over which means are computed.
pub const MEAN_OF: [usize; 2] = [100, 10];
/// Number of step positions within a column. The next constant is the number of evaluated columns
/// on either side of the step.
const SUBPIXEL_EDGES: u32 = 16;
const BESIDE_EDGE: f64 = 12.0;
/// Height of the step, in standard deviations of the line's image. The two lines are then detected
/// as one, whose centre changes in proportion to the light of both sides in the column.
const EDGE_STEP_SIGMAS: f64 = 0.5;

/// Content of `sheet.json`: the figures of a data sheet.
#[derive(Debug, Serialize)]
pub struct SheetSummary {
    /// Path of the sensor file or scene.
    #[serde(serialize_with = "printable::in_json")]
    pub sensor: PathBuf,
    /// Results by distance, from the near to the far end of the range.
    pub places: Vec<SheetPlace>,
    /// Range (maximum minus minimum) of [`SheetPlace::linearity_um`], µm.
    pub linearity_um: Option<f64>,
    /// Linearity relative to the evaluated range, percent.
    pub linearity_percent: Option<f64>,
    /// Path of the plot.
    #[serde(serialize_with = "printable::in_json")]
    pub picture: PathBuf,
}

/// Standard deviation in simulated measurements, and its prediction, µm.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct MeasuredAndPredicted {
    /// Observed standard deviation.
    pub found_um: f64,
    /// Standard deviation predicted from optics and image.
    pub predicted_um: f64,
}

/// Results for a plane perpendicular to the beam at one distance. Heights are along the beam, from
/// points without a flag other than UNCERTAINTY_NOT_VALID. Predictions are not valid where lines are
/// too narrow for a valid uncertainty.
#[derive(Debug, Clone, Serialize)]
pub struct SheetPlace {
    /// Distance from the laser along the beam, mm.
    pub distance_mm: f64,
    /// Length per pixel along the line and along the beam, µm.
    pub um_per_px: [f64; 2],
    /// Number of measured points.
    pub points: usize,
    /// Repeatability of single points without motion, at constant speckle.
    pub repeatability: Option<MeasuredAndPredicted>,
    /// Standard deviation of single points over different surface areas, including speckle.
    pub spatial_std: Option<MeasuredAndPredicted>,
    /// Standard deviation of height from 0.3905·√(hσ)·C of [`centroid_noise`] and from noise. It is
    /// valid for a round pupil and pixels smaller than a speckle grain.
    pub speckle_theory_um: Option<f64>,
    /// Sum Σ_k ρ_k of the correlation of points at a lag of k columns, observed and predicted.
    pub correlation_length_columns: Option<[f64; 2]>,
    /// Means over `MEAN_OF[0]` adjacent columns, over different surface areas.
    pub moving_average_100_columns: Option<MeasuredAndPredicted>,
    /// Means over `MEAN_OF[1]` profiles of different surface areas, by column.
    pub mean_of_profiles: Option<MeasuredAndPredicted>,
    /// Indicated minus true height, averaged over all columns and surface areas, and its standard
    /// uncertainty.
    pub linearity_um: Option<[f64; 2]>,
    /// Distance along the profile from 10 % to 90 % of a low step, without speckle and noise.
    /// Points are connected by straight lines. The value is the mean over positions of the step
    /// within a column.
    pub edge_response_10_90_um: Option<f64>,
}

/// Measures the sensor of a scene over its measuring range, and writes `sheet.json` and
/// `sheet.svg`. The target is a plane with the surface of the scene's part. Exposure and
/// calibration are taken from the scene.
///
/// # Errors
/// Returns an error if the camera sees no laser light at any distance, and the errors of
/// [`Simulation::new`].
pub fn sheet<'a>(
    mut scene: Scene,
    out: impl Into<OutputFolder<'a>>,
    control: &RunControl,
) -> Result<SheetSummary> {
    require_study(&scene)?;
    // Effects that cause scatter must be simulated, whatever the tolerance.
    scene.tolerance_um = None;
    let names = Names::of(["sheet.json", "sheet.svg"]);
    let out = out.into().claim(&scene.inputs, &names)?.path;
    let figures = {
        let (scene, accel) = hierarchy_watched(&scene, control)?;
        SensorFigures::of_sensor(&scene, &accel)
    };
    let no_range = |why: String| {
        let path = printable::path(&scene.path);
        Error::Usage(format!(
            "{path}: {why}; `lasertrace check` says where laser and camera look"
        ))
    };
    let figures = figures.ok_or_else(|| {
        let nothing = "the camera sees nothing of the laser's light, wherever it falls, so there is no range to measure";
        no_range(nothing.to_owned())
    })?;
    let [near, far] = figures.ends();
    if far > FURTHEST_MM {
        let expected = range_that_ends();
        return Err(no_range(format!(
            "found a measuring range up to {far:.3e} mm from the laser, expected {expected}"
        )));
    }
    let ends = [near + ENDS * (far - near), far - ENDS * (far - near)];
    let done = AtomicU64::new(0);
    let mut places = Vec::new();
    for i in 0..PLACES {
        let share = i as f64 / (PLACES - 1) as f64;
        let distance = ends[0] + share * (ends[1] - ends[0]);
        if let Some(um_per_px) = SensorFigures::um_per_px(&scene, distance) {
            let target = PlaneTarget {
                scene: &scene,
                distance,
                size: 8.0 * far,
                um_per_px,
                done: &done,
            };
            places.push(target.measured(control)?);
        }
        done.store((i as u64 + 1) * STEPS, Relaxed);
        (control.progress)((i as u64 + 1) * STEPS);
    }
    if places.is_empty() {
        let why =
            "the camera does not see the middle of the laser beam, where heights are measured";
        return Err(no_range(why.to_owned()));
    }
    let means = places
        .iter()
        .filter_map(|p| p.linearity_um)
        .map(|[mean, _]| mean);
    let [least, most] = means.fold([f64::INFINITY, f64::NEG_INFINITY], |[a, b], m| {
        [a.min(m), b.max(m)]
    });
    let linearity_um = (most >= least).then_some(most - least);
    let summary = SheetSummary {
        sensor: scene.path.clone(),
        linearity_um,
        linearity_percent: linearity_um.map(|um| 0.1 * um / (ends[1] - ends[0])),
        places,
        picture: out.join("sheet.svg"),
    };
    let svg = sheet_plot(&summary.plotted(), &summary.headline());
    files::write_bytes(&summary.picture, svg.as_bytes())?;
    files::write_json(&out.join("sheet.json"), &summary)?;
    Ok(summary)
}

/// Number of images per distance.
const STEPS: u64 = (FRAMES + IMAGES + SUBPIXEL_EDGES) as u64;

/// Number of progress steps of [`sheet`].
pub const SHEET_STEPS: u64 = PLACES as u64 * STEPS;

/// Target in front of the sensor.
struct PlaneTarget<'a> {
    scene: &'a Scene,
    /// Distance from the laser along the beam, mm.
    distance: f64,
    size: f64,
    /// Length per pixel along the line and along the beam, at this distance.
    um_per_px: [f64; 2],
    /// Number of images of all targets.
    done: &'a AtomicU64,
}

impl PlaneTarget<'_> {
    /// Returns the scene with a part whose top is at the distance and `height` above its origin.
    /// The part moves by `step` (laser frame) between frames.
    fn scene(&self, mesh: Mesh, height: f64, step: DVec3, frames: u32) -> Scene {
        let from = &self.scene.head_from_laser;
        let part = Rigid {
            // The part's z points towards the laser, and its x is along the line.
            rotation: DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)),
            translation: DVec3::Z * (self.distance + height) - step * (f64::from(frames - 1) / 2.0),
        };
        let mut scene = self.scene.clone();
        scene.mesh = Arc::new(mesh);
        scene.copies = vec![Rigid::IDENTITY].into();
        scene.part_at_rest = *from * part;
        scene.scan = ScanPath {
            frames,
            moves: MovingBody::Part,
            motion: PathMotion::Linear {
                step: from.vector(step),
            },
            ..ScanPath::at_rest()
        };
        scene
    }

    /// Counts an image. Returns an error if the work is cancelled.
    fn taken(&self, control: &RunControl) -> Result<()> {
        (control.progress)(self.done.fetch_add(1, Relaxed) + 1);
        control.check()
    }

    fn measured(&self, control: &RunControl) -> Result<SheetPlace> {
        let radius = self.scene.laser.radius(DVec3::Z * self.distance);
        let plane = shapes::plane(DVec2::splat(self.size)).map_err(|e| self.no_target(&e))?;
        let scene = self.scene(plane, 0.0, DVec3::Y * (SHIFT_RADII * radius), FRAMES);
        let simulation = Simulation::watched(&scene, control)?;
        let sensor = Heights::of(&simulation);
        let still = self.repeated(&simulation, &sensor, control)?;
        let mut frames = Vec::new();
        for frame in 0..FRAMES {
            frames.push(sensor.points(&simulation, &simulation.image_of(&simulation.pose(frame))));
            self.taken(control)?;
        }
        let points: Vec<HeightPoint> = frames.iter().flatten().copied().collect();
        let n = points.len() as f64;
        let mut place = SheetPlace {
            distance_mm: self.distance,
            um_per_px: self.um_per_px,
            points: points.len(),
            repeatability: still,
            spatial_std: None,
            speckle_theory_um: None,
            correlation_length_columns: None,
            moving_average_100_columns: None,
            mean_of_profiles: None,
            linearity_um: None,
            edge_response_10_90_um: self.edge(&simulation, control)?,
        };
        if points.len() < 2 {
            return Ok(place);
        }
        let mean = points.iter().map(|p| self.distance - p.z).sum::<f64>() / n;
        let errors: Vec<Vec<(u32, f64)>> = frames
            .iter()
            .map(|points| {
                points
                    .iter()
                    .map(|p| (p.column, self.distance - p.z - mean))
                    .collect()
            })
            .collect();
        let square = errors.iter().flatten().map(|(_, e)| e * e).sum::<f64>() / (n - 1.0);
        let rms = |of: &dyn Fn(&HeightPoint) -> f64| {
            (points.iter().map(|p| of(p).powi(2)).sum::<f64>() / n).sqrt()
        };
        let predicted = rms(&|p| p.sigma);
        place.spatial_std = Some(MeasuredAndPredicted {
            found_um: 1e3 * square.sqrt(),
            predicted_um: 1e3 * predicted,
        });
        let noise = rms(&|p| p.noise);
        place.speckle_theory_um = closed_form(&simulation, &points).map(|mm| 1e3 * mm.hypot(noise));
        let rho = simulation.column_correlation();
        let share = (noise / predicted).powi(2).min(1.0);
        let correlated = share + (1.0 - share) * sum_of_both_sides(rho);
        let found = found_correlation(&errors, 2 * rho.len(), square);
        place.correlation_length_columns = Some([found, correlated]);
        let [columns, profiles] = MEAN_OF;
        place.moving_average_100_columns =
            spread_of_means(&errors, columns).map(|found| MeasuredAndPredicted {
                found_um: 1e3 * found,
                predicted_um: 1e3 * predicted * mean_over(columns, share, rho).sqrt(),
            });
        place.mean_of_profiles =
            spread_over_frames(&errors, profiles).map(|found| MeasuredAndPredicted {
                found_um: 1e3 * found,
                predicted_um: 1e3 * predicted / (profiles as f64).sqrt(),
            });
        place.linearity_um = Some([1e3 * mean, 1e3 * (square * correlated / n).sqrt()]);
        Ok(place)
    }

    /// Returns the standard deviation of columns about their means over images of one surface area.
    /// Only columns that are measured in all images count.
    fn repeated(
        &self,
        simulation: &Simulation,
        sensor: &Heights,
        control: &RunControl,
    ) -> Result<Option<MeasuredAndPredicted>> {
        let light = simulation.irradiance(0);
        let mut by_column = vec![Vec::new(); simulation.scene.camera.sensor.resolution.x as usize];
        for image in 0..IMAGES {
            for point in sensor.points(simulation, &simulation.counts_near_light(image, &light)) {
                by_column[point.column as usize].push(point);
            }
            self.taken(control)?;
        }
        let whole = || {
            by_column
                .iter()
                .filter(|points| points.len() == IMAGES as usize)
        };
        let n = IMAGES as f64;
        let (mut found, mut predicted, mut columns) = (0.0, 0.0, 0.0);
        for points in whole() {
            let mean = points.iter().map(|p| p.z).sum::<f64>() / n;
            found += points.iter().map(|p| (p.z - mean).powi(2)).sum::<f64>() / (n - 1.0);
            predicted += points.iter().map(|p| p.noise.powi(2)).sum::<f64>() / n;
            columns += 1.0;
        }
        Ok((columns > 0.0).then(|| MeasuredAndPredicted {
            found_um: 1e3 * f64::sqrt(found / columns),
            predicted_um: 1e3 * f64::sqrt(predicted / columns),
        }))
    }

    /// Returns the error for an impossible target.
    fn no_target(&self, wrong: &InvalidDimension) -> Error {
        Error::Usage(format!(
            "{}: the target at {:.4} mm from the laser, where a pixel is {:.4} µm of height: its {} is not {}; move the \
             camera so that it sees a shorter range",
            printable::path(&self.scene.path),
            self.distance,
            self.um_per_px[1],
            wrong.argument,
            wrong.expected
        ))
    }

    /// Returns the width of the response to a low step across the line. It is averaged over
    /// [`SUBPIXEL_EDGES`] positions of the step within a column, since the response of single
    /// profiles depends on the position. `simulation` is the simulation of the plane.
    fn edge(&self, simulation: &Simulation, control: &RunControl) -> Result<Option<f64>> {
        let sensor = Heights::of(simulation);
        let [column, row] = self.um_per_px.map(|um| 1e-3 * um);
        let step = EDGE_STEP_SIGMAS * simulation.plan.line_half_width_px / 2.0 * row;
        let height = self.size.max(4.0 * step);
        let size = DVec3::new(self.size, self.size, height);
        let block = shapes::step_block(size, step).map_err(|e| self.no_target(&e))?;
        let by = DVec3::X * (column / f64::from(SUBPIXEL_EDGES));
        let mut scene = self.scene(block, height, by, SUBPIXEL_EDGES);
        scene.speckle = None;
        scene.camera.sensor.noise = None;
        scene.camera.sensor.exposure_ms = simulation.scene.camera.sensor.exposure_ms;
        scene.auto_exposure = None;
        let edges = Simulation::watched(&scene, control)?;
        // The step is lower for x < 0.
        let share = |z: f64| (self.distance + step - z) / step;
        let mut widths = Vec::new();
        for frame in 0..SUBPIXEL_EDGES {
            let at = (f64::from(frame) - f64::from(SUBPIXEL_EDGES - 1) / 2.0) * by.x;
            let points = sensor.all_points(&edges, &edges.image_of(&edges.pose(frame)));
            let response = points.iter().map(|p| (p.x - at, share(p.z)));
            let mut response: Vec<(f64, f64)> = response
                .filter(|(x, _)| x.abs() < BESIDE_EDGE * column)
                .collect();
            response.sort_by(|a, b| a.0.total_cmp(&b.0));
            widths.extend(rise(&response));
            self.taken(control)?;
        }
        // A mean over only part of the positions would depend on their selection.
        let all = widths.len() == SUBPIXEL_EDGES as usize;
        Ok(all.then(|| 1e3 * widths.iter().sum::<f64>() / widths.len() as f64))
    }
}

/// Returns the distance from 10 % to 90 % of a step from 0 to 1 near x = 0. The points (x, height)
/// are in order of x, and are connected by straight lines. Returns `None` if the points do not
/// reach both levels.
fn rise(response: &[(f64, f64)]) -> Option<f64> {
    let crossings =
        (1..response.len()).filter(|&i| response[i - 1].1 < 0.5 && response[i].1 >= 0.5);
    let middle = crossings.min_by(|&a, &b| response[a].0.abs().total_cmp(&response[b].0.abs()))?;
    let before = (0..middle).rev().find(|&i| response[i].1 <= 0.1)?;
    let after = (middle..response.len()).find(|&i| response[i].1 >= 0.9)?;
    let between =
        |a: (f64, f64), b: (f64, f64), level: f64| a.0 + (b.0 - a.0) * (level - a.1) / (b.1 - a.1);
    let low = between(response[before], response[before + 1], 0.1);
    Some(between(response[after - 1], response[after], 0.9) - low)
}

/// Point in the laser frame, mm.
#[derive(Debug, Clone, Copy)]
struct HeightPoint {
    column: u32,
    x: f64,
    z: f64,
    /// Stated standard uncertainties of z: total, and noise only.
    sigma: f64,
    noise: f64,
    /// Height change per row, mm.
    per_row: f64,
    /// Standard deviation of the line, px.
    width: f64,
}

/// Conversion of detected peaks to points in the laser frame.
struct Heights {
    laser_from_camera: Rigid,
}

impl Heights {
    fn of(simulation: &Simulation) -> Heights {
        let head_from_camera = simulation.calibration.head_from_camera;
        Heights {
            laser_from_camera: simulation.scene.head_from_laser.inverse() * head_from_camera,
        }
    }

    fn point(
        &self,
        simulation: &Simulation,
        peak: &Peak,
        error: &RowUncertainty,
    ) -> Option<HeightPoint> {
        let calibration = &simulation.calibration;
        let [before, place, after] = [-0.5, 0.0, 0.5].map(|by| {
            let point = calibration.point_at(peak.place() + DVec2::Y * by)?;
            Some(self.laser_from_camera.point(point))
        });
        let per_row = (after?.z - before?.z).abs();
        let by_field = match &simulation.systematic {
            None => DVec3::ZERO,
            Some(errors) => {
                let jacobian = calibration.point_jacobian(peak.place())?;
                let from_laser = &simulation.scene.head_from_laser;
                from_laser.inverse().vector(errors.field_shift(&jacobian))
            }
        };
        let place = place? + by_field;
        Some(HeightPoint {
            column: peak.column,
            x: place.x,
            z: place.z,
            sigma: per_row * error.sigma,
            noise: per_row * error.noise,
            per_row,
            width: peak.sigma,
        })
    }

    fn all_points(
        &self,
        simulation: &Simulation,
        image: &dyn crate::camera::ImageColumns,
    ) -> Vec<HeightPoint> {
        let (peaks, errors) = simulation.peaks(image);
        let points = peaks.iter().zip(&errors);
        points
            .filter_map(|(peak, error)| self.point(simulation, peak, error))
            .collect()
    }

    /// Returns the points without a flag, and those whose stated uncertainty is not valid.
    fn points(
        &self,
        simulation: &Simulation,
        image: &dyn crate::camera::ImageColumns,
    ) -> Vec<HeightPoint> {
        let (peaks, errors) = simulation.peaks(image);
        let points = peaks
            .iter()
            .zip(&errors)
            .filter(|(peak, _)| Flags::UNCERTAINTY_NOT_VALID.contains(peak.flags));
        points
            .filter_map(|(peak, error)| self.point(simulation, peak, error))
            .collect()
    }
}

/// Returns the root mean square of the height errors from [`centroid_noise`], mm.
fn closed_form(simulation: &Simulation, points: &[HeightPoint]) -> Option<f64> {
    let contrast = simulation.scene.speckle?.coherence.contrast();
    let h = simulation.plan.grain.speckle_extent_px[1];
    let law = |p: &HeightPoint| p.per_row * centroid_noise(h, p.width, contrast);
    root_mean_square(points.iter().map(law))
}

/// Estimates Σ_k ρ_k up to the lag `lags`, in columns, from errors with the mean square `square`.
fn found_correlation(frames: &[Vec<(u32, f64)>], lags: usize, square: f64) -> f64 {
    let at = |lag: usize| {
        let (mut sum, mut count) = (0.0, 0.0);
        for errors in frames {
            for (a, b) in errors.iter().zip(errors.iter().skip(lag)) {
                if b.0 - a.0 == lag as u32 {
                    sum += a.1 * b.1;
                    count += 1.0;
                }
            }
        }
        sum / f64::max(count, 1.0) / square
    };
    1.0 + 2.0 * (1..=lags).map(at).sum::<f64>()
}

/// Returns the variance of the mean over n columns relative to one column. The fraction `noise` of
/// the variance is uncorrelated; the rest has the correlation `rho`.
fn mean_over(columns: usize, noise: f64, rho: &[f64]) -> f64 {
    let n = columns as f64;
    let pairs = rho.iter().enumerate().skip(1).take(columns - 1);
    let pairs: f64 = pairs.map(|(k, rho)| 2.0 * (n - k as f64) * rho).sum();
    noise / n + (1.0 - noise) * (n + pairs) / (n * n)
}

/// Returns the root mean square of the means over `columns` adjacent columns.
fn spread_of_means(frames: &[Vec<(u32, f64)>], columns: usize) -> Option<f64> {
    let runs = frames
        .iter()
        .flat_map(|errors| errors.chunks_exact(columns));
    let whole = runs.filter(|run| (run[columns - 1].0 - run[0].0) as usize + 1 == columns);
    root_mean_square(whole.map(|run| run.iter().map(|(_, e)| e).sum::<f64>() / columns as f64))
}

/// Returns the root mean square of the means over `count` frames, for columns that are measured in
/// all of them.
fn spread_over_frames(frames: &[Vec<(u32, f64)>], count: usize) -> Option<f64> {
    let groups = frames.chunks_exact(count).flat_map(|frames| {
        let mut all: Vec<(u32, f64)> = frames.concat();
        all.sort_by_key(|&(column, _)| column);
        let of_column = all.chunk_by(|a, b| a.0 == b.0).filter(|e| e.len() == count);
        let means = of_column.map(|e| e.iter().map(|(_, e)| e).sum::<f64>() / count as f64);
        means.collect::<Vec<f64>>()
    });
    root_mean_square(groups)
}

/// Returns the root mean square; `None` for fewer than two values.
fn root_mean_square(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (sum, count) = values.fold((0.0, 0u32), |(sum, n), v| (sum + v * v, n + 1));
    (count > 1).then(|| (sum / f64::from(count)).sqrt())
}

impl SheetSummary {
    /// Returns a summary of the result as text.
    pub fn headline(&self) -> [String; 2] {
        let um = |figure: Option<MeasuredAndPredicted>| {
            figure.map_or("–".to_owned(), |f| format!("{} µm", short(f.found_um)))
        };
        let linearity = match (self.linearity_um, self.linearity_percent) {
            (Some(um), Some(percent)) => format!("{} µm ({} % of it)", short(um), short(percent)),
            _ => "–".to_owned(),
        };
        let middle = &self.places[self.places.len() / 2];
        [
            format!(
                "At {} mm: repeatability {}, standard deviation over positions {}; linearity over the range {linearity}",
                short(middle.distance_mm),
                um(middle.repeatability),
                um(middle.spatial_std),
            ),
            "Standard deviations of heights of single points on a plane square to the beam; points without a flag."
                .to_owned(),
        ]
    }

    /// Returns a table with one row per distance.
    pub fn table(&self) -> String {
        let heads = [
            "distance", "x / px", "z / px", "repeat", "stated", "place", "stated", "closed", "n_c",
            "stated", "of 100", "stated", "of 10", "stated", "linear", "± 2u", "edge",
        ];
        let mut text = String::new();
        for row in std::iter::once(heads.map(str::to_owned).to_vec()).chain(self.rows()) {
            for cell in row {
                text += &format!("{cell:>9}");
            }
            text.push('\n');
        }
        text
    }

    /// Returns the rows of [`Self::table`]: the distance in mm, then values in µm, except the
    /// dimensionless n_c.
    pub fn rows(&self) -> impl Iterator<Item = Vec<String>> {
        let of = |value: Option<f64>| value.map_or("–".to_owned(), short);
        let both = move |figure: Option<MeasuredAndPredicted>| {
            [
                of(figure.map(|f| f.found_um)),
                of(figure.map(|f| f.predicted_um)),
            ]
        };
        self.places.iter().map(move |place| {
            let mut row = vec![short(place.distance_mm)];
            row.extend(place.um_per_px.map(short));
            row.extend(both(place.repeatability));
            row.extend(both(place.spatial_std));
            row.push(of(place.speckle_theory_um));
            row.extend([0, 1].map(|i| of(place.correlation_length_columns.map(|n| n[i]))));
            row.extend(both(place.moving_average_100_columns));
            row.extend(both(place.mean_of_profiles));
            row.push(of(place.linearity_um.map(|l| l[0])));
            row.push(of(place.linearity_um.map(|l| 2.0 * l[1])));
            row.push(of(place.edge_response_10_90_um));
            row
        })
    }

    fn plotted(&self) -> Vec<PlottedPlace> {
        let both =
            |figure: Option<MeasuredAndPredicted>| figure.map(|f| [f.found_um, f.predicted_um]);
        let of = |place: &SheetPlace| PlottedPlace {
            distance_mm: place.distance_mm,
            repeatability: both(place.repeatability),
            spatial_std: both(place.spatial_std),
            moving_average_100_columns: both(place.moving_average_100_columns),
            mean_of_profiles: both(place.mean_of_profiles),
            correlation_length_columns: place.correlation_length_columns,
            linearity: place.linearity_um,
            column_um: place.um_per_px[0],
            edge_um: place.edge_response_10_90_um,
        };
        self.places.iter().map(of).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Purpose, RngKey};

    /// Returns heights in columns of width 1 for a step at `x`, integrated over `width`.
    fn ramp(x: f64, width: f64, noise: &dyn Fn(i32) -> f64) -> Vec<(f64, f64)> {
        let height = |column: f64| ((column - x) / width + 0.5).clamp(0.0, 1.0);
        let point = |i: i32| (f64::from(i) - x, height(f64::from(i)) + noise(i));
        (-12..=12).map(point).collect()
    }

    /// An ideal step has a width of 0.8 columns at every position. A step integrated over `w`
    /// columns has a width of 0.8·w. Straight lines between columns shift each end outwards by less
    /// than half a column.
    #[test]
    fn the_width_of_a_step_does_not_depend_on_its_position() {
        for seed in [1, 2, 3] {
            let key = RngKey::new(seed, Purpose::Samples);
            let noise = |i: i32| 0.02 * (key.uniform((i + 20) as u64) - 0.5);
            let mean = |width: f64, shift: f64| {
                let at = |k: u32| (f64::from(k) + 0.5) / f64::from(SUBPIXEL_EDGES) - 0.5 + shift;
                let widths =
                    (0..SUBPIXEL_EDGES).map(|k| rise(&ramp(at(k), width, &noise)).unwrap());
                widths.sum::<f64>() / f64::from(SUBPIXEL_EDGES)
            };
            let shift = key.uniform(100) / f64::from(SUBPIXEL_EDGES);
            // Tolerance: the noise of two points is 0.02 for a step of height 1.
            assert!(
                (mean(1e-9, shift) - 0.8).abs() < 0.03,
                "{}",
                mean(1e-9, shift)
            );
            for width in [1.0, 2.0, 4.0] {
                let found = mean(width, shift);
                assert!(
                    (0.8 * width - 0.05..0.8 * width + 1.0).contains(&found),
                    "{width} {found}"
                );
                assert!((found - mean(width, 0.0)).abs() < 0.05, "{width} {found}");
            }
        }
        assert_eq!(rise(&[(-1.0, 0.0), (0.0, 0.6), (1.0, 0.7)]), None);
        assert_eq!(rise(&[]), None);
    }
}
