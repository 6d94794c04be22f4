//! Scan of a head with several cameras: a scan of each camera, and the cloud of all cameras.

use super::simulation::Simulation;
use crate::inspect::cloud::{CloudPoint, of_frame};
use crate::inspect::features::{
    Element, FeaturePoint, PointErrors, SpeckleCorrelation, SystematicShift,
};
use crate::math::{DVec2, DVec3};
use crate::profile::Covariance;
use rayon::prelude::*;
use std::cmp::Ordering;
use std::ops::Range;

/// Cameras of a head. In the cloud of all cameras, the columns of a camera follow those of the
/// cameras before it.
pub(super) struct Head<'a> {
    cameras: Vec<HeadCamera<'a>>,
}

struct HeadCamera<'a> {
    simulation: &'a Simulation,
    /// Columns in the cloud of all cameras.
    columns: Range<u32>,
}

/// Points of one camera in a frame, by their position on the line.
struct LinePoints {
    /// Points by increasing tangent.
    rays: Vec<OnRay>,
    /// Largest change of the tangent over half a column.
    widest: f64,
}

/// Point of one camera on a ray of the laser.
struct OnRay {
    /// Tangent of the fan angle, 0 for a laser without a fan.
    tangent: f64,
    /// Change of the tangent over half a column.
    half_column: f64,
    point: CloudPoint,
}

impl OnRay {
    /// Compares the points of two cameras. The smaller one is used: a valid point, or the point with
    /// the smaller uncertainty.
    fn order(&self, other: &OnRay) -> Ordering {
        let [a, b] = [&self.point, &other.point];
        let by_uncertainty = || a.u_position.total_cmp(&b.u_position);
        (b.is_valid().cmp(&a.is_valid()))
            .then_with(by_uncertainty)
            .then(a.column.cmp(&b.column))
    }
}

impl<'a> Head<'a> {
    pub fn of(simulations: impl IntoIterator<Item = &'a Simulation>) -> Head<'a> {
        let mut before = 0;
        let camera = |simulation: &'a Simulation| {
            let start = before;
            before += simulation.scene.camera.sensor.resolution.x;
            HeadCamera {
                simulation,
                columns: start..before,
            }
        };
        Head {
            cameras: simulations.into_iter().map(camera).collect(),
        }
    }

    /// Returns the number of columns of all cameras.
    pub fn columns(&self) -> u32 {
        self.cameras.last().map_or(0, |camera| camera.columns.end)
    }

    /// Returns the simulation of the camera that measured a point, and the point with the column of
    /// this camera.
    fn of_camera(&self, point: &CloudPoint) -> (usize, &Simulation, CloudPoint) {
        let i = self
            .cameras
            .partition_point(|camera| camera.columns.end <= point.column);
        let HeadCamera {
            simulation,
            columns,
        } = &self.cameras[i];
        let point = CloudPoint {
            column: point.column - columns.start,
            ..*point
        };
        (i, simulation, point)
    }

    /// Returns the points of the first camera that has valid ones, with the columns of this camera.
    pub fn of_one_camera(&self, points: &[CloudPoint]) -> (&Simulation, Vec<CloudPoint>) {
        let of = |camera: &HeadCamera| {
            let of_camera = points.iter().filter(|p| camera.columns.contains(&p.column));
            let own = |p: &CloudPoint| self.of_camera(p).2;
            of_camera.map(own).collect::<Vec<CloudPoint>>()
        };
        let mut all = self.cameras.iter().map(|c| (c.simulation, of(c)));
        let is_valid = |(_, points): &(_, Vec<CloudPoint>)| points.iter().any(|p| p.is_valid());
        let first = || (self.cameras[0].simulation, Vec::new());
        all.find(is_valid).unwrap_or_else(first)
    }

    /// Returns the points of all cameras in the order of frames, then columns. Where two cameras
    /// measured one ray of the laser within half a column, the point with the smaller uncertainty is
    /// used; points without flags have priority. `points` are the points of each camera.
    pub fn merged(&self, points: &[&[CloudPoint]], frames: &Range<u32>) -> Vec<CloudPoint> {
        let merged = |frame: u32| {
            let lines: Vec<LinePoints> = (self.cameras.iter().zip(points))
                .map(|(camera, points)| camera.line_points(&points[of_frame(points, frame)], frame))
                .collect();
            let mut used = Vec::new();
            for (i, line) in lines.iter().enumerate() {
                let is_used = |ray: &&OnRay| {
                    let mut others = lines.iter().enumerate().filter(|(j, _)| *j != i);
                    !others.any(|(_, other)| other.has_better(ray))
                };
                used.extend(line.rays.iter().filter(is_used).map(|ray| ray.point));
            }
            used.sort_by_key(|point| point.column);
            used
        };
        frames
            .clone()
            .into_par_iter()
            .flat_map_iter(merged)
            .collect()
    }
}

