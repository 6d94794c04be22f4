//! What reading every table of a scene file takes: values checked, mistakes placed.

use super::data_sheet::{DataSheet, Origin, SolvedValue, as_toml};
use super::file::SensorFile;
use super::locate::Source;
use crate::error::{Error, Result, printable};
use crate::math::DVec3;
use crate::mesh::{self, Watch};
use serde::Deserialize;
use std::cell::RefCell;
use std::io::ErrorKind::{InvalidFilename, InvalidInput, NotADirectory, NotFound};
use std::mem;
use std::path::{Path, PathBuf};

pub(super) struct Resolver<'a> {
    pub(super) source: Source,
    pub(super) path: &'a Path,
    pub(super) watch: &'a Watch<'a>,
    /// Files that the scene names and that were read.
    pub(super) inputs: RefCell<Vec<PathBuf>>,
}

/// What is read of a scene before the rest.
#[derive(Deserialize)]
struct Named {
    sensor: Option<String>,
}

#[derive(Deserialize)]
struct Described {
    data_sheet: Option<DataSheet>,
}

impl Resolver<'_> {
    /// Lays the scene over the sensor it names, and both over what follows from a data sheet, which is given.
    pub(super) fn take_sensor(&mut self) -> Result<Vec<SolvedValue>> {
        let mut described_in = self.path.to_owned();
        if let Some(name) = self.source.values::<Named>()?.sensor {
            let what = "the file of a sensor (TOML)";
            let file = self.file(&name, "sensor", what)?;
            let sensor = Source::read(&file)?;
            sensor.values::<SensorFile>()?;
            self.source = mem::take(&mut self.source).over(&file, &sensor.text(), false);
            described_in = file;
        }
        let Some(sheet) = self.source.values::<Described>()?.data_sheet else {
            return Ok(Vec::new());
        };
        let solved = sheet
            .solve()
            .map_err(|(key, expected)| self.source.wrong(key, &expected))?;
        let follows = |value: &&SolvedValue| value.origin != Origin::Assumed;
        for SolvedValue { key, value, .. } in solved.iter().filter(follows) {
            let expected = format!(
                "nothing beside [data_sheet], from which it follows as {value}; leave one of the two out"
            );
            let beside = self.source.beside(key, "data_sheet");
            self.check(!beside, key, &expected)?;
        }
        let text = as_toml(&solved);
        self.source = mem::take(&mut self.source).over(&described_in, &text, true);
        Ok(solved)
    }

    pub(super) fn check(&self, holds: bool, key: &str, expected: &str) -> Result<()> {
        if holds {
            Ok(())
        } else {
            Err(self.source.wrong(key, expected))
        }
    }

    pub(super) fn positive(&self, value: f64, key: &str) -> Result<f64> {
        let holds = value.is_finite() && value > 0.0;
        self.check(holds, key, "a finite number > 0")?;
        self.within(value, key, [1e-12, 1e12])
    }

    /// Far beyond what is sensible, but near enough that no product of a few such
    /// numbers is infinite, or zero for rounding.
    pub(super) fn within(&self, value: f64, key: &str, [low, high]: [f64; 2]) -> Result<f64> {
        let expected = format!("a number from {low:e} to {high:e}");
        self.check((low..=high).contains(&value), key, &expected)
            .map(|()| value)
    }

    /// Lengths (mm) of either sign. The bound keeps their products finite.
    pub(super) fn lengths<const N: usize>(&self, value: [f64; N], key: &str) -> Result<[f64; N]> {
        // Written so that NaN fails.
        let holds = value.iter().all(|v| v.abs() <= mesh::LARGEST_MM);
        self.check(holds, key, "finite numbers within 1e12 mm")
            .map(|()| value)
    }

    pub(super) fn direction(&self, value: [f64; 3], key: &str) -> Result<DVec3> {
        DVec3::from(value)
            .try_normalize()
            .ok_or_else(|| self.source.wrong(key, "a vector of finite length > 0"))
    }

    /// The file `key` names, relative to the scene file. Errors: there is none, or it is
    /// no regular file, at the key; `Error::Io` where the system does not let it be found.
    pub(super) fn file(&self, name: &str, key: &str, what: &str) -> Result<PathBuf> {
        let own = self.path.file_name().unwrap_or_default();
        let file = match own.to_string_lossy() == name {
            // A sensor's file names itself, also where its name is not UTF-8.
            true => self.path.to_owned(),
            false => self.path.parent().unwrap_or(Path::new("")).join(name),
        };
        let shown = printable::path(&file);
        match file.metadata() {
            Ok(kind) if kind.is_file() => {
                self.inputs.borrow_mut().push(file.clone());
                Ok(file)
            }
            Ok(_) => {
                // A pipe or a device may never end.
                let expected = format!("{what}; {shown} is not a regular file");
                Err(self.source.wrong(key, &expected))
            }
            // Of the last two are names that no file can have.
            Err(error)
                if matches!(
                    error.kind(),
                    NotFound | NotADirectory | InvalidInput | InvalidFilename
                ) =>
            {
                let mut expected = format!("{what}; there is none at {shown}");
                // A backslash, or the line feed that an escape became: C:\new.
                if name.contains(|c: char| c == '\\' || c.is_control()) {
                    expected += "; a backslash does not separate folders, and in double quotes it begins an escape: write /";
                }
                Err(self.source.wrong(key, &expected))
            }
            Err(error) => Err(Error::io("read", &file)(error)),
        }
    }
}
