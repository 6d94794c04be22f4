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
    checked: &'a CheckReport,
}

impl CheckOutput<'_> {
    fn of(checked: &CheckReport) -> CheckOutput<'_> {
        CheckOutput {
            scene: &checked.scene,
            mesh: mesh::report(&checked.scene.mesh),
            checked,
        }
    }
}

/// Output for a scene of several cameras.
#[derive(Serialize)]
struct CameraChecks<'a> {
    cameras: Vec<CheckOutput<'a>>,
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
    let scene = match of_sensor {
        Some(scene) => arguments.scene.changed(scene)?,
        None => arguments.scene.load(output)?,
    };
    let scenes = scene.each_camera();
    let mut checks = Vec::new();
    for scene in scenes {
        let checked = match is_sensor {
            true => run::check_sensor(scene.clone(), &control)?,
            false => run::check(scene, &control)?,
        };
        if let Some(out) = &arguments.output {
            let of_camera = out.join(format!("camera-{}", scene.camera_number));
            let out = if scenes.len() > 1 { &of_camera } else { out };
            run::draw_sensor(&checked, arguments.force.folder(out))?;
        }
        checks.push(checked);
    }
    for checked in &checks {
        run::refuse(&checked.warnings, arguments.strict)?;
    }
    let text = |checked: &CheckReport| match is_sensor {
        true => run::sensor_text(checked),
        false => run::check_text(checked),
    };
    if let [checked] = &checks[..] {
        return output.result(&CheckOutput::of(checked), &text(checked));
    }
    let texts = checks
        .iter()
        .map(|checked| format!("Camera {}\n{}", checked.scene.camera_number, text(checked)));
    let texts: Vec<String> = texts.collect();
    let cameras = checks.iter().map(CheckOutput::of).collect();
    output.result(&CameraChecks { cameras }, &texts.join("\n"))
}
