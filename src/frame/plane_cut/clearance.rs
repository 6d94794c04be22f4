//! Runs of chains that no surface can hide from the camera or from the laser.
//!
//! A run consists of one chain in each of several consecutive columns. It is clear if no triangle
//! is in the volumes between the run and the camera, and between the run and the laser aperture. Two
//! queries of the triangle clusters then replace the rays of all its columns.

use super::chains::{Chain, Slice};
use super::facets::{BeamSection, clipped};
use crate::accel::{HalfSpace, TriangleClusters};
use crate::math::{DVec2, DVec3};
use std::ops::Range;

/// Smallest number of columns of a run. Two queries take the time of the rays of about eight columns.
const FEWEST_COLUMNS: usize = 16;
/// Height above a run up to which surface is ignored, pixels on the surface. Surface of this height
/// hides at most this number of rows. Without an allowance, the surface would hide itself by
/// rounding.
pub(super) const CLEARANCE_PX: f64 = 0.25;
/// Largest deviation of a run from a plane, pixels on the surface. The volumes above curved surfaces
/// contain many boxes of the surface itself, so that queries take longer than rays.
pub(super) const MAX_SPREAD_PX: f64 = 0.1;
/// Cosine of the angle between the surface normal and the light, below which a run is not tested.
const LEAST_COSINE: f64 = 0.01;
/// Rows beyond the ends of the chains that a region includes. Between column centers, the ends of a
/// chain may be outside the straight lines through the ends at the centers.
const MARGIN_ROWS: f64 = 0.5;

/// Region of a surface that no other surface hides from the camera or from the laser.
pub(super) struct ClearRegion {
    /// First column center and the middle row of the line there, and the change of that row per column.
    start: DVec2,
    slope: f64,
    /// First and last column position.
    columns: [f64; 2],
    /// First and last row relative to the middle row.
    rows: [f64; 2],
    /// Plane through the points, laser's frame, and the heights of the points over it.
    center: DVec3,
    normal: DVec3,
    heights: [f64; 2],
}

impl ClearRegion {
    /// Sets [`Chain::is_clear`] of the chains in the region.
    pub fn mark(&self, cut: &BeamSection, slice: &mut Slice) {
        for k in 0..slice.chains.len() {
            let chain = &slice.chains[k];
            if !chain.is_clear && self.contains(cut, slice, chain) {
                slice.chains[k].is_clear = true;
            }
        }
    }

    fn contains(&self, cut: &BeamSection, slice: &Slice, chain: &Chain) -> bool {
        let middle = self.row(slice.x);
        let is_within = slice.x >= self.columns[0]
            && slice.x <= self.columns[1]
            && chain.rows[0] >= middle + self.rows[0]
            && chain.rows[1] <= middle + self.rows[1];
        let is_on = |p: DVec3| {
            let height = self.normal.dot(p - self.center);
            height >= self.heights[0] && height <= self.heights[1]
        };
        is_within && faces_laser(cut, slice, chain) && points(cut, slice, chain).all(is_on)
    }

    fn row(&self, x: f64) -> f64 {
        self.start.y + self.slope * (x - self.start.x)
    }

    /// Returns the pyramid of the rays from the camera to the region, part's frame.
    fn view_pyramid(&self, cut: &BeamSection) -> [HalfSpace; 4] {
        let direction = |x: f64, offset: f64| {
            let to_sensor = cut.sight.to_sensor(DVec2::new(x, self.row(x) + offset));
            cut.view.part_from_laser.vector(to_sensor)
        };
        let ([left, right], [low, high]) = (self.columns, self.rows);
        let corners = [
            direction(left, low),
            direction(right, low),
            direction(right, high),
            direction(left, high),
        ];
        let center: DVec3 = corners.iter().sum();
        let eye = cut.view.part_from_camera.translation;
        std::array::from_fn(|i| {
            let side = corners[i].cross(corners[(i + 1) % 4]);
            HalfSpace::new(eye, side * side.dot(center).signum())
        })
    }
}

/// One chain in each of several consecutive slices.
struct Run {
    /// Index of the first slice.
    first: usize,
    /// Index of the chain in each slice.
    chains: Vec<usize>,
    /// Index in `points` of the first point of each chain, followed by the total number.
    starts: Vec<usize>,
    /// Ends of all spans, laser's frame.
    points: Vec<DVec3>,
}

