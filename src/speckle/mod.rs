//! Subjective laser speckle.
//!
//! `pattern` generates one pattern. `frame_field` generates and reads the field of each frame of a
//! scan. Following Bergmann et al. (2016), `slices` generates a closed ring of correlated patterns,
//! `texture` stores them, and `lookup` reads them at a `coordinate`. `theory` contains the closed
//! forms. `motion` computes the shift of the speckle when laser, part and camera move. `anchor`
//! computes the pattern coordinate of a scan, and `path` does so for a scan that rotates.
//! [`crate::wave`] is the slow reference for all of them.

pub mod anchor;
pub mod column_covariance;
pub mod coordinate;
mod estimate;
mod fft2;
mod fixed_point;
pub mod frame_field;
pub mod imaged_line;
pub mod lookup;
mod method;
pub mod motion;
pub mod path;
pub mod pattern;
mod slice_statistics;
pub mod slices;
pub mod statistics;
pub mod strips;
mod texture;
pub mod theory;
