//! What the compiler does not see of the laws of ARCHITECTURE.md: which room may import
//! which, and that neither rooms nor the files of a room import each other in circles.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

/// The rooms from the ground up: each may import those before it.
const ROOMS: &[&str] = &[
    "error", "math", "mesh", "accel", "race", "laser", "surface", "camera", "speckle", "wave",
    "frame", "profile", "plan", "inspect", "scene", "report", "run", "study", "service", "view",
    "cli",
];

/// What a room may not import though it stands before it, and why.
const FORBIDDEN: &[(&str, &[&str], &str)] = &[
    (
        "laser",
        &["mesh", "accel", "race"],
        "models know no triangles",
    ),
    (
        "surface",
        &["mesh", "accel", "race", "laser"],
        "models know no triangles and not each other",
    ),
    (
        "camera",
        &["mesh", "accel", "race", "laser", "surface"],
        "models know no triangles and not each other",
    ),
    (
        "speckle",
        &["mesh", "accel", "race", "laser", "surface", "camera"],
        "models know no triangles and not each other",
    ),
    (
        "profile",
        &["mesh", "accel", "race", "laser", "surface", "frame"],
        "a measurement does not read its own truth",
    ),
];

/// Rooms of plain data in, plain data out, and what they may not name.
const HOT: &[&str] = &[
    "math", "laser", "surface", "camera", "speckle", "frame", "profile",
];
const NOT_IN_HOT: &[&str] = &["std::fs", "std::net", "Mutex", "RwLock"];

/// A file's module path, as "frame::light"; `lib.rs` and `main.rs` have none.
fn module(path: &Path) -> Option<String> {
    let text = path.with_extension("").to_str()?.replace('/', "::");
    let text = text.trim_end_matches("::mod").to_owned();
    (text != "lib" && text != "main").then_some(text)
}

fn room(module: &str) -> &str {
    module.split("::").next().unwrap_or(module)
}

fn read(folder: &Path, root: &Path, files: &mut BTreeMap<String, String>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            read(&path, root, files);
        } else if let Some(module) = module(path.strip_prefix(root).unwrap()) {
            // Tests stand in or below the file they test, and may use what they like of it.
            let text = fs::read_to_string(&path).unwrap();
            let text = text
                .split("\n#[cfg(test)]\nmod ")
                .next()
                .unwrap()
                .to_owned();
            if !module.ends_with("tests") {
                files.insert(module, text);
            }
        }
    }
}

/// The paths of a `use`, its groups opened: "super::a::{b, c::d}" gives "super::a::b" and
/// "super::a::c::d".
fn opened(path: &str) -> Vec<String> {
    let Some((start, group)) = path.split_once('{') else {
        let path = path.split(" as ").next().unwrap_or(path);
        return vec![path.trim().to_owned()];
    };
    let group = &group[..group.rfind('}').unwrap_or(group.len())];
    let (mut parts, mut depth, mut begin) = (Vec::new(), 0, 0);
    for (i, c) in group.char_indices() {
        match c {
            '{' => depth += 1,
            '}' => depth -= 1,
            ',' if depth == 0 => {
                parts.push(&group[begin..i]);
                begin = i + 1;
            }
            _ => {}
        }
    }
    parts.push(&group[begin..]);
    let parts = parts.into_iter().filter(|part| !part.trim().is_empty());
    parts
        .flat_map(|part| opened(&format!("{start}{}", part.trim())))
        .collect()
}

/// Paths from the crate's root that a module names, in `use` and in place; what it only shows
/// again (`pub use`) if `shown`.
fn named(module: &str, text: &str, shown: bool) -> Vec<String> {
    let code: Vec<&str> = text
        .lines()
        .filter(|line| !line.trim_start().starts_with("//"))
        .collect();
    let code = code.join("\n");
    let mut paths = Vec::new();
    let uses = code.split("\n").collect::<Vec<_>>().join(" ");
    for statement in uses.split(';') {
        let statement = statement.trim();
        let Some(at) = statement.rfind("use ") else {
            continue;
        };
        let before = statement[..at].trim_end();
        let again = before.ends_with("pub") || before.ends_with(')');
        if before.is_empty() || before.ends_with(['{', '}', ']']) || again && shown {
            paths.extend(opened(statement[at + 4..].trim()));
        }
    }
    for start in ["crate::", "super::"] {
        for (at, _) in code.match_indices(start) {
            let rest: String = code[at..]
                .chars()
                .take_while(|c| c.is_alphanumeric() || "_:".contains(*c))
                .collect();
            if !rest.ends_with(':') {
                paths.push(rest);
            }
        }
    }
    paths
        .into_iter()
        .map(|path| {
            if let Some(path) = path.strip_prefix("crate::") {
                return path.to_owned();
            }
            let mut base: Vec<&str> = module.split("::").collect();
            let mut rest = path.as_str();
            if !rest.starts_with("super::") && !rest.starts_with("self::") {
                // Of its own child.
                return format!("{module}::{rest}");
            }
            while let Some(further) = rest.strip_prefix("super::") {
                base.pop();
                rest = further;
            }
            rest = rest.strip_prefix("self::").unwrap_or(rest);
            base.push(rest);
            base.join("::")
        })
        .collect()
}

