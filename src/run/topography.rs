//! Displacement of detected lines by the topography of the surface.

use super::simulation::{Pose, Simulation};
use crate::accel::{TriangleId, facing_normal};
use crate::math::{DVec3, Rigid};
use crate::profile::Peak;
use crate::surface::{LineFootprint, Surface};

/// Smallest component along the normal of the displacement by one row, as a fraction of it. Rows
/// do not resolve heights of a surface that is closer to parallel with the laser plane.
const LEAST_ALONG_NORMAL: f64 = 0.05;

/// Change of a normal by which derivatives of the brightness are computed, rad. It is small
/// compared with the smallest roughness of a lobe, 0.01.
const TILT: f64 = 1e-4;

/// Poses of a frame, in the part frame, and the poses of the head during the exposure.
struct FramePoses {
    part_from_head: Rigid,
    part_from_laser: Rigid,
    eye: DVec3,
    during_exposure: Vec<Rigid>,
}

impl Simulation {
    /// Displaces the rows of a frame's peaks by the topography of the surface. Peaks on surfaces
    /// without a topography are unchanged.
    pub(super) fn displace_by_topography(&self, pose: &Pose, peaks: &mut [Peak]) {
        let scene = &self.scene;
        if !scene.surface.has_topography() {
            return;
        }
        let view = self.view_of(pose);
        let places = scene.scan.exposure_places(pose.frame);
        let poses = FramePoses {
            part_from_head: view.part_from_laser * scene.head_from_laser.inverse(),
            part_from_laser: view.part_from_laser,
            eye: view.part_from_camera.translation,
            during_exposure: places.map(|at| scene.part_from_head_at(at)).collect(),
        };
        let mut close = None;
        for peak in peaks {
            peak.row += self
                .topography_rows(&poses, peak, &mut close)
                .unwrap_or(0.0);
        }
    }

    /// Returns the displacement of a peak, px; `None` for a surface without a topography, or one
    /// whose heights the rows do not resolve. `close` is the triangle of the previous peak.
    fn topography_rows(
        &self,
        poses: &FramePoses,
        peak: &Peak,
        close: &mut Option<TriangleId>,
    ) -> Option<f64> {
        let jacobian = self.calibration.point_jacobian(peak.place())?;
        let point = poses.part_from_head.point(jacobian.point);
        let nearest = self.accel.nearest(point, *close);
        *close = Some(nearest.face);
        let material = self.scene.surface.material(nearest.face.triangle);
        let topography = material.topography.as_ref()?;
        let eye = poses.eye - point;
        let normal = facing_normal(self.accel.corners(nearest.face), -eye)?;
        let [by_column, by_row] = jacobian.by_pixel.map(|by| poses.part_from_head.vector(by));
        let height_of_row = normal.dot(by_row);
        if height_of_row.abs() < LEAST_ALONG_NORMAL * by_row.length() {
            return None;
        }
        let lit = LitSurface {
            point,
            normal,
            light: (point - poses.part_from_laser.translation).normalize(),
            eye: eye.normalize(),
            sheet: poses.part_from_laser.rotation.y_axis,
            by_pixel: [by_column, by_row],
        };
        let in_laser = poses.part_from_laser.inverse().point(point);
        let sigma = self.scene.laser.radius(in_laser) / 2.0;
        let across = lit.across()?;
        let exposure = match &poses.during_exposure[..] {
            [_] => Vec::new(),
            all => {
                let middle = mean_point(all, jacobian.point);
                let moved = all.iter().map(|pose| pose.point(jacobian.point) - middle);
                moved.map(|by| by.reject_from_normalized(normal)).collect()
            }
        };
        let footprint = LineFootprint {
            across: across * sigma,
            shading: lit.shading(&material.surface, across),
            column: by_column - by_row * (normal.dot(by_column) / height_of_row),
            exposure,
        };
        Some(topography.averaged(nearest.point, &footprint) / height_of_row)
    }
}

/// Returns the mean position of a point of the head during the exposure, part frame.
fn mean_point(during_exposure: &[Rigid], in_head: DVec3) -> DVec3 {
    let sum: DVec3 = during_exposure.iter().map(|pose| pose.point(in_head)).sum();
    sum / during_exposure.len() as f64
}

/// Lit surface at a point of the line. Vectors are in the part frame.
struct LitSurface {
    point: DVec3,
    /// Unit normal on the side of the camera.
    normal: DVec3,
    /// Direction of the light.
    light: DVec3,
    /// Direction to the camera.
    eye: DVec3,
    /// Unit normal of the laser plane.
    sheet: DVec3,
    /// Displacements of the measured point by one column and one row, mm.
    by_pixel: [DVec3; 2],
}

impl LitSurface {
    /// Returns the displacement on the surface per unit of distance from the laser plane; `None` if
    /// the surface faces away from the light.
    fn across(&self) -> Option<DVec3> {
        let incidence = -self.light.dot(self.normal);
        let across = self.sheet + self.light * (self.sheet.dot(self.normal) / incidence);
        (incidence > 0.0 && across.is_finite()).then_some(across)
    }

    /// Returns ε of [`Topography::averaged`](crate::surface::Topography::averaged).
    ///
    /// Light at the distance y from the laser plane lies at y·q on the surface, and is displaced by
    /// u·h along the beam. The image of a displacement d moves by R·d rows. The brightness of a
    /// facet changes by the factor 1 + g·h′, with h′ the slope along q. Integration of the centroid
    /// by parts gives ε = (R·q)·g/(|q|·(R·u)).
    fn shading(&self, surface: &Surface, across: DVec3) -> f64 {
        let along = across.normalize();
        let brightness = |slope: f64| {
            let normal = (self.normal - along * slope).normalize();
            let cosine = normal.dot(self.eye).max(0.0);
            surface.bsdf(self.point, normal, -self.light, self.eye) * cosine
        };
        let [low, middle, high] = [-TILT, 0.0, TILT].map(brightness);
        let by_slope = (high - low) / (2.0 * TILT * middle);
        let along_beam = self.light / self.light.dot(self.normal);
        let ratio = self.rows(across) * by_slope / (across.length() * self.rows(along_beam));
        match ratio.is_finite() {
            true => ratio,
            false => 0.0,
        }
    }

    /// Returns the number of rows by which the image of a displaced point moves.
    fn rows(&self, by: DVec3) -> f64 {
        // Projection along the viewing ray onto the laser plane.
        let in_plane = by - self.eye * (by.dot(self.sheet) / self.eye.dot(self.sheet));
        let [column, row] = self.by_pixel;
        column.cross(in_plane).dot(self.sheet) / column.cross(row).dot(self.sheet)
    }
}
