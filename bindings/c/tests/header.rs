//! The header matches the output of cbindgen, and its version matches the crate.

use std::path::Path;

/// Regenerate with `LASERTRACE_WRITE_PAGES=1 cargo test -p lasertrace-c --test header`.
#[test]
fn the_header_is_that_of_the_source() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let config = cbindgen::Config::from_file(root.join("cbindgen.toml")).unwrap();
    let builder = cbindgen::Builder::new().with_config(config);
    // cbindgen follows the modules of this file. A module that is also given as a source is
    // declared twice.
    let builder = builder.with_src(root.join("src/lib.rs"));
    let mut made = Vec::new();
    builder.generate().unwrap().write(&mut made);
    let file = root.join("include/lasertrace.h");
    if std::env::var_os("LASERTRACE_WRITE_PAGES").is_some() {
        std::fs::write(&file, &made).unwrap();
    }
    let committed = std::fs::read(&file).unwrap_or_default();
    assert!(
        committed == made,
        "include/lasertrace.h is not that of the source: run \
         `LASERTRACE_WRITE_PAGES=1 cargo test -p lasertrace-c --test header`"
    );
    let text = String::from_utf8(made).unwrap();
    let parts = env!("CARGO_PKG_VERSION").split('.');
    for (part, value) in ["MAJOR", "MINOR", "PATCH"].iter().zip(parts) {
        let line = format!("#define LASERTRACE_VERSION_{part} {value}\n");
        assert!(text.contains(&line), "{line}");
    }
    assert_eq!(declared(&text), exported(&root.join("src")));
}

/// Returns the functions that the header declares, in order, including repetitions.
fn declared(header: &str) -> Vec<String> {
    let is_code = |line: &&str| {
        line.starts_with(|first: char| first.is_ascii_alphabetic()) && !line.starts_with("typedef")
    };
    let starts = (header.lines().filter(is_code)).filter_map(|line| line.split_once('('));
    let name = |start: &str| {
        let name = start.rsplit([' ', '*']).next();
        name.unwrap_or_default().to_owned()
    };
    let mut names: Vec<String> = starts.map(|(start, _)| name(start)).collect();
    names.sort_unstable();
    names
}

/// Returns the functions that the source exports to C, in order.
fn exported(sources: &Path) -> Vec<String> {
    let mut names = Vec::new();
    for file in std::fs::read_dir(sources).unwrap() {
        let text = std::fs::read_to_string(file.unwrap().path()).unwrap();
        let starts = text.split("extern \"C\" fn ").skip(1);
        names.extend(starts.map(|rest| rest.split('(').next().unwrap_or_default().to_owned()));
    }
    assert!(!names.is_empty());
    names.sort_unstable();
    names
}
