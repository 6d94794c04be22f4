//! What the library promises to keep is small and listed: docs/public-surface.txt is what
//! rustdoc shows, item by item, and the pages are made without a warning.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The pages as `cargo doc` makes them, where it makes them.
fn pages() -> PathBuf {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let target = Path::new(env!("CARGO_TARGET_TMPDIR")).parent().unwrap();
    let mut doc = Command::new(env!("CARGO"));
    doc.args(["doc", "--no-deps", "--lib", "-p", "lasertrace"])
        .env("RUSTDOCFLAGS", "-Dwarnings")
        .env("CARGO_TARGET_DIR", target);
    let output = doc.current_dir(root).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "cargo doc: {said}");
    target.join("doc/lasertrace")
}

/// What stands between `before` and `after`, each time.
fn between<'a>(text: &'a str, before: &'a str, after: &'a str) -> impl Iterator<Item = &'a str> {
    let pieces = text.split(before).skip(1);
    pieces.filter_map(move |piece| piece.split(after).next())
}

/// "struct.Scene.html" is "struct Scene".
fn item(page: &str) -> String {
    let path = page.trim_end_matches(".html");
    let (folder, file) = path.rsplit_once('/').unwrap_or(("", path));
    let (kind, name) = file.split_once('.').unwrap();
    let module = folder.replace('/', "::");
    let colons = if module.is_empty() { "" } else { "::" };
    format!("{kind} {module}{colons}{name}")
}

/// A line for each item, and for each field, variant and method of its own.
fn surface(pages: &Path) -> String {
    let all = fs::read_to_string(pages.join("all.html")).unwrap();
    let mut lines = BTreeSet::new();
    let links = between(&all, "<li><a href=\"", "\"");
    for page in links.filter(|link| !link.starts_with('#')) {
        let item = item(page);
        let text = fs::read_to_string(pages.join(page)).unwrap();
        // Methods of traits have another class, and are not the item's own.
        let marks = [
            ("id=\"structfield.", "\" class=\"structfield", "field"),
            ("id=\"variant.", "\" class=\"variant", "variant"),
            ("id=\"method.", "\" class=\"method\"", "method"),
            (
                "id=\"associatedconstant.",
                "\" class=\"associatedconstant\"",
                "constant",
            ),
        ];
        for (before, after, kind) in marks {
            let found = between(&text, before, ">").filter_map(|tag| {
                let at = tag.find(after)?;
                Some(&tag[..at])
            });
            lines.extend(found.map(|name| format!("{item}: {kind} {name}\n")));
        }
        lines.insert(format!("{item}\n"));
    }
    lines.into_iter().collect()
}

/// To renew it: `LASERTRACE_WRITE_PAGES=1 cargo test --test repository public_surface`.
#[test]
fn the_public_surface_is_the_one_listed() {
    let surface = surface(&pages());
    assert!(
        surface.contains("struct Simulation: method image\n"),
        "{surface}"
    );
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/public-surface.txt");
    if std::env::var_os("LASERTRACE_WRITE_PAGES").is_some() {
        fs::write(&file, &surface).unwrap();
    }
    let listed = fs::read_to_string(&file).unwrap_or_default();
    let [was, is] = [&listed, &surface].map(|text| text.lines().collect::<BTreeSet<_>>());
    let gone: Vec<_> = was.difference(&is).collect();
    let new: Vec<_> = is.difference(&was).collect();
    assert!(
        listed == surface,
        "what rustdoc shows is not what docs/public-surface.txt lists.\nGone: {gone:#?}\nNew: \
         {new:#?}\nA change on purpose goes into CHANGELOG.md, and the list is renewed by \
         LASERTRACE_WRITE_PAGES=1 cargo test --test repository public_surface"
    );
}
