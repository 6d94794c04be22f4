//! Simulation of one frame, from a pose of the sensor to the counts of its image. This file calls
//! the stages in order. Each stage is a function from plain data to plain data.
//!
//! ```text
//! widened sensor → footprint → light → centroid shift → blur ─┬→ expose ─┬→ counts
//!                                             indirect light ─┴→ expose ─┘
//! ```
//!
//! `expose` multiplies light by speckle and integrates it over pixels. Direct and indirect light are
//! exposed with one speckle pattern if their fields add, and separately otherwise.

mod blur;
mod circular_otf;
mod counts;
mod defocus;
mod direct_light;
mod distorted_frustum;
mod footprint;
mod geometric;
mod ground_truth;
mod indirect;
mod irradiance;
mod laser_emitter;
mod line_image;
mod line_source;
mod mis;
mod pinhole;
mod pixel_integration;
mod pixel_mask;
mod pixel_quadrature;
mod planar_pixel;
mod plane_cut;
mod polygon;
mod pupil;
mod pupil_brdf;
mod pupil_centroid;
mod random_walk;
mod rays;
mod speckle;
mod speckle_strips;
mod thin_lens;
mod tile_classification;
mod transform;

pub use blur::blur;
pub use counts::Readout;
pub use defocus::{Blur, DefocusSettings};
pub use direct_light::{DirectIrradiance, Sampling, light};
pub use footprint::{TracedRegion, footprint};
pub use geometric::{IdealProfilePoint, LaserPlaneSampler};
pub use ground_truth::{Truth, truth_layers};
pub use indirect::{
    IndirectLight, IndirectSettings, Reflections, indirect_irradiance, second_hit_power,
};
pub use irradiance::Irradiance;
pub use line_source::lit_curve_applies;
pub use pixel_integration::expose;
pub use pixel_mask::PixelMask;
pub use pixel_quadrature::PixelQuadrature;
pub use pupil_centroid::pupil_centroid_shift;
pub use speckle::{Speckle, SpeckleSource};
pub use speckle_strips::{StripReference, StripReferences};

pub(crate) use defocus::reach_px;
pub(crate) use distorted_frustum::DistortedFrustum;
pub(crate) use footprint::{frustum, sides};
pub(crate) use geometric::FanAngleRange;
pub(crate) use pinhole::{PinholeGeometry, Projection};
pub(crate) use pixel_quadrature::{SAMPLING_TOLERANCE_PX, narrowest, sampling_error};
pub(crate) use plane_cut::unmet_plane_cut_requirement;
pub(crate) use polygon::Polygon;

use crate::accel::Accel;
use crate::camera::Camera;
use crate::laser::Laser;
use crate::math::Rigid;
use crate::surface::Materials;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, Ordering};

/// Inputs of the simulation for one pose of the sensor, in the part's frame.
#[derive(Clone)]
pub struct PoseView<'a> {
    /// Acceleration structure that intersects rays with the part.
    pub accel: &'a Accel,
    /// Reflectance of the part.
    pub surface: Materials,
    /// Light source.
    pub laser: &'a Laser,
    /// Pose of the laser.
    pub part_from_laser: Rigid,
    /// Lens and sensor.
    pub camera: &'a Camera,
    /// Pose of the camera.
    pub part_from_camera: Rigid,
    /// Speckle patterns; `None` for incoherent light.
    pub speckle: Option<Speckle<'a>>,
    /// Sample positions within a pixel.
    pub grid: PixelQuadrature,
    /// Selection of the samples that are traced.
    pub sampling: Sampling,
    /// Beam cut-off, in beam radii, at most [`CUTOFF_RADII`](crate::laser::CUTOFF_RADII).
    pub beam_cutoff_radii: f64,
    /// Defocus blur and diffraction of the lens.
    pub lens: DefocusSettings,
    /// Indirect light; `None` if only direct light is simulated.
    pub indirect: Option<IndirectSettings>,
    /// Cancellation flag: any thread may set it to end the stages. `None`: the stages cannot be
    /// cancelled.
    pub stop: Option<&'a AtomicBool>,
}

