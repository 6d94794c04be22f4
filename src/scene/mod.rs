//! The scene: what is written in the file, and what that means in internal units.

mod file;
mod locate;
mod optics;
mod resolve;

pub use file::{SceneFile, Unit, schema};
pub use resolve::{LinearScan, Scene, SpeckleModel};
