//! Bodies of requests: within a size, and not slower than a line that is worth waiting for.

use super::refusal::Refusal;
use super::store::{Hash, Store};
use crate::error::Error;
use axum::body::{Body, BodyDataStream, Bytes};
use axum::http::{HeaderMap, StatusCode, header};
use futures_util::StreamExt;
use sha2::{Digest, Sha256};
use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::{Duration, Instant};

/// Time without a byte after which a client is gone.
const SILENCE: Duration = Duration::from_secs(10);
/// Bytes a second that a body has on average at least, after the first [`SILENCE`].
const SLOWEST: f64 = 16e3;
/// Bytes that are written at once.
const PIECE: usize = 1 << 18;

/// The pieces of a body.
struct Pieces {
    stream: BodyDataStream,
    start: Instant,
    received: u64,
    largest: u64,
}

impl Pieces {
    /// Errors: a body that says it is larger.
    fn of(body: Body, length: Option<u64>, largest: u64) -> Result<Pieces, Refusal> {
        match length {
            Some(length) if length > largest => Err(too_large(largest)),
            _ => Ok(Pieces {
                stream: body.into_data_stream(),
                start: Instant::now(),
                received: 0,
                largest,
            }),
        }
    }

    async fn next(&mut self) -> Result<Option<Bytes>, Refusal> {
        let slow = |what: &str| Refusal::new(StatusCode::REQUEST_TIMEOUT, what);
        let next = tokio::time::timeout(SILENCE, self.stream.next()).await;
        let piece = match next.map_err(|_| slow("the body stopped coming"))? {
            None => return Ok(None),
            Some(Ok(piece)) => piece,
            Some(Err(error)) => {
                return Err(Refusal::new(StatusCode::BAD_REQUEST, error.to_string()));
            }
        };
        self.received += piece.len() as u64;
        let seconds = self.start.elapsed().saturating_sub(SILENCE).as_secs_f64();
        if seconds * SLOWEST > self.received as f64 {
            return Err(slow("the body comes too slowly"));
        }
        match self.received > self.largest {
            true => Err(too_large(self.largest)),
            false => Ok(Some(piece)),
        }
    }
}

fn too_large(largest: u64) -> Refusal {
    let message = format!("the body is larger than {largest} bytes");
    Refusal::new(StatusCode::PAYLOAD_TOO_LARGE, message)
}

/// The value of the header Content-Length.
pub fn length(headers: &HeaderMap) -> Option<u64> {
    let value = headers.get(header::CONTENT_LENGTH)?;
    value.to_str().ok()?.parse().ok()
}

/// Reads a body to its end, unless it is too slow or has more than `largest` bytes.
pub async fn discard(body: Body, length: Option<u64>, largest: u64) {
    if let Ok(mut pieces) = Pieces::of(body, length, largest) {
        while let Ok(Some(_)) = pieces.next().await {}
    }
}

/// A whole body in memory.
pub async fn whole(body: Body, length: Option<u64>, largest: u64) -> Result<Vec<u8>, Refusal> {
    let mut pieces = Pieces::of(body, length, largest)?;
    let mut bytes = Vec::new();
    while let Some(piece) = pieces.next().await? {
        bytes.extend_from_slice(&piece);
    }
    Ok(bytes)
}

/// A file that is being received; it goes if it does not become whole.
struct Receiving {
    path: PathBuf,
    file: File,
    hash: Sha256,
}

impl Receiving {
    fn begin(path: PathBuf) -> crate::error::Result<Receiving> {
        let file = File::create_new(&path).map_err(Error::io("write", &path))?;
        Ok(Receiving {
            path,
            file,
            hash: Sha256::new(),
        })
    }

    fn write(mut self, bytes: &[u8]) -> crate::error::Result<Receiving> {
        self.hash.update(bytes);
        let written = self.file.write_all(bytes);
        written.map_err(Error::io("write", &self.path))?;
        Ok(self)
    }

    /// Under its own name; or, of another hash, this hash.
    fn finish(self, hash: &Hash, path: &Path) -> crate::error::Result<Result<(), Hash>> {
        let found = Hash::of(&self.hash.clone().finalize());
        if found != *hash {
            return Ok(Err(found));
        }
        self.file.sync_data().map_err(Error::io("write", path))?;
        fs::rename(&self.path, path).map_err(Error::io("write", path))?;
        Ok(Ok(()))
    }
}

impl Drop for Receiving {
    fn drop(&mut self) {
        // After a rename there is nothing under this name.
        let _ = fs::remove_file(&self.path);
    }
}

/// Work that waits for the disk, on a thread of its own.
pub async fn on_disk<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> T {
    let done = tokio::task::spawn_blocking(work).await;
    done.unwrap_or_else(|error| std::panic::resume_unwind(error.into_panic()))
}

/// Receives the file with this hash.
pub async fn file(
    body: Body,
    length: Option<u64>,
    largest: u64,
    hash: Hash,
    store: &Store,
) -> Result<(), Refusal> {
    static NUMBER: AtomicU64 = AtomicU64::new(0);
    let mut pieces = Pieces::of(body, length, largest)?;
    if let (Some(length), Some(free)) = (length, store.free())
        && length > free
    {
        return Err(Refusal::new(
            StatusCode::INSUFFICIENT_STORAGE,
            format!(
                "the file has {length} bytes and the store room for {free}; delete jobs or files"
            ),
        ));
    }
    let path = store.file(&hash);
    let number = NUMBER.fetch_add(1, Relaxed);
    let part = path.with_extension(format!("{number}{}", crate::run::files::PART));
    let mut receiving = on_disk(move || Receiving::begin(part)).await?;
    let mut waiting = Vec::with_capacity(PIECE);
    loop {
        let piece = pieces.next().await?;
        let last = piece.is_none();
        waiting.extend_from_slice(&piece.unwrap_or_default());
        if last || waiting.len() >= PIECE {
            let bytes = std::mem::replace(&mut waiting, Vec::with_capacity(PIECE));
            receiving = on_disk(move || receiving.write(&bytes)).await?;
        }
        if last {
            break;
        }
    }
    let expected = hash.clone();
    match on_disk(move || receiving.finish(&expected, &path)).await? {
        Ok(()) => Ok(()),
        Err(found) => Err(Refusal::new(
            StatusCode::UNPROCESSABLE_ENTITY,
            format!(
                "what was sent has the SHA-256 {}, expected {}: it was changed or cut on its way",
                found.digits(),
                hash.digits()
            ),
        )),
    }
}
