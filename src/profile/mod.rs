//! From an image to a profile: peaks of the laser line, and through a calibration
//! to millimetres. Sees images and a calibration, never the scene.

mod peak;
mod triangulate;

pub use peak::{Peak, find_peaks};
pub use triangulate::Calibration;
