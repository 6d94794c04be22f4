//! The live view: a scene in the browser, its picture made anew while values are dragged.
//!
//! A page asks for a draft of the newest values, and for the next when it has drawn that one: no request waits for
//! another of the same page. Once the values rest it asks for the picture that `render` makes.

mod refused;
mod session;
mod values;
mod web;

pub use refused::Refused;
pub use session::{CheckPage, Picture, Session};
pub use values::{Files, Values};
pub use web::{Listener, serve};
