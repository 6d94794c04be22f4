//! Job table in SQLite. Each change is a transaction that is durable on disk before the client
//! receives a response.

use super::refusal::HttpError;
use super::store::Hash;
use super::upload::on_disk;
use crate::error::{Error, Result};
use crate::scene::Unit;
use axum::http::StatusCode;
use rusqlite::types::Type;
use rusqlite::{Connection, ErrorCode, OptionalExtension, Row, params};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::SystemTime;
use utoipa::ToSchema;

/// Kind of job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// One frame with ground truth: `lasertrace render`.
    Frame,
    /// A complete scan: `lasertrace scan`.
    Scan,
    /// Profiles without images: `lasertrace scan --geometry-only`.
    Profiles,
    /// Many scans of a scene with varied values: `lasertrace sweep`.
    Sweep,
    /// Intersections of rays with a mesh.
    Rays,
}

impl Kind {
    /// Returns the name used in requests and pages.
    pub fn name(self) -> &'static str {
        match self {
            Kind::Frame => "frame",
            Kind::Scan => "scan",
            Kind::Profiles => "profiles",
            Kind::Sweep => "sweep",
            Kind::Rays => "rays",
        }
    }
}

/// State of a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum JobState {
    /// Waiting for its turn or for free disk space.
    Queued,
    /// A process executes the job.
    Running,
    /// The results are complete.
    Done,
    /// The job failed; `message` contains the reason.
    Failed,
    /// The job was deleted and is being stopped.
    Cancelled,
}

/// Request of a client without the body.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Request {
    pub kind: Kind,
    pub frame: u32,
    pub frames: Option<Range<u32>>,
    /// Additional formats of the point cloud.
    pub also: Vec<String>,
    /// Mesh of a job of kind `Rays`, and its unit.
    pub mesh: Option<(Hash, Option<Unit>)>,
    /// All files that the job reads.
    pub files: Vec<Hash>,
    /// Files that other files refer to by these names, such as the buffers of a glTF file.
    #[serde(default)]
    pub named: Vec<(String, Hash)>,
}

/// A job as stored in the table.
#[derive(Debug, Clone)]
pub struct Job {
    pub id: String,
    pub request: Request,
    pub state: JobState,
    /// Times are from the system clock (RFC 3339); they are informational.
    pub created: String,
    pub started: Option<String>,
    pub finished: Option<String>,
    /// Number of processes started for the job.
    pub starts: u32,
    pub exit_code: Option<u8>,
    pub message: Option<String>,
}

/// Result of submitting a job.
pub enum SubmitResult {
    New(Job),
    /// The job was submitted before with this key.
    Before(Job),
    /// The key belongs to a different job.
    OtherJob,
    /// The queue is full with the given number of jobs.
    Full(u32),
}

/// Job table; clones share the connection.
#[derive(Clone)]
pub struct Jobs(Arc<Mutex<Connection>>);

/// Columns that [`job`] reads.
const COLUMNS: &str = "id, request, state, created, started, finished, starts, exit_code, message";

