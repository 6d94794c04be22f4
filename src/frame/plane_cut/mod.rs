//! Direct light from the cut of the part with the beam.
//!
//! The facets inside the beam are intersected with column positions of the sensor. Rays determine
//! which rows are visible, except for runs of columns that no surface can hide. The laser profile is then integrated over the rows of each
//! facet.
//!
//! ```text
//! cut → chains at column centers → clear runs → visible rows
//!     → [finer columns: chains, visible rows] → light
//! ```
//!
//! Rays per pixel, in [`super::direct_light`], are the method for all other views and for columns
//! with many facets per pixel.

mod chains;
mod clearance;
mod facets;
mod refinement;
mod shading;
mod visibility;

use super::direct_light::{self, DirectIrradiance, Sampling};
use super::footprint::{footprint, traced_columns};
use super::pixel_mask::{PixelMask, PixelNumbering};
use super::speckle_strips::TangentPlane;
use super::{PoseView, TracedRegion};
use crate::accel::TriangleClusters;
use crate::camera::Camera;
use crate::laser::Laser;
use crate::math::DVec2;
use crate::surface::Materials;
use chains::Slice;
use clearance::{ClearRegion, mark_clear_chains};
use facets::BeamSection;
use rayon::prelude::*;
use refinement::{Center, Refinement, positions_for_slope, refinement};
use shading::{ColumnLight, Shader, SliceTarget};
use smallvec::{SmallVec, smallvec};
use std::ops::Range;
use visibility::{Piece, visible_pieces};

/// Columns per task. Two more columns are intersected for each task.
const COLUMNS_PER_TASK: usize = 32;
/// Distance of visibility tests, pixels, in columns without and with edges.
const COARSE_ROWS: f64 = 1.0;
const EDGE_ROWS: f64 = 0.5;
/// Minimum number of positions in a column in which the surface turns, and in a column with edges.
const TURN_POSITIONS: usize = 2;
const EDGE_POSITIONS: usize = 4;
/// Maximum number of positions. A line that needs more is nearly parallel to the columns; its light is
/// computed by rays.
const MOST_POSITIONS: usize = 64;
/// Largest number of facets per row of a column. With more facets, one ray per sample is faster.
const MOST_FACETS_PER_ROW: f64 = 10.0;

/// Returns the requirement of this method that a scene does not satisfy; `None` if it satisfies all.
pub(crate) fn unmet_plane_cut_requirement(
    laser: &Laser,
    camera: &Camera,
    surface: &Materials,
) -> Option<&'static str> {
    if laser.fan.is_none() {
        Some("a line laser (laser.line)")
    } else if camera.lens.distortion.is_some() {
        Some("a lens without distortion")
    } else if surface.glossy().next().is_some() {
        Some("diffuse surfaces")
    } else if surface.polarisation_differs() {
        Some("one degree of polarisation on all surfaces")
    } else {
        None
    }
}

/// Computes the light at the samples of the lit pixels of a region. `None` if the method does not
/// apply to the view. Each column is computed independently, so the result is byte-identical for any
/// number of threads.
pub(super) fn light(view: &PoseView, region: &TracedRegion) -> Option<DirectIrradiance> {
    let applies = view.sampling == Sampling::PlaneCut
        && unmet_plane_cut_requirement(view.laser, view.camera, &view.surface).is_none();
    if !applies {
        return None;
    }
    let cut = BeamSection::new(view, region)?;
    let shader = Shader::new(&cut);
    let columns = ColumnFacets::new(&cut);
    let (clusters, wanted) = match region {
        TracedRegion::All => (None, columns.touched()),
        TracedRegion::Lit(clusters) => (Some(*clusters), columns.touched()),
        TracedRegion::Columns(clusters, wanted) => {
            let wanted = traced_columns(view, wanted);
            let touched = columns.touched();
            let start = touched.start.max(wanted.start);
            (
                Some(*clusters),
                start..touched.end.min(wanted.end).max(start),
            )
        }
    };
    // Blocks do not depend on the region.
    let blocks = wanted.start / COLUMNS_PER_TASK..wanted.end.div_ceil(COLUMNS_PER_TASK);
    let blocks: Vec<Vec<ColumnResult>> = blocks
        .into_par_iter()
        .map(|number| {
            view.unwind_if_stopped();
            block(&shader, &columns, clusters, number)
        })
        .collect();
    let columns = blocks.into_iter().flatten();
    let columns = columns.filter(|column| wanted.contains(&column.number()));
    let columns: Vec<ColumnResult> = columns.collect();
    Some(assemble(shader, region, &columns))
}

/// Facets that touch each column of the sensor.
struct ColumnFacets {
    /// Index in `facets` of the first facet of each column, followed by the total number.
    starts: Vec<usize>,
    facets: Vec<u32>,
}

