//! The live view over a socket, without a browser: its pictures are those of `render`, whatever was dragged, and it
//! answers nobody else.

use lasertrace::run::{self, RunControl, TraceMode};
use lasertrace::scene::Scene;
use lasertrace::view::{Files, Listener, Session, serve};
use lasertrace::{DVec3, Rigid};
use serde_json::Value;
use std::fs;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use tempfile::TempDir;

fn control<'a>() -> RunControl<'a> {
    static STOP: AtomicBool = AtomicBool::new(false);
    RunControl {
        progress: &|_| {},
        setup_progress: None,
        notice: None,
        stop: &STOP,
    }
}

/// A view of a scene that answers until it is dropped.
struct View {
    address: SocketAddr,
    stop: &'static AtomicBool,
    thread: Option<JoinHandle<()>>,
}

impl View {
    fn of(scene: &Path) -> View {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(2)
            .build()
            .unwrap();
        let scene = Scene::load(scene).unwrap();
        let session = Arc::new(Session::new(&scene, Files::ByFullPath, pool, &control()).unwrap());
        let stop: &'static AtomicBool = Box::leak(Box::default());
        let thread =
            std::thread::spawn(move || serve(session, Listener::Browsers(listener), stop).unwrap());
        View {
            address,
            stop,
            thread: Some(thread),
        }
    }

    /// Sends a request and reads the whole answer: status and body.
    fn ask(&self, request: &str) -> (u16, Vec<u8>) {
        let mut stream = TcpStream::connect(self.address).unwrap();
        stream.write_all(request.as_bytes()).unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        let end = answer.windows(4).position(|w| w == b"\r\n\r\n").unwrap();
        let head = String::from_utf8(answer[..end].to_vec()).unwrap();
        let status = head.split(' ').nth(1).unwrap().parse().unwrap();
        (status, answer[end + 4..].to_vec())
    }

    fn get_as(&self, path: &str, headers: &str) -> (u16, Vec<u8>) {
        self.ask(&format!(
            "GET /{path} HTTP/1.1\r\n{headers}Connection: close\r\n\r\n"
        ))
    }

    fn get(&self, path: &str) -> (u16, Vec<u8>) {
        self.get_as(path, &format!("Host: {}\r\n", self.address))
    }

    fn taken(&self, path: &str) -> Vec<u8> {
        let (status, body) = self.get(path);
        assert_eq!(status, 200, "{path}: {}", String::from_utf8_lossy(&body));
        body
    }

    /// Status and message of a refusal, and whose value it is.
    fn refused(&self, path: &str) -> (u16, String, Value) {
        let (status, body) = self.get(path);
        let body: Value = serde_json::from_slice(&body).unwrap();
        (
            status,
            body["message"].as_str().unwrap().to_owned(),
            body["key"].clone(),
        )
    }
}

impl Drop for View {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        let ended = self.thread.take().unwrap().join();
        assert!(std::thread::panicking() || ended.is_ok());
    }
}

/// Head and image of an answer.
fn unpacked(answer: &[u8]) -> (Value, &[u8]) {
    let length = u32::from_le_bytes(answer[..4].try_into().unwrap()) as usize;
    (
        serde_json::from_slice(&answer[4..4 + length]).unwrap(),
        &answer[4 + length..],
    )
}

fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

/// The plane of scenes/plane with speckle, noise and few pixels.
fn small_scene(folder: &Path) -> PathBuf {
    let text = fs::read_to_string(repository("scenes/plane/scene.toml")).unwrap();
    let text = text
        .replace("speckle = false", "speckle = true")
        .replace("[640, 300]", "[160, 80]")
        .replace("pixel_pitch_um = 5", "pixel_pitch_um = 20")
        .replace("full_well_e", "read_noise_e = 5\nfull_well_e");
    let path = folder.join("small.toml");
    fs::write(&path, text).unwrap();
    path
}

