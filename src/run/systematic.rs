//! Systematic errors of sensor and stage: drawn once per run for the simulated sensor, and
//! propagated to the points for the stated uncertainties.
//!
//! An error with standard deviation σ has the value σ·Σ_k w_k·n_k at a point. The n_k are
//! independent normal numbers of the seed, one for each node k, and Σ_k w_k² = 1. The same sum gives
//! the covariance of two points, so errors of features and means follow exactly from the nodes. An
//! error that is constant has one node. An error with correlation length L has nodes at multiples
//! of L/2 and Gaussian weights of standard deviation L/2, which give the correlation exp(−(d/L)²).

use super::error_model::perfect_calibration;
use crate::camera::Camera;
use crate::laser::Laser;
use crate::math::rng::{Purpose, RngKey};
use crate::math::{DMat3, DVec2, DVec3, Rigid, normal_quantile};
use crate::profile::{Calibration, PointJacobian};
use crate::scene::{ErrorCorrelation, ErrorEffect, MovingBody, PathMotion, Scene, SystematicError};
use glam::DQuat;
use std::f64::consts::TAU;

/// Number of nodes on either side of a point. The weight of the first neglected node is e⁻¹⁵.
const NODES: i64 = 5;

/// Steps of the numerical derivatives: rad and relative, and mm.
const SMALL_ANGLE: f64 = 1e-4;
const SMALL_SHIFT: f64 = 1e-3;

/// Axes and travel of the stage.
struct Stage {
    /// Direction of travel, horizontal axis and vertical axis, in the frame of the moving body.
    axes: [DVec3; 3],
    /// Travel at each frame, for a list of poses; otherwise the travel per frame.
    travel: Travel,
    moves: MovingBody,
    pivot: DVec3,
}

enum Travel {
    PerFrame(f64),
    AtFrames(Vec<f64>),
}

/// Poses of head and sensor in a run with systematic errors.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TruePoses {
    pub part_from_head: Rigid,
    pub head_from_laser: Rigid,
    pub head_from_camera: Rigid,
}

/// Position of a point for the correlations of the errors.
#[derive(Debug, Clone, Copy, Default)]
struct Position {
    time_s: f64,
    travel_mm: f64,
    /// Fan angle, rad, and x and z, mm, in the laser frame.
    fan: f64,
    x: f64,
    z: f64,
}

/// Displacement of a measured point by one standard deviation of an error, part frame, mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ErrorShift {
    /// Index of the error in the scene.
    pub error: usize,
    pub shift: DVec3,
}

/// Systematic errors of one run.
pub(crate) struct SystematicErrors {
    errors: Vec<SystematicError>,
    /// Keys: errors common to all cameras, and errors of this camera.
    keys: [RngKey; 2],
    stage: Stage,
    period_s: f64,
    laser_from_head: Rigid,
    head_from_laser: Rigid,
    head_from_camera: Rigid,
    /// Laser and camera with the drawn power and focal length.
    pub laser: Laser,
    pub camera: Camera,
    /// Calibrations with each error of the sensor changed by plus and minus `step`; `None` for an
    /// error that changes no calibration.
    changed: Vec<Option<([Calibration; 2], f64)>>,
}

