//! Common functions for reading the tables of a scene file: value checks and error locations.

use super::data_sheet::{DataSheet, Origin, SolvedSensor, SolvedValue, as_toml};
use super::file::SensorFile;
use super::opencv::take_opencv;
use super::toml_source::TomlSource;
use crate::error::{Error, Result, printable};
use crate::math::DVec3;
use crate::mesh::{self, ProgressFn};
use serde::Deserialize;
use std::cell::RefCell;
use std::io::ErrorKind::{InvalidFilename, InvalidInput, NotADirectory, NotFound};
use std::mem;
use std::path::{Path, PathBuf};

pub(super) struct Resolver<'a> {
    pub(super) source: TomlSource,
    pub(super) path: &'a Path,
    pub(super) watch: &'a ProgressFn<'a>,
    /// Files that the scene names and that were read.
    pub(super) inputs: RefCell<Vec<PathBuf>>,
}

/// Key that is read before the rest of the scene.
#[derive(Deserialize)]
struct SensorKey {
    sensor: Option<String>,
}

#[derive(Deserialize)]
struct SensorTables {
    data_sheet: Option<DataSheet>,
}

impl Resolver<'_> {
    /// Merges the scene with the sensor file it names, and with the values derived from a data
    /// sheet and from OpenCV parameters. The scene has priority over the sensor file, and both over
    /// derived values. Returns the values derived from the data sheet.
    pub(super) fn take_sensor(&mut self) -> Result<SolvedSensor> {
        let (solved, described_in) = self.take_sheet()?;
        self.source = take_opencv(mem::take(&mut self.source), &described_in)?;
        Ok(solved)
    }

    /// Merges the scene with the sensor file and its data sheet. Returns the derived values and the
    /// file that describes the sensor.
    fn take_sheet(&mut self) -> Result<(SolvedSensor, PathBuf)> {
        let mut described_in = self.path.to_owned();
        if let Some(name) = self.source.values::<SensorKey>()?.sensor {
            let what = "the file of a sensor (TOML)";
            let file = self.file(&name, "sensor", what)?;
            let sensor = TomlSource::read(&file)?;
            sensor.values::<SensorFile>()?;
            self.source = mem::take(&mut self.source).overlay(&file, &sensor.text(), false);
            described_in = file;
        }
        let Some(sheet) = self.source.values::<SensorTables>()?.data_sheet else {
            return Ok((SolvedSensor::default(), described_in));
        };
        let solved = sheet
            .solve()
            .map_err(|(key, expected)| self.source.input_error(key, &expected))?;
        let follows = |value: &&SolvedValue| value.origin != Origin::Assumed;
        for SolvedValue { key, value, .. } in solved.values.iter().filter(follows) {
            let expected = format!(
                "no value in addition to [data_sheet], from which it follows as {value}; leave one of the two out"
            );
            let beside = self.source.is_in_base_file(key, "data_sheet");
            self.check(!beside, key, &expected)?;
        }
        let text = as_toml(&solved.values);
        self.source = mem::take(&mut self.source).overlay(&described_in, &text, true);
        Ok((solved, described_in))
    }

    pub(super) fn check(&self, holds: bool, key: &str, expected: &str) -> Result<()> {
        if holds {
            Ok(())
        } else {
            Err(self.source.input_error(key, expected))
        }
    }

    pub(super) fn positive(&self, value: f64, key: &str) -> Result<f64> {
        let holds = value.is_finite() && value > 0.0;
        self.check(holds, key, "a finite number > 0")?;
        self.within(value, key, [1e-12, 1e12])
    }

    /// Checks that a value is from `low` to `high`. The ranges are far wider than practical values,
    /// but products of a few such numbers remain finite and nonzero.
    pub(super) fn within(&self, value: f64, key: &str, [low, high]: [f64; 2]) -> Result<f64> {
        let expected = format!("a number from {low:e} to {high:e}");
        self.check((low..=high).contains(&value), key, &expected)
            .map(|()| value)
    }

    /// Checks lengths (mm) of either sign. The bound keeps products of them finite.
    pub(super) fn lengths<const N: usize>(&self, value: [f64; N], key: &str) -> Result<[f64; N]> {
        // The comparison is false for NaN.
        let holds = value.iter().all(|v| v.abs() <= mesh::MAX_COORDINATE_MM);
        self.check(holds, key, "finite numbers within 1e12 mm")
            .map(|()| value)
    }

    pub(super) fn direction(&self, value: [f64; 3], key: &str) -> Result<DVec3> {
        DVec3::from(value).try_normalize().ok_or_else(|| {
            self.source
                .input_error(key, "a vector of finite length > 0")
        })
    }

    /// Returns the path of the file that `key` names, relative to the scene file. Returns an error
    /// at the key if the file does not exist or is not a regular file, and `Error::Io` if the
    /// system denies access.
    pub(super) fn file(&self, name: &str, key: &str, what: &str) -> Result<PathBuf> {
        self.file_beside(self.path, name, key, what)
    }

    /// Returns the path of the file that `key` names, relative to the file `base`. The errors are
    /// those of [`Self::file`].
    pub(super) fn file_beside(
        &self,
        base: &Path,
        name: &str,
        key: &str,
        what: &str,
    ) -> Result<PathBuf> {
        let own = base.file_name().unwrap_or_default();
        let file = match own.to_string_lossy() == name {
            // A sensor file names itself, even if its name is not UTF-8.
            true => base.to_owned(),
            false => base.parent().unwrap_or(Path::new("")).join(name),
        };
        let shown = printable::path(&file);
        match file.metadata() {
            Ok(kind) if kind.is_file() => {
                self.inputs.borrow_mut().push(file.clone());
                Ok(file)
            }
            Ok(_) => {
                // Reading a pipe or a device may never end.
                let expected = format!("{what}; {shown} is not a regular file");
                Err(self.source.input_error(key, &expected))
            }
            // `InvalidInput` and `InvalidFilename` denote names that no file can have.
            Err(error)
                if matches!(
                    error.kind(),
                    NotFound | NotADirectory | InvalidInput | InvalidFilename
                ) =>
            {
                let mut expected = format!("{what}; there is none at {shown}");
                // The control character may be an escape such as the line feed in C:\new.
                if name.contains(|c: char| c == '\\' || c.is_control()) {
                    expected += "; a backslash does not separate folders, and in double quotes it begins an escape: write /";
                }
                Err(self.source.input_error(key, &expected))
            }
            Err(error) => Err(Error::io("read", &file)(error)),
        }
    }
}
