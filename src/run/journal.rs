//! Journal of a scan, `frames.journal`. It holds the finished frames in order, each with its points
//! and the checksum of its image. A killed run can be continued, and a complete run can be checked.
//!
//! ```text
//! file    header, frame, frame, …
//! each    length of the content (u32), CRC-32 of the content (u32), content
//! header  inputs that determine the bytes, as JSON
//! frame   postcard of `FrameRecord`, in full precision
//! ```
//!
//! A record that is truncated by a kill or a full disk, or that has a flipped bit, does not match
//! its CRC. The journal ends before such a record. The file is locked while a run writes. The
//! system releases the lock of a process that dies.

use super::files;
use crate::error::input_file;
use crate::error::{Error, Result};
use crate::inspect::cloud::CloudPoint;
use rayon::prelude::*;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

pub type Checksum = [u8; 32];

pub fn checksum(bytes: &[u8]) -> Checksum {
    Sha256::digest(bytes).into()
}

/// All inputs that determine the output bytes of a run. The scene hash covers the scene file and
/// all files it names. Thread count and trace mode do not change the output.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunKey {
    pub version: String,
    pub accel: String,
    pub scene_sha256: String,
    pub seed: u64,
    pub frames: Range<u32>,
    pub geometry_only: bool,
    /// Rung of the ladder that the tolerance of the scene requires; `None` without a tolerance.
    pub rung: Option<String>,
}

impl RunKey {
    /// Returns a short name of the key: the first 8 bytes of its SHA-256 in hexadecimal.
    pub fn job(&self) -> String {
        let sum = checksum(&serde_json::to_vec(self).expect("a key is JSON"));
        sum[..8].iter().map(|byte| format!("{byte:02x}")).collect()
    }

    /// Returns a description of the first difference, for the user.
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
            () if old.rung != self.rung => {
                let [old, new] = [old, self].map(|key| key.rung.as_deref().unwrap_or("none"));
                differ("the method for the tolerance", &old, &new)
            }
            () => None,
        }
    }
}

/// A finished frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FrameRecord {
    pub frame: u32,
    /// Checksum of the image file; `None` without an image.
    pub image: Option<Checksum>,
    /// Number of points whose blur is wider than two standard deviations of their line.
    pub blurred: u32,
    pub points: Vec<CloudPoint>,
}

impl Record for FrameRecord {
    /// Returns whether all numbers are finite and all points belong to this frame.
    fn is_sound(&self) -> bool {
        self.points.iter().all(|point| {
            let numbers = [
                point.deviation,
                point.u_position,
                point.repeatability,
                point.correlation_length,
                point.scan_correlation_length,
                point.u_deviation,
                point.intensity,
                point.row,
                point.line_sigma_px,
                f64::from(point.direct_fraction),
            ];
            point.frame == self.frame
                && point.position.is_finite()
                && point.normal.is_finite()
                && numbers.iter().all(|number| number.is_finite())
        })
    }
}

/// A record of a journal, which follows the header.
pub trait Record: Serialize + DeserializeOwned + Sync {
    /// Returns whether a run may have written the record. The checksum cannot show this.
    fn is_sound(&self) -> bool;

    /// Decodes a record. Returns `None` if the content is not a record or is not sound.
    fn read(content: &[u8]) -> Option<Self> {
        let record = postcard::from_bytes::<Self>(content).ok();
        record.filter(Record::is_sound)
    }
}

pub struct Journal {
    file: File,
    path: PathBuf,
    synced: Instant,
}

/// Minimum interval between syncs. Synced frames survive a loss of power.
const SYNC: Duration = Duration::from_secs(10);

impl Journal {
    /// Opens the journal in `out` for one run only. With `resume`, returns the number of frames it
    /// holds; otherwise starts a new journal. `prepare` is called with that number before the
    /// journal changes.
    ///
    /// # Errors
    /// `Error::Busy` if another run writes to `out`; with `resume`, `Error::OtherRun` if the frames
    /// belong to another scene, seed, range or version.
    pub fn open(
        out: &Path,
        key: &RunKey,
        resume: bool,
        prepare: impl FnOnce(u32) -> Result<()>,
    ) -> Result<(Journal, u32)> {
        let mut journal = Journal::locked(out)?;
        let (kept, end) = match resume {
            true => journal.check(key)?,
            false => (0, 0),
        };
        prepare(kept)?;
        if end == 0 {
            return Ok((journal.replaced(key, |_| Ok(()))?, 0));
        }
        let cut = |file: &mut File| {
            file.set_len(end)?;
            file.seek(SeekFrom::Start(end)).map(drop)
        };
        cut(&mut journal.file).map_err(Error::io("write", &journal.path))?;
        Ok((journal, kept))
    }