/// The PNG that `render` writes of a frame of a scene file.
fn rendered(scene: &Path, frame: u32, folder: &Path) -> Vec<u8> {
    let scene = Scene::load(scene).unwrap();
    let out = folder.join("out");
    let summary = run::render(
        &scene,
        (frame, None),
        TraceMode::Footprint,
        &out,
        &control(),
    )
    .unwrap();
    fs::read(summary.png).unwrap()
}

const ALL: &str = "frame=3&exposure_ms=0.02&f_number=5.6&power_mw=3.5&angle_deg=38&x_mm=0.3&y_mm=-0.2&z_mm=0.4\
                   &rx_deg=2&ry_deg=-1.5&rz_deg=3";

#[test]
fn pictures_are_those_that_render_writes_of_the_saved_scene() {
    let folder = TempDir::new().unwrap();
    let scene = small_scene(folder.path());
    let view = View::of(&scene);
    assert_eq!(
        view.taken("picture.png?frame=4"),
        rendered(&scene, 4, folder.path())
    );
    // Somewhere else than the scene it comes from.
    let elsewhere = TempDir::new().unwrap();
    let saved = elsewhere.path().join("saved.toml");
    let mut before = Vec::new();
    for values in [
        "frame=3",
        "frame=3&f_number=11",
        "frame=3&angle_deg=30",
        ALL,
    ] {
        fs::write(&saved, view.taken(&format!("scene.toml?{values}"))).unwrap();
        let png = view.taken(&format!("picture.png?{values}"));
        assert_eq!(png, rendered(&saved, 3, elsewhere.path()), "{values}");
        assert_ne!(png, before, "{values}");
        // What the page shows is that picture, brightened.
        let answer = view.taken(&format!("final?{values}"));
        let (head, image) = unpacked(&answer);
        let counts = image::load_from_memory(&png).unwrap().to_luma16();
        let expected = lasertrace::report::picture::for_eyes(counts.as_raw(), 4095);
        assert_eq!(image, expected, "{values}");
        assert_eq!(
            (&head["columns"], &head["draft"]),
            (&160.into(), &false.into())
        );
        assert!(
            head["points"][0].as_u64().unwrap() > 100,
            "{values}: {head}"
        );
        let (draft, shown) = (view.taken(&format!("draft?{values}")), 160 * 80);
        let (head, image) = unpacked(&draft);
        assert_eq!((&head["draft"], image.len()), (&true.into(), shown));
        before = png;
    }
}

#[test]
fn a_sensor_by_its_data_sheet_and_a_tolerance_are_saved_too() {
    let folder = TempDir::new().unwrap();
    let scene = folder.path().join("scene.toml");
    let sensor = repository("sensors/generic-20mm-405nm.toml");
    fs::copy(&sensor, folder.path().join("sensor.toml")).unwrap();
    let text = "seed = 1\nspeckle = false\nsensor = \"sensor.toml\"\n[data_sheet]\npoints_per_profile = 320\n[part]\nplane = { size_mm = [20, 20] }\n\
                reflectance = 0.5\n[scan]\ndirection = [0, 1, 0]\nstep_mm = 0.1\nframes = 3\n\
                [accuracy]\nmax_height_error_um = 20\n";
    fs::write(&scene, text).unwrap();
    let view = View::of(&scene);
    for values in ["frame=1", "frame=1&angle_deg=25&exposure_ms=0.2"] {
        let saved = folder.path().join("saved.toml");
        fs::write(&saved, view.taken(&format!("scene.toml?{values}"))).unwrap();
        let png = view.taken(&format!("picture.png?{values}"));
        assert_eq!(png, rendered(&saved, 1, folder.path()), "{values}");
    }
    assert_eq!(
        view.taken("picture.png?frame=1"),
        rendered(&scene, 1, folder.path())
    );
    let check: Value = serde_json::from_slice(&view.taken("check?angle_deg=25")).unwrap();
    let text = check["text"].as_str().unwrap();
    // At the middle of what the camera then sees of the beam, which moves a little with it.
    let angle = text
        .split("triangulation     ")
        .nth(1)
        .and_then(|rest| rest.split('°').next());
    let angle: f64 = angle.unwrap().parse().unwrap();
    assert!((angle - 25.0).abs() < 0.5, "{text}");
    assert!(check["drawing"].as_str().unwrap().starts_with("<svg"));
}

