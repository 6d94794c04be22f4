//! lasertrace simulates laser-triangulation sensors. From a CAD mesh and a sensor description it
//! computes the sensor images and the measured 3D points.
//!
//! ```
//! use lasertrace::{Scene, Simulation};
//!
//! let text = include_str!("../scenes/plane/scene.toml"); // or any other TOML
//! let scene = Scene::parse(text, "folder-of-its-files".as_ref())?;
//! let simulation = Simulation::new(&scene)?; // owns its data and can be shared among threads
//! let image = simulation.image(0); // sensor image of frame 0
//! let counts: &[u16] = image.by_column();
//! let (_, profile) = simulation.measure(0, &image); // measured points on the part
//! assert_eq!((counts.len(), profile.len()), (640 * 300, 640));
//! for point in &profile {
//!     // mm in the part frame; deviation from the CAD and its standard uncertainty
//!     println!("{} {} {}", point.position, point.deviation, point.u_deviation);
//! }
//! # Ok::<(), lasertrace::Error>(())
//! ```
//!
//! ```text
//! sensor, part, path → Scene → plan → [ one frame ] → cloud → deviation, uncertainty → report
//! one frame: footprint → rays → light → blur → speckle × pixels → counts → peaks → points
//! ```
//!
//! Lengths are in millimetres, angles in radians and irradiance in mW/mm². A quantity in a
//! different unit has the unit in its name. Frames are right-handed, and transforms are named
//! `to_from_from` (`world_from_head`):
//!
//! ```text
//! world   frame of the scene
//! part    frame of the CAD mesh; rays are traced in it
//! head    carries laser and camera; moves through the world
//! laser   z along the beam, x along the line, y perpendicular to the laser plane
//! camera  z along the optical axis, x to higher columns, y to higher rows
//! image   (column, row); pixel (i, j) covers [i, i+1] × [j, j+1]
//!
//!          laser                   camera
//!            ┌─┐ aperture           ╱╲
//!            └┬┘──→ x (line)       ╱  ╲ pupil
//!             │                    ╲ ╱──→ x (columns)
//!             │ z (beam)           ↙
//!             ↓                 z (axis)
//!      ───────┴────── surface ────────────
//! ```

// The library does not print and does not end the process. Every public item is documented.
#![warn(
    clippy::dbg_macro,
    clippy::exit,
    clippy::print_stderr,
    clippy::print_stdout,
    missing_docs
)]

// These modules are public for the program, tests and benches of this project and may change with
// any version. The documented, stable interface is the list of re-exports below; see
// docs/public-surface.txt.
#[doc(hidden)]
pub mod accel;
#[doc(hidden)]
pub mod camera;
#[cfg(feature = "cli")]
#[doc(hidden)]
pub mod cli;
#[doc(hidden)]
pub mod error;
#[doc(hidden)]
pub mod frame;
#[doc(hidden)]
pub mod inspect;
#[doc(hidden)]
pub mod laser;
#[doc(hidden)]
pub mod math;
#[doc(hidden)]
pub mod mesh;
#[doc(hidden)]
pub mod plan;
#[doc(hidden)]
pub mod profile;
#[cfg(feature = "race")]
#[doc(hidden)]
pub mod race;
#[doc(hidden)]
pub mod report;
#[doc(hidden)]
pub mod run;
#[doc(hidden)]
pub mod scene;
#[cfg(feature = "service")]
#[doc(hidden)]
pub mod service;
#[doc(hidden)]
pub mod speckle;
#[doc(hidden)]
pub mod study;
#[doc(hidden)]
pub mod surface;
#[cfg(feature = "service")]
#[doc(hidden)]
pub mod view;
#[doc(hidden)]
pub mod wave;

// Ray casting against triangles.
pub use accel::{Accel, AllHits, Backend, Ray, SurfacePoint};
pub use mesh::Mesh;
// Scenes and their simulated frames.
pub use camera::{Camera, Counts, Lens, Sensor};
pub use frame::Truth;
pub use inspect::cloud::CloudPoint;
pub use laser::{Beam, Laser};
pub use profile::{Flags, Peak};
pub use run::Simulation;
pub use scene::{ScanPath, Scene};
// Types common to both.
pub use error::{Error, InputError, Place, Result};
pub use math::{Aabb, Rigid};
#[doc(no_inline)]
pub use math::{DMat3, DVec2, DVec3};

/// The example of README.md is compiled and run.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
