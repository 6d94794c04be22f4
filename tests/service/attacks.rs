//! Each attack that docs/security.md names, tried.

use super::client::{Answer, PATIENCE, SQUARE, Served, digits};
use super::program::{PLANE, run, scene};
use std::fs;
use std::io::{Read, Write};
use std::os::unix::fs::symlink;
use std::thread::sleep;
use std::time::{Duration, Instant};

const TOKEN: &str = "0123456789abcdef0123456789abcdef";

#[test]
#[expect(clippy::too_many_lines, reason = "one attack after the other")]
fn no_path_of_a_client_reaches_the_file_system() {
    let store = tempfile::tempdir().unwrap();
    let served = Served::start(&store.path().join("store"), &[]);
    fs::write(store.path().join("secret"), "secret").unwrap();
    let id = served.job("kind=frame", &scene(PLANE));
    served.done(&id);
    let out = store.path().join("store/jobs").join(&id).join("out");
    symlink(store.path().join("secret"), out.join("link.png")).unwrap();
    symlink(store.path(), out.join("folder")).unwrap();
    for path in [
        "../in/scene.toml",
        "..%2fin%2fscene.toml",
        "%2e%2e/in/scene.toml",
        "..%2f..%2f..%2f..%2fsecret",
        "%2fetc%2fpasswd",
        "/etc/passwd",
        "a/../../in/scene.toml",
        "frame-000000.png%00",
        "link.png",
        "folder/secret",
        "folder%2fsecret",
    ] {
        let answer = served.get(&format!("/v1/jobs/{id}/files/{path}"));
        assert!(matches!(answer.status, 400 | 404), "{path}: {answer:?}");
        assert!(!answer.text().contains("secret"), "{path}: {answer:?}");
    }
    for path in [
        "/v1/files/..%2f..%2fsecret",
        "/v1/files/..",
        "/v1/jobs/..%2f..",
        "/v1/jobs/..%2fx/files/a",
    ] {
        for method in ["GET", "PUT", "HEAD", "DELETE"] {
            let answer = served.ask(method, path, &[], b"x");
            assert!(
                (400..=405).contains(&answer.status),
                "{method} {path}: {answer:?}"
            );
        }
    }
    assert_eq!(fs::read(store.path().join("secret")).unwrap(), b"secret");
    // In scenes; the rest is in src/service/scene_files.rs.
    let secret = store.path().join("secret");
    for file in [
        secret.to_str().unwrap(),
        "../../../secret",
        "job.json",
        "scene.toml",
    ] {
        let text = scene(&format!("mesh = {{ file = \"{file}\", unit = \"mm\" }}"));
        assert_eq!(served.post("kind=scan", &[], &text).status, 422, "{file}");
    }
    // A mesh that names a file which the client did not send: the job's own files are not in its folder.
    for uri in [
        "../../../../secret",
        "../job.json",
        "job.json",
        "result.json",
        "lock",
        "../out/a",
    ] {
        let name = served.put(gltf_with(uri).as_bytes());
        let job = served.end(&served.job(
            "kind=scan",
            &scene(&format!("mesh = {{ file = \"{name}\" }}")),
        ));
        assert!(
            matches!(job["exit_code"].as_u64(), Some(65 | 74)),
            "{uri}: {job}"
        );
    }
    // Words that look like options of the command line are no options.
    for query in [
        "kind=scan&frames=--help..3",
        "kind=scan&also=--help",
        "kind=frame&frame=--help",
    ] {
        assert!(
            matches!(served.post(query, &[], &scene(PLANE)).status, 400 | 422),
            "{query}"
        );
    }
}

/// A glTF file of one triangle whose buffer is elsewhere.
pub fn gltf_with(uri: &str) -> String {
    format!(
        r#"{{"asset":{{"version":"2.0"}},"buffers":[{{"uri":"{uri}","byteLength":36}}],
        "bufferViews":[{{"buffer":0,"byteLength":36}}],"accessors":[{{"bufferView":0,"componentType":5126,
        "count":3,"type":"VEC3"}}],"meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}}}}]}}],
        "nodes":[{{"mesh":0}}],"scenes":[{{"nodes":[0]}}],"scene":0}}"#
    )
}

