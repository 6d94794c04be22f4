//! Tables of surfaces.

use super::arrays::{array, optional_array};
use schemars::JsonSchema;
use serde::Deserialize;

/// Surface of the part: `metal`, `coated_diffuse`, `diffuse` or `mirror`, or a mixture of them
/// weighted by `weight`.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SurfaceTable {
    pub metal: Option<MetalTable>,
    pub coated_diffuse: Option<CoatedDiffuseTable>,
    pub diffuse: Option<DiffuseTable>,
    pub mirror: Option<MirrorTable>,
    pub lay: Option<LayTable>,
    /// Heights of a milled, printed or cast surface. Default: none.
    pub topography: Option<TopographyTable>,
}

/// Rough bare metal with GGX microfacets (Walter et al. 2007). The refractive index is given by
/// `name`, or by `n` and `k`.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MetalTable {
    /// Metal whose refractive index is used at the laser wavelength: aluminium, copper, iron or
    /// titanium.
    pub name: Option<String>,
    /// Real part of the refractive index.
    pub n: Option<f64>,
    /// Imaginary part of the refractive index.
    pub k: Option<f64>,
    /// GGX roughness α, 0.01 (nearly a mirror) to 1. Half of the facets have a slope below α.
    pub roughness: f64,
    /// GGX roughness α perpendicular to the lay; `roughness` then applies along the lay. Default:
    /// `roughness`.
    pub roughness_v: Option<f64>,
    /// Weight of this material in the mixture, 0 to 1. Default: 1.
    #[serde(default = "one")]
    pub weight: f64,
}

/// Clear coat over a diffuse base: paint, varnish, coloured anodising.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CoatedDiffuseTable {
    /// Refractive index of the coat, 1.05 to 3.
    pub index: f64,
    /// GGX roughness α of the coat, 0.01 (nearly a mirror) to 1.
    pub roughness: f64,
    /// GGX roughness α of the coat perpendicular to the lay. Default: `roughness`.
    pub roughness_v: Option<f64>,
    /// Diffuse reflectance of the base without the coat, 0 to 1.
    pub reflectance: f64,
    /// Weight of this material in the mixture, 0 to 1. Default: 1.
    #[serde(default = "one")]
    pub weight: f64,
}

/// Diffuse (Lambertian) reflector.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DiffuseTable {
    /// Reflectance, 0 to 1.
    pub reflectance: f64,
    /// Weight of this material in the mixture, 0 to 1. Default: 1.
    #[serde(default = "one")]
    pub weight: f64,
}

/// Perfect mirror. It is visible only by the light of other surfaces that it reflects.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MirrorTable {
    /// Reflectance, 0 to 1.
    pub reflectance: f64,
    /// Weight of this material in the mixture, 0 to 1. Default: 1.
    #[serde(default = "one")]
    pub weight: f64,
}

/// Lay of the surface (direction of the machining grooves) in the part's frame. Grooves run along
/// `direction` (milled, ground), or in circles about an axis (turned).
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LayTable {
    /// Direction of the grooves of a milled or ground surface, any length.
    #[serde(default, deserialize_with = "optional_array")]
    pub direction: Option<[f64; 3]>,
    /// A point on the turning axis. Default: the part's origin.
    #[serde(default, deserialize_with = "array")]
    pub axis_point_mm: [f64; 3],
    /// Direction of the turning axis, any length.
    #[serde(default, deserialize_with = "optional_array")]
    pub axis_direction: Option<[f64; 3]>,
}

/// Topography: random heights along the surface normal, with a normal distribution and a Gaussian
/// autocorrelation function. The field is fixed to the part and follows from the seed. It displaces
/// the detected rows of the line, averaged over the line and the column. Images and the ground
/// truth do not contain it. It applies to slopes that are small and hide no surface.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TopographyTable {
    /// Root mean square height Sq (ISO 25178-2).
    pub sq_um: f64,
    /// Autocorrelation length Sal (ISO 25178-2), at which the autocorrelation is 0.2. With a lay, it
    /// applies across the lay.
    pub length_mm: f64,
    /// Length along the lay at which the autocorrelation is 0.2, at least `length_mm`. It requires
    /// `lay`. Default: `length_mm`.
    pub length_along_mm: Option<f64>,
}

/// Returns the default of factors and weights.
pub(super) fn one() -> f64 {
    1.0
}
