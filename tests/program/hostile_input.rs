//! Hostile input and the limits of a machine: each case, the message it gives and the exit
//! code, as docs/hostile-input.md lists them. After a change of words:
//! `LASERTRACE_WRITE_PAGES=1 cargo test --test program hostile_input`.

#![cfg(unix)]

use crate::effort::extent;
use crate::program::{PLANE, folder_with, scene};
use assert_cmd::Command;
use lasertrace::math::rng::{Purpose, RngKey};
use std::fs;
use std::os::unix::fs::symlink;
use std::path::Path;
use std::time::Duration;

/// A row of the page. In `message`, … stands for anything.
struct Case {
    what: &'static str,
    /// For a shell, in the folder that `make` has filled.
    command: &'static str,
    code: i32,
    /// Of stderr; of a command that prints nothing there, a line of stdout.
    message: &'static str,
    make: fn(&Path),
}

const CHECK: &str = "lasertrace check scene.toml";
const SCAN: &str = "lasertrace scan scene.toml -o out";
const FORCED: &str = "lasertrace scan scene.toml -o out --force";

fn write(folder: &Path, name: &str, bytes: impl AsRef<[u8]>) {
    fs::write(folder.join(name), bytes).unwrap();
}

/// A scene of that mesh file, and the file.
fn mesh(folder: &Path, name: &str, bytes: impl AsRef<[u8]>) {
    write(folder, "scene.toml", scene(&named(name)));
    write(folder, name, bytes);
}

fn named(mesh: &str) -> String {
    let file = serde_json::to_string(mesh).unwrap();
    format!("mesh = {{ file = {file}, unit = \"mm\" }}")
}

/// A scene in which `from` is `to`.
fn changed(folder: &Path, from: &str, to: &str) {
    let text = scene(PLANE);
    assert!(text.contains(from));
    write(folder, "scene.toml", text.replace(from, to));
}

const SENSOR: &str = "resolution_px = [64, 48]";

/// Of a path, and of one of many frames that all see the part.
const FRAMES: &str = "frames = 3\nstep_mm = 0.5";
const MANY_FRAMES: &str = "frames = 1000000\nstep_mm = 1e-5";

/// A file outside the output folder, and the folder with a link to it of that name.
fn linked(folder: &Path, name: &str) {
    changed(folder, "seed = 7", "seed = 8");
    write(folder, "victim", "precious");
    fs::create_dir(folder.join("out")).unwrap();
    symlink("../victim", folder.join("out").join(name)).unwrap();
}

fn binary_stl(header: &str) -> Vec<u8> {
    let mut bytes = header.as_bytes().to_vec();
    bytes.resize(80, b' ');
    bytes.extend(1u32.to_le_bytes());
    bytes.extend([0; 12]);
    for corner in [[0f32, 0., 0.], [8., 0., 0.], [0., 8., 0.]] {
        bytes.extend(corner.iter().flat_map(|c| c.to_le_bytes()));
    }
    bytes.extend([0; 2]);
    bytes
}

const VERTICES: &str = "element vertex 3\nproperty float x\nproperty float y\nproperty float z\n";
const FACES: &str = "element face 1\nproperty list uchar int vertex_indices\n";

fn ply(elements: &[&str], body: &str) -> String {
    format!(
        "ply\nformat ascii 1.0\n{}end_header\n{body}",
        elements.concat()
    )
}

/// Formats that get taken for meshes.
const FORMATS: &[(&str, &str, &[u8])] = &[
    (
        "STEP behind a comment",
        "a STEP file",
        b"/* made by */ ISO-10303-21;\nHEADER;\n",
    ),
    (
        "IGES",
        "an IGES file",
        b"made by a program of drawings                                           S      1\n",
    ),
    (
        "DXF",
        "a DXF drawing",
        b"999\nmade by\n0\nSECTION\n2\nHEADER\n",
    ),
    (
        "OFF",
        "an OFF mesh",
        b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n",
    ),
    (
        "VTK",
        "a VTK file",
        b"# vtk DataFile Version 3.0\nx\nASCII\n",
    ),
    (
        "3MF or another archive, cut off",
        "a ZIP archive that is cut off",
        b"PK\x03\x04\x14\0\0\0",
    ),
    (
        "glTF without a scene",
        "a file without a scene",
        b"{\"asset\": {\"version\": \"2.0\"}}",
    ),
    (
        "glTF of a version that is not read",
        "glTF \"1.0\"",
        b"{\"asset\": {\"version\": \"1.0\"}}",
    ),
    (
        "gzip",
        "a file of the format gzip (GZ)",
        b"\x1f\x8b\x08\0\0\0\0\0",
    ),
    (
        "PNG image",
        "a file of the format Portable Network Graphics (PNG)",
        b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR",
    ),
];

