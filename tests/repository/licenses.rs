//! The Python wheel holds the licences of all that is linked into it: bindings/python/LICENSES-BUNDLED.md lists each
//! crate that `cargo tree` does. After a change of dependencies:
//! `LASERTRACE_WRITE_PAGES=1 cargo test --test repository licenses`.

use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

const WHEEL: &str = "x86_64-unknown-linux-gnu";

const HEAD: &str = "A wheel made by `wheel.sh` or `maturin build` holds copies of these libraries, in the folder
`lasertrace.libs`. Both are under the Apache License 2.0 (LICENSE-APACHE):

- Embree, © Intel Corporation, https://github.com/RenderKit/embree
- oneTBB, © Intel Corporation, https://github.com/uxlfoundation/oneTBB

The crates below are linked into its module. Those that offer the Apache License 2.0 are used under it; the texts of the
others follow. Written by `LASERTRACE_WRITE_PAGES=1 cargo test --test repository licenses`.

| crate | version | licence | source |
|---|---|---|---|
";

fn cargo(arguments: &[&str]) -> String {
    let output = Command::new(env!("CARGO"))
        .args(arguments)
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "cargo {arguments:?}: {stderr}");
    String::from_utf8(output.stdout).unwrap()
}

/// Name and version of each crate that is linked into the wheel, but for this project's own.
fn linked() -> BTreeSet<(String, String)> {
    let tree = cargo(&[
        "tree",
        "--locked",
        "-p",
        "lasertrace-python",
        "--edges=normal,no-proc-macro",
        "--target",
        WHEEL,
        "--prefix=none",
        "--no-dedupe",
        "--format={p}",
    ]);
    let of_line = |line: &str| {
        let mut words = line.split(' ');
        let name = words.next()?.to_owned();
        let version = words.next()?.strip_prefix('v')?.to_owned();
        (!name.starts_with("lasertrace")).then_some((name, version))
    };
    tree.lines().filter_map(of_line).collect()
}

/// The licence's files of a crate's folder: of several for choice, that of the MIT licence.
fn texts(folder: &Path, offers_apache: bool) -> Vec<PathBuf> {
    let files = fs::read_dir(folder)
        .unwrap()
        .map(|file| file.unwrap().path());
    let mut files: Vec<PathBuf> = files.filter(|file| file.is_file()).collect();
    files.sort();
    let begins = |file: &PathBuf, words: &[&str]| {
        let name = file.file_name().unwrap().to_string_lossy().to_uppercase();
        words.iter().any(|word| name.starts_with(word))
    };
    if offers_apache {
        files.retain(|file| begins(file, &["NOTICE"]));
    } else if files.iter().any(|file| begins(file, &["LICENSE-MIT"])) {
        files.retain(|file| begins(file, &["LICENSE-MIT", "NOTICE"]));
    } else {
        files.retain(|file| begins(file, &["LICENSE", "LICENCE", "COPYING", "NOTICE"]));
    }
    files
}

fn page() -> String {
    let metadata = cargo(&["metadata", "--locked", "--format-version=1"]);
    let metadata: Value = serde_json::from_str(&metadata).unwrap();
    let word = |package: &Value, key: &str| package[key].as_str().unwrap_or("").to_owned();
    let packages = metadata["packages"].as_array().unwrap().iter();
    let packages: BTreeMap<(String, String), &Value> = packages
        .map(|package| ((word(package, "name"), word(package, "version")), package))
        .collect();
    let (mut table, mut all_texts) = (HEAD.to_owned(), String::new());
    for (name, version) in linked() {
        let package = packages[&(name.clone(), version.clone())];
        let license = word(package, "license");
        assert!(!license.is_empty(), "{name} names no licence");
        let source = word(package, "repository");
        let _ = writeln!(table, "| {name} | {version} | {license} | {source} |");
        let manifest = PathBuf::from(word(package, "manifest_path"));
        for file in texts(manifest.parent().unwrap(), license.contains("Apache-2.0")) {
            let text = fs::read_to_string(&file).unwrap().replace("\r\n", "\n");
            let file = file.file_name().unwrap().to_string_lossy();
            let lines: Vec<&str> = text.lines().map(str::trim_end).collect();
            let text = lines.join("\n");
            let _ = write!(
                all_texts,
                "\n## {name} {version}: {file}\n\n```text\n{}\n```\n",
                text.trim_matches('\n')
            );
        }
    }
    table + &all_texts
}

#[test]
fn licenses_of_all_linked_crates_are_bundled() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("bindings/python/LICENSES-BUNDLED.md");
    let page = page();
    if std::env::var_os("LASERTRACE_WRITE_PAGES").is_some() {
        fs::write(&path, &page).unwrap();
    }
    let found = fs::read_to_string(&path).unwrap();
    for (name, version) in linked() {
        let row = format!("| {name} | {version} |");
        assert!(found.contains(&row), "no row of {name} {version}");
    }
    assert!(
        found == page,
        "{} differs from what is linked: LASERTRACE_WRITE_PAGES=1 cargo test --test repository licenses",
        path.display()
    );
}
