//! What a request gets that is not done, in the form in which the commands say it with `--json`.

use crate::error::Error;
use axum::Json;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use utoipa::ToSchema;

/// Why a request is not done.
#[derive(Debug)]
pub struct Refusal {
    /// Of HTTP.
    pub status: StatusCode,
    /// What was found, what was expected, what to do.
    pub message: String,
}

/// The body of an answer that refuses.
#[derive(Serialize, ToSchema)]
pub struct RefusalBody {
    error: RefusalMessage,
}

/// Why, in words.
#[derive(Serialize, ToSchema)]
pub struct RefusalMessage {
    message: String,
}

impl Refusal {
    /// With this status and message.
    pub fn new(status: StatusCode, message: impl Into<String>) -> Refusal {
        Refusal {
            status,
            message: message.into(),
        }
    }
}

impl IntoResponse for Refusal {
    fn into_response(self) -> Response {
        let body = RefusalBody {
            error: RefusalMessage {
                message: crate::error::printable::line(&self.message),
            },
        };
        let mut response = (self.status, Json(body)).into_response();
        let headers = response.headers_mut();
        match self.status {
            StatusCode::UNAUTHORIZED => {
                for way in [
                    "Bearer",
                    "Basic realm=\"lasertrace: the token is the password\"",
                ] {
                    headers.append(header::WWW_AUTHENTICATE, way.parse().expect("ASCII"));
                }
            }
            StatusCode::TOO_MANY_REQUESTS | StatusCode::SERVICE_UNAVAILABLE => {
                headers.insert(header::RETRY_AFTER, "10".parse().expect("ASCII"));
            }
            _ => {}
        }
        response
    }
}

impl From<Error> for Refusal {
    fn from(error: Error) -> Refusal {
        let full = matches!(error, Error::Io { .. }) && error.exit_code() == 75;
        let status = match error.exit_code() {
            75 if full => StatusCode::INSUFFICIENT_STORAGE,
            64 | 65 => StatusCode::UNPROCESSABLE_ENTITY,
            75 => StatusCode::SERVICE_UNAVAILABLE,
            _ => StatusCode::INTERNAL_SERVER_ERROR,
        };
        Refusal::new(status, error.to_string())
    }
}
