//! The journal of a scan, `frames.journal`: the finished frames in their order,
//! each with its points and the checksum of its image, so that a run that was
//! killed can go on and one that is whole can be checked.
//!
//! ```text
//! file    header, frame, frame, …
//! each    length of the content (u32), CRC-32 of the content (u32), content
//! header  what the bytes depend on, as JSON
//! frame   postcard of `FrameRecord`, in full precision
//! ```
//!
//! What a kill or a full disk left of a record, or a flipped bit made of it, does
//! not match its CRC, and the journal ends before it. The file is locked while
//! a run writes; the system drops the lock of a process that dies.

use super::files;
use crate::error::{Error, Result};
use crate::inspect::cloud::CloudPoint;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::fs::{File, TryLockError};
use std::io::{self, BufReader, Read, Seek, SeekFrom, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

pub type Checksum = [u8; 32];

pub fn checksum(bytes: &[u8]) -> Checksum {
    Sha256::digest(bytes).into()
}

/// Everything the bytes of a run depend on. The scene's hash is that of its file
/// and of the files it names; threads and coverage change no byte.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunKey {
    pub version: String,
    pub accel: String,
    pub scene_sha256: String,
    pub seed: u64,
    pub frames: Range<u32>,
    pub geometry_only: bool,
}

impl RunKey {
    /// A short name of it: the first of the SHA-256 of all of it.
    pub fn job(&self) -> String {
        let sum = checksum(&serde_json::to_vec(self).expect("a key is JSON"));
        sum[..8].iter().map(|byte| format!("{byte:02x}")).collect()
    }

    /// What differs, in the user's words.
    pub fn difference(&self, old: &RunKey) -> Option<String> {
        let differ = |what: &str, old: &dyn std::fmt::Debug, new: &dyn std::fmt::Debug| {
            Some(format!("{what} was {old:?} and is {new:?}"))
        };
        match () {
            () if old.version != self.version => differ("version", &old.version, &self.version),
            () if old.accel != self.accel => {
                differ("the intersection library", &old.accel, &self.accel)
            }
            () if old.scene_sha256 != self.scene_sha256 => {
                Some("the scene or a file it names has changed".into())
            }
            () if old.seed != self.seed => differ("seed", &old.seed, &self.seed),
            () if old.frames != self.frames => differ("frames", &old.frames, &self.frames),
            () if old.geometry_only != self.geometry_only => {
                differ("geometry alone", &old.geometry_only, &self.geometry_only)
            }
            () => None,
        }
    }
}

/// A finished frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FrameRecord {
    pub frame: u32,
    /// Of the image's file; `None` if there is none.
    pub image: Option<Checksum>,
    /// Points whose blur is wider than two standard deviations of their line.
    pub blurred: u32,
    pub points: Vec<CloudPoint>,
}

pub struct Journal {
    file: File,
    path: PathBuf,
    synced: Instant,
}

/// Time after which frames are safe from a loss of power.
const SYNC: Duration = Duration::from_secs(10);

