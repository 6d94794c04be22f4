//! The shape of a pupil.

/// Shape of the lens's aperture; its width is the pupil diameter D.
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
    /// A disc; its diameter is the pupil's.
    #[default]
    Circle,
    /// Height / width, above 0 and at most 1.
    Ellipse(f64),
    /// A square; its side is the pupil's diameter.
    Square,
}

impl Aperture {
    /// Height / width.
    pub fn ratio(&self) -> f64 {
        match *self {
            Aperture::Ellipse(ratio) => ratio,
            Aperture::Circle | Aperture::Square => 1.0,
        }
    }

    /// Returns the variance, along its height, of points distributed uniformly over it, in squares of the width.
    ///
    /// A blur of diameter b has this variance times b² along the sensor's rows.
    pub(crate) fn variance_along_height(&self) -> f64 {
        match *self {
            Aperture::Circle => 1.0 / 16.0,
            Aperture::Ellipse(ratio) => ratio * ratio / 16.0,
            Aperture::Square => 1.0 / 12.0,
        }
    }

    /// Largest extent in any direction, in widths.
    pub fn extent(&self) -> f64 {
        match self {
            Aperture::Square => std::f64::consts::SQRT_2,
            Aperture::Circle | Aperture::Ellipse(_) => 1.0,
        }
    }
}
