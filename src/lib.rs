//! lasertrace: from a CAD mesh and a description of a laser-triangulation sensor
//! to the images it would take and the points it would measure.
pub mod error;
pub mod math;
pub mod speckle;