impl Journal {
    /// Opens the journal in `out` for one run alone, and with `resume` says how many frames
    /// are in it; else it starts anew.
    ///
    /// Errors: another run writes there; with `resume`, frames of another scene,
    /// seed, range or version.
    pub fn open(out: &Path, key: &RunKey, resume: bool) -> Result<(Journal, u32)> {
        let path = out.join("frames.journal");
        let file = files::open_own_file(&path).map_err(Error::io("open", &path))?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Err(Error::Busy(out.to_owned())),
            // Some network file systems have no locks.
            Err(TryLockError::Error(e)) if e.kind() == io::ErrorKind::Unsupported => {}
            Err(TryLockError::Error(e)) => return Err(Error::io("lock", &path)(e)),
        }
        let mut journal = Journal {
            file,
            path,
            synced: Instant::now(),
        };
        let (mut kept, mut end) = (0, 0);
        if resume {
            (kept, end) = journal.check(key)?;
        }
        let cut = |file: &mut File| {
            file.set_len(end)?;
            file.seek(SeekFrom::Start(end)).map(drop)
        };
        cut(&mut journal.file).map_err(Error::io("write", &journal.path))?;
        if end == 0 {
            let header = serde_json::to_vec(key).expect("a key is JSON");
            journal.write(&framed(&header))?;
        }
        Ok((journal, kept))
    }

    /// A new journal at `path`, whatever was there.
    pub fn begin(path: &Path, header: &impl Serialize) -> Result<Journal> {
        let file = files::open_own_file(path).map_err(Error::io("open", path))?;
        file.set_len(0).map_err(Error::io("write", path))?;
        let mut journal = Journal {
            file,
            path: path.to_owned(),
            synced: Instant::now(),
        };
        let header = serde_json::to_vec(header).expect("a key is JSON");
        journal.write(&framed(&header))?;
        Ok(journal)
    }

    /// Reads what there is of the run; how many frames and how many bytes of the file are of use.
    fn check(&self, key: &RunKey) -> Result<(u32, u64)> {
        let failed = || Error::io("read", &self.path);
        let mut reader = self.reader().map_err(failed())?;
        let header = reader.next().map_err(failed())?;
        let Some(old) = header.and_then(|h| serde_json::from_slice::<RunKey>(&h).ok()) else {
            return Ok((0, 0));
        };
        if let Some(difference) = key.difference(&old) {
            return Err(Error::OtherRun {
                journal: self.path.clone(),
                difference,
            });
        }
        let (mut kept, mut end) = (0, reader.at);
        while let Some(content) = reader.next().map_err(failed())? {
            let expected = u64::from(key.frames.start) + u64::from(kept);
            match postcard::from_bytes::<FrameRecord>(&content) {
                Ok(record)
                    if u64::from(record.frame) == expected && record.frame < key.frames.end =>
                {
                    kept += 1;
                }
                _ => break,
            }
            end = reader.at;
        }
        Ok((kept, end))
    }

    fn reader(&self) -> io::Result<Reader<&File>> {
        let mut file = &self.file;
        file.seek(SeekFrom::Start(0))?;
        Reader::new(file, file.metadata()?.len())
    }

    /// Adds the next records.
    pub fn append(&mut self, records: &[impl Serialize + Sync]) -> Result<()> {
        let content = |record| postcard::to_allocvec(record).expect("a record has a length");
        let records = records.par_iter().map(|record| framed(&content(record)));
        for bytes in records.collect::<Vec<_>>() {
            self.write(&bytes)?;
        }
        if self.synced.elapsed() > SYNC {
            self.sync()?;
        }
        Ok(())
    }

    fn write(&mut self, bytes: &[u8]) -> Result<()> {
        self.file
            .write_all(bytes)
            .map_err(Error::io("write", &self.path))
    }

    /// Waits until what was appended is on the disk.
    pub fn sync(&mut self) -> Result<()> {
        self.synced = Instant::now();
        self.file
            .sync_data()
            .map_err(Error::io("write", &self.path))
    }

    /// Calls `then` with all frames in the journal, one by one.
    pub fn each(&mut self, mut then: impl FnMut(FrameRecord) -> Result<()>) -> Result<()> {
        let failed = || Error::io("read", &self.path);
        let mut reader = self.reader().map_err(failed())?;
        reader.next().map_err(failed())?;
        while let Some(content) = reader.next().map_err(failed())? {
            let record = postcard::from_bytes::<FrameRecord>(&content).map_err(io::Error::other);
            then(record.map_err(failed())?)?;
        }
        // What is added comes at the end.
        let end = self.file.seek(SeekFrom::End(0));
        end.map(drop).map_err(Error::io("read", &self.path))
    }
}

