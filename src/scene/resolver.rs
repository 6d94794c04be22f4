//! What reading every table of a scene file takes: values checked, mistakes placed.

use super::locate::Source;
use crate::error::{Error, Result, printable};
use crate::math::DVec3;
use crate::mesh::{self, Watch};
use std::io::ErrorKind::{InvalidFilename, InvalidInput, NotADirectory, NotFound};
use std::path::{Path, PathBuf};

pub(super) struct Resolver<'a> {
    pub(super) source: Source,
    pub(super) path: &'a Path,
    pub(super) watch: &'a Watch<'a>,
}

impl Resolver<'_> {
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
        let file = self.path.parent().unwrap_or(Path::new("")).join(name);
        let shown = printable::path(&file);
        match file.metadata() {
            Ok(kind) if kind.is_file() => Ok(file),
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
                let expected = format!("{what}; there is none at {shown}");
                Err(self.source.wrong(key, &expected))
            }
            Err(error) => Err(Error::io("read", &file)(error)),
        }
    }
}
