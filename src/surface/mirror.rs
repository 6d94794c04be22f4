//! Perfect mirror.

/// Perfect specular reflection. Light from a mirror reaches the camera only if another surface
/// scatters it before or after.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Mirror {
    /// Reflectance, 0 to 1, at all angles.
    pub reflectance: f64,
}