#[expect(clippy::too_many_lines, reason = "a table of one row a case")]
fn cases() -> Vec<Case> {
    let case = |what, command, code, message, make| Case {
        what,
        command,
        code,
        message,
        make,
    };
    vec![
        case(
            "a path of one pose",
            SCAN,
            0,
            "open the report:  out/report.html",
            |folder| {
                let text = scene(PLANE);
                let (before, _) = text.split_once("[scan]").unwrap();
                write(
                    folder,
                    "scene.toml",
                    format!("{before}[scan]\nposes = \"one.csv\"\n"),
                );
                write(
                    folder,
                    "one.csv",
                    "x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\n0,0,0,0,0,0\n",
                );
            },
        ),
        case(
            "a PLY header of 400 000 elements",
            CHECK,
            65,
            "lasertrace: part.ply: found no triangles (a PLY of 0 e0, 0 e1, …), expected a mesh \
             of at least one triangle",
            |folder| {
                let elements: String = (0..400_000).map(|i| format!("element e{i} 0\n")).collect();
                mesh(folder, "part.ply", ply(&[&elements], ""));
            },
        ),
        case(
            "more threads than the machine has",
            "lasertrace check scene.toml --threads 65535",
            0,
            "lasertrace: --threads 65535: … used, which is all that cores, control group and \
             Slurm grant this program",
            |folder| changed(folder, "seed = 7", "seed = 8"),
        ),
        case(
            "a sensor of 65 535² pixels",
            "ulimit -v 4000000; lasertrace check scene.toml",
            75,
            "lasertrace: 1 images of 65535 × 65535 pixels at once takes 34.36 GB, and … GB of \
             memory are free: make it smaller, take fewer threads or a larger machine",
            |folder| changed(folder, SENSOR, "resolution_px = [65535, 65535]"),
        ),
        case(
            "the same, a frame of it",
            "ulimit -v 4000000; lasertrace render scene.toml -o out",
            75,
            "lasertrace: a frame of 65535 × 65535 pixels with its truth, … bytes a pixel, takes \
             … GB, and … GB of memory are free: …",
            |folder| changed(folder, SENSOR, "resolution_px = [65535, 65535]"),
        ),
        case(
            "a scan of 4 294 967 295 frames",
            "ulimit -v 4000000; lasertrace scan scene.toml -o out",
            75,
            "lasertrace: a scan of 4294967295 frames, … images of 64 × 48 pixels at once and 192 \
             bytes a frame in the report, takes 824.63 GB, and … GB of memory are free: …",
            |folder| changed(folder, "frames = 3", "frames = 4294967295"),
        ),
        case(
            "the same, before it",
            "ulimit -v 4000000; lasertrace check scene.toml",
            0,
            "  memory            … GB: MORE THAN THE … GB THAT ARE FREE",
            |folder| changed(folder, "frames = 3", "frames = 4294967295"),
        ),
        case(
            "a scan with more points than fit memory",
            "ulimit -v 4000000; lasertrace scan scene.toml -o out",
            75,
            "lasertrace: the report of a scan of 1000000 frames and about … points, 256 bytes \
             each, takes … GB, and … GB of memory are free: …",
            |folder| changed(folder, FRAMES, MANY_FRAMES),
        ),
        case(
            "the same, before it",
            "ulimit -v 4000000; lasertrace check scene.toml",
            0,
            "  memory            … GB: MORE THAN THE … GB THAT ARE FREE",
            |folder| changed(folder, FRAMES, MANY_FRAMES),
        ),
        case(
            "a file larger than the user may write (SIGXFSZ)",
            "ulimit -f 4; lasertrace scan scene.toml -o out",
            75,
            "lasertrace: cannot write out/…: File too large (os error 27); when there is room, run \
             the same command with --resume …",
            |folder| changed(folder, "seed = 7", "seed = 8"),
        ),
        case(
            "a file's name that clears the screen and forges a line",
            CHECK,
            65,
            "lasertrace: scene.toml:6: part.mesh.file: found \"a\\u001b[2J\\nlasertrace: \
             done.stl\", expected a mesh file; there is none at a\\u{1b}[2J\\nlasertrace: done.stl; a backslash does not \
             separate folders, and in double quotes it begins an escape: write /",
            |folder| {
                write(
                    folder,
                    "scene.toml",
                    scene(&named("a\u{1b}[2J\nlasertrace: done.stl")),
                );
            },
        ),
        case(
            "the same on the command line",
            "lasertrace check \"$(printf 'a\\033[2J\\nlasertrace: done')\"",
            74,
            "lasertrace: cannot read a\\u{1b}[2J\\nlasertrace: done: No such file or directory (os \
             error 2)",
            |_| {},
        ),
        case(
            "the same as an option",
            "lasertrace check scene.toml --threads \"$(printf '\\033[2J\\n0')\"",
            64,
            "error: invalid value '\\u{1b}[2J\\n0' for '--threads <N>': invalid digit found in \
             string…",
            |_| {},
        ),
        case(
            "a value of a megabyte",
            CHECK,
            65,
            "lasertrace: scene.toml:6: part.mesh.file: found \"xxx…xxx\", expected a mesh file; \
             there is none at xxx…xxx",
            |folder| write(folder, "scene.toml", scene(&named(&"x".repeat(1 << 20)))),
        ),
        case(
            "a link in the place of a file in the making",
            FORCED,
            0,
            "open the report:  out/report.html",
            |folder| linked(folder, "cloud.ply.part"),
        ),
        case(
            "a link in the place of the journal",
            FORCED,
            74,
            "lasertrace: cannot open out/frames.journal: it is a symbolic link, and links in an \
             output folder are not followed; remove it",
            |folder| linked(folder, "frames.journal"),
        ),
        case(
            "a link in the place of a folder",
            FORCED,
            74,
            "lasertrace: cannot read folder out/frames: it is a symbolic link, and links in \
             an output folder are not followed; remove it",
            |folder| linked(folder, "frames"),
        ),
        case(
            "wave optics of a wide spot",
            "lasertrace wave scene.toml -o out",
            64,
            "lasertrace: the wave-optics reference of scene.toml adds up … terms, at most 1e12 \
             are taken (some … hours on one core): the laser's light with its surroundings is … mm \
             or … grains wide, motions take … terms; take a narrower beam, a smaller aperture, \
             shorter steps or fewer realisations",
            |folder| changed(folder, "waist_radius_um = 300", "waist_radius_um = 6000"),
        ),
        case(
            "a mesh behind a loop of links",
            CHECK,
            74,
            "lasertrace: cannot read loop.stl: Too many levels of symbolic links (os error 40)",
            |folder| {
                symlink("loop.stl", folder.join("loop.stl")).unwrap();
                write(folder, "scene.toml", scene(&named("loop.stl")));
            },
        ),
        case(
            "\"ply\" in the header of a binary STL",
            CHECK,
            0,
            "  triangles         1",
            |folder| mesh(folder, "part.stl", binary_stl("ply exported")),
        ),
        case(
            "a PLY with faces before vertices",
            CHECK,
            0,
            "  triangles         1",
            |folder| {
                let text = ply(&[FACES, VERTICES], "3 0 1 2\n0 0 0\n8 0 0\n0 8 0\n");
                mesh(folder, "part.ply", text);
            },
        ),
        case(
            "^Z at the end of an OBJ",
            CHECK,
            0,
            "  triangles         1",
            |folder| {
                mesh(
                    folder,
                    "part.obj",
                    "v 0 0 0\r\nv 8 0 0\r\nv 0 8 0\r\nf 1 2 3\r\n\x1a",
                );
            },
        ),
        case(
            "a PLY with two x",
            CHECK,
            65,
            "lasertrace: part.ply:5: found a second property \"x\" of element \"vertex\", \
             expected each property once",
            |folder| {
                let twice = VERTICES.replace("float y", "float x");
                mesh(
                    folder,
                    "part.ply",
                    ply(&[&twice, FACES], "0 0 0\n8 0 0\n0 8 0\n3 0 1 2\n"),
                );
            },
        ),
        case(
            "a mesh without area",
            CHECK,
            65,
            "lasertrace: part.obj: found 2 triangles, all without area, expected a mesh with a \
             surface",
            |folder| {
                mesh(
                    folder,
                    "part.obj",
                    "v 0 0 0\nv 8 0 0\nv 4 0 0\nf 1 2 3\nf 1 1 2\n",
                )
            },
        ),
    ]
}

