//! Tables of objects that are not inspected.

use super::arrays::array;
use super::surface_table::SurfaceTable;
use super::unit::Unit;
use schemars::JsonSchema;
use serde::Deserialize;

/// Object that is not inspected: a fixture or a table. It casts shadows and reflects light, and it
/// moves with the part. Points that lie on it are not output.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ObjectTable {
    /// Mesh file (STL, OBJ, PLY, glTF, 3MF), relative to the scene file.
    pub file: String,
    /// Length unit of the file. Required if the file does not state one.
    pub unit: Option<Unit>,
    /// Lambertian (diffuse) reflectance, 0 to 1. Required unless `surface` is given.
    pub reflectance: Option<f64>,
    /// Metal, paint or a mixture; replaces `reflectance`.
    pub surface: Option<SurfaceTable>,
    /// Position of the object's origin in the part's frame. Default: the origin.
    #[serde(default, deserialize_with = "array")]
    pub position_mm: [f64; 3],
    /// Rotation about the part's x, then y, then z axis. Default: none.
    #[serde(default, deserialize_with = "array")]
    pub rotation_deg: [f64; 3],
}
