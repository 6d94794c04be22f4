//! Model configuration of a scene: the effects that change its heights, their methods and their
//! costs.

pub mod accuracy;
mod config;
mod cost;
mod cutoff;
mod defocus;
pub mod display;
pub mod height_error;
pub mod rules;
pub mod visible_line;

pub use config::ModelConfig;
