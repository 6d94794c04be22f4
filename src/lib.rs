//! lasertrace: from a CAD mesh and a description of a laser-triangulation sensor
//! to the images it would take and the 3D points it would measure.
//!
//! ```
//! use lasertrace::{Scene, Simulation};
//!
//! let text = include_str!("../scenes/plane/scene.toml"); // or any other TOML
//! let scene = Scene::parse(text, "folder-of-its-files".as_ref())?;
//! let simulation = Simulation::new(&scene)?; // owns what it needs: share it among threads
//! let image = simulation.image(0); // what the sensor takes in frame 0
//! let counts: &[u16] = image.by_column();
//! let (_, profile) = simulation.measure(0, &image); // its points on the part
//! assert_eq!((counts.len(), profile.len()), (640 * 300, 640));
//! for point in &profile {
//!     // mm in the part's frame; deviation from the CAD, and how sure it is
//!     println!("{} {} {}", point.position, point.deviation, point.deviation_sigma);
//! }
//! # Ok::<(), lasertrace::Error>(())
//! ```
//!
//! ```text
//! sensor, part, path → Scene → plan → [ one frame ] → cloud → deviation, uncertainty → report
//! one frame: footprint → rays → light → blur → speckle × pixels → counts → peaks → points
//! ```
//!
//! Lengths are millimetres, angles radians, irradiance mW/mm²; a quantity in
//! another unit carries it in its name. Frames are right-handed, and transforms
//! are named `to_from_from` (`world_from_head`):
//!
//! ```text
//! world   the scene's own
//! part    the CAD mesh's; rays are traced in it
//! head    carries laser and camera; moves through the world
//! laser   z along the beam, x along the line, y across the sheet
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

// A library does not speak, and does not end the program; every public item says what it is.
#![warn(
    clippy::dbg_macro,
    clippy::exit,
    clippy::print_stderr,
    clippy::print_stdout,
    missing_docs
)]

// The rooms are open to this project's program, tests and benches, and may change with any
// version. What is documented, and stays, is what stands below them; docs/public-surface.txt
// lists it.
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

// Rays against triangles.
pub use accel::{Accel, Backend, Ray, SurfacePoint};
pub use mesh::Mesh;
// A scene, and a sensor's frames of it.
pub use camera::{Camera, Counts, Lens, Sensor};
pub use frame::Truth;
pub use inspect::cloud::CloudPoint;
pub use laser::{Beam, Laser};
pub use profile::{Flags, Peak};
pub use run::Simulation;
pub use scene::{ScanPath, Scene};
// What both speak in.
pub use error::{Error, InputError, Place, Result};
pub use math::{Aabb, Rigid};
#[doc(no_inline)]
pub use math::{DMat3, DVec2, DVec3};

/// README.md's example is compiled and run.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
