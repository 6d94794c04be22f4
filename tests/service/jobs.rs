//! What the service gives.

use super::client::{SQUARE, Served, assert_same, by_command, digits, long_scene, square_scene};
use super::program::{PLANE, folder_with, run, scene};
use serde_json::{Value, json};
use std::fs;
use std::io::{BufRead, BufReader};
use std::path::Path;

#[test]
fn jobs_give_the_bytes_of_the_command_line() {
    let store = tempfile::tempdir().unwrap();
    let served = Served::start(store.path(), &[]);
    let name = served.put(SQUARE.as_bytes());
    let text = square_scene();
    let scan = served.job("kind=scan&also=csv", &text);
    let frame = served.job("kind=frame&frame=1", &text);
    let bare = text.replace("save_images = true", "save_images = false");
    let profiles = served.job("kind=profiles&frames=1..3", &bare);
    let rays = json!({"rays": [[1, 2, 10, 0, 0, -1], [9, 0, 5, 0, 0, -1], [0, 1, -4, 0, 0, 2]]});
    let rays = served.job(&format!("kind=rays&mesh={name}&unit=mm"), &rays.to_string());

    let done = served.done(&scan);
    assert_eq!(
        (&done["exit_code"], &done["starts"]),
        (&json!(0), &json!(1))
    );
    assert_eq!(done["result"]["frames"], 3, "{done}");
    let expected = by_command(
        &text,
        &["scan", "in/scene.toml", "-o", "out", "--also", "csv"],
    );
    assert!(expected.contains_key("cloud.ply") && expected.contains_key("frames/frame-000002.png"));
    assert_same(served.results(&scan), expected);

    served.done(&frame);
    let expected = by_command(
        &text,
        &["render", "in/scene.toml", "--frame", "1", "-o", "out"],
    );
    assert_same(served.results(&frame), expected);

    served.done(&profiles);
    let arguments = [
        "scan",
        "in/scene.toml",
        "-o",
        "out",
        "--geometry-only",
        "--frames",
        "1..3",
    ];
    assert_same(served.results(&profiles), by_command(&bare, &arguments));

    // A ray down onto the square from 10 mm; one beside it; one up from below, of length 2.
    let done = served.done(&rays);
    assert_eq!(
        (&done["result"]["rays"], &done["result"]["hits"]),
        (&json!(3), &json!(2))
    );
    let hits: Value = serde_json::from_slice(&served.results(&rays)["hits.json"]).unwrap();
    let hits = &hits["hits"];
    assert_eq!(
        (&hits[0]["distance"], &hits[0]["point_mm"]),
        (&json!(10.0), &json!([1.0, 2.0, 0.0]))
    );
    assert_eq!(hits[1], Value::Null);
    assert_eq!(hits[2]["distance"], 2.0);

    // The folder is what a user would have typed in, with nothing beside it but the service's own.
    let folder = store.path().join("jobs").join(&scan);
    assert_eq!(
        fs::read_to_string(folder.join("in/scene.toml")).unwrap(),
        text
    );
    assert!(folder.join("out/manifest.json").exists());
}

#[test]
fn a_sweep_gives_the_table_of_the_command_line() {
    let store = tempfile::tempdir().unwrap();
    let served = Served::start(store.path(), &[]);
    let name = served.put(scene(PLANE).as_bytes());
    let sweep = format!("scene = \"{name}\"\n[grid]\n\"laser.power_mw\" = [5, 10]\n");
    let job = served.job("kind=sweep", &sweep);
    served.done(&job);
    let folder = folder_with(&sweep);
    fs::write(folder.path().join(&name), scene(PLANE)).unwrap();
    let (code, _, said) = run(folder.path(), &["sweep", "scene.toml", "-o", "out"]);
    assert_eq!(code, 0, "{said}");
    let results = served.results(&job);
    for name in ["sweep.csv", "sweep.svg"] {
        assert!(results[name] == fs::read(folder.path().join("out").join(name)).unwrap());
    }
}

