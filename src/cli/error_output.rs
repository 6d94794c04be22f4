//! Error messages of the program.

use crate::error::{Error, Place, printable};
use serde::Serialize;
use std::io::Write;
use std::path::Path;

/// Error in the format of `--json`, under the key `error`.
#[derive(Serialize)]
struct ErrorObject<'a> {
    message: &'a str,
    exit_code: u8,
    #[serde(flatten)]
    place: Option<InFile<'a>>,
}

#[derive(Serialize)]
struct InFile<'a> {
    #[serde(serialize_with = "printable::in_json")]
    file: &'a Path,
    /// Line number, starting at 1.
    line: Option<usize>,
    /// Byte offset, starting at 0.
    byte: Option<u64>,
    key: Option<String>,
    /// Value found; `null` if the key is missing.
    found: Option<String>,
    expected: String,
    hint: Option<String>,
}

/// How errors of a command are reported.
#[derive(Clone, Copy)]
pub struct ErrorPrinter {
    /// True if errors are also printed as JSON.
    pub json: bool,
    pub retry: Again,
}

/// Effect of running a command again after an interruption.
#[derive(Clone, Copy)]
pub enum Again {
    StartsAnew,
    /// It continues with `--resume`.
    Resumes,
    /// It continues automatically.
    GoesOn,
}

impl ErrorPrinter {
    /// Reports an error: one line on stderr and, with `json`, one object on stdout. A closed stream
    /// must not hide the exit code.
    pub fn say(self, error: &Error) {
        // A file system error with exit code 75 means that space is missing, which may change
        // later.
        let full = matches!(error, Error::Io { .. }) && error.exit_code() == 75;
        let interrupted = matches!(error, Error::Interrupted);
        let when = if full { "when there is room, " } else { "" };
        let other = matches!(error, Error::OtherRun { .. });
        let next = match self.retry {
            _ if matches!(error, Error::Occupied { .. }) => {
                "name an empty folder with -o, or add --force to replace files of the names that this \
                 command writes; an input is never replaced"
            }
            Again::Resumes if other => "without --resume the scan starts anew and replaces it",
            _ if other => "give a folder of its own with -o",
            _ if !full && !interrupted => "",
            Again::Resumes => {
                "run the same command with --resume to go on after the last finished frame: without \
                 --resume it starts anew and replaces them all"
            }
            Again::GoesOn => {
                "run the same command again: it goes on, and keeps the files that are finished"
            }
            Again::StartsAnew => "run the same command again: it starts anew",
        };
        let message = match next {
            "" => error.to_string(),
            next => format!("{error}; {when}{next}"),
        };
        super::say(&message);
        if self.json {
            let place = match error {
                Error::Input(wrong) => Some(InFile {
                    file: &wrong.file,
                    line: match wrong.place {
                        Place::Line(line) => Some(line),
                        _ => None,
                    },
                    byte: match wrong.place {
                        Place::Byte(byte) => Some(byte),
                        _ => None,
                    },
                    key: wrong.key.as_deref().map(printable::short),
                    found: Some(printable::short(&wrong.found)).filter(|found| !found.is_empty()),
                    expected: printable::short(&wrong.expected),
                    hint: wrong.hint.as_deref().map(printable::short),
                }),
                _ => None,
            };
            print(&ErrorObject {
                message: &message,
                exit_code: error.exit_code(),
                place,
            });
        }
    }
}

/// Reports a mistake on the command line together with the usage. If the arguments contain
/// `--json`, its first line is also printed as an object; the arguments could not be parsed.
pub fn print_usage_error(error: &clap::Error) {
    let _ = error.print();
    if std::env::args_os().any(|argument| argument == "--json") {
        let text = error.to_string();
        let message = text.lines().next().unwrap_or_default();
        print(&ErrorObject {
            message: message.trim_start_matches("error: "),
            exit_code: 64,
            place: None,
        });
    }
}

fn print(complaint: &ErrorObject) {
    let object = serde_json::json!({ "error": complaint });
    let _ = writeln!(
        std::io::stdout(),
        "{}",
        printable::json(&object.to_string())
    );
}
