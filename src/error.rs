//! The one error type. A user's mistake names the file, the place in it, the
//! key, what was found and what was expected; a bug is an assertion instead.

pub mod input_file;
pub mod printable;

use printable::{path, short};
use std::fmt;
use std::path::{Path, PathBuf};

/// What a function of this library gives back if it may fail.
pub type Result<T> = std::result::Result<T, Error>;

/// Where in an input file a mistake was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// Line number, counted from 1 (text files).
    Line(usize),
    /// Byte offset, counted from 0 (binary files).
    Byte(u64),
    /// The file as a whole.
    File,
}

/// A mistake in a scene or mesh file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InputError {
    /// The file that is wrong.
    pub file: PathBuf,
    /// Where in the file.
    pub place: Place,
    /// Dotted key in a scene file (`camera.f_number`); `None` in a mesh.
    pub key: Option<String>,
    /// Empty: a key that must be there is not.
    pub found: String,
    /// What should stand there.
    pub expected: String,
    /// What was probably meant.
    pub hint: Option<String>,
}

impl InputError {
    /// A mistake at `place` of `file`, outside any key.
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

/// What can go wrong: each message says what was found and what to do.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// What the command line or a call asks for cannot be done.
    #[error("{}", printable::line(.0))]
    Usage(String),
    /// A scene or mesh file is wrong.
    #[error("{0}")]
    Input(Box<InputError>),
    /// The file system refused.
    #[error("cannot {action} {}: {source}", path(file))]
    Io {
        /// What was to be done, after "cannot": "read", "write".
        action: &'static str,
        /// With what.
        file: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// Embree failed.
    #[error("Embree: {0}")]
    Embree(String),
    /// A journal to be resumed is of another run.
    #[error("{} is of another run: {difference}", path(journal))]
    OtherRun {
        /// The journal's file.
        journal: PathBuf,
        /// What the two runs do not have in common.
        difference: String,
    },
    /// The output folder holds files that no run of this program wrote.
    #[error("{} holds {found}, not written by lasertrace", path(folder))]
    Occupied {
        /// The output folder.
        folder: PathBuf,
        /// Names of some of these files.
        found: String,
    },
    /// The machine has too little memory.
    #[error(
        "{work} takes {:.2} GB, and {:.2} GB of memory are free: make it smaller, take fewer \
         threads or a larger machine",
        *need as f64 / 1e9, *available as f64 / 1e9
    )]
    Memory {
        /// What, and how its need comes about.
        work: String,
        /// Bytes.
        need: u64,
        /// Free memory, bytes.
        available: u64,
    },
    /// The system gave no memory or no thread, though there seemed to be enough.
    #[error("{0}; take fewer threads or a larger machine")]
    Exhausted(String),
    /// Another run writes to this folder.
    #[error("another run is writing to {}; wait for its end or choose another folder", path(.0))]
    Busy(PathBuf),
    /// What warns of a worthless result is to be an error.
    #[error("{}", .0.join(" "))]
    Warned(Vec<String>),
    /// The user stopped the run.
    #[error("interrupted before the end")]
    Interrupted,
}

impl From<InputError> for Error {
    fn from(error: InputError) -> Self {
        Error::Input(Box::new(error))
    }
}

impl Error {
    /// `map_err` adapter: `fs::read(p).map_err(Error::io("read", p))`.
    pub fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Error + use<> {
        let file = path.to_owned();
        move |source| Error::Io {
            action,
            file,
            source,
        }
    }

    /// Process exit status, after BSD `sysexits.h`: 64 usage, 65 bad input
    /// data, 70 internal, 74 input/output, 75 temporary (run again).
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
