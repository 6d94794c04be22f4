//! Model configuration of a scene: the effects that change its heights, and their methods.

pub mod accuracy;
mod config;
mod cutoff;
mod defocus;
pub mod display;
pub mod height_error;
pub mod ladder;
pub mod rules;
pub mod visible_line;

pub use config::ModelConfig;