/// Sets [`Chain::is_clear`] in slices of consecutive column centers, and returns the clear regions.
pub(super) fn mark_clear_chains(
    cut: &BeamSection,
    clusters: &TriangleClusters,
    slices: &mut [Slice],
) -> Vec<ClearRegion> {
    let mut regions = Vec::new();
    for run in runs(cut, slices) {
        let all = 0..run.chains.len();
        mark(cut, clusters, slices, &run, all, &mut regions);
    }
    regions
}

/// Marks the chains of a part of a run, or of its halves.
fn mark(
    cut: &BeamSection,
    clusters: &TriangleClusters,
    slices: &mut [Slice],
    run: &Run,
    part: Range<usize>,
    regions: &mut Vec<ClearRegion>,
) {
    if part.len() < FEWEST_COLUMNS {
        return;
    }
    if let Some(region) = clear_region(cut, clusters, slices, run, part.clone()) {
        regions.push(region);
        for i in part {
            slices[run.first + i].chains[run.chains[i]].is_clear = true;
        }
    } else {
        let middle = part.start + part.len() / 2;
        mark(cut, clusters, slices, run, part.start..middle, regions);
        mark(cut, clusters, slices, run, middle..part.end, regions);
    }
}

/// Joins chains of adjacent slices whose rows overlap.
fn runs(cut: &BeamSection, slices: &[Slice]) -> Vec<Run> {
    let mut runs: Vec<Run> = Vec::new();
    // Runs that end in the slice before.
    let mut open: Vec<usize> = Vec::new();
    for (i, slice) in slices.iter().enumerate() {
        let mut next = Vec::new();
        for (k, chain) in slice.chains.iter().enumerate() {
            if !faces_laser(cut, slice, chain) {
                continue;
            }
            let overlaps = |&run: &usize| {
                let run: &Run = &runs[run];
                let before = &slices[i - 1].chains[run.chains[run.chains.len() - 1]];
                before.rows[0].max(chain.rows[0]) < before.rows[1].min(chain.rows[1])
            };
            let number = match open.iter().position(overlaps) {
                Some(at) => open.remove(at),
                None => {
                    runs.push(Run {
                        first: i,
                        chains: Vec::new(),
                        starts: vec![0],
                        points: Vec::new(),
                    });
                    runs.len() - 1
                }
            };
            let run = &mut runs[number];
            run.chains.push(k);
            run.points.extend(points(cut, slice, chain));
            run.starts.push(run.points.len());
            next.push(number);
        }
        open = next;
    }
    runs.retain(|run| run.chains.len() >= FEWEST_COLUMNS);
    runs
}

/// Returns the first and the last point of all spans of a chain.
fn points<'a>(
    cut: &'a BeamSection,
    slice: &'a Slice,
    chain: &'a Chain,
) -> impl Iterator<Item = DVec3> + 'a {
    let spans = slice.spans[chain.spans.clone()].iter();
    spans.flat_map(|span| {
        let facet = &cut.facets[span.facet as usize];
        (span.rows).map(|row| cut.point(facet, DVec2::new(slice.x, row)))
    })
}

/// Returns true if the laser illuminates the front of all facets of a chain.
fn faces_laser(cut: &BeamSection, slice: &Slice, chain: &Chain) -> bool {
    let mut spans = slice.spans[chain.spans.clone()].iter();
    spans.all(|span| {
        let facet = &cut.facets[span.facet as usize];
        let p = cut.point(facet, DVec2::new(slice.x, span.rows[0]));
        let light = DVec3::new(p.x, 0.0, p.z);
        -facet.normal.dot(light) > LEAST_COSINE * light.length()
    })
}

