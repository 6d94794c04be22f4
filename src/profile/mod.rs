//! From an image to a profile: peaks of the laser line, and through a calibration
//! to millimetres. Sees images and a calibration, never the scene.

mod adjust;
mod calibration;
mod calibration_file;
mod normal;
mod peak;
mod residual_picture;

pub use adjust::{Adjustment, Dot, LinePoint, Observations, adjust};
pub use calibration::{Calibration, Covariance, PARAMETERS, Parameters, PointJacobian};
pub use peak::{Peak, find_peaks};
pub use residual_picture::residual_picture;
