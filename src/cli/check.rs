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
    let of_sensor = Scene::of_sensor(&arguments.scene.scene)?;
    let building = output.share("prepared");
    let control = Control {
        progress: &|_| {},
        building: Some(&|share| show(&building, share)),
        stop: &STOP,
    };
    let is_sensor = of_sensor.is_some();
    let checked = match of_sensor {
        Some(scene) => run::check_sensor(arguments.scene.changed(scene), &control)?,
        None => run::check(&arguments.scene.load(output)?, &control)?,
    };
    let check = Check {
        mesh: mesh::report(&checked.scene.mesh),
        scene: &checked.scene.clone(),
        checked,
    };
    if let Some(out) = &arguments.output {
        run::draw_sensor(&check.checked, arguments.force.folder(out))?;
    }
    run::refuse(&check.checked.warnings, arguments.strict)?;
    let text = match is_sensor {
        true => run::sensor_text(&check.checked),
        false => run::check_text(&check.checked),
    };
    output.result(&check, &text)
}
