//! Direct light from the cut of the part with the beam.
//!
//! The facets inside the beam are intersected with column positions of the sensor. Rays only
//! determine which rows are visible. The laser profile is then integrated over the rows of each
//! facet.
//!
//! ```text
//! cut → chains at column centers → visible rows → [finer columns: chains, visible rows] → light
//! ```
//!
//! Rays per pixel, in [`super::direct_light`], are the method for all other views and for columns
//! with many facets per pixel.

mod chains;
mod facets;
mod refinement;
mod shading;
mod visibility;

use super::defocus::{self, DefocusMap};
use super::direct_light::{self, DirectIrradiance, Sampling};
use super::pinhole::PinholeGeometry;
use super::pixel_mask::{PixelMask, PixelNumbering, middle};
use super::pixel_quadrature::QuadratureNodes;
use super::rays::CameraRayCaster;
use super::speckle_strips::TangentPlane;
use super::{PoseView, TracedRegion};
use crate::camera::Camera;
use crate::laser::Laser;
use crate::math::DVec2;
use crate::surface::Materials;
use chains::Slice;
use facets::BeamSection;
use rayon::prelude::*;
use refinement::{Center, is_coarse, positions_for_slope};
use shading::{ColumnLight, Shader, SliceTarget};
use std::ops::Range;
use visibility::{Piece, visible_pieces};

/// Columns per task. Two more columns are intersected for each task.
const COLUMNS_PER_TASK: usize = 32;
/// Distance of visibility tests, pixels, in columns with one and with several positions.
const COARSE_ROWS: f64 = 1.0;
const FINE_ROWS: f64 = 0.5;
/// Minimum and maximum number of positions in a refined column. A line that needs more is nearly
/// parallel to the columns; its light is computed by rays.
const FINE_POSITIONS: usize = 4;
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

/// Computes the light at the samples of these pixels, the footprint of the region. Each column is
/// computed independently, so the result is byte-identical for any number of threads.
pub(super) fn light(view: &PoseView, region: &TracedRegion, pixels: PixelMask) -> DirectIrradiance {
    let applies = view.sampling == Sampling::PlaneCut
        && unmet_plane_cut_requirement(view.laser, view.camera, &view.surface).is_none();
    let cut = applies.then(|| BeamSection::new(view, region)).flatten();
    let (Some(cut), Some(span)) = (cut, pixels.span()) else {
        return direct_light::light(view, pixels);
    };
    let part_sight = PinholeGeometry::new(view.camera, &view.part_from_camera);
    let rays = CameraRayCaster::new(view, &part_sight, false);
    let speckle = view.speckle.as_ref();
    let shader = Shader {
        cut: &cut,
        rays: &rays,
        nodes: QuadratureNodes::new(defocus::grid(view)),
        reads_surface: speckle.is_some_and(|speckle| speckle.patterns.read_surface()),
        defocus: DefocusMap::new(view),
    };
    let columns = ColumnFacets::new(&cut);
    let starts: Vec<usize> = span.clone().step_by(COLUMNS_PER_TASK).collect();
    let blocks: Vec<Vec<ColumnResult>> = (starts.into_par_iter())
        .map(|start| {
            view.unwind_if_stopped();
            let end = (start + COLUMNS_PER_TASK).min(span.end);
            block(&shader, &columns, start..end)
        })
        .collect();
    assemble(shader, pixels, blocks.into_iter().flatten())
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
}

/// Result of a column.
enum ColumnResult {
    Light(ColumnLight),
    /// Column with more than [`MOST_FACETS_PER_ROW`] or [`MOST_POSITIONS`]; its light is computed by
    /// rays.
    Rays(usize),
}

/// Computes the light of some columns.
fn block(shader: &Shader, facets: &ColumnFacets, columns: Range<usize>) -> Vec<ColumnResult> {
    let cut = shader.cut;
    let count = facets.starts.len() - 1;
    let first = columns.start.saturating_sub(1);
    let centers: Vec<Center> = (first..(columns.end + 1).min(count))
        .map(|column| {
            let slice = [Slice::new(cut, facets.of(column), column as f64 + 0.5)];
            let pieces = match is_dense(&slice[0]) {
                true => Vec::new(),
                false => nearest(cut, &slice, visible_pieces(cut, &slice, COARSE_ROWS)),
            };
            let [slice] = slice;
            Center { slice, pieces }
        })
        .collect();
    let mut found = Vec::new();
    for column in columns {
        let all = facets.of(column);
        if all.is_empty() {
            continue;
        }
        let i = column - first;
        let here = &centers[i];
        let positions = positions_for_slope(cut, &here.slice);
        if is_dense(&here.slice) || positions > MOST_POSITIONS {
            found.push(ColumnResult::Rays(column));
            continue;
        }
        let around = [i.checked_sub(1), Some(i + 1)].map(|i| centers.get(i?));
        let light = match positions > 1 || is_coarse(cut, all, here, around) {
            true => refined(shader, all, column, positions.max(FINE_POSITIONS)),
            false => shader.column(
                column,
                std::slice::from_ref(&here.slice),
                &[SliceTarget {
                    columns: 0..shader.nodes.side(),
                    weight: 1.0,
                    width: None,
                }],
                &here.pieces,
            ),
        };
        found.extend(light.map(ColumnResult::Light));
    }
    found
}