/// Exit code, stdout, stderr.
fn run(folder: &Path, command: &str) -> (i32, String, String) {
    let program = Path::new(env!("CARGO_BIN_EXE_lasertrace"));
    let path = format!(
        "{}:{}",
        program.parent().unwrap().display(),
        std::env::var("PATH").unwrap()
    );
    let output = Command::new("sh")
        .args(["-c", command])
        .env("PATH", path)
        .current_dir(folder)
        .timeout(Duration::from_secs(120))
        .output()
        .unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    let code = output.status.code();
    let code = code.unwrap_or_else(|| panic!("{command}: {}", output.status));
    (code, text(output.stdout), text(output.stderr))
}

/// Whether a text is `pattern`, in which … stands for anything.
fn fits(text: &str, pattern: &str) -> bool {
    let mut pieces = pattern.split('…');
    let Some(mut rest) = text.strip_prefix(pieces.next().unwrap()) else {
        return false;
    };
    let pieces: Vec<&str> = pieces.collect();
    let Some((last, middle)) = pieces.split_last() else {
        return rest.is_empty();
    };
    for piece in middle {
        match rest.split_once(piece) {
            Some((_, after)) => rest = after,
            None => return false,
        }
    }
    rest.ends_with(last)
}

fn hold(case: &Case) {
    let folder = tempfile::tempdir().unwrap();
    (case.make)(folder.path());
    let (code, stdout, stderr) = run(folder.path(), case.command);
    assert_eq!(code, case.code, "{}: {stderr}", case.what);
    let holds = match stderr.trim_end() {
        "" => stdout.lines().any(|line| fits(line, case.message)),
        message => fits(message, case.message),
    };
    assert!(
        holds,
        "{}: {stdout}{stderr}is not\n{}",
        case.what, case.message
    );
    // Whatever the case: no character that a terminal obeys, no endless line.
    for line in stderr.lines().chain(stdout.lines()) {
        assert!(
            !line.chars().any(char::is_control),
            "{}: {line:?}",
            case.what
        );
        assert!(line.chars().count() < 4000, "{}", case.what);
    }
    let victim = folder.path().join("victim");
    if victim.exists() {
        assert_eq!(fs::read(victim).unwrap(), b"precious", "{}", case.what);
    }
}

