//! Which pixels can see lit surface: the triangles that the beam's volume
//! touches within the camera's view, cut to it and projected to the sensor.
//!
//! Nothing lit is left out. A ray shows light only from a point P of its own at
//! which the laser shines, and P is within `Accel::resolution` of a point Q
//! of a triangle. So P is in the volume, Q in the volume widened by as much
//! and thus in the cut polygon, and `Projection::spread` bounds how far the image
//! of Q is from that of P, a point of the pixel.

use super::View;
use super::bend::Bend;
use super::defocus::{Blur, spread_into};
use super::pixels::Pixels;
use super::polygon::{MOST_CORNERS, Polygon};
use super::sight::{Image, Projection, Sight};
use crate::accel::{Clusters, Found, HalfSpace};
use crate::laser::{FanProfile, Laser};
use crate::math::{Aabb, DVec2, DVec3, Rigid};
use std::ops::Range;

/// Where on the sensor light is sought.
#[derive(Clone)]
pub enum Region<'a> {
    /// In every pixel: the check of the others.
    All,
    /// In those that may see lit surface; of the part's mesh.
    Lit(&'a Clusters),
    /// In those of these columns, where the light is the same.
    Columns(&'a Clusters, Range<usize>),
}

/// The pixels of a region.
pub fn footprint(view: &View, region: &Region) -> Pixels {
    let sight = Sight::new(view.camera, &view.part_from_camera);
    match region {
        Region::All => Pixels::all(view.camera.sensor.resolution),
        Region::Lit(clusters) => lit_pixels(view, &sight, clusters),
        Region::Columns(clusters, columns) => {
            let mut pixels = lit_pixels(view, &sight, clusters);
            pixels.keep_columns(&match view.lens.blur {
                Blur::None => columns.clone(),
                _ => spread_into(columns, view.lens.reach),
            });
            pixels
        }
    }
}

/// The pixels that may see light. Costs what the beam touches, not what the mesh or
/// the sensor holds.
fn lit_pixels(view: &View, sight: &Sight, clusters: &Clusters) -> Pixels {
    let margin = margin(view);
    let beam = slices(view, margin);
    let resolution = view.camera.sensor.resolution;
    let mut pixels = Pixels::none(resolution);
    let projection = Projection::new(sight, resolution.as_dvec2());
    let bend = Bend::new(view.camera, sight, view.part_from_camera.rotation);
    let frustum = frustum(sight.eye, &projection, resolution.as_dvec2(), bend.as_ref());
    let detail = detail(view, &projection);
    let mut marker = Marker {
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
            Found::Triangle { face, crossed } => {
                let mut polygon = Polygon::new(accel.corners(face));
                for (i, half) in volume.iter().enumerate() {
                    if crossed >> i & 1 == 1 {
                        polygon.cut(half);
                    }
                }
                marker.seen_polygon(&polygon);
            }
            Found::Ball { center, radius } => marker.seen_ball(center, radius + margin),
        });
    }
    pixels
}

/// How far Q may be from P: the resolution, and the rounding of f64 in coordinates
/// that run up to the largest in play (some 2⁻⁵⁰ of it, taken 16 times).
fn margin(view: &View) -> f64 {
    let largest = [
        view.part_from_camera.translation,
        view.part_from_laser.translation,
    ]
    .map(|p| p.abs().max_element())
    .into_iter()
    .fold(view.accel.largest_coordinate(), f64::max);
    view.accel.resolution() + largest * 2f64.powi(-46)
}

/// The size (mm) of two pixels' view in the middle of the part: what is smaller
/// is not worth cutting. A choice of speed alone.
fn detail(view: &View, projection: &Projection) -> f64 {
    let scale = projection.image(view.accel.bounds().center()).scale;
    2.0 / projection.spread(1.0, scale.abs()).max_element()
}