/// The page of a job's scene, its pictures those of `render`, by addresses below the job's; what it saves can be sent as
/// a job.
#[test]
fn a_live_view_of_a_jobs_scene() {
    let store = tempfile::tempdir().unwrap();
    let served = Served::start(store.path(), &["--jobs", "1"]);
    served.put(SQUARE.as_bytes());
    let text = square_scene();
    let job = served.job("kind=frame&frame=1", &text);
    served.done(&job);
    let view = format!("/v1/jobs/{job}/view");
    let moved = served.get(&view);
    assert_eq!(
        (moved.status, &moved.headers["location"]),
        (308, &format!("{view}/"))
    );
    let page = served.get(&format!("{view}/"));
    assert!(
        page.status == 200 && page.text().contains("live.js"),
        "{page:?}"
    );
    assert_eq!(served.get(&format!("{view}/live.js")).status, 200);
    let png = served.get(&format!("{view}/picture.png?frame=1"));
    assert!(png.body == served.results(&job)["frame-000001.png"]);
    let wrong = served.get(&format!("{view}/draft?frame=9"));
    assert_eq!(
        (wrong.status, wrong.json()["key"].as_str()),
        (422, Some("frame"))
    );
    for path in [
        "nothing",
        "../scene.toml",
        "..%2fscene.toml",
        "draft/",
        "draft?frame=1&x=2",
    ] {
        let answer = served.get(&format!("{view}/{path}"));
        assert!((400..=404).contains(&answer.status), "{path}: {answer:?}");
    }
    let saved = served
        .get(&format!("{view}/scene.toml?frame=2&power_mw=3.5"))
        .text();
    assert!(
        saved.contains("sha256:") && !saved.contains("/jobs/"),
        "{saved}"
    );
    let again = served.job("kind=frame&frame=2", &saved);
    served.done(&again);
    let png = served.get(&format!("{view}/picture.png?frame=2&power_mw=3.5"));
    assert!(png.body == served.results(&again)["frame-000002.png"]);

    // As many views as jobs at once.
    let full = served.get(&format!("/v1/jobs/{again}/view/"));
    assert_eq!(full.status, 429, "{full:?}");
    let process = fs::read_to_string(store.path().join("jobs").join(&job).join("view/lock"));
    let process = format!("/proc/{}", process.unwrap().trim());
    assert!(Path::new(&process).exists());
    assert_eq!(
        served
            .ask("DELETE", &format!("/v1/jobs/{job}"), &[], b"")
            .status,
        204
    );
    assert!(!Path::new(&process).exists() && served.get(&format!("{view}/")).status == 404);
}

#[test]
fn a_view_that_cannot_be_says_why() {
    let store = tempfile::tempdir().unwrap();
    let served = Served::start(store.path(), &[]);
    served.put(SQUARE.as_bytes());
    let text = square_scene();
    let wrong = served.job("kind=frame", &text.replace("f_number = 8", "f_number = -8"));
    served.end(&wrong);
    let page = served.get(&format!("/v1/jobs/{wrong}/view/"));
    assert!(
        page.status == 422 && page.text().contains("found -8"),
        "{page:?}"
    );
    let rays = json!({"rays": [[1, 2, 10, 0, 0, -1]]}).to_string();
    let mesh = digits(SQUARE.as_bytes());
    let rays = served.job(&format!("kind=rays&mesh=sha256:{mesh}&unit=mm"), &rays);
    served.done(&rays);
    let page = served.get(&format!("/v1/jobs/{rays}/view/"));
    assert!(
        page.status == 409 && page.text().contains("no scene"),
        "{page:?}"
    );
}

