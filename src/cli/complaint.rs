//! How the program says that it cannot do what was asked.

use crate::error::{Error, Place, printable};
use serde::Serialize;
use std::io::Write;
use std::path::Path;

/// An error as `--json` gives it, below the key `error`.
#[derive(Serialize)]
struct Complaint<'a> {
    message: &'a str,
    exit_code: u8,
    #[serde(flatten)]
    place: Option<InFile<'a>>,
}

#[derive(Serialize)]
struct InFile<'a> {
    #[serde(serialize_with = "printable::in_json")]
    file: &'a Path,
    /// From 1.
    line: Option<usize>,
    /// From 0.
    byte: Option<u64>,
    key: Option<String>,
    /// `null`: the key is missing.
    found: Option<String>,
    expected: String,
    hint: Option<String>,
}

/// How a command's errors are said.
#[derive(Clone, Copy)]
pub struct Complaints {
    /// For programs too.
    pub json: bool,
    pub again: Again,
}

/// What the same command does when it runs again after it was interrupted.
#[derive(Clone, Copy)]
pub enum Again {
    StartsAnew,
    /// It goes on with `--resume`.
    Resumes,
    /// It goes on by itself.
    GoesOn,
}

impl Complaints {
    /// An error: one line on stderr for people, and with `json` one object on stdout for
    /// programs. A stream that is closed must not hide the exit code.
    pub fn say(self, error: &Error) {
        // Of what the file system refuses, this is what it may grant later: room.
        let full = matches!(error, Error::Io { .. }) && error.exit_code() == 75;
        let interrupted = matches!(error, Error::Interrupted);
        let when = if full { "when there is room, " } else { "" };
        let other = matches!(error, Error::OtherRun { .. });
        let next = match self.again {
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
            print(&Complaint {
                message: &message,
                exit_code: error.exit_code(),
                place,
            });
        }
    }
}

/// A mistake on the command line, with the usage; with `--json` among the arguments, which
/// could not be parsed, its first line as an object too.
pub fn complain_of_usage(error: &clap::Error) {
    let _ = error.print();
    if std::env::args_os().any(|argument| argument == "--json") {
        let text = error.to_string();
        let message = text.lines().next().unwrap_or_default();
        print(&Complaint {
            message: message.trim_start_matches("error: "),
            exit_code: 64,
            place: None,
        });
    }
}

fn print(complaint: &Complaint) {
    let object = serde_json::json!({ "error": complaint });
    let _ = writeln!(
        std::io::stdout(),
        "{}",
        printable::json(&object.to_string())
    );
}
