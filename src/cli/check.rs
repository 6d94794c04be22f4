use super::{ForceArguments, Output, STOP, SceneArguments, show};
use crate::run;
use crate::run::Control;

use crate::error::Result;
use crate::mesh::{self, MeshReport};
use crate::run::Checked;
use crate::scene::Scene;
use serde::Serialize;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    #[command(flatten)]
    scene: SceneArguments,
    /// Exit with code 65 if there are warnings
    #[arg(long)]
    strict: bool,
    /// Folder to write sensor.svg to: laser, camera and measuring range to scale, with the part
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    #[command(flatten)]
    force: ForceArguments,
}

#[derive(Serialize)]
struct Check<'a> {
    scene: &'a Scene,
    mesh: MeshReport,
    #[serde(flatten)]
    checked: Checked,
}

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    let scene = arguments.scene.load(output)?;
    let building = output.share("prepared");
    let control = Control {
        progress: &|_| {},
        building: Some(&|share| show(&building, share)),
        stop: &STOP,
    };
    let checked = run::check(&scene, &control)?;
    let check = Check {
        mesh: mesh::report(&scene.mesh),
        scene: &checked.scene.clone(),
        checked,
    };
    if let Some(out) = &arguments.output {
        run::draw_sensor(&check.checked, arguments.force.folder(out))?;
    }
    run::refuse(&check.checked.warnings, arguments.strict)?;
    output.result(&check, &run::check_text(&check.checked))
}