/// By the definitions: the head turned about its own origin and moved, the camera swung about the line.
#[test]
fn head_and_camera_stand_where_the_values_say() {
    let folder = TempDir::new().unwrap();
    let scene = small_scene(folder.path());
    let view = View::of(&scene);
    let load = |values: &str| {
        let saved = folder.path().join("saved.toml");
        fs::write(&saved, view.taken(&format!("scene.toml?{values}"))).unwrap();
        Scene::load(&saved).unwrap()
    };
    // Lengths are some 100 mm, and a handful of roundings of them are below this.
    let same = |a: &Rigid, b: &Rigid| {
        assert!(
            (a.translation - b.translation).length() < 1e-11,
            "{a:?} {b:?}"
        );
        let off = (a.rotation - b.rotation).to_cols_array();
        assert!(off.iter().all(|x| x.abs() < 1e-13), "{a:?} {b:?}");
    };
    let own = Scene::load(&scene).unwrap();
    let turned = load("x_mm=1&y_mm=2&z_mm=-3&rx_deg=10&ry_deg=-20&rz_deg=30");
    let angles = DVec3::new(10.0, -20.0, 30.0).map(f64::to_radians);
    let turn = Rigid::from_euler_xyz(angles, DVec3::ZERO);
    same(&turned.head_from_laser, &(turn * own.head_from_laser));
    same(&turned.head_from_camera, &(turn * own.head_from_camera));
    let moved = Rigid::translation(DVec3::new(1.0, 2.0, -3.0));
    same(
        &turned.world_from_head(2),
        &(moved * own.world_from_head(2)),
    );

    // The camera of scenes/plane looks at the head's origin from 150 mm at -y and 45°.
    let swung = load("angle_deg=30");
    let eye = swung.head_from_camera.translation;
    let (sin, cos) = 30f64.to_radians().sin_cos();
    // The scene has its place to 1e-6 mm, and so has the distance.
    assert!(
        (eye - 150.0 * DVec3::new(0.0, -sin, cos)).length() < 2e-6,
        "{eye}"
    );
    assert!((swung.head_from_camera.rotation.z_axis - DVec3::new(0.0, sin, -cos)).length() < 1e-7);
    same(&swung.head_from_laser, &own.head_from_laser);
}

#[test]
fn wrong_values_are_refused_and_said() {
    let folder = TempDir::new().unwrap();
    let view = View::of(&small_scene(folder.path()));
    for (values, key, words) in [
        ("f_number=0", "f_number", "found 0"),
        ("f_number=NaN", "f_number", "found nan"),
        ("exposure_ms=-1", "exposure_ms", "found -1"),
        ("power_mw=inf", "power_mw", "expected"),
        ("angle_deg=0", "angle_deg", "from 1 to 89"),
        ("angle_deg=NaN", "angle_deg", "from 1 to 89"),
        ("frame=9", "frame", "0 to 8"),
        ("x_mm=1e300", "x_mm", "found"),
        ("rz_deg=NaN", "rz_deg", "found"),
    ] {
        for what in ["draft", "final", "picture.png", "check", "scene.toml"] {
            let (status, message, whose) = view.refused(&format!("{what}?{values}"));
            assert_eq!(
                (status, whose),
                (422, key.into()),
                "{what}?{values}: {message}"
            );
            assert!(message.contains(words), "{message}");
        }
    }
    for values in [
        "frame=-1",
        "frame=1.5",
        "f_number=eight",
        "seed=2",
        "frame=1&frame=2",
    ] {
        let (status, message, _) = view.refused(&format!("draft?{values}"));
        assert_eq!(status, 400, "{values}: {message}");
    }
    // After all that it still works.
    view.taken("draft?frame=1");
}

