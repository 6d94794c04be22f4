//! Sweeps: a scene scanned with other values at each of many places, and what each scan gave, as one table.
//!
//! What is done lies in `places/*.journal`: one file for each run, with the records of the places that it finished.
//! A run reads all of them and does what none has, so it goes on after a kill, and shards may run
//! never, once, twice, at the same time or divided otherwise. Who finds all places there writes the table, whose bytes
//! depend on sweep and scene alone.

mod figures;
mod places;
mod record;
mod table;

use super::journal::{Journal, Records, checksum};
use super::output_folder::{Names, OutputFolder, remove_unfinished};
use super::ready;
use super::reason::Warning;
use super::recipe::Values;
use super::scan::summed_up;
use super::shards::{Shard, attempt, ranges, runs};
use super::simulation::Simulation;
use super::{Control, Coverage, check_frames, files, need};
use crate::error::input_file::{self, LARGEST_TEXT};
use crate::error::{Error, InputError, Place, Result, printable};
use crate::scene::Scene;
use figures::{Figures, figures};
use places::{Places, of_part};
use rayon::prelude::*;
use record::{Outcome, Record};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use toml::Value;

pub use table::Plot;

/// What the first record of a journal says.
#[derive(Serialize, Deserialize)]
struct Header {
    job: String,
    #[serde(flatten)]
    shard: Shard,
}

/// What a run of `sweep` has done.
#[derive(Debug, Serialize)]
pub struct SweepSummary {
    /// Of sweep, scene, the files they name, version and numerics: all shards have the same.
    pub job: String,
    /// Places of the sweep.
    pub places: u64,
    /// Those that were scanned now.
    pub places_taken: u64,
    /// Those that no run has finished yet.
    pub missing: u64,
    /// Those that the scene cannot have, of all that are there.
    pub refused: u64,
    /// `sweep.csv`, if no place is missing.
    #[serde(serialize_with = "printable::some_in_json")]
    pub table: Option<PathBuf>,
    /// `sweep.svg`, if no place is missing.
    #[serde(serialize_with = "printable::some_in_json")]
    pub plots: Option<PathBuf>,
}

struct Sweep {
    places: Places,
    scene: Scene,
    /// The scene's text.
    text: Value,
    job: String,
}

/// Scans those places of a sweep that are a shard's and that no run has finished, into `out`, and writes the
/// table and its plots once all places are there. Values that a scene cannot have are a row
/// with the reason. Memory: one scan's points for each place in work, and the table.
///
/// # Errors
/// A mistake in the sweep's file or in the scene as it is; files of another sweep in `out`; every place refused; a plot
/// of what there is not.
pub fn sweep<'a>(
    path: &Path,
    shard: Shard,
    plots: &[Plot],
    out: impl Into<OutputFolder<'a>>,
    control: &Control,
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
        // Others' too.
        (done, _) = sweep.read_records(out)?;
    }
    sweep.written(&done, taken, plots, out)
}

/// The table of a sweep whose places were scanned in shards.
///
/// # Errors
/// As [`sweep`]; and `Error::Input` that names the shards of which places are missing, as an array of jobs has it.
pub fn sweep_merge<'a>(
    path: &Path,
    plots: &[Plot],
    out: impl Into<OutputFolder<'a>>,
    control: &Control,
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
    let found = format!(
        "{} of {} places missing",
        shards.len(),
        sweep.places.count()
    );
    shards.sort_unstable();
    shards.dedup();
    let expected = format!(
        "all of them; run these shards of {of} again: --array={}",
        ranges(runs(&shards))
    );
    Err(InputError::new(&folder(out.path), Place::File, found, expected).into())
}

/// How many places a shard of a sweep has, for a progress bar.
pub fn sweep_places(path: &Path, shard: Shard) -> Result<u64> {
    let places = Places::read(path)?.count();
    Ok((u64::from(shard.shard)..places)
        .step_by(shard.of as usize)
        .count() as u64)
}

fn folder(out: &Path) -> PathBuf {
    out.join("places")
}

/// Files that are written when all places are finished.
const TABLES: [&str; 2] = ["sweep.csv", "sweep.svg"];

impl Sweep {
    fn read(path: &Path, control: &Control) -> Result<Sweep> {
        let places = Places::read(path)?;
        let file = places.written.beside(&places.scene);
        let scene = Scene::load_watched(&file, &|_| control.check())?;
        let text = input_file::read_text(&file, LARGEST_TEXT, "a scene (TOML)")?;
        Ok(Sweep {
            job: job(&places, &scene),
            text: Value::Table(text.parse().expect("the scene was read from it")),
            scene,
            places,
        })
    }

