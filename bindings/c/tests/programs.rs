//! Compiles and runs C programs against the installed header and library (`install.sh`). They are
//! linked dynamically and statically, with all warnings as errors, and under AddressSanitizer if
//! the compiler supports it.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

const WARNINGS: [&str; 5] = ["-std=c11", "-Wall", "-Wextra", "-Werror", "-pedantic"];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// Returns the target folder of the profile of this test.
fn target() -> PathBuf {
    let test = std::env::current_exe().unwrap();
    test.ancestors().nth(2).unwrap().to_owned()
}

fn run(command: &mut Command) -> Output {
    let output = command.output();
    let output = output.unwrap_or_else(|error| panic!("{command:?}: {error}"));
    assert!(
        output.status.success(),
        "{command:?}: {}\n{}{}",
        output.status,
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    );
    output
}

fn text(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).trim().to_owned()
}

/// Installs header, libraries and the pkg-config file into a separate folder, once for all tests.
///
/// Cargo does not build the C library for tests, so it is built here. The build has the packages,
/// targets and features of `make test`, so both use the same artefacts.
fn installed() -> &'static Path {
    static INSTALLED: OnceLock<PathBuf> = OnceLock::new();
    INSTALLED.get_or_init(|| {
        let mut build = Command::new(env!("CARGO"));
        build.args(["build", "-p", "lasertrace", "-p", "lasertrace-c"]);
        build.args(["--lib", "--test", "header"]);
        build.args(["--features", "lasertrace/service,lasertrace/race"]);
        if target().ends_with("release") {
            build.arg("--release");
        }
        run(build.current_dir(root()));
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("c");
        let install = Path::new(env!("CARGO_MANIFEST_DIR")).join("install.sh");
        run(Command::new(install).args([&folder, &target()]));
        folder
    })
}

fn pkg_config(arguments: &[&str]) -> Vec<String> {
    let mut command = Command::new("pkg-config");
    command.env("PKG_CONFIG_PATH", installed().join("lib/pkgconfig"));
    let flags = text(&run(command.args(arguments).arg("lasertrace")));
    flags.split_whitespace().map(str::to_owned).collect()
}

fn has(tool: &str) -> bool {
    Command::new(tool).arg("--version").output().is_ok()
}

/// Kind of linking.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Linked {
    Shared,
    Static,
}

/// Compiles a source file. Returns the program and its temporary folder.
fn compiled(source: &str, linked: Linked, more: &[&str]) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let program = folder.path().join("program");
    let mut flags = pkg_config(&["--cflags", "--libs"]);
    if linked == Linked::Static {
        // The archive is given by path, because the linker prefers a shared library of the same
        // name.
        let archive = installed()
            .join("lib/liblasertrace.a")
            .display()
            .to_string();
        let all = pkg_config(&["--cflags", "--libs", "--static"]);
        let named = |flag: String| match flag == "-llasertrace" {
            true => archive.clone(),
            false => flag,
        };
        flags = all.into_iter().map(named).collect();
    }
    let mut cc = Command::new("cc");
    cc.args(WARNINGS)
        .args(more)
        .args(["-pthread", "-o"])
        .arg(&program);
    cc.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join(source));
    cc.args(flags).arg("-lm");
    run(&mut cc);
    (folder, program)
}

fn started(program: &Path) -> Command {
    let mut command = Command::new(program);
    command.env("LD_LIBRARY_PATH", installed().join("lib"));
    let leaks = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/leaks.txt");
    let leaks = format!("print_suppressions=0:suppressions={}", leaks.display());
    command.env("LSAN_OPTIONS", leaks);
    command
}

/// Runs `check` on a program for every kind of linking.
fn each_way(source: &str, check: impl Fn(Command)) {
    if !has("cc") || !has("pkg-config") {
        eprintln!("SKIPPED: the C programs, for cc or pkg-config is missing");
        return;
    }
    let sanitizer = ["-fsanitize=address", "-g"];
    for linked in [Linked::Shared, Linked::Static] {
        let (_folder, program) = compiled(source, linked, &[]);
        check(started(&program));
        if !has_sanitizer() {
            eprintln!("SKIPPED: {source} under AddressSanitizer, which cc does not have");
            continue;
        }
        let (_folder, program) = compiled(source, linked, &sanitizer);
        check(started(&program));
    }
}

