//! Choice of the columns in which one column position does not represent the column.
//!
//! At its center, a column has exact rows of every facet. Facets that continue into the adjacent
//! columns are evaluated on their planes over the whole width of the column. The error is first
//! order in what begins or ends within the column, so such columns need more positions.

use super::chains::{Chain, SIGNIFICANT_RADII, Slice};
use super::facets::{BeamSection, Facet};
use super::visibility::Piece;
use crate::math::{DVec2, DVec3};

/// Largest bend of the ends of a chain over three columns, pixels. A chain that is replaced by a
/// different one moves at once.
const BEND_ROWS: f64 = 0.25;
/// Largest difference of the ends of shadows in adjacent columns, pixels.
const SHADOW_ROWS: f64 = 0.25;
/// Largest difference of unit normals in adjacent columns. Light changes by 3 % at 45° incidence.
const MAX_NORMAL_CHANGE: f64 = 0.03;
/// Fractions of a chain at which normals are compared. The bright part of a line is in the middle
/// third of its rows.
const NORMAL_FRACTIONS: [f64; 3] = [0.35, 0.5, 0.65];

/// Chains at the center of a column and their visible rows.
pub(super) struct Center<'a> {
    pub slice: &'a Slice,
    pub pieces: &'a [Piece],
}

impl Center<'_> {
    /// Returns the visible pieces of significant chains.
    fn significant(&self) -> impl Iterator<Item = &Piece> {
        let chains = &self.slice.chains;
        self.pieces
            .iter()
            .filter(|piece| chains[piece.chain].nearest < SIGNIFICANT_RADII)
    }
}

/// Returns the fraction of the rows of a chain by which the line may move over a column position.
/// Half of the movement is at either side, and light within [`SIGNIFICANT_RADII`] remains in the rows. If the
/// beam is cut off within significant light, a tenth of the rows bounds the number of positions.
fn most_movement(cut: &BeamSection) -> f64 {
    let significant = SIGNIFICANT_RADII / cut.view.beam_cutoff_radii;
    (1.0 - significant).max(0.1)
}

/// Returns the number of column positions that the slope of the line in the image requires.
pub(super) fn positions_for_slope(cut: &BeamSection, slice: &Slice) -> usize {
    let of_chain = |chain: &Chain| {
        let row = (chain.rows[0] + chain.rows[1]) / 2.0;
        let facet = &cut.facets[slice.span_at(chain, row).facet as usize];
        let [a, b] = [-0.5, 0.5].map(|off| cut.point(facet, DVec2::new(slice.x + off, row)));
        let radius = cut.view.laser.radius(a);
        (b.y - a.y).abs() / (2.0 * cut.view.beam_cutoff_radii * radius)
    };
    let movement = slice.significant().map(of_chain).fold(0.0, f64::max);
    (movement / most_movement(cut)).ceil().max(1.0) as usize
}

/// Column positions that a column needs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Refinement {
    /// The center represents the column.
    None,
    /// The surface continues through the column, but turns.
    Turn,
    /// Surface begins, ends, or is partly hidden within the column.
    Edge,
}

/// Returns the column positions that a column needs. `facets` are those that touch the column,
/// `around` the columns before and after it.
pub(super) fn refinement(
    cut: &BeamSection,
    facets: &[u32],
    here: &Center,
    around: [Option<&Center>; 2],
) -> Refinement {
    let chains: Vec<&Chain> = here.slice.significant().collect();
    if chains
        .iter()
        .any(|chain| chain.is_open[0] || chain.is_open[1])
    {
        return Refinement::Edge;
    }
    let around = around.map(|there| {
        let there = there?;
        Some((there, there.slice.significant().collect::<Vec<_>>()))
    });
    if around.iter().flatten().any(|(there, chains_there)| {
        differ(cut, &chains, chains_there) || shadows_differ(here, there)
    }) {
        return Refinement::Edge;
    }
    if let [Some((_, before)), Some((_, after))] = &around {
        for (i, chain) in chains.iter().enumerate() {
            let bend =
                |end: usize| before[i].rows[end] - 2.0 * chain.rows[end] + after[i].rows[end];
            if bend(0).abs().max(bend(1).abs()) > BEND_ROWS {
                return Refinement::Edge;
            }
        }
    }
    let x = here.slice.x;
    let mut aside = facets
        .iter()
        .map(|&facet| &cut.facets[facet as usize])
        .filter(|facet| facet.columns[0] > x || facet.columns[1] <= x);
    if aside.any(|facet| !is_on_a_chain(cut, facet, here.slice)) {
        return Refinement::Edge;
    }
    let turns = around
        .iter()
        .flatten()
        .any(|(there, chains_there)| turn(cut, (here.slice, &chains), (there.slice, chains_there)));
    match turns {
        true => Refinement::Turn,
        false => Refinement::None,
    }
}

