//! Which blur of the lens is computed, how far it goes, and how far each sample is out of focus.

use super::View;
use super::grid::Grid;
use super::rays::Plane;
use super::sight::Sight;
use super::transform::fast_length;
use crate::camera::GrainExtent;
use crate::math::DVec2;
use std::ops::Range;

/// What is done of the lens's blur.
#[derive(
    Debug,
    Clone,
    Copy,
    PartialEq,
    Eq,
    PartialOrd,
    serde::Serialize,
    serde::Deserialize,
    schemars::JsonSchema,
)]
#[serde(rename_all = "lowercase")]
pub enum Blur {
    /// Nothing: the image is sharp.
    None,
    /// The mean light is spread, and speckle multiplied into it. Where the blur is wider than two
    /// standard deviations of the line, speckle so moves its centroid too little.
    Mean,
    /// The field on the surface goes through the lens: speckle, too, is as the blur makes it.
    Coherent,
}

impl Blur {
    /// What is left of it without speckle.
    pub fn without_field(self) -> Blur {
        match self {
            Blur::Coherent => Blur::Mean,
            blur => blur,
        }
    }
}

/// What the frame has to know of the lens's blur.
#[derive(Debug, Clone, Copy)]
pub struct LensBlur {
    /// What is done of it.
    pub blur: Blur,
    /// How far light is spread at most, pixels; so far beyond the sensor's edges it is traced.
    pub reach: usize,
    /// Standard deviation of the thinnest line without the lens, pixels: what samples must resolve.
    pub line_sigma: f64,
    /// Standard deviation of the line on steep surfaces without the lens, pixels.
    pub narrowest_sigma: f64,
}

impl LensBlur {
    /// A sharp image.
    pub const NONE: LensBlur = LensBlur {
        blur: Blur::None,
        reach: 0,
        line_sigma: 1.0,
        narrowest_sigma: 1.0,
    };
}

/// Columns of a tile's light.
pub(super) const COLUMNS: usize = 64;
/// The same, for costs.
pub(crate) const TILE: f64 = COLUMNS as f64;

/// How far light of a blur is spread where grains are so large, all in pixels.
pub(crate) fn reach_px(blur: f64, grain: f64) -> f64 {
    (blur / 2.0 + GRAINS * grain).min(FURTHEST as f64)
}

/// Furthest that light is spread in a tile, pixels.
const FURTHEST: usize = 128;
/// Grains beyond the blur's edge to which light is spread: 1.3 % of a line's light is further off
/// (0.129/grains, the tail of Airy's pattern across it), and comes in again on the other side.
pub(super) const GRAINS: f64 = 10.0;
/// Samples that a standard deviation of the line needs: of a Gaussian exp(−2π²·0.8²·½²) = 4 % is left at half
/// a cycle a sample, and what is mixed with what the lens passes (a fifth of that) is 10⁻³.
const SAMPLES: f64 = 0.8;

/// The columns from which light is spread into these, so far at most: whole tiles, so that they are
/// those of the whole frame.
pub(super) fn spread_into(columns: &Range<usize>, reach: usize) -> Range<usize> {
    let after = (0..=reach).map(|margin| fast_length(COLUMNS + 2 * margin) - margin);
    let after = after.max().expect("0 is one");
    let start = (columns.start + 1).saturating_sub(after);
    start.next_multiple_of(COLUMNS)..(columns.end + reach).next_multiple_of(COLUMNS)
}

/// Most of them along the side of a pixel, as for speckle.
const MOST: f64 = 16.0;

/// Most of them for lines on steep surfaces. A sample there is the mean over its part of the pixel: the centroid
/// of a line of σ px errs by at most exp(−2π²·8²·σ²)/(16π) px, 8·10⁻⁴ for 0.05 px.
const MOST_ON_SLOPES: f64 = 8.0;

/// Where in a pixel light is sampled before the lens spreads it: so finely that what the pupil lets pass is
/// not mixed with finer parts of it. Where pixels alone are as fine, they are integrated: light that ends within
/// a pixel is then off by at most 4.6 % of it in the pixels beside that edge, 1.7 % in the next, and 0.4 % further on (a half-plane
/// under Airy's pattern of any size, whose transfer differs most between f and 1 − f cycles a pixel where grains
/// are 0.7).
pub(super) fn grid(view: &View) -> Grid {
    let Grid::Gauss { per_side } = view.grid else {
        return view.grid;
    };
    // What integrals over pixels ask for is of light and speckle, or of intensities; light alone, and
    // fields, vary half as fast.
    let of_pixels = per_side.div_ceil(2);
    let of_line = (SAMPLES / view.lens.line_sigma).ceil().min(MOST) as u32;
    let on_slopes = (SAMPLES / view.lens.narrowest_sigma)
        .ceil()
        .min(MOST_ON_SLOPES) as u32;
    match view.lens.blur {
        Blur::None => view.grid,
        Blur::Mean => match of_line.max(on_slopes) {
            1 => view.grid,
            least => Grid::Even {
                per_side: of_pixels.max(least),
            },
        },
        Blur::Coherent => {
            let wider = (view.speckle.as_ref()).and_then(|speckle| speckle.wider);
            let of_speckle = (wider.unwrap_or(1.0) / smallest_grain(view))
                .ceil()
                .min(MOST) as u32;
            Grid::Even {
                per_side: of_pixels.max(of_line).max(of_speckle),
            }
        }
    }
}

/// Where in a pixel the intensity of a field behind the lens is taken: of no finer detail than grains, which
/// 1 + 1.5/h nodes a side integrate; more than one in addition change nothing.
pub(super) fn grid_behind(view: &View) -> Grid {
    let enough = 2 + (1.5 / smallest_grain(view)).ceil().min(MOST) as u32;
    match view.grid {
        Grid::Gauss { per_side } => Grid::Gauss {
            per_side: per_side.min(enough),
        },
        even => even,
    }
}

/// Of the sensor's corners, pixels.
fn smallest_grain(view: &View) -> f64 {
    let resolution = view.camera.sensor.resolution.as_dvec2();
    let places = [
        DVec2::ZERO,
        resolution.with_y(0.0),
        resolution.with_x(0.0),
        resolution,
    ];
    let wavelength = view.laser.beam.wavelength;
    let of = |extent: GrainExtent, place: &DVec2| {
        extent.with(view.camera.grains_per_pixel(*place, wavelength))
    };
    places.iter().fold(GrainExtent::NONE, of).speckle_size_px
}

/// By how much light is out of focus where it is seen.
pub(super) struct Spread {
    /// D²/λ, mm.
    scale: f64,
    focal_length: f64,
}

impl Spread {
    /// `None`: nothing is spread.
    pub fn new(view: &View) -> Option<Spread> {
        let lens = &view.camera.lens;
        let scale = lens.pupil_diameter().powi(2) / view.laser.beam.wavelength;
        let focal_length = lens.focal_length;
        (view.lens.blur != Blur::None).then_some(Spread {
            scale,
            focal_length,
        })
    }

    /// β of the surface that the ray through a place on the sensor meets.
    pub fn blur(&self, sight: &Sight, place: DVec2, plane: &Plane) -> f32 {
        let distance = sight.axis.dot(plane.point - sight.eye);
        let behind = sight.axis.dot(sight.to_sensor(place));
        let vergence = 1.0 / distance - 1.0 / self.focal_length + 1.0 / behind;
        (self.scale * vergence) as f32
    }
}