fn has_sanitizer() -> bool {
    static HAS: OnceLock<bool> = OnceLock::new();
    *HAS.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("empty.c");
        std::fs::write(&file, "int main(void) { return 0; }\n").unwrap();
        let program = folder.path().join("empty");
        let mut cc = Command::new("cc");
        cc.arg("-fsanitize=address")
            .arg(file)
            .arg("-o")
            .arg(&program);
        let built = cc.output().is_ok_and(|output| output.status.success());
        built && Command::new(program).status().is_ok_and(|s| s.success())
    })
}

#[test]
fn rays_are_cast() {
    each_way("examples/cast.c", |mut program| {
        let said = text(&run(&mut program));
        assert!(said.contains("ray 2 meets nothing"), "{said}");
        assert!(
            said.ends_with(concat!("lasertrace ", env!("CARGO_PKG_VERSION"))),
            "{said}"
        );
    });
}

/// A frame is byte-identical from C, from Rust and from the command line.
#[test]
fn a_frame_is_to_the_byte_that_of_rust_and_of_the_command_line() {
    const FRAME: u32 = 90;
    let path = root().join("scenes/bracket/scene.toml");
    let scene = lasertrace_core::Scene::load(&path).unwrap();
    let simulation = lasertrace_core::Simulation::new(&scene).unwrap();
    let rust = simulation.image(FRAME).to_rows();
    assert!(rust.iter().any(|&count| count > 100), "the frame is dark");

    let folder = tempfile::tempdir().unwrap();
    let mut render = Command::new(target().join("lasertrace"));
    render.args(["render", "--frame", &FRAME.to_string(), "-o"]);
    run(render.arg(folder.path()).arg(&path));
    let picture = image::open(folder.path().join(format!("frame-{FRAME:06}.png"))).unwrap();
    let picture = picture.as_luma16().expect("16 bits of grey");
    assert!(picture.as_raw()[..] == rust, "the command line's counts");

    each_way("examples/frames.c", |mut program| {
        let file = folder.path().join("counts.bin");
        let numbers = [FRAME.to_string(), "2".to_owned()];
        run(program.arg(&path).args(numbers).arg(&file));
        let bytes = std::fs::read(&file).unwrap();
        let counts: Vec<u16> = (bytes.as_chunks::<2>().0.iter())
            .map(|&pair| u16::from_ne_bytes(pair))
            .collect();
        assert!(counts == rust, "C's counts");
    });
}

/// Returns a scene with a random part, pose and seed. The sensor has speckle and noise.
fn random_scene(draw: u64) -> String {
    use lasertrace_core::math::rng::{Purpose, RngKey};
    let key = RngKey::new(draw, Purpose::SensorNoise);
    let between = |i: u64, low: f64, high: f64| low + (high - low) * key.uniform(i);
    let radius = between(0, 2.0, 4.0);
    let part = match draw % 2 {
        0 => format!(
            "sphere = {{ radius_mm = {radius}, chordal_deviation_um = 2 }}\nposition_mm = [0, 0, {}]",
            -radius
        ),
        _ => format!(
            "step_block = {{ size_mm = [20, 20, 10], step_mm = {} }}\nposition_mm = [0, 0, -9.5]",
            between(1, 0.3, 0.9)
        ),
    };
    let (turn, tilt) = (between(2, -40.0, 40.0), between(3, -8.0, 8.0));
    let text = include_str!("../../../scenes/plane/scene.toml");
    let changes = [
        ("seed = 1", format!("seed = {draw}")),
        ("speckle = false", "speckle = true".to_owned()),
        ("plane = { size_mm = [20, 20] }", part),
        (
            "rotation_deg = [8, 5, 0]",
            format!("rotation_deg = [{tilt}, 0, {turn}]"),
        ),
        (
            "full_well_e = 20000",
            "full_well_e = 20000\nread_noise_e = 8".to_owned(),
        ),
        (
            "resolution_px = [640, 300]",
            "resolution_px = [320, 200]".to_owned(),
        ),
    ];
    changes.iter().fold(text.to_owned(), |text, (from, to)| {
        assert!(text.contains(from), "{from}");
        text.replace(from, to)
    })
}

