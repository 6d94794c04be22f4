use super::{ForceArguments, Output, STOP};
use crate::error::Result;
use crate::error::printable::path;
use crate::run::{self, RunControl};
use crate::scene::Unit;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    /// Mesh file
    mesh: PathBuf,
    /// Rays (JSON): {"rays": [[x, y, z, dx, dy, dz], …]} in mm
    rays: PathBuf,
    /// Length unit of the mesh file, if the file does not state it
    #[arg(long, value_enum)]
    unit: Option<Unit>,
    /// Output folder
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    force: ForceArguments,
}

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    let control = RunControl {
        progress: &|_| {},
        setup_progress: None,
        notice: None,
        stop: &STOP,
    };
    let Arguments { mesh, rays, .. } = &arguments;
    let unit = arguments.unit.map(Unit::mm);
    let done = run::cast_rays(
        mesh,
        unit,
        rays,
        arguments.force.folder(&arguments.output),
        &control,
    )?;
    let (rays, hits) = (done.rays, done.hits);
    let text = format!("{hits} of {rays} rays met the mesh\n{}", path(&done.file));
    output.result(&done, &text)
}
