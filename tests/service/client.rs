//! A service of a test's own, and requests to it by hand: a client that helps would not send what attacks do.

use serde_json::Value;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

/// A test waits no longer for anything.
pub const PATIENCE: Duration = Duration::from_secs(120);

pub struct Served {
    child: Child,
    pub address: SocketAddr,
}

impl Served {
    pub fn start(store: &Path, more: &[&str]) -> Served {
        Served::start_with(store, more, None)
    }

    pub fn start_with(store: &Path, more: &[&str], token: Option<&str>) -> Served {
        let mut command = Command::new(env!("CARGO_BIN_EXE_lasertrace"));
        command
            .args([
                "serve",
                "--json",
                "--quiet",
                "--listen",
                "127.0.0.1:0",
                "--threads",
                "1",
                "--store",
            ])
            .arg(store)
            .args(more)
            .env_remove("LASERTRACE_TOKEN")
            .stdout(Stdio::piped())
            .stderr(Stdio::null());
        if let Some(token) = token {
            command.env("LASERTRACE_TOKEN", token);
        }
        let mut child = command.spawn().unwrap();
        let mut line = String::new();
        let out = child.stdout.take().unwrap();
        BufReader::new(out).read_line(&mut line).unwrap();
        let said: Value = serde_json::from_str(&line).unwrap_or_else(|_| panic!("said {line:?}"));
        let url = said["listening"].as_str().unwrap();
        let address = url.strip_prefix("http://").unwrap().parse().unwrap();
        Served { child, address }
    }

    pub fn process(&self) -> u32 {
        self.child.id()
    }

    /// As `kill -9` does.
    pub fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    pub fn send(&self, bytes: &[u8]) -> TcpStream {
        let mut stream = TcpStream::connect(self.address).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        stream.write_all(bytes).unwrap();
        stream
    }

    pub fn ask(&self, method: &str, path: &str, headers: &[(&str, &str)], body: &[u8]) -> Answer {
        let host = self.address.to_string();
        let mut head = format!("{method} {path} HTTP/1.1\r\nConnection: close\r\n");
        if !headers.iter().any(|(name, _)| *name == "Host") {
            head += &format!("Host: {host}\r\n");
        }
        for (name, value) in headers {
            head += &format!("{name}: {value}\r\n");
        }
        head += &format!("Content-Length: {}\r\n\r\n", body.len());
        let mut stream = self.send(head.as_bytes());
        // A service that refuses may close before it has read all.
        let _ = stream.write_all(body);
        let mut bytes = Vec::new();
        let _ = stream.read_to_end(&mut bytes);
        Answer::of(&bytes, method == "HEAD")
    }

    /// Sends a request as Python's `http.client` does: the whole body before the answer is read.
    pub fn ask_after_body(&self, method: &str, path: &str, body: &[u8]) -> std::io::Result<Answer> {
        let head = format!(
            "{method} {path} HTTP/1.1\r\nHost: {}\r\nContent-Length: {}\r\nConnection: close\r\n\r\n",
            self.address,
            body.len()
        );
        let mut stream = self.send(head.as_bytes());
        for piece in body.chunks(1 << 13) {
            stream.write_all(piece)?;
        }
        let mut bytes = Vec::new();
        stream.read_to_end(&mut bytes)?;
        Ok(Answer::of(&bytes, false))
    }

    pub fn get(&self, path: &str) -> Answer {
        self.ask("GET", path, &[], b"")
    }

    /// Sends a file; how scenes name it.
    pub fn put(&self, bytes: &[u8]) -> String {
        let digits = digits(bytes);
        let answer = self.ask("PUT", &format!("/v1/files/{digits}"), &[], bytes);
        assert!(matches!(answer.status, 200 | 201), "{answer:?}");
        format!("sha256:{digits}")
    }

    pub fn post(&self, query: &str, headers: &[(&str, &str)], body: &str) -> Answer {
        let kind = match query.contains("kind=rays") {
            true => "application/json",
            false => "application/toml",
        };
        let mut all = vec![("Content-Type", kind)];
        all.extend(headers);
        self.ask("POST", &format!("/v1/jobs?{query}"), &all, body.as_bytes())
    }

