use super::{CoverageArguments, Output, STOP, SceneArguments, show, warning_lines};
use crate::run;
use crate::run::Control;
use clap::builder::{PossibleValuesParser, TypedValueParser};

use crate::error::Result;
use crate::error::printable::path;
use crate::report::chart::short;
use crate::report::formats::Format;
use crate::run::ScanOptions;
use std::ops::Range;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    #[command(flatten)]
    scene: SceneArguments,
    #[command(flatten)]
    coverage: CoverageArguments,
    /// Only the frames from A to B - 1
    #[arg(long, value_name = "A..B", value_parser = frames)]
    frames: Option<Range<u32>>,
    /// Go on from an earlier run in this folder; the frames it finished are not taken again
    #[arg(long)]
    resume: bool,
    /// No images: profiles from laser rays and what the camera sees of them
    #[arg(long)]
    geometry_only: bool,
    /// Exit with code 65 if there are warnings, before the scan or of its result
    #[arg(long)]
    strict: bool,
    /// Also write cloud.csv, cloud.e57, profiles.npy; intensity_dn is the sum of the line's
    /// counts above black in its column
    #[arg(long, value_name = "FORMAT", value_delimiter = ',', value_parser = formats())]
    also: Vec<Format>,
    /// Folder to write to
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
}

/// The form of the cloud that a file's ending names.
fn formats() -> impl TypedValueParser<Value = Format> {
    let form = |word: String| {
        Format::ALL
            .into_iter()
            .find(|format| format.ending() == word)
    };
    PossibleValuesParser::new(Format::ALL.map(Format::ending))
        .map(move |word| form(word).expect("it is a possible value"))
}

fn frames(text: &str) -> std::result::Result<Range<u32>, String> {
    let number = |text: &str| text.parse::<u32>().ok();
    text.split_once("..")
        .and_then(|(a, b)| Some(number(a)?..number(b)?))
        .ok_or_else(|| "expected two frame numbers as in 10..20".to_owned())
}

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    let scene = arguments.scene.load(output)?;
    let options = ScanOptions {
        coverage: arguments.coverage.coverage(),
        frames: arguments.frames,
        resume: arguments.resume,
        geometry_only: arguments.geometry_only,
        strict: arguments.strict,
        also: arguments.also,
    };
    let count = options
        .frames
        .as_ref()
        .map_or(scene.scan.frames as usize, |f| f.len());
    let bar = output.progress(count as u64, "frames");
    let building = output.share("of the hierarchy built");
    let control = Control {
        progress: &|done| bar.set_position(done),
        building: Some(&|share| show(&building, share)),
        stop: &STOP,
    };
    let summary = run::scan(&scene, &options, &arguments.output, &control);
    bar.finish_and_clear();
    let summary = summary?;
    let deviation = match &summary.deviation {
        Some(d) => format!(
            "{} of {} points are valid; their deviation from the CAD: mean {} µm, standard \
             deviation {} µm",
            d.points,
            summary.points,
            short(d.mean_um),
            short(d.std_um)
        ),
        None => format!("{} points, none of them valid", summary.points),
    };
    let warnings = warning_lines(&summary.warnings);
    let mut text = format!(
        "{warnings}{deviation}\nopen the report:  {}\npoint cloud:      {}",
        path(&summary.report),
        path(&summary.cloud)
    );
    if let Some(accuracy) = &summary.accuracy {
        text += &format!("\naccuracy:         {}", accuracy.statement);
    }
    for picture in &summary.pictures {
        text += &format!("\npicture:          {}", path(picture));
    }
    output.result(&summary, &text)
}