#[test]
fn a_part_of_a_result_is_what_its_range_says() {
    let store = tempfile::tempdir().unwrap();
    let served = Served::start(store.path(), &[]);
    let id = served.job("kind=frame", &scene(PLANE));
    served.done(&id);
    let path = format!("/v1/jobs/{id}/files/frame-000000.png");
    let whole = served.get(&path);
    assert_eq!(
        (whole.status, &whole.headers["content-type"][..]),
        (200, "image/png")
    );
    let part = served.ask("GET", &path, &[("Range", "bytes=5-9")], b"");
    assert_eq!((part.status, &part.body[..]), (206, &whole.body[5..10]));
    let length = whole.body.len();
    assert_eq!(part.headers["content-range"], format!("bytes 5-9/{length}"));
    let rest = served.ask(
        "GET",
        &path,
        &[("Range", &format!("bytes={}-", length - 3))],
        b"",
    );
    assert_eq!(
        (rest.status, &rest.body[..]),
        (206, &whole.body[length - 3..])
    );
    let beyond = served.ask("GET", &path, &[("Range", &format!("bytes={length}-"))], b"");
    assert_eq!(
        (beyond.status, beyond.headers["content-range"].clone()),
        (416, format!("bytes */{length}"))
    );
    let head = served.ask("HEAD", &path, &[], b"");
    assert_eq!(
        (head.status, head.headers["content-length"].clone()),
        (200, length.to_string())
    );
    assert!(head.body.is_empty());
}

#[test]
fn a_version_of_a_result_has_its_tag() {
    let store = tempfile::tempdir().unwrap();
    let served = Served::start(store.path(), &[]);
    let id = served.job("kind=frame", &scene(PLANE));
    served.done(&id);
    let path = format!("/v1/jobs/{id}/files/frame-000000.png");
    let whole = served.get(&path);
    let tag = whole.headers["etag"].clone();
    let other = served.get(&format!("/v1/jobs/{id}/files/frame-000000.exr"));
    assert_ne!(other.headers["etag"], tag);
    let ask = |headers: &[(&str, &str)]| served.ask("GET", &path, headers, b"");
    let known = ask(&[("If-None-Match", &tag)]);
    assert_eq!((known.status, known.body.len()), (304, 0));
    assert_eq!(ask(&[("If-None-Match", "\"other\"")]).status, 200);
    let range = ("Range", "bytes=5-9");
    assert_eq!(ask(&[range, ("If-Range", &tag)]).status, 206);
    let changed = ask(&[range, ("If-Range", "\"other\"")]);
    assert_eq!(
        (changed.status, changed.body.len()),
        (200, whole.body.len())
    );
}

#[test]
fn a_refused_file_is_read_to_its_end() {
    let store = tempfile::tempdir().unwrap();
    let served = Served::start(store.path(), &["--file-mb", "8"]);
    for megabytes in [1, 3, 8] {
        let file = vec![megabytes as u8; megabytes * 1_000_000];
        let path = format!("/v1/files/{}", digits(&file));
        for status in [201, 200, 200] {
            let answer = served.ask_after_body("PUT", &path, &file).unwrap();
            assert_eq!(answer.status, status, "{megabytes} MB");
        }
    }
    for megabytes in [9, 20, 60] {
        let file = vec![megabytes as u8; megabytes * 1_000_000];
        let path = format!("/v1/files/{}", digits(&file));
        let answer = served.ask_after_body("PUT", &path, &file).unwrap();
        assert_eq!(answer.status, 413, "{megabytes} MB: {answer:?}");
    }
}

#[test]
fn a_mesh_may_name_files_that_were_sent() {
    let store = tempfile::tempdir().unwrap();
    let served = Served::start(store.path(), &[]);
    // A triangle of some 10 mm; glTF is in metres.
    let corners: [f32; 9] = [-0.01, -0.01, 0.0, 0.01, -0.01, 0.0, 0.0, 0.01, 0.0];
    let buffer: Vec<u8> = corners.iter().flat_map(|x| x.to_le_bytes()).collect();
    let buffer = served.put(&buffer);
    let mesh = served.put(super::attacks::gltf_with("part.bin").as_bytes());
    let text = scene(&format!("mesh = {{ file = \"{mesh}\" }}"));
    let text = text.replace("save_images = true", "save_images = false");
    let id = served.job(&format!("kind=profiles&files=part.bin={buffer}"), &text);
    let job = served.done(&id);
    assert!(job["result"]["points"].as_u64() > Some(0), "{job}");
    let without = served.end(&served.job("kind=profiles", &text));
    assert_eq!(without["state"], "failed");
    for name in ["", "..", "../a", "a/b", ".a", "scene.toml", "sha256:x"] {
        let answer = served.post(&format!("kind=profiles&files={name}={buffer}"), &[], &text);
        assert_eq!(answer.status, 422, "{name}: {answer:?}");
    }
}