    /// Sends a job that is taken; its number.
    #[track_caller]
    pub fn job(&self, query: &str, body: &str) -> String {
        let answer = self.post(query, &[], body);
        assert_eq!(answer.status, 202, "{answer:?}");
        answer.json()["id"].as_str().unwrap().to_owned()
    }

    pub fn state(&self, id: &str) -> Value {
        let answer = self.get(&format!("/v1/jobs/{id}"));
        assert_eq!(answer.status, 200, "{answer:?}");
        answer.json()
    }

    /// The job when `holds` of it.
    #[track_caller]
    pub fn wait(&self, id: &str, holds: impl Fn(&Value) -> bool) -> Value {
        let start = Instant::now();
        loop {
            let job = self.state(id);
            if holds(&job) {
                return job;
            }
            assert!(start.elapsed() < PATIENCE, "{job}");
            sleep(Duration::from_millis(30));
        }
    }

    #[track_caller]
    pub fn end(&self, id: &str) -> Value {
        self.wait(id, |job| {
            matches!(job["state"].as_str(), Some("done" | "failed"))
        })
    }

    #[track_caller]
    pub fn done(&self, id: &str) -> Value {
        let job = self.end(id);
        assert_eq!(job["state"], "done", "{job}");
        job
    }

    /// All result files of a job.
    pub fn results(&self, id: &str) -> BTreeMap<String, Vec<u8>> {
        let list = self.get(&format!("/v1/jobs/{id}/files")).json();
        let names = list
            .as_array()
            .unwrap()
            .iter()
            .map(|file| file["name"].as_str().unwrap().to_owned());
        names
            .map(|name| {
                let answer = self.get(&format!("/v1/jobs/{id}/files/{name}"));
                assert_eq!(answer.status, 200, "{name}");
                (name, answer.body)
            })
            .collect()
    }