    /// The folder, whose lists have the names that this run writes.
    fn claim<'a>(&self, out: OutputFolder<'a>) -> Result<&'a Path> {
        let mut inputs = self.scene.inputs.to_vec();
        inputs.push(self.places.written.path.clone());
        inputs.extend(named_files(&self.places).into_values());
        let journal = format!("places/{}.journal", attempt());
        let names = Names::of(TABLES.map(str::to_owned).into_iter().chain([journal]));
        Ok(out.claim(&inputs, &names)?.path)
    }

    /// The places that some run has finished, and of how many shards the runs spoke.
    fn read_records(&self, out: &Path) -> Result<(BTreeMap<u64, Record>, u32)> {
        let (mut done, mut of) = (BTreeMap::new(), 1);
        let folder = folder(out);
        for name in files::names_in(&folder)? {
            let path = folder.join(name);
            if path.extension().is_none_or(|ending| ending != "journal") {
                continue;
            }
            let mut records = Records::open(&path)?;
            let Some(header) = records.header::<Header>()? else {
                // Its run was killed at once, or has only begun.
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
            while let Some(record) = records.next::<Record>()? {
                if record.place >= self.places.count() {
                    break;
                }
                done.insert(record.place, record);
            }
        }
        Ok((done, of))
    }

    /// Scans these places, into a journal of this run's own.
    fn take(
        &self,
        places: Vec<u64>,
        shard: Shard,
        out: &Path,
        progress: &dyn Fn(u64),
        control: &Control,
    ) -> Result<()> {
        files::create_own_folder(&folder(out))?;
        let path = folder(out).join(format!("{}.journal", attempt()));
        let job = self.job.clone();
        let mut journal = Journal::begin(&path, &Header { job, shard })?;
        // One part after the other, in the order of their first places.
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
            // Short scans leave cores to other places.
            let together = (rayon::current_num_threads() / frames).max(1);
            for some in places.chunks(together) {
                control.check()?;
                let records = some.par_iter().map(|&place| match &base {
                    Ok(base) => self.record(base, place, control),
                    Err(message) => Ok(Record::refused(place, message.clone())),
                });
                let records: Vec<Result<Record>> = records.collect();
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

    /// What all places share that have these values of the part.
    fn base(&self, part: &Values, control: &Control) -> Result<Simulation> {
        if part.is_empty() {
            return ready::simulation(&self.scene, Coverage::Footprint, control);
        }
        let text = self.places.written.text_with(&self.text, part)?;
        let scene = self.scene.of_other_part(text, &|_| control.check())?;
        ready::simulation(&scene, Coverage::Footprint, control)
    }

    fn record(&self, base: &Simulation, place: u64, control: &Control) -> Result<Record> {
        match self.scanned(base, place, control) {
            Ok((warnings, figures)) => {
                let messages: Vec<String> = warnings.into_iter().map(|w| w.message).collect();
                Ok(Record {
                    place,
                    outcome: match messages.is_empty() {
                        true => Outcome::Good,
                        false => Outcome::Warned,
                    },
                    message: messages.join(" "),
                    figures,
                })
            }
            Err(error) => Ok(Record::refused(place, self.refusal(error)?)),
        }
    }

    fn scanned(
        &self,
        base: &Simulation,
        place: u64,
        control: &Control,
    ) -> Result<(Vec<Warning>, Figures)> {
        let values = self.places.values(place);
        let text = self.places.written.text_with(&self.text, &values)?;
        let mut scene = base.scene.of_same_part(text)?;
        scene.write_frames = false;
        let frames = self.places.frames.clone().unwrap_or(0..scene.scan.frames);
        check_frames(&scene, &frames)?;
        need::require_scan(&scene, frames.len() as u64, true)?;
        let simulation = base.of_same_part(&scene)?;
        let summary = summed_up(&simulation, &frames, control)?;
        let mut figures = figures(&summary);
        // What the sweep's own columns say.
        figures.retain(|name, _| !name.starts_with("warnings."));
        Ok((summary.warnings, figures))
    }

    /// Why values were refused, the same wherever the sweep lies. Errors: what is no fault of theirs.
    fn refusal(&self, error: Error) -> Result<String> {
        let message = match error {
            Error::Input(mut mistake) => {
                let whole = mistake.to_string();
                // The line is one of a text that no one has.
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
        let folder = self.places.written.beside("");
        match folder.to_string_lossy().trim_end_matches('/') {
            "" => Ok(message),
            folder => Ok(message.replace(&format!("{folder}/"), "")),
        }
    }

    /// What is there, and the table and its plots if that is all.
    fn written(
        &self,
        done: &BTreeMap<u64, Record>,
        taken: u64,
        plots: &[Plot],
        out: &Path,
    ) -> Result<SweepSummary> {
        let refused = done.values().filter(|r| r.outcome == Outcome::Refused);
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
        let records: Vec<&Record> = done.values().collect();
        let rows = table::rows(&self.places, &records);
        let path = out.join("sweep.csv");
        table::write_csv(&path, &self.places, &rows)?;
        summary.table = Some(path);
        let [all, none] = [summary.places, summary.refused];
        if let Some(first) = refused.clone().next().filter(|_| all == none) {
            let found = format!(
                "{all} places, all of them refused, the first: {}",
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
        // Unfinished files of killed runs.
        remove_unfinished(out, &Names::of(TABLES))?;
        Ok(summary)
    }
}

/// Of all that the table's bytes depend on.
fn job(places: &Places, scene: &Scene) -> String {
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

/// Files that values name, of a sensor or a mesh, by their names in the sweep.
fn named_files(places: &Places) -> BTreeMap<String, PathBuf> {
    let folder = places.written.beside(&places.scene);
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
