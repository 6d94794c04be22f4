use super::{CoverageArguments, ForceArguments, Output, STOP, SceneArguments, show};
use crate::run;
use crate::run::Control;
use clap::builder::{PossibleValuesParser, TypedValueParser};

use crate::error::Result;
use crate::error::printable::path;
use crate::inspect::bands::in_words;
use crate::report::chart::short;
use crate::report::formats::Format;
use crate::run::{OutputFolder, ScanOptions, ScanSummary, Shard};
use crate::scene::Scene;
use std::ops::Range;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    /// Take the frames I, I + N, … alone, into a folder that all N shards share; then merge. auto/N: I is
    /// the number that Slurm, Kubernetes or AWS Batch gives a job of an array
    #[arg(long, value_name = "I/N", value_parser = shard, conflicts_with_all = ["resume", "also"])]
    shard: Option<Shard>,
    #[command(flatten)]
    scan: Whole,
    /// Go on from an earlier run in this folder; the frames it finished are not taken again
    #[arg(long)]
    resume: bool,
}

/// What a scan and the merging of its shards have in common.
#[derive(clap::Args)]
pub struct Whole {
    #[command(flatten)]
    scene: SceneArguments,
    #[command(flatten)]
    coverage: CoverageArguments,
    /// Only the frames from A to B - 1
    #[arg(long, value_name = "A..B", value_parser = frames)]
    frames: Option<Range<u32>>,
    /// No images: profiles from laser rays and what the camera sees of them
    #[arg(long)]
    geometry_only: bool,
    /// Exit with code 65 if there are warnings, before the scan or of its result
    #[arg(long)]
    strict: bool,
    /// Also write cloud.csv, cloud.e57, cloud.pcd; intensity_dn is the sum of the line's counts above black in its
    /// column
    #[arg(long, value_name = "FORMAT", value_delimiter = ',', value_parser = formats())]
    also: Vec<Format>,
    /// Folder to write to
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    force: ForceArguments,
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

/// Numbers that engines give the jobs of an array.
const ARRAYS: [&str; 3] = [
    "SLURM_ARRAY_TASK_ID",
    "JOB_COMPLETION_INDEX",
    "AWS_BATCH_JOB_ARRAY_INDEX",
];

pub fn shard(text: &str) -> std::result::Result<Shard, String> {
    let expected = "expected I/N with I below N, as 3/8, or auto/N";
    let (shard, of) = text.split_once('/').ok_or(expected)?;
    let of = of.parse::<u32>().map_err(|_| expected)?;
    let shard = match shard {
        "auto" => of_the_array()?,
        number => number.parse::<u32>().map_err(|_| expected)?,
    };
    if shard >= of {
        return Err(format!("found shard {shard} of {of}, {expected}"));
    }
    Ok(Shard { shard, of })
}

/// The number of this job in its array.
fn of_the_array() -> std::result::Result<u32, String> {
    let set = ARRAYS.map(|name| Some((name, std::env::var(name).ok()?)));
    let set: Vec<(&str, String)> = set.into_iter().flatten().collect();
    let names = ARRAYS.join(", ");
    match &set[..] {
        [(name, value)] => value
            .parse()
            .map_err(|_| format!("found {name}={value}, expected a number from 0")),
        [] => Err(format!(
            "auto: found no number of an array's job, expected one of {names}"
        )),
        _ => {
            let found: Vec<&str> = set.iter().map(|(name, _)| *name).collect();
            Err(format!(
                "auto: found {}, expected one of {names}",
                found.join(" and ")
            ))
        }
    }
}

impl Arguments {
    pub fn is_shard(&self) -> bool {
        self.shard.is_some()
    }
}

pub fn run(arguments: Arguments, output: &Output) -> Result<()> {
    let Some(shard) = arguments.shard else {
        return (arguments.scan).whole(output, arguments.resume, |scene, options, out, control| {
            run::scan(scene, options, out, control)
        });
    };
    let scan = &arguments.scan;
    let done = scan.with(output, false, |scene, options, control| {
        run::scan_shard(scene, options, shard, scan.folder(), control)
    })?;
    let Shard { shard, of } = shard;
    let frames = match done.frames_taken {
        0 if done.frames > 0 => format!("{} frames were there", done.frames),
        taken => format!("{taken} frames"),
    };
    let text = format!(
        "job {}, shard {shard} of {of}: {frames}\nwhen all are there:  lasertrace merge {} -o {}",
        done.job,
        path(&scan.scene.scene),
        path(&scan.output)
    );
    output.result(&done, &text)
}

impl Whole {
    fn folder(&self) -> OutputFolder<'_> {
        self.force.folder(&self.output)
    }

    /// Calls `then` with what the arguments say.
    fn with<T>(
        &self,
        output: &Output,
        resume: bool,
        then: impl FnOnce(&Scene, &ScanOptions, &Control) -> Result<T>,
    ) -> Result<T> {
        let scene = self.scene.load(output)?;
        let options = ScanOptions {
            coverage: self.coverage.coverage(),
            frames: self.frames.clone(),
            resume,
            geometry_only: self.geometry_only,
            strict: self.strict,
            also: self.also.clone(),
        };
        let count = options
            .frames
            .as_ref()
            .map_or(scene.scan.frames as usize, |f| f.len());
        let bar = output.progress(count as u64, "frames");
        let building = output.share("prepared");
        let control = Control {
            progress: &|done| bar.set_position(done),
            building: Some(&|share| show(&building, share)),
            stop: &STOP,
        };
        let done = then(&scene, &options, &control);
        bar.finish_and_clear();
        done
    }

    /// Runs what gives a whole scan, and says what it gave.
    pub fn whole(
        &self,
        output: &Output,
        resume: bool,
        scan: impl FnOnce(&Scene, &ScanOptions, OutputFolder, &Control) -> Result<ScanSummary>,
    ) -> Result<()> {
        let summary = self.with(output, resume, |scene, options, control| {
            scan(scene, options, self.folder(), control)
        })?;
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
        let warnings = run::warning_lines(&summary.warnings);
        let mut text = format!(
            "{warnings}{deviation}\nopen the report:  {}\npoint cloud:      {}",
            path(&summary.report),
            path(&summary.cloud)
        );
        if !summary.tolerance.is_empty() {
            text += &format!("\ntolerance:        {}", in_words(&summary.tolerance));
        }
        if let Some(accuracy) = &summary.accuracy {
            text += &format!("\naccuracy:         {}", accuracy.statement);
        }
        for picture in &summary.pictures {
            text += &format!("\npicture:          {}", path(picture));
        }
        output.result(&summary, &text)
    }
}
