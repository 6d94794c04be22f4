//! Connections of HTTP/1.1, with an end to everything a client can draw out: the head of a request, reading
//! its answer, and the number of connections.

use super::quota::Quota;
use super::refusal::Refusal;
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

/// Connections that are served at the same time.
const CONNECTIONS: usize = 512;
/// Connections of one address among them.
const PER_ADDRESS: usize = CONNECTIONS / 4 * 3;
/// Connections beyond these limits that may still ask whether the service is alive; more wait.
const RESERVE: usize = 64;
/// Time in which the head of a request comes, counted from the end of the one before.
const HEAD: Duration = Duration::from_secs(10);
/// [`HEAD`] of a connection of the reserve.
const HEAD_OF_RESERVE: Duration = Duration::from_secs(1);
/// Time in which a client takes something of an answer.
const TAKES: Duration = Duration::from_secs(30);
/// Bytes of a request's head.
const LARGEST_HEAD: usize = 16 << 10;

/// Pages that need neither a token nor a connection of those that are limited: they show nothing of jobs.
pub const OPEN: [&str; 2] = ["/healthz", "/readyz"];

/// Where a request comes from.
#[derive(Debug, Clone, Copy)]
pub struct Peer(pub SocketAddr);

/// Answers every connection with `pages`.
pub async fn accept(listener: TcpListener, pages: Router) {
    let all = Quota::new(CONNECTIONS, PER_ADDRESS);
    let reserve = Arc::new(Semaphore::new(RESERVE));
    loop {
        let reserved = reserve.clone().acquire_owned().await;
        let (stream, peer) = match listener.accept().await {
            Ok(accepted) => accepted,
            // The client has gone, or files are short: both pass.
            Err(error) => {
                tracing::warn!("cannot accept a connection: {error}");
                tokio::time::sleep(Duration::from_millis(100)).await;
                continue;
            }
        };
        let place = all.take(peer.ip());
        let reserved = reserved.ok().filter(|_| place.is_none());
        let restricted = place.is_none();
        // Answers are small or large, never many small pieces.
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
            // An error concerns this client's connection only.
            if let Err(error) = http.serve_connection(io, pages).await {
                tracing::debug!(%peer, "connection: {error}");
            }
            drop((place, reserved));
        });
    }
}

fn too_many() -> Refusal {
    let message = "too many connections are open; close some or try again in ten seconds";
    Refusal::new(StatusCode::SERVICE_UNAVAILABLE, message)
}