#[test]
fn every_case_gives_its_message() {
    let cases = cases();
    cases.iter().for_each(hold);
    println!("tried {} files and limits", cases.len());
}

#[test]
fn other_formats_are_named() {
    for &(_, name, bytes) in FORMATS {
        let folder = folder_with(&scene(&named("part")));
        write(folder.path(), "part", bytes);
        let (code, _, stderr) = run(folder.path(), CHECK);
        let expected = format!("lasertrace: part: found {name}, expected ");
        assert!(code == 65 && stderr.starts_with(&expected), "{stderr}");
    }
}

/// The page holds what the tests hold.
#[test]
fn the_page_lists_every_case() {
    let mut page = String::from(
        "# Hostile input and limits\n\n`tests/program/hostile_input.rs` writes and checks this page. In \
         a message, … represents text that is long or varies between runs.\n\n\
         | case | command | exit code | message |\n|---|---|---|---|\n",
    );
    let cell = |text: &str| text.replace('|', "\\|");
    for case in cases() {
        let [what, command, message] = [case.what, case.command, case.message].map(cell);
        page += &format!("| {what} | `{command}` | {} | `{message}` |\n", case.code);
    }
    for (what, name, _) in FORMATS {
        page += &format!(
            "| {what} for a mesh | `{CHECK}` | 65 | `lasertrace: part: found {name}, expected …` |\n"
        );
    }
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/hostile-input.md");
    if std::env::var_os("LASERTRACE_WRITE_PAGES").is_some() {
        fs::write(&path, &page).unwrap();
    }
    let kept = fs::read_to_string(&path).unwrap_or_default();
    assert!(
        kept == page,
        "{} is not what the tests hold; this makes it:\n{page}",
        path.display()
    );
}

