//! Lens distortion in the footprint. A distorting lens does not image straight lines as straight
//! lines.
//!
//! A visible point P with normalised coordinates n is imaged by the lens at D(n). The sensor of a
//! pinhole camera sees the direction (D(n), 1) there. Points are therefore distorted first and
//! projected afterwards.

use super::pinhole::PinholeGeometry;
use crate::accel::HalfSpace;
use crate::camera::Camera;
use crate::camera::Distortion;
use crate::math::{DMat3, DVec2, DVec3};

/// Number of segments per sensor side at which the border is sampled.
const BORDER: usize = 64;

pub(crate) struct DistortedFrustum {
    distortion: Distortion,
    camera_center: DVec3,
    /// Rotation of part_from_camera.
    axes: DMat3,
    /// Bounding box of the undistorted field of view, normalised coordinates.
    low: DVec2,
    high: DVec2,
    /// Radius of a disc around the bounding box. The bounds below hold in the disc.
    radius: f64,
    /// Upper bound of the stretch of D, and Lipschitz constant of its Jacobian.
    stretch: f64,
    curvature: f64,
}

impl DistortedFrustum {
    /// Returns `None` for a lens without distortion.
    pub fn new(camera: &Camera, sight: &PinholeGeometry, axes: DMat3) -> Option<DistortedFrustum> {
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
        // Between two samples, the border is at most half their distance from one of them.
        // Undistorting stretches by at most 1/least_stretch.
        let between = DVec2::splat(gap / 2.0 / distortion.min_jacobian_eigenvalue());
        let (low, high) = (low - between, high + between);
        // Enlarged by 10 %, because corners of polygons may exceed the box by the margin.
        let radius = 1.1 * low.abs().max(high.abs()).length();
        Some(DistortedFrustum {
            distortion,
            camera_center: sight.camera_center,
            axes,
            low,
            high,
            radius,
            stretch: distortion.max_jacobian_eigenvalue(radius),
            curvature: distortion.curvature(radius),
        })
    }

    /// Returns a pyramid with its apex at the eye that encloses the field of view.
    pub fn frustum(&self) -> [HalfSpace; 4] {
        let (low, high) = (self.low, self.high);
        [
            DVec3::new(1.0, 0.0, -low.x),
            DVec3::new(-1.0, 0.0, high.x),
            DVec3::new(0.0, 1.0, -low.y),
            DVec3::new(0.0, -1.0, high.y),
        ]
        .map(|inward| HalfSpace::new(self.camera_center, self.axes * inward))
    }

    /// Returns the normalised coordinates of a point and its distance along the axis. `None` if the
    /// bounds do not hold there.
    pub fn normalised(&self, p: DVec3) -> Option<(DVec2, f64)> {
        let v = self.axes.transpose() * (p - self.camera_center);
        let n = v.truncate() / v.z;
        // The comparisons are false for NaN, so NaN gives `None`.
        (v.z > 0.0 && n.length() <= self.radius).then_some((n, v.z))
    }

    /// Returns a point that a pinhole camera would image where the lens images `n`. It is at unit
    /// distance from the eye along the axis.
    pub fn bent(&self, n: DVec2) -> DVec3 {
        self.camera_center + self.axes * self.distortion.distort(n).extend(1.0)
    }

    /// Returns an upper bound of the distance between the distorted images of two points that are
    /// `distance` apart. One point is on the sensor, the other is at `depth` from the eye along the
    /// axis. With n of the first point, the normalised coordinates differ by (Δx - n_x·Δz, Δy -
    /// n_y·Δz)/depth.
    pub fn max_image_distance(&self, distance: f64, depth: f64) -> f64 {
        self.stretch * (1.0 + self.radius * self.radius).sqrt() * distance / depth
    }

    /// Returns twice the maximum deviation of D, within `extent` of a point, from its tangent
    /// affine map at that point. An affine map takes a convex polygon to a polygon. The corners of
    /// that polygon and the points in it each deviate from their distorted images by at most one
    /// such deviation. A marked region must therefore extend beyond the polygon of distorted
    /// corners by the returned amount.
    pub fn affine_residual(&self, extent: f64) -> f64 {
        self.curvature * extent * extent
    }
}
