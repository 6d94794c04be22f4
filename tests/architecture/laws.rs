//! The laws as tables and as functions from a file's text to what is wrong.

use crate::source::{code_of, first_word, functions, is_word, line_of, words};

/// Each room (a folder or file of `src/`) and the rooms it may import. The order
/// is the way of the data, last step first: nothing imports upwards.
pub const MAY_IMPORT: &[(&str, &[&str])] = &[
    ("main", &["cli"]),
    (
        "cli",
        &[
            "service",
            "batch",
            "race",
            "scene",
            "inspect",
            "profile",
            "integrator",
            "camera",
            "laser",
            "speckle",
            "surface",
            "accel",
            "mesh",
            "math",
            "error",
        ],
    ),
    ("service", &["batch", "scene", "inspect", "error"]),
    (
        "capi",
        &[
            "batch",
            "scene",
            "inspect",
            "profile",
            "integrator",
            "camera",
            "laser",
            "speckle",
            "surface",
            "accel",
            "mesh",
            "math",
            "error",
        ],
    ),
    (
        "batch",
        &[
            "race",
            "scene",
            "inspect",
            "profile",
            "integrator",
            "camera",
            "laser",
            "speckle",
            "surface",
            "accel",
            "mesh",
            "math",
            "error",
        ],
    ),
    (
        "scene",
        &[
            "inspect",
            "profile",
            "integrator",
            "camera",
            "laser",
            "speckle",
            "surface",
            "accel",
            "mesh",
            "math",
            "error",
        ],
    ),
    // Compares with the CAD, so it may see triangles; the scene it may not.
    (
        "inspect",
        &[
            "profile",
            "integrator",
            "camera",
            "laser",
            "speckle",
            "surface",
            "accel",
            "mesh",
            "math",
            "error",
        ],
    ),
    // A measurement must not read its own ground truth: neither scene nor mesh.
    ("profile", &["camera", "speckle", "math", "error"]),
    (
        "integrator",
        &[
            "camera", "laser", "speckle", "surface", "accel", "mesh", "math", "error",
        ],
    ),
    // Light and lens know no triangles, and each knows nothing of the others.
    ("camera", &["math", "error"]),
    ("laser", &["math", "error"]),
    ("speckle", &["math", "error"]),
    ("surface", &["math", "error"]),
    // Embree against other crates: no light.
    ("race", &["accel", "mesh", "math", "error"]),
    ("accel", &["mesh", "math", "error"]),
    ("mesh", &["math", "error"]),
    ("math", &["error"]),
    ("error", &[]),
];

/// Rooms of the hot loops: plain data in, plain data out.
pub const WITHOUT_IO_AND_LOCKS: &[&str] = &[
    "profile",
    "integrator",
    "camera",
    "laser",
    "speckle",
    "surface",
    "math",
];

pub const MOST_LINES_OF_A_FUNCTION: usize = 69;

/// Functions that may be longer (file, name), and why.
pub const LONG_FUNCTIONS: &[(&str, &str, &str)] = &[
    (
        "tests/speckle_motion.rs",
        "a_table_may_turn_all_round",
        "one path from its first frame to its last",
    ),
    (
        "tests/hostile_input.rs",
        "cases",
        "a table of one row a case",
    ),
    (
        "tests/meshes.rs",
        "every_nasty_file_gives_the_right_mesh_or_an_error_that_names_the_problem",
        "a table of one row a file",
    ),
    (
        "src/mesh/ply/header.rs",
        "header_mistakes_are_placed_on_their_line",
        "a table of one row a mistake",
    ),
];

/// Room of a file: `src/mesh/ply/mod.rs` and `src/mesh.rs` are of `mesh`.
fn room_of(path: &str) -> Option<&str> {
    let inside = path.strip_prefix("src/")?;
    let room = inside.split('/').next()?.trim_end_matches(".rs");
    (room != "lib").then_some(room)
}

/// First names after a path's start, `{a, b::c}` opened: "a", "b".
fn names_after(rest: &str) -> Vec<&str> {
    let rest = rest.trim_start();
    let Some(group) = rest.strip_prefix('{') else {
        return vec![first_word(rest)];
    };
    let mut depth = 0;
    let mut start = 0;
    let mut names = Vec::new();
    for (i, c) in group.char_indices() {
        match c {
            '{' => depth += 1,
            '}' | ',' if depth == 0 => {
                names.push(first_word(&group[start..i]));
                start = i + 1;
                if c == '}' {
                    break;
                }
            }
            '}' => depth -= 1,
            _ => {}
        }
    }
    names.retain(|name| !name.is_empty());
    names
}

/// Rooms a file names, by `crate::`, by `lasertrace::` or by climbing out of its
/// own room with `super::`, each with its offset.
fn imports<'a>(path: &str, code: &'a str) -> Vec<(usize, &'a str)> {
    let folders = path.matches('/').count();
    let depth = if path.ends_with("/mod.rs") {
        folders - 1
    } else {
        folders
    };
    let mut found = Vec::new();
    for start in ["crate", "lasertrace"] {
        for at in words(code, start) {
            if let Some(rest) = code[at + start.len()..].strip_prefix("::") {
                found.extend(names_after(rest).into_iter().map(|name| (at, name)));
            }
        }
    }
    let climb = "super::".repeat(depth.max(1));
    for (at, _) in code.match_indices(&climb) {
        let is_room = |name: &str| MAY_IMPORT.iter().any(|(room, _)| *room == name);
        let names = names_after(&code[at + climb.len()..]).into_iter();
        found.extend(names.filter(|name| is_room(name)).map(|name| (at, name)));
    }
    found
}