impl Jobs {
    pub fn open(path: &Path) -> Result<Jobs> {
        let open = || -> rusqlite::Result<Connection> {
            let connection = Connection::open(path)?;
            // Only one service uses the store. Without shared memory, which needs a file, the table
            // can be opened on a full disk.
            connection.pragma_update(None, "locking_mode", "EXCLUSIVE")?;
            // Takes effect in a new table only; an older one is rewritten once.
            connection.pragma_update(None, "auto_vacuum", "INCREMENTAL")?;
            connection.pragma_update(None, "journal_mode", "WAL")?;
            // Durable after a power failure.
            connection.pragma_update(None, "synchronous", "FULL")?;
            connection.execute_batch(
                "CREATE TABLE IF NOT EXISTS jobs (
                    number INTEGER PRIMARY KEY AUTOINCREMENT,
                    id TEXT NOT NULL UNIQUE,
                    key TEXT UNIQUE,
                    sum TEXT NOT NULL,
                    request TEXT NOT NULL,
                    body BLOB NOT NULL,
                    state TEXT NOT NULL,
                    created TEXT NOT NULL,
                    started TEXT,
                    finished TEXT,
                    starts INTEGER NOT NULL DEFAULT 0,
                    deaths INTEGER NOT NULL DEFAULT 0,
                    exit_code INTEGER,
                    message TEXT
                );
                CREATE INDEX IF NOT EXISTS by_state ON jobs (state, number);",
            )?;
            let mode: u32 = connection.query_row("PRAGMA auto_vacuum", [], |row| row.get(0))?;
            if mode == 0 {
                // Needs disk space for a copy. If it fails, it is repeated at the next start.
                let _ = connection.execute_batch("VACUUM");
            }
            Ok(connection)
        };
        let connection = open().map_err(|error| Error::Io {
            action: "open",
            file: path.to_owned(),
            source: as_io(error),
        })?;
        Ok(Jobs(Arc::new(Mutex::new(connection))))
    }

    async fn with<T: Send + 'static>(
        &self,
        work: impl FnOnce(&mut Connection) -> rusqlite::Result<T> + Send + 'static,
    ) -> std::result::Result<T, HttpError> {
        let connection = self.0.clone();
        let done = on_disk(move || {
            // A panic within a transaction rolls it back.
            work(&mut connection.lock().unwrap_or_else(PoisonError::into_inner))
        });
        done.await.map_err(|error| {
            HttpError::from(Error::Io {
                action: "write",
                file: "jobs.db".into(),
                source: as_io(error),
            })
        })
    }

    /// Adds a job, once for each key. `sum` is a checksum of the complete request.
    pub async fn add(
        &self,
        key: Option<String>,
        sum: String,
        request: Request,
        body: Vec<u8>,
        longest: u32,
    ) -> std::result::Result<SubmitResult, HttpError> {
        self.with(move |connection| {
            let change = connection.transaction()?;
            if let Some(key) = &key {
                let select = format!("SELECT {COLUMNS}, sum FROM jobs WHERE key = ?1");
                let row = |row: &Row| Ok((job(row)?, row.get::<_, String>("sum")?));
                if let Some((before, its)) = change.query_row(&select, [key], row).optional()? {
                    return Ok(match its == sum {
                        true => SubmitResult::Before(before),
                        false => SubmitResult::OtherJob,
                    });
                }
            }
            let waiting = "SELECT count(*) FROM jobs WHERE state = 'queued'";
            let waiting: u32 = change.query_row(waiting, [], |row| row.get(0))?;
            if waiting >= longest {
                return Ok(SubmitResult::Full(waiting));
            }
            let text = serde_json::to_string(&request).expect("a request is JSON");
            let insert = format!(
                "INSERT INTO jobs (id, key, sum, request, body, state, created)
                 VALUES (lower(hex(randomblob(16))), ?1, ?2, ?3, ?4, 'queued', ?5) RETURNING {COLUMNS}"
            );
            let values = params![key, sum, text, body, now()];
            let new = change.query_row(&insert, values, job)?;
            change.commit()?;
            Ok(SubmitResult::New(new))
        })
        .await
    }

    pub async fn get(&self, id: &str) -> std::result::Result<Option<Job>, HttpError> {
        let id = id.to_owned();
        let select = format!("SELECT {COLUMNS} FROM jobs WHERE id = ?1");
        self.with(move |connection| connection.query_row(&select, [id], job).optional())
            .await
    }

    /// Returns the body of the request.
    pub async fn body(&self, id: &str) -> std::result::Result<Vec<u8>, HttpError> {
        let id = id.to_owned();
        let select = "SELECT body FROM jobs WHERE id = ?1";
        self.with(move |connection| connection.query_row(select, [id], |row| row.get(0)))
            .await
    }

    /// Returns the last `count` jobs, newest first.
    pub async fn last(&self, count: u32) -> std::result::Result<Vec<Job>, HttpError> {
        let select = format!("SELECT {COLUMNS} FROM jobs ORDER BY number DESC LIMIT ?1");
        self.with(move |connection| {
            connection
                .prepare(&select)?
                .query_map([count], job)?
                .collect()
        })
        .await
    }

    /// Returns the jobs in a state, oldest first.
    pub async fn in_state(&self, state: JobState) -> std::result::Result<Vec<Job>, HttpError> {
        let select = format!("SELECT {COLUMNS} FROM jobs WHERE state = ?1 ORDER BY number");
        self.with(move |connection| {
            let mut rows = connection.prepare(&select)?;
            rows.query_map([word(state)], job)?.collect()
        })
        .await
    }

    /// Returns the number of jobs in each state.
    pub async fn counts(&self) -> std::result::Result<BTreeMap<String, u32>, HttpError> {
        let select = "SELECT state, count(*) FROM jobs GROUP BY state";
        self.with(move |connection| {
            let mut rows = connection.prepare(select)?;
            rows.query_map([], |row| Ok((row.get(0)?, row.get(1)?)))?
                .collect()
        })
        .await
    }

    /// Takes the oldest waiting job and marks it as running.
    pub async fn take(&self) -> std::result::Result<Option<Job>, HttpError> {
        let update = format!(
            "UPDATE jobs SET state = 'running', started = coalesce(started, ?1)
             WHERE number = (SELECT min(number) FROM jobs WHERE state = 'queued') RETURNING {COLUMNS}"
        );
        self.with(move |connection| connection.query_row(&update, [now()], job).optional())
            .await
    }

    /// Increments the number of started or, if `died`, of crashed processes of a job. Returns the
    /// new number.
    pub async fn count(&self, id: &str, died: bool) -> std::result::Result<u32, HttpError> {
        let id = id.to_owned();
        let column = if died { "deaths" } else { "starts" };
        let update =
            format!("UPDATE jobs SET {column} = {column} + 1 WHERE id = ?1 RETURNING {column}");
        self.with(move |connection| connection.query_row(&update, [id], |row| row.get(0)))
            .await
    }

    /// Records the end of a running job or its return to the queue. Returns false if the job was
    /// deleted meanwhile.
    pub async fn finish_or_requeue(
        &self,
        id: &str,
        state: JobState,
        exit_code: Option<u8>,
        message: Option<String>,
    ) -> std::result::Result<bool, HttpError> {
        let id = id.to_owned();
        let finished = (state != JobState::Queued).then(now);
        let update = "UPDATE jobs SET state = ?2, exit_code = ?3, message = ?4, finished = ?5
                      WHERE id = ?1 AND state = 'running'";
        self.with(move |connection| {
            let values = params![id, word(state), exit_code, message, finished];
            Ok(connection.execute(update, values)? == 1)
        })
        .await
    }

    /// Returns true if the job exists and no process executes it, so it can be removed immediately.
    pub async fn rests(&self, id: &str) -> std::result::Result<bool, HttpError> {
        let job = self.get(id).await?;
        Ok(job.is_some_and(|job| !matches!(job.state, JobState::Running | JobState::Cancelled)))
    }

    /// Removes a job; a running one is only marked as deleted. Returns its previous state.
    pub async fn delete(&self, id: &str) -> std::result::Result<Option<JobState>, HttpError> {
        let id = id.to_owned();
        self.with(move |connection| {
            let change = connection.transaction()?;
            let select = format!("SELECT {COLUMNS} FROM jobs WHERE id = ?1");
            let Some(job) = change.query_row(&select, [&id], job).optional()? else {
                return Ok(None);
            };
            match job.state {
                JobState::Running => {
                    change.execute("UPDATE jobs SET state = 'cancelled' WHERE id = ?1", [&id])?
                }
                JobState::Cancelled => 0,
                _ => change.execute("DELETE FROM jobs WHERE id = ?1", [&id])?,
            };
            change.commit()?;
            Ok(Some(job.state))
        })
        .await
    }

    /// Returns the pages of deleted jobs to the file system.
    pub async fn shrink(&self) -> std::result::Result<(), HttpError> {
        self.with(|connection| {
            // The write-ahead log is emptied first, because it occupies space too.
            let empty_log = "PRAGMA wal_checkpoint(TRUNCATE)";
            for pragma in [empty_log, "PRAGMA incremental_vacuum", empty_log] {
                let mut rows = connection.prepare(pragma)?;
                let mut rows = rows.query([])?;
                while rows.next()?.is_some() {}
            }
            Ok(())
        })
        .await
    }

    /// Removes a job that was deleted while it ran.
    pub async fn remove(&self, id: &str) -> std::result::Result<(), HttpError> {
        let id = id.to_owned();
        let delete = "DELETE FROM jobs WHERE id = ?1 AND state = 'cancelled'";
        self.with(move |connection| connection.execute(delete, [id]).map(drop))
            .await
    }

    /// Returns true if an unfinished job reads this file.
    pub async fn reads(&self, hash: &Hash) -> std::result::Result<bool, HttpError> {
        let digits = hash.digits().to_owned();
        let select = "SELECT EXISTS (SELECT 1 FROM jobs WHERE state IN ('queued', 'running')
                      AND instr(request, ?1))";
        self.with(move |connection| connection.query_row(select, [digits], |row| row.get(0)))
            .await
    }

    /// Checks that the table is writable.
    pub async fn write_nothing(&self) -> std::result::Result<(), HttpError> {
        self.with(|connection| {
            // Acquires the write lock and writes a page.
            connection.execute_batch("BEGIN IMMEDIATE; PRAGMA user_version = 1; COMMIT")
        })
        .await
    }
}