/// Records of `profiles.npy`, reduced to the fields that `points.c` writes.
fn records(file: &Path) -> Vec<u8> {
    // Frame, column, twelve numbers and flags.
    const RECORD: usize = 4 + 4 + 12 * 8 + 2;
    let bytes = std::fs::read(file).unwrap();
    let header = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    let of = |record: &[u8]| [&record[..8], &record[8 + 9 * 8..]].concat();
    bytes[header..].chunks(RECORD).flat_map(of).collect()
}

/// Flags, repeatability and correlation lengths of random scenes are byte-identical from C and from
/// the command line, for complete scans and for some of their frames. Neighbouring frames decide on
/// the flags of some points.
#[test]
fn points_are_to_the_byte_that_of_the_command_line() {
    if !has("cc") || !has("pkg-config") {
        eprintln!("SKIPPED: the C programs, for cc or pkg-config is missing");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (_folder, program) = compiled("tests/points.c", Linked::Shared, &[]);
    let mut decided = 0;
    for draw in 1..=3 {
        let path = folder.path().join(format!("{draw}.toml"));
        std::fs::write(&path, random_scene(draw)).unwrap();
        let scene = lasertrace_core::Scene::load(&path).unwrap();
        let simulation = lasertrace_core::Simulation::new(&scene).unwrap();
        for (first, end) in [(0, 9), (3, 4 + draw as u32)] {
            let out = folder.path().join(format!("{draw}-{first}"));
            let mut scan = Command::new(target().join("lasertrace"));
            scan.args(["scan", "--frames", &format!("{first}..{end}"), "-o"]);
            run(scan.arg(&out).arg(&path));
            let found = records(&out.join("profiles.npy"));
            let single = (first..end).flat_map(|frame| simulation.profile(frame).1);
            let flags = single.map(|point| point.flags.bits());
            let pairs = flags.zip(found.chunks(34));
            decided += pairs
                .filter(|(flags, record)| flags.to_le_bytes() != record[32..])
                .count();
            let file = folder.path().join("points.bin");
            let mut program = started(&program);
            program.arg(&path);
            program.args([first.to_string(), (end - first).to_string()]);
            run(program.arg(&file));
            let of_c = std::fs::read(&file).unwrap();
            assert!(!found.is_empty() && found == of_c, "{draw}: {first}..{end}");
        }
    }
    assert!(decided > 0, "no flag depends on neighbouring frames");
}

/// Features of the parts of `random_scene`: values with and without a tolerance, and a face that the
/// sensor does not see.
fn features(draw: u64) -> String {
    let seen = match draw % 2 {
        0 => "name = \"ball\"\nkind = \"sphere\"\npoint_mm = [0, 0, RADIUS]\nform = true\n\
              tolerance = { diameter_mm = [-0.02, 0.02] }\n"
            .to_owned(),
        _ => "name = \"high, \\\"wide\\\"\"\nkind = \"plane\"\npoint_mm = [4, 0, 10]\n\
              tolerance = { offset_mm = [-0.01, 0.01], form_mm = [0, 0.001] }\n\
              [[feature]]\nname = \"hidden\"\nkind = \"plane\"\npoint_mm = [1, 2, 0]\n"
            .to_owned(),
    };
    format!("[[feature]]\n{seen}")
}

/// Returns the fields of a line of CSV.
fn fields(line: &str) -> Vec<String> {
    let (mut fields, mut quoted) = (vec![String::new()], false);
    let mut characters = line.chars().peekable();
    while let Some(c) = characters.next() {
        let field = fields.last_mut().unwrap();
        match c {
            '"' if quoted && characters.peek() == Some(&'"') => field.extend(characters.next()),
            '"' => quoted = !quoted,
            ',' if !quoted => fields.push(String::new()),
            c => field.push(c),
        }
    }
    fields
}

/// Values and verdicts of features of random scenes are equal from C and from the command line.
#[test]
fn features_are_those_of_the_command_line() {
    if !has("cc") || !has("pkg-config") {
        eprintln!("SKIPPED: the C programs, for cc or pkg-config is missing");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (_folder, program) = compiled("examples/features.c", Linked::Shared, &[]);
    let (mut values, mut problems) = (0, 0);
    for draw in 1..=3 {
        let path = folder.path().join(format!("{draw}.toml"));
        let scene = random_scene(draw);
        let radius = scene.split("radius_mm = ").nth(1);
        let radius = radius.map_or("", |text| text.split(',').next().unwrap());
        std::fs::write(
            &path,
            scene.clone() + &features(draw).replace("RADIUS", radius),
        )
        .unwrap();
        let out = folder.path().join(format!("out-{draw}"));
        let mut scan = Command::new(target().join("lasertrace"));
        run(scan.args(["scan", "-o"]).arg(&out).arg(&path));
        let table = std::fs::read_to_string(out.join("features.csv")).unwrap();
        let of_c = text(&run(started(&program).arg(&path)));
        let rows: Vec<&str> = table.trim().lines().skip(1).collect();
        assert!(
            !rows.is_empty() && rows.len() == of_c.lines().count(),
            "{of_c}"
        );
        for (row, c) in rows.into_iter().zip(of_c.lines()) {
            let row = fields(row);
            // Names and problems contain commas in C's output without quotation marks.
            let numbers = |from: usize| row[from..].to_vec();
            let number = |text: &str| text.parse::<f64>().unwrap_or(0.0);
            let tail = format!(",{},{}", row[1], row[2]);
            let (name, rest) = c.split_once(&tail).unwrap();
            assert_eq!(name, row[0]);
            let c: Vec<&str> = rest.trim_start_matches(',').split(',').collect();
            for (k, text) in numbers(3).iter().enumerate().take(11) {
                match k {
                    7 => assert_eq!(text, c[k], "{row:?}"),
                    _ => assert_eq!(number(text), number(c[k]), "{k} of {row:?}"),
                }
            }
            let problem = c[11..c.len() - 1].join(",");
            assert_eq!(problem, row[14], "{row:?}");
            match problem.is_empty() {
                true => {
                    values += 1;
                    assert_eq!(c[c.len() - 1] == "1", row[15] == "true", "{row:?}");
                }
                false => problems += 1,
            }
        }
    }
    assert!(values >= 10 && problems >= 1, "{values} {problems}");
}

/// Rounding modes, traps, a small stack, many handles and `fork` do not affect the results.
#[test]
fn what_a_process_does_around_the_library_changes_nothing() {
    each_way("tests/process.c", |mut program| {
        run(program.arg(root().join("scenes/plane/scene.toml")));
    });
}

/// Regenerate the table with `LASERTRACE_WRITE_PAGES=1 cargo test -p lasertrace-c --test programs`.
#[test]
fn a_hostile_call_is_an_error() {
    let folder = root().join("scenes/plane");
    let readme = Path::new(env!("CARGO_MANIFEST_DIR")).join("README.md");
    each_way("tests/hostile.c", |mut program| {
        let output = run(program.arg(folder.join("scene.toml")).arg(&folder));
        // Folders and addresses differ between machines.
        let said = text(&output).replace(&folder.display().to_string(), "FOLDER");
        let table: Vec<String> = said.lines().map(row).collect();
        let table = table.join("\n");
        let page = std::fs::read_to_string(&readme).unwrap();
        let head = "| call | status | message |\n|---|---|---|\n";
        let (before, _) = page.split_once(head).expect("the table's head");
        let renewed = format!("{before}{head}{table}\n");
        if std::env::var_os("LASERTRACE_WRITE_PAGES").is_some() {
            std::fs::write(&readme, &renewed).unwrap();
        }
        let page = std::fs::read_to_string(&readme).unwrap();
        assert!(
            page == renewed,
            "bindings/c/README.md does not have this table:\n{table}\nrun \
             `LASERTRACE_WRITE_PAGES=1 cargo test -p lasertrace-c --test programs`"
        );
    });
}

/// Replaces the addresses in a row of the table.
fn row(line: &str) -> String {
    let words = line.split(' ').map(|word| match word.starts_with("0x") {
        true => "0x…",
        false => word,
    });
    words.collect::<Vec<_>>().join(" ")
}
