//! Subjective laser speckle, read from precomputed patterns.
//!
//! `pattern` makes one pattern, `slices` a closed ring of correlated ones,
//! `texture` stores them, `lookup` reads them at a `coordinate`; `theory` has
//! the closed forms and `statistics` holds the patterns against them.

pub mod coordinate;
mod fixed;
pub mod lookup;
pub mod pattern;
mod slice_statistics;
pub mod slices;
mod spectrum;
pub mod statistics;
mod texture;
pub mod theory;
