//! Slow wave-optics reference for speckle: sums over exact paths.

pub mod cases;
pub mod centroid;
pub mod correlation;
pub mod defocus;
pub mod grain;
pub mod image;
pub mod line_statistics;
pub mod motion;
pub mod patch;
pub mod spot;
