//! Sweeps: a scene is scanned with different values in many runs, and the results form one table.
//!
//! Finished runs are in `places/*.journal`. Each invocation writes one file with the records of the
//! runs that it finishes. An invocation reads all files and executes only the remaining runs. It
//! therefore continues after a kill. Shards may be executed repeatedly, concurrently, with another
//! division, or not at all. An invocation that finds all runs finished writes the table. The bytes
//! of the table depend only on the sweep and the scene.

mod figures;
mod places;
mod record;
mod table;

use super::journal::{Journal, Records, checksum};
use super::output_folder::{Names, OutputFolder, remove_unfinished};
use super::recipe::Values;
use super::scan::scan_summary;
use super::setup;
use super::shards::{Shard, attempt, ranges, runs};
use super::simulation::Simulation;
use super::warning_kind::Warning;
use super::{RunControl, TraceMode, check_frames, files, memory_estimate};
use crate::error::input_file::{self, LARGEST_TEXT};
use crate::error::{Error, InputError, Place, Result, printable};
use crate::scene::Scene;
use figures::{Figures, figures};
use places::{SweepRuns, of_part};
use rayon::prelude::*;
use record::{RunOutcome, RunRecord};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use toml::Value;

pub use table::Plot;

/// Header of a journal.
#[derive(Serialize, Deserialize)]
struct Header {
    job: String,
    #[serde(flatten)]
    shard: Shard,
}

/// Summary of an invocation of `sweep`.
#[derive(Debug, Serialize)]
pub struct SweepSummary {
    /// Hash of sweep, scene, the files they name, version and numerics. All shards have one value.
    pub job: String,
    /// Number of runs of the sweep.
    pub places: u64,
    /// Number of runs that this invocation scanned.
    pub places_taken: u64,
    /// Number of runs that are not finished yet.
    pub missing: u64,
    /// Number of finished runs whose values the scene cannot have.
    pub refused: u64,
    /// Path of `sweep.csv`, if all runs are finished.
    #[serde(serialize_with = "printable::some_in_json")]
    pub table: Option<PathBuf>,
    /// Path of `sweep.svg`, if all runs are finished.
    #[serde(serialize_with = "printable::some_in_json")]
    pub plots: Option<PathBuf>,
}

struct Sweep {
    places: SweepRuns,
    scene: Scene,
    /// Parsed TOML of the scene.
    text: Value,
    job: String,
}

/// Scans the unfinished runs of a shard into `out`, and writes the table and its plots once all
/// runs are finished. Values that a scene cannot have become a row with the reason. Memory holds
/// the table and the points of one scan per run in progress.
///
/// # Errors
/// A mistake in the sweep file or in the unchanged scene; files of another sweep in `out`; all runs
/// refused; a plot of an unknown quantity.
pub fn sweep<'a>(
    path: &Path,
    shard: Shard,
    plots: &[Plot],
    out: impl Into<OutputFolder<'a>>,
    control: &RunControl,
) -> Result<SweepSummary> {
    let sweep = Sweep::read(path, control)?;
    let out = sweep.claim(out.into())?;
    let (mut done, _) = sweep.read_records(out)?;
    let own = (u64::from(shard.shard)..sweep.places.count()).step_by(shard.of as usize);
    let left: Vec<u64> = own
        .clone()
        .filter(|place| !done.contains_key(place))
        .collect();
    let taken = left.len() as u64;
    if !left.is_empty() {
        let before = own.count() as u64 - taken;
        sweep.take(
            left,
            shard,
            out,
            &|n| (control.progress)(before + n),
            control,
        )?;
        // Other invocations may have finished runs too.
        (done, _) = sweep.read_records(out)?;
    }
    sweep.written(&done, taken, plots, out)
}

/// Writes the table of a sweep whose runs were scanned in shards.
///
/// # Errors
/// As [`sweep`]; and `Error::Input` with the shards that have unfinished runs, in the syntax of job
/// arrays.
pub fn sweep_merge<'a>(
    path: &Path,
    plots: &[Plot],
    out: impl Into<OutputFolder<'a>>,
    control: &RunControl,
) -> Result<SweepSummary> {
    let sweep = Sweep::read(path, control)?;
    let out = out.into();
    let (done, of) = sweep.read_records(out.path)?;
    let missing = (0..sweep.places.count()).filter(|place| !done.contains_key(place));
    let mut shards: Vec<u32> = missing
        .map(|place| (place % u64::from(of)) as u32)
        .collect();
    if shards.is_empty() {
        return sweep.written(&done, 0, plots, sweep.claim(out)?);
    }
    let found = format!("{} of {} runs missing", shards.len(), sweep.places.count());
    shards.sort_unstable();
    shards.dedup();
    let expected = format!(
        "all of them; run these shards of {of} again: --array={}",
        ranges(runs(&shards))
    );
    Err(InputError::new(&folder(out.path), Place::File, found, expected).into())
}

/// Returns the number of runs in a shard of a sweep, for a progress bar.
pub fn sweep_places(path: &Path, shard: Shard) -> Result<u64> {
    let places = SweepRuns::read(path)?.count();
    Ok((u64::from(shard.shard)..places)
        .step_by(shard.of as usize)
        .count() as u64)
}

