//! Shape of the lens pupil.

/// Shape of the lens aperture; its width is the pupil diameter D.
#[derive(
    Debug,
    Clone,
    Copy,
    Default,
    PartialEq,
    serde::Serialize,
    serde::Deserialize,
    schemars::JsonSchema,
)]
#[serde(rename_all = "lowercase")]
pub enum Aperture {
    /// Circular disc; its diameter is the pupil diameter.
    #[default]
    Circle,
    /// Ellipse with this ratio of height to width, above 0 and at most 1.
    Ellipse(f64),
    /// Square; its side is the pupil diameter.
    Square,
}

impl Aperture {
    /// Returns the ratio of height to width.
    pub fn ratio(&self) -> f64 {
        match *self {
            Aperture::Ellipse(ratio) => ratio,
            Aperture::Circle | Aperture::Square => 1.0,
        }
    }

    /// Returns the variance along the height of points distributed uniformly over the aperture, in
    /// units of the squared width.
    ///
    /// A blur of diameter b has b² times this variance along the sensor rows.
    pub(crate) fn variance_along_height(&self) -> f64 {
        match *self {
            Aperture::Circle => 1.0 / 16.0,
            Aperture::Ellipse(ratio) => ratio * ratio / 16.0,
            Aperture::Square => 1.0 / 12.0,
        }
    }

    /// Returns the largest extent in any direction, in widths.
    pub fn extent(&self) -> f64 {
        match self {
            Aperture::Square => std::f64::consts::SQRT_2,
            Aperture::Circle | Aperture::Ellipse(_) => 1.0,
        }
    }
}
