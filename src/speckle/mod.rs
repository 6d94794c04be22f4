//! Subjective laser speckle.
//!
//! `pattern` makes one pattern. `frame_field` makes the field of each frame of a
//! scan and reads it. As the seed has it, `slices` makes a closed ring of
//! correlated patterns, `texture` stores them, `lookup` reads them at a
//! `coordinate`. `theory` has the closed forms. `motion` says where to read as
//! laser, part and camera move, `anchor` does so for a scan, `path`
//! for one that turns. `wave*` is the slow
//! wave-optics reference that all of it is measured against.

pub mod anchor;
pub mod column_covariance;
pub mod coordinate;
mod fixed;
pub mod frame_field;
pub mod lookup;
pub mod motion;
pub mod path;
pub mod pattern;
mod slice_statistics;
pub mod slices;
mod spectrum;
pub mod statistics;
pub mod strips;
mod texture;
pub mod theory;
pub mod wave;
pub mod wave_cases;
pub mod wave_centroid;
pub mod wave_correlation;
pub mod wave_grain;
pub mod wave_motion;
pub mod wave_patch;
pub mod wave_plot;
pub mod wave_spot;
