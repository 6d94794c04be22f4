//! One frame, from a pose of the sensor to the counts of its image. This is the page on
//! which its stages are called one after the other; each is a function from plain data to
//! plain data in the file of its name.
//!
//! ```text
//! footprint → rays → light → blur → expose (speckle × light, over pixels) → counts
//! ```

mod bend;
mod blur;
mod counts;
mod expose;
mod flat;
mod footprint;
mod geometric;
mod grid;
mod irradiance;
mod light;
mod pixels;
mod polygon;
mod rays;
mod reference;
mod sight;
mod speckle;
mod truth;
mod window;

pub use blur::blur;
pub use counts::Readout;
pub use expose::expose;
pub use footprint::{Region, footprint};
pub use geometric::{LinePoint, Sheet};
pub use grid::Grid;
pub use irradiance::Irradiance;
pub use light::{Light, Sampling, light};
pub use pixels::Pixels;
pub use reference::{Reference, Strips};
pub use speckle::{Patterns, Speckle};
pub use truth::{Truth, truth_layers};

pub(crate) use bend::Bend;
pub(crate) use footprint::{frustum, sides};
pub(crate) use geometric::SheetAngles;
pub(crate) use grid::sampling_error;
pub(crate) use sight::{Projection, Sight};

use crate::accel::Accel;
use crate::camera::{Camera, Counts};
use crate::laser::Laser;
use crate::math::Rigid;
use crate::math::rng::Key;
use crate::surface::Lambert;

/// Everything one pose of the sensor depends on, in the part's frame.
pub struct View<'a> {
    /// Rays against the part.
    pub accel: &'a Accel,
    /// How the part scatters light.
    pub surface: Lambert,
    /// The source of light.
    pub laser: &'a Laser,
    /// Where the laser stands.
    pub part_from_laser: Rigid,
    /// Lens and sensor.
    pub camera: &'a Camera,
    /// Where the camera stands.
    pub part_from_camera: Rigid,
    /// `None`: the light is taken as incoherent.
    pub speckle: Option<Speckle<'a>>,
    /// Where in a pixel light is sampled.
    pub grid: Grid,
    /// Which samples are traced.
    pub sampling: Sampling,
    /// Beam radii at which light is taken to end, at most
    /// [`CUTOFF_RADII`](crate::laser::CUTOFF_RADII).
    pub cutoff_radii: f64,
}

/// The image that the sensor takes: the mean of the light over the `views` of one exposure
/// (at least one), and what the sensor makes of it. `key` is the frame's.
pub fn take<'a>(
    views: impl IntoIterator<Item = View<'a>>,
    region: &Region,
    readout: &Readout,
    key: Key,
) -> Counts {
    let images = views.into_iter().map(|view| irradiance(&view, region));
    readout.counts(&Irradiance::mean(images.collect()), key)
}

/// Mean irradiance of each pixel, mW/mm². The same bytes for any number of threads, and
/// for [`Region::All`] and [`Region::Lit`].
pub fn irradiance(view: &View, region: &Region) -> Irradiance {
    let pixels = footprint(view, region); // which pixels may see laser light
    let light = light(view, pixels); // rays: irradiance and depth at each sample
    let light = blur(light); // what the lens spreads
    expose(light, view) // speckle × light, integrated over pixels
}