/// As many clients as the service had connections follow a job and read nothing: they held every connection.
#[test]
fn clients_that_never_read_hold_up_neither_health_nor_jobs() {
    let store = tempfile::tempdir().unwrap();
    let served = Served::start(store.path(), &["--jobs", "1"]);
    served.put(SQUARE.as_bytes());
    let id = served.job("kind=scan", &long());
    let request = format!("GET /v1/jobs/{id}/events HTTP/1.1\r\nHost: localhost\r\n\r\n");
    let silent: Vec<_> = (0..256).map(|_| served.send(request.as_bytes())).collect();
    let start = Instant::now();
    assert_eq!(served.get("/healthz").status, 200);
    assert_eq!(served.post("kind=frame", &[], &scene(PLANE)).status, 202);
    eprintln!("healthz and a job after {:?}", start.elapsed());
    // So do as many that send nothing.
    let idle: Vec<_> = (0..256).map(|_| served.send(b"")).collect();
    assert_eq!(served.get("/healthz").status, 200);
    drop((silent, idle));
    // The service notices that they have gone.
    let start = Instant::now();
    while served.get("/v1/jobs").status == 503 {
        assert!(start.elapsed() < PATIENCE);
        sleep(Duration::from_millis(50));
    }
    let deleted = served.ask("DELETE", &format!("/v1/jobs/{id}"), &[], b"");
    assert_eq!(deleted.status, 202);
}

#[test]
fn a_long_text_in_a_field_does_not_come_back_whole() {
    let store = tempfile::tempdir().unwrap();
    let served = Served::start(store.path(), &[]);
    let name = served.put(SQUARE.as_bytes());
    let text = "x".repeat(3 << 20);
    let rays = serde_json::json!({ "rays": [text] }).to_string();
    let id = served.job(&format!("kind=rays&mesh={name}&unit=mm"), &rays);
    assert_eq!(served.end(&id)["state"], "failed");
    let wide = scene(PLANE).replace("seed = 1", &format!("seed = \"{}\"", &text[..900_000]));
    let answer = served.post("kind=scan", &[], &wide);
    assert!(matches!(answer.status, 202 | 422), "{}", answer.status);
    if answer.status == 202 {
        served.end(answer.json()["id"].as_str().unwrap());
    }
    for path in [format!("/v1/jobs/{id}"), "/v1/jobs".to_owned()] {
        let length = served.get(&path).body.len();
        // Two messages of 2000 characters and four values of 300 for each of two jobs.
        assert!(length < 20_000, "{path}: {length} bytes");
    }
}

/// The status after `bytes`, and when the connection was closed.
fn closed_after(served: &Served, bytes: &[u8]) -> (u16, Duration) {
    let start = Instant::now();
    let mut stream = served.send(bytes);
    let mut answer = Vec::new();
    let _ = stream.read_to_end(&mut answer);
    (Answer::of(&answer, false).status, start.elapsed())
}

