//! Subjective laser speckle.
//!
//! `pattern` makes one pattern. `frame_field` makes the field of each frame of a
//! scan and reads it. As the seed has it, `slices` makes a closed ring of
//! correlated patterns, `texture` stores them, `lookup` reads them at a
//! `coordinate`. `theory` has the closed forms. `motion` says where to read as
//! laser, part and camera move, `anchor` does so for a scan, `path`
//! for one that turns.
//! [`crate::wave`] is the slow reference that all of it is measured against.

pub mod anchor;
pub mod column_covariance;
pub mod coordinate;
mod estimate;
mod fixed;
pub mod frame_field;
pub mod imaged_line;
pub mod lookup;
mod method;
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
