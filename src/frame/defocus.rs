//! Choice of the blur model, blur radius, and defocus of each sample.

use super::PoseView;
use super::pinhole::PinholeGeometry;
use super::pixel_quadrature::PixelQuadrature;
use super::rays::SurfaceElement;
use super::transform::fast_length;
use crate::camera::SpeckleSizeRange;
use crate::math::DVec2;
use std::ops::Range;

/// Blur model of the lens.
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
    /// No blur: the image is sharp.
    None,
    /// Incoherent blur: the mean light is blurred, then multiplied by speckle. If the blur is wider
    /// than two standard deviations of the line, speckle displaces the centroid too little.
    #[serde(rename = "incoherent")]
    Mean,
    /// Coherent blur: the complex field on the surface is imaged by the lens, so speckle includes
    /// the effect of defocus.
    Coherent,
}

impl Blur {
    /// Returns the blur model for images without speckle.
    pub fn without_field(self) -> Blur {
        match self {
            Blur::Coherent => Blur::Mean,
            blur => blur,
        }
    }
}

/// Parameters of the lens blur for a frame.
#[derive(Debug, Clone, Copy)]
pub struct DefocusSettings {
    /// Blur model.
    pub blur: Blur,
    /// Maximum blur radius, pixels. Light is traced up to this distance beyond the sensor border.
    pub reach: usize,
    /// Standard deviation of the thinnest line before the lens blur, pixels. Samples must resolve
    /// it.
    pub line_sigma: f64,
    /// Standard deviation of the line on steep surfaces before the lens blur, pixels.
    pub narrowest_sigma: f64,
}

impl DefocusSettings {
    /// Sharp image without blur.
    pub const NONE: DefocusSettings = DefocusSettings {
        blur: Blur::None,
        reach: 0,
        line_sigma: 1.0,
        narrowest_sigma: 1.0,
    };
}

/// Columns of lit pixels per tile.
pub(super) const COLUMNS: usize = 64;

/// Returns the blur radius for a blur diameter and a grain size, all in pixels.
pub(crate) fn reach_px(blur: f64, grain: f64) -> f64 {
    (blur / 2.0 + TAIL_GRAINS * grain).min(MAX_BLUR_REACH_PX as f64)
}

/// Maximum blur radius in a tile, pixels.
const MAX_BLUR_REACH_PX: usize = 128;
/// Margin beyond the edge of the geometric blur, grains. 1.3 % of a line's light is further away
/// (0.129/grains, the tail of the Airy pattern across the line). The mean blur omits this light
/// along rows.
pub(super) const TAIL_GRAINS: f64 = 10.0;
/// Samples per standard deviation of the line. At half a cycle per sample, the spectrum of a
/// Gaussian has fallen to exp(−2π²·0.8²·½²) = 4 %. Aliases in the passband of the lens (a fifth of
/// that) are 10⁻³.
const SAMPLES_PER_LINE_SIGMA: f64 = 0.8;

/// Returns the columns from which light may spread into `columns`, for blur radii up to `reach`.
/// The result consists of complete tiles, so it has the tiles of the complete frame.
pub(super) fn spread_into(columns: &Range<usize>, reach: usize) -> Range<usize> {
    let after = (0..=reach).map(|margin| fast_length(COLUMNS + 2 * margin) - margin);
    let after = after.max().expect("0 is one");
    let start = (columns.start + 1).saturating_sub(after);
    start.next_multiple_of(COLUMNS)..(columns.end + reach).next_multiple_of(COLUMNS)
}

/// Maximum number of samples along the side of a pixel, as for speckle.
const MAX_SAMPLES_PER_SIDE: f64 = 16.0;

/// Maximum number of samples along the side of a pixel for lines on steep surfaces. Samples there
/// are means over their cells. The centroid error of a line of σ px is at most
/// exp(−2π²·8²·σ²)/(16π) px, 8·10⁻⁴ for 0.05 px.
const MOST_ON_SLOPES: f64 = 8.0;

