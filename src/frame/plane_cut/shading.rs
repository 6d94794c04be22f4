//! Light of visible pieces at the samples of a column.

use super::chains::{Slice, Span};
use super::facets::BeamSection;
use super::visibility::Piece;
use crate::frame::defocus::DefocusMap;
use crate::frame::pixel_quadrature::QuadratureNodes;
use crate::frame::planar_pixel::PlanarBeamProfile;
use crate::frame::rays::{CameraRayCaster, SurfaceElement};
use crate::math::{DVec2, DVec3};
use crate::surface::Surface;
use std::f64::consts::{PI, SQRT_2};
use std::ops::Range;

/// Largest change of the argument u of exp(−u²) over an interval for which two Gauss nodes are
/// used. The error is (u/2)⁴·12/270 = 1.7·10⁻⁴ of the maximum.
const TWO_NODES: f64 = 0.5;
/// Largest change of u over a width for which one node is used. The error is u²·2/24 = 2·10⁻⁴.
const ONE_NODE: f64 = 0.05;
/// exp(−u²) is zero in f32 beyond this argument.
const DARK: f64 = 9.4;

/// Sample columns that a slice represents.
pub(super) struct SliceTarget {
    /// Sample columns of the pixel.
    pub columns: Range<usize>,
    /// Fraction of each sample's cell that the slice represents.
    pub weight: f64,
    /// Width that the slice represents, columns; `None` if it represents the pixel, so that light is
    /// evaluated at the samples.
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

/// Values that all columns have in common.
pub(super) struct Shader<'a> {
    pub cut: &'a BeamSection<'a>,
    pub rays: &'a CameraRayCaster<'a>,
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

impl Shader<'_> {
    /// Computes the light of the pieces. Pieces of one slice must not overlap.
    pub fn column(
        &self,
        column: usize,
        slices: &[Slice],
        targets: &[SliceTarget],
        pieces: &[Piece],
    ) -> Option<ColumnLight> {
        let rows = pieces.iter().map(|piece| piece.rows);
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
        for piece in pieces {
            let (slice, target) = (&slices[piece.slice], &targets[piece.slice]);
            let chain = &slice.chains[piece.chain];
            for span in &slice.spans[chain.spans.clone()] {
                let start = span.rows[0].max(piece.rows[0]);
                let end = span.rows[1].min(piece.rows[1]);
                let mut from = start;
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
                        self.shade(&segment, target, &mut light);
                    }
                    from = to;
                }
            }
        }
        Some(light)
    }

    /// Returns the plane of a segment, the beam radius there, and the irradiance of its image on the
    /// beam axis. `None` if the surface is not lit.
    fn lit(&self, segment: &Segment) -> Option<(SurfaceElement, f64, f64)> {
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
        let plane = SurfaceElement {
            point,
            normal: facet.normal,
            tolerance: 0.0,
            material_id: facet.material_id,
        };
        Some((plane, section.radius, irradiance))
    }

    fn shade(&self, segment: &Segment, target: &SliceTarget, light: &mut ColumnLight) {
        let Some((plane, radius, irradiance)) = self.lit(segment) else {
            return;
        };
        let facet = &self.cut.facets[segment.span.facet as usize];
        let count = self.nodes.places().len();
        let first = count * (segment.row - light.top);
        let mut add = |sample: usize, value: f64| {
            let value = value as f32;
            light.irradiance[first + sample] += value;
            if let Some(owner) = light.owners.get_mut(first + sample)
                && value > owner.0
            {
                *owner = (value, segment.span.facet);
            }
        };
        let is_whole = target.width.is_none() && segment.rows[1] - segment.rows[0] == 1.0;
        if is_whole {
            let profile = PlanarBeamProfile::new(segment.place, radius, &plane, self.rays);
            if let Some(profile) = profile {
                // A single sample is the mean of its pixel, as in pixels that facets divide. The
                // errors of a column would not cancel otherwise.
                let takes_means = profile.steepness() > self.nodes.steepest || count == 1;
                for (four, quad) in self.nodes.quads().iter().enumerate() {
                    let weights = profile.profile_weights(quad).to_array();
                    for (i, &weight) in weights[..quad.count].iter().enumerate() {
                        let sample = 4 * four + i;
                        let cell = &self.nodes.cells()[sample];
                        let mean = match takes_means {
                            true => profile.mean(cell.centre, cell),
                            false => weight,
                        };
                        add(sample, mean as f64 * irradiance);
                    }
                }
                return;
            }
        }
        let side = self.nodes.side();
        for column in target.columns.clone() {
            let (x, width) = match target.width {
                Some(width) => (segment.place.x, width),
                None => {
                    let cell = &self.nodes.cells()[column];
                    let center = light.column as f64 + 0.5 + cell.centre.x;
                    (center, 2.0 * cell.half.x)
                }
            };
            for sample in (0..side).map(|row| side * row + column) {
                let cell = &self.nodes.cells()[sample];
                let center = segment.row as f64 + 0.5 + cell.centre.y;
                let low = segment.rows[0].max(center - cell.half.y);
                let high = segment.rows[1].min(center + cell.half.y);
                if low < high {
                    let u = |x: f64, row: f64| {
                        self.cut.point(facet, DVec2::new(x, row)).y * SQRT_2 / radius
                    };
                    let mean = mean_over_columns([x, width], [low, high], u);
                    let fraction = (high - low) / (2.0 * cell.half.y) * target.weight;
                    add(sample, mean * fraction * irradiance);
                }
            }
        }
    }

    /// Returns the plane of a facet: unit normal and distance from the laser.
    pub fn plane(&self, facet: u32) -> SurfaceElement {
        let facet = &self.cut.facets[facet as usize];
        let center = self.cut.image_center(facet);
        let point: DVec3 = self.cut.point(facet, center);
        SurfaceElement {
            point,
            normal: facet.normal,
            tolerance: 0.0,
            material_id: facet.material_id,
        }
    }
}