impl ColumnFacets {
    fn new(cut: &BeamSection) -> ColumnFacets {
        let count = cut.view.camera.sensor.resolution.x as usize;
        let columns = |facet: &facets::Facet| {
            let [low, high] = facet.columns.map(|x| x.max(0.0) as usize);
            low.min(count)..(high + 1).min(count)
        };
        let mut starts = vec![0; count + 1];
        for column in cut.facets.iter().flat_map(columns) {
            starts[column + 1] += 1;
        }
        for column in 0..count {
            starts[column + 1] += starts[column];
        }
        let mut next = starts.clone();
        let mut facets = vec![0; starts[count]];
        for (facet, number) in cut.facets.iter().zip(0..) {
            for column in columns(facet) {
                facets[next[column]] = number;
                next[column] += 1;
            }
        }
        ColumnFacets { starts, facets }
    }

    fn of(&self, column: usize) -> &[u32] {
        &self.facets[self.starts[column]..self.starts[column + 1]]
    }

    fn count(&self) -> usize {
        self.starts.len() - 1
    }

    /// Returns the columns from the first to the last with a facet.
    fn touched(&self) -> Range<usize> {
        let total = self.facets.len();
        let start = self.starts.partition_point(|&start| start == 0);
        let end = self.starts.partition_point(|&start| start < total);
        start.saturating_sub(1).min(end)..end
    }
}

/// Result of a column.
enum ColumnResult {
    Light(ColumnLight),
    /// Column with more than [`MOST_FACETS_PER_ROW`] or [`MOST_POSITIONS`]; its light is computed by
    /// rays.
    Rays(usize),
}

impl ColumnResult {
    fn number(&self) -> usize {
        match self {
            ColumnResult::Light(light) => light.column,
            ColumnResult::Rays(column) => *column,
        }
    }
}

/// Computes the light of the block of columns with this number.
fn block(
    shader: &Shader,
    facets: &ColumnFacets,
    clusters: Option<&TriangleClusters>,
    number: usize,
) -> Vec<ColumnResult> {
    let cut = shader.cut;
    let start = number * COLUMNS_PER_TASK;
    let columns = start..(start + COLUMNS_PER_TASK).min(facets.count());
    let first = start.saturating_sub(1);
    let mut slices: Vec<Slice> = (first..(columns.end + 1).min(facets.count()))
        .map(|column| {
            let slice = Slice::new(cut, facets.of(column), column as f64 + 0.5);
            match slice.facets_per_row() > MOST_FACETS_PER_ROW {
                true => Slice::dense(slice.x),
                false => slice,
            }
        })
        .collect();
    let regions = match clusters {
        Some(clusters) => mark_clear_chains(cut, clusters, &mut slices),
        None => Vec::new(),
    };
    let pieces = visible_pieces(cut, &slices, COARSE_ROWS);
    let pieces = nearest(cut, &slices, &pieces);
    let mut left = &pieces[..];
    let centers: Vec<Center> = (slices.iter().enumerate())
        .map(|(i, slice)| {
            let pieces;
            (pieces, left) = left.split_at(left.partition_point(|piece| piece.slice == i));
            Center { slice, pieces }
        })
        .collect();
    let target = SliceTarget {
        columns: 0..shader.nodes.side(),
        weight: 1.0,
        width: None,
    };
    let mut found = Vec::new();
    for column in columns {
        let all = facets.of(column);
        if all.is_empty() {
            continue;
        }
        let i = column - first;
        let here = &centers[i];
        let positions = positions_for_slope(cut, here.slice);
        if here.slice.is_dense || positions > MOST_POSITIONS {
            found.push(ColumnResult::Rays(column));
            continue;
        }
        let around = [i.checked_sub(1), Some(i + 1)].map(|i| centers.get(i?));
        let (fewest, step) = match refinement(cut, all, here, around) {
            Refinement::None => (1, COARSE_ROWS),
            Refinement::Turn => (TURN_POSITIONS, COARSE_ROWS),
            Refinement::Edge => (EDGE_POSITIONS, EDGE_ROWS),
        };
        let light = match positions.max(fewest) {
            1 => shader.column(column, &[(here.slice, here.pieces, &target)]),
            positions => refined(shader, &regions, all, column, (positions, step)),
        };
        found.extend(light.map(ColumnResult::Light));
    }
    found
}

