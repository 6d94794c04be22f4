//! Error responses, in the format of the commands with `--json`.

use crate::error::Error;
use axum::Json;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use utoipa::ToSchema;

/// Reason why a request is rejected.
#[derive(Debug)]
pub struct HttpError {
    /// HTTP status.
    pub status: StatusCode,
    /// Message with the value found, the value expected and the remedy.
    pub message: String,
}

/// Body of an error response.
#[derive(Serialize, ToSchema)]
pub struct RefusalBody {
    error: RefusalMessage,
}

/// Reason as text.
#[derive(Serialize, ToSchema)]
pub struct RefusalMessage {
    message: String,
}

impl HttpError {
    /// Creates an error response.
    pub fn new(status: StatusCode, message: impl Into<String>) -> HttpError {
        HttpError {
            status,
            message: message.into(),
        }
    }
}

impl IntoResponse for HttpError {
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

impl From<Error> for HttpError {
    fn from(error: Error) -> HttpError {
        let full = matches!(error, Error::Io { .. }) && error.exit_code() == 75;
        let status = match error.exit_code() {
            75 if full => StatusCode::INSUFFICIENT_STORAGE,
            64 | 65 => StatusCode::UNPROCESSABLE_ENTITY,
            75 => StatusCode::SERVICE_UNAVAILABLE,
            _ => StatusCode::INTERNAL_SERVER_ERROR,
        };
        HttpError::new(status, error.to_string())
    }
}
