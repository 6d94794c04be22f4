//! Live view: a scene in the browser whose image is updated while values change.
//!
//! The page requests a draft for the newest values, and the next draft when that one is displayed.
//! Requests of one page therefore do not queue. Once the values are unchanged for a while, the page
//! requests the image that `render` produces.

mod refused;
mod session;
mod values;
mod web;

pub use refused::ViewError;
pub use session::{CheckPage, Picture, Session};
pub use values::{Files, SliderValues};
pub use web::{Listener, serve};
