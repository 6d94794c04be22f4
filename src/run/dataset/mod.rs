//! Data sets for machine learning: frames of a scene with random values for each sample, with
//! ground truth. Each tar file holds a fixed number of samples.
//!
//! A tar file appears complete or not at all, and its index follows. The content of the folder
//! determines the remaining work. A set can therefore be generated in shards, on several machines,
//! and continue after a kill. The bytes depend only on the recipe and the scene.

mod recipe;
mod sample;

use super::journal::checksum;
use super::output_folder::{Names, OutputFolder, remove_unfinished};
use super::shards::{Shard, unfinished};
use super::{RunControl, TraceMode, files, memory_estimate, setup};
use crate::error::input_file::{self, LARGEST_TEXT};
use crate::error::{Error, InputError, Place, Result, printable};
use crate::mesh::memory;
use crate::scene::Scene;
use rayon::prelude::*;
use recipe::Recipe;
use sample::Set;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufWriter, Read, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

/// Content of `samples-NNNNNN.json`: index of one tar file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct TarIndex {
    job: String,
    file: String,
    samples: Range<u64>,
    bytes: u64,
    sha256: String,
}

/// Content of `index.json`: index of the complete set.
#[derive(Serialize)]
struct SetIndex<'a> {
    program: &'static str,
    version: &'static str,
    job: &'a str,
    samples: u64,
    decoders: BTreeMap<&'static str, &'static str>,
    files: Vec<TarIndex>,
}

/// Python expressions that read the files of a sample, by file extension.
const DECODERS: [(&str, &str); 4] = [
    (
        "png",
        "16 bits: numpy.asarray(PIL.Image.open(io.BytesIO(data))), or \
         cv2.imdecode(numpy.frombuffer(data, numpy.uint8), cv2.IMREAD_UNCHANGED). WebDataset's decoders \"l\", \
         \"rgb\" and \"pil\" convert to 8 bits, which clips at 255: do not use them.",
    ),
    ("npz", "numpy.load(io.BytesIO(data))"),
    ("json", "json.loads(data)"),
    ("toml", "tomllib.loads(data.decode())"),
];

/// Summary of a run of `dataset`.
#[derive(Debug, Serialize)]
pub struct DatasetSummary {
    /// Hash of recipe, scene, part, version and numerics. All shards have one value.
    pub job: String,
    /// Number of tar files of this shard.
    pub files: u64,
    /// Number of tar files that this run wrote.
    pub files_made: u64,
    /// Path of the set's index, if the files of all shards exist.
    #[serde(serialize_with = "printable::some_in_json")]
    pub index: Option<PathBuf>,
}

/// Writes the missing tar files of a shard to `out`, and the set's index once all files exist.
/// Memory does not grow with the number of samples.
///
/// Errors: a mistake in recipe or scene, including values at the ends of the distributions; files
/// of another recipe in `out`; too little memory or disk space.
pub fn dataset<'a>(
    path: &Path,
    shard: Shard,
    out: impl Into<OutputFolder<'a>>,
    control: &RunControl,
) -> Result<DatasetSummary> {
    let recipe = Recipe::read(path)?;
    let scene = Scene::load_watched(&recipe.scene, &|_| control.check())?;
    let text = input_file::read_text(&recipe.scene, LARGEST_TEXT, "a scene (TOML)")?;
    memory_estimate::require_images(&scene, rayon::current_num_threads() as u64)?;
    let job = job(&recipe, &scene);
    let files = recipe.samples.div_ceil(recipe.samples_per_file);
    let set = Set {
        text: toml::Value::Table(text.parse().expect("the scene was read from it")),
        base: setup::simulation(&scene, TraceMode::Footprint, control)?,
        recipe: &recipe,
    };
    for (values, end) in recipe.draws.ends().iter().zip(["lower", "upper"]) {
        set.scene(values, 0, &format!("at the {end} ends of [sample]"))?;
    }
    let inputs = [&scene.inputs[..], &[path.to_owned()]].concat();
    let names = names(files);
    let out = out.into().claim(&inputs, &names)?.path;
    let own = (u64::from(shard.shard)..files).step_by(shard.of as usize);
    let (mut done, mut made) = (0, 0);
    for file in own.clone() {
        let samples = file * recipe.samples_per_file
            ..((file + 1) * recipe.samples_per_file).min(recipe.samples);
        let count = samples.end - samples.start;
        let there = match indexed(out, file, &job)? {
            Some(index) => is_sound(out, &index, control)?,
            None => false,
        };
        if !there {
            make(
                &set,
                file,
                samples,
                &job,
                out,
                &|n| (control.progress)(done + n),
                control,
            )?;
            made += 1;
        }
        done += count;
        (control.progress)(done);
    }
    Ok(DatasetSummary {
        files: own.count() as u64,
        files_made: made,
        index: index(&recipe, files, &job, (out, shard), control)?,
        job,
    })
}

