//! The error type of the library. An error in user input names the file, the location, the key, the
//! value found and the value expected. Bugs are assertions instead.

pub mod input_file;
pub mod printable;

use printable::{path, short};
use std::fmt;
use std::path::{Path, PathBuf};

/// Result of a fallible function of this library.
pub type Result<T> = std::result::Result<T, Error>;

/// Location of an error in an input file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// Line number, starting at 1 (text files).
    Line(usize),
    /// Byte offset, starting at 0 (binary files).
    Byte(u64),
    /// The file in general.
    File,
}

/// Error in a scene or mesh file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InputError {
    /// Path of the file.
    pub file: PathBuf,
    /// Location in the file.
    pub place: Place,
    /// Dotted key in a scene file (`camera.f_number`); `None` in a mesh.
    pub key: Option<String>,
    /// Value found; empty if a required key is missing.
    pub found: String,
    /// Description of the expected value.
    pub expected: String,
    /// Suggested correction.
    pub hint: Option<String>,
}

impl InputError {
    /// Creates an error at `place` of `file` without a key.
    pub fn new(
        file: &Path,
        place: Place,
        found: impl Into<String>,
        expected: impl Into<String>,
    ) -> Self {
        InputError {
            file: file.to_owned(),
            place,
            key: None,
            found: found.into(),
            expected: expected.into(),
            hint: None,
        }
    }
}

impl fmt::Display for InputError {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{}", path(&self.file))?;
        match self.place {
            Place::Line(line) => write!(f, ":{line}")?,
            Place::Byte(byte) => write!(f, ": byte {byte}")?,
            Place::File => {}
        }
        if let Some(key) = &self.key {
            write!(f, ": {}", short(key))?;
        }
        match self.found.as_str() {
            "" => write!(f, " is missing")?,
            found => write!(f, ": found {}", short(found))?,
        }
        write!(f, ", expected {}", short(&self.expected))?;
        match &self.hint {
            Some(hint) => write!(f, "; {}", short(hint)),
            None => Ok(()),
        }
    }
}

/// Errors of the library. Each message states the problem and a remedy.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Invalid command-line argument or function argument.
    #[error("{}", printable::line(.0))]
    Usage(String),
    /// Error in a scene or mesh file.
    #[error("{0}")]
    Input(Box<InputError>),
    /// Error of the file system.
    #[error("cannot {action} {}: {source}", path(file))]
    Io {
        /// The failed operation, after "cannot": "read", "write".
        action: &'static str,
        /// Path of the file.
        file: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// Error of Embree.
    #[error("Embree: {0}")]
    Embree(String),
    /// The journal to be resumed belongs to a different run.
    #[error("{} is of another run: {difference}", path(journal))]
    OtherRun {
        /// Path of the journal.
        journal: PathBuf,
        /// Difference between the two runs.
        difference: String,
    },
    /// The output folder contains files that were not written by this program.
    #[error("{} holds {found}, not written by lasertrace", path(folder))]
    Occupied {
        /// Output folder.
        folder: PathBuf,
        /// Names of some of these files.
        found: String,
    },
    /// Insufficient memory for the requested work.
    #[error(
        "{work} takes {:.2} GB, and {:.2} GB of memory are free: make it smaller, take fewer \
         threads or a larger machine",
        *need as f64 / 1e9, *available as f64 / 1e9
    )]
    Memory {
        /// The work and the cause of its memory requirement.
        work: String,
        /// Required memory, bytes.
        need: u64,
        /// Free memory, bytes.
        available: u64,
    },
    /// The system refused memory or a thread although enough seemed available.
    #[error("{0}; take fewer threads or a larger machine")]
    Exhausted(String),
    /// The folder is in use by another run.
    #[error("another run is writing to {}; wait for its end or choose another folder", path(.0))]
    Busy(PathBuf),
    /// Warnings that are treated as errors.
    #[error("{}", .0.join(" "))]
    Warned(Vec<String>),
    /// Interruption by the user.
    #[error("interrupted before the end")]
    Interrupted,
}

impl From<InputError> for Error {
    fn from(error: InputError) -> Self {
        Error::Input(Box::new(error))
    }
}

impl Error {
    /// Returns a `map_err` adapter: `fs::read(p).map_err(Error::io("read", p))`.
    pub fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Error + use<> {
        let file = path.to_owned();
        move |source| Error::Io {
            action,
            file,
            source,
        }
    }

    /// Returns the process exit code (BSD `sysexits.h`): 64 usage, 65 invalid input data, 70
    /// internal error, 74 input/output error, 75 temporary failure (run again).
    pub fn exit_code(&self) -> u8 {
        use std::io::ErrorKind::{FileTooLarge, OutOfMemory, QuotaExceeded, StorageFull};
        match self {
            Error::Usage(_) | Error::OtherRun { .. } | Error::Occupied { .. } => 64,
            Error::Input(_) | Error::Warned(_) => 65,
            Error::Embree(_) => 70,
            Error::Io { source, .. } => match source.kind() {
                StorageFull | QuotaExceeded | FileTooLarge | OutOfMemory => 75,
                _ => 74,
            },
            Error::Memory { .. } | Error::Exhausted(_) | Error::Busy(_) | Error::Interrupted => 75,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_input_error_names_file_place_key_found_and_expected() {
        let mut error = InputError::new(Path::new("a.toml"), Place::Line(7), "-8", "a number > 0");
        error.key = Some("camera.f_number".into());
        assert_eq!(
            error.to_string(),
            "a.toml:7: camera.f_number: found -8, expected a number > 0"
        );
    }

    #[test]
    fn a_full_disk_is_temporary_and_no_permission_is_not() {
        let code = |kind: std::io::ErrorKind| {
            Error::io("write", Path::new("x"))(std::io::Error::from(kind)).exit_code()
        };
        assert_eq!(code(std::io::ErrorKind::StorageFull), 75);
        assert_eq!(code(std::io::ErrorKind::FileTooLarge), 75);
        assert_eq!(code(std::io::ErrorKind::PermissionDenied), 74);
    }
}