/// With too little address space a run ends in order: it says so and is temporary, or it
/// goes well. Never an abort, a panic or an internal error.
#[test]
fn too_little_memory_is_temporary() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    changed(path, SENSOR, "resolution_px = [1600, 1000]");
    let text = fs::read_to_string(path.join("scene.toml")).unwrap();
    write(
        path,
        "scene.toml",
        text.replace("speckle = false", "speckle = true"),
    );
    let mut codes = Vec::new();
    for command in [
        "check scene.toml",
        "render scene.toml -o out",
        "scan scene.toml -o out",
    ] {
        // From less than the program itself takes to more than enough.
        let sizes = [60, 90, 130, 180, 250, 350, 500, 700, 1000, 4000];
        for megabytes in sizes.into_iter().step_by(extent(3, 1)) {
            let limit = megabytes * 1000;
            let (code, _, stderr) = run(path, &format!("ulimit -v {limit}; lasertrace {command}"));
            // Where it cannot even say its version, it was not loaded: with Debian 13's
            // libraries there is a size at which one of them ends the program at its start.
            let loads = || run(path, &format!("ulimit -v {limit}; lasertrace --version")).0 == 0;
            let fine = matches!(code, 0 | 75) || megabytes <= 130 && !loads();
            assert!(fine, "{command} in {megabytes} MB: {code}\n{stderr}");
            assert!(code == 0 || !stderr.is_empty());
            codes.push(code);
        }
    }
    assert!(codes.contains(&0) && codes.contains(&75), "{codes:?}");
}

/// Slurm's share of a node binds as the machine does.
#[test]
fn slurm_grants_threads() {
    let folder = folder_with(&scene(PLANE));
    let command = "SLURM_CPUS_PER_TASK=1 lasertrace check scene.toml --json --threads 2";
    let (code, stdout, stderr) = run(folder.path(), command);
    assert_eq!(code, 0);
    assert!(stderr.contains("--threads 2: 1 used"), "{stderr}");
    let check: serde_json::Value = serde_json::from_str(&stdout).unwrap();
    assert_eq!(check["forecast"]["threads"], 1);
}

/// JSON on a terminal: escaped too, and of the same value.
#[test]
fn json_holds_no_character_that_a_terminal_obeys() {
    let folder = folder_with(&scene(PLANE));
    let name = "out\u{9b}2J\u{202e}";
    let command = format!("lasertrace render scene.toml --json -o '{name}'");
    let (code, stdout, stderr) = run(folder.path(), &command);
    assert_eq!(code, 0, "{stderr}");
    assert!(stdout.trim_end().is_ascii(), "{stdout:?}");
    let summary: serde_json::Value = serde_json::from_str(&stdout).unwrap();
    assert_eq!(summary["png"], format!("{name}/frame-000000.png"));
}

/// A folder that may not be entered is no absent file.
#[test]
fn a_folder_without_permission_is_an_error_of_the_file_system() {
    use std::os::unix::fs::PermissionsExt;
    let folder = folder_with(&scene(&named("closed/part.stl")));
    let closed = folder.path().join("closed");
    fs::create_dir(&closed).unwrap();
    write(&closed, "part.stl", binary_stl("x"));
    fs::set_permissions(&closed, fs::Permissions::from_mode(0o000)).unwrap();
    if fs::metadata(closed.join("part.stl")).is_ok() {
        eprintln!("\n*** NOT TESTED: this user may enter every folder. ***\n");
    } else {
        let (code, _, stderr) = run(folder.path(), CHECK);
        assert_eq!(code, 74, "{stderr}");
        assert!(stderr.contains("Permission denied"), "{stderr}");
    }
    fs::set_permissions(&closed, fs::Permissions::from_mode(0o700)).unwrap();
}

/// Whether the program is ready to be told to stop: else a signal kills it.
#[cfg(target_os = "linux")]
fn listens(process: u32) -> bool {
    let status = fs::read_to_string(format!("/proc/{process}/status")).unwrap_or_default();
    let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:"));
    let caught = caught.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    // SIGTERM is signal 15.
    caught.is_some_and(|mask| mask >> 14 & 1 == 1)
}