    /// Writes a journal of the records that `fill` appends. The new journal replaces the one in
    /// `out` when it is complete. `prepare` is called first.
    pub fn make(
        out: &Path,
        key: &RunKey,
        prepare: impl FnOnce() -> Result<()>,
        fill: impl FnOnce(&mut Journal) -> Result<()>,
    ) -> Result<()> {
        let journal = Journal::locked(out)?;
        prepare()?;
        journal.replaced(key, fill).map(drop)
    }

    /// Opens and locks the journal in `out` without changing it.
    fn locked(out: &Path) -> Result<Journal> {
        let path = out.join("frames.journal");
        loop {
            let file = files::open_own_file(&path).map_err(Error::io("open", &path))?;
            if !files::lock(&file).map_err(Error::io("lock", &path))? {
                return Err(Error::Busy(out.to_owned()));
            }
            // Another run may have replaced the file before the lock.
            if files::is_at(&file, &path) {
                return Ok(Journal {
                    file,
                    path,
                    synced: Instant::now(),
                });
            }
        }
    }

    /// Replaces this journal by a new one. This journal stays locked until then.
    fn replaced(
        self,
        key: &RunKey,
        fill: impl FnOnce(&mut Journal) -> Result<()>,
    ) -> Result<Journal> {
        Journal::written(&self.path, files::PART, key, fill)
    }

    /// Writes a journal under a name that ends in `part`, and renames it when `fill` returns. On an
    /// error the unfinished file is removed.
    pub fn written(
        path: &Path,
        part: &str,
        header: &impl Serialize,
        fill: impl FnOnce(&mut Journal) -> Result<()>,
    ) -> Result<Journal> {
        let part = files::unfinished(path, part);
        let written = Journal::begin(&part, header).and_then(|mut journal| {
            journal.path = path.to_owned();
            fill(&mut journal)?;
            journal.sync()?;
            files::rename(&journal.file, &part, path)
                .and_then(|()| files::sync_folder_of(path))
                .map_err(Error::io("write", path))?;
            Ok(journal)
        });
        if written.is_err() {
            // Best effort, because the first error is the one to report.
            let _ = files::remove(&part);
        }
        written
    }

    /// Creates a journal at `path` and replaces an existing file.
    pub fn begin(path: &Path, header: &impl Serialize) -> Result<Journal> {
        let mut journal = Journal {
            file: files::create_locked(path).map_err(Error::io("write", path))?,
            path: path.to_owned(),
            synced: Instant::now(),
        };
        let header = serde_json::to_vec(header).expect("a key is JSON");
        journal.write(&framed(&header))?;
        Ok(journal)
    }