/// The file in which what a path names is written: re-exports are followed.
fn file_of(path: &str, files: &BTreeMap<String, String>) -> Option<String> {
    let mut end = path.len();
    let file = loop {
        if files.contains_key(&path[..end]) {
            break &path[..end];
        }
        end = path[..end].rfind("::")?;
    };
    let Some(name) = path[end..].strip_prefix("::") else {
        return Some(file.to_owned());
    };
    let name = name.split("::").next().unwrap_or(name);
    let reexport = named(file, &files[file], true).into_iter().find(|path| {
        path.starts_with(&format!("{file}::"))
            && path.ends_with(&format!("::{name}"))
            && path.matches("::").count() > file.matches("::").count() + 1
    });
    match reexport {
        Some(shown) if shown != path => file_of(&shown, files),
        _ => Some(file.to_owned()),
    }
}

fn imports() -> BTreeMap<String, BTreeSet<String>> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = BTreeMap::new();
    read(&root, &root, &mut files);
    assert!(files.len() > 100, "{}", files.len());
    let of = |module: &String, text: &String| {
        let paths = named(module, text, false).into_iter();
        let found = paths.filter_map(|path| file_of(&path, &files));
        found.filter(|other| other != module).collect()
    };
    let imports = files
        .iter()
        .map(|(module, text)| (module.clone(), of(module, text)));
    imports.collect()
}

#[test]
fn rooms_import_downwards() {
    let place = |name: &str| ROOMS.iter().position(|room| *room == name);
    let mut wrong = Vec::new();
    for (module, others) in imports() {
        let own = room(&module);
        let own_place = place(own).unwrap_or_else(|| panic!("room {own} has no place in ROOMS"));
        for other in others {
            let theirs = room(&other);
            let forbidden = FORBIDDEN
                .iter()
                .find(|(room, others, _)| *room == own && others.contains(&theirs));
            if place(theirs).is_some_and(|theirs| theirs > own_place) {
                wrong.push(format!("{module} imports {other}, which stands above it"));
            } else if let Some((_, _, why)) = forbidden {
                wrong.push(format!("{module} imports {other}: {why}"));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// What a file imports of its own room, and what that imports.
fn reached(module: &str, imports: &BTreeMap<String, BTreeSet<String>>) -> BTreeSet<String> {
    let mut reached = BTreeSet::new();
    let mut next = vec![module.to_owned()];
    while let Some(here) = next.pop() {
        let others = imports.get(&here).into_iter().flatten();
        for other in others.filter(|other| room(other) == room(module)) {
            if reached.insert(other.clone()) {
                next.push(other.clone());
            }
        }
    }
    reached
}

#[test]
fn files_do_not_import_each_other_in_circles() {
    let imports = imports();
    let reached: BTreeMap<&String, BTreeSet<String>> =
        imports.keys().map(|m| (m, reached(m, &imports))).collect();
    let mut circles = BTreeSet::new();
    for (module, others) in &reached {
        if others.contains(*module) {
            let with = others.iter().filter(|o| reached[*o].contains(*module));
            circles.insert(with.cloned().collect::<Vec<_>>().join(", "));
        }
    }
    let circles: Vec<String> = circles.into_iter().collect();
    assert!(
        circles.is_empty(),
        "circles of files:\n{}",
        circles.join("\n")
    );
}

#[test]
fn hot_rooms_do_no_input_output_and_take_no_locks() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = BTreeMap::new();
    read(&root, &root, &mut files);
    for (module, text) in files
        .iter()
        .filter(|(module, _)| HOT.contains(&room(module)))
    {
        for word in NOT_IN_HOT {
            assert!(!text.contains(word), "{module} names {word}");
        }
    }
}

/// The two ways a path is found, on text whose answer is known.
/// Names of the types that a file defines outside functions.
fn types(text: &str) -> impl Iterator<Item = &str> {
    text.lines().filter_map(|line| {
        let visible = line.strip_prefix("pub").map_or(line, |rest| {
            let rest = rest.strip_prefix('(').and_then(|rest| rest.split_once(')'));
            rest.map_or(&line["pub".len()..], |(_, rest)| rest)
                .trim_start()
        });
        let (kind, rest) = visible.split_once(' ')?;
        let name = rest.split(|c: char| !c.is_alphanumeric()).next()?;
        ["struct", "enum", "trait", "type", "union"]
            .contains(&kind)
            .then_some(name)
    })
}

#[test]
fn no_type_name_is_defined_twice() {
    let mut files = BTreeMap::new();
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    read(&root, &root, &mut files);
    let mut defined: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    let library = files.iter().filter(|(module, _)| room(module) != "cli");
    for (module, text) in library {
        for name in types(text) {
            defined.entry(name).or_default().push(module);
        }
    }
    assert!(defined.len() > 500, "{} types", defined.len());
    defined.retain(|_, modules| modules.len() > 1);
    assert!(defined.is_empty(), "{defined:#?}");
}

#[test]
fn imports_are_found() {
    let text =
        "use super::a::{B, c::{self, D}};\n// use crate::x::Y;\nfn f() { crate::math::g() }\n";
    let found = named("room::file", text, false);
    assert_eq!(
        found,
        ["room::a::B", "room::a::c::self", "room::a::c::D", "math::g"]
    );
}
