//! Section of the part with the beam: the pieces of triangles that are inside both the beam and the
//! field of view, with their images.

use crate::accel::{ClusterHit, HalfSpace, TriangleId, facing_normal};
use crate::frame::footprint::{margin, slices};
use crate::frame::pinhole::{PinholeGeometry, Projection};
use crate::frame::polygon::Polygon;
use crate::frame::rays::SurfaceElement;
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
    /// Corners of the image in [`BeamSection::corners`].
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
pub(super) struct BeamSection<'a> {
    pub view: &'a PoseView<'a>,
    pub facets: Vec<Facet>,
    /// Corners of all images, pixels.
    corners: Vec<DVec2>,
    /// Viewing geometry in the laser's frame.
    pub sight: PinholeGeometry,
}

impl<'a> BeamSection<'a> {
    /// Cuts the part with the beam. The facets and their order depend only on the view, except that
    /// [`TracedRegion::All`] has a different order. `None` if a facet is too close to the plane of
    /// the lens.
    pub fn new(view: &'a PoseView<'a>, region: &TracedRegion) -> Option<BeamSection<'a>> {
        let laser_from_part = view.part_from_laser.inverse();
        let sight = PinholeGeometry::new(view.camera, &(laser_from_part * view.part_from_camera));
        let resolution = view.camera.sensor.resolution.as_dvec2();
        let projection = Projection::new(&sight, resolution);
        let mut cut = BeamSection {
            view,
            facets: Vec::new(),
            corners: Vec::new(),
            sight,
        };
        let (accel, margin) = (view.accel, margin(view));
        let mut is_in_front = true;
        for borders in volumes(view, margin) {
            let mut add = |face: TriangleId| {
                let corners = accel.corners(face);
                if let Some(mut polygon) = clipped(corners, &borders) {
                    for corner in &mut polygon.corners[..polygon.count] {
                        *corner = laser_from_part.point(*corner);
                    }
                    let corners = corners.map(|corner| laser_from_part.point(corner));
                    is_in_front &= cut.add(face, corners, &polygon, &projection);
                }
            };
            match region {
                TracedRegion::All => {
                    for copy in 0..accel.poses().len() as u32 {
                        for triangle in 0..accel.mesh().triangles.len() as u32 {
                            add(TriangleId { copy, triangle });
                        }
                    }
                }
                TracedRegion::Lit(clusters) | TracedRegion::Columns(clusters, _) => {
                    let widened: Vec<_> = borders.iter().map(|b| b.widened(margin)).collect();
                    // A group of triangles whose box has no extent has no area.
                    accel.touching(clusters, &widened, 0.0, |found| {
                        if let ClusterHit::Triangle { face, .. } = found {
                            add(face);
                        }
                    });
                }
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

    /// Returns the plane of the facet with this number, through the middle of its image.
    pub fn plane(&self, number: u32) -> SurfaceElement {
        let facet = &self.facets[number as usize];
        SurfaceElement {
            point: self.point(facet, self.image_center(facet)),
            normal: facet.normal,
            tolerance: 0.0,
            material_id: facet.material_id,
        }
    }

    /// Returns the ratio of the beam radii at the aperture and at a point.
    pub fn aperture_ratio(&self, p: DVec3) -> f64 {
        let laser = self.view.laser;
        laser.beam.shape(laser.distance(p)).aperture_radius_ratio
    }

    /// Returns the changes of the distance from the laser plane (y in the laser's frame) per column and
    /// per row, on the plane of a facet at a sensor position, mm.
    pub fn height_gradient(&self, facet: &Facet, place: DVec2) -> DVec2 {
        let (direction, [column, row]) = self.sight.around(place);
        let nearness = facet.nearness(place);
        let steps = DVec2::new(column.y, row.y);
        let turn = DVec2::new(facet.inverse.y, facet.inverse.z) * (direction.y / nearness);
        (steps - turn) / nearness
    }

    /// Returns the width of a pixel at a point, perpendicular to the view, mm.
    pub fn pixel_size(&self, p: DVec3) -> f64 {
        let [column, row] = self.sight.steps();
        (p - self.sight.camera_center).length() * column.length().min(row.length())
    }

    /// Returns the point of a facet's plane that is imaged at a sensor position, laser's frame.
    pub fn point(&self, facet: &Facet, place: DVec2) -> DVec3 {
        self.sight.camera_center + self.sight.to_sensor(place) / facet.nearness(place)
    }
}

/// Clips a triangle to the intersection of the half-spaces. `None` if nothing is left.
pub(super) fn clipped(corners: [DVec3; 3], borders: &[HalfSpace]) -> Option<Polygon> {
    let mut crossed = 0u32;
    for (i, border) in borders.iter().enumerate() {
        match corners.map(|corner| border.height(corner) < 0.0) {
            [true, true, true] => return None,
            [false, false, false] => {}
            _ => crossed |= 1 << i,
        }
    }
    let mut polygon = Polygon::new(corners);
    polygon.clip_to(borders, crossed);
    (polygon.count >= 3).then_some(polygon)
}

/// Returns the convex volumes in which surface is lit and in the field of view, in the part's frame.
/// The beam width is nearly constant in each of them.
fn volumes(view: &PoseView, margin: f64) -> Vec<Vec<HalfSpace>> {
    let resolution = view.camera.sensor.resolution.as_dvec2();
    let sight = PinholeGeometry::new(view.camera, &view.part_from_camera);
    let projection = Projection::new(&sight, resolution);
    let in_view = frustum(sight.camera_center, &projection, resolution, None);
    let along = view.part_from_laser.rotation.z_axis;
    let aperture = view.part_from_laser.translation;
    let nearest = HalfSpace::new(aperture + along * NEAREST_Z_MM, along);
    let of_beam = slices(view, margin).into_iter();
    of_beam
        .map(|mut borders| {
            borders.push(nearest);
            borders.extend(in_view);
            borders
        })
        .collect()
}
