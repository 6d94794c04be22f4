//! The laws of ARCHITECTURE.md, read off the source text: which room may import which,
//! where `unsafe` may stand, how long a function may be, who may speak
//! to the terminal. A law that is broken on purpose goes into a table below with
//! its reason.

#[path = "architecture/laws.rs"]
mod laws;
#[path = "architecture/source.rs"]
mod source;

use laws::*;
use source::{code_of, functions};
use std::fs;
use std::path::Path;

fn visit(root: &Path, folder: &str, files: &mut Vec<String>) {
    let Ok(entries) = fs::read_dir(root.join(folder)) else {
        return;
    };
    for entry in entries {
        let entry = entry.unwrap();
        let path = format!("{folder}/{}", entry.file_name().to_str().unwrap());
        if entry.file_type().unwrap().is_dir() {
            visit(root, &path, files);
        } else if path.ends_with(".rs") {
            files.push(path);
        }
    }
}

#[test]
fn the_laws_hold() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut files = vec!["build.rs".to_owned()];
    for folder in ["src", "tests", "examples", "benches"] {
        visit(root, folder, &mut files);
    }
    assert!(files.len() > 40, "found only {files:?}");
    files.sort();
    let wrong: Vec<String> = files
        .iter()
        .flat_map(|path| violations(path, &fs::read_to_string(root.join(path)).unwrap()))
        .collect();
    assert!(wrong.is_empty(), "broken laws:\n{}", wrong.join("\n"));
}

/// An exception whose file or function is gone would hide the next one.
#[test]
fn every_exception_is_still_needed() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let read = |path: &str| fs::read_to_string(root.join(path)).unwrap_or_default();
    for (path, name, why) in LONG_FUNCTIONS {
        let code = code_of(&read(path));
        let long = |f: &(&str, usize, usize)| f.0 == *name && f.2 > MOST_LINES_OF_A_FUNCTION;
        assert!(
            functions(&code).iter().any(long) && !why.is_empty(),
            "{path}: {name}"
        );
    }
}

fn assert_found(path: &str, text: &str, words: &str) {
    let found = violations(path, text);
    assert!(
        found.len() == 1 && found[0].contains(words),
        "{path}: {text:?} gave {found:?}, expected one with {words:?}"
    );
}

#[test]
fn a_broken_import_law_is_found() {
    assert_found(
        "src/profile/peak.rs",
        "use crate::scene::Scene;",
        "`profile` must not import `scene`",
    );
    assert_found(
        "src/mesh/mod.rs",
        "fn f() { crate::accel::g() }",
        "import `accel`",
    );
    assert_found(
        "src/laser/mod.rs",
        "use crate::{math::{A, B}, camera};",
        ":1: `laser` must not",
    );
    assert_found(
        "src/speckle/a/b.rs",
        "\nuse super::super::super::accel::A;",
        ":2: `speckle`",
    );
    assert_found("src/surface.rs", "use super::laser;", "import `laser`");
    assert_found("src/novelty/mod.rs", "", "no place");
    assert_found(
        "src/main.rs",
        "fn main() { lasertrace::mesh::load() }",
        "import `mesh`",
    );
    assert_found(
        "src/main.rs",
        "fn main() { lasertrace::cli::run() }\nfn g() {}",
        "more than call",
    );
    let fine = "// use crate::scene;\nuse crate::mesh::{a, b};\nuse super::embree::{c};\n";
    assert_eq!(violations("src/accel/x.rs", fine), [""; 0]);
}

#[test]
fn a_careless_unsafe_is_found() {
    let careless = "fn f() {\n    let a = 1;\n    unsafe { g(a) }\n}\n";
    assert_found("src/accel/embree.rs", careless, ":3: unsafe without");
    assert_found("src/camera/mod.rs", careless, ":3: unsafe outside");
    assert_found(
        "src/accel/refine.rs",
        "// SAFETY: no.\nunsafe impl Send for A {}",
        "outside",
    );
    let one_for_two = "// SAFETY: a.\nlet a = unsafe { f() };\nlet b = unsafe { g() };\n";
    assert_found("src/capi.rs", one_for_two, ":3: unsafe without");
    let careful = "// SAFETY: a\n// and b.\nlet c =\n    unsafe { f() };\nlet d = unsafe {\n    \
                   // SAFETY: e.\n    f()\n};\nunsafe extern \"C\" fn g() {}\n";
    assert_eq!(violations("src/accel/embree_more.rs", careful), [""; 0]);
}

#[test]
fn what_is_too_long_is_found() {
    let body = "    // one line\n".repeat(68);
    let fits = format!(
        "fn fits(a: [u8; 2]) {{\n{}}}\n",
        &body["    // one line\n".len()..]
    );
    assert_eq!(violations("src/math/a.rs", &fits), [""; 0]);
    let long = format!("fn fits();\nfn long(a: [u8; 2]) {{\n{body}}}\n");
    assert_found("src/math/a.rs", &long, ":2: fn long of 70 lines");
    let quoted =
        format!("fn long() {{\n    let (a, b, c) = ('}}', \"}}\", r#\"\"}}\"#);\n{body}}}\n");
    assert_found("src/math/a.rs", &quoted, "fn long of 71 lines");
}

#[test]
fn who_speaks_or_locks_out_of_turn_is_found() {
    let speech = "fn f() {\n    eprintln!(\"{}\", 1);\n}\n";
    assert_found("src/batch/scan.rs", speech, ":2: eprintln!");
    assert_eq!(violations("src/cli/scan.rs", speech), [""; 0]);
    assert_eq!(violations("src/batch/scan/tests.rs", speech), [""; 0]);
    assert_found(
        "src/inspect/mod.rs",
        "fn f() { std::process::exit(1) }",
        "process::exit",
    );
    assert_found(
        "src/integrator/direct.rs",
        "static A: std::sync::Mutex<u8>;",
        "Mutex",
    );
    assert_found("src/speckle/lookup.rs", "use std::fs::File;", "std::fs");
    assert_eq!(violations("src/mesh/mod.rs", "use std::fs;"), [""; 0]);
}