    /// Reads the existing records of the run. Returns the number of valid frames and their length
    /// in bytes.
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
            match FrameRecord::read(&content) {
                Some(record)
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

    fn reader(&self) -> io::Result<RecordReader<&File>> {
        let mut file = &self.file;
        file.seek(SeekFrom::Start(0))?;
        RecordReader::new(file, file.metadata()?.len())
    }

    /// Appends the next records.
    pub fn append(&mut self, records: &[impl Record]) -> Result<()> {
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

    /// Waits until the appended records are on the disk.
    pub fn sync(&mut self) -> Result<()> {
        self.synced = Instant::now();
        self.file
            .sync_data()
            .map_err(Error::io("write", &self.path))
    }

    /// Calls `then` with each frame in the journal, in order.
    pub fn each(&mut self, mut then: impl FnMut(FrameRecord) -> Result<()>) -> Result<()> {
        let failed = || Error::io("read", &self.path);
        let mut reader = self.reader().map_err(failed())?;
        reader.next().map_err(failed())?;
        while let Some(content) = reader.next().map_err(failed())? {
            let wrong = || failed()(io::Error::other("a record that no run wrote"));
            then(FrameRecord::read(&content).ok_or_else(wrong)?)?;
        }
        // New records are appended at the end.
        let end = self.file.seek(SeekFrom::End(0));
        end.map(drop).map_err(Error::io("read", &self.path))
    }
}

/// Returns the content with its length and CRC in front.
fn framed(content: &[u8]) -> Vec<u8> {
    let length = u32::try_from(content.len()).expect("a frame has no 4 GB of points");
    let head = [length, crc32fast::hash(content)].map(u32::to_le_bytes);
    [head.as_flattened(), content].concat()
}

/// Iterator over the records of a journal, up to its end or first damage.
pub struct Records {
    reader: RecordReader<File>,
    path: PathBuf,
}

impl Records {
    pub fn open(path: &Path) -> Result<Records> {
        let (file, kind) = input_file::open(path, "a journal of finished frames")?;
        Ok(Records {
            reader: RecordReader::new(file, kind.len()).map_err(Error::io("read", path))?,
            path: path.to_owned(),
        })
    }

    /// Returns the header; `None` if the first record is not a header.
    pub fn header<T: DeserializeOwned>(&mut self) -> Result<Option<T>> {
        let content = self.content()?;
        Ok(content.and_then(|content| serde_json::from_slice(&content).ok()))
    }

    /// Returns the next record; `None` at the end of the file or at a damaged record.
    pub fn next<T: Record>(&mut self) -> Result<Option<T>> {
        let content = self.content()?;
        Ok(content.and_then(|content| T::read(&content)))
    }

    fn content(&mut self) -> Result<Option<Vec<u8>>> {
        self.reader.next().map_err(Error::io("read", &self.path))
    }

    /// Returns whether all bytes of the file were valid.
    pub fn at_end(&self) -> bool {
        self.reader.left == 0
    }
}

struct RecordReader<F> {
    file: BufReader<F>,
    at: u64,
    left: u64,
}

impl<F: Read> RecordReader<F> {
    /// Creates a reader of a file at its beginning; `length` is the file length in bytes.
    fn new(file: F, length: u64) -> io::Result<RecordReader<F>> {
        Ok(RecordReader {
            file: BufReader::with_capacity(1 << 16, file),
            at: 0,
            left: length,
        })
    }

    /// Returns the next content; `None` at the end of the file or at damage.
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
        // A damaged length must not exceed the remaining bytes.
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
            rung: None,
        }
    }

