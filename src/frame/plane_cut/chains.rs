//! Facets along one column position: spans of rows, joined to chains where the surface continues.

use super::facets::BeamSection;
use crate::math::DVec2;
use smallvec::SmallVec;
use std::ops::Range;

/// Largest gap between spans of one chain, pixels. It covers rounding of clipped corners.
const JOINT_ROWS: f64 = 1e-6;
/// Largest relative step of the inverse ray parameter between spans of one chain.
const JOINT_DEPTH: f64 = 1e-6;
/// Number of chains that are tested for continuation by a span. More chains that pass one row
/// remain correct, but are tested for visibility separately.
const OPEN_CHAINS: usize = 8;
/// Distance from the laser plane, in beam radii, beyond which a chain or its end is not significant. The
/// light there is 10⁻³ of the light in the laser plane: √(½·ln 10³).
pub(super) const SIGNIFICANT_RADII: f64 = 1.858_459;

/// Rows of a facet in one column position, within the beam cut-off.
#[derive(Clone, Copy)]
pub(super) struct Span {
    pub facet: u32,
    pub rows: [f64; 2],
    /// True for ends at the beam cut-off or at the sensor border.
    is_cut: [bool; 2],
    /// Distance from the laser plane at both ends, and the smallest distance, beam radii.
    off: [f64; 2],
    nearest: f64,
}

/// Consecutive spans of a continuous surface.
pub(super) struct Chain {
    /// Spans in [`Slice::spans`].
    pub spans: Range<usize>,
    pub rows: [f64; 2],
    /// True for ends inside the beam with significant light: outlines of the surface.
    pub is_open: [bool; 2],
    /// Smallest distance from the laser plane, beam radii.
    pub nearest: f64,
    /// True if all of it is known to be visible without rays.
    pub is_clear: bool,
}

/// All chains in one column position.
pub(super) struct Slice {
    /// Column position, pixels.
    pub x: f64,
    pub spans: Vec<Span>,
    pub chains: Vec<Chain>,
    /// True if there are too many facets for this method. There are then no chains.
    pub is_dense: bool,
}

impl Slice {
    /// Finds the chains of the given facets at the column position `x`. The result does not depend
    /// on the order of the facets.
    pub fn new(cut: &BeamSection, facets: &[u32], x: f64) -> Slice {
        let spans = facets.iter().filter_map(|&facet| span(cut, facet, x));
        let mut spans: Vec<Span> = spans.collect();
        let face = |span: &Span| cut.facets[span.facet as usize].face;
        spans.sort_unstable_by(|a, b| {
            let by_row = a.rows[0].total_cmp(&b.rows[0]);
            by_row.then_with(|| face(a).cmp(&face(b)))
        });
        // Chain of each span, and the last span of each chain.
        let mut numbers: SmallVec<[u32; 64]> = SmallVec::new();
        let mut last: SmallVec<[Span; OPEN_CHAINS]> = SmallVec::new();
        for span in &spans {
            let recent = last.iter().enumerate().rev().take(OPEN_CHAINS);
            let mut joined = recent.filter(|(_, before)| continues(cut, before, span, x));
            let chain = joined.next().map_or(last.len(), |(i, _)| i);
            match last.get_mut(chain) {
                Some(last) => *last = *span,
                None => last.push(*span),
            }
            numbers.push(chain as u32);
        }
        if !numbers.is_sorted() {
            let mut numbered: Vec<(u32, Span)> = numbers.iter().copied().zip(spans).collect();
            numbered.sort_by_key(|&(chain, _)| chain);
            numbers.sort_unstable();
            spans = numbered.into_iter().map(|(_, span)| span).collect();
        }
        let mut chains = Vec::with_capacity(last.len());
        let mut first = 0;
        for all in numbers.chunk_by(|a, b| a == b) {
            chains.push(Chain::new(first, &spans[first..first + all.len()]));
            first += all.len();
        }
        Slice {
            x,
            spans,
            chains,
            is_dense: false,
        }
    }

    /// Returns a slice with too many facets.
    pub fn dense(x: f64) -> Slice {
        Slice {
            x,
            spans: Vec::new(),
            chains: Vec::new(),
            is_dense: true,
        }
    }