fn folder(out: &Path) -> PathBuf {
    out.join("places")
}

/// Names of the files that are written when all runs are finished.
const TABLES: [&str; 2] = ["sweep.csv", "sweep.svg"];

impl Sweep {
    fn read(path: &Path, control: &RunControl) -> Result<Sweep> {
        let places = SweepRuns::read(path)?;
        let file = places.written.sibling_path(&places.scene);
        let scene = Scene::load_watched(&file, &|_| control.check())?;
        let text = input_file::read_text(&file, LARGEST_TEXT, "a scene (TOML)")?;
        Ok(Sweep {
            job: job(&places, &scene),
            text: Value::Table(text.parse().expect("the scene was read from it")),
            scene,
            places,
        })
    }

    /// Claims the folder for the names that this invocation writes.
    fn claim<'a>(&self, out: OutputFolder<'a>) -> Result<&'a Path> {
        let mut inputs = self.scene.inputs.to_vec();
        inputs.push(self.places.written.path.clone());
        inputs.extend(named_files(&self.places).into_values());
        let journal = format!("places/{}.journal", attempt());
        let names = Names::of(TABLES.map(str::to_owned).into_iter().chain([journal]));
        Ok(out.claim(&inputs, &names)?.path)
    }

    /// Returns the finished runs, and the largest number of shards in the journal headers.
    fn read_records(&self, out: &Path) -> Result<(BTreeMap<u64, RunRecord>, u32)> {
        let (mut done, mut of) = (BTreeMap::new(), 1);
        let folder = folder(out);
        for name in files::names_in(&folder)? {
            let path = folder.join(name);
            if path.extension().is_none_or(|ending| ending != "journal") {
                continue;
            }
            let mut records = Records::open(&path)?;
            let Some(header) = records.header::<Header>()? else {
                // The invocation was killed immediately, or has only begun.
                continue;
            };
            if header.job != self.job {
                return Err(Error::OtherRun {
                    journal: path,
                    difference: "sweep, scene, a file they name or the version has changed"
                        .to_owned(),
                });
            }
            of = of.max(header.shard.of);
            while let Some(record) = records.next::<RunRecord>()? {
                if record.place >= self.places.count() {
                    break;
                }
                done.insert(record.place, record);
            }
        }
        Ok((done, of))
    }

    /// Scans runs into a separate journal of this invocation.
    fn take(
        &self,
        places: Vec<u64>,
        shard: Shard,
        out: &Path,
        progress: &dyn Fn(u64),
        control: &RunControl,
    ) -> Result<()> {
        files::create_own_folder(&folder(out))?;
        let path = folder(out).join(format!("{}.journal", attempt()));
        let job = self.job.clone();
        let mut journal = Journal::begin(&path, &Header { job, shard })?;
        // Runs are grouped by part, in the order of the first run of each part.
        let mut parts: Vec<(Values, Vec<u64>)> = Vec::new();
        let mut known = BTreeMap::new();
        for place in places {
            let part = of_part(&self.places.values(place));
            let i = *known.entry(format!("{part:?}")).or_insert_with(|| {
                parts.push((part, Vec::new()));
                parts.len() - 1
            });
            parts[i].1.push(place);
        }
        let mut done = 0;
        for (part, places) in parts {
            let base = match self.base(&part, control) {
                Ok(base) => Ok(base),
                Err(error) => Err(self.refusal(error)?),
            };
            let frames = self.places.frames.as_ref().map_or(1, |frames| frames.len());
            // Short scans leave cores free for other runs.
            let together = (rayon::current_num_threads() / frames).max(1);
            for some in places.chunks(together) {
                control.check()?;
                let records = some.par_iter().map(|&place| match &base {
                    Ok(base) => self.record(base, place, control),
                    Err(message) => Ok(RunRecord::refused(place, message.clone())),
                });
                let records: Vec<Result<RunRecord>> = records.collect();
                let mut stopped = None;
                for record in records {
                    match record {
                        Ok(record) => journal.append(&[record])?,
                        Err(error) => stopped = stopped.or(Some(error)),
                    }
                    done += 1;
                }
                if let Some(error) = stopped {
                    return Err(error);
                }
                progress(done);
            }
        }
        journal.sync()
    }

    /// Builds the simulation that all runs with these values of the part have in common.
    fn base(&self, part: &Values, control: &RunControl) -> Result<Simulation> {
        if part.is_empty() {
            return setup::simulation(&self.scene, TraceMode::Footprint, control);
        }
        let text = self.places.written.text_with(&self.text, part)?;
        let scene = self.scene.of_other_part(text, &|_| control.check())?;
        setup::simulation(&scene, TraceMode::Footprint, control)
    }

    fn record(&self, base: &Simulation, place: u64, control: &RunControl) -> Result<RunRecord> {
        match self.scanned(base, place, control) {
            Ok((warnings, figures)) => {
                let messages: Vec<String> = warnings.into_iter().map(|w| w.message).collect();
                Ok(RunRecord {
                    place,
                    outcome: match messages.is_empty() {
                        true => RunOutcome::Good,
                        false => RunOutcome::Warned,
                    },
                    message: messages.join(" "),
                    figures,
                })
            }
            Err(error) => Ok(RunRecord::refused(place, self.refusal(error)?)),
        }
    }

    fn scanned(
        &self,
        base: &Simulation,
        place: u64,
        control: &RunControl,
    ) -> Result<(Vec<Warning>, Figures)> {
        let values = self.places.values(place);
        let text = self.places.written.text_with(&self.text, &values)?;
        let mut scene = base.scene.reusing_part(text)?;
        scene.save_images = false;
        let frames = self.places.frames.clone().unwrap_or(0..scene.scan.frames);
        check_frames(&scene, &frames)?;
        memory_estimate::require_scan(&scene, frames.len() as u64, true)?;
        let simulation = base.reusing_part(&scene)?;
        let summary = scan_summary(&simulation, &frames, control)?;
        let mut figures = figures(&summary);
        // The sweep has separate columns for warnings.
        figures.retain(|name, _| !name.starts_with("warnings."));
        Ok((summary.warnings, figures))
    }

    /// Returns the reason that values were refused, independent of the folder of the sweep. Errors:
    /// causes other than the values.
    fn refusal(&self, error: Error) -> Result<String> {
        let message = match error {
            Error::Input(mut mistake) => {
                let whole = mistake.to_string();
                // The line refers to a generated text that the user does not have.
                mistake.place = Place::File;
                match mistake.file == self.scene.path || mistake.file == self.places.written.path {
                    true => mistake
                        .to_string()
                        .split_once(": ")
                        .map_or(whole, |(_, rest)| rest.to_owned()),
                    false => whole,
                }
            }
            Error::Usage(_) | Error::Memory { .. } => error.to_string(),
            other => return Err(other),
        };
        let message = message.replace(&self.scene.path.display().to_string(), &self.places.scene);
        let folder = self.places.written.sibling_path("");
        match folder.to_string_lossy().trim_end_matches('/') {
            "" => Ok(message),
            folder => Ok(message.replace(&format!("{folder}/"), "")),
        }
    }

    /// Returns the summary, and writes the table and its plots if all runs are finished.
    fn written(
        &self,
        done: &BTreeMap<u64, RunRecord>,
        taken: u64,
        plots: &[Plot],
        out: &Path,
    ) -> Result<SweepSummary> {
        let refused = done.values().filter(|r| r.outcome == RunOutcome::Refused);
        let mut summary = SweepSummary {
            job: self.job.clone(),
            places: self.places.count(),
            places_taken: taken,
            missing: self.places.count() - done.len() as u64,
            refused: refused.clone().count() as u64,
            table: None,
            plots: None,
        };
        if summary.missing > 0 {
            return Ok(summary);
        }
        let records: Vec<&RunRecord> = done.values().collect();
        let rows = table::rows(&self.places, &records);
        let path = out.join("sweep.csv");
        table::write_csv(&path, &self.places, &rows)?;
        summary.table = Some(path);
        let [all, none] = [summary.places, summary.refused];
        if let Some(first) = refused.clone().next().filter(|_| all == none) {
            let found = format!(
                "{all} runs, all of them refused, the first: {}",
                first.message
            );
            let file = &self.places.written.path;
            return Err(InputError::new(
                file,
                Place::File,
                found,
                "values that the scene can have",
            )
            .into());
        }
        summary.plots = table::write_plots(&out.join("sweep.svg"), &self.places, &rows, plots)?;
        // Removes unfinished files of killed runs.
        remove_unfinished(out, &Names::of(TABLES))?;
        Ok(summary)
    }
}