/// Content as it stands in the file.
fn framed(content: &[u8]) -> Vec<u8> {
    let length = u32::try_from(content.len()).expect("a frame has no 4 GB of points");
    let head = [length, crc32fast::hash(content)].map(u32::to_le_bytes);
    [head.as_flattened(), content].concat()
}

/// The records of a journal, one by one, as far as it is written.
pub struct Records {
    reader: Reader<File>,
    path: PathBuf,
}

impl Records {
    pub fn open(path: &Path) -> Result<Records> {
        let open = || -> io::Result<_> {
            let file = File::open(path)?;
            let length = file.metadata()?.len();
            Reader::new(file, length)
        };
        Ok(Records {
            reader: open().map_err(Error::io("open", path))?,
            path: path.to_owned(),
        })
    }

    /// The first record; `None` where it is none.
    pub fn header<T: serde::de::DeserializeOwned>(&mut self) -> Result<Option<T>> {
        let content = self.content()?;
        Ok(content.and_then(|content| serde_json::from_slice(&content).ok()))
    }

    /// The next record; `None` where the file ends or is damaged.
    pub fn next<T: serde::de::DeserializeOwned>(&mut self) -> Result<Option<T>> {
        let content = self.content()?;
        Ok(content.and_then(|content| postcard::from_bytes(&content).ok()))
    }

    fn content(&mut self) -> Result<Option<Vec<u8>>> {
        self.reader.next().map_err(Error::io("read", &self.path))
    }

    /// Whether all bytes of the file were of use.
    pub fn at_end(&self) -> bool {
        self.reader.left == 0
    }
}

struct Reader<F> {
    file: BufReader<F>,
    at: u64,
    left: u64,
}

impl<F: Read> Reader<F> {
    /// Of a file at its beginning, and its length.
    fn new(file: F, length: u64) -> io::Result<Reader<F>> {
        Ok(Reader {
            file: BufReader::with_capacity(1 << 16, file),
            at: 0,
            left: length,
        })
    }

