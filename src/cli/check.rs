use super::{Output, STOP, SceneArguments, show};
use crate::batch::{self, Control, Forecast};
use crate::error::Result;
use crate::inspect::chart::short;
use crate::integrator::Plan;
use crate::mesh::{self, MeshReport};
use crate::scene::Scene;
use indicatif::{DecimalBytes, HumanDuration};
use serde::Serialize;
use std::fmt::Write;
use std::time::Duration;

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
    /// Of the whole scan.
    forecast: Forecast,
}

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    let scene = arguments.scene.load(output)?;
    let building = output.share("of the hierarchy built");
    let control = Control {
        progress: &|_| {},
        building: Some(&|share| show(&building, share)),
        stop: &STOP,
    };
    let check = Check {
        mesh: mesh::report(&scene.mesh),
        plan: batch::scene_plan(&scene)?,
        forecast: batch::forecast(&scene, &control)?,
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
    text + &whole_scan(&check.forecast)
}

/// What the whole scan takes.
fn whole_scan(forecast: &Forecast) -> String {
    let bytes = |bytes: u64| DecimalBytes(bytes).to_string();
    let free = match forecast.memory_available_bytes {
        Some(available) if forecast.fits() => format!(" ({} are free)", bytes(available)),
        Some(available) => format!(": MORE THAN THE {} THAT ARE FREE", bytes(available)),
        None => String::new(),
    };
    let time =
        HumanDuration(Duration::try_from_secs_f64(forecast.seconds).unwrap_or(Duration::MAX));
    format!(
        "\n\nthe whole scan, about\n  frames              {}\n  memory              {}{free}\n  \
         disk                {}\n  time                {time} with threads: {}",
        forecast.frames,
        bytes(forecast.memory_bytes),
        bytes(forecast.disk_bytes),
        forecast.threads
    )
}
