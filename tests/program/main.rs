//! Tests of the program from outside.

#[path = "../common/effort.rs"]
mod effort;
#[path = "../common/generated.rs"]
mod generated;
#[path = "../common/mistakes.rs"]
mod mistakes;
#[path = "../common/program.rs"]
mod program;
#[path = "../common/random.rs"]
mod random;

mod accept;
mod begin;
mod cli;
mod dataset;
mod hostile_input;
mod hostile_sensors;
mod interrupted_build;
mod interruption;
mod limits_input;
mod limits_running;
mod limits_scenes;
mod messages;
mod one_pose;
mod output_folder;
mod race_interruption;
mod real_parts;
mod resume;
mod scan_paths;
mod scene_file;
mod sensors;
mod shards;
mod sweep;
#[cfg(feature = "service")]
mod view;
mod warnings;
