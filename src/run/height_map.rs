//! Height map of a scan as 16-bit images, as machine-vision programs read them.

use super::files;
use super::simulation::Simulation;
use crate::error::Result;
use crate::inspect::align::Alignment;
use crate::inspect::cloud::CloudPoint;
use crate::math::{DVec3, Rigid};
use crate::report::picture::encode_grey16;
use serde::Serialize;
use std::ops::Range;
use std::path::Path;

const HEIGHT: &str = "heightmap.png";
const X: &str = "heightmap-x.png";
const INTENSITY: &str = "heightmap-intensity.png";
const SIDECAR: &str = "heightmap.json";

/// Names of the files of a height map.
pub const FILES: [&str; 4] = [HEIGHT, X, INTENSITY, SIDECAR];

/// Value of a pixel without a valid point.
const INVALID: u16 = 0;

/// Content of `heightmap.json`.
#[derive(Serialize)]
struct Sidecar {
    /// Number of columns: columns of the sensor, or positions of resampled profiles.
    columns: usize,
    /// Number of rows: profiles.
    rows: usize,
    /// Value of pixels without a valid point, in all images.
    invalid: u16,
    /// Distance from the laser along the beam.
    z_mm: ScaledImage,
    /// Position along the laser line.
    x_mm: ScaledImage,
    /// Sum of the counts of the line.
    intensity_dn: ScaledImage,
    /// Pose of the laser in the part's frame for each row: three rows of rotation and translation
    /// (mm). The point of a pixel is the pose applied to (x, 0, z).
    part_from_laser: Vec<[[f64; 4]; 3]>,
}

/// Image whose pixels have the value offset + scale · count.
#[derive(Serialize)]
struct ScaledImage {
    file: &'static str,
    scale: f64,
    offset: f64,
}

/// Valid points of a scan in a grid of profiles and columns.
pub(crate) struct HeightGrid {
    /// Number of columns: columns of the sensor, or positions of resampled profiles.
    pub columns: usize,
    /// Points in the order of the scan.
    pub points: Vec<GridPoint>,
    /// Pose of the laser in the part's frame for each profile.
    pub part_from_laser: Vec<Rigid>,
}

/// Point in the laser frame, and its position in the grid.
pub(crate) struct GridPoint {
    pub row: usize,
    pub column: usize,
    pub x: f64,
    pub z: f64,
    pub intensity: f64,
}

impl HeightGrid {
    /// Returns the grid of the valid points of a scan of `frames`.
    pub fn of(
        simulation: &Simulation,
        frames: &Range<u32>,
        points: &[CloudPoint],
        alignment: Option<&Alignment>,
    ) -> HeightGrid {
        let scene = &simulation.scene;
        let filters = &scene.measure.filters;
        let count = filters.average_frames;
        let aligned = alignment.map_or(Rigid::IDENTITY, |fit| fit.part_from_measured);
        let profiles = frames.clone().step_by(count as usize).map(|first| {
            // The points of averaged frames have the pose at the midpoint of the frames.
            let last = scene.scan.frames.min(first + count);
            let middle = f64::from(first) + (f64::from(last - first) - 1.0) / 2.0;
            aligned * scene.part_from_head_at(middle) * scene.head_from_laser
        });
        let part_from_laser: Vec<Rigid> = profiles.collect();
        let laser_from_part: Vec<Rigid> = part_from_laser.iter().map(Rigid::inverse).collect();
        let located = |point: &CloudPoint| {
            let row = (point.frame.checked_sub(frames.start)? / count) as usize;
            let DVec3 { x, z, .. } = laser_from_part.get(row)?.point(point.position);
            let column = match filters.resample {
                Some(step) => (x / step).round() as i64,
                None => i64::from(point.column),
            };
            Some((row, column, x, z, point.intensity))
        };
        let valid = points.iter().filter(|point| point.is_valid());
        let located: Vec<_> = valid.filter_map(located).collect();
        let numbers = located.iter().map(|&(_, column, ..)| column);
        let (least, columns) = match filters.resample {
            Some(_) => {
                let least = numbers.clone().min().unwrap_or(0);
                (least, numbers.max().map_or(1, |most| most + 1 - least))
            }
            None => (0, i64::from(scene.camera.sensor.resolution.x)),
        };
        let point = |(row, column, x, z, intensity): (usize, i64, f64, f64, f64)| GridPoint {
            row,
            column: (column - least) as usize,
            x,
            z,
            intensity,
        };
        HeightGrid {
            columns: columns as usize,
            points: located.into_iter().map(point).collect(),
            part_from_laser,
        }
    }
}

/// Writes the height map of the valid points of a scan of `frames`.
pub fn write(
    simulation: &Simulation,
    frames: &Range<u32>,
    points: &[CloudPoint],
    alignment: Option<&Alignment>,
    out: &Path,
) -> Result<()> {
    let grid = HeightGrid::of(simulation, frames, points, alignment);
    let (rows, columns) = (grid.part_from_laser.len(), grid.columns);
    let image =
        |file, step: Option<f64>, value: &dyn Fn(&GridPoint) -> f64| -> Result<ScaledImage> {
            let channel = ScaledImage::of(file, step, grid.points.iter().map(value));
            let mut counts = vec![INVALID; rows * columns];
            for point in &grid.points {
                counts[point.row * columns + point.column] = channel.count(value(point));
            }
            files::write_bytes(&out.join(file), &encode_grey16(&counts, [columns, rows]))?;
            Ok(channel)
        };
    let steps = simulation.scene.measure.point_steps;
    let sidecar = Sidecar {
        columns,
        rows,
        invalid: INVALID,
        z_mm: image(HEIGHT, steps.map(|[_, z]| z), &|p| p.z)?,
        x_mm: image(X, steps.map(|[x, _]| x), &|p| p.x)?,
        intensity_dn: image(INTENSITY, None, &|p| p.intensity)?,
        part_from_laser: grid.part_from_laser.iter().map(rows_of).collect(),
    };
    files::write_json(&out.join(SIDECAR), &sidecar)
}

impl ScaledImage {
    /// Returns the scale and the offset for values. The counts 1 to 65535 cover their range. A
    /// `step` that is larger than this resolution is the scale.
    fn of(
        file: &'static str,
        step: Option<f64>,
        values: impl Iterator<Item = f64> + Clone,
    ) -> ScaledImage {
        let least = values.clone().fold(f64::INFINITY, f64::min);
        let most = values.fold(f64::NEG_INFINITY, f64::max);
        let (least, most) = if least <= most {
            (least, most)
        } else {
            (0.0, 0.0)
        };
        let finest = (most - least) / f64::from(u16::MAX - 1);
        let scale = step.unwrap_or(0.0).max(finest);
        let scale = if scale > 0.0 { scale } else { 1.0 };
        ScaledImage {
            file,
            scale,
            offset: least - scale,
        }
    }

    fn count(&self, value: f64) -> u16 {
        let count = ((value - self.offset) / self.scale).round();
        // The cast saturates; counts of valid points are at least 1.
        (count as u16).max(1)
    }
}

fn rows_of(pose: &Rigid) -> [[f64; 4]; 3] {
    let rotation = pose.rotation.transpose();
    let [x, y, z] = [rotation.x_axis, rotation.y_axis, rotation.z_axis];
    let t = pose.translation;
    [
        [x.x, x.y, x.z, t.x],
        [y.x, y.y, y.z, t.y],
        [z.x, z.y, z.z, t.z],
    ]
}