    /// The next content; `None` where the file ends or is damaged.
    fn next(&mut self) -> io::Result<Option<Vec<u8>>> {
        const HEAD: usize = 4 + 4;
        if self.left < HEAD as u64 {
            return Ok(None);
        }
        let mut head = [0; HEAD];
        self.file.read_exact(&mut head)?;
        let [length, sum] = [0, 4]
            .map(|at| u32::from_le_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]));
        let length = u64::from(length);
        // A damaged length must not ask for more than there is.
        if length > self.left - HEAD as u64 {
            return Ok(None);
        }
        let mut content = vec![0; length as usize];
        self.file.read_exact(&mut content)?;
        if crc32fast::hash(&content) != sum {
            return Ok(None);
        }
        self.at += HEAD as u64 + length;
        self.left -= HEAD as u64 + length;
        Ok(Some(content))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::DVec3;
    use std::fs;

    fn key() -> RunKey {
        RunKey {
            version: "1".into(),
            accel: "4".into(),
            scene_sha256: "ab".into(),
            seed: 7,
            frames: 3..8,
            geometry_only: false,
        }
    }

    fn record(frame: u32) -> FrameRecord {
        let point = CloudPoint {
            position: DVec3::new(1.0 / 3.0, 1e-300, -7.0),
            deviation: 0.1,
            sigma: 0.02,
            deviation_sigma: 0.01,
            repeatability: 0.005,
            correlation_length: 0.1,
            scan_correlation_length: 0.1,
            intensity: 200.5,
            frame,
            column: 9,
            row: 31.25,
            width: 1.5,
            flags: crate::profile::Flags::EDGE,
            normal: glam::Vec3::Z,
            direct: 1.0,
        };
        FrameRecord {
            frame,
            image: Some(checksum(&frame.to_le_bytes())),
            blurred: frame,
            points: vec![point; frame as usize],
        }
    }

    fn records(journal: &mut Journal) -> Vec<FrameRecord> {
        let mut all = Vec::new();
        let each = journal.each(|record| {
            all.push(record);
            Ok(())
        });
        each.unwrap();
        all
    }

    /// A journal of frames 3, 4 and 5, and its bytes.
    fn written(out: &Path) -> Vec<u8> {
        let (mut journal, kept) = Journal::open(out, &key(), false).unwrap();
        assert_eq!(kept, 0);
        journal.append(&[record(3), record(4)]).unwrap();
        journal.append(&[record(5)]).unwrap();
        fs::read(out.join("frames.journal")).unwrap()
    }

    #[test]
    fn what_was_written_is_read_to_the_bit_and_continued() {
        let folder = tempfile::tempdir().unwrap();
        written(folder.path());
        let (mut journal, kept) = Journal::open(folder.path(), &key(), true).unwrap();
        assert_eq!(kept, 3);
        assert_eq!(records(&mut journal), [3, 4, 5].map(record));
        journal.append(&[record(6)]).unwrap();
        assert_eq!(records(&mut journal), [3, 4, 5, 6].map(record));
    }

    /// Whatever byte is lost or flipped, only whole frames before it are kept.
    #[test]
    fn no_damaged_record_is_ever_kept() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("frames.journal");
        let whole = written(folder.path());
        let open = |bytes: &[u8]| {
            fs::write(&path, bytes).unwrap();
            let (mut journal, kept) = Journal::open(folder.path(), &key(), true).unwrap();
            assert!(kept < 3 || bytes.starts_with(&whole));
            assert!(
                records(&mut journal)
                    .into_iter()
                    .eq((3..3 + kept).map(record))
            );
            drop(journal);
            // What is left is a journal that can be continued.
            let left = fs::read(&path).unwrap();
            assert!(whole.starts_with(&left));
            kept
        };
        let mut lengths = Vec::new();
        for length in 0..whole.len() {
            lengths.push(open(&whole[..length]));
            let mut flipped = whole.clone();
            flipped[length] ^= 1 << (length % 8);
            open(&flipped);
        }
        assert!(
            lengths.is_sorted() && lengths[whole.len() - 1] == 2,
            "{lengths:?}"
        );
        assert_eq!(open(&[&whole[..], b"more"].concat()), 3);
    }

    #[test]
    fn a_journal_of_another_run_is_refused_and_says_why() {
        let folder = tempfile::tempdir().unwrap();
        let whole = written(folder.path());
        let other = |change: fn(&mut RunKey)| {
            let mut key = key();
            change(&mut key);
            let error = Journal::open(folder.path(), &key, true).err().unwrap();
            assert_eq!(error.exit_code(), 64);
            error.to_string()
        };
        for (message, words) in [
            (
                other(|k| k.version = "2".into()),
                "version was \"1\" and is \"2\"",
            ),
            (
                other(|k| k.accel = "3".into()),
                "the intersection library was \"4\" and is \"3\"",
            ),
            (
                other(|k| k.scene_sha256 = "cd".into()),
                "the scene or a file it names has changed",
            ),
            (other(|k| k.seed = 8), "seed was 7 and is 8"),
            (other(|k| k.frames = 3..9), "frames was 3..8 and is 3..9"),
        ] {
            assert!(message.contains(words), "{message}");
        }
        let left = fs::read(folder.path().join("frames.journal")).unwrap();
        assert_eq!(left, whole, "a refusal changes nothing");
    }

    #[test]
    fn a_second_run_is_refused_until_the_first_is_over() {
        let folder = tempfile::tempdir().unwrap();
        let first = Journal::open(folder.path(), &key(), false).unwrap();
        for resume in [false, true] {
            let error = Journal::open(folder.path(), &key(), resume).err().unwrap();
            assert_eq!(error.exit_code(), 75);
            assert!(error.to_string().contains("another run"), "{error}");
        }
        drop(first);
        assert!(Journal::open(folder.path(), &key(), true).is_ok());
    }
}