/// Returns the names of all files of a set.
fn names(files: u64) -> Names {
    Names::of(["index.json"])
        .and("samples-", 6, ".tar", 0..files)
        .and("samples-", 6, ".json", 0..files)
}

/// Returns the number of samples in a shard of a recipe, for a progress bar.
pub fn dataset_samples(path: &Path, shard: Shard) -> Result<u64> {
    let recipe = Recipe::read(path)?;
    let files = recipe.samples.div_ceil(recipe.samples_per_file);
    let own = (u64::from(shard.shard)..files).step_by(shard.of as usize);
    let count = |file: u64| {
        recipe
            .samples_per_file
            .min(recipe.samples - file * recipe.samples_per_file)
    };
    Ok(own.map(count).sum())
}

fn job(recipe: &Recipe, scene: &Scene) -> String {
    let parts = [
        env!("CARGO_PKG_VERSION"),
        &scene.accel.version(),
        &recipe.written.text,
        &scene.hash,
    ];
    let sum = checksum(parts.join("\n").as_bytes());
    hex(&sum[..8])
}

fn name(file: u64) -> String {
    format!("samples-{file:06}.tar")
}

/// Returns the index of a tar file, if the tar file exists with the stated length. Errors: the
/// index is of another set; an existing file cannot be read.
fn indexed(out: &Path, file: u64, job: &str) -> Result<Option<TarIndex>> {
    let tar = out.join(name(file));
    let path = tar.with_extension("json");
    let not_there = |error: &Error| {
        let kind = io::ErrorKind::NotFound;
        matches!(error, Error::Io { source, .. } if source.kind() == kind)
    };
    let bytes = match input_file::read(&path, LARGEST_TEXT, "the index of a tar file") {
        Err(error) if not_there(&error) => return Ok(None),
        bytes => bytes?,
    };
    let length = match std::fs::metadata(&tar).map_err(Error::io("read", &tar)) {
        Err(error) if not_there(&error) => return Ok(None),
        tar => tar?.len(),
    };
    let index = serde_json::from_slice::<TarIndex>(&bytes).ok();
    let Some(index) = index.filter(|index| index.bytes == length && index.file == name(file))
    else {
        return Ok(None);
    };
    if index.job != job {
        return Err(Error::OtherRun {
            journal: path,
            difference: "recipe, scene, a file it names or the version has changed".to_owned(),
        });
    }
    Ok(Some(index))
}