#[test]
fn people_find_a_page_and_what_a_failed_job_printed() {
    let store = tempfile::tempdir().unwrap();
    let served = Served::start(store.path(), &[]);
    let empty = served.get("/");
    assert_eq!(
        (empty.status, &empty.headers["content-type"][..]),
        (200, "text/html; charset=utf-8")
    );
    let id = served.job("kind=scan", "seed = 1\nnonsense = 2\n");
    assert_eq!(served.end(&id)["state"], "failed");
    let log = served.get(&format!("/v1/jobs/{id}/log"));
    assert_eq!(log.status, 200);
    assert!(log.text().contains("nonsense"), "{log:?}");
    let page = served.get("/").text();
    assert!(page.contains(&id) && page.contains("failed"), "{page}");
    assert_eq!(served.get("/v1/jobs/none/log").status, 404);
}

#[test]
fn a_file_is_not_removed_while_a_job_with_it_is_accepted() {
    let store = tempfile::tempdir().unwrap();
    let served = Served::start(store.path(), &["--jobs", "1"]);
    let text = square_scene();
    let path = format!("/v1/files/{}", digits(SQUARE.as_bytes()));
    let mut ids = Vec::new();
    for _ in 0..20 {
        served.put(SQUARE.as_bytes());
        std::thread::scope(|scope| {
            let post = scope.spawn(|| served.post("kind=frame", &[], &text));
            let delete = scope.spawn(|| served.ask("DELETE", &path, &[], b"").status);
            let answer = post.join().unwrap();
            // Either the job came first and the file stays, or the job is refused.
            match answer.status {
                202 => ids.push(answer.json()["id"].as_str().unwrap().to_owned()),
                status => assert_eq!(status, 422, "{answer:?}"),
            }
            assert!(matches!(delete.join().unwrap(), 204 | 409));
        });
    }
    for id in ids {
        served.done(&id);
    }
}

#[test]
fn a_view_opens_in_a_store_with_a_long_path() {
    let folder = tempfile::tempdir().unwrap();
    let store = folder.path().join("x".repeat(150));
    let served = Served::start(&store, &[]);
    let id = served.job("kind=frame", &scene(PLANE));
    served.done(&id);
    let page = served.get(&format!("/v1/jobs/{id}/view/"));
    assert_eq!(page.status, 200, "{page:?}");
}

#[test]
fn a_job_sent_again_with_its_key_is_the_same_job() {
    let store = tempfile::tempdir().unwrap();
    let mut served = Served::start(store.path(), &[]);
    let text = scene(PLANE);
    let key = [("Idempotency-Key", "one")];
    let first = served.post("kind=frame", &key, &text);
    assert_eq!(first.status, 202, "{first:?}");
    let id = first.json()["id"].clone();
    let again = served.post("kind=frame", &key, &text);
    assert_eq!(
        (again.status, again.json()["id"].clone()),
        (200, id.clone())
    );
    let other = served.post("kind=frame&frame=1", &key, &text);
    assert_eq!(other.status, 422, "{other:?}");
    served.done(id.as_str().unwrap());
    served.kill();
    let served = Served::start(store.path(), &[]);
    let again = served.post("kind=frame", &key, &text);
    assert_eq!((again.status, again.json()["id"].clone()), (200, id));
    assert_eq!(again.json()["starts"], 1);
}

