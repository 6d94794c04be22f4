//! Light of visible pieces at the samples of a column.

use super::chains::{Slice, Span};
use super::facets::BeamSection;
use super::visibility::Piece;
use crate::frame::defocus::{self, DefocusMap};
use crate::frame::direct_light::DirectIrradiance;
use crate::frame::pixel_mask::middle;
use crate::frame::pixel_quadrature::QuadratureNodes;
use crate::frame::planar_pixel::mean_of_gaussian;
use crate::frame::rays::SurfaceElement;
use crate::frame::speckle_strips::TangentPlane;
use crate::math::DVec2;
use crate::surface::Surface;
use std::f64::consts::SQRT_2;
use std::ops::Range;
use wide::f32x4;

/// Sample columns that a slice represents.
pub(super) struct SliceTarget {
    /// Sample columns of the pixel.
    pub columns: Range<usize>,
    /// Fraction of each sample's cell that the slice represents.
    pub weight: f64,
    /// Width that the slice represents, columns; `None` if it represents the whole pixel.
    pub width: Option<f64>,
}

/// Light of the samples of a column.
pub(super) struct ColumnLight {
    pub column: usize,
    /// First row.
    pub top: usize,
    /// Irradiance, mW/mm², row by row and sample by sample.
    pub irradiance: Vec<f32>,
    /// Largest contribution of a facet to each sample, and the facet; empty if not needed.
    pub owners: Vec<(f32, u32)>,
}

impl ColumnLight {
    /// Stores the light of the column. `defocus` is the defocus of the samples; `None` without blur.
    pub fn store(
        &self,
        cut: &BeamSection,
        defocus: Option<&DefocusMap>,
        light: &mut DirectIrradiance,
    ) {
        let count = light.nodes.places().len();
        for (i, samples) in self.irradiance.chunks_exact(count).enumerate() {
            let row = self.top + i;
            let Some(pixel) = light.rows.number(row, self.column) else {
                continue;
            };
            let own = count * pixel..count * (pixel + 1);
            light.irradiance[own.clone()].copy_from_slice(samples);
            let Some(owners) = self.owners.get(count * i..count * (i + 1)) else {
                continue;
            };
            let center = middle(self.column, row);
            // Most pixels have one facet.
            let mut last: Option<(u32, SurfaceElement)> = None;
            for (sample, &(_, facet)) in own.zip(owners).filter(|(_, owner)| owner.1 != u32::MAX) {
                let plane = match last {
                    Some((number, plane)) if number == facet => plane,
                    _ => cut.plane(facet),
                };
                last = Some((facet, plane));
                if let Some(surface) = light.surface.get_mut(sample) {
                    *surface = TangentPlane::new(&plane);
                }
                if let Some(defocus) = defocus {
                    light.blur[sample] = defocus.blur(&cut.sight, center, &plane);
                }
            }
        }
    }
}

/// Largest half-change of the argument u over a cell for which three Gauss nodes are used. The error is
/// u⁶·120/31 500 = 1.8·10⁻⁴ of the maximum.
const MOST_CHANGE: f32 = 0.6;

/// Largest p² + q² for which the mean is expanded to second order. The error is 1.6·10⁻⁴ of the maximum.
const SMALL: f32 = 0.04;

/// Returns the mean of exp(−(u + p·s + q·t)²) for s and t from −1 to 1, by an expansion or by three Gauss
/// nodes each.
fn mean_of_quad(u: f32x4, p: f32x4, q: f32x4) -> f32x4 {
    let square = p * p + q * q;
    if square.to_array().iter().all(|&square| square < SMALL) {
        let bend = square * (u * u * 2.0 - 1.0) / 3.0;
        return (-u * u).max(f32x4::splat(-87.0)).exp() * (bend + 1.0);
    }
    const RULE: [(f32, f32); 3] = [(-0.774_596_7, 5.0), (0.0, 8.0), (0.774_596_7, 5.0)];
    let mut sum = f32x4::ZERO;
    for (s, v) in RULE {
        for (t, w) in RULE {
            let u = u + p * s + q * t;
            sum += (-u * u).max(f32x4::splat(-87.0)).exp() * (v * w);
        }
    }
    sum / (18.0 * 18.0)
}

/// Values that all columns have in common.
pub(super) struct Shader<'a> {
    pub cut: &'a BeamSection<'a>,
    pub nodes: QuadratureNodes,
    pub reads_surface: bool,
    /// Defocus of the samples; `None` without blur.
    pub defocus: Option<DefocusMap>,
}

/// Light of a facet in a pixel at a column position.
struct Segment<'a> {
    span: &'a Span,
    /// Sensor position of the slice and of the middle of the visible rows.
    place: DVec2,
    row: usize,
    /// Visible rows in the pixel.
    rows: [f64; 2],
}