/// All wait at the same time: ten seconds are the program's own, and no test may wait for each after the other.
#[test]
#[expect(clippy::too_many_lines, reason = "one attack after the other")]
fn slow_clients_and_huge_heads_are_let_go() {
    let store = tempfile::tempdir().unwrap();
    let served = Served::start(store.path(), &[]);
    let address = served.address;
    // Far longer than the service waits, for a machine that is busy.
    let patience = Duration::from_secs(60);
    std::thread::scope(|scope| {
        let served = &served;
        for silent in ["", "GET /healthz HTTP/1.1\r\nHost: localhost\r\nX-Slow: "] {
            scope.spawn(move || {
                let (status, took) = closed_after(served, silent.as_bytes());
                assert!(matches!(status, 0 | 408), "{silent:?}: {status}");
                assert!(took < patience, "{silent:?}: {took:?}");
            });
        }
        // A header a byte at a time, faster than any silence.
        scope.spawn(move || {
            let start = Instant::now();
            let mut stream = served.send(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nX: ");
            while start.elapsed() < patience && stream.write_all(b"x").is_ok() {
                sleep(Duration::from_millis(100));
            }
            assert!(start.elapsed() < patience, "it still listens");
        });
        for length in ["Content-Length: 10", "Transfer-Encoding: chunked"] {
            scope.spawn(move || {
                let head = format!(
                    "POST /v1/jobs?kind=scan HTTP/1.1\r\nHost: {address}\r\nContent-Type: application/toml\r\n\
                     {length}\r\n\r\n"
                );
                let (status, took) = closed_after(served, head.as_bytes());
                assert_eq!(status, 408, "{length}");
                assert!(took < patience, "{length}: {took:?}");
            });
        }
        let path = format!("/v1/files/{}", digits(SQUARE.as_bytes()));
        scope.spawn(move || {
            let head = format!(
                "PUT {path} HTTP/1.1\r\nHost: {address}\r\nContent-Length: 500\r\n\r\nsolid"
            );
            assert_eq!(closed_after(served, head.as_bytes()).0, 408);
        });
        for (what, head) in [
            (
                "one header",
                format!(
                    "GET /healthz HTTP/1.1\r\nHost: localhost\r\nX: {}\r\n\r\n",
                    "x".repeat(1 << 20)
                ),
            ),
            (
                "many headers",
                format!(
                    "GET /healthz HTTP/1.1\r\nHost: localhost\r\n{}\r\n",
                    "X: y\r\n".repeat(1 << 16)
                ),
            ),
            (
                "a path",
                format!(
                    "GET /{} HTTP/1.1\r\nHost: localhost\r\n\r\n",
                    "x".repeat(1 << 20)
                ),
            ),
        ] {
            scope.spawn(move || {
                let mut stream = served.send(b"");
                let _ = stream.write_all(head.as_bytes());
                let mut answer = Vec::new();
                let _ = stream.read_to_end(&mut answer);
                // Closed, or refused; the rest of what was sent may cut the answer off.
                assert!(
                    matches!(Answer::of(&answer, false).status, 0 | 414 | 431),
                    "{what}"
                );
            });
        }
        // Others are served meanwhile.
        scope.spawn(move || {
            for _ in 0..20 {
                assert_eq!(served.get("/healthz").status, 200);
                sleep(Duration::from_millis(50));
            }
        });
    });
    assert_eq!(fs::read_dir(store.path().join("files")).unwrap().count(), 0);
    // A body that is larger than it may be is not read to its end.
    let head = format!(
        "POST /v1/jobs?kind=scan HTTP/1.1\r\nHost: {address}\r\nContent-Type: application/toml\r\n\
         Content-Length: 1000000000000\r\n\r\n"
    );
    assert_eq!(closed_after(&served, head.as_bytes()).0, 413);
    let endless = served.post("kind=scan", &[], &"#".repeat((1 << 20) + 1));
    assert!(matches!(endless.status, 0 | 413), "{endless:?}");
}

#[test]
fn a_token_is_asked_for_and_cannot_be_guessed_quickly() {
    let store = tempfile::tempdir().unwrap();
    let served = Served::start_with(store.path(), &[], Some(TOKEN));
    let bearer = |token: &str| format!("Bearer {token}");
    for path in ["/healthz", "/readyz"] {
        assert_eq!(served.get(path).status, 200);
    }
    for path in [
        "/v1/jobs",
        "/metrics",
        "/v1/openapi.json",
        "/v1/jobs/x/files/y",
        "//v1/jobs",
        "/nothing",
    ] {
        let answer = served.get(path);
        assert_eq!(answer.status, 401, "{path}");
        // The last of two: browsers then ask for a password.
        assert!(
            answer.headers["www-authenticate"].starts_with("Basic"),
            "{path}"
        );
    }
    let password = "Basic bWU6MDEyMzQ1Njc4OWFiY2RlZjAxMjM0NTY3ODlhYmNkZWY="; // me:TOKEN
    let answer = served.ask("GET", "/v1/jobs", &[("Authorization", password)], b"");
    assert_eq!(answer.status, 200, "{answer:?}");
    let good = bearer(TOKEN);
    assert_eq!(
        served
            .ask("GET", "/v1/jobs", &[("Authorization", &good)], b"")
            .status,
        200
    );
    let mut statuses = Vec::new();
    for i in 0..20 {
        let guess = bearer(&format!("{}{i:02}", &TOKEN[..30]));
        statuses.push(
            served
                .ask("GET", "/v1/jobs", &[("Authorization", &guess)], b"")
                .status,
        );
    }
    assert_eq!(statuses[..10], [401; 10]);
    assert_eq!(statuses[10..], [429; 10]);
    let answer = served.ask("GET", "/v1/jobs", &[("Authorization", &good)], b"");
    assert_eq!(
        answer.status, 200,
        "the token is right, whatever was sent before"
    );
    drop(served);
    for (listen, token) in [
        ("0.0.0.0:0", None),
        ("[::]:0", None),
        ("127.0.0.1:0", Some("short")),
    ] {
        let file = store.path().join("token");
        fs::write(&file, token.unwrap_or("")).unwrap();
        let mut arguments = vec![
            "serve",
            "--listen",
            listen,
            "--store",
            store.path().to_str().unwrap(),
        ];
        if token.is_some() {
            arguments.extend(["--token-file", file.to_str().unwrap()]);
        }
        let (code, _, said) = run(store.path(), &arguments);
        assert_eq!(code, 64, "{said}");
        assert!(said.contains("token"), "{said}");
    }
}

/// A scan that takes minutes.
fn long() -> String {
    scene(PLANE)
        .replace("frames = 3", "frames = 100000")
        .replace("step_mm = 0.5", "step_mm = 0.00001")
}

#[test]
fn a_job_does_not_see_the_token() {
    let store = tempfile::tempdir().unwrap();
    let served = Served::start_with(store.path(), &[], Some(TOKEN));
    let bearer = format!("Bearer {TOKEN}");
    let answer = served.post("kind=scan", &[("Authorization", &bearer)], &long());
    assert_eq!(answer.status, 202, "{answer:?}");
    let id = answer.json()["id"].as_str().unwrap().to_owned();
    let folder = store.path().join("jobs").join(&id);
    let start = Instant::now();
    while !folder.join("out/frames.journal").exists() && start.elapsed() < super::client::PATIENCE {
        sleep(Duration::from_millis(20));
    }
    let lock = fs::read_to_string(folder.join("lock")).unwrap();
    let holds = |process: &str| {
        let environment = fs::read(format!("/proc/{process}/environ")).unwrap();
        let mut windows = environment.windows(TOKEN.len());
        windows.any(|window| window == TOKEN.as_bytes())
    };
    assert!(holds(&served.process().to_string()) && !holds(lock.trim()));
}

#[test]
fn a_queue_has_an_end() {
    let store = tempfile::tempdir().unwrap();
    let served = Served::start(store.path(), &["--jobs", "1", "--queue", "2"]);
    let first = served.job("kind=scan", &long());
    served.wait(&first, |job| job["state"] == "running");
    let waiting = [(); 2].map(|()| served.job("kind=frame", &long()));
    let answer = served.post("kind=frame", &[], &long());
    assert_eq!(
        (answer.status, &answer.headers["retry-after"][..]),
        (429, "10"),
        "{answer:?}"
    );
    let path = format!("/v1/jobs/{}", waiting[0]);
    assert_eq!(served.ask("DELETE", &path, &[], b"").status, 204);
    assert_eq!(served.post("kind=frame", &[], &long()).status, 202);
}

#[test]
fn pages_of_other_sites_cannot_ask_a_service_on_loopback() {
    let store = tempfile::tempdir().unwrap();
    let served = Served::start(store.path(), &[]);
    let text = scene(PLANE);
    let host = served.address.to_string();
    // What a form or a script of another site sends without asking first.
    for (name, value) in [
        ("Origin", "http://evil.example"),
        ("Origin", "null"),
        ("Origin", "http://localhost:1"),
        ("Sec-Fetch-Site", "cross-site"),
        ("Sec-Fetch-Site", "same-site"),
    ] {
        let answer = served.post("kind=frame", &[(name, value)], &text);
        assert_eq!(answer.status, 403, "{name}: {value}: {answer:?}");
        let answer = served.ask("GET", "/v1/jobs", &[(name, value)], b"");
        assert_eq!(answer.status, 403, "{name}: {value}");
    }
    for kind in [
        "text/plain",
        "application/x-www-form-urlencoded",
        "multipart/form-data; boundary=x",
    ] {
        let answer = served.ask(
            "POST",
            "/v1/jobs?kind=frame",
            &[("Content-Type", kind)],
            text.as_bytes(),
        );
        assert_eq!(answer.status, 415, "{kind}");
    }
    // The question that a browser asks before it sends more gets no leave.
    let before = [
        ("Origin", "http://evil.example"),
        ("Access-Control-Request-Method", "PUT"),
    ];
    let answer = served.ask("OPTIONS", "/v1/jobs", &before, b"");
    assert!(
        answer.status >= 400 && !answer.headers.contains_key("access-control-allow-origin"),
        "{answer:?}"
    );
    // DNS rebinding: the page's own name, which now leads here.
    for name in [
        "evil.example",
        "localhost.evil.example:80",
        "127.0.0.1.nip.example",
        "",
        "x@localhost",
    ] {
        let answer = served.ask("GET", "/v1/jobs", &[("Host", name)], b"");
        assert!(matches!(answer.status, 400 | 421), "{name}: {answer:?}");
    }
    let twice = format!(
        "GET /v1/jobs HTTP/1.1\r\nHost: {host}\r\nHost: evil.example\r\nConnection: close\r\n\r\n"
    );
    assert_eq!(closed_after(&served, twice.as_bytes()).0, 421);
    assert_eq!(served.get("/v1/jobs").json().as_array().unwrap().len(), 0);
    // The service's own pages may.
    let own = format!("http://{host}");
    assert_eq!(
        served.post("kind=frame", &[("Origin", &own)], &text).status,
        202
    );
    // A report runs apart from the service's origin.
    let id = served.get("/v1/jobs").json()[0]["id"]
        .as_str()
        .unwrap()
        .to_owned();
    served.done(&id);
    let png = served.get(&format!("/v1/jobs/{id}/files/frame-000000.png"));
    assert_eq!(
        png.headers["content-security-policy"],
        "sandbox allow-scripts"
    );
    assert_eq!(png.headers["x-content-type-options"], "nosniff");
}
