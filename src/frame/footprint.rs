//! Pixels that may see lit surface. Triangles in both the beam and the field of view are clipped to
//! them and projected onto the sensor.
//!
//! The result is conservative. A ray carries light only from a point P on it that the laser
//! illuminates. P is within `Accel::resolution` of a point Q of a triangle. P is inside the volume,
//! hence Q is inside the volume widened by that distance and thus in the clipped polygon.
//! `Projection::spread` bounds the distance between the image of Q and the image of P, a point of
//! the pixel.

use super::PoseView;
use super::defocus::{Blur, spread_into};
use super::distorted_frustum::DistortedFrustum;
use super::pinhole::{Image, PinholeGeometry, Projection};
use super::pixel_mask::PixelMask;
use super::polygon::{MOST_CORNERS, Polygon};
use crate::accel::{ClusterHit, HalfSpace, TriangleClusters};
use crate::laser::Laser;
use crate::math::{Aabb, DVec2, DVec3, Rigid};
use std::ops::Range;

/// Part of the sensor in which light is computed.
#[derive(Clone)]
pub enum TracedRegion<'a> {
    /// All pixels, as a reference for the other variants.
    All,
    /// Pixels that may see lit surface of the given mesh clusters.
    Lit(&'a TriangleClusters),
    /// Lit pixels of the given columns. Their light equals the light with [`TracedRegion::Lit`].
    Columns(&'a TriangleClusters, Range<usize>),
}

/// Returns the pixels of a region.
pub fn footprint(view: &PoseView, region: &TracedRegion) -> PixelMask {
    let sight = PinholeGeometry::new(view.camera, &view.part_from_camera);
    match region {
        TracedRegion::All => PixelMask::all(view.camera.sensor.resolution),
        TracedRegion::Lit(clusters) => lit_pixels(view, &sight, clusters),
        TracedRegion::Columns(clusters, columns) => {
            let mut pixels = lit_pixels(view, &sight, clusters);
            pixels.keep_columns(&traced_columns(view, columns));
            pixels
        }
    }
}

/// Returns the columns whose light the given columns receive through the lens.
pub(super) fn traced_columns(view: &PoseView, columns: &Range<usize>) -> Range<usize> {
    match view.lens.blur {
        Blur::None => columns.clone(),
        _ => spread_into(columns, view.lens.reach),
    }
}

/// Returns the pixels that may see light. The cost depends on the triangles in the beam, not on the
/// size of the mesh or sensor.
fn lit_pixels(view: &PoseView, sight: &PinholeGeometry, clusters: &TriangleClusters) -> PixelMask {
    let margin = margin(view);
    let beam = slices(view, margin);
    let resolution = view.camera.sensor.resolution;
    let mut pixels = PixelMask::none(resolution);
    let projection = Projection::new(sight, resolution.as_dvec2());
    let bend = DistortedFrustum::new(view.camera, sight, view.part_from_camera.rotation);
    let frustum = frustum(
        sight.camera_center,
        &projection,
        resolution.as_dvec2(),
        bend.as_ref(),
    );
    let detail = detail(view, &projection);
    let mut marker = FootprintRasterizer {
        pixels: &mut pixels,
        projection,
        bend,
        margin,
    };
    let mut volume = Vec::new();
    for borders in beam {
        volume.clear();
        volume.extend(borders.iter().chain(&frustum).map(|h| h.widened(margin)));
        let accel = view.accel;
        accel.touching(clusters, &volume, detail, |found| match found {
            ClusterHit::Triangle { face, crossed } => {
                let mut polygon = Polygon::new(accel.corners(face));
                polygon.clip_to(&volume, crossed);
                marker.seen_polygon(&polygon);
            }
            ClusterHit::Ball { center, radius } => marker.seen_ball(center, radius + margin),
        });
    }
    pixels
}

/// Returns the largest distance between P and Q. It is the resolution of the intersection plus the
/// f64 rounding of the largest coordinate, 16 times 2⁻⁵⁰ of it.
pub(super) fn margin(view: &PoseView) -> f64 {
    let largest = [
        view.part_from_camera.translation,
        view.part_from_laser.translation,
    ]
    .map(|p| p.abs().max_element())
    .into_iter()
    .fold(view.accel.largest_coordinate(), f64::max);
    view.accel.resolution() + largest * 2f64.powi(-46)
}

/// Returns the size of two pixels at the centre of the part, mm. Smaller triangles are not clipped.
/// This affects only speed.
fn detail(view: &PoseView, projection: &Projection) -> f64 {
    let scale = projection.image(view.accel.bounds().center()).scale;
    2.0 / projection
        .max_image_distance(1.0, scale.abs())
        .max_element()
}

/// Returns the pyramid of the field of view with its apex at the eye. A distorting lens has a
/// curved field of view, which the pyramid encloses.
pub(crate) fn frustum(
    eye: DVec3,
    projection: &Projection,
    resolution: DVec2,
    bend: Option<&DistortedFrustum>,
) -> [HalfSpace; 4] {
    if let Some(bend) = bend {
        return bend.frustum();
    }
    let Projection {
        column, row, scale, ..
    } = projection;
    [
        *column,
        scale * resolution.x - column,
        *row,
        scale * resolution.y - row,
    ]
    .map(|inward| HalfSpace::new(eye, inward))
}

/// Returns the bounding half-spaces of the beam within the bounds of the part. The beam is cut
/// along its axis into convex pieces of nearly constant width.
pub(super) fn slices(view: &PoseView, margin: f64) -> Vec<Vec<HalfSpace>> {
    let (laser, part_from_laser) = (view.laser, &view.part_from_laser);
    let part = view.accel.bounds();
    let laser_from_part = part_from_laser.inverse();
    let part = Aabb::of(part.corners().map(|c| laser_from_part.point(c)));
    let (near, far) = ((part.min.z - margin).max(0.0), part.max.z + margin);
    if far <= near {
        return Vec::new();
    }
    let waist = laser.beam.waist_distance.clamp(near, far);
    let widest = laser.beam.radius(near).max(laser.beam.radius(far));
    // One more piece for each 2.5 % of widening.
    let count = ((widest / laser.beam.radius(waist) - 1.0) * 40.0)
        .clamp(1.0, 16.0)
        .ceil();
    let furthest_x = part.min.x.abs().max(part.max.x.abs()) + margin;
    let (across, along) = (
        part_from_laser.rotation.y_axis,
        part_from_laser.rotation.z_axis,
    );
    let aperture = part_from_laser.translation;
    (0..count as usize)
        .map(|i| {
            let z = |i: usize| near + (far - near) * i as f64 / count;
            let (from, to) = (z(i), z(i + 1));
            // The width of a laser plane depends on the distance from the aperture.
            let furthest = match &laser.fan {
                None => to,
                Some(fan) if fan.is_bounded() => {
                    furthest_x.hypot(to).min(to / (fan.angle / 2.0).cos())
                }
                Some(_) => furthest_x.hypot(to),
            };
            let reach = laser.reach(from, furthest, view.beam_cutoff_radii);
            let mut borders = vec![
                HalfSpace::new(aperture - across * reach.y, across),
                HalfSpace::new(aperture + across * reach.y, -across),
                HalfSpace::new(aperture + along * from, along),
                HalfSpace::new(aperture + along * to, -along),
            ];
            borders.extend(sides(laser, part_from_laser, reach.x).into_iter().flatten());
            borders
        })
        .collect()
}

/// Returns the half-spaces that bound the beam along x.
pub(crate) fn sides(laser: &Laser, part_from_laser: &Rigid, reach: f64) -> Option<[HalfSpace; 2]> {
    let aperture = part_from_laser.translation;
    let (x, z) = (
        part_from_laser.rotation.x_axis,
        part_from_laser.rotation.z_axis,
    );
    match &laser.fan {
        None => Some([-x, x].map(|inward| HalfSpace::new(aperture - inward * reach, inward))),
        Some(fan) if fan.is_bounded() => {
            let (sin, cos) = (fan.angle / 2.0).sin_cos();
            Some([-x, x].map(|inward| HalfSpace::new(aperture, z * sin + inward * cos)))
        }
        Some(_) => None,
    }
}

/// Upper bound of image errors due to rounding, pixels. Projection has an error of 1e-8. On the
/// edge of a polygon, a row error of 1e-11 becomes a column error of 1e-3. This happens if the edge
/// rises by only [`LEVEL`] over the 65 536 columns of the largest sensor.
const ROUNDING: f64 = 1e-2;
/// Rise below which an edge counts as horizontal, pixels.
const LEVEL: f64 = 1e-3;
/// Polygons lower than this are replaced by their bounding box, pixels.
const LOW: f64 = 3.0;

/// Pixels that may see surface, and the projection by which they are marked.
struct FootprintRasterizer<'a> {
    pixels: &'a mut PixelMask,
    projection: Projection,
    bend: Option<DistortedFrustum>,
    /// Maximum distance between a visible point and the triangle that is marked for it, mm.
    margin: f64,
}

