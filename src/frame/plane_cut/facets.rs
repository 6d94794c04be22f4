//! Cut of the part with the beam: the pieces of triangles that are inside both the beam and the
//! field of view, with their images.

use crate::accel::{ClusterHit, HalfSpace, TriangleId, facing_normal};
use crate::frame::footprint::{margin, slices};
use crate::frame::pinhole::{PinholeGeometry, Projection};
use crate::frame::polygon::Polygon;
use crate::frame::{PoseView, TracedRegion, frustum};
use crate::math::{DVec2, DVec3};
use std::ops::Range;

/// Minimum distance of a facet from the aperture along the beam axis, mm. The irradiance of a fan
/// is proportional to 1/ρ and has no finite value at the aperture.
const NEAREST_Z_MM: f64 = 1e-6;

/// Smallest ratio of the projection scale of two corners of a facet. Below it, one corner is so
/// close to the plane of the lens that its image position is not accurate.
const LEAST_SCALE_RATIO: f64 = 1e-9;

/// Part of a triangle that is inside the beam and the field of view, in the laser's frame.
pub(super) struct Facet {
    pub face: TriangleId,
    pub material_id: u32,
    /// Unit normal on the side of the camera.
    pub normal: DVec3,
    /// Coefficients (1, column, row) of the inverse ray parameter of the plane. The ray through a
    /// sensor position has the direction [`PinholeGeometry::to_sensor`]. Its inverse parameter is
    /// linear in the sensor position.
    inverse: DVec3,
    /// Corners of the image in [`Cut::corners`].
    corners: Range<u32>,
    /// First and last column of the image, pixels.
    pub columns: [f64; 2],
}

impl Facet {
    /// Returns the inverse ray parameter at a sensor position. It is larger for nearer points.
    pub fn nearness(&self, place: DVec2) -> f64 {
        self.inverse.dot(DVec3::new(1.0, place.x, place.y))
    }
}

/// All facets of a view.
pub(super) struct Cut<'a> {
    pub view: &'a PoseView<'a>,
    pub facets: Vec<Facet>,
    /// Corners of all images, pixels.
    corners: Vec<DVec2>,
    /// Viewing geometry in the laser's frame.
    pub sight: PinholeGeometry,
}

/// Volume inside which triangles are lit and visible, in the part's frame.
struct Volume {
    borders: Vec<HalfSpace>,
    /// Borders, widened by the rounding margin.
    widened: Vec<HalfSpace>,
}