impl LinePoints {
    /// Returns whether this camera has a better point on the ray of a point of another camera.
    fn has_better(&self, ray: &OnRay) -> bool {
        let widest = self.widest.max(ray.half_column);
        let start = (self.rays).partition_point(|r| r.tangent < ray.tangent - widest);
        self.rays[start..]
            .iter()
            .take_while(|r| r.tangent <= ray.tangent + widest)
            .filter(|r| (r.tangent - ray.tangent).abs() <= r.half_column.max(ray.half_column))
            .any(|r| r.order(ray) == Ordering::Less)
    }
}

impl HeadCamera<'_> {
    /// Returns the points of a frame by their position on the line.
    fn line_points(&self, points: &[CloudPoint], frame: u32) -> LinePoints {
        let scene = &self.simulation.scene;
        let laser_from_part = self.simulation.head_pose(frame).part_from_laser.inverse();
        let laser_from_head = scene.head_from_laser.inverse();
        let on_ray = |point: &CloudPoint| {
            let pixel = DVec2::new(f64::from(point.column) + 0.5, point.row);
            let at = laser_from_part.point(point.position);
            let jacobian = self.simulation.calibration.point_jacobian(pixel);
            let by_column = jacobian.map_or(DVec3::ZERO, |jacobian| {
                laser_from_head.vector(jacobian.by_pixel[0])
            });
            let slope = (by_column.x - at.x / at.z * by_column.z) / at.z;
            let (tangent, half_column) = match scene.laser.fan {
                Some(_) => (at.x / at.z, slope.abs() / 2.0),
                None => (0.0, 0.0),
            };
            OnRay {
                tangent,
                half_column,
                point: CloudPoint {
                    column: point.column + self.columns.start,
                    ..*point
                },
            }
        };
        let mut rays: Vec<OnRay> = points.iter().map(on_ray).collect();
        rays.sort_by(|a, b| a.tangent.total_cmp(&b.tangent));
        LinePoints {
            widest: rays.iter().map(|r| r.half_column).fold(0.0, f64::max),
            rays,
        }
    }
}

impl PointErrors for Head<'_> {
    fn of_point(&self, point: &CloudPoint) -> Option<FeaturePoint> {
        let (_, simulation, own) = self.of_camera(point);
        let errors = simulation.of_point(&own)?;
        Some(FeaturePoint {
            column: point.column,
            ..errors
        })
    }

    fn correlation(&self, points: &[CloudPoint]) -> SpeckleCorrelation {
        let (simulation, points) = self.of_one_camera(points);
        PointErrors::correlation(simulation, &points)
    }

    fn edge_margin(&self, point: &CloudPoint) -> f64 {
        let (_, simulation, own) = self.of_camera(point);
        simulation.edge_margin(&own)
    }

    fn is_open(&self, point: &CloudPoint, distance: f64) -> bool {
        let (_, simulation, own) = self.of_camera(point);
        simulation.is_open(&own, distance)
    }

    /// Scenes with several cameras have an exact calibration.
    fn curvature_error(&self, point: &CloudPoint, element: &Element) -> f64 {
        let (_, simulation, own) = self.of_camera(point);
        simulation.curvature_error(&own, element)
    }

    fn calibration_covariance(&self) -> &Covariance {
        self.cameras[0].simulation.calibration_covariance()
    }

    /// Errors of different cameras have different components.
    fn systematic(&self, point: &CloudPoint) -> Vec<SystematicShift> {
        let (i, simulation, own) = self.of_camera(point);
        let errors = &simulation.scene.systematic.errors;
        let mut shifts = simulation.systematic(&own);
        for shift in &mut shifts {
            if errors[shift.component.0].effect.is_of_camera() {
                shift.component.0 += i * errors.len();
            }
        }
        shifts
    }

    fn has_systematic(&self) -> bool {
        self.cameras[0].simulation.has_systematic()
    }
}
