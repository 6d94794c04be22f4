use super::{Output, SceneArguments};
use crate::batch;
use crate::error::Result;
use crate::inspect::chart::short;
use crate::integrator::Plan;
use crate::mesh::{self, MeshReport};
use crate::scene::Scene;
use serde::Serialize;
use std::fmt::Write;

#[derive(clap::Args)]
pub struct Arguments {
    #[command(flatten)]
    scene: SceneArguments,
}

#[derive(Serialize)]
struct Check<'a> {
    scene: &'a Scene,
    mesh: MeshReport,
    plan: Plan,
}

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    let scene = arguments.scene.load(output)?;
    let check = Check {
        mesh: mesh::report(&scene.mesh),
        plan: batch::scene_plan(&scene)?,
        scene: &scene,
    };
    output.result(&check, &text(&check))
}

fn text(check: &Check) -> String {
    let resolved = serde_json::to_string_pretty(check.scene).expect("a scene is JSON");
    let mut text = format!("scene\n{resolved}\n\nmesh\n{}", check.mesh);
    if check.scene.copies.len() > 1 {
        let size = check.scene.bounds().size();
        let _ = write!(
            text,
            "\ncopies              {}, together in a box of {} × {} × {} mm",
            check.scene.copies.len(),
            short(size.x),
            short(size.y),
            short(size.z)
        );
    }
    text.push_str("\n\nplan\n");
    for effect in &check.plan.effects {
        let modelled = if effect.modelled {
            "modelled"
        } else {
            "left out"
        };
        let numbers = match (effect.influence_um, effect.cost_ms) {
            (None, None) => String::new(),
            (um, ms) => format!(
                " [{}{}]",
                um.map_or("moves heights by an unknown way".into(), |um| format!(
                    "moves heights by {} µm",
                    short(um)
                )),
                ms.map_or(String::new(), |ms| format!(", costs {} ms", short(ms)))
            ),
        };
        let _ = writeln!(
            text,
            "  {:<32} {modelled:<9} {}: {}{numbers}",
            effect.effect, effect.method, effect.why
        );
    }
    if let Some(accuracy) = &check.plan.accuracy {
        let _ = writeln!(
            text,
            "\naccuracy, tolerance {} µm: {}; {} ms a frame on one core",
            accuracy.tolerance_um,
            accuracy.statement,
            short(accuracy.cost_ms)
        );
    }
    if let (Some([x, y]), Some(distance)) = (
        check.plan.scheimpflug_tilt_deg,
        check.plan.laser_plane_distance_mm,
    ) {
        let _ = writeln!(
            text,
            "\nthe laser plane is in focus with camera.tilt_deg = [{x:.4}, {y:.4}] and \
             camera.focus_distance_mm = {distance:.3}"
        );
    }
    text
}
