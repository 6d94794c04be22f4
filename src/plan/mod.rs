//! What a scene needs: which effects move its heights, by which method, at what cost.

pub mod accuracy;
mod chosen;
mod cost;
mod cutoff;
mod defocus;
pub mod height_error;
pub mod in_view;
pub mod rules;
pub mod words;

pub use chosen::Plan;