impl SystematicErrors {
    /// Draws the errors of the scene from its seed. Returns `None` for a scene without errors.
    pub fn of(scene: &Scene) -> Option<SystematicErrors> {
        if scene.systematic.is_none() {
            return None;
        }
        let errors = scene.systematic.errors.clone();
        let base = perfect_calibration(scene);
        let changed = errors.iter().map(|error| {
            let step = match error.effect {
                ErrorEffect::CameraShift(_) => SMALL_SHIFT,
                _ => SMALL_ANGLE,
            };
            let both = [step, -step].map(|by| changed(&base, scene, error.effect, by));
            let [plus, minus] = both;
            Some(([plus?, minus?], step))
        });
        let sensor = &scene.camera.sensor;
        let exposure_s = sensor.exposure_ms * 1e-3;
        let fastest_s = sensor.total_exposure_ms().max(sensor.readout_ms) * 1e-3;
        let mut drawn = SystematicErrors {
            changed: changed.collect(),
            keys: [scene.seed, scene.camera_seed()]
                .map(|seed| RngKey::new(seed, Purpose::Systematic)),
            stage: Stage::of(scene),
            period_s: (scene.scan.exposure_share).map_or(fastest_s, |share| exposure_s / share),
            laser_from_head: scene.head_from_laser.inverse(),
            head_from_laser: scene.head_from_laser,
            head_from_camera: scene.head_from_camera,
            laser: scene.laser.clone(),
            camera: scene.camera.clone(),
            errors,
        };
        for (i, error) in drawn.errors.iter().enumerate() {
            let value = drawn.value(i, &Position::default());
            match error.effect {
                ErrorEffect::LaserPower => drawn.laser.beam.power_mw *= (1.0 + value).max(0.0),
                ErrorEffect::FocalLength => drawn.camera = refocused(&drawn.camera, value),
                _ => {}
            }
        }
        Some(drawn)
    }

    /// Returns the value of an error at a position.
    fn value(&self, error: usize, at: &Position) -> f64 {
        let is_of_camera = self.errors[error].effect.is_of_camera();
        let key = self.keys[usize::from(is_of_camera)].with(error as u64);
        let normal = |node: u64| {
            let uniform = key.uniform(node).clamp(1e-15, 1.0 - 1e-15);
            normal_quantile(uniform)
        };
        let mut sum = 0.0;
        self.errors[error].nodes(at, &mut |node, weight| sum += weight * normal(node));
        self.errors[error].standard_deviation * sum
    }

    fn position(&self, place: f64) -> Position {
        Position {
            time_s: place * self.period_s,
            travel_mm: self.stage.travel.at(place),
            ..Position::default()
        }
    }

    /// Returns the true poses at a position on the path, given the nominal pose of the head.
    pub fn poses(&self, place: f64, part_from_head: Rigid) -> TruePoses {
        let at = self.position(place);
        let mut stage = [DVec3::ZERO; 2];
        let (mut laser, mut camera) = (DVec3::ZERO, [DVec3::ZERO; 2]);
        let mut height = 0.0;
        for (i, error) in self.errors.iter().enumerate() {
            let value = || self.value(i, &at);
            let axes = &self.stage.axes;
            match error.effect {
                ErrorEffect::LaserTurn(axis) => laser[axis] += value(),
                ErrorEffect::CameraTurn(axis) => camera[0][axis] += value(),
                ErrorEffect::CameraShift(axis) => camera[1][axis] += value(),
                ErrorEffect::Height => height += value(),
                ErrorEffect::StageShift(axis) => stage[1] += axes[axis] * value(),
                ErrorEffect::StageScale => stage[1] += axes[0] * (value() * at.travel_mm),
                ErrorEffect::StageTurn(axis) => stage[0] += axes[axis] * value(),
                ErrorEffect::FocalLength
                | ErrorEffect::LaserPower
                | ErrorEffect::RayAngle
                | ErrorEffect::Row => {}
            }
        }
        let moved = about(self.stage.pivot, stage);
        let part_from_head = match self.stage.moves {
            MovingBody::Head => part_from_head * moved,
            MovingBody::Part => moved.inverse() * part_from_head,
        };
        TruePoses {
            part_from_head: part_from_head * Rigid::translation(DVec3::Z * height),
            head_from_laser: self.head_from_laser * about(DVec3::ZERO, [laser, DVec3::ZERO]),
            head_from_camera: self.head_from_camera * about(self.camera.position(), camera),
        }
    }

    /// Returns the displacement of a measured point, head frame, by the errors that depend on the
    /// position in the laser plane. The image does not contain these errors.
    pub fn field_shift(&self, jacobian: &PointJacobian) -> DVec3 {
        let at = self.in_plane(Position::default(), jacobian.point);
        let mut sum = DVec3::ZERO;
        for (i, error) in self.errors.iter().enumerate() {
            if let Some(by) = self.by_field(error.effect, jacobian) {
                sum += by * self.value(i, &at);
            }
        }
        sum
    }

