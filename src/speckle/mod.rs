//! Subjective laser speckle, read from precomputed patterns.

pub mod lookup;
pub mod pattern;
pub mod slices;
pub mod theory;
