//! Reads what a handler left of a request's body.
//!
//! Clients such as Python's `http.client` send the whole body before they read the response. If the
//! connection closes while they send, they report a broken pipe in place of the response.

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

/// A body that the handler and the middleware both read.
#[derive(Clone)]
struct SharedBody {
    stream: Arc<Mutex<BodyDataStream>>,
    /// Whether anybody has read from it.
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
/// A client that waits for `100 Continue` has sent nothing yet if the handler did not read the body, and a
/// client that was too slow (408) is not waited for any longer.
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
