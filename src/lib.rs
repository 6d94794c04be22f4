//! lasertrace: from a CAD mesh and a description of a laser-triangulation sensor
//! to the images it would take and the points it would measure.
pub mod accel;
pub mod camera;
pub mod error;
pub mod laser;
pub mod math;
pub mod mesh;
pub mod scene;
pub mod surface;