/// Returns the hash of all inputs that determine the bytes of the table.
fn job(places: &SweepRuns, scene: &Scene) -> String {
    let mut parts = vec![
        env!("CARGO_PKG_VERSION").to_owned(),
        scene.accel.version(),
        places.written.text.clone(),
        scene.hash.clone(),
    ];
    for (name, file) in named_files(places) {
        if let Ok(bytes) = std::fs::read(file) {
            let sum = checksum(&bytes).map(|byte| format!("{byte:02x}")).concat();
            parts.push(format!("{name}={sum}"));
        }
    }
    let sum = checksum(parts.join("\n").as_bytes());
    sum[..8].iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Returns the sensor and mesh files that values name, with their names in the sweep.
fn named_files(places: &SweepRuns) -> BTreeMap<String, PathBuf> {
    let folder = places.written.sibling_path(&places.scene);
    let values = (0..places.count()).flat_map(|place| places.values(place).into_values());
    let names = values.filter_map(|value| match value {
        Value::String(name) => Some(name),
        _ => None,
    });
    let names: BTreeSet<String> = names.collect();
    let files = names
        .into_iter()
        .map(|name| (folder.with_file_name(&name), name));
    let files = files.filter(|(file, _)| file.is_file());
    files.map(|(file, name)| (name, file)).collect()
}
