//! The slow wave-optics reference that speckle is measured against: sums of exact paths.

pub mod cases;
pub mod centroid;
pub mod correlation;
pub mod grain;
pub mod image;
pub mod motion;
pub mod patch;
pub mod spot;