    /// Returns the displacement of a point, head frame, per unit of an error that depends on the
    /// position in the laser plane.
    fn by_field(&self, effect: ErrorEffect, jacobian: &PointJacobian) -> Option<DVec3> {
        const PLANE_OFFSET: usize = 14;
        match effect {
            ErrorEffect::Row => Some(jacobian.by_pixel[1].normalize_or_zero()),
            ErrorEffect::RayAngle => {
                let range = self.laser_from_head.point(jacobian.point).length();
                Some(jacobian.by_parameters[PLANE_OFFSET] * -range)
            }
            _ => None,
        }
    }

    fn in_plane(&self, at: Position, in_head: DVec3) -> Position {
        let p = self.laser_from_head.point(in_head);
        Position {
            fan: p.x.atan2(p.z),
            x: p.x,
            z: p.z,
            ..at
        }
    }

    /// Returns the displacements of the point at a pixel by one standard deviation of each error,
    /// part frame. `place` is the position on the path, and `part_from_head` the nominal pose.
    pub fn shifts(
        &self,
        pixel: DVec2,
        jacobian: &PointJacobian,
        place: f64,
        part_from_head: &Rigid,
    ) -> Vec<ErrorShift> {
        let in_head = jacobian.point;
        let travel = self.stage.travel.at(place);
        let axes = &self.stage.axes;
        // The measured point has the nominal pose of the body, and the surface has the true pose.
        let (in_body, sign) = match self.stage.moves {
            MovingBody::Head => (in_head, -1.0),
            MovingBody::Part => (part_from_head.point(in_head), 1.0),
        };
        let of_body = |shift: DVec3| match self.stage.moves {
            MovingBody::Head => part_from_head.vector(shift) * sign,
            MovingBody::Part => shift * sign,
        };
        let arm = in_body - self.stage.pivot;
        let of_error = |(i, error): (usize, &SystematicError)| {
            let by = match error.effect {
                ErrorEffect::LaserPower => return None,
                ErrorEffect::LaserTurn(_)
                | ErrorEffect::CameraTurn(_)
                | ErrorEffect::CameraShift(_)
                | ErrorEffect::FocalLength => {
                    let (both, step) = self.changed[i].as_ref()?;
                    let [plus, minus] = both.each_ref().map(|changed| {
                        let point = changed.point_at(pixel)?;
                        Some(changed.head_from_camera.point(point))
                    });
                    part_from_head.vector((minus? - plus?) / (2.0 * step))
                }
                ErrorEffect::Height => part_from_head.vector(-DVec3::Z),
                ErrorEffect::RayAngle | ErrorEffect::Row => {
                    part_from_head.vector(self.by_field(error.effect, jacobian)?)
                }
                ErrorEffect::StageShift(axis) => of_body(axes[axis]),
                ErrorEffect::StageScale => of_body(axes[0] * travel),
                ErrorEffect::StageTurn(axis) => of_body(axes[axis].cross(arm)),
            };
            let weight = match error.correlation {
                // The sum of squared weights of the other correlations is 1.
                ErrorCorrelation::Bow(half) => {
                    let fan = self.in_plane(Position::default(), in_head).fan;
                    (fan / half).powi(2)
                }
                _ => 1.0,
            };
            let shift = by * (error.standard_deviation * weight);
            Some(ErrorShift { error: i, shift })
        };
        self.errors
            .iter()
            .enumerate()
            .filter_map(of_error)
            .collect()
    }

    /// Returns the covariance of the point at a pixel, part frame, mm².
    pub fn covariance(
        &self,
        pixel: DVec2,
        jacobian: &PointJacobian,
        place: f64,
        part_from_head: &Rigid,
    ) -> DMat3 {
        let shifts = self.shifts(pixel, jacobian, place, part_from_head);
        shifts.iter().fold(DMat3::ZERO, |sum, of| {
            let s = of.shift;
            sum + DMat3::from_cols(s * s.x, s * s.y, s * s.z)
        })
    }