    /// Value of a metric.
    pub fn metric(&self, name: &str) -> f64 {
        let page = String::from_utf8(self.get("/metrics").body).unwrap();
        let line = page
            .lines()
            .find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
        line.unwrap_or_else(|| panic!("no {name} in {page}"))
            .parse()
            .unwrap()
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        // In order, so that its jobs' processes end too.
        let _ = Command::new("kill")
            .arg(self.child.id().to_string())
            .status();
        let start = Instant::now();
        while matches!(self.child.try_wait(), Ok(None)) && start.elapsed() < Duration::from_secs(5)
        {
            sleep(Duration::from_millis(10));
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

pub struct Answer {
    /// 0: the connection was closed without one.
    pub status: u16,
    pub headers: BTreeMap<String, String>,
    pub body: Vec<u8>,
}

impl std::fmt::Debug for Answer {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        write!(f, "{} {}", self.status, String::from_utf8_lossy(&self.body))
    }
}

impl Answer {
    pub fn of(bytes: &[u8], no_body: bool) -> Answer {
        let end = bytes.windows(4).position(|four| four == b"\r\n\r\n");
        let (head, body) = match end {
            Some(end) => (&bytes[..end], &bytes[end + 4..]),
            None => (bytes, &b""[..]),
        };
        let head = String::from_utf8_lossy(head);
        let mut lines = head.lines();
        let status = lines
            .next()
            .and_then(|line| line.split(' ').nth(1)?.parse().ok())
            .unwrap_or(0);
        let headers: BTreeMap<String, String> = lines
            .filter_map(|line| line.split_once(": "))
            .map(|(name, value)| (name.to_lowercase(), value.to_owned()))
            .collect();
        let body = match headers.get("transfer-encoding") {
            Some(_) => chunks(body),
            None => body.to_vec(),
        };
        if let (Some(length), false) = (headers.get("content-length"), no_body) {
            assert_eq!(length.parse(), Ok(body.len()), "{head}");
        }
        Answer {
            status,
            headers,
            body,
        }
    }

    #[track_caller]
    pub fn json(&self) -> Value {
        serde_json::from_slice(&self.body).unwrap_or_else(|_| panic!("{self:?}"))
    }

    pub fn text(&self) -> String {
        String::from_utf8_lossy(&self.body).into_owned()
    }
}

fn chunks(mut body: &[u8]) -> Vec<u8> {
    let mut whole = Vec::new();
    while let Some(end) = body.windows(2).position(|two| two == b"\r\n") {
        let length = std::str::from_utf8(&body[..end]).unwrap();
        let length = usize::from_str_radix(length, 16).unwrap();
        let rest = &body[end + 2..];
        if length == 0 || rest.len() < length + 2 {
            break;
        }
        whole.extend_from_slice(&rest[..length]);
        body = &rest[length + 2..];
    }
    whole
}

pub fn digits(bytes: &[u8]) -> String {
    Sha256::digest(bytes)
        .iter()
        .map(|byte| format!("{byte:02x}"))
        .collect()
}

/// A square of 16 mm as STL.
pub const SQUARE: &str = "solid square
facet normal 0 0 1
outer loop
vertex -8 -8 0
vertex 8 -8 0
vertex 8 8 0
endloop
endfacet
facet normal 0 0 1
outer loop
vertex -8 -8 0
vertex 8 8 0
vertex -8 8 0
endloop
endfacet
endsolid square
";

/// A scene of three frames of [`SQUARE`].
pub fn square_scene() -> String {
    let digits = digits(SQUARE.as_bytes());
    super::program::scene(&format!(
        "mesh = {{ file = \"sha256:{digits}\", unit = \"mm\" }}"
    ))
}

/// The same of many frames.
pub fn long_scene(frames: u32) -> String {
    square_scene()
        .replace("frames = 3", &format!("frames = {frames}"))
        .replace("step_mm = 0.5", "step_mm = 0.01")
}

/// What the command line gives of the same scene in a folder of its own.
pub fn by_command(scene: &str, arguments: &[&str]) -> BTreeMap<String, Vec<u8>> {
    let folder = tempfile::tempdir().unwrap();
    let inputs = folder.path().join("in");
    fs::create_dir(&inputs).unwrap();
    fs::write(inputs.join("scene.toml"), scene).unwrap();
    let mesh = format!("sha256:{}", digits(SQUARE.as_bytes()));
    fs::write(inputs.join(mesh), SQUARE).unwrap();
    let (code, _, said) = super::program::run(folder.path(), arguments);
    assert_eq!(code, 0, "{said}");
    let mut found = BTreeMap::new();
    let mut left = vec![folder.path().join("out")];
    while let Some(next) = left.pop() {
        for entry in fs::read_dir(&next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                // The lists of names are no results of a job.
                left.extend(Some(path).filter(|path| !path.ends_with(".lasertrace")));
            } else {
                let name = path.strip_prefix(folder.path().join("out")).unwrap();
                found.insert(name.to_str().unwrap().to_owned(), fs::read(&path).unwrap());
            }
        }
    }
    found
}

/// Asserts that two runs gave the same bytes but for their times.
#[track_caller]
pub fn assert_same(mut a: BTreeMap<String, Vec<u8>>, mut b: BTreeMap<String, Vec<u8>>) {
    for files in [&mut a, &mut b] {
        if let Some(report) = files.get_mut("report.html") {
            let text = String::from_utf8(std::mem::take(report)).unwrap();
            *report = text
                .split("<h2>The run</h2>")
                .next()
                .unwrap()
                .to_owned()
                .into_bytes();
        }
        if let Some(manifest) = files.get_mut("manifest.json") {
            let mut value: Value = serde_json::from_slice(manifest).unwrap();
            let table = value.as_object_mut().unwrap();
            table.retain(|key, _| {
                !key.starts_with("seconds") && key != "date" && key != "frames_resumed"
            });
            table.remove("threads");
            *manifest = value.to_string().into_bytes();
        }
    }
    let names: Vec<&String> = a.keys().collect();
    assert_eq!(names, b.keys().collect::<Vec<_>>());
    let differ: Vec<&String> = names
        .into_iter()
        .filter(|name| a[*name] != b[*name])
        .collect();
    assert!(differ.is_empty(), "{differ:?} differ");
}