/// Returns the region of a part of a run. `None` if the part is not planar, or if a surface is above it,
/// seen from the camera or from the laser.
fn clear_region(
    cut: &BeamSection,
    clusters: &TriangleClusters,
    slices: &[Slice],
    run: &Run,
    part: Range<usize>,
) -> Option<ClearRegion> {
    let chain = |i: usize| {
        let slice = &slices[run.first + i];
        (slice, &slice.chains[run.chains[i]])
    };
    let ends = |i: usize| [run.points[run.starts[i]], run.points[run.starts[i + 1] - 1]];
    let middle = |i: usize| {
        let [low, high] = ends(i);
        (low + high) / 2.0
    };
    let [from, to] = [part.start, part.end - 1];
    let along = middle(to) - middle(from);
    let across: DVec3 = part.clone().map(|i| ends(i)[1] - ends(i)[0]).sum();
    let center = (middle(from) + middle(to)) / 2.0;
    let to_eye = cut.sight.camera_center - center;
    let normal = along.cross(across);
    let normal = (normal * normal.dot(to_eye).signum()).normalize();
    let light = DVec3::new(center.x, 0.0, center.z);
    let cosine = -normal.dot(light) / light.length();
    // Also false for NaN.
    if !(cosine > LEAST_COSINE && normal.dot(to_eye) > LEAST_COSINE * to_eye.length()) {
        return None;
    }
    let points = &run.points[run.starts[part.start]..run.starts[part.end]];
    let heights = points.iter().map(|&p| normal.dot(p - center));
    let [low, high] = heights.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], height| {
        [low.min(height), high.max(height)]
    });
    let slope = cosine / (1.0 - cosine * cosine).max(0.0).sqrt();
    let pixel = cut.pixel_size(center);
    let of_laser = pixel * slope.min(1.0);
    if high - low > MAX_SPREAD_PX * of_laser {
        return None;
    }
    let clearance = [pixel, of_laser].map(|pixel| CLEARANCE_PX * pixel);
    let above = |clearance: f64| {
        let lifted = center + normal * (high + clearance);
        HalfSpace::new(
            cut.view.part_from_laser.point(lifted),
            cut.view.part_from_laser.vector(normal),
        )
    };
    let middle_row = |i: usize| {
        let (slice, chain) = chain(i);
        DVec2::new(slice.x, (chain.rows[0] + chain.rows[1]) / 2.0)
    };
    let [first, last] = [from, to].map(middle_row);
    let mut region = ClearRegion {
        start: first,
        slope: (last.y - first.y) / (last.x - first.x),
        columns: [first.x - 0.5, last.x + 0.5],
        rows: [0.0; 2],
        center,
        normal,
        heights: [low - clearance[1], high + clearance[1]],
    };
    for i in part {
        let (slice, chain) = chain(i);
        let middle = region.row(slice.x);
        region.rows[0] = region.rows[0].min(chain.rows[0] - middle - MARGIN_ROWS);
        region.rows[1] = region.rows[1].max(chain.rows[1] - middle + MARGIN_ROWS);
    }
    // Most triangles are below the first half-space.
    let mut volume = vec![above(clearance[0])];
    volume.extend(region.view_pyramid(cut));
    if !is_empty(cut, clusters, &volume) {
        return None;
    }
    let mut volume = vec![above(clearance[1])];
    volume.extend(laser_wedge(cut, points, (to - from) as f64)?);
    is_empty(cut, clusters, &volume).then_some(region)
}

/// Returns true if no triangle is in the intersection of the half-spaces, part's frame.
fn is_empty(cut: &BeamSection, clusters: &TriangleClusters, volume: &[HalfSpace]) -> bool {
    let accel = cut.view.accel;
    !accel.touches(clusters, volume, |face| {
        clipped(accel.corners(face), volume).is_some()
    })
}

/// Returns the volume of the light from the aperture to the points of columns that are `columns`
/// apart, and to half a column beyond, part's frame. `None` without points.
fn laser_wedge(cut: &BeamSection, points: &[DVec3], columns: f64) -> Option<[HalfSpace; 5]> {
    let (mut tangents, mut sides) = ([f64::INFINITY, f64::NEG_INFINITY], [0.0f64; 2]);
    for &p in points {
        let tangent = p.x / p.z;
        tangents = [tangents[0].min(tangent), tangents[1].max(tangent)];
        sides = [sides[0].min(p.y), sides[1].max(p.y)];
    }
    let half_column = (tangents[1] - tangents[0]) / columns / 2.0;
    let tangents = [tangents[0] - half_column, tangents[1] + half_column];
    // The ratio of the beam radii at the aperture and at a point changes little within a run.
    let widest = cut.aperture_ratio(*points.first()?).max(1.0);
    let frame = &cut.view.part_from_laser;
    let half_space =
        |point: DVec3, inward: DVec3| HalfSpace::new(frame.point(point), frame.vector(inward));
    Some([
        half_space(DVec3::ZERO, DVec3::new(1.0, 0.0, -tangents[0])),
        half_space(DVec3::ZERO, DVec3::new(-1.0, 0.0, tangents[1])),
        half_space(DVec3::Y * (sides[0] * widest), DVec3::Y),
        half_space(DVec3::Y * (sides[1] * widest), -DVec3::Y),
        half_space(DVec3::ZERO, DVec3::Z),
    ])
}