    /// Calls `is` with the nodes of an error at a point (head frame) and their weights. The squared
    /// weights sum to 1.
    pub fn nodes(&self, error: usize, place: f64, in_head: DVec3, is: &mut dyn FnMut(u64, f64)) {
        let at = self.in_plane(self.position(place), in_head);
        match self.errors[error].correlation {
            ErrorCorrelation::Bow(_) => is(0, 1.0),
            _ => self.errors[error].nodes(&at, is),
        }
    }

    /// Returns the values of the errors of a source at the start of the scan.
    pub fn values(&self, name: &str) -> Vec<f64> {
        let errors = (0..self.errors.len()).filter(|&i| self.errors[i].name == name);
        errors
            .map(|i| self.value(i, &Position::default()))
            .collect()
    }

    /// Returns the number of errors.
    pub fn len(&self) -> usize {
        self.errors.len()
    }

    /// Returns the name of an error's source.
    pub fn name(&self, error: usize) -> &'static str {
        self.errors[error].name
    }
}

impl SystematicError {
    /// Calls `is` with the nodes at a position and their weights.
    fn nodes(&self, at: &Position, is: &mut dyn FnMut(u64, f64)) {
        match self.correlation {
            ErrorCorrelation::Constant => is(0, 1.0),
            ErrorCorrelation::Bow(half) => is(0, (at.fan / half).powi(2)),
            ErrorCorrelation::Sinusoidal(frequency) => {
                let (sin, cos) = (TAU * frequency * at.time_s).sin_cos();
                is(0, cos);
                is(1, sin);
            }
            ErrorCorrelation::Time(length) => along(at.time_s, length, &mut |k, w| is(k as u64, w)),
            ErrorCorrelation::Travel(length) => {
                along(at.travel_mm, length, &mut |k, w| is(k as u64, w));
            }
            ErrorCorrelation::Fan(length) => along(at.fan, length, &mut |k, w| is(k as u64, w)),
            ErrorCorrelation::Field([x, z]) => along(at.x, x, &mut |i, a| {
                along(at.z, z, &mut |j, b| {
                    is((i as u64) << 32 ^ (j as u64 & 0xffff_ffff), a * b);
                });
            }),
        }
    }
}

/// Calls `is` with the nodes at `x` and their weights, for a correlation length.
fn along(x: f64, length: f64, is: &mut dyn FnMut(i64, f64)) {
    let u = 2.0 * x / length;
    let middle = u.floor();
    let weight = |k: i64| {
        let d = u - middle - k as f64;
        (-0.5 * d * d).exp()
    };
    let nodes = -NODES..=NODES + 1;
    let norm = nodes.clone().map(|k| weight(k).powi(2)).sum::<f64>().sqrt();
    for k in nodes {
        is(middle as i64 + k, weight(k) / norm);
    }
}

/// Returns the motion that rotates about `pivot` by the rotation vector `turn` and then moves by
/// `shift`.
fn about(pivot: DVec3, [turn, shift]: [DVec3; 2]) -> Rigid {
    let rotation = DMat3::from_quat(DQuat::from_scaled_axis(turn));
    Rigid {
        rotation,
        translation: pivot - rotation * pivot + shift,
    }
}

/// Returns the camera with a relative change of its focal length. The focus distance is constant.
fn refocused(camera: &Camera, by: f64) -> Camera {
    let mut camera = camera.clone();
    // A lens is focused beyond its focal length.
    let most = 0.999 * camera.lens.focus_distance;
    let focal_length = camera.lens.focal_length;
    camera.lens.focal_length = (focal_length * (1.0 + by)).clamp(0.5 * focal_length, most);
    camera
}