/// Returns the sample grid before the lens blur. Its spacing keeps the passband of the pupil free
/// of aliases.
///
/// If one sample per pixel suffices, light is integrated over pixels. Light that ends within a
/// pixel then has an error of at most 4.6 % in the pixels next to the edge. The error is 1.7 % in
/// the next pixels and 0.4 % further away. These values hold for a half-plane under the Airy
/// pattern of any size. For grains of 0.7, the transfer differs most between f and 1 − f cycles per
/// pixel.
pub(super) fn grid(view: &PoseView) -> PixelQuadrature {
    let PixelQuadrature::Gauss { per_side } = view.grid else {
        return view.grid;
    };
    // The requested grid integrates the product of light and speckle, or intensities. Light without
    // speckle, and fields, vary half as fast.
    let of_pixels = per_side.div_ceil(2);
    let of_line = (SAMPLES_PER_LINE_SIGMA / view.lens.line_sigma)
        .ceil()
        .min(MAX_SAMPLES_PER_SIDE) as u32;
    let on_slopes = (SAMPLES_PER_LINE_SIGMA / view.lens.narrowest_sigma)
        .ceil()
        .min(MOST_ON_SLOPES) as u32;
    match view.lens.blur {
        Blur::None => view.grid,
        Blur::Mean => match of_line.max(on_slopes) {
            1 => view.grid,
            least => PixelQuadrature::Even {
                per_side: of_pixels.max(least),
            },
        },
        Blur::Coherent => {
            let wider = (view.speckle.as_ref()).and_then(|speckle| speckle.pupil_scale);
            let of_speckle = (wider.unwrap_or(1.0) / smallest_grain(view))
                .ceil()
                .min(MAX_SAMPLES_PER_SIDE) as u32;
            PixelQuadrature::Even {
                per_side: of_pixels.max(of_line).max(of_speckle),
            }
        }
    }
}

/// Returns the grid at which the intensity of a field behind the lens is evaluated. The intensity
/// has no finer detail than grains of size h, which 1 + 1.5/h nodes per side integrate. More than
/// one additional node has no effect.
pub(super) fn grid_behind(view: &PoseView) -> PixelQuadrature {
    let enough = 2
        + (1.5 / smallest_grain(view))
            .ceil()
            .min(MAX_SAMPLES_PER_SIDE) as u32;
    match view.grid {
        PixelQuadrature::Gauss { per_side } => PixelQuadrature::Gauss {
            per_side: per_side.min(enough),
        },
        even => even,
    }
}

/// Returns the smallest grain size at the corners of the sensor, pixels.
fn smallest_grain(view: &PoseView) -> f64 {
    let resolution = view.camera.sensor.resolution.as_dvec2();
    let places = [
        DVec2::ZERO,
        resolution.with_y(0.0),
        resolution.with_x(0.0),
        resolution,
    ];
    let wavelength = view.laser.beam.wavelength;
    let of = |extent: SpeckleSizeRange, place: &DVec2| {
        extent.with(view.camera.grains_per_pixel(*place, wavelength))
    };
    places
        .iter()
        .fold(SpeckleSizeRange::NONE, of)
        .speckle_size_px
}

/// Defocus β of samples as a function of the surface distance.
pub(super) struct DefocusMap {
    /// D²/λ, mm.
    scale: f64,
    focal_length: f64,
}

impl DefocusMap {
    /// Returns `None` if the image is not blurred.
    pub fn new(view: &PoseView) -> Option<DefocusMap> {
        let lens = &view.camera.lens;
        let scale = lens.pupil_diameter().powi(2) / view.laser.beam.wavelength;
        let focal_length = lens.focal_length;
        (view.lens.blur != Blur::None).then_some(DefocusMap {
            scale,
            focal_length,
        })
    }

    /// Returns β of the surface that the ray of a sensor position hits.
    pub fn blur(&self, sight: &PinholeGeometry, place: DVec2, plane: &SurfaceElement) -> f32 {
        let distance = sight.axis.dot(plane.point - sight.camera_center);
        let behind = sight.axis.dot(sight.to_sensor(place));
        let vergence = 1.0 / distance - 1.0 / self.focal_length + 1.0 / behind;
        (self.scale * vergence) as f32
    }
}