/// Returns whether a tar file has the SHA-256 in its index.
fn is_sound(out: &Path, index: &TarIndex, control: &RunControl) -> Result<bool> {
    const PIECE: usize = 1 << 22;
    let path = out.join(&index.file);
    let (mut file, _) = input_file::open(&path, "a tar file of samples")?;
    let (mut hash, mut piece) = (Sha256::new(), vec![0; PIECE]);
    loop {
        control.check()?;
        match file.read(&mut piece) {
            Ok(0) => return Ok(hex(&hash.finalize()) == index.sha256),
            Ok(length) => hash.update(&piece[..length]),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(Error::io("read", &path)(error)),
        }
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Writes one tar file and its index.
fn make(
    set: &Set,
    file: u64,
    samples: Range<u64>,
    job: &str,
    out: &Path,
    progress: &(dyn Fn(u64) + Sync),
    control: &RunControl,
) -> Result<()> {
    let path = out.join(name(file));
    // A stale index must not describe a new file.
    files::remove(&path.with_extension("json"))?;
    let (bytes, sha256) = files::write_in_steps(&path, &unfinished(), |file| {
        let mut tar = tar::Builder::new(Summed::new(file));
        let first = samples.start;
        let together = 4 * rayon::current_num_threads() as u64;
        for start in samples.clone().step_by(together as usize) {
            control.check()?;
            let some: Vec<u64> = (start..samples.end.min(start + together)).collect();
            let made = some.par_iter().map(|&k| {
                control.check()?;
                set.sample(k)
            });
            for (k, parts) in some.iter().zip(made.collect::<Result<Vec<_>>>()?) {
                for (ending, content) in parts {
                    append(&mut tar, &format!("{k:09}.{ending}"), &content)
                        .map_err(Error::io("write", &path))?;
                }
                progress(k + 1 - first);
            }
            memory::give_back();
        }
        let summed = tar.into_inner().map_err(Error::io("write", &path))?;
        Ok((summed.bytes, summed.hash.finalize()))
    })?;
    let index = TarIndex {
        job: job.to_owned(),
        file: name(file),
        samples,
        bytes,
        sha256: hex(&sha256),
    };
    write_json(&path.with_extension("json"), &index)
}

/// Writes JSON to a file that several runs may write concurrently.
fn write_json(path: &Path, value: &impl Serialize) -> Result<()> {
    files::write_in_steps(path, &unfinished(), |file| {
        serde_json::to_writer_pretty(&mut *file, value)
            .map_err(|error| Error::io("write", path)(error.into()))
    })
}

/// Appends a file to a tar archive, without time or owner, so that the bytes are reproducible.
fn append<W: Write>(tar: &mut tar::Builder<W>, name: &str, content: &[u8]) -> io::Result<()> {
    let mut header = tar::Header::new_ustar();
    header.set_size(content.len() as u64);
    header.set_mode(0o644);
    tar.append_data(&mut header, name, content)
}

/// Writes the set's index if all its files exist. Files of other shards are checked first.
///
/// # Errors
/// A file of another shard is damaged; a file of this shard is missing.
fn index(
    recipe: &Recipe,
    files: u64,
    job: &str,
    (out, shard): (&Path, Shard),
    control: &RunControl,
) -> Result<Option<PathBuf>> {
    let own = |file: u64| file % u64::from(shard.of) == u64::from(shard.shard);
    let mut found = Vec::new();
    for file in 0..files {
        match indexed(out, file, job)? {
            Some(index) => found.push(index),
            None if own(file) => {
                let path = out.join(name(file));
                let lost = io::Error::other("it, or its index, was lost or changed meanwhile");
                return Err(Error::io("read", &path)(lost));
            }
            None => return Ok(None),
        }
    }
    for (file, index) in found.iter().enumerate() {
        let file = file as u64;
        if !own(file) && !is_sound(out, index, control)? {
            let expected = format!(
                "a file with the SHA-256 of its index; run shard {} of {} again",
                file % u64::from(shard.of),
                shard.of
            );
            let found = "other bytes";
            return Err(
                InputError::new(&out.join(&index.file), Place::File, found, expected).into(),
            );
        }
    }
    let path = out.join("index.json");
    let set = SetIndex {
        program: env!("CARGO_PKG_NAME"),
        version: env!("CARGO_PKG_VERSION"),
        job,
        samples: recipe.samples,
        decoders: DECODERS.into(),
        files: found,
    };
    write_json(&path, &set)?;
    // Removes unfinished files of killed runs.
    remove_unfinished(out, &names(files))?;
    Ok(Some(path))
}

/// Writer that counts and hashes its output.
struct Summed<'a> {
    file: &'a mut BufWriter<File>,
    bytes: u64,
    hash: Sha256,
}

impl<'a> Summed<'a> {
    fn new(file: &'a mut BufWriter<File>) -> Summed<'a> {
        Summed {
            file,
            bytes: 0,
            hash: Sha256::new(),
        }
    }
}

impl Write for Summed<'_> {
    fn write(&mut self, content: &[u8]) -> io::Result<usize> {
        let written = self.file.write(content)?;
        self.hash.update(&content[..written]);
        self.bytes += written as u64;
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}
