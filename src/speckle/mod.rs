//! Speckle: how it moves, and the wave-optics reference it is measured against.
pub mod anchor;
pub mod motion;
pub mod wave;
pub mod wave_cases;
pub mod wave_centroid;
pub mod wave_correlation;
pub mod wave_motion;
pub mod wave_patch;
pub mod wave_plot;
