//! Why a request got no picture.

use crate::error::{Error, printable};
use serde::Serialize;

/// What the page shows in place of a picture.
#[derive(Debug, Serialize)]
pub struct Refused {
    /// The value that is wrong, as the page calls it; `null`: none by itself.
    pub key: Option<&'static str>,
    /// What was found and what was expected.
    pub message: String,
    /// HTTP's number.
    #[serde(skip)]
    pub status: u16,
}

/// What was asked for, or why not.
pub type Answer<T> = Result<T, Refused>;

/// Keys of the scene whose values the page has.
const KEYS: [(&str, &str); 5] = [
    ("camera.exposure_ms", "exposure_ms"),
    ("camera.f_number", "f_number"),
    ("laser.power_mw", "power_mw"),
    ("laser.direction", "angle_deg"),
    ("camera.position_mm", "angle_deg"),
];

impl Refused {
    /// A value that cannot be.
    pub fn value(key: &'static str, found: f64, expected: &str) -> Refused {
        Refused {
            key: Some(key),
            message: format!("found {found}, expected {expected}"),
            status: 422,
        }
    }

    /// Too much is asked for at once.
    pub fn busy() -> Refused {
        Refused {
            key: None,
            message: "too many pages ask at once; close some".to_owned(),
            status: 503,
        }
    }

    /// A newer draft was requested.
    pub fn superseded() -> Refused {
        Refused {
            key: None,
            message: "a newer draft was requested, and this one was cancelled".to_owned(),
            status: 409,
        }
    }

    /// A fault of the program.
    pub fn fault() -> Refused {
        Refused {
            key: None,
            message: "this is a fault of the program; please report what it printed".to_owned(),
            status: 500,
        }
    }
}

impl From<Error> for Refused {
    fn from(error: Error) -> Refused {
        match &error {
            Error::Input(mistake) => {
                let known = |(key, _): &&(&str, _)| mistake.key.as_deref() == Some(*key);
                let key = KEYS.iter().find(known).map(|(_, name)| *name);
                let place = match (key, &mistake.key) {
                    (None, Some(key)) => format!("{key}: "),
                    _ => String::new(),
                };
                let (found, expected) = (&mistake.found, &mistake.expected);
                Refused {
                    key,
                    message: printable::line(&format!("{place}found {found}, expected {expected}")),
                    status: 422,
                }
            }
            Error::Usage(message) => Refused {
                key: None,
                message: printable::line(message),
                status: 422,
            },
            Error::Interrupted => Refused::superseded(),
            other => Refused {
                key: None,
                message: other.to_string(),
                status: 500,
            },
        }
    }
}