/// Returns the mean of exp(−u²) over columns of a width around `x`, and over the rows. The argument
/// `u` of column and row is nearly linear.
fn mean_over_columns([x, width]: [f64; 2], rows: [f64; 2], u: impl Fn(f64, f64) -> f64) -> f64 {
    let middle = (rows[0] + rows[1]) / 2.0;
    let change = (u(x + width / 2.0, middle) - u(x - width / 2.0, middle)).abs();
    if change < ONE_NODE {
        return mean_of_gaussian(rows, |row| u(x, row));
    }
    let count = (change / TWO_NODES).ceil().max(1.0);
    let interval = width / count;
    let nodes = (0..count as usize).flat_map(|i| {
        let center = x + interval * (i as f64 + 0.5 - count / 2.0);
        let node = interval / 2.0 / 3f64.sqrt();
        [center - node, center + node]
    });
    let sum: f64 = nodes.map(|x| mean_of_gaussian(rows, |row| u(x, row))).sum();
    sum / (2.0 * count)
}

/// Returns the mean of exp(−u²) over the rows. The argument `u` of the row is nearly linear.
fn mean_of_gaussian(rows: [f64; 2], u: impl Fn(f64) -> f64) -> f64 {
    let [a, b] = rows.map(&u);
    if a.signum() == b.signum() && a.abs().min(b.abs()) > DARK {
        return 0.0;
    }
    let change = b - a;
    if change.abs() < TWO_NODES {
        let middle = (rows[0] + rows[1]) / 2.0;
        let node = (rows[1] - rows[0]) / 2.0 / 3f64.sqrt();
        let values = [-node, node].map(|off| {
            let u = u(middle + off);
            (-u * u).exp()
        });
        return (values[0] + values[1]) / 2.0;
    }
    (libm::erf(b) - libm::erf(a)) * PI.sqrt() / (2.0 * change)
}