/// What the sensor sees: a pyramid from the eye; for a lens that distorts one that holds
/// it.
pub(crate) fn frustum(
    eye: DVec3,
    projection: &Projection,
    resolution: DVec2,
    bend: Option<&Bend>,
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

/// The beam where it may meet the part, cut along its axis into pieces over which
/// its width varies little, and which are convex: what bounds each.
fn slices(view: &View, margin: f64) -> Vec<Vec<HalfSpace>> {
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
    // A piece more for each 2.5 % that the beam widens.
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
            // The width of a sheet follows the distance from the aperture.
            let furthest = match laser.fan {
                None => to,
                Some(fan) if fan.profile == FanProfile::Uniform => {
                    furthest_x.hypot(to).min(to / (fan.angle / 2.0).cos())
                }
                Some(_) => furthest_x.hypot(to),
            };
            let reach = laser.reach(from, furthest, view.cutoff_radii);
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

/// What bounds the beam along x.
pub(crate) fn sides(laser: &Laser, part_from_laser: &Rigid, reach: f64) -> Option<[HalfSpace; 2]> {
    let aperture = part_from_laser.translation;
    let (x, z) = (
        part_from_laser.rotation.x_axis,
        part_from_laser.rotation.z_axis,
    );
    match laser.fan {
        None => Some([-x, x].map(|inward| HalfSpace::new(aperture - inward * reach, inward))),
        Some(fan) if fan.profile == FanProfile::Uniform => {
            let (sin, cos) = (fan.angle / 2.0).sin_cos();
            Some([-x, x].map(|inward| HalfSpace::new(aperture, z * sin + inward * cos)))
        }
        Some(_) => None,
    }
}

/// More than rounding moves an image by, pixels: 1e-8 in projecting; and on the
/// edge of a polygon 1e-11 in row become 1e-3 in column where the edge rises by
/// only [`LEVEL`] over the 65 536 columns of the largest sensor.
const ROUNDING: f64 = 1e-2;
/// Edges that rise less than this (pixels) count as level.
const LEVEL: f64 = 1e-3;
/// Polygons lower than this are marked by their bounding box, pixels.
const LOW: f64 = 3.0;

/// Adds to `pixels` what may see something.
struct Marker<'a> {
    pixels: &'a mut Pixels,
    projection: Projection,
    bend: Option<Bend>,
    /// How far what is seen may be from what is marked, mm.
    margin: f64,
}

impl Marker<'_> {
    /// What lies within `distance` of `center`.
    fn seen_ball(&mut self, center: DVec3, distance: f64) {
        let Some(bend) = &self.bend else {
            return self.ball(center, distance);
        };
        match bend.normalised(center) {
            Some((n, depth)) => self.ball(bend.bent(n), bend.spread(distance, depth)),
            None => self.pixels.insert_all(),
        }
    }

    /// What lies within the margin of a polygon.
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
        // Cut across its length into pieces that sag by a quarter of a pixel, if
        // their width allows: a choice of speed alone.
        let middle = self.projection.image(bend.bent((low + high) / 2.0)).scale;
        let pixel = 1.0 / self.projection.spread(1.0, middle.abs()).max_element();
        let size = high - low;
        let count = (bend.sag(size.max_element() / 2.0) / (pixel / 4.0)).sqrt();
        let count = count.ceil().clamp(1.0, 64.0);
        let along = match size.x > size.y {
            true => DVec3::X,
            false => DVec3::Y,
        };
        for i in 0..count as usize {
            let end = |i: usize| (low + size * (i as f64 / count)).extend(0.0);
            let mut piece = Polygon { ..flat };
            if count > 1.0 {
                piece.cut(&HalfSpace::new(end(i), along));
                piece.cut(&HalfSpace::new(end(i + 1), -along));
            }
            self.piece(&mut piece, nearest);
        }
    }

    /// Bends and marks a polygon of normalised coordinates whose corners are at
    /// least `nearest` from the eye.
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
        let distance = bend.spread(self.margin, nearest) + bend.sag((high - low).length() / 2.0);
        for corner in &mut piece.corners[..piece.count] {
            *corner = bend.bent(corner.truncate());
        }
        self.polygon(piece.corners(), distance);
    }

    fn ball(&mut self, center: DVec3, distance: f64) {
        let Image { pixel, scale } = self.projection.image(center);
        if scale > 0.0 {
            let spread = self.projection.spread(distance, scale) + ROUNDING;
            self.rectangle(pixel - spread, pixel + spread);
        } else if -scale <= distance * self.projection.scale.length() {
            // The lens is in the ball.
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
        let spread = self.projection.spread(distance, nearest) + ROUNDING;
        let finite = (low + high + spread).is_finite();
        let behind = distance * self.projection.scale.length();
        if nearest <= behind || !finite {
            // Within the margin of the lens: cut to the camera's view, nothing
            // else is behind it.
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

    /// Row by row what lies within `spread` of a convex polygon that spans the rows
    /// from `low` to `high`.
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

/// The first and the last of `count` pixels in a line that the stretch from `low` to
/// `high` touches.
fn cells(low: f64, high: f64, count: usize) -> Option<(usize, usize)> {
    if high < 0.0 {
        return None;
    }
    // Casts round what is not negative down, as `floor`, a call on baseline x86-64,
    // would. Bounds that are not numbers count as infinite.
    let first = low as usize;
    let last = match high < count as f64 {
        true => high as usize,
        false => count - 1,
    };
    (first <= last).then_some((first, last))
}

/// Columns of the ends of the part of the edge `p`–`q` between two rows.
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