/// A failed assertion of Embree aborts. That is a fault of the program, not temporary: a job
/// script that repeats what ends with 75 would repeat it for ever.
#[cfg(target_os = "linux")]
#[test]
fn an_abort_is_not_temporary() {
    use std::os::unix::process::ExitStatusExt;
    use std::process::{Command, Stdio};
    let folder = tempfile::tempdir().unwrap();
    changed(folder.path(), FRAMES, MANY_FRAMES);
    let mut child = Command::new(env!("CARGO_BIN_EXE_lasertrace"))
        .args(["scan", "scene.toml", "-o", "out"])
        .current_dir(folder.path())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    while !listens(child.id()) && child.try_wait().unwrap().is_none() {
        std::thread::sleep(Duration::from_millis(1));
    }
    let kill = format!("kill -ABRT {}", child.id());
    let told = Command::new("sh").args(["-c", &kill]).status().unwrap();
    assert!(told.success());
    let status = child.wait().unwrap();
    assert_eq!((status.code(), status.signal()), (None, Some(6)));
}

/// A head 300 mm beside the part, seen along directions that are almost those of the axes, and
/// others drawn from a seed: the scene is checked or refused, and never aborts.
#[test]
fn a_part_far_beside_the_sensor_is_checked() {
    let bracket = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/bracket");
    let text = fs::read_to_string(bracket.join("scene.toml")).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    for file in fs::read_dir(&bracket).unwrap() {
        let file = file.unwrap().path();
        if file.is_file() {
            fs::copy(&file, path.join(file.file_name().unwrap())).unwrap();
        }
    }
    let key = RngKey::new(43, Purpose::SensorNoise);
    let random = |i: u64, half: f64| {
        [0, 1, 2].map(|j| (half * (2.0 * key.with(i).uniform(j) - 1.0)).round())
    };
    let mut places = vec![([0.0, 300.0, 0.0], [0.0; 3])];
    places.extend((0..4).map(|i| {
        (
            random(i, 400.0),
            random(10 + i, 2.0).map(|turn| 90.0 * turn),
        )
    }));
    for (at, turn) in places {
        let placed = format!("[part]\nposition_mm = {at:?}\nrotation_deg = {turn:?}\n");
        write(path, "scene.toml", text.replace("[part]\n", &placed));
        let (code, _, stderr) = run(path, "lasertrace check scene.toml");
        assert!(matches!(code, 0 | 65), "{at:?} {turn:?}: {code}\n{stderr}");
    }
}

/// Every command that takes long is told to stop, in whatever it is doing, and does so with
/// 75. A minute is for a machine under load.
#[cfg(target_os = "linux")]
#[test]
fn every_command_stops_when_told() {
    use std::process::{Command, Stdio};
    use std::thread::sleep;
    use std::time::Instant;
    let folder = tempfile::tempdir().unwrap();
    changed(folder.path(), "frames = 3", "frames = 1000000");
    let many = scene(PLANE)
        .replace(SENSOR, "resolution_px = [2048, 1536]")
        .replace("pixel_pitch_um = 30", "pixel_pitch_um = 0.9375");
    write(folder.path(), "large.toml", many);
    for arguments in [
        "wave -o out --realisations 99999",
        "wave large.toml -o out --realisations 9999",
        "chart large.toml -o out",
        "uncertainty large.toml -o out",
        "calibrate large.toml -o out",
        "peaks -o out",
        "speckle -o out --size 1024",
        "scan scene.toml -o out",
    ] {
        let mut child = Command::new(env!("CARGO_BIN_EXE_lasertrace"))
            .args(arguments.split(' '))
            .current_dir(folder.path())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        while !listens(child.id()) && child.try_wait().unwrap().is_none() {
            sleep(Duration::from_millis(1));
        }
        sleep(Duration::from_millis(50));
        let kill = format!("kill -TERM {}", child.id());
        assert!(
            Command::new("sh")
                .args(["-c", &kill])
                .status()
                .unwrap()
                .success()
        );
        let told = Instant::now();
        while child.try_wait().unwrap().is_none() {
            if told.elapsed() > Duration::from_secs(60) {
                let _ = child.kill();
                panic!("{arguments}: deaf");
            }
            sleep(Duration::from_millis(10));
        }
        let output = child.wait_with_output().unwrap();
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(75), "{arguments}: {stderr}");
        assert!(stderr.contains("interrupted"), "{arguments}: {stderr}");
    }
}