    /// Returns the number of facets relative to the number of rows.
    pub fn facets_per_row(&self) -> f64 {
        let rows = self
            .chains
            .iter()
            .map(|chain| chain.rows[1] - chain.rows[0]);
        self.spans.len() as f64 / (rows.sum::<f64>() + 1.0)
    }

    /// Returns the span of a chain at a row within it.
    pub fn span_at(&self, chain: &Chain, row: f64) -> &Span {
        let spans = &self.spans[chain.spans.clone()];
        let after = spans.partition_point(|span| span.rows[0] <= row);
        &spans[after.saturating_sub(1)]
    }

    /// Returns the significant chains.
    pub fn significant(&self) -> impl Iterator<Item = &Chain> {
        self.chains
            .iter()
            .filter(|chain| chain.nearest < SIGNIFICANT_RADII)
    }
}

impl Chain {
    fn new(first: usize, spans: &[Span]) -> Chain {
        let ends = [&spans[0], &spans[spans.len() - 1]];
        let is_open = |end: usize| !ends[end].is_cut[end] && ends[end].off[end] < SIGNIFICANT_RADII;
        Chain {
            spans: first..first + spans.len(),
            rows: [ends[0].rows[0], ends[1].rows[1]],
            is_open: [is_open(0), is_open(1)],
            nearest: (spans.iter().map(|span| span.nearest)).fold(f64::INFINITY, f64::min),
            is_clear: false,
        }
    }
}

/// Returns true if `next` begins at the point at which `before` ends.
fn continues(cut: &BeamSection, before: &Span, next: &Span, x: f64) -> bool {
    let gap = next.rows[0] - before.rows[1];
    let [a, b] = [(before, before.rows[1]), (next, next.rows[0])]
        .map(|(span, row)| cut.facets[span.facet as usize].nearness(DVec2::new(x, row)));
    gap.abs() <= JOINT_ROWS && (a - b).abs() <= JOINT_DEPTH * a.abs()
}

/// Returns the rows of a facet at the column position `x` that are within the beam cut-off.
fn span(cut: &BeamSection, number: u32, x: f64) -> Option<Span> {
    let (facet, view) = (&cut.facets[number as usize], cut.view);
    let [low, high] = cut.rows_at(facet, x)?;
    let border = view.camera.sensor.resolution.y as f64;
    let mut rows = [low.max(0.0), high.min(border)];
    let mut is_cut = [low < 0.0, high > border];
    // Also false for NaN.
    let ordered = rows[0] < rows[1];
    if !ordered {
        return None;
    }
    let scale = rows.map(|row| facet.nearness(DVec2::new(x, row)));
    if !(scale[0] > 0.0 && scale[1] > 0.0) {
        return None;
    }
    let point = |row: f64| cut.point(facet, DVec2::new(x, row));
    let mut heights = rows.map(|row| point(row).y);
    // The facet is in a part of the beam of nearly constant width.
    let radius = view.laser.radius(point((rows[0] + rows[1]) / 2.0));
    let limit = view.beam_cutoff_radii * radius;
    // y ∓ limit is linear in the row after multiplication by the inverse ray parameter.
    let mut fractions = [0.0f64, 1.0];
    for side in [1.0, -1.0] {
        let beyond = [0, 1].map(|end| (side * heights[end] - limit) * scale[end]);
        let fraction = beyond[0] / (beyond[0] - beyond[1]);
        match beyond.map(|height| height > 0.0) {
            [true, true] => return None,
            [true, false] => fractions[0] = fractions[0].max(fraction),
            [false, true] => fractions[1] = fractions[1].min(fraction),
            [false, false] => {}
        }
    }
    let whole = rows;
    for end in 0..2 {
        if fractions[end] > 0.0 && fractions[end] < 1.0 {
            rows[end] = whole[0] + (whole[1] - whole[0]) * fractions[end];
            heights[end] = point(rows[end]).y;
            is_cut[end] = true;
        }
    }
    let ordered = rows[0] < rows[1];
    let off = heights.map(|y| y.abs() / radius);
    let crosses = heights[0].signum() != heights[1].signum();
    ordered.then_some(Span {
        facet: number,
        rows,
        is_cut,
        off,
        nearest: match crosses {
            true => 0.0,
            false => off[0].min(off[1]),
        },
    })
}