fn import_violations(path: &str, code: &str) -> Vec<String> {
    let Some(room) = room_of(path) else {
        return Vec::new();
    };
    let Some((_, allowed)) = MAY_IMPORT.iter().find(|(name, _)| *name == room) else {
        return vec![format!("{path}: room `{room}` has no place in MAY_IMPORT")];
    };
    imports(path, code)
        .into_iter()
        .filter(|(_, name)| *name != room && !allowed.contains(name))
        .map(|(at, name)| {
            let line = line_of(code, at);
            format!("{path}:{line}: `{room}` must not import `{name}`")
        })
        .collect()
}

/// Whether a `// SAFETY:` comment stands above the statement on `line` (from 0),
/// or is the first thing after it.
fn has_safety_comment(lines: &[&str], line: usize) -> bool {
    if lines
        .get(line + 1)
        .is_some_and(|next| next.trim_start().starts_with("// SAFETY:"))
    {
        return true;
    }
    // Up to where the statement starts, then through the comment above it.
    let mut above = lines[..line]
        .iter()
        .rev()
        .map(|line| line.trim())
        .peekable();
    while let Some(text) = above.peek() {
        if text.starts_with("//") || text.is_empty() || text.ends_with([';', '{', '}', ',']) {
            break;
        }
        above.next();
    }
    above
        .take_while(|text| text.starts_with("//"))
        .any(|text| text.starts_with("// SAFETY:"))
}

fn unsafe_violations(path: &str, text: &str, code: &str) -> Vec<String> {
    let in_accel = path.strip_prefix("src/accel/").unwrap_or_default();
    let allowed = in_accel.starts_with("embree") || path == "src/capi.rs";
    let lines: Vec<&str> = text.lines().collect();
    let mut wrong = Vec::new();
    for at in words(code, "unsafe") {
        let line = line_of(code, at);
        let rest = code[at + "unsafe".len()..].trim_start();
        let promises = rest.starts_with('{') || first_word(rest) == "impl";
        if !allowed {
            wrong.push(format!(
                "{path}:{line}: unsafe outside accel/embree and capi.rs"
            ));
        } else if promises && !has_safety_comment(&lines, line - 1) {
            wrong.push(format!(
                "{path}:{line}: unsafe without a `// SAFETY:` comment"
            ));
        }
    }
    wrong
}

fn length_violations(path: &str, code: &str) -> Vec<String> {
    let mut wrong = Vec::new();
    for (name, line, lines) in functions(code) {
        let excepted = LONG_FUNCTIONS
            .iter()
            .any(|(file, function, _)| (*file, *function) == (path, name));
        if lines > MOST_LINES_OF_A_FUNCTION && !excepted {
            wrong.push(format!(
                "{path}:{line}: fn {name} of {lines} lines, at most {MOST_LINES_OF_A_FUNCTION}"
            ));
        }
    }
    wrong
}

fn speech_violations(path: &str, code: &str) -> Vec<String> {
    let Some(room) = room_of(path) else {
        return Vec::new();
    };
    let mut wrong = Vec::new();
    let mut forbid = |parts: &[&str], why: &str| {
        for part in parts {
            for (at, _) in code.match_indices(part) {
                if !code[..at].ends_with(is_word) {
                    wrong.push(format!("{path}:{}: {part} {why}", line_of(code, at)));
                }
            }
        }
    };
    // What a unit test prints, the harness catches.
    let is_test = path.ends_with("/tests.rs") || path.ends_with("_tests.rs");
    if !["cli", "main"].contains(&room) && !is_test {
        let speech = [
            "println!",
            "eprintln!",
            "print!",
            "eprint!",
            "dbg!",
            "process::exit",
        ];
        forbid(&speech, "outside src/cli and main.rs");
    }
    if WITHOUT_IO_AND_LOCKS.contains(&room) {
        let io = ["std::fs", "std::net", "Mutex", "RwLock"];
        forbid(&io, "in a room of plain data in, plain data out");
    }
    wrong
}

/// `src/main.rs` starts the program and returns its exit code; nothing else.
fn main_violations(path: &str, code: &str) -> Vec<String> {
    let functions = functions(code).len();
    let declares = |word| words(code, word).next().is_some();
    let more = functions != 1
        || ["struct", "enum", "mod", "static", "const"]
            .into_iter()
            .any(declares);
    match path == "src/main.rs" && (more || !code.contains("lasertrace::")) {
        true => vec![format!("{path}: does more than call the library")],
        false => Vec::new(),
    }
}

/// All laws on one file; `path` is relative to the project, with `/`.
pub fn violations(path: &str, text: &str) -> Vec<String> {
    let code = code_of(text);
    [
        import_violations(path, &code),
        unsafe_violations(path, text, &code),
        length_violations(path, &code),
        speech_violations(path, &code),
        main_violations(path, &code),
    ]
    .concat()
}
