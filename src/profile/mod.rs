//! From an image to a profile: peaks of the laser line, and through a calibration
//! to millimetres. Sees images and a calibration, never the scene.
//!
//! `background` says what counts are noise, `find` which lines a frame holds and
//! what is doubtful about them, `locate` and `fit` where each lies in its pixels,
//! `uncertainty` how surely.

mod background;
mod find;
mod fit;
mod locate;
mod peak;
mod triangulate;
mod uncertainty;

pub use background::FALSE_PEAKS_PER_FRAME;
pub use find::{
    CANDIDATE_SHARE, JUMP_SIGMAS, NARROW_RATIO, WEAK_SHARE, WEAK_SNR, WIDE_RATIO, find_peaks,
};
pub use peak::{Choice, Flags, Peak, PeakFinder, PeakSettings};
pub use triangulate::Calibration;
pub use uncertainty::{
    ErrorModel, LARGEST_LIGHT_VARIANCE, LARGEST_SHAPE_VARIANCE, SIGMAS_PX, SpeckleGrain,
};
