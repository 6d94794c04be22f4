//! Subjective laser speckle: precomputed patterns, where to read them as laser,
//! part and camera move, and the wave-optics reference both are measured against.

pub mod anchor;
pub mod lookup;
pub mod motion;
pub mod pattern;
pub mod slices;
pub mod theory;
pub mod wave;
pub mod wave_cases;
pub mod wave_centroid;
pub mod wave_correlation;
pub mod wave_motion;
pub mod wave_patch;
pub mod wave_plot;