/// Payload of the unwinding that ends a cancelled frame.
struct Stopped;

impl PoseView<'_> {
    /// Unwinds to [`unless_stopped`] if `stop` is set. A stage has no result for light that was not
    /// traced. Rayon carries the unwinding from its threads to the caller.
    fn unwind_if_stopped(&self) {
        if self.stop.is_some_and(|stop| stop.load(Ordering::Relaxed)) {
            resume_unwind(Box::new(Stopped));
        }
    }
}

/// Returns the result of `work`, or `None` if `work` traced a view whose `stop` was set.
pub fn unless_stopped<T>(work: impl FnOnce() -> T) -> Option<T> {
    match catch_unwind(AssertUnwindSafe(work)) {
        Ok(done) => Some(done),
        Err(why) if why.is::<Stopped>() => None,
        Err(why) => resume_unwind(why),
    }
}

/// Computes the mean irradiance of each pixel, mW/mm². The result is byte-identical for any number
/// of threads, and for [`TracedRegion::All`] and [`TracedRegion::Lit`]. The exception is
/// [`Sampling::PlaneCut`], for which [`TracedRegion::Lit`] ignores surface up to 0.35 pixels above a
/// plane.
pub fn irradiance(view: &PoseView, region: &TracedRegion) -> Irradiance {
    let again = |indirect| indirect_irradiance(view, region, indirect); // light that is reflected more than once
    irradiance_with(view, region, view.indirect.as_ref().map(again).as_ref())
}

/// Computes [`irradiance()`] with the given indirect light, or without indirect light if `ghosts`
/// is `None`.
pub(crate) fn irradiance_with(
    view: &PoseView,
    region: &TracedRegion,
    ghosts: Option<&IndirectLight>,
) -> Irradiance {
    let (camera, wider) = beyond_the_edges(view, region);
    let traced = &PoseView {
        camera: &camera,
        ..view.clone()
    };
    // Irradiance and depth at each sample of the pixels that see laser light.
    let light = plane_cut::light(traced, &wider)
        .unwrap_or_else(|| light(traced, footprint(traced, &wider)));
    let light = pupil_centroid_shift(light); // out of focus, gloss lies to one side
    let light = blur(light, view, region); // what the lens spreads
    let (Some(indirect), Some(ghosts)) = (&view.indirect, ghosts) else {
        return expose(light, view); // speckle × light, integrated over pixels
    };
    match indirect.is_one_field(view) {
        true => expose(light.with_indirect(&ghosts.mean), view),
        false => Irradiance::sum(&[expose(light, view), ghosts.pixel_irradiance(view)]),
    }
}

/// Computes the mean direct light of each pixel without speckle, mW/mm². Its sum with the mean
/// indirect light is the mean of `irradiance` over all speckle patterns.
pub(crate) fn mean_direct(view: &PoseView, region: &TracedRegion) -> Irradiance {
    let mut direct = PoseView {
        speckle: None,
        indirect: None,
        ..view.clone()
    };
    direct.lens.blur = direct.lens.blur.without_field();
    irradiance(&direct, region)
}

/// Returns the view's camera with a sensor enlarged by the blur radius on each side, and the region
/// shifted accordingly. All light that the lens spreads onto the original sensor falls on the
/// enlarged one.
fn beyond_the_edges<'a>(view: &PoseView, region: &TracedRegion<'a>) -> (Camera, TracedRegion<'a>) {
    let reach = view.lens.reach;
    let mut camera = view.camera.clone();
    camera.sensor.resolution += 2 * reach as u32;
    let region = match region.clone() {
        TracedRegion::Columns(clusters, columns) => {
            TracedRegion::Columns(clusters, columns.start + reach..columns.end + reach)
        }
        region => region,
    };
    (camera, region)
}
