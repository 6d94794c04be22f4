//! Discards the part of a request body that the handler did not read.
//!
//! Clients such as Python's `http.client` send the entire body before they read the response. If
//! the connection closes while they send, they report a broken pipe instead of the response.

use super::upload;
use axum::body::{Body, BodyDataStream, Bytes, HttpBody};
use axum::extract::{Request, State};
use axum::http::{StatusCode, header};
use axum::middleware::Next;
use axum::response::Response;
use futures_util::StreamExt;
use futures_util::stream::{Stream, unfold};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use tokio::sync::Mutex;

/// Request body that is read by the handler and by the middleware.
#[derive(Clone)]
struct SharedBody {
    stream: Arc<Mutex<BodyDataStream>>,
    /// True if the body has been polled.
    polled: Arc<AtomicBool>,
}

impl SharedBody {
    fn pieces(&self) -> impl Stream<Item = Result<Bytes, axum::Error>> + Send + 'static + use<> {
        unfold(self.clone(), async |body| {
            body.polled.store(true, Relaxed);
            let piece = body.stream.lock().await.next().await;
            piece.map(|piece| (piece, body))
        })
    }
}

/// Runs the handler and discards up to `largest` bytes of the body that the handler did not read.
///
/// Nothing is discarded in two cases. A client that waits for `100 Continue` has sent no body if
/// the handler did not read it. A client that was too slow (408) is not waited for any longer.
pub async fn discard_rest(State(largest): State<u64>, request: Request, next: Next) -> Response {
    let waits = request.headers().contains_key(header::EXPECT);
    let (head, body) = request.into_parts();
    if body.is_end_stream() {
        return next.run(Request::from_parts(head, body)).await;
    }
    let length = upload::length(&head.headers);
    let shared = SharedBody {
        stream: Arc::new(Mutex::new(body.into_data_stream())),
        polled: Arc::default(),
    };
    let body = Body::from_stream(shared.pieces());
    let response = next.run(Request::from_parts(head, body)).await;
    let nothing_sent = waits && !shared.polled.load(Relaxed);
    if !nothing_sent && response.status() != StatusCode::REQUEST_TIMEOUT {
        upload::discard(Body::from_stream(shared.pieces()), length, largest).await;
    }
    response
}