/// Returns true if the chains of two adjacent columns differ in number, or move by so much that
/// significant light is outside the rows of the center.
fn differ(cut: &BeamSection, a: &[&Chain], b: &[&Chain]) -> bool {
    if a.len() != b.len() {
        return true;
    }
    let most = most_movement(cut);
    a.iter().zip(b).any(|(a, b)| {
        let length = (a.rows[1] - a.rows[0]).min(b.rows[1] - b.rows[0]);
        let moves = [0, 1].map(|end| (a.rows[end] - b.rows[end]).abs());
        moves[0].max(moves[1]) > most * length
    })
}

/// Returns true if normals of the chains of two adjacent columns differ by more than
/// [`MAX_NORMAL_CHANGE`].
fn turn(
    cut: &BeamSection,
    (here, a): (&Slice, &[&Chain]),
    (there, b): (&Slice, &[&Chain]),
) -> bool {
    a.iter().zip(b).any(|(a, b)| {
        NORMAL_FRACTIONS.into_iter().any(|fraction| {
            let normal = |slice: &Slice, chain: &Chain| -> DVec3 {
                let row = chain.rows[0] + (chain.rows[1] - chain.rows[0]) * fraction;
                cut.facets[slice.span_at(chain, row).facet as usize].normal
            };
            (normal(here, a) - normal(there, b)).length_squared()
                > MAX_NORMAL_CHANGE * MAX_NORMAL_CHANGE
        })
    })
}

/// Returns true if the visible rows of adjacent columns differ in number or by more than
/// [`SHADOW_ROWS`].
fn shadows_differ(here: &Center, there: &Center) -> bool {
    let (mut a, mut b) = (here.significant(), there.significant());
    loop {
        match (a.next(), b.next()) {
            (None, None) => return false,
            (Some(a), Some(b)) => {
                let moved = |end: usize| {
                    (a.is_shadow[end] || b.is_shadow[end])
                        && (a.rows[end] - b.rows[end]).abs() > SHADOW_ROWS
                };
                if moved(0) || moved(1) {
                    return true;
                }
            }
            _ => return true,
        }
    }
}

/// Returns true if a facet that does not cross the column position of the slice continues one of
/// its chains, or if its light is not significant.
fn is_on_a_chain(cut: &BeamSection, facet: &Facet, slice: &Slice) -> bool {
    let center = cut.image_center(facet);
    let p = cut.point(facet, center);
    if p.y.abs() > SIGNIFICANT_RADII * cut.view.laser.radius(p) {
        return true;
    }
    let nearness = facet.nearness(center);
    let direction = cut.sight.to_sensor(center);
    let step = cut.sight.to_sensor(center + DVec2::X) - direction;
    let tolerance = nearness * step.length() / direction.length();
    slice.chains.iter().any(|chain| {
        let is_near = center.y > chain.rows[0] - 1.0 && center.y < chain.rows[1] + 1.0;
        is_near && {
            let span = slice.span_at(chain, center.y);
            let plane = &cut.facets[span.facet as usize];
            (plane.nearness(center) - nearness).abs() <= tolerance
        }
    })
}
