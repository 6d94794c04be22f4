//! One frame, from a pose of the sensor to the counts of its image. This is the page on
//! which its stages are called one after the other; each is a function from plain data to
//! plain data in the file of its name.
//!
//! ```text
//! footprint → rays → light → skew → blur ─┬→ expose (speckle × light, over pixels) → counts
//!                                 ghosts ─┘
//! ```

mod bend;
mod blur;
mod counts;
mod defocus;
mod disc;
mod expose;
mod eye;
mod flat;
mod footprint;
mod geometric;
mod ghosts;
mod gloss;
mod grid;
mod irradiance;
mod join;
mod light;
mod pixels;
mod polygon;
mod pupil;
mod rays;
mod reference;
mod sight;
mod skew;
mod speckle;
mod transform;
mod truth;
mod walk;
mod window;

pub use blur::blur;
pub use counts::Readout;
pub use defocus::{Blur, LensBlur};
pub use expose::expose;
pub use footprint::{Region, footprint};
pub use geometric::{LinePoint, Sheet};
pub use ghosts::{Ghosts, Indirect, Reflections, ghosts, met_again};
pub use grid::Grid;
pub use irradiance::Irradiance;
pub use light::{Light, Sampling, light};
pub use pixels::Pixels;
pub use reference::{Reference, Strips};
pub use skew::skew;
pub use speckle::{Patterns, Speckle};
pub use truth::{Truth, truth_layers};

pub(crate) use bend::Bend;
pub(crate) use defocus::{TILE, reach_px};
pub(crate) use footprint::{frustum, sides};
pub(crate) use geometric::SheetAngles;
pub(crate) use grid::{SAMPLING_TOLERANCE_PX, narrowest, sampling_error};
pub(crate) use polygon::Polygon;
pub(crate) use sight::{Projection, Sight};

use crate::accel::Accel;
use crate::camera::{Camera, NearLight};
use crate::laser::Laser;
use crate::math::Rigid;
use crate::math::rng::Key;
use crate::surface::Surfaces;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, Ordering};

/// Everything one pose of the sensor depends on, in the part's frame.
#[derive(Clone)]
pub struct View<'a> {
    /// Rays against the part.
    pub accel: &'a Accel,
    /// How the part scatters light.
    pub surface: Surfaces,
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
    /// The lens's blur.
    pub lens: LensBlur,
    /// `None`: light is reflected once.
    pub indirect: Option<Indirect>,
    /// Ends the stages when it is set, from any thread; `None`: they always run to their end.
    pub stop: Option<&'a AtomicBool>,
}

/// The payload of the unwinding that ends a frame whose `stop` is set.
struct Stopped;

impl View<'_> {
    /// Unwinds once `stop` is set, up to [`unless_stopped`]. A stage has nothing to return for light that was not
    /// traced, and rayon carries the unwinding from its threads to the caller.
    fn unwind_if_stopped(&self) {
        if self.stop.is_some_and(|stop| stop.load(Ordering::Relaxed)) {
            resume_unwind(Box::new(Stopped));
        }
    }
}

/// Returns the result of `work`; `None` where it traced a view whose `stop` was set.
pub fn unless_stopped<T>(work: impl FnOnce() -> T) -> Option<T> {
    match catch_unwind(AssertUnwindSafe(work)) {
        Ok(done) => Some(done),
        Err(why) if why.is::<Stopped>() => None,
        Err(why) => resume_unwind(why),
    }
}

/// The image that the sensor takes, drawn near its light: the mean of the light over the `views` of one exposure
/// (at least one), and what the sensor makes of it. `key` is the frame's.
pub fn take<'a>(
    views: impl IntoIterator<Item = View<'a>>,
    region: &Region,
    readout: &Readout,
    key: Key,
) -> NearLight {
    let images = views.into_iter().map(|view| irradiance(&view, region));
    readout.near_light(&Irradiance::mean(images.collect()), key)
}

/// Mean irradiance of each pixel, mW/mm². The same bytes for any number of threads, and
/// for [`Region::All`] and [`Region::Lit`].
pub fn irradiance(view: &View, region: &Region) -> Irradiance {
    let again = |indirect| ghosts(view, region, indirect); // light that is reflected more than once
    irradiance_with(view, region, view.indirect.as_ref().map(again).as_ref())
}

/// The same with light that is reflected more than once as it was found before; without it if it is `None`.
pub(crate) fn irradiance_with(view: &View, region: &Region, ghosts: Option<&Ghosts>) -> Irradiance {
    let (camera, wider) = beyond_the_edges(view, region);
    let traced = &View {
        camera: &camera,
        ..view.clone()
    };
    let pixels = footprint(traced, &wider); // which pixels may see laser light
    let light = light(traced, pixels); // rays: irradiance and depth at each sample
    let light = skew(light); // out of focus, gloss lies to one side
    let light = blur(light, view, region); // what the lens spreads
    let (Some(indirect), Some(ghosts)) = (&view.indirect, ghosts) else {
        return expose(light, view); // speckle × light, integrated over pixels
    };
    match indirect.is_one_field(view) {
        true => expose(light.with_indirect(&ghosts.mean), view),
        false => Irradiance::sum(&[expose(light, view), ghosts.exposed(view)]),
    }
}

/// Mean irradiance of each pixel without speckle, mW/mm²: of light reflected once, and more than once. Together they are
/// the mean of `irradiance` over all speckle.
pub fn shares(view: &View, region: &Region) -> [Irradiance; 2] {
    let mut direct = View {
        speckle: None,
        indirect: None,
        ..view.clone()
    };
    direct.lens.blur = direct.lens.blur.without_field();
    let more = match &view.indirect {
        Some(indirect) => ghosts(&direct, region, indirect).mean,
        None => Irradiance::dark(view.camera.sensor.resolution),
    };
    [irradiance(&direct, region), more]
}

/// A camera whose sensor is so much larger on each side that all light that the lens spreads onto the
/// view's is on it, and the region there.
fn beyond_the_edges<'a>(view: &View, region: &Region<'a>) -> (Camera, Region<'a>) {
    let reach = view.lens.reach;
    let mut camera = view.camera.clone();
    camera.sensor.resolution += 2 * reach as u32;
    let region = match region.clone() {
        Region::Columns(clusters, columns) => {
            Region::Columns(clusters, columns.start + reach..columns.end + reach)
        }
        region => region,
    };
    (camera, region)
}
