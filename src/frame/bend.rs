//! A distorting lens in the footprint: what is straight in space is not straight
//! on the sensor.
//!
//! A point P that a sample sees lies at n in normalised coordinates and is imaged
//! by the lens at D(n); a pinhole's sensor would see the direction (D(n), 1) there.
//! So points are bent first, and projected after.

use super::sight::Sight;
use crate::accel::HalfSpace;
use crate::camera::Camera;
use crate::camera::Distortion;
use crate::math::{DMat3, DVec2, DVec3};

/// Pieces along each side of the sensor in which its border is followed.
const BORDER: usize = 64;

pub(crate) struct Bend {
    distortion: Distortion,
    eye: DVec3,
    /// part_from_camera.
    axes: DMat3,
    /// What the sensor sees, undistorted, lies between these.
    low: DVec2,
    high: DVec2,
    /// Of the disc on which the bounds below hold; it encloses that box.
    radius: f64,
    /// Greatest stretch of D, and Lipschitz constant of its Jacobian.
    stretch: f64,
    curvature: f64,
}

impl Bend {
    /// `None` for a lens that does not distort.
    pub fn new(camera: &Camera, sight: &Sight, axes: DMat3) -> Option<Bend> {
        let distortion = camera.lens.distortion?;
        let size = camera.sensor.resolution.as_dvec2();
        let corners = [DVec2::ZERO, size.with_y(0.0), size, size.with_x(0.0)];
        let border = (0..4 * BORDER).map(|i| {
            let (from, to) = (corners[i / BORDER], corners[(i / BORDER + 1) % 4]);
            let pixel = from.lerp(to, (i % BORDER) as f64 / BORDER as f64);
            let behind = axes.transpose() * sight.to_sensor(pixel);
            behind.truncate() / behind.z
        });
        let border: Vec<DVec2> = border.collect();
        let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        let mut gap: f64 = 0.0;
        for (i, &seen) in border.iter().enumerate() {
            let x = distortion.undistort(seen, seen);
            (low, high) = (low.min(x), high.max(x));
            gap = gap.max(seen.distance(border[(i + 1) % border.len()]));
        }
        // The border between two of its points is no further from one of them than
        // half their distance, and undistorting stretches by 1/least_stretch.
        let between = DVec2::splat(gap / 2.0 / distortion.least_stretch());
        let (low, high) = (low - between, high + between);
        // A little more: corners of polygons stand over the box by the margin.
        let radius = 1.1 * low.abs().max(high.abs()).length();
        Some(Bend {
            distortion,
            eye: sight.eye,
            axes,
            low,
            high,
            radius,
            stretch: distortion.most_stretch(radius),
            curvature: distortion.curvature(radius),
        })
    }

    /// A pyramid from the eye that holds all that the sensor sees.
    pub fn frustum(&self) -> [HalfSpace; 4] {
        let (low, high) = (self.low, self.high);
        [
            DVec3::new(1.0, 0.0, -low.x),
            DVec3::new(-1.0, 0.0, high.x),
            DVec3::new(0.0, 1.0, -low.y),
            DVec3::new(0.0, -1.0, high.y),
        ]
        .map(|inward| HalfSpace::new(self.eye, self.axes * inward))
    }

    /// Normalised coordinates of a point, and its distance along the axis; `None`
    /// where the bounds do not hold.
    pub fn normalised(&self, p: DVec3) -> Option<(DVec2, f64)> {
        let v = self.axes.transpose() * (p - self.eye);
        let n = v.truncate() / v.z;
        // Written so that NaN is no point.
        (v.z > 0.0 && n.length() <= self.radius).then_some((n, v.z))
    }

    /// A point that a pinhole would image where the lens images `n`; one unit
    /// from the eye along the axis.
    pub fn bent(&self, n: DVec2) -> DVec3 {
        self.eye + self.axes * self.distortion.distort(n).extend(1.0)
    }

    /// How far apart two points can be bent that are `distance` apart, one of them
    /// on the sensor and the other `depth` from the eye along the axis: with n of
    /// the first, the difference of the normalised coordinates is
    /// (Δx - n_x·Δz, Δy - n_y·Δz)/depth.
    pub fn spread(&self, distance: f64, depth: f64) -> f64 {
        self.stretch * (1.0 + self.radius * self.radius).sqrt() * distance / depth
    }

    /// Twice how far D departs, within `extent` of a point, from the affine map
    /// that touches it there. An affine map takes a convex polygon to one whose
    /// corners are this departure from the bent corners, and points in it to points
    /// this departure from the bent ones: so what is marked around the polygon of
    /// the bent corners must reach this much further.
    pub fn sag(&self, extent: f64) -> f64 {
        self.curvature * extent * extent
    }
}
