//! Scans in shards: shard I of N takes the frames I, I + N, … into a folder that all of them share, each with
//! a journal of its own, and merging makes of these the journal of an undivided scan.
//!
//! A shard may run never, once, twice, or twice at the same time: its journal is written under a name that no other
//! run has, and renamed when it is whole; and a frame's files are the same bytes whoever writes them. So
//! what counts is what lies in the folder, and no locks are needed, which network file systems may not have.

use super::files;
use super::frames::Run;
use super::journal::{FrameRecord, Journal, Records, RunKey};
use crate::error::{Error, InputError, Place, Result};
use serde::{Deserialize, Serialize};
use std::hash::{BuildHasher, RandomState};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

/// One of the shards of a scan.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Shard {
    /// Which, from 0.
    pub shard: u32,
    /// Of so many.
    pub of: u32,
}

/// What the first record of a shard's journal says.
#[derive(Serialize, Deserialize)]
struct ShardKey {
    #[serde(flatten)]
    shard: Shard,
    run: RunKey,
}

static ATTEMPT: LazyLock<String> =
    LazyLock::new(|| format!("{:016x}", RandomState::new().hash_one(std::process::id())));

/// A word that no other run has, for names of files.
pub fn attempt() -> &'static str {
    &ATTEMPT
}

/// The end of names of files that are not whole.
pub fn unfinished() -> String {
    format!(".{}.part", attempt())
}

fn folder(out: &Path) -> PathBuf {
    out.join("shards")
}

impl Shard {
    /// Its frames of all.
    pub fn frames(self, all: &Range<u32>) -> impl Iterator<Item = u32> + use<> {
        let first = all.start.saturating_add(self.shard).min(all.end);
        (first..all.end).step_by(self.of as usize)
    }

    fn journal(self, out: &Path) -> PathBuf {
        let Shard { shard, of } = self;
        folder(out).join(format!("shard-{shard}-of-{of}.journal"))
    }

    /// Its whole journal, checked to the end; `None` where there is none, or a damaged one.
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

    /// Errors: it is of another run.
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

/// Takes the frames of a shard, unless its journal is whole already; how many were taken.
pub fn take(run: &Run, shard: Shard, key: &RunKey) -> Result<u32> {
    if shard.whole(run.out, key)?.is_some() {
        return Ok(0);
    }
    files::create_own_folder(&folder(run.out))?;
    let path = shard.journal(run.out);
    let mut part = path.clone().into_os_string();
    part.push(unfinished());
    let part = PathBuf::from(part);
    let run_key = key.clone();
    let written = Journal::begin(
        &part,
        &ShardKey {
            shard,
            run: run_key,
        },
    )
    .and_then(|mut journal| {
        run.frames(shard.frames(&key.frames), &mut journal)?;
        journal.sync()
    });
    let renamed =
        written.and_then(|()| std::fs::rename(&part, &path).map_err(Error::io("write", &path)));
    if renamed.is_err() {
        // Best effort: the first error is the one to report.
        let _ = std::fs::remove_file(&part);
    }
    renamed?;
    Ok(shard.frames(&key.frames).count() as u32)
}

/// Makes the journal of the undivided scan in `out` from its shards', so that the scan can go on as if it had
/// taken all frames itself. Records are read as they are written: memory does not grow with their number.
///
/// # Errors
/// `Error::Input` with what is missing or damaged, as an array of jobs has it; `Error::OtherRun`.
pub fn merge(out: &Path, key: &RunKey) -> Result<()> {
    let of = shards_in(out)?;
    let shards = (0..of).map(|shard| Shard { shard, of });
    let (mut whole, mut missing) = (Vec::new(), Vec::new());
    for shard in shards {
        match shard.whole(out, key)? {
            Some(path) => whole.push((shard, path)),
            None => missing.push(shard.shard),
        }
    }
    if !missing.is_empty() {
        let found = format!("{} of {of} shards missing or damaged", missing.len());
        let expected = format!("all of them; run these again: --array={}", ranges(&missing));
        return Err(InputError::new(&folder(out), Place::File, found, expected).into());
    }
    allow_open_files();
    let mut readers = Vec::new();
    for (shard, path) in whole {
        let changed = || Error::io("read", &path)(std::io::Error::other("it has changed"));
        readers.push((shard.open(&path, key)?.ok_or_else(changed)?, path));
    }
    let (mut journal, _) = Journal::open(out, key, false)?;
    for frame in key.frames.clone() {
        let reader = ((frame - key.frames.start) % of) as usize;
        let (records, path) = &mut readers[reader];
        let changed = || Error::io("read", path)(std::io::Error::other("it has changed"));
        let record: FrameRecord = records.next()?.ok_or_else(changed)?;
        journal.append(&[record])?;
    }
    journal.sync()
}

/// How many shards the journals in a folder say there are.
fn shards_in(out: &Path) -> Result<u32> {
    let folder = folder(out);
    let wrong = |found: String, expected: &str| {
        Err(InputError::new(&folder, Place::File, found, expected).into())
    };
    let mut of: Vec<u32> = Vec::new();
    let entries = match std::fs::read_dir(&folder) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => None,
        entries => Some(entries.map_err(Error::io("read folder", &folder))?),
    };
    for entry in entries.into_iter().flatten() {
        let entry = entry.map_err(Error::io("read folder", &folder))?;
        let name = entry.file_name().to_string_lossy().into_owned();
        let number = name
            .strip_suffix(".journal")
            .and_then(|name| name.rsplit('-').next());
        of.extend(number.and_then(|number| number.parse::<u32>().ok()));
    }
    of.sort_unstable();
    of.dedup();
    match of[..] {
        [of] if of > 0 => Ok(of),
        [] => wrong(
            "no finished shard".to_owned(),
            "journals of shards (scan --shard I/N with this folder)",
        ),
        _ => {
            let all: Vec<String> = of.iter().map(u32::to_string).collect();
            let found = format!("shards of {}", all.join(" and of "));
            wrong(found, "shards of one division; remove the others' journals")
        }
    }
}

/// Numbers as `1,3-5`.
pub fn ranges(numbers: &[u32]) -> String {
    let runs = numbers.chunk_by(|a, b| a + 1 == *b);
    let words = runs.map(|run| match run {
        [one] => one.to_string(),
        [first, .., last] => format!("{first}-{last}"),
        [] => String::new(),
    });
    words.collect::<Vec<_>>().join(",")
}

/// As many files at once as the system lets this process have: there may be a thousand shards.
fn allow_open_files() {
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
    let limit = getrlimit(Resource::Nofile);
    let most = Rlimit {
        current: limit.maximum,
        ..limit
    };
    // If it does not, opening them says so.
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
        assert_eq!(ranges(&[0, 1, 2, 4, 7, 8]), "0-2,4,7-8");
    }
}
