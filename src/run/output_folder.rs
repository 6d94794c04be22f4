//! Management of the output folders of commands.
//!
//! Before its first output, a run records the names of its output files in
//! `.lasertrace/HASH.json`. A run replaces and removes only files that such a list names. This
//! protects the user's files, also after a kill. The name of a list is a hash of its content.
//! Concurrent runs therefore never write different contents to one list.

use super::files::{self, PART, names_in};
use super::journal::checksum;
use crate::error::{Error, Result, printable};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// Name of the folder of the lists.
pub const LISTS: &str = ".lasertrace";

/// Maximum number of file names in an error message.
const SHOWN: usize = 3;

/// A folder to write to.
#[derive(Debug, Clone, Copy)]
pub struct OutputFolder<'a> {
    /// Path of the folder. The folder is created if it does not exist.
    pub path: &'a Path,
    /// Whether files that are not in any list may be replaced.
    pub force: bool,
}

impl<'a, P: AsRef<Path> + ?Sized> From<&'a P> for OutputFolder<'a> {
    fn from(path: &'a P) -> OutputFolder<'a> {
        OutputFolder {
            path: path.as_ref(),
            force: false,
        }
    }
}

/// Names of files in an output folder, as paths below it.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Names {
    files: BTreeSet<String>,
    series: Vec<Series>,
}

/// A series of names: `before`, a number in `numbers` with at least `digits` digits, `after`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
struct Series {
    before: String,
    digits: usize,
    after: String,
    numbers: Range<u64>,
}

impl Names {
    /// Returns a set of names.
    pub fn of(names: impl IntoIterator<Item: Into<String>>) -> Names {
        Names {
            files: names.into_iter().map(Into::into).collect(),
            series: Vec::new(),
        }
    }

    /// Adds the names that consist of `before`, one of the `numbers` with at least `digits` digits,
    /// and `after`.
    pub fn and(mut self, before: &str, digits: usize, after: &str, numbers: Range<u64>) -> Names {
        self.series.push(Series {
            before: before.to_owned(),
            digits,
            after: after.to_owned(),
            numbers,
        });
        self
    }

    fn has(&self, name: &str) -> bool {
        self.files.contains(name) || self.series.iter().any(|series| series.has(name))
    }

    /// Returns whether `name` is one of the names, or the name of such a file while it is
    /// unfinished.
    pub(super) fn has_part(&self, name: &str) -> bool {
        self.has(name) || whole_name(name).is_some_and(|name| self.has(name))
    }

    /// Returns the folders of all files, relative to the output folder, which is "".
    fn folders(&self) -> BTreeSet<&str> {
        let series = self.series.iter().map(|series| &series.before);
        let all = self.files.iter().chain(series);
        let above = all.filter_map(|name| Some(name.rsplit_once('/')?.0));
        above.chain([""]).collect()
    }
}

impl Series {
    fn has(&self, name: &str) -> bool {
        let number = name
            .strip_prefix(&self.before)
            .and_then(|rest| rest.strip_suffix(&self.after));
        let Some(number) = number else { return false };
        let value = number.parse::<u64>().ok();
        // Accepts only the format that runs write: no sign and no extra leading zeros.
        value.is_some_and(|value| {
            self.numbers.contains(&value)
                && format!("{value:0width$}", width = self.digits) == number
        })
    }
}

/// Returns the final name of an unfinished file: `cloud.ply` for `cloud.ply.part` and for
/// `cloud.ply.0123456789abcdef.part`.
fn whole_name(name: &str) -> Option<&str> {
    let name = name.strip_suffix(PART)?;
    let of_an_attempt = name.rsplit_once('.').filter(|(_, attempt)| {
        attempt.len() == 16 && attempt.bytes().all(|byte| byte.is_ascii_hexdigit())
    });
    Some(of_an_attempt.map_or(name, |(name, _)| name))
}

fn below(folder: &str, name: &str) -> String {
    match folder {
        "" => name.to_owned(),
        folder => format!("{folder}/{name}"),
    }
}

/// An output folder whose lists include the files of this run.
pub struct Claimed<'a> {
    pub path: &'a Path,
    /// Lists of earlier runs.
    before: Vec<Names>,
}

impl<'a> OutputFolder<'a> {
    /// Creates the folder and records the names that a run writes. Removes unfinished files of runs
    /// that died.
    ///
    /// # Errors
    /// `Error::Occupied` for files that are not in any list, unless `force` is set; `Error::Usage`
    /// if one of the `inputs` would be replaced.
    pub fn claim(self, inputs: &[PathBuf], names: &Names) -> Result<Claimed<'a>> {
        let path = self.path;
        files::create_folder(path)?;
        // Best effort: the folder above may not be readable.
        let _ = files::sync_folder_of(path);
        // Lists are read after the folder, because every run writes its list before its files.
        let mut found = Vec::new();
        for folder in names.folders() {
            let entries = names_in(&path.join(folder))?;
            let entries = entries.iter().filter_map(|name| name.to_str());
            found.extend(entries.map(|name| below(folder, name)));
        }
        // The trailing slash is needed because the folder may be given as a link.
        let top = names_in(&path.join(""))?;
        let before = lists(path)?;
        let listed = |name: &str| before.iter().any(|list| list.has_part(name));
        let mut foreign: Vec<String> = match before.is_empty() {
            true => (top.iter().map(|name| name.to_string_lossy().into_owned()))
                .filter(|name| name != LISTS)
                .collect(),
            false => (found.iter())
                .filter(|name| names.has_part(name) && !listed(name))
                .cloned()
                .collect(),
        };
        refuse_inputs(path, inputs, |name| names.has_part(name) || listed(name))?;
        if !foreign.is_empty() && !self.force {
            foreign.sort();
            return Err(Error::Occupied {
                folder: path.to_owned(),
                found: summary(&foreign),
            });
        }
        for name in found.iter().filter(|name| listed(name)) {
            if whole_name(name).is_some() {
                files::remove_if_unlocked(&path.join(name))?;
            }
        }
        for name in names_in(&path.join(LISTS))? {
            if name.to_str().is_some_and(|name| whole_name(name).is_some()) {
                files::remove_if_unlocked(&path.join(LISTS).join(name))?;
            }
        }
        record(path, names, &before)?;
        Ok(Claimed { path, before })
    }
}

