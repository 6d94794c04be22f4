//! Scans in shards. Shard I of N simulates the frames I, I + N, … into a folder that all shards
//! use. Each shard has a separate journal. Merging combines the journals into the journal of an
//! undivided scan.
//!
//! A shard may be executed repeatedly, concurrently, or not at all. Its journal has a unique name
//! while it is written, and is renamed when it is complete. The bytes of a frame's files do not
//! depend on the run. Only the content of the folder therefore matters. No locks are needed, which
//! network file systems may lack.

use super::files;
use super::frames::FrameRunner;
use super::journal::{FrameRecord, Journal, Records, RunKey};
use crate::error::{Error, InputError, Place, Result};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::hash::{BuildHasher, RandomState};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

/// A shard of a scan.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Shard {
    /// Index of the shard, from 0.
    pub shard: u32,
    /// Number of shards.
    pub of: u32,
}

/// Header of a shard's journal.
#[derive(Serialize, Deserialize)]
pub(super) struct ShardKey {
    #[serde(flatten)]
    pub(super) shard: Shard,
    run: RunKey,
}

static ATTEMPT: LazyLock<String> =
    LazyLock::new(|| format!("{:016x}", RandomState::new().hash_one(std::process::id())));

/// Returns a string for file names that is unique to this run.
pub fn attempt() -> &'static str {
    &ATTEMPT
}

/// Returns the suffix of unfinished files.
pub fn unfinished() -> String {
    format!(".{}.part", attempt())
}

fn folder(out: &Path) -> PathBuf {
    out.join("shards")
}

impl Shard {
    /// Returns the frames of the shard within `all`.
    pub fn frames(self, all: &Range<u32>) -> impl Iterator<Item = u32> + use<> {
        let first = all.start.saturating_add(self.shard).min(all.end);
        (first..all.end).step_by(self.of as usize)
    }

    fn journal(self, out: &Path) -> PathBuf {
        folder(out).join(self.name())
    }

    fn name(self) -> String {
        let Shard { shard, of } = self;
        format!("shard-{shard}-of-{of}.journal")
    }

    /// Returns the shard whose journal has this name.
    fn of_journal(name: &str) -> Option<Shard> {
        let numbers = name.strip_prefix("shard-")?.strip_suffix(".journal")?;
        let (shard, of) = numbers.split_once("-of-")?;
        let shard = Shard {
            shard: shard.parse().ok()?,
            of: of.parse().ok()?,
        };
        (shard.shard < shard.of && shard.name() == name).then_some(shard)
    }

    /// Returns the path of the complete journal after checking all records; `None` if it is absent
    /// or damaged.
    fn whole(self, out: &Path, key: &RunKey) -> Result<Option<PathBuf>> {
        let path = self.journal(out);
        if !path.exists() {
            return Ok(None);
        }
        let Some(mut records) = self.open(&path, key)? else {
            return Ok(None);
        };
        for frame in self.frames(&key.frames) {
            match records.next::<FrameRecord>()? {
                Some(record) if record.frame == frame => {}
                _ => return Ok(None),
            }
        }
        Ok(records.at_end().then_some(path))
    }

    /// Opens the journal. Errors: the journal belongs to another run.
    fn open(self, path: &Path, key: &RunKey) -> Result<Option<Records>> {
        let mut records = Records::open(path)?;
        let Some(old) = records.header::<ShardKey>()? else {
            return Ok(None);
        };
        if let Some(difference) = key.difference(&old.run) {
            let journal = path.to_owned();
            return Err(Error::OtherRun {
                journal,
                difference,
            });
        }
        Ok((old.shard == self).then_some(records))
    }
}

/// Simulates the frames of a shard, unless its journal is complete. Returns the number of simulated
/// frames.
pub fn take(run: &FrameRunner, shard: Shard, key: &RunKey) -> Result<u32> {
    if shard.whole(run.out, key)?.is_some() {
        return Ok(0);
    }
    files::create_own_folder(&folder(run.out))?;
    let header = ShardKey {
        shard,
        run: key.clone(),
    };
    Journal::written(&shard.journal(run.out), &unfinished(), &header, |journal| {
        run.frames(shard.frames(&key.frames), journal)?;
        // The images must be on the disk before the journal is complete.
        match run.simulation.scene.save_images {
            true => files::sync_all(run.out),
            false => Ok(()),
        }
    })?;
    Ok(shard.frames(&key.frames).count() as u32)
}

/// Returns the journals of all shards in a folder after checking all records.
///
/// # Errors
/// `Error::Input` with the missing or damaged shards, in the syntax of job arrays;
/// `Error::OtherRun`.
pub fn all_whole(out: &Path, key: &RunKey) -> Result<Vec<(Shard, PathBuf)>> {
    let (of, there) = shards_in(out)?;
    let mut whole = Vec::new();
    for shard in there {
        let shard = Shard { shard, of };
        whole.extend(shard.whole(out, key)?.map(|path| (shard, path)));
    }
    let missing = without(of, whole.iter().map(|(shard, _)| shard.shard));
    if missing.is_empty() {
        return Ok(whole);
    }
    let count: u64 = missing
        .iter()
        .map(|range| u64::from(range.end - range.start))
        .sum();
    let found = format!("{count} of {of} shards missing or damaged");
    let expected = format!("all of them; run these again: --array={}", ranges(missing));
    Err(InputError::new(&folder(out), Place::File, found, expected).into())
}

