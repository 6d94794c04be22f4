//! Tests of simulated images.

#[path = "../common/cameras.rs"]
mod cameras;
#[path = "../common/effort.rs"]
mod effort;
#[path = "../common/program.rs"]
mod program;
#[path = "../common/random.rs"]
mod random;
#[path = "../common/rendered.rs"]
mod rendered;
#[path = "../common/tilted.rs"]
mod tilted;

mod corner;
mod dark;
mod footprint;
mod geometric;
mod grain;
mod hologram;
mod image;
mod laser;
mod lens;
mod lens_waves;
mod limits_optics;
mod metal;
mod patterns;
mod pixel_contrast;
mod plan;
mod sampling;
mod speckle;
mod speckle_motion;
mod speckle_scan;
mod step;
mod telecentric;
mod tolerance;