impl<'a> Shader<'a> {
    pub fn new(cut: &'a BeamSection<'a>) -> Shader<'a> {
        let speckle = cut.view.speckle.as_ref();
        Shader {
            cut,
            nodes: QuadratureNodes::new(defocus::grid(cut.view)),
            reads_surface: speckle.is_some_and(|speckle| speckle.patterns.read_surface()),
            defocus: DefocusMap::new(cut.view),
        }
    }

    /// Computes the light of the pieces of some slices. Pieces of one slice must not overlap. `None`
    /// without pieces.
    pub fn column(
        &self,
        column: usize,
        parts: &[(&Slice, &[Piece], &SliceTarget)],
    ) -> Option<ColumnLight> {
        let pieces = parts.iter().flat_map(|(_, pieces, _)| pieces.iter());
        let rows = pieces.map(|piece| piece.rows);
        let [low, high] = rows.reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])])?;
        let border = self.cut.view.camera.sensor.resolution.y as usize;
        let (top, bottom) = (low as usize, (high.ceil() as usize).min(border));
        let count = self.nodes.places().len() * (bottom - top);
        let has_planes = self.reads_surface || self.defocus.is_some();
        let owned = if has_planes { count } else { 0 };
        let mut light = ColumnLight {
            column,
            top,
            irradiance: vec![0.0; count],
            owners: vec![(0.0, u32::MAX); owned],
        };
        for &(slice, pieces, target) in parts {
            for piece in pieces {
                self.shade_piece(slice, piece, target, bottom, &mut light);
            }
        }
        Some(light)
    }

    /// Adds the light of a piece in the rows before `bottom`.
    fn shade_piece(
        &self,
        slice: &Slice,
        piece: &Piece,
        target: &SliceTarget,
        bottom: usize,
        light: &mut ColumnLight,
    ) {
        let chain = &slice.chains[piece.chain];
        for span in &slice.spans[chain.spans.clone()] {
            let end = span.rows[1].min(piece.rows[1]);
            let mut from = span.rows[0].max(piece.rows[0]);
            while from < end {
                let row = from as usize;
                let to = end.min((row + 1) as f64);
                let segment = Segment {
                    span,
                    place: DVec2::new(slice.x, (from + to) / 2.0),
                    row,
                    rows: [from, to],
                };
                if row < bottom {
                    self.shade(&segment, target, light);
                }
                from = to;
            }
        }
    }

    /// Returns the irradiance of the image of a segment on the beam axis, the argument u of the laser
    /// profile exp(−u²) in the middle of the segment, and the change of u per column and row. `None` if
    /// the surface is not lit.
    fn lit(&self, segment: &Segment) -> Option<(f64, f64, DVec2)> {
        let cut = self.cut;
        let facet = &cut.facets[segment.span.facet as usize];
        let point = cut.point(facet, segment.place);
        let section = cut.view.laser.section(point)?;
        let received = -section.flux.dot(facet.normal);
        // Also false for NaN.
        let is_lit = received > 0.0;
        let material = &cut.view.surface.kinds()[facet.material_id as usize];
        let (true, Surface::Lambert(lambert)) = (is_lit, &material.surface) else {
            return None;
        };
        let direction = cut.sight.to_sensor(segment.place);
        let irradiance =
            lambert.bsdf() * received * cut.sight.solid_angle(segment.place, direction);
        let scale = SQRT_2 / section.radius;
        let gradient = cut.height_gradient(facet, segment.place) * scale;
        Some((irradiance, point.y * scale, gradient))
    }

    /// Adds the light of a segment to the samples. Each sample is the mean over its cell. The argument
    /// of the laser profile is linearised within the pixel.
    fn shade(&self, segment: &Segment, target: &SliceTarget, light: &mut ColumnLight) {
        let Some((irradiance, u, gradient)) = self.lit(segment) else {
            return;
        };
        let count = self.nodes.places().len();
        let first = count * (segment.row - light.top);
        let side = self.nodes.side();
        let center = middle(light.column, segment.row);
        let place = segment.place - center;
        let [top, bottom] = segment
            .rows
            .map(|row| f32x4::splat((row - center.y) as f32));
        let [u, across, along] =
            [u, gradient.x, gradient.y].map(|value| f32x4::splat(value as f32));
        for (four, quad) in self.nodes.quads().iter().enumerate() {
            let ([x, y], [half_x, half_y]) = (quad.cell_center, quad.cell_half);
            let (off, half_width) = match target.width {
                Some(width) => (f32x4::ZERO, f32x4::splat(width as f32 / 2.0)),
                None => (x - place.x as f32, half_x),
            };
            let (low, high) = (top.max(y - half_y), bottom.min(y + half_y));
            let rows = (low + high) * 0.5 - place.y as f32;
            let u = u + across * off + along * rows;
            let (p, q) = (across * half_width, along * (high - low) * 0.5);
            let fractions = ((high - low) / (half_y * 2.0)).to_array();
            let mut means = mean_of_quad(u, p, q).to_array();
            let lanes = [u, p, q].map(f32x4::to_array);
            for (i, mean) in means[..quad.count].iter_mut().enumerate() {
                let sample = 4 * four + i;
                if fractions[i] <= 0.0 || !target.columns.contains(&(sample % side)) {
                    continue;
                }
                let [u, p, q] = lanes.map(|lane| lane[i]);
                if p.abs().max(q.abs()) > MOST_CHANGE {
                    *mean = mean_of_gaussian([0.0, u], [0.0, p], [0.0, q]);
                }
                let value = *mean * fractions[i] * (target.weight * irradiance) as f32;
                light.irradiance[first + sample] += value;
                if let Some(owner) = light.owners.get_mut(first + sample)
                    && value > owner.0
                {
                    *owner = (value, segment.span.facet);
                }
            }
        }
    }
}
