//! The service from outside, over loopback: what it gives, what it survives, what it refuses.

#![cfg(all(feature = "service", target_os = "linux"))]

mod attacks;
mod client;
mod faults;
mod jobs;
mod load;
#[path = "../common/program.rs"]
mod program;
