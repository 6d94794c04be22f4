//! Tests of the repository: architecture, licences, public surface.

mod architecture;
mod licenses;
mod public_surface;
