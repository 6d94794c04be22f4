//! The jobs, in SQLite. What a client was told is on the disk: each change is one transaction that waits for it.

use super::refusal::Refusal;
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

/// What a job computes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// One frame with its truth: `lasertrace render`.
    Frame,
    /// A whole scan: `lasertrace scan`.
    Scan,
    /// Profiles alone, without images: `lasertrace scan --geometry-only`.
    Profiles,
    /// Many scans of one scene with other values: `lasertrace sweep`.
    Sweep,
    /// What rays meet on a mesh.
    Rays,
}

impl Kind {
    /// As requests and pages name it.
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

/// Where a job is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum State {
    /// It waits for its turn, or for room on the disk.
    Queued,
    /// A process does it.
    Running,
    /// Its results are whole.
    Done,
    /// It cannot be done; `message` says why.
    Failed,
    /// It was deleted and is being stopped.
    Cancelled,
}

/// What a client asks for, but for the body.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Request {
    pub kind: Kind,
    pub frame: u32,
    pub frames: Option<Range<u32>>,
    /// Other forms of the cloud.
    pub also: Vec<String>,
    /// The mesh of rays, and its unit.
    pub mesh: Option<(Hash, Option<Unit>)>,
    /// All files that the job reads.
    pub files: Vec<Hash>,
    /// Files that other files refer to by these names, such as the buffers of a glTF file.
    #[serde(default)]
    pub named: Vec<(String, Hash)>,
}

/// A job as it is in the table.
#[derive(Debug, Clone)]
pub struct Job {
    pub id: String,
    pub request: Request,
    pub state: State,
    /// Times are those of the system's clock, RFC 3339, and nothing depends on them.
    pub created: String,
    pub started: Option<String>,
    pub finished: Option<String>,
    /// Processes that were started for it.
    pub starts: u32,
    pub exit_code: Option<u8>,
    pub message: Option<String>,
}

/// What became of a job that was sent.
pub enum Accepted {
    New(Job),
    /// It had been sent before, with the same key.
    Before(Job),
    /// The key is of another job.
    OtherJob,
    /// So many wait already.
    Full(u32),
}

/// The table of jobs; clones share it.
#[derive(Clone)]
pub struct Jobs(Arc<Mutex<Connection>>);

/// Of a job as [`job`] reads it.
const COLUMNS: &str = "id, request, state, created, started, finished, starts, exit_code, message";

