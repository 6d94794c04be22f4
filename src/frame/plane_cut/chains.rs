//! Facets along one column position: spans of rows, joined to chains where the surface continues.

use super::facets::BeamSection;
use crate::laser::gaussian;
use crate::math::DVec2;
use std::ops::Range;

/// Largest gap between spans of one chain, pixels. It covers rounding of clipped corners.
const JOINT_ROWS: f64 = 1e-6;
/// Largest relative step of the inverse ray parameter between spans of one chain.
const JOINT_DEPTH: f64 = 1e-6;
/// Number of chains that are tested for continuation by a span. More chains that pass one row
/// remain correct, but are tested for visibility separately.
const OPEN_CHAINS: usize = 8;
/// Fraction of the light in the laser plane below which a chain or its end is not significant.
pub(super) const SIGNIFICANT: f64 = 1e-3;

/// Rows of a facet in one column position, within the beam cut-off.
#[derive(Clone, Copy)]
pub(super) struct Span {
    pub facet: u32,
    pub rows: [f64; 2],
    /// True for ends at the beam cut-off or at the sensor border.
    is_cut: [bool; 2],
    /// Laser profile at both ends, and its maximum.
    profile: [f64; 2],
    peak: f64,
}

/// Consecutive spans of a continuous surface.
pub(super) struct Chain {
    /// Spans in [`Slice::spans`].
    pub spans: Range<usize>,
    pub rows: [f64; 2],
    /// True for ends inside the beam with significant light: outlines of the surface.
    pub is_open: [bool; 2],
    /// Maximum of the laser profile.
    pub peak: f64,
}

/// All chains in one column position.
pub(super) struct Slice {
    /// Column position, pixels.
    pub x: f64,
    pub spans: Vec<Span>,
    pub chains: Vec<Chain>,
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
        let mut numbered: Vec<(u32, Span)> = Vec::with_capacity(spans.len());
        let mut last: Vec<Span> = Vec::new();
        for span in spans {
            let recent = last.iter().enumerate().rev().take(OPEN_CHAINS);
            let before = recent.map(|(i, before)| (i, *before));
            let joined = before.filter(|(_, before)| continues(cut, before, &span, x));
            let chain = joined.map(|(i, _)| i).next().unwrap_or(last.len());
            match last.get_mut(chain) {
                Some(last) => *last = span,
                None => last.push(span),
            }
            numbered.push((chain as u32, span));
        }
        numbered.sort_by_key(|&(chain, _)| chain);
        let spans: Vec<Span> = numbered.iter().map(|&(_, span)| span).collect();
        let mut chains = Vec::with_capacity(last.len());
        let mut first = 0;
        for all in numbered.chunk_by(|a, b| a.0 == b.0) {
            chains.push(Chain::new(first, &spans[first..first + all.len()]));
            first += all.len();
        }
        Slice { x, spans, chains }
    }

    /// Returns the span of a chain at a row within it.
    pub fn span_at(&self, chain: &Chain, row: f64) -> &Span {
        let spans = &self.spans[chain.spans.clone()];
        let after = spans.partition_point(|span| span.rows[0] <= row);
        &spans[after.saturating_sub(1)]
    }

    /// Returns the significant chains.
    pub fn significant(&self) -> impl Iterator<Item = &Chain> {
        self.chains.iter().filter(|chain| chain.peak > SIGNIFICANT)
    }
}

impl Chain {
    fn new(first: usize, spans: &[Span]) -> Chain {
        let ends = [&spans[0], &spans[spans.len() - 1]];
        let is_open = |end: usize| !ends[end].is_cut[end] && ends[end].profile[end] > SIGNIFICANT;
        Chain {
            spans: first..first + spans.len(),
            rows: [ends[0].rows[0], ends[1].rows[1]],
            is_open: [is_open(0), is_open(1)],
            peak: spans.iter().map(|span| span.peak).fold(0.0, f64::max),
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
    let at = |row: f64| {
        let p = cut.point(facet, DVec2::new(x, row));
        (p.y, view.laser.radius(p))
    };
    let ends = rows.map(at);
    let limit = view.beam_cutoff_radii * ends[0].1.min(ends[1].1);
    // y ∓ limit is linear in the row after multiplication by the inverse ray parameter.
    let scale = rows.map(|row| facet.nearness(DVec2::new(x, row)));
    if !(scale[0] > 0.0 && scale[1] > 0.0) {
        return None;
    }
    let mut fractions = [0.0f64, 1.0];
    for side in [1.0, -1.0] {
        let beyond = [0, 1].map(|end| (side * ends[end].0 - limit) * scale[end]);
        let fraction = beyond[0] / (beyond[0] - beyond[1]);
        match beyond.map(|height| height > 0.0) {
            [true, true] => return None,
            [true, false] => fractions[0] = fractions[0].max(fraction),
            [false, true] => fractions[1] = fractions[1].min(fraction),
            [false, false] => {}
        }
    }
    is_cut = [
        is_cut[0] || fractions[0] > 0.0,
        is_cut[1] || fractions[1] < 1.0,
    ];
    rows = [
        match fractions[0] > 0.0 {
            true => rows[0] + (rows[1] - rows[0]) * fractions[0],
            false => rows[0],
        },
        match fractions[1] < 1.0 {
            true => rows[0] + (rows[1] - rows[0]) * fractions[1],
            false => rows[1],
        },
    ];
    let ordered = rows[0] < rows[1];
    let ends = rows.map(at);
    let profile = ends.map(|(y, radius)| gaussian(y * y, radius));
    let crosses = ends[0].0.signum() != ends[1].0.signum();
    ordered.then_some(Span {
        facet: number,
        rows,
        is_cut,
        profile,
        peak: match crosses {
            true => 1.0,
            false => profile[0].max(profile[1]),
        },
    })
}