/// Computes the light of a column with at least `positions` column positions. Visibility is tested at
/// distances of `step` pixels.
fn refined(
    shader: &Shader,
    regions: &[ClearRegion],
    facets: &[u32],
    column: usize,
    (positions, step): (usize, f64),
) -> Option<ColumnLight> {
    let (cut, nodes) = (shader.cut, &shader.nodes);
    let side = nodes.side();
    let positions = positions.div_ceil(side);
    let (mut slices, mut targets) = (Vec::new(), Vec::new());
    for sample in 0..side {
        let cell = &nodes.cells()[sample];
        for i in 0..positions {
            let fraction = (2 * i + 1) as f64 / positions as f64 - 1.0;
            let off = cell.centre.x + cell.half.x * fraction;
            let mut slice = Slice::new(cut, facets, column as f64 + 0.5 + off);
            regions
                .iter()
                .for_each(|region| region.mark(cut, &mut slice));
            slices.push(slice);
            targets.push(SliceTarget {
                columns: sample..sample + 1,
                weight: 1.0 / positions as f64,
                width: Some(2.0 * cell.half.x / positions as f64),
            });
        }
    }
    let pieces = nearest(cut, &slices, &visible_pieces(cut, &slices, step));
    let parts: Vec<_> = pieces
        .chunk_by(|a, b| a.slice == b.slice)
        .map(|pieces| (&slices[pieces[0].slice], pieces, &targets[pieces[0].slice]))
        .collect();
    shader.column(column, &parts)
}

/// Removes the rows of each piece in which another piece of its slice is nearer to the camera.
/// Gaps between tests of visibility may hide a thin piece in front.
fn nearest(cut: &BeamSection, slices: &[Slice], pieces: &[Piece]) -> Vec<Piece> {
    let mut kept: Vec<Piece> = Vec::with_capacity(pieces.len());
    for pieces in pieces.chunk_by(|a, b| a.slice == b.slice) {
        let slice = &slices[pieces[0].slice];
        for i in 0..pieces.len() {
            kept.extend(unhidden(cut, slice, pieces, i));
        }
    }
    kept
}

/// Returns the rows of a piece in which no other piece of its slice is nearer to the camera.
fn unhidden(cut: &BeamSection, slice: &Slice, pieces: &[Piece], i: usize) -> SmallVec<[Piece; 1]> {
    let piece = &pieces[i];
    let nearness = |piece: &Piece, row: f64| {
        let span = slice.span_at(&slice.chains[piece.chain], row);
        cut.facets[span.facet as usize].nearness(DVec2::new(slice.x, row))
    };
    let mut parts: SmallVec<[Piece; 1]> = smallvec![*piece];
    for (k, other) in pieces.iter().enumerate().filter(|&(k, _)| k != i) {
        let rows = [
            piece.rows[0].max(other.rows[0]),
            piece.rows[1].min(other.rows[1]),
        ];
        // Also false for NaN.
        let overlaps = rows[0] < rows[1];
        if !overlaps {
            continue;
        }
        let middle = (rows[0] + rows[1]) / 2.0;
        let [own, its] = [piece, other].map(|piece| nearness(piece, middle));
        // The first of two coincident facets is kept.
        if its < own || its == own && k > i {
            continue;
        }
        for part in std::mem::take(&mut parts) {
            let before = [part.rows[0], part.rows[1].min(rows[0])];
            let after = [part.rows[0].max(rows[1]), part.rows[1]];
            let left = [before, after].into_iter().filter(|rows| rows[0] < rows[1]);
            parts.extend(left.map(|rows| Piece { rows, ..part }));
        }
    }
    parts
}

/// Collects the light of all columns, in ascending order. Columns without a result of their own are
/// computed by rays.
fn assemble(shader: Shader, region: &TracedRegion, columns: &[ColumnResult]) -> DirectIrradiance {
    let Shader {
        cut,
        nodes,
        reads_surface,
        defocus,
    } = shader;
    let view = cut.view;
    let resolution = view.camera.sensor.resolution;
    let count = nodes.places().len();
    let mut pixels = PixelMask::none(resolution);
    let mut by_rays = vec![false; resolution.x as usize];
    for result in columns {
        match result {
            ColumnResult::Light(light) => {
                for (i, samples) in light.irradiance.chunks_exact(count).enumerate() {
                    if samples.iter().any(|&e| e > 0.0) {
                        pixels.insert(light.top + i, light.column, light.column);
                    }
                }
            }
            ColumnResult::Rays(column) => by_rays[*column] = true,
        }
    }
    let traced = by_rays.contains(&true).then(|| {
        let footprint = footprint(view, region);
        let mut traced = PixelMask::none(resolution);
        for row in 0..footprint.rows {
            for column in footprint.of(row).filter(|&column| by_rays[column]) {
                traced.insert(row, column, column);
                pixels.insert(row, column, column);
            }
        }
        direct_light::light(view, traced)
    });
    let rows = PixelNumbering::new(pixels);
    let samples = count * rows.total();
    let of = |is_needed: bool| samples * usize::from(is_needed);
    let mut light = DirectIrradiance {
        blur: vec![0.0; of(defocus.is_some())],
        ..DirectIrradiance::from_blurred(
            rows,
            nodes,
            vec![0.0; of(true)],
            vec![TangentPlane::default(); of(reads_surface)],
        )
    };
    for result in columns {
        if let ColumnResult::Light(column) = result {
            column.store(cut, defocus.as_ref(), &mut light);
        }
    }
    if let Some(traced) = traced {
        light.replace(&traced);
    }
    light
}

#[cfg(test)]
mod tests;