/// Returns true if a column has more than [`MOST_FACETS_PER_ROW`] facets per row.
fn is_dense(slice: &Slice) -> bool {
    let rows = slice
        .chains
        .iter()
        .map(|chain| chain.rows[1] - chain.rows[0]);
    slice.spans.len() as f64 > MOST_FACETS_PER_ROW * (rows.sum::<f64>() + 1.0)
}

/// Computes the light of a column with at least `positions` column positions.
fn refined(
    shader: &Shader,
    facets: &[u32],
    column: usize,
    positions: usize,
) -> Option<ColumnLight> {
    let nodes = &shader.nodes;
    let side = nodes.side();
    let positions = positions.div_ceil(side);
    let (mut slices, mut targets) = (Vec::new(), Vec::new());
    for sample in 0..side {
        let cell = &nodes.cells()[sample];
        for i in 0..positions {
            let fraction = (2 * i + 1) as f64 / positions as f64 - 1.0;
            let off = cell.centre.x + cell.half.x * fraction;
            slices.push(Slice::new(shader.cut, facets, column as f64 + 0.5 + off));
            targets.push(SliceTarget {
                columns: sample..sample + 1,
                weight: 1.0 / positions as f64,
                width: Some(2.0 * cell.half.x / positions as f64),
            });
        }
    }
    let pieces = visible_pieces(shader.cut, &slices, FINE_ROWS);
    let pieces = nearest(shader.cut, &slices, pieces);
    shader.column(column, &slices, &targets, &pieces)
}

/// Removes the rows of each piece in which another piece of its slice is nearer to the camera.
/// Gaps between tests of visibility may hide a thin piece in front.
fn nearest(cut: &BeamSection, slices: &[Slice], pieces: Vec<Piece>) -> Vec<Piece> {
    let overlap = |a: &Piece, b: &Piece| {
        let rows = [a.rows[0].max(b.rows[0]), a.rows[1].min(b.rows[1])];
        (a.slice == b.slice && rows[0] < rows[1]).then_some(rows)
    };
    let nearness = |piece: &Piece, row: f64| {
        let slice = &slices[piece.slice];
        let span = slice.span_at(&slice.chains[piece.chain], row);
        cut.facets[span.facet as usize].nearness(DVec2::new(slice.x, row))
    };
    let mut kept: Vec<Piece> = Vec::with_capacity(pieces.len());
    let mut parts: Vec<Piece> = Vec::new();
    for (i, piece) in pieces.iter().enumerate() {
        parts.clear();
        parts.push(*piece);
        for (k, other) in pieces.iter().enumerate().filter(|&(k, _)| k != i) {
            let Some(rows) = overlap(piece, other) else {
                continue;
            };
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
        kept.extend_from_slice(&parts);
    }
    kept
}

/// Collects the light of all columns. Columns without a result of their own are computed by rays.
fn assemble(
    shader: Shader,
    pixels: PixelMask,
    columns: impl Iterator<Item = ColumnResult>,
) -> DirectIrradiance {
    let view = shader.cut.view;
    let count = shader.nodes.places().len();
    let rows = PixelNumbering::new(pixels);
    let of = |is_needed: bool| count * rows.total() * usize::from(is_needed);
    let mut irradiance = vec![0.0; of(true)];
    let mut surface = vec![TangentPlane::default(); of(shader.reads_surface)];
    let mut blur = vec![0.0; of(shader.defocus.is_some())];
    let mut by_rays = vec![false; rows.pixels.columns];
    for light in columns {
        let light = match light {
            ColumnResult::Light(light) => light,
            ColumnResult::Rays(column) => {
                by_rays[column] = true;
                continue;
            }
        };
        for (i, samples) in light.irradiance.chunks_exact(count).enumerate() {
            let Some(pixel) = rows.number(light.top + i, light.column) else {
                continue;
            };
            let own = count * pixel..count * (pixel + 1);
            irradiance[own.clone()].copy_from_slice(samples);
            let Some(owners) = light.owners.get(count * i..count * (i + 1)) else {
                continue;
            };
            let center = middle(light.column, light.top + i);
            for (sample, &(_, facet)) in own.zip(owners).filter(|(_, owner)| owner.1 != u32::MAX) {
                let plane = shader.plane(facet);
                if let Some(surface) = surface.get_mut(sample) {
                    *surface = TangentPlane::new(&plane);
                }
                if let Some(defocus) = &shader.defocus {
                    blur[sample] = defocus.blur(&shader.cut.sight, center, &plane);
                }
            }
        }
    }
    let mut light = DirectIrradiance {
        blur,
        ..DirectIrradiance::from_blurred(rows, shader.nodes, irradiance, surface)
    };
    if by_rays.contains(&true) {
        let mut pixels = PixelMask::none(view.camera.sensor.resolution);
        for row in 0..light.rows.pixels.rows {
            for column in light.rows.pixels.of(row).filter(|&column| by_rays[column]) {
                pixels.insert(row, column, column);
            }
        }
        light.replace(&direct_light::light(view, pixels));
    }
    light
}

#[cfg(test)]
mod tests;
