use super::{ForceArguments, Output, STOP, SceneArguments, show};
use crate::run;
use crate::run::RunControl;

use crate::error::Result;
use crate::mesh::{self, MeshReport};
use crate::run::CheckReport;
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
    /// Output folder for sensor.svg, a scale drawing of laser, camera, measuring range and part
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    #[command(flatten)]
    force: ForceArguments,
}

#[derive(Serialize)]
struct CheckOutput<'a> {
    scene: &'a Scene,
    mesh: MeshReport,
    #[serde(flatten)]
    checked: CheckReport,
}

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    let of_sensor = Scene::of_sensor(&arguments.scene.scene)?;
    let building = output.share("prepared");
    let control = RunControl {
        progress: &|_| {},
        setup_progress: Some(&|share| show(&building, share)),
        notice: None,
        stop: &STOP,
    };
    let is_sensor = of_sensor.is_some();
    let checked = match of_sensor {
        Some(scene) => run::check_sensor(arguments.scene.changed(scene), &control)?,
        None => run::check(&arguments.scene.load(output)?, &control)?,
    };
    let check = CheckOutput {
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
