//! Connections of HTTP/1.1, with an end to everything a client can draw out: the head of a request, reading
//! its answer, and the number of connections.

use axum::Router;
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

/// Connections at the same time; more wait.
const CONNECTIONS: usize = 256;
/// Time in which the head of a request comes, counted from the end of the one before.
const HEAD: Duration = Duration::from_secs(10);
/// Time in which a client takes something of an answer.
const TAKES: Duration = Duration::from_secs(30);
/// Bytes of a request's head.
const LARGEST_HEAD: usize = 16 << 10;

/// Where a request comes from.
#[derive(Debug, Clone, Copy)]
pub struct Peer(pub SocketAddr);

/// Answers every connection with `pages`.
pub async fn accept(listener: TcpListener, pages: Router) {
    let places = Arc::new(Semaphore::new(CONNECTIONS));
    loop {
        let place = places.clone().acquire_owned().await;
        let (stream, peer) = match listener.accept().await {
            Ok(accepted) => accepted,
            // Of a client that has gone, or for want of files: both pass.
            Err(error) => {
                tracing::warn!("cannot accept a connection: {error}");
                tokio::time::sleep(Duration::from_millis(100)).await;
                continue;
            }
        };
        // Answers are small or large, never many small pieces.
        let _ = stream.set_nodelay(true);
        let mut stream = TimeoutStream::new(stream);
        stream.set_write_timeout(Some(TAKES));
        let pages = TowerToHyperService::new(pages.clone());
        let pages = service_fn(move |mut request: Request<Incoming>| {
            request.extensions_mut().insert(Peer(peer));
            pages.call(request)
        });
        tokio::spawn(async move {
            let mut http = http1::Builder::new();
            http.timer(TokioTimer::new())
                .header_read_timeout(HEAD)
                .max_buf_size(LARGEST_HEAD);
            let io = TokioIo::new(Box::pin(stream));
            // What fails is the client's connection, and only that.
            if let Err(error) = http.serve_connection(io, pages).await {
                tracing::debug!(%peer, "connection: {error}");
            }
            drop(place);
        });
    }
}
