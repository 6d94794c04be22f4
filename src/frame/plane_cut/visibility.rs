//! Visible rows of chains: rays to the camera and to the aperture at positions along them, with
//! bisection where visibility changes.

use super::chains::{Chain, Slice};
use super::facets::BeamSection;
use crate::accel::{Ray, WIDTH};
use crate::math::{DVec2, DVec3};
use smallvec::SmallVec;

/// Distance of the outermost tests from the ends of a chain, pixels. Rays start in front of the
/// surface by the resolution of the hierarchy, so closer to a concave edge they may start behind
/// the adjacent surface.
const END_MARGIN_ROWS: f64 = 0.02;
/// Chains shorter than this are tested once, pixels.
const SHORT_ROWS: f64 = 0.05;
/// Number of bisections. The error of an end is at most 2⁻⁶ of the distance between two tests.
const BISECTIONS: usize = 5;

/// Visible rows of a chain.
#[derive(Clone, Copy)]
pub(super) struct Piece {
    /// Index of the slice.
    pub slice: usize,
    /// Index of the chain in the slice.
    pub chain: usize,
    pub rows: [f64; 2],
    /// True for ends at which visibility changes.
    pub is_shadow: [bool; 2],
}

/// Position at which visibility is tested.
#[derive(Clone, Copy)]
struct Probe {
    slice: usize,
    chain: usize,
    row: f64,
    /// Beam radius at the aperture relative to the radius at the chain.
    aperture_ratio: f64,
}

/// Adjacent tests with different results.
struct Change {
    /// Index of the test before the change.
    after: usize,
    visible: Probe,
    hidden: Probe,
}

/// Returns the visible rows of all chains of the slices. Clear chains are visible. Other chains are
/// tested at distances of at most `step` pixels, so a shorter gap or piece may be missed. The packets
/// of rays depend only on the slices.
pub(super) fn visible_pieces(cut: &BeamSection, slices: &[Slice], step: f64) -> Vec<Piece> {
    let mut probes = Vec::new();
    for (slice, of) in slices.iter().enumerate() {
        for (chain, Chain { rows, is_clear, .. }) in of.chains.iter().enumerate() {
            let length = rows[1] - rows[0];
            let intervals = (length / step).ceil().max(1.0) as usize;
            let (count, margin) = match *is_clear || length < SHORT_ROWS {
                true => (0, length / 2.0),
                false => (intervals, END_MARGIN_ROWS.min(length / 4.0)),
            };
            let apart = (length - 2.0 * margin) / intervals as f64;
            let aperture_ratio = aperture_ratio(cut, of, &of.chains[chain]);
            probes.extend((0..=count).map(|i| Probe {
                slice,
                chain,
                row: rows[0] + margin + apart * i as f64,
                aperture_ratio,
            }));
        }
    }
    let is_visible = visible(cut, slices, &probes);
    let mut changes: Vec<Change> = (1..probes.len())
        .filter(|&i| {
            let [a, b] = [probes[i - 1], probes[i]];
            a.slice == b.slice && a.chain == b.chain && is_visible[i - 1] != is_visible[i]
        })
        .map(|i| {
            let (visible, hidden) = match is_visible[i] {
                true => (probes[i], probes[i - 1]),
                false => (probes[i - 1], probes[i]),
            };
            Change {
                after: i - 1,
                visible,
                hidden,
            }
        })
        .collect();
    for _ in 0..BISECTIONS {
        let middles: Vec<Probe> = (changes.iter())
            .map(|change| Probe {
                row: (change.visible.row + change.hidden.row) / 2.0,
                ..change.visible
            })
            .collect();
        let is_visible = visible(cut, slices, &middles);
        for ((change, middle), is_visible) in changes.iter_mut().zip(middles).zip(is_visible) {
            match is_visible {
                true => change.visible = middle,
                false => change.hidden = middle,
            }
        }
    }
    pieces(slices, &probes, &is_visible, &changes)
}

