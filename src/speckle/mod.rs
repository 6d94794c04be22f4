//! Speckle: how it moves, and the wave-optics reference it is measured against.
pub mod anchor;
pub mod motion;