#[test]
#[expect(clippy::too_many_lines, reason = "a table of one row a case")]
fn mistakes_are_said_with_what_to_do() {
    let store = tempfile::tempdir().unwrap();
    let served = Served::start(store.path(), &["--file-mb", "1"]);
    let missing = "0".repeat(64);
    let text = square_scene();
    let wrong = |query: &str, body: &str, status: u16, word: &str| {
        let answer = served.post(query, &[], body);
        assert_eq!(answer.status, status, "{query}: {answer:?}");
        let message = answer.json()["error"]["message"]
            .as_str()
            .unwrap()
            .to_owned();
        assert!(message.contains(word), "{query}: no {word:?} in {message}");
    };
    wrong(
        "kind=scan",
        &text,
        422,
        "part.mesh.file: there is no file sha256:",
    );
    wrong("kind=scan", "seed = ", 422, "not TOML");
    wrong("kind=scan&frames=3", &text, 422, "expected A..B");
    wrong(
        "kind=scan&frame=3",
        &text,
        422,
        "frame: a job of this kind has none",
    );
    wrong(
        "kind=scan&also=xyz",
        &text,
        422,
        "expected of csv, e57, pcd",
    );
    wrong("kind=paint", &text, 400, "unknown variant");
    wrong("kind=rays&mesh=part.stl", "{}", 422, "expected sha256:");
    wrong(
        &format!("kind=rays&mesh=sha256:{missing}"),
        "{}",
        422,
        "send it first",
    );
    let form = served.ask(
        "POST",
        "/v1/jobs?kind=scan",
        &[("Content-Type", "text/plain")],
        text.as_bytes(),
    );
    assert_eq!(form.status, 415, "{form:?}");
    // Bytes that are not those of the hash leave nothing.
    let answer = served.ask("PUT", &format!("/v1/files/{missing}"), &[], b"other bytes");
    assert_eq!(answer.status, 422, "{answer:?}");
    assert!(answer.text().contains(&digits(b"other bytes")));
    assert_eq!(
        served
            .ask("HEAD", &format!("/v1/files/{missing}"), &[], b"")
            .status,
        404
    );
    assert_eq!(fs::read_dir(store.path().join("files")).unwrap().count(), 0);
    assert_eq!(served.ask("PUT", "/v1/files/xyz", &[], b"").status, 400);
    let large = vec![0; 1_000_001];
    let path = format!("/v1/files/{}", digits(&large));
    let answer = served.ask("PUT", &path, &[], &large);
    // The rest of what was sent may cut the answer off.
    assert!(matches!(answer.status, 0 | 413), "{answer:?}");
    assert_eq!(served.ask("HEAD", &path, &[], b"").status, 404);
    // What only the command finds is the job's.
    let id = served.job(
        "kind=frame",
        &scene(PLANE).replace("f_number = 8", "f_number = -8"),
    );
    let job = served.end(&id);
    assert_eq!(
        (&job["state"], &job["exit_code"]),
        (&json!("failed"), &json!(65)),
        "{job}"
    );
    let error = &job["result"]["error"];
    assert_eq!(
        (&error["key"], &error["file"]),
        (&json!("camera.f_number"), &json!("in/scene.toml"))
    );
    assert!(
        job["message"].as_str().unwrap().contains("found -8"),
        "{job}"
    );
    assert_eq!(served.get("/v1/jobs/nothing").status, 404);
    assert_eq!(served.get("/nothing").status, 404);
    assert_eq!(served.ask("PATCH", "/v1/jobs", &[], b"").status, 405);
}

