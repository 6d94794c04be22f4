//! Errors of requests.

use crate::error::{Error, printable};
use serde::Serialize;

/// Error that the page shows instead of an image.
#[derive(Debug, Serialize)]
pub struct ViewError {
    /// Page name of the erroneous value; `null` if the error is not due to a single value.
    pub key: Option<&'static str>,
    /// Found and expected value.
    pub message: String,
    /// HTTP status code.
    #[serde(skip)]
    pub status: u16,
}

/// Result of a request.
pub type HttpResult<T> = Result<T, ViewError>;

/// Scene keys that the page controls, with the page names of their values.
const KEYS: [(&str, &str); 5] = [
    ("camera.exposure_ms", "exposure_ms"),
    ("camera.f_number", "f_number"),
    ("laser.power_mw", "power_mw"),
    ("laser.direction", "angle_deg"),
    ("camera.position_mm", "angle_deg"),
];

impl ViewError {
    /// Returns the error for an invalid value.
    pub fn value(key: &'static str, found: f64, expected: &str) -> ViewError {
        ViewError {
            key: Some(key),
            message: format!("found {found}, expected {expected}"),
            status: 422,
        }
    }

    /// Returns the error for too many simultaneous requests.
    pub fn busy() -> ViewError {
        ViewError {
            key: None,
            message: "too many pages ask at once; close some".to_owned(),
            status: 503,
        }
    }

    /// Returns the error of a draft that a newer request cancelled.
    pub fn superseded() -> ViewError {
        ViewError {
            key: None,
            message: "a newer draft was requested, and this one was cancelled".to_owned(),
            status: 409,
        }
    }

    /// Returns the error for a defect of the program.
    pub fn fault() -> ViewError {
        ViewError {
            key: None,
            message: "this is a fault of the program; please report what it printed".to_owned(),
            status: 500,
        }
    }
}

impl From<Error> for ViewError {
    fn from(error: Error) -> ViewError {
        match &error {
            Error::Input(mistake) => {
                let known = |(key, _): &&(&str, _)| mistake.key.as_deref() == Some(*key);
                let key = KEYS.iter().find(known).map(|(_, name)| *name);
                let place = match (key, &mistake.key) {
                    (None, Some(key)) => format!("{key}: "),
                    _ => String::new(),
                };
                let (found, expected) = (&mistake.found, &mistake.expected);
                ViewError {
                    key,
                    message: printable::line(&format!("{place}found {found}, expected {expected}")),
                    status: 422,
                }
            }
            Error::Usage(message) => ViewError {
                key: None,
                message: printable::line(message),
                status: 422,
            },
            Error::Interrupted => ViewError::superseded(),
            other => ViewError {
                key: None,
                message: other.to_string(),
                status: 500,
            },
        }
    }
}