/// Returns the calibration of a sensor whose error of this kind is `by`; `None` for an error that
/// changes no calibration.
fn changed(base: &Calibration, scene: &Scene, effect: ErrorEffect, by: f64) -> Option<Calibration> {
    let mut changed = base.clone();
    let axis = |axis: usize| DVec3::AXES[axis] * by;
    // Motions of the plane and of the camera, both in the camera frame.
    let plane = match effect {
        ErrorEffect::LaserTurn(i) => {
            let camera_from_laser = scene.head_from_camera.inverse() * scene.head_from_laser;
            let turned = about(DVec3::ZERO, [axis(i), DVec3::ZERO]);
            camera_from_laser * turned * camera_from_laser.inverse()
        }
        ErrorEffect::CameraTurn(_) | ErrorEffect::CameraShift(_) => {
            let moved = match effect {
                ErrorEffect::CameraTurn(i) => {
                    about(scene.camera.position(), [axis(i), DVec3::ZERO])
                }
                ErrorEffect::CameraShift(i) => Rigid::translation(axis(i)),
                _ => return None,
            };
            changed.head_from_camera = base.head_from_camera * moved;
            moved.inverse()
        }
        ErrorEffect::FocalLength => {
            let distance = |camera: &Camera| camera.model().principal_distance;
            let ratio = distance(&refocused(&scene.camera, by)) / distance(&scene.camera);
            changed.camera.principal_distance *= ratio;
            Rigid::IDENTITY
        }
        _ => return None,
    };
    changed.plane_point = plane.point(base.plane_point);
    changed.plane_normal = plane.vector(base.plane_normal);
    Some(changed)
}

impl Stage {
    fn of(scene: &Scene) -> Stage {
        let scan = &scene.scan;
        let body = |place: f64| match scan.moves {
            MovingBody::Head => scan.world_from_head(place),
            MovingBody::Part => scan.world_from_part(place, &scene.part_at_rest),
        };
        let last = f64::from(scan.frames.max(2) - 1);
        let (start, end) = (body(0.0), body(last));
        let in_body = |v: DVec3| start.rotation.transpose() * v;
        let way = match scan.motion {
            // The chord of a complete turn has no length.
            PathMotion::Rotary { .. } => body(1.0).translation - start.translation,
            _ => end.translation - start.translation,
        };
        let from_head = |v: DVec3| match scan.moves {
            MovingBody::Head => v,
            MovingBody::Part => scene.part_from_head(0).vector(v),
        };
        let across_plane = from_head(scene.head_from_laser.rotation.y_axis);
        let travel = in_body(way).try_normalize().unwrap_or(across_plane);
        let up = from_head(DVec3::Z).reject_from_normalized(travel);
        let up = match up.try_normalize() {
            Some(up) => up,
            None => travel.any_orthonormal_vector(),
        };
        Stage {
            axes: [travel, up.cross(travel), up],
            travel: Travel::of(scene),
            moves: scan.moves,
            pivot: scene.systematic.pivot,
        }
    }
}

impl Travel {
    /// Returns the path length of the head's origin over the part.
    fn of(scene: &Scene) -> Travel {
        let at = |frame: u32| scene.part_from_head(frame).translation;
        match scene.scan.motion {
            PathMotion::Linear { .. } | PathMotion::Rotary { .. } => {
                Travel::PerFrame(at(0).distance(at(1)))
            }
            PathMotion::Poses { .. } => {
                let mut travelled = 0.0;
                let steps = (1..scene.scan.frames).map(|frame| {
                    travelled += at(frame - 1).distance(at(frame));
                    travelled
                });
                Travel::AtFrames(std::iter::once(0.0).chain(steps).collect())
            }
        }
    }

    fn at(&self, place: f64) -> f64 {
        match self {
            Travel::PerFrame(step) => step * place,
            Travel::AtFrames(travel) => {
                let before = (place.max(0.0) as usize).min(travel.len() - 1);
                let after = (before + 1).min(travel.len() - 1);
                let fraction = place - before as f64;
                travel[before] + (travel[after] - travel[before]) * fraction
            }
        }
    }
}

#[cfg(test)]
#[path = "systematic_tests.rs"]
mod tests;
