//! Model configuration of a scene: the effects that change its heights, their methods and their
//! costs.

pub mod accuracy;
mod chosen;
mod cost;
mod cutoff;
mod defocus;
pub mod height_error;
pub mod in_view;
pub mod rules;
pub mod words;

pub use chosen::ModelConfig;