impl FootprintRasterizer<'_> {
    /// Marks the pixels that may see a point within `distance` of `center`.
    fn seen_ball(&mut self, center: DVec3, distance: f64) {
        let Some(bend) = &self.bend else {
            return self.ball(center, distance);
        };
        match bend.normalised(center) {
            Some((n, depth)) => self.ball(bend.bent(n), bend.max_image_distance(distance, depth)),
            None => self.pixels.insert_all(),
        }
    }

    /// Marks the pixels that may see a point within the margin of a polygon.
    fn seen_polygon(&mut self, polygon: &Polygon) {
        let Some(bend) = &self.bend else {
            return self.polygon(polygon.corners(), self.margin);
        };
        let mut flat = Polygon {
            count: 0,
            ..*polygon
        };
        let mut nearest = f64::INFINITY;
        let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        for &corner in polygon.corners() {
            let Some((n, depth)) = bend.normalised(corner) else {
                return self.pixels.insert_all();
            };
            flat.push(n.extend(0.0));
            (low, high) = (low.min(n), high.max(n));
            nearest = nearest.min(depth);
        }
        if flat.count == 0 {
            return;
        }
        // The polygon is cut across its longer side into pieces whose sag is a quarter of a pixel,
        // if their width allows it. This affects only speed.
        let middle = self.projection.image(bend.bent((low + high) / 2.0)).scale;
        let pixel = 1.0
            / self
                .projection
                .max_image_distance(1.0, middle.abs())
                .max_element();
        let size = high - low;
        let count = (bend.affine_residual(size.max_element() / 2.0) / (pixel / 4.0)).sqrt();
        let count = count.ceil().clamp(1.0, 64.0);
        let along = match size.x > size.y {
            true => DVec3::X,
            false => DVec3::Y,
        };
        for i in 0..count as usize {
            let end = |i: usize| (low + size * (i as f64 / count)).extend(0.0);
            let mut piece = Polygon { ..flat };
            if count > 1.0 {
                piece.clip(&HalfSpace::new(end(i), along));
                piece.clip(&HalfSpace::new(end(i + 1), -along));
            }
            self.piece(&mut piece, nearest);
        }
    }

    /// Distorts and marks a polygon of normalised coordinates whose corners are at least `nearest`
    /// from the eye.
    fn piece(&mut self, piece: &mut Polygon, nearest: f64) {
        let bend = self.bend.as_ref().expect("only a distorting lens bends");
        let corners = piece.corners();
        let (low, high) = (
            corners.iter().copied().fold(DVec3::INFINITY, DVec3::min),
            corners
                .iter()
                .copied()
                .fold(DVec3::NEG_INFINITY, DVec3::max),
        );
        let distance = bend.max_image_distance(self.margin, nearest)
            + bend.affine_residual((high - low).length() / 2.0);
        for corner in &mut piece.corners[..piece.count] {
            *corner = bend.bent(corner.truncate());
        }
        self.polygon(piece.corners(), distance);
    }

    fn ball(&mut self, center: DVec3, distance: f64) {
        let Image { pixel, scale } = self.projection.image(center);
        if scale > 0.0 {
            let spread = self.projection.max_image_distance(distance, scale) + ROUNDING;
            self.rectangle(pixel - spread, pixel + spread);
        } else if -scale <= distance * self.projection.scale.length() {
            // The lens is inside the ball.
            self.pixels.insert_all();
        }
    }

    fn polygon(&mut self, corners: &[DVec3], distance: f64) {
        if corners.is_empty() {
            return;
        }
        let mut images = [DVec2::ZERO; MOST_CORNERS];
        let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        let mut nearest = f64::INFINITY;
        for (image, &corner) in images.iter_mut().zip(corners) {
            let Image { pixel, scale } = self.projection.image(corner);
            *image = pixel;
            (low, high) = (low.min(pixel), high.max(pixel));
            nearest = nearest.min(scale);
        }
        let spread = self.projection.max_image_distance(distance, nearest) + ROUNDING;
        let finite = (low + high + spread).is_finite();
        let behind = distance * self.projection.scale.length();
        if nearest <= behind || !finite {
            // The polygon is within the margin of the lens. It was clipped to the field of view, so
            // it cannot be behind the lens otherwise.
            return self.pixels.insert_all();
        }
        if high.y - low.y <= LOW {
            self.rectangle(low - spread, high + spread);
        } else {
            self.rows(&images[..corners.len()], low.y, high.y, spread);
        }
    }

    fn rectangle(&mut self, low: DVec2, high: DVec2) {
        let Some((top, bottom)) = cells(low.y, high.y, self.pixels.rows) else {
            return;
        };
        if let Some((first, last)) = cells(low.x, high.x, self.pixels.columns) {
            for row in top..=bottom {
                self.pixels.insert(row, first, last);
            }
        }
    }

    /// Marks row by row the pixels within `spread` of a convex polygon. The polygon extends over
    /// the rows from `low` to `high`.
    fn rows(&mut self, polygon: &[DVec2], low: f64, high: f64, spread: DVec2) {
        let count = self.pixels.rows;
        let Some((top, bottom)) = cells(low - spread.y, high + spread.y, count) else {
            return;
        };
        for row in top..=bottom {
            let strip = (row as f64 - spread.y, row as f64 + 1.0 + spread.y);
            let (mut left, mut right) = (f64::INFINITY, f64::NEG_INFINITY);
            let mut before = polygon[polygon.len() - 1];
            for &corner in polygon {
                if let Some((a, b)) = within_strip(before, corner, strip) {
                    left = left.min(a).min(b);
                    right = right.max(a).max(b);
                }
                before = corner;
            }
            let run = cells(left - spread.x, right + spread.x, self.pixels.columns);
            if let Some((first, last)) = run {
                self.pixels.insert(row, first, last);
            }
        }
    }
}

/// Returns the first and the last index of the `count` pixels of a line that the interval from
/// `low` to `high` overlaps.
fn cells(low: f64, high: f64, count: usize) -> Option<(usize, usize)> {
    if high < 0.0 {
        return None;
    }
    // Casts round non-negative values down like `floor`, which is a function call on baseline
    // x86-64. NaN bounds count as infinite.
    let first = low as usize;
    let last = match high < count as f64 {
        true => high as usize,
        false => count - 1,
    };
    (first <= last).then_some((first, last))
}

/// Returns the columns of the end points of the edge `p`–`q` after clipping to two rows.
fn within_strip(p: DVec2, q: DVec2, (top, bottom): (f64, f64)) -> Option<(f64, f64)> {
    if p.y.max(q.y) < top || p.y.min(q.y) > bottom {
        return None;
    }
    let rise = q.y - p.y;
    if rise.abs() < LEVEL {
        return Some((p.x, q.x));
    }
    let column = |end: DVec2| {
        let row = end.y.clamp(top, bottom);
        end.x + (row - end.y) * ((q.x - p.x) / rise)
    };
    Some((column(p), column(q)))
}

#[cfg(test)]
#[path = "footprint_tests.rs"]
mod tests;
