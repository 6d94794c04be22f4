//! HTTP/1.1 connections with limits on everything that a client can prolong: request headers,
//! reading the response, and the number of connections.

use super::quota::Quota;
use super::refusal::HttpError;
use axum::Router;
use axum::http::StatusCode;
use axum::response::IntoResponse;
use hyper::Request;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::{Service, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::TcpListener;
use tokio::sync::Semaphore;
use tokio_io_timeout::TimeoutStream;

/// Maximum number of simultaneous connections.
const CONNECTIONS: usize = 512;
/// Maximum number of connections per client address.
const PER_ADDRESS: usize = CONNECTIONS / 4 * 3;
/// Additional connections beyond these limits, which may request [`OPEN`] pages only. Further
/// connections wait.
const RESERVE: usize = 64;
/// Time limit for receiving the header of a request, counted from the end of the previous request.
const HEAD: Duration = Duration::from_secs(10);
/// [`HEAD`] for a connection of the reserve.
const HEAD_OF_RESERVE: Duration = Duration::from_secs(1);
/// Timeout for a client that does not read the response.
const TAKES: Duration = Duration::from_secs(30);
/// Maximum size of a request header, bytes.
const LARGEST_HEAD: usize = 16 << 10;

/// Pages available without a token and without a regular connection. They contain no data of jobs.
pub const OPEN: [&str; 2] = ["/healthz", "/readyz"];

/// Address of the client of a request.
#[derive(Debug, Clone, Copy)]
pub struct Peer(pub SocketAddr);

/// Accepts connections and serves `pages` on them.
pub async fn accept(listener: TcpListener, pages: Router) {
    let all = Quota::new(CONNECTIONS, PER_ADDRESS);
    let reserve = Arc::new(Semaphore::new(RESERVE));
    loop {
        let reserved = reserve.clone().acquire_owned().await;
        let (stream, peer) = match listener.accept().await {
            Ok(accepted) => accepted,
            // The client has disconnected or file descriptors are exhausted. Both conditions are
            // temporary.
            Err(error) => {
                tracing::warn!("cannot accept a connection: {error}");
                tokio::time::sleep(Duration::from_millis(100)).await;
                continue;
            }
        };
        let place = all.take(peer.ip());
        let reserved = reserved.ok().filter(|_| place.is_none());
        let restricted = place.is_none();
        // Responses are never written in many small chunks, so Nagle's algorithm is not needed.
        let _ = stream.set_nodelay(true);
        let mut stream = TimeoutStream::new(stream);
        stream.set_write_timeout(Some(TAKES));
        let pages = TowerToHyperService::new(pages.clone());
        let pages = service_fn(move |mut request: Request<Incoming>| {
            request.extensions_mut().insert(Peer(peer));
            let open = OPEN.contains(&request.uri().path());
            let answer = (!restricted || open).then(|| pages.call(request));
            async move {
                match answer {
                    Some(answer) => answer.await,
                    None => Ok(too_many().into_response()),
                }
            }
        });
        tokio::spawn(async move {
            let mut http = http1::Builder::new();
            http.timer(TokioTimer::new())
                .header_read_timeout(if restricted { HEAD_OF_RESERVE } else { HEAD })
                .keep_alive(!restricted)
                .max_buf_size(LARGEST_HEAD);
            let io = TokioIo::new(Box::pin(stream));
            // An error affects only the connection of this client.
            if let Err(error) = http.serve_connection(io, pages).await {
                tracing::debug!(%peer, "connection: {error}");
            }
            drop((place, reserved));
        });
    }
}

fn too_many() -> HttpError {
    let message = "too many connections are open; close some or try again in ten seconds";
    HttpError::new(StatusCode::SERVICE_UNAVAILABLE, message)
}
