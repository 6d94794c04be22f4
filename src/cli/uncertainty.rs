use super::{ForceArguments, Output, STOP, SceneArguments};
use crate::run::RunControl;
use crate::scene::Scene;
use crate::study;

use crate::error::printable::path;
use crate::error::{Error, Result};
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    #[command(flatten)]
    scene: SceneArguments,
    /// Frame of the scan, starting at 0
    #[arg(long, value_name = "K", default_value_t = 0, conflicts_with = "range")]
    frame: u32,
    /// Number of seeds of speckle and noise (with --static: number of images), 2 or more, starting
    /// at the seed of the scene
    #[arg(long, value_name = "N", default_value_t = 64, conflicts_with = "range", value_parser = clap::value_parser!(u64).range(2..100_000))]
    seeds: u64,
    /// Keep the speckle fixed and vary only the noise (repeatability)
    #[arg(long = "static", conflicts_with = "range")]
    fixed: bool,
    /// Measure data-sheet figures with a plane that moves through the measuring range; always set
    /// for a sensor file
    #[arg(long)]
    range: bool,
    /// Compare the stated uncertainty of each feature of the scene with the scatter over complete
    /// scans
    #[arg(long, conflicts_with_all = ["range", "fixed", "frame"])]
    features: bool,
    /// Output folder
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    force: ForceArguments,
}

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    let file = &arguments.scene.scene;
    match Scene::of_sensor(file)? {
        Some(scene) if !arguments.fixed && !arguments.features => {
            let scene = arguments.scene.changed(scene)?;
            let text =
                "The file describes a sensor: the target is a diffuse plane of reflectance 0.5.\n";
            over_range(scene, &arguments, text, output)
        }
        Some(_) if arguments.features => Err(Error::Usage(format!(
            "--features with the sensor {}: expected a scene with [[feature]]",
            file.display()
        ))),
        Some(_) => Err(Error::Usage(format!(
            "--static with the sensor {}: expected a scene, whose frame is repeated; \
             omit --static, because repeatability over the range is part of the result",
            file.display()
        ))),
        None if arguments.range => {
            let scene = arguments.scene.load(output)?;
            over_range(scene, &arguments, "", output)
        }
        None if arguments.features => of_features(&arguments, output),
        None => of_frame(&arguments, output),
    }
}

fn of_frame(arguments: &Arguments, output: &Output) -> Result<()> {
    let scene = arguments.scene.load(output)?;
    let bar = output.progress(arguments.seeds, "seeds");
    let control = RunControl {
        progress: &|done| bar.set_position(done),
        setup_progress: None,
        notice: None,
        stop: &STOP,
    };
    let (frame, seeds) = (arguments.frame, arguments.seeds);
    let out = arguments.force.folder(&arguments.output);
    let summary = match arguments.fixed {
        true => study::repeatability(scene, frame, seeds, out, &control),
        false => study::monte_carlo(scene, frame, seeds, out, &control),
    };
    bar.finish_and_clear();
    let summary = summary?;
    let [first, second] = summary.headline();
    let text = format!("{first}\n{second}\n{}\n", path(&summary.picture));
    output.result(&summary, &text)
}

fn of_features(arguments: &Arguments, output: &Output) -> Result<()> {
    let scene = arguments.scene.load(output)?;
    let bar = output.progress(arguments.seeds, "seeds");
    let control = RunControl {
        progress: &|done| bar.set_position(done),
        setup_progress: None,
        notice: None,
        stop: &STOP,
    };
    let out = arguments.force.folder(&arguments.output);
    let summary = study::feature_monte_carlo(scene, arguments.seeds, out, &control);
    bar.finish_and_clear();
    let summary = summary?;
    let text = format!("{}{}\n", summary.text(), path(&summary.table));
    output.result(&summary, &text)
}

fn over_range(scene: Scene, arguments: &Arguments, target: &str, output: &Output) -> Result<()> {
    let bar = output.progress(study::SHEET_STEPS, "images");
    let control = RunControl {
        progress: &|done| bar.set_position(done),
        setup_progress: None,
        notice: None,
        stop: &STOP,
    };
    let summary = study::sheet(scene, arguments.force.folder(&arguments.output), &control);
    bar.finish_and_clear();
    let summary = summary?;
    let [first, second] = summary.headline();
    let table = summary.table();
    let picture = path(&summary.picture);
    let [columns, profiles] = study::MEAN_OF;
    let text = format!(
        "{first}\n{second}\n{target}\n{table}\n\
         distance: from the laser, mm. Other columns except n_c: µm, measured and then stated for each point.\n\
         x / px, z / px: size of a pixel. repeat: static repetition. place: over positions, with speckle;\n\
         closed: 0.3905·√(hσ)·C and noise. n_c: correlated columns. of {columns}: mean over {columns} columns.\n\
         of {profiles}: mean over {profiles} profiles. linear: indicated minus true height ± 2 standard uncertainties.\n\
         edge: 10 to 90 % of a low step along the line.\n{picture}\n"
    );
    output.result(&summary, &text)
}
