//! The scene: structure of the file, and its validated form in internal units.

mod accept;
mod accept_table;
mod ambient;
mod ambient_table;
mod arrays;
mod camera_geometry;
mod data_sheet;
mod feature_table;
mod features;
mod field_of_view;
mod file;
mod inspect_table;
mod keys;
mod line_profile;
mod measure;
mod model_table;
mod object_table;
mod objects;
mod old_keys;
mod opencv;
mod opencv_table;
mod optics;
mod part;
mod path;
mod poses;
mod printed;
mod resolve;
mod resolver;
mod surface;
mod surface_table;
mod systematic;
mod systematic_table;
mod toml_source;
mod unit;
mod values;
mod warnings;
mod warnings_table;

pub use accept_table::{AcceptTable, LimitsTable};
pub use ambient::Ambient;
pub use data_sheet::{Origin, SheetEstimate, SolvedSensor, SolvedValue};
pub use field_of_view::FieldOfView;
pub(crate) use file::SensorFile;
pub use file::{ModelTable, MovingBody, SceneFile, schema, sensor_schema};
pub use path::{PathMotion, ScanPath};
pub use poses::parse as parse_poses;
pub use resolve::{Measure, Nominal, Scene, SpeckleModel};
pub use systematic::{ErrorCorrelation, ErrorEffect, Systematic, SystematicError};
pub(crate) use toml_source::{FileKind, backslash_hint, file_kind};
pub use unit::Unit;
#[cfg(feature = "service")]
pub(crate) use values::at as value_at;
pub(crate) use values::change_files;
#[doc(hidden)]
pub use values::set as set_value;
pub use warnings_table::WarningsTable;