#[test]
fn events_follow_a_job_to_its_end_and_deleting_stops_it() {
    let store = tempfile::tempdir().unwrap();
    let served = Served::start(store.path(), &["--jobs", "1"]);
    served.put(SQUARE.as_bytes());
    let id = served.job("kind=scan", &long_scene(3000));
    let waits = served.job("kind=scan", &square_scene());
    let head = format!("GET /v1/jobs/{id}/events HTTP/1.1\r\nHost: localhost\r\n\r\n");
    let events = BufReader::new(served.send(head.as_bytes()));
    let mut seen = Vec::new();
    for line in events.lines().map_while(Result::ok) {
        let Some(data) = line.strip_prefix("data: ") else {
            continue;
        };
        let job: Value = serde_json::from_str(data).unwrap();
        if let Some(done) = job["progress"]["done"].as_u64()
            && job["progress"]["what"] == "frames"
        {
            assert_eq!(job["progress"]["of"], 3000);
            seen.push(done);
        }
        if seen.len() > 1 {
            break;
        }
    }
    assert!(seen.len() > 1 && seen.is_sorted(), "{seen:?}");
    assert_eq!(served.state(&waits)["state"], "queued");
    // Files that jobs still read stay.
    let mesh = format!("/v1/files/{}", digits(SQUARE.as_bytes()));
    assert_eq!(served.ask("DELETE", &mesh, &[], b"").status, 409);
    assert_eq!(
        served
            .ask("DELETE", &format!("/v1/jobs/{id}"), &[], b"")
            .status,
        202
    );
    // Its place is free for the next.
    served.done(&waits);
    let gone = || served.get(&format!("/v1/jobs/{id}")).status == 404;
    let folder = store.path().join("jobs").join(&id);
    for _ in 0..1000 {
        if gone() {
            break;
        }
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    assert!(gone() && !folder.exists());
    assert_eq!(served.ask("DELETE", &mesh, &[], b"").status, 204);
    // What a job read stays with it.
    let folder = store.path().join("jobs").join(&waits).join("in");
    assert!(
        folder
            .join(format!("sha256:{}", digits(SQUARE.as_bytes())))
            .exists()
    );
    assert_eq!(
        served
            .ask("DELETE", &format!("/v1/jobs/{waits}"), &[], b"")
            .status,
        204
    );
    assert!(!folder.exists());
    // The last event of a job that is done is its end.
    let id = served.job("kind=frame", &scene(PLANE));
    served.done(&id);
    let events = served.get(&format!("/v1/jobs/{id}/events")).text();
    assert!(events.starts_with("event: end\ndata: {"), "{events}");
}

#[test]
fn pages_for_machines_say_what_there_is() {
    let store = tempfile::tempdir().unwrap();
    let served = Served::start(store.path(), &[]);
    assert_eq!(served.get("/healthz").text(), "ok\n");
    assert_eq!(served.get("/readyz").text(), "ready\n");
    let api = served.get("/v1/openapi.json").json();
    let paths: Vec<&String> = api["paths"].as_object().unwrap().keys().collect();
    for path in [
        "/v1/files/{sha256}",
        "/v1/jobs",
        "/v1/jobs/{id}",
        "/v1/jobs/{id}/events",
        "/metrics",
    ] {
        assert!(paths.iter().any(|found| *found == path), "{paths:?}");
    }
    assert!(api["components"]["schemas"]["JobPage"].is_object());
    let id = served.job("kind=frame", &scene(PLANE));
    served.done(&id);
    assert_eq!(served.metric("lasertrace_jobs{state=\"done\"}"), 1.0);
    assert_eq!(served.metric("lasertrace_processes_started_total"), 1.0);
    assert!(served.metric("lasertrace_request_seconds_count") > 3.0);
    let list = served.get("/v1/jobs").json();
    assert_eq!(
        (list[0]["id"].as_str(), list.as_array().unwrap().len()),
        (Some(&id[..]), 1)
    );
    // A second service has no place in the same store.
    let (code, _, said) = super::program::run(
        store.path(),
        &[
            "serve",
            "--listen",
            "127.0.0.1:0",
            "--store",
            store.path().to_str().unwrap(),
        ],
    );
    assert_eq!(code, 75, "{said}");
    assert!(said.contains("another run is writing"), "{said}");
}