fn job(row: &Row) -> rusqlite::Result<Job> {
    let request: String = row.get("request")?;
    let request = serde_json::from_str(&request);
    Ok(Job {
        id: row.get("id")?,
        request: request.map_err(|error| {
            rusqlite::Error::FromSqlConversionFailure(1, Type::Text, error.into())
        })?,
        state: state(&row.get::<_, String>("state")?),
        created: row.get("created")?,
        started: row.get("started")?,
        finished: row.get("finished")?,
        starts: row.get("starts")?,
        exit_code: row.get("exit_code")?,
        message: row.get("message")?,
    })
}

const WORDS: [(JobState, &str); 5] = [
    (JobState::Queued, "queued"),
    (JobState::Running, "running"),
    (JobState::Done, "done"),
    (JobState::Failed, "failed"),
    (JobState::Cancelled, "cancelled"),
];

pub fn word(state: JobState) -> &'static str {
    let found = WORDS.iter().find(|(other, _)| *other == state);
    found.expect("each state has a word").1
}

fn state(word: &str) -> JobState {
    let found = WORDS.iter().find(|(_, other)| *other == word);
    found.map_or(JobState::Failed, |(state, _)| *state)
}

fn now() -> String {
    humantime::format_rfc3339_millis(SystemTime::now()).to_string()
}

/// Converts an SQLite error; a full disk becomes `StorageFull`.
fn as_io(error: rusqlite::Error) -> std::io::Error {
    match error.sqlite_error_code() {
        Some(ErrorCode::DiskFull) => std::io::ErrorKind::StorageFull.into(),
        _ => std::io::Error::other(error),
    }
}

impl HttpError {
    /// Returns the response for an unknown job.
    pub fn no_job(id: &str) -> HttpError {
        HttpError::new(StatusCode::NOT_FOUND, format!("there is no job {id}"))
    }
}
