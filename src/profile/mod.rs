//! Laser line profiles: peaks of the line in an image, and their conversion to millimetres by a
//! calibration. The module uses images and a calibration, never the scene.
//!
//! - `background`: noise statistics and detection threshold of a column.
//! - `find`, `flags`: detection of lines in a frame, and their flags.
//! - `peak_estimators`, `fit`: sub-pixel position of a line.
//! - `uncertainty`, `variances`, `defocus_noise`: standard uncertainty of the row, for sharp and blurred
//!   images.
//! - `truncation`, `horizon`: lines truncated by edges, in single columns and gradually over many columns.
//! - `clipping`: effect of saturation.
//! - `reflection_flags`: lines caused by indirect light.
//! - `filter`: profile filters that sensors apply before delivery.

mod adjust;
mod background;
mod calibration;
mod calibration_file;
mod clipping;
mod defocus_noise;
mod estimator_weights;
mod few_grains;
mod filter;
mod find;
mod fit;
mod flags;
mod horizon;
mod line;
mod median_variance;
mod neighbourhood;
mod peak;
mod peak_estimators;
mod reflection_flags;
mod slope;
mod truncation;
mod uncertainty;
mod variances;
mod widths;

pub use adjust::{Adjustment, Dot, LaserLineObservation, Observations, adjust};
pub use background::{FALSE_PEAKS_PER_FRAME, detection_sigmas, least_height};
pub use calibration::{Calibration, Covariance, PARAMETERS, Parameters, PointJacobian};
pub use clipping::max_usable_height;
pub use defocus_noise::DefocusNoise;
pub use filter::{
    DeliveredRow, Drift, Filters, FrameStep, GAUSSIAN_REACH, MeasuredRow, OUTLIER_COLUMNS,
    ProfileFilter, Smooth, sum_of_both_sides,
};
pub use find::{CANDIDATE_SHARE, MOST_LINES, find_lines, find_peaks};
pub use flags::{
    NARROW_RATIO, WEAK_SHARE, WEAK_SNR, WIDE_RATIO, compare_neighbours,
    update_flags_from_uncertainty,
};
pub use peak::{Flags, Peak, PeakFinder, PeakSelection, PeakSettings};
pub use slope::JUMP_SIGMAS;
pub use uncertainty::{
    HdrExposure, LARGEST_LIGHT_VARIANCE, LARGEST_SHAPE_VARIANCE, RowUncertainty, UncertaintyModel,
};
pub use variances::{SIGMAS_PX, SpeckleGrain};