/// Joins tests that are visible to pieces.
fn pieces(
    slices: &[Slice],
    probes: &[Probe],
    is_visible: &[bool],
    changes: &[Change],
) -> Vec<Piece> {
    let mut pieces: Vec<Piece> = Vec::new();
    let mut changes = changes.iter().peekable();
    let mut open = false;
    for (i, probe) in probes.iter().enumerate() {
        let chain = &slices[probe.slice].chains[probe.chain];
        let is_first =
            i == 0 || (probes[i - 1].slice, probes[i - 1].chain) != (probe.slice, probe.chain);
        if is_first {
            open = false;
        }
        let change = (i.checked_sub(1))
            .and_then(|before| changes.next_if(|change| change.after == before))
            .map(|change| (change.visible.row + change.hidden.row) / 2.0);
        if is_visible[i] && !open {
            pieces.push(Piece {
                slice: probe.slice,
                chain: probe.chain,
                rows: [change.unwrap_or(chain.rows[0]), chain.rows[1]],
                is_shadow: [change.is_some(), false],
            });
        } else if let (Some(row), true, Some(piece)) = (change, open, pieces.last_mut()) {
            piece.rows[1] = row;
            piece.is_shadow[1] = true;
        }
        open = is_visible[i];
    }
    pieces
}

/// Position on the surface and point at the aperture, part's frame.
struct Waiting {
    /// Index of the position.
    probe: usize,
    start: DVec3,
    aperture: DVec3,
}

/// Returns whether light reaches the camera from the laser at each position.
fn visible(cut: &BeamSection, slices: &[Slice], probes: &[Probe]) -> Vec<bool> {
    let is_clear = |probe: &Probe| slices[probe.slice].chains[probe.chain].is_clear;
    let mut is_visible: Vec<bool> = probes.iter().map(is_clear).collect();
    let mut waiting: SmallVec<[Waiting; WIDTH]> = SmallVec::new();
    for (i, probe) in probes.iter().enumerate() {
        if !is_visible[i] {
            waiting.extend(lit_position(cut, slices, i, probe));
        }
        if waiting.len() == WIDTH {
            trace(cut, &waiting, &mut is_visible);
            waiting.clear();
        }
    }
    trace(cut, &waiting, &mut is_visible);
    is_visible
}

/// Returns the ratio of the beam radii at the aperture and at a chain. It changes little along the chain.
fn aperture_ratio(cut: &BeamSection, slice: &Slice, chain: &Chain) -> f64 {
    let facet = &cut.facets[slice.spans[chain.spans.start].facet as usize];
    cut.aperture_ratio(cut.point(facet, DVec2::new(slice.x, chain.rows[0])))
}

/// Returns the position of a test. `None` if the surface faces away from the laser or the camera.
fn lit_position(
    cut: &BeamSection,
    slices: &[Slice],
    number: usize,
    probe: &Probe,
) -> Option<Waiting> {
    let view = cut.view;
    let slice = &slices[probe.slice];
    let span = slice.span_at(&slice.chains[probe.chain], probe.row);
    let facet = &cut.facets[span.facet as usize];
    let p = cut.point(facet, DVec2::new(slice.x, probe.row));
    let start = p + facet.normal * view.accel.resolution();
    let aperture = DVec3::Y * (p.y * probe.aperture_ratio);
    let faces = |end: DVec3| (end - start).dot(facet.normal) > 0.0;
    // Also false for NaN.
    (faces(aperture) && faces(cut.sight.camera_center)).then(|| Waiting {
        probe: number,
        start: view.part_from_laser.point(start),
        aperture: view.part_from_laser.point(aperture),
    })
}

/// Sets the positions that the rays of a packet show to be visible.
fn trace(cut: &BeamSection, packet: &[Waiting], is_visible: &mut [bool]) {
    let accel = cut.view.accel;
    let eye = cut.view.part_from_camera.translation;
    // The surface faces both ends, so that every ray has a length.
    let to_eye: SmallVec<[Ray; WIDTH]> = (packet.iter())
        .filter_map(|at| Ray::between(at.start, eye))
        .collect();
    let hidden = accel.occluded(&to_eye);
    let seen = packet
        .iter()
        .enumerate()
        .filter(|(k, _)| hidden >> k & 1 == 0);
    let seen: SmallVec<[&Waiting; WIDTH]> = seen.map(|(_, at)| at).collect();
    let to_laser: SmallVec<[Ray; WIDTH]> = (seen.iter())
        .filter_map(|at| Ray::between(at.start, at.aperture))
        .collect();
    let blocked = accel.occluded(&to_laser);
    for (k, at) in seen.into_iter().enumerate() {
        is_visible[at.probe] = blocked >> k & 1 == 0;
    }
}