#[test]
fn nobody_else_is_answered() {
    let folder = TempDir::new().unwrap();
    let view = View::of(&small_scene(folder.path()));
    let own = format!("Host: {}\r\n", view.address);
    let page = String::from_utf8(view.taken("")).unwrap();
    assert!(
        page.contains("small.toml") && !page.contains("http"),
        "it loads nothing from elsewhere"
    );
    for (headers, status) in [
        ("Host: evil.example\r\n".to_owned(), 421),
        (format!("{own}Origin: http://evil.example\r\n"), 403),
        (format!("{own}Sec-Fetch-Site: cross-site\r\n"), 403),
    ] {
        for path in ["", "draft", "final", "picture.png", "scene.toml", "live.js"] {
            assert_eq!(view.get_as(path, &headers).0, status, "{path}: {headers}");
        }
    }
    let post =
        format!("POST /draft HTTP/1.1\r\n{own}Content-Length: 0\r\nConnection: close\r\n\r\n");
    assert_eq!(view.ask(&post).0, 405);
    assert_eq!(view.get("../etc/passwd").0, 404);
    assert_eq!(view.get("draft/").0, 404);
}

/// Clients that go before their answer, and more at once than may wait: those who stay are answered.
#[test]
fn who_has_gone_holds_nobody_up() {
    let folder = TempDir::new().unwrap();
    let view = View::of(&small_scene(folder.path()));
    let request = format!(
        "GET /final?{ALL} HTTP/1.1\r\nHost: {}\r\n\r\n",
        view.address
    );
    for _ in 0..20 {
        let mut stream = TcpStream::connect(view.address).unwrap();
        stream.write_all(request.as_bytes()).unwrap();
    }
    view.taken(&format!("final?{ALL}"));
    let many = std::thread::scope(|scope| {
        let asking: Vec<_> = (0..100)
            .map(|_| scope.spawn(|| view.get("draft?frame=1").0))
            .collect();
        asking
            .into_iter()
            .map(|one| one.join().unwrap())
            .collect::<Vec<u16>>()
    });
    assert!(
        (many.iter()).all(|status| [200, 409, 503].contains(status)),
        "{many:?}"
    );
    assert!(many.contains(&200));
    view.taken("draft?frame=2");
}

/// Drafts of some minutes, of a wide blur over many poses, end when another is requested. The other has its light
/// beside the part.
#[test]
fn a_draft_is_cancelled_by_the_next() {
    let folder = TempDir::new().unwrap();
    let text = fs::read_to_string(small_scene(folder.path())).unwrap();
    let view_of = |f_number: &str, pixels: &str| {
        let text = text
            .replace("f_number = 8", f_number)
            .replace("[160, 80]", pixels)
            .replace("pixel_pitch_um = 20", "pixel_pitch_um = 0.625")
            .replace(
                "[scan]\n",
                "[scan]\nmotion_samples = 64\nframe_rate_hz = 100\n",
            );
        let scene = folder.path().join("slow.toml");
        fs::write(&scene, text).unwrap();
        View::of(&scene)
    };
    for (f_number, pixels) in [
        ("f_number = 1", "[5120, 2400]"),
        ("f_number = 2.8", "[5120, 1200]"),
        ("f_number = 16", "[4096, 4096]"),
    ] {
        let view = view_of(f_number, pixels);
        let cancelled = std::thread::scope(|scope| {
            // The first draft may not be there yet when the second comes, which then cancels nothing.
            let mut slow: Vec<std::thread::ScopedJoinHandle<u16>> = Vec::new();
            for wait in [1, 10] {
                slow.push(scope.spawn(|| view.get("draft?frame=4").0));
                std::thread::sleep(Duration::from_secs(wait));
                let start = Instant::now();
                view.taken("draft?frame=4&x_mm=1000");
                assert!(start.elapsed() < Duration::from_secs(300), "{f_number}");
                // A cancelled draft ends soon.
                std::thread::sleep(Duration::from_secs(1));
                if slow.iter().any(|one| one.is_finished()) {
                    break;
                }
            }
            let ends = slow.into_iter().map(|one| one.join().unwrap());
            ends.collect::<Vec<u16>>()
        });
        assert!(cancelled.contains(&409), "{f_number}: {cancelled:?}");
    }
}
