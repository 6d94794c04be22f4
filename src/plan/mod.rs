//! What a scene needs: which effects move its heights, by which method, at what cost.

pub mod accuracy;
mod chosen;
mod cost;
mod cutoff;
mod defocus;
mod grain_extent;
pub mod height_error;
pub mod in_view;
pub mod rules;
pub mod words;

pub use chosen::Plan;
pub use grain_extent::GrainExtent;
