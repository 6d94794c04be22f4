//! Request bodies, with limits on their size and a minimum transfer rate.

use super::refusal::HttpError;
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

/// Timeout for receiving data from a client.
const SILENCE: Duration = Duration::from_secs(10);
/// Minimum average transfer rate after the first [`SILENCE`], bytes per second.
const SLOWEST: f64 = 16e3;
/// Size of a write to disk, bytes.
const PIECE: usize = 1 << 18;

/// Chunks of a request body.
struct Pieces {
    stream: BodyDataStream,
    start: Instant,
    received: u64,
    largest: u64,
}

impl Pieces {
    /// Creates the chunks of a body. Returns an error if `length` exceeds `largest`.
    fn of(body: Body, length: Option<u64>, largest: u64) -> Result<Pieces, HttpError> {
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

    async fn next(&mut self) -> Result<Option<Bytes>, HttpError> {
        let slow = |what: &str| HttpError::new(StatusCode::REQUEST_TIMEOUT, what);
        let next = tokio::time::timeout(SILENCE, self.stream.next()).await;
        let piece = match next.map_err(|_| slow("the body stopped coming"))? {
            None => return Ok(None),
            Some(Ok(piece)) => piece,
            Some(Err(error)) => {
                return Err(HttpError::new(StatusCode::BAD_REQUEST, error.to_string()));
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

fn too_large(largest: u64) -> HttpError {
    let message = format!("the body is larger than {largest} bytes");
    HttpError::new(StatusCode::PAYLOAD_TOO_LARGE, message)
}

/// Returns the value of the header Content-Length.
pub fn length(headers: &HeaderMap) -> Option<u64> {
    let value = headers.get(header::CONTENT_LENGTH)?;
    value.to_str().ok()?.parse().ok()
}

/// Reads a body to its end and discards it. Stops if it is too slow or has more than `largest`
/// bytes.
pub async fn discard(body: Body, length: Option<u64>, largest: u64) {
    if let Ok(mut pieces) = Pieces::of(body, length, largest) {
        while let Ok(Some(_)) = pieces.next().await {}
    }
}

/// Reads a complete body into memory.
pub async fn whole(body: Body, length: Option<u64>, largest: u64) -> Result<Vec<u8>, HttpError> {
    let mut pieces = Pieces::of(body, length, largest)?;
    let mut bytes = Vec::new();
    while let Some(piece) = pieces.next().await? {
        bytes.extend_from_slice(&piece);
    }
    Ok(bytes)
}

/// File that is being received. It is removed on drop unless it was completed.
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

    /// Renames the file to `path`. Returns the actual hash as an error if it differs from `hash`.
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
        // After a rename, no file has this name.
        let _ = fs::remove_file(&self.path);
    }
}

/// Runs blocking disk work on a separate thread.
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
) -> Result<(), HttpError> {
    static NUMBER: AtomicU64 = AtomicU64::new(0);
    let mut pieces = Pieces::of(body, length, largest)?;
    if let (Some(length), Some(free)) = (length, store.free())
        && length > free
    {
        return Err(HttpError::new(
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
        Err(found) => Err(HttpError::new(
            StatusCode::UNPROCESSABLE_ENTITY,
            format!(
                "what was sent has the SHA-256 {}, expected {}: it was changed or cut on its way",
                found.digits(),
                hash.digits()
            ),
        )),
    }
}
