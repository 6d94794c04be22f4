//! A perfect mirror.

/// Reflects one direction into one: light reaches the camera by it only after, or before, it is scattered by
/// something else.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Mirror {
    /// Share of the light that is reflected, 0 to 1, at all angles.
    pub reflectance: f64,
}
