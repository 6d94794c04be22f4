//! From an image to a profile: peaks of the laser line, and through a calibration
//! to millimetres. Sees images and a calibration, never the scene.
//!
//! `background` says what counts are noise, `find` which lines a frame holds and
//! what is doubtful about them, `locate` and `fit` where each lies in its pixels,
//! `uncertainty` how surely, by the `variances` of lines anywhere on the sensor, `blurred` by the lens or sharp; `cut` which of them edges
//! along them cut, `horizon` which ones edges may cut that single columns do not show, `clipping` what
//! saturation leaves of them. `filter` is what sensors do to profiles before they deliver them.

mod adjust;
mod background;
mod blurred;
mod calibration;
mod calibration_file;
mod clipping;
mod cut;
mod filter;
mod find;
mod fit;
mod flags;
mod ghosts;
mod horizon;
mod influence;
mod line;
mod locate;
mod median_variance;
mod neighbourhood;
mod peak;
mod slope;
mod uncertainty;
mod variances;
mod widths;

pub use adjust::{Adjustment, Dot, LinePoint, Observations, adjust};
pub use background::{FALSE_PEAKS_PER_FRAME, least_height};
pub use blurred::Blurred;
pub use calibration::{Calibration, Covariance, PARAMETERS, Parameters, PointJacobian};
pub use clipping::blinding_height;
pub use filter::{
    DeliveredRow, Drift, Filters, FrameStep, OUTLIER_COLUMNS, ProfileFilter, ProfileRow, Smooth,
    sum_of_both_sides,
};
pub use find::{CANDIDATE_SHARE, find_peaks};
pub use flags::{NARROW_RATIO, WEAK_SHARE, WEAK_SNR, WIDE_RATIO, compare_neighbours, weigh};
pub use peak::{Choice, Flags, Peak, PeakFinder, PeakSettings};
pub use slope::JUMP_SIGMAS;
pub use uncertainty::{
    ErrorModel, LARGEST_LIGHT_VARIANCE, LARGEST_SHAPE_VARIANCE, Merged, RowError,
};
pub use variances::{SIGMAS_PX, SpeckleGrain};