/// Writes the journal of the undivided scan in `out` from the journals of its shards. The scan can
/// then continue as if it had simulated all frames. Records are read while they are written, so
/// memory does not grow with their number. `prepare` is called before the journal changes.
pub fn merge(
    out: &Path,
    key: &RunKey,
    whole: Vec<(Shard, PathBuf)>,
    prepare: impl FnOnce() -> Result<()>,
) -> Result<()> {
    allow_open_files();
    let of = whole.len() as u32;
    let mut readers = Vec::new();
    for (shard, path) in whole {
        let changed = || Error::io("read", &path)(std::io::Error::other("it has changed"));
        readers.push((shard.open(&path, key)?.ok_or_else(changed)?, path));
    }
    Journal::make(out, key, prepare, |journal| {
        for frame in key.frames.clone() {
            let reader = ((frame - key.frames.start) % of) as usize;
            let (records, path) = &mut readers[reader];
            let changed = || Error::io("read", path)(std::io::Error::other("it has changed"));
            let record: FrameRecord = records.next()?.ok_or_else(changed)?;
            journal.append(&[record])?;
        }
        Ok(())
    })
}

/// Returns the number of shards that the names of the journals state, and the shards with a
/// journal, in ascending order.
fn shards_in(out: &Path) -> Result<(u32, BTreeSet<u32>)> {
    let folder = folder(out);
    let wrong = |found: String, expected: &str| {
        Err(InputError::new(&folder, Place::File, found, expected).into())
    };
    let mut by_division: BTreeMap<u32, BTreeSet<u32>> = BTreeMap::new();
    for name in files::names_in(&folder)? {
        if let Some(Shard { shard, of }) = name.to_str().and_then(Shard::of_journal) {
            by_division.entry(of).or_default().insert(shard);
        }
    }
    if by_division.len() > 1 {
        let all: Vec<String> = by_division.keys().map(u32::to_string).collect();
        let found = format!("shards of {}", all.join(" and of "));
        return wrong(found, "shards of one division; remove the others' journals");
    }
    match by_division.pop_first() {
        Some(division) => Ok(division),
        None => wrong(
            "no finished shard".to_owned(),
            "journals of shards (scan --shard I/N with this folder)",
        ),
    }
}

/// Returns the numbers below `of` that are absent from `these`, which is in ascending order.
fn without(of: u32, these: impl Iterator<Item = u32>) -> Vec<Range<u32>> {
    let mut next = 0;
    let mut gaps = Vec::new();
    for one in these.chain([of]) {
        if next < one {
            gaps.push(next..one);
        }
        next = one.saturating_add(1);
    }
    gaps
}

/// Formats ranges of numbers as `1,3-5`.
pub fn ranges(numbers: impl IntoIterator<Item = Range<u32>>) -> String {
    let words = numbers.into_iter().map(|run| match run.len() {
        1 => run.start.to_string(),
        _ => format!("{}-{}", run.start, run.end - 1),
    });
    words.collect::<Vec<_>>().join(",")
}

/// Returns ascending numbers as ranges.
pub fn runs(numbers: &[u32]) -> impl Iterator<Item = Range<u32>> {
    let runs = numbers.chunk_by(|a, b| a + 1 == *b);
    runs.map(|run| run[0]..run[0] + run.len() as u32)
}

/// Raises the limit of open files to the maximum for this process, because there may be a thousand
/// shards.
fn allow_open_files() {
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
    let limit = getrlimit(Resource::Nofile);
    let most = Rlimit {
        current: limit.maximum,
        ..limit
    };
    // On failure, opening the files returns the error.
    let _ = setrlimit(Resource::Nofile, most);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shards_share_out_all_frames() {
        let all = 5..23;
        for of in [1, 2, 7, 18, 40] {
            let mut frames: Vec<u32> = (0..of)
                .flat_map(|shard| Shard { shard, of }.frames(&all))
                .collect();
            frames.sort_unstable();
            assert!(frames.into_iter().eq(all.clone()), "{of}");
        }
        let last = Shard { shard: 9, of: 10 };
        assert_eq!(last.frames(&(u32::MAX - 3..u32::MAX)).count(), 0);
    }

    #[test]
    fn missing_shards_are_named_as_arrays_have_them() {
        assert_eq!(ranges(runs(&[0, 1, 2, 4, 7, 8])), "0-2,4,7-8");
        for (of, there, missing) in [
            (9, &[3, 5, 6][..], "0-2,4,7-8"),
            (1, &[], "0"),
            (20_000_000, &[0], "1-19999999"),
            (u32::MAX, &[u32::MAX - 1], "0-4294967293"),
            (3, &[0, 1, 2], ""),
        ] {
            assert_eq!(ranges(without(of, there.iter().copied())), missing);
        }
    }
}