impl<'a> Cut<'a> {
    /// Cuts the part with the beam. The facets and their order depend only on the view, except that
    /// [`TracedRegion::All`] has a different order. `None` if a facet is too close to the plane of
    /// the lens, or if the beam diverges so fast that it has no constant width.
    pub fn new(view: &'a PoseView<'a>, region: &TracedRegion) -> Option<Cut<'a>> {
        let laser_from_part = view.part_from_laser.inverse();
        let sight = PinholeGeometry::new(view.camera, &(laser_from_part * view.part_from_camera));
        let resolution = view.camera.sensor.resolution.as_dvec2();
        let projection = Projection::new(&sight, resolution);
        let volume = Volume::new(view)?;
        let mut cut = Cut {
            view,
            facets: Vec::new(),
            corners: Vec::new(),
            sight,
        };
        let mut is_in_front = true;
        let mut add = |cut: &mut Cut, face: TriangleId| {
            let corners = view.accel.corners(face);
            is_in_front &= match clipped(corners, &volume.borders) {
                Some(mut polygon) => {
                    for corner in &mut polygon.corners[..polygon.count] {
                        *corner = laser_from_part.point(*corner);
                    }
                    let corners = corners.map(|corner| laser_from_part.point(corner));
                    cut.add(face, corners, &polygon, &projection)
                }
                None => true,
            };
        };
        let accel = view.accel;
        match region {
            TracedRegion::All => {
                for copy in 0..accel.poses().len() as u32 {
                    for triangle in 0..accel.mesh().triangles.len() as u32 {
                        add(&mut cut, TriangleId { copy, triangle });
                    }
                }
            }
            TracedRegion::Lit(clusters) | TracedRegion::Columns(clusters, _) => {
                // A group of triangles whose box has no extent has no area.
                accel.touching(clusters, &volume.widened, 0.0, |found| {
                    if let ClusterHit::Triangle { face, .. } = found {
                        add(&mut cut, face);
                    }
                });
            }
        }
        is_in_front.then_some(cut)
    }

    /// Adds the part of a triangle that is inside the volume, laser's frame. Returns false if its
    /// image is not finite.
    fn add(
        &mut self,
        face: TriangleId,
        corners: [DVec3; 3],
        polygon: &Polygon,
        projection: &Projection,
    ) -> bool {
        let eye = self.sight.camera_center;
        let Some(normal) = facing_normal(corners, corners[0] - eye) else {
            return true;
        };
        let is_lit = |&corner: &DVec3| {
            let section = self.view.laser.section(corner);
            section.is_none_or(|section| -section.flux.dot(normal) > 0.0)
        };
        if !polygon.corners().iter().any(is_lit) {
            return true;
        }
        let images = polygon.corners().iter().map(|&p| projection.image(p));
        let scales = images.clone().map(|image| image.scale);
        let (nearest, furthest) = scales.fold((f64::INFINITY, 0.0f64), |(low, high), scale| {
            (low.min(scale), high.max(scale))
        });
        if nearest <= furthest * LEAST_SCALE_RATIO {
            return false;
        }
        let first = self.corners.len();
        self.corners.extend(images.map(|image| image.pixel));
        let columns = self.corners[first..].iter().map(|corner| corner.x);
        let (low, high) = columns.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| {
            (low.min(x), high.max(x))
        });
        // The origin, and the steps per column and row, of the ray direction.
        let origin = self.sight.to_sensor(DVec2::ZERO);
        let steps = [DVec2::X, DVec2::Y].map(|step| self.sight.to_sensor(step) - origin);
        let height = normal.dot(corners[0] - eye);
        let inverse = DVec3::new(
            normal.dot(origin),
            normal.dot(steps[0]),
            normal.dot(steps[1]),
        ) / height;
        if !inverse.is_finite() || low >= high {
            // The facet is edge-on to the camera.
            self.corners.truncate(first);
            return low.is_finite() && high.is_finite();
        }
        self.facets.push(Facet {
            face,
            material_id: self.view.surface.number(face.triangle) as u32,
            normal,
            inverse,
            corners: first as u32..self.corners.len() as u32,
            columns: [low, high],
        });
        true
    }

    /// Returns the first and last row of a facet's image in the column position `x`.
    pub fn rows_at(&self, facet: &Facet, x: f64) -> Option<[f64; 2]> {
        let corners = &self.corners[facet.corners.start as usize..facet.corners.end as usize];
        let mut before = corners[corners.len() - 1];
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for &corner in corners {
            if (before.x <= x) != (corner.x <= x) {
                // Facets on both sides of an edge find the same row to the bit.
                let [p, q] = match before.x < corner.x {
                    true => [before, corner],
                    false => [corner, before],
                };
                let row = p.y + (q.y - p.y) * ((x - p.x) / (q.x - p.x));
                (low, high) = (low.min(row), high.max(row));
            }
            before = corner;
        }
        (low < high).then_some([low, high])
    }

    /// Returns the mean of the corners of a facet's image.
    pub fn image_center(&self, facet: &Facet) -> DVec2 {
        let corners = &self.corners[facet.corners.start as usize..facet.corners.end as usize];
        corners.iter().sum::<DVec2>() / corners.len() as f64
    }

    /// Returns the point of a facet's plane that is imaged at a sensor position, laser's frame.
    pub fn point(&self, facet: &Facet, place: DVec2) -> DVec3 {
        self.sight.camera_center + self.sight.to_sensor(place) / facet.nearness(place)
    }
}

/// Clips a triangle to the intersection of the half-spaces. `None` if nothing is left.
fn clipped(corners: [DVec3; 3], borders: &[HalfSpace]) -> Option<Polygon> {
    let mut crossed = 0u32;
    for (i, border) in borders.iter().enumerate() {
        match corners.map(|corner| border.height(corner) < 0.0) {
            [true, true, true] => return None,
            [false, false, false] => {}
            _ => crossed |= 1 << i,
        }
    }
    let mut polygon = Polygon::new(corners);
    for (i, border) in borders.iter().enumerate() {
        if crossed >> i & 1 == 1 {
            polygon.clip(border);
        }
    }
    (polygon.count >= 3).then_some(polygon)
}

impl Volume {
    /// Returns `None` if the beam diverges so fast that it has no constant width.
    fn new(view: &PoseView) -> Option<Volume> {
        let margin = margin(view);
        let slices = slices(view, margin);
        let [slice] = &slices[..] else {
            return None;
        };
        let resolution = view.camera.sensor.resolution.as_dvec2();
        let sight = PinholeGeometry::new(view.camera, &view.part_from_camera);
        let projection = Projection::new(&sight, resolution);
        let in_view = frustum(sight.camera_center, &projection, resolution, None);
        let along = view.part_from_laser.rotation.z_axis;
        let aperture = view.part_from_laser.translation;
        let mut borders = slice.clone();
        borders.push(HalfSpace::new(aperture + along * NEAREST_Z_MM, along));
        borders.extend(in_view);
        Some(Volume {
            widened: borders.iter().map(|half| half.widened(margin)).collect(),
            borders,
        })
    }
}