impl Jobs {
    pub fn open(path: &Path) -> Result<Jobs> {
        let open = || -> rusqlite::Result<Connection> {
            let connection = Connection::open(path)?;
            // Only one service has the store. Without shared memory, which would be a file, a full disk
            // does not hinder opening.
            connection.pragma_update(None, "locking_mode", "EXCLUSIVE")?;
            // Takes effect in a new table only; an older one is rewritten once.
            connection.pragma_update(None, "auto_vacuum", "INCREMENTAL")?;
            connection.pragma_update(None, "journal_mode", "WAL")?;
            // Also after a loss of power.
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
                // Needs room for a copy: at the latest when there is some.
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
    ) -> std::result::Result<T, Refusal> {
        let connection = self.0.clone();
        let done = on_disk(move || {
            // A panic within a transaction rolls it back.
            work(&mut connection.lock().unwrap_or_else(PoisonError::into_inner))
        });
        done.await.map_err(|error| {
            Refusal::from(Error::Io {
                action: "write",
                file: "jobs.db".into(),
                source: as_io(error),
            })
        })
    }

    /// Keeps a job, once for each key. `sum` is that of all that the client sent.
    pub async fn add(
        &self,
        key: Option<String>,
        sum: String,
        request: Request,
        body: Vec<u8>,
        longest: u32,
    ) -> std::result::Result<Accepted, Refusal> {
        self.with(move |connection| {
            let change = connection.transaction()?;
            if let Some(key) = &key {
                let select = format!("SELECT {COLUMNS}, sum FROM jobs WHERE key = ?1");
                let row = |row: &Row| Ok((job(row)?, row.get::<_, String>("sum")?));
                if let Some((before, its)) = change.query_row(&select, [key], row).optional()? {
                    return Ok(match its == sum {
                        true => Accepted::Before(before),
                        false => Accepted::OtherJob,
                    });
                }
            }
            let waiting = "SELECT count(*) FROM jobs WHERE state = 'queued'";
            let waiting: u32 = change.query_row(waiting, [], |row| row.get(0))?;
            if waiting >= longest {
                return Ok(Accepted::Full(waiting));
            }
            let text = serde_json::to_string(&request).expect("a request is JSON");
            let insert = format!(
                "INSERT INTO jobs (id, key, sum, request, body, state, created)
                 VALUES (lower(hex(randomblob(16))), ?1, ?2, ?3, ?4, 'queued', ?5) RETURNING {COLUMNS}"
            );
            let values = params![key, sum, text, body, now()];
            let new = change.query_row(&insert, values, job)?;
            change.commit()?;
            Ok(Accepted::New(new))
        })
        .await
    }

    pub async fn get(&self, id: &str) -> std::result::Result<Option<Job>, Refusal> {
        let id = id.to_owned();
        let select = format!("SELECT {COLUMNS} FROM jobs WHERE id = ?1");
        self.with(move |connection| connection.query_row(&select, [id], job).optional())
            .await
    }

    /// The body that was sent.
    pub async fn body(&self, id: &str) -> std::result::Result<Vec<u8>, Refusal> {
        let id = id.to_owned();
        let select = "SELECT body FROM jobs WHERE id = ?1";
        self.with(move |connection| connection.query_row(select, [id], |row| row.get(0)))
            .await
    }

    /// The last jobs, the newest first.
    pub async fn last(&self, count: u32) -> std::result::Result<Vec<Job>, Refusal> {
        let select = format!("SELECT {COLUMNS} FROM jobs ORDER BY number DESC LIMIT ?1");
        self.with(move |connection| {
            connection
                .prepare(&select)?
                .query_map([count], job)?
                .collect()
        })
        .await
    }

    /// Jobs in these states, the oldest first.
    pub async fn in_state(&self, state: State) -> std::result::Result<Vec<Job>, Refusal> {
        let select = format!("SELECT {COLUMNS} FROM jobs WHERE state = ?1 ORDER BY number");
        self.with(move |connection| {
            let mut rows = connection.prepare(&select)?;
            rows.query_map([word(state)], job)?.collect()
        })
        .await
    }

    /// How many there are in each state.
    pub async fn counts(&self) -> std::result::Result<BTreeMap<String, u32>, Refusal> {
        let select = "SELECT state, count(*) FROM jobs GROUP BY state";
        self.with(move |connection| {
            let mut rows = connection.prepare(select)?;
            rows.query_map([], |row| Ok((row.get(0)?, row.get(1)?)))?
                .collect()
        })
        .await
    }

    /// Takes the oldest job that waits; it runs from now on.
    pub async fn take(&self) -> std::result::Result<Option<Job>, Refusal> {
        let update = format!(
            "UPDATE jobs SET state = 'running', started = coalesce(started, ?1)
             WHERE number = (SELECT min(number) FROM jobs WHERE state = 'queued') RETURNING {COLUMNS}"
        );
        self.with(move |connection| connection.query_row(&update, [now()], job).optional())
            .await
    }

    /// Counts a process that is started for the job, or that died without a word; how many there were.
    pub async fn count(&self, id: &str, died: bool) -> std::result::Result<u32, Refusal> {
        let id = id.to_owned();
        let column = if died { "deaths" } else { "starts" };
        let update =
            format!("UPDATE jobs SET {column} = {column} + 1 WHERE id = ?1 RETURNING {column}");
        self.with(move |connection| connection.query_row(&update, [id], |row| row.get(0)))
            .await
    }

    /// The end of a job that runs, or its return to those that wait; whether it was not deleted meanwhile.
    pub async fn leave(
        &self,
        id: &str,
        state: State,
        exit_code: Option<u8>,
        message: Option<String>,
    ) -> std::result::Result<bool, Refusal> {
        let id = id.to_owned();
        let finished = (state != State::Queued).then(now);
        let update = "UPDATE jobs SET state = ?2, exit_code = ?3, message = ?4, finished = ?5
                      WHERE id = ?1 AND state = 'running'";
        self.with(move |connection| {
            let values = params![id, word(state), exit_code, message, finished];
            Ok(connection.execute(update, values)? == 1)
        })
        .await
    }

    /// Whether there is such a job that no process does: it can be taken out at once.
    pub async fn rests(&self, id: &str) -> std::result::Result<bool, Refusal> {
        let job = self.get(id).await?;
        Ok(job.is_some_and(|job| !matches!(job.state, State::Running | State::Cancelled)))
    }

    /// Marks a job that runs as deleted; or takes out one that does not. The state it was in.
    pub async fn delete(&self, id: &str) -> std::result::Result<Option<State>, Refusal> {
        let id = id.to_owned();
        self.with(move |connection| {
            let change = connection.transaction()?;
            let select = format!("SELECT {COLUMNS} FROM jobs WHERE id = ?1");
            let Some(job) = change.query_row(&select, [&id], job).optional()? else {
                return Ok(None);
            };
            match job.state {
                State::Running => {
                    change.execute("UPDATE jobs SET state = 'cancelled' WHERE id = ?1", [&id])?
                }
                State::Cancelled => 0,
                _ => change.execute("DELETE FROM jobs WHERE id = ?1", [&id])?,
            };
            change.commit()?;
            Ok(Some(job.state))
        })
        .await
    }

    /// Returns the pages of deleted jobs to the file system.
    pub async fn shrink(&self) -> std::result::Result<(), Refusal> {
        self.with(|connection| {
            // The log is emptied first: what it holds takes room too.
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

    /// Takes out a job that was deleted while it ran.
    pub async fn forget(&self, id: &str) -> std::result::Result<(), Refusal> {
        let id = id.to_owned();
        let delete = "DELETE FROM jobs WHERE id = ?1 AND state = 'cancelled'";
        self.with(move |connection| connection.execute(delete, [id]).map(drop))
            .await
    }

    /// Whether a job that is not done yet reads this file.
    pub async fn reads(&self, hash: &Hash) -> std::result::Result<bool, Refusal> {
        let digits = hash.digits().to_owned();
        let select = "SELECT EXISTS (SELECT 1 FROM jobs WHERE state IN ('queued', 'running')
                      AND instr(request, ?1))";
        self.with(move |connection| connection.query_row(select, [digits], |row| row.get(0)))
            .await
    }

    /// Whether the table can be written.
    pub async fn write_nothing(&self) -> std::result::Result<(), Refusal> {
        self.with(|connection| {
            // Takes the lock for writing, and writes a page.
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

const WORDS: [(State, &str); 5] = [
    (State::Queued, "queued"),
    (State::Running, "running"),
    (State::Done, "done"),
    (State::Failed, "failed"),
    (State::Cancelled, "cancelled"),
];

pub fn word(state: State) -> &'static str {
    let found = WORDS.iter().find(|(other, _)| *other == state);
    found.expect("each state has a word").1
}

fn state(word: &str) -> State {
    let found = WORDS.iter().find(|(_, other)| *other == word);
    found.map_or(State::Failed, |(state, _)| *state)
}

fn now() -> String {
    humantime::format_rfc3339_millis(SystemTime::now()).to_string()
}

/// SQLite's word for a full disk is the system's.
fn as_io(error: rusqlite::Error) -> std::io::Error {
    match error.sqlite_error_code() {
        Some(ErrorCode::DiskFull) => std::io::ErrorKind::StorageFull.into(),
        // So it says that the log cannot grow; nothing else of its files is written at once.
        _ => std::io::Error::other(error),
    }
}

impl Refusal {
    /// There is no such job.
    pub fn no_job(id: &str) -> Refusal {
        Refusal::new(StatusCode::NOT_FOUND, format!("there is no job {id}"))
    }
}
