use super::{CoverageArguments, ForceArguments, Output, STOP, SceneArguments, show};
use crate::run;
use crate::run::RunControl;
use clap::builder::{PossibleValuesParser, TypedValueParser};

use crate::error::Result;
use crate::error::printable::path;
use crate::inspect::tolerance::to_text;
use crate::report::chart::short;
use crate::run::{Export, OutputFolder, ScanOptions, ScanSummary, Shard};
use crate::scene::Scene;
use std::ops::Range;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    /// Scan only the frames I, I + N, …; all N shards share the output folder and are combined by
    /// `merge`. With auto/N, I is the array index set by Slurm, Kubernetes or AWS Batch
    #[arg(long, value_name = "I/N", value_parser = shard, conflicts_with_all = ["resume", "also"])]
    shard: Option<Shard>,
    #[command(flatten)]
    scan: ScanArguments,
    /// Continue an interrupted run in the output folder; finished frames are kept
    #[arg(long)]
    resume: bool,
}

/// Options common to a scan and the merging of its shards.
#[derive(clap::Args)]
pub struct ScanArguments {
    #[command(flatten)]
    scene: SceneArguments,
    #[command(flatten)]
    coverage: CoverageArguments,
    /// Scan only the frames from A to B - 1
    #[arg(long, value_name = "A..B", value_parser = frames)]
    frames: Option<Range<u32>>,
    /// Compute profiles from laser rays and camera visibility, without images
    #[arg(long)]
    geometry_only: bool,
    /// Exit with code 65 if there are warnings about the scene or the result
    #[arg(long)]
    strict: bool,
    /// Also write cloud.csv, cloud.e57 or cloud.pcd; intensity_dn is the sum of the line's counts
    /// above the black level in its column. heightmap writes 16-bit images of height, position and
    /// intensity, and heightmap.json with their scales and offsets
    #[arg(long, value_name = "FORMAT", value_delimiter = ',', value_parser = formats())]
    also: Vec<Export>,
    /// Output folder
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    force: ForceArguments,
}

/// Parses the name of a further output.
fn formats() -> impl TypedValueParser<Value = Export> {
    let form = |word: String| Export::ALL.into_iter().find(|export| export.name() == word);
    PossibleValuesParser::new(Export::ALL.map(Export::name))
        .map(move |word| form(word).expect("it is a possible value"))
}

fn frames(text: &str) -> std::result::Result<Range<u32>, String> {
    let number = |text: &str| text.parse::<u32>().ok();
    text.split_once("..")
        .and_then(|(a, b)| Some(number(a)?..number(b)?))
        .ok_or_else(|| "expected two frame numbers as in 10..20".to_owned())
}

/// Environment variables with the array index of a job.
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
        "auto" => array_task_index()?,
        number => number.parse::<u32>().map_err(|_| expected)?,
    };
    if shard >= of {
        return Err(format!("found shard {shard} of {of}, {expected}"));
    }
    Ok(Shard { shard, of })
}

/// Returns the array index of this job.
fn array_task_index() -> std::result::Result<u32, String> {
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
        return (arguments.scan).run_full_scan(
            output,
            arguments.resume,
            |scene, options, out, control| run::scan(scene, options, out, control),
        );
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
        "job {}, shard {shard} of {of}: {frames}\nafter the last shard:  lasertrace merge {} -o {}{}",
        done.job,
        path(&scan.scene.scene),
        path(&scan.output),
        scan.job_options()
    );
    output.result(&done, &text)
}

impl ScanArguments {
    /// Returns the options that select the frames and their methods, as arguments of a command.
    fn job_options(&self) -> String {
        let mut text = self.scene.options();
        if let Some(Range { start, end }) = self.frames {
            text += &format!(" --frames {start}..{end}");
        }
        if self.geometry_only {
            text += " --geometry-only";
        }
        if self.coverage.exhaustive {
            text += " --exhaustive";
        }
        text
    }

    fn folder(&self) -> OutputFolder<'_> {
        self.force.folder(&self.output)
    }

    /// Calls `then` with the scene and the options given by the arguments.
    fn with<T>(
        &self,
        output: &Output,
        resume: bool,
        then: impl FnOnce(&Scene, &ScanOptions, &RunControl) -> Result<T>,
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
        let count = count * scene.cameras.len().max(1);
        let bar = output.progress(count as u64, "frames");
        let building = output.share("prepared");
        let control = RunControl {
            progress: &|done| bar.set_position(done),
            setup_progress: Some(&|share| show(&building, share)),
            notice: Some(&|text| output.say(text)),
            stop: &STOP,
        };
        let done = then(&scene, &options, &control);
        bar.finish_and_clear();
        done
    }

    /// Runs a complete scan and prints its summary.
    pub fn run_full_scan(
        &self,
        output: &Output,
        resume: bool,
        scan: impl FnOnce(&Scene, &ScanOptions, OutputFolder, &RunControl) -> Result<ScanSummary>,
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
            text += &format!("\ntolerance:        {}", to_text(&summary.tolerance));
        }
        if !summary.features.is_empty() {
            text += &format!("\n{}", run::features_text(&summary.features).trim_end());
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