impl Claimed<'_> {
    /// Removes a file if the list of an earlier run names it.
    pub fn remove(&self, name: &str) -> Result<()> {
        match self.before.iter().any(|list| list.has(name)) {
            true => files::remove(&self.path.join(name)),
            false => Ok(()),
        }
    }

    /// Removes all files in a subfolder that lists of earlier runs name.
    pub fn remove_in(&self, folder: &str) -> Result<()> {
        for name in names_in(&self.path.join(folder))? {
            if let Some(name) = name.to_str() {
                self.remove(&below(folder, name))?;
            }
        }
        Ok(())
    }
}

/// Removes unfinished files of these names whose writers have died.
pub fn remove_unfinished(folder: &Path, names: &Names) -> Result<()> {
    for below_it in names.folders() {
        for name in names_in(&folder.join(below_it))? {
            let name = name.to_str().map(|name| below(below_it, name));
            let of_ours = |name: &String| whole_name(name).is_some_and(|whole| names.has(whole));
            if let Some(name) = name.filter(of_ours) {
                files::remove_if_unlocked(&folder.join(name))?;
            }
        }
    }
    Ok(())
}

/// Returns the lists in a folder. A damaged list has no effect.
fn lists(path: &Path) -> Result<Vec<Names>> {
    let folder = path.join(LISTS);
    let mut lists = Vec::new();
    for name in names_in(&folder)? {
        if Path::new(&name)
            .extension()
            .is_some_and(|end| end == "json")
        {
            let file = folder.join(name);
            let bytes = fs::read(&file).map_err(Error::io("read", &file))?;
            lists.extend(serde_json::from_slice::<Names>(&bytes).ok());
        }
    }
    Ok(lists)
}

/// Adds a list, unless the folder already has it.
fn record(path: &Path, names: &Names, before: &[Names]) -> Result<()> {
    if before.contains(names) {
        return Ok(());
    }
    let folder = path.join(LISTS);
    files::create_own_folder(&folder)?;
    let text = serde_json::to_vec(names).expect("names are JSON");
    let sum = checksum(&text);
    let name: String = sum[..8].iter().map(|byte| format!("{byte:02x}")).collect();
    let part = super::shards::unfinished();
    files::write_in_steps(&folder.join(format!("{name}.json")), &part, |file| {
        use std::io::Write;
        file.write_all(&text).map_err(Error::io("write", &folder))
    })
}

/// Returns an error if an input would be replaced, whichever path or link leads to it.
fn refuse_inputs(path: &Path, inputs: &[PathBuf], is_ours: impl Fn(&str) -> bool) -> Result<()> {
    let folder = path
        .canonicalize()
        .map_err(Error::io("read folder", path))?;
    for input in inputs {
        for at in locations(input) {
            let name = at.strip_prefix(&folder).ok().and_then(Path::to_str);
            if name.is_some_and(&is_ours) {
                return Err(Error::Usage(format!(
                    "{} is an input, and would be replaced or removed: name another folder to write to",
                    printable::path(input)
                )));
            }
        }
    }
    Ok(())
}

/// Returns the location of a file and of the symbolic links on its path.
fn locations(file: &Path) -> Vec<PathBuf> {
    /// Maximum number of links that the system follows.
    const LINKS: usize = 40;
    let mut locations = Vec::new();
    let mut next = Some(file.to_owned());
    while let Some(at) = next.take().filter(|_| locations.len() < LINKS) {
        let folder = match at.parent() {
            Some(folder) if folder != Path::new("") => folder,
            _ => Path::new("."),
        };
        if let (Ok(folder), Some(name)) = (folder.canonicalize(), at.file_name()) {
            let at = folder.join(name);
            next = fs::read_link(&at).ok().map(|to| folder.join(to));
            locations.push(at);
        }
    }
    locations
}

fn summary(names: &[String]) -> String {
    let shown = names.iter().take(SHOWN).map(|name| printable::short(name));
    let shown = shown.collect::<Vec<_>>().join(", ");
    match names.len().saturating_sub(SHOWN) {
        0 => shown,
        more => format!("{shown} and {more} more"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_series_has_only_names_as_they_are_written() {
        let names = Names::of(["cloud.ply"]).and("frames/frame-", 6, ".png", 3..2_000_000);
        for (name, is_one) in [
            ("cloud.ply", true),
            ("cloud.csv", false),
            ("frames/frame-000003.png", true),
            ("frames/frame-1234567.png", true),
            ("frames/frame-000002.png", false),
            ("frames/frame-0000003.png", false),
            ("frames/frame-3.png", false),
            ("frames/frame-+00003.png", false),
            ("frames/frame-of-x.png", false),
            ("frame-000003.png", false),
        ] {
            assert_eq!(names.has(name), is_one, "{name}");
        }
        for (name, is_one) in [
            ("cloud.ply.part", true),
            ("cloud.ply.0123456789abcdef.part", true),
            ("cloud.ply.mine.part", false),
            ("cloud.csv.part", false),
        ] {
            assert_eq!(names.has_part(name), is_one, "{name}");
        }
        assert_eq!(names.folders(), BTreeSet::from(["", "frames"]));
    }
}