    fn record(frame: u32) -> FrameRecord {
        let point = CloudPoint {
            position: DVec3::new(1.0 / 3.0, 1e-300, -7.0),
            deviation: 0.1,
            u_position: 0.02,
            u_deviation: 0.01,
            repeatability: 0.005,
            correlation_length: 0.1,
            scan_correlation_length: 0.1,
            intensity: 200.5,
            frame,
            column: 9,
            row: 31.25,
            line_sigma_px: 1.5,
            flags: crate::profile::Flags::DISCONTINUITY,
            normal: glam::Vec3::Z,
            direct_fraction: 1.0,
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

    /// Writes a journal of frames 3, 4 and 5 and returns its bytes.
    fn written(out: &Path) -> Vec<u8> {
        let (mut journal, kept) = Journal::open(out, &key(), false, |_| Ok(())).unwrap();
        assert_eq!(kept, 0);
        journal.append(&[record(3), record(4)]).unwrap();
        journal.append(&[record(5)]).unwrap();
        fs::read(out.join("frames.journal")).unwrap()
    }

    #[test]
    fn what_was_written_is_read_to_the_bit_and_continued() {
        let folder = tempfile::tempdir().unwrap();
        written(folder.path());
        let (mut journal, kept) = Journal::open(folder.path(), &key(), true, |_| Ok(())).unwrap();
        assert_eq!(kept, 3);
        assert_eq!(records(&mut journal), [3, 4, 5].map(record));
        journal.append(&[record(6)]).unwrap();
        assert_eq!(records(&mut journal), [3, 4, 5, 6].map(record));
    }

    /// If any byte is lost or flipped, only the complete frames before it remain valid.
    #[test]
    fn no_damaged_record_is_ever_kept() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("frames.journal");
        let whole = written(folder.path());
        let open = |bytes: &[u8]| {
            fs::write(&path, bytes).unwrap();
            let (mut journal, kept) =
                Journal::open(folder.path(), &key(), true, |_| Ok(())).unwrap();
            assert!(kept < 3 || bytes.starts_with(&whole));
            assert!(
                records(&mut journal)
                    .into_iter()
                    .eq((3..3 + kept).map(record))
            );
            drop(journal);
            // The remaining file is a journal that can be continued.
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

    /// Records with a correct checksum but with numbers that no run writes.
    #[test]
    fn records_of_numbers_that_are_not_finite_are_not_kept() {
        let changes: [fn(&mut CloudPoint, f64); 14] = [
            |point, x| point.position.x = x,
            |point, x| point.position.y = x,
            |point, x| point.position.z = x,
            |point, x| point.deviation = x,
            |point, x| point.u_position = x,
            |point, x| point.repeatability = x,
            |point, x| point.correlation_length = x,
            |point, x| point.scan_correlation_length = x,
            |point, x| point.u_deviation = x,
            |point, x| point.intensity = x,
            |point, x| point.row = x,
            |point, x| point.line_sigma_px = x,
            |point, x| point.normal.y = x as f32,
            |point, x| point.direct_fraction = x as f32,
        ];
        let folder = tempfile::tempdir().unwrap();
        for (i, change) in changes.iter().enumerate() {
            for x in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
                let mut forged = record(4);
                change(&mut forged.points[i % 4], x);
                let fill = |journal: &mut Journal| journal.append(&[record(3), forged, record(5)]);
                Journal::make(folder.path(), &key(), || Ok(()), fill).unwrap();
                let opened = Journal::open(folder.path(), &key(), true, |_| Ok(()));
                assert_eq!(opened.unwrap().1, 1, "{i} {x}");
            }
        }
        let mut forged = record(4);
        forged.points[2].frame = 7;
        assert!(!forged.is_sound() && record(4).is_sound());
    }

    /// The old journal stays unchanged until the new one is complete. A failed replacement leaves
    /// no file.
    #[test]
    fn a_journal_is_replaced_by_a_whole_one() {
        let folder = tempfile::tempdir().unwrap();
        let whole = written(folder.path());
        let names = || files::names_in(folder.path()).unwrap();
        let made = Journal::make(
            folder.path(),
            &key(),
            || Ok(()),
            |journal| {
                journal.append(&[record(3)])?;
                assert_eq!(
                    fs::read(folder.path().join("frames.journal")).unwrap(),
                    whole
                );
                Err(Error::Interrupted)
            },
        );
        assert!(matches!(made, Err(Error::Interrupted)));
        assert_eq!(names(), ["frames.journal"]);
        assert_eq!(
            fs::read(folder.path().join("frames.journal")).unwrap(),
            whole
        );
        let fill = |journal: &mut Journal| journal.append(&[record(3)]);
        Journal::make(folder.path(), &key(), || Ok(()), fill).unwrap();
        let (mut journal, kept) = Journal::open(folder.path(), &key(), true, |_| Ok(())).unwrap();
        assert_eq!((kept, records(&mut journal)), (1, vec![record(3)]));
        assert_eq!(names(), ["frames.journal"]);
    }

    #[test]
    fn a_journal_of_another_run_is_refused_and_says_why() {
        let folder = tempfile::tempdir().unwrap();
        let whole = written(folder.path());
        let other = |change: fn(&mut RunKey)| {
            let mut key = key();
            change(&mut key);
            let error = Journal::open(folder.path(), &key, true, |_| Ok(()))
                .err()
                .unwrap();
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
            (
                other(|k| k.rung = Some("coarse".into())),
                "the method for the tolerance was \"none\" and is \"coarse\"",
            ),
        ] {
            assert!(message.contains(words), "{message}");
        }
        let left = fs::read(folder.path().join("frames.journal")).unwrap();
        assert_eq!(left, whole, "a refusal changes nothing");
    }

    #[test]
    fn a_second_run_is_refused_until_the_first_is_over() {
        let folder = tempfile::tempdir().unwrap();
        let first = Journal::open(folder.path(), &key(), false, |_| Ok(())).unwrap();
        for resume in [false, true] {
            let error = Journal::open(folder.path(), &key(), resume, |_| Ok(()))
                .err()
                .unwrap();
            assert_eq!(error.exit_code(), 75);
            assert!(error.to_string().contains("another run"), "{error}");
        }
        drop(first);
        assert!(Journal::open(folder.path(), &key(), true, |_| Ok(())).is_ok());
    }
}
