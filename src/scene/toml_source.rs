//! Source locations of the keys of a scene, for error messages.

use super::keys;
use super::old_keys::RENAMED;
use crate::error::input_file::{self, LARGEST_TEXT};
use crate::error::{Error, InputError, Place};
use serde::de::DeserializeOwned;
use std::ops::Range;
use std::path::{Path, PathBuf};
use toml::Spanned;
use toml::de::{DeTable, DeValue};

/// Text of a scene file with the locations of its keys. It may include the text of a sensor file,
/// whose values apply where the scene has none. From a list of cameras, one is selected.
#[derive(Default, Clone)]
pub(super) struct TomlSource {
    /// All files; the scene is first.
    files: Vec<FileText>,
    entries: Vec<Entry>,
    /// Index of the selected camera.
    camera: usize,
}

/// Text of one file of a source.
#[derive(Clone)]
struct FileText {
    file: PathBuf,
    /// Text after a prefix of spaces. The prefix is as long as all preceding files, which makes
    /// byte offsets unique across files.
    text: String,
    start: usize,
    /// True if the text is derived from a data sheet, and therefore has no line numbers.
    solved: bool,
}

#[derive(Clone)]
struct Entry {
    /// Dotted key.
    key: String,
    /// Byte range of the key.
    at: Range<usize>,
    /// Byte range of the value.
    value: Range<usize>,
    kind: ValueKind,
}

#[derive(Clone, Copy)]
enum ValueKind {
    Table,
    /// List whose first element is a table.
    Tables,
    List,
    Value,
}

impl TomlSource {
    /// Reads a file. Returns an error if it cannot be read, is not a regular file, or is not TOML.
    pub fn read(path: &Path) -> Result<TomlSource, Error> {
        let bytes = input_file::read(path, LARGEST_TEXT, "a scene file (TOML)")?;
        let text = String::from_utf8(bytes).map_err(|error| {
            let place = Place::Byte(error.utf8_error().valid_up_to() as u64);
            let expected = "a scene or a sensor as TOML text; a mesh is named in a scene, \
                            [part] mesh = { file = \"part.stl\", unit = \"mm\" }";
            InputError::new(path, place, "bytes that are not UTF-8", expected)
        })?;
        TomlSource::parse(path, text)
    }

    /// Parses a text. Returns an error if it is not TOML.
    pub fn parse(file: &Path, text: String) -> Result<TomlSource, Error> {
        let mut source = TomlSource {
            files: vec![FileText {
                file: file.to_owned(),
                text,
                start: 0,
                solved: false,
            }],
            entries: Vec::new(),
            camera: 0,
        };
        let mut entries = Vec::new();
        // The readable part of an erroneous file serves to locate the error.
        let (mut table, errors) = DeTable::parse_recoverable(&source.files[0].text);
        select_camera(table.get_mut(), 0);
        collect("", table.get_ref(), &mut entries);
        let error = errors.into_iter().next();
        source.entries = entries;
        match error {
            Some(error) => Err(source.not_toml(&error)),
            None => source.no_list_for_a_table().map(|()| source),
        }
    }

    /// Adds the values of the file `under` where this source has none. `solved`: they are derived
    /// from other values.
    pub fn overlay(mut self, file: &Path, under: &str, solved: bool) -> TomlSource {
        let start = self
            .files
            .iter()
            .map(|part| part.text.len())
            .max()
            .unwrap_or(0);
        self.files.push(FileText {
            file: file.to_owned(),
            text: " ".repeat(start) + under,
            start,
            solved,
        });
        self.located()
    }

    /// Returns the source with the locations of the selected keys.
    fn located(mut self) -> TomlSource {
        let mut entries = Vec::new();
        collect("", self.table().get_ref(), &mut entries);
        self.entries = entries;
        self
    }

    /// Returns the number of cameras in the longest list `[[camera]]`, at least 1.
    pub fn cameras(&self) -> usize {
        let of = |part: &FileText| {
            let (mut table, _) = DeTable::parse_recoverable(&part.text);
            select_camera(table.get_mut(), 0)
        };
        self.files.iter().map(of).fold(1, usize::max)
    }

    /// Returns the number of files in the list `measure.calibration`; `None` if it is no list.
    pub fn calibrations(&self) -> Option<usize> {
        let of = |part: &FileText| {
            let (mut table, _) = DeTable::parse_recoverable(&part.text);
            select_calibration(table.get_mut(), 0)
        };
        self.files.iter().find_map(of)
    }

    /// Returns the position of the selected camera in the list, from 1.
    pub fn camera_number(&self) -> u32 {
        self.camera as u32 + 1
    }

    /// Returns the source with the camera of this index. A single table `[camera]` applies to all
    /// cameras.
    pub fn with_camera(&self, camera: usize) -> TomlSource {
        TomlSource {
            camera,
            ..self.clone()
        }
        .located()
    }

    /// Returns all values. Every file was parsed before, so it is valid TOML.
    pub fn table(&self) -> Spanned<DeTable<'_>> {
        let tables = self.files.iter().map(|part| {
            let (mut table, _) = DeTable::parse_recoverable(&part.text);
            select_camera(table.get_mut(), self.camera);
            select_calibration(table.get_mut(), self.camera);
            table
        });
        tables
            .reduce(|mut table, under| {
                fill(table.get_mut(), under.into_inner());
                table
            })
            .expect("a source has a file")
    }

    /// Deserializes the values into `T`. Returns mistakes with their source locations.
    pub fn values<T: DeserializeOwned>(&self) -> Result<T, Error> {
        let table = toml::de::Deserializer::from(self.table());
        T::deserialize(table).map_err(|error| self.explain(&error))
    }

    /// Returns an error if the file is not a scene.
    pub fn require_scene(&self) -> Result<(), Error> {
        let has = |key: &str| self.has(key);
        let (kind, hint) = match file_kind(has) {
            Some(kind @ FileKind::Sensor) => {
                (kind, "lasertrace begin makes one of a part and this file")
            }
            Some(kind @ FileKind::Sweep) => (kind, "lasertrace sweep takes this file"),
            Some(kind @ FileKind::Recipe) => (kind, "lasertrace dataset takes this file"),
            Some(FileKind::Scene) | None => return Ok(()),
        };
        let expected = "a scene, which names a sensor, a part and a path";
        let mut mistake = self.mistake(None, None, kind.name(), expected);
        mistake.hint = Some(hint.to_owned());
        Err(mistake.into())
    }

    /// Rejects a list at the key of a table. Serde would assign its elements to the table's keys by
    /// order.
    fn no_list_for_a_table(&self) -> Result<(), Error> {
        let list = self.entries.iter().find(|entry| {
            let inside = keys::inside(&entry.key).next().is_some();
            matches!(entry.kind, ValueKind::List | ValueKind::Tables) && inside
        });
        let Some(entry) = list else { return Ok(()) };
        let (key, place) = (&entry.key, Some(entry.at.start));
        let (found, expected) = match entry.kind {
            ValueKind::Tables => (
                format!("[[{key}]], a list of tables"),
                format!("[{key}], one table"),
            ),
            _ => (self.written(entry).to_owned(), A_TABLE.to_owned()),
        };
        Err(self.error(place, Some(key), found, &expected))
    }

    /// Returns the texts of all files, concatenated.
    pub fn text(&self) -> String {
        self.files
            .iter()
            .map(|part| &part.text[part.start..])
            .collect()
    }

    /// Returns the file that contains `offset`.
    fn file(&self, offset: usize) -> &FileText {
        let mut files = self.files.iter().rev();
        let found = files.find(|part| part.start <= offset);
        found.unwrap_or(&self.files[0])
    }

    /// Returns the text before `offset`, clamped to the text length and to a character boundary.
    fn before(&self, offset: usize) -> &str {
        let text = &self.file(offset).text;
        let mut ends = (0..=offset.min(text.len())).rev();
        let end = ends.find(|&end| text.is_char_boundary(end));
        &text[..end.unwrap_or(0)]
    }

    fn line(&self, offset: usize) -> Place {
        let FileText { text, solved, .. } = self.file(offset);
        let before = &text.as_bytes()[..offset.min(text.len())];
        match solved {
            true => Place::File,
            false => Place::Line(1 + before.iter().filter(|&&b| b == b'\n').count()),
        }
    }

    /// Returns the first line of an entry's value as written.
    fn written(&self, entry: &Entry) -> &str {
        let text = &self.file(entry.value.start).text[entry.value.clone()];
        text.lines().next().unwrap_or_default()
    }

    /// Whether `key` is in the file that first describes `table`, and not in one that overrides it.
    pub fn is_in_base_file(&self, key: &str, table: &str) -> bool {
        let start = |entry: &Entry| self.file(entry.at.start).start;
        let own = self.entries.iter().find(|entry| entry.key == key);
        let in_table = self.entries.iter().filter(|entry| {
            let name = entry.key.strip_prefix(table);
            name.is_some_and(|name| name.starts_with('.'))
        });
        own.is_some_and(|own| in_table.map(start).max() == Some(start(own)))
    }

    /// Returns the file that contains `key`; the scene file if no file does.
    pub fn file_of(&self, key: &str) -> &Path {
        let entry = self.entries.iter().find(|entry| entry.key == key);
        &self.file(entry.map_or(0, |entry| entry.at.start)).file
    }

    /// Returns whether `key` has a value.
    pub fn has(&self, key: &str) -> bool {
        self.entries.iter().any(|entry| entry.key == key)
    }

    /// Returns an error with the value of `key` as written. If the key is absent, the location is
    /// the line of its nearest ancestor.
    pub fn input_error(&self, key: &str, expected: &str) -> Error {
        let mut path = key;
        let found = |path: &str| self.entries.iter().find(|entry| entry.key == path);
        let place = loop {
            match (found(path), path.rfind('.')) {
                (Some(entry), _) => break Some(entry.at.start),
                (None, Some(dot)) => path = &path[..dot],
                (None, None) => break None,
            }
        };
        let value = found(key).map_or("", |entry| self.written(entry));
        self.error(place, Some(key), value, expected)
    }

    /// Returns an error for a required `key` that is absent.
    pub fn missing(&self, key: &str) -> Error {
        let expected = match key.rsplit_once('.') {
            _ if keys::inside(key).next().is_some() => format!("a table [{key}]"),
            Some((table, name)) => format!("{name} = ... in {}", header(table)),
            None => format!("{key} = ... above the first [table]"),
        };
        self.input_error(key, &expected)
    }

    /// Returns an error for text that the TOML parser rejects.
    fn not_toml(&self, error: &toml::de::Error) -> Error {
        let at = error.span().unwrap_or(0..0);
        let place = Some(at.start);
        let start = self.before(at.start).rfind('\n').map_or(0, |n| n + 1);
        let line = self.files[0].text[start..]
            .lines()
            .next()
            .unwrap_or_default()
            .trim();
        if error.message() == "duplicate key" {
            let name = &self.before(at.end)[self.before(at.start).len()..];
            let key = self.key_at(at.start, name.trim_matches(['[', ']', ' ']));
            // The parser may retain only the second of two tables with one name.
            let mut before = self.entries.iter().filter(|e| e.at.start < at.start);
            let first = before.find(|entry| entry.key == key);
            let first = first.map_or(String::new(), |entry| match self.line(entry.at.start) {
                Place::Line(line) => format!("; the first is in line {line}"),
                _ => String::new(),
            });
            let found = format!("a second {name}");
            return self.error(place, Some(&key), found, &format!("each key once{first}"));
        }
        let name = line.split_once('=').map(|(name, _)| name.trim());
        let bare = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '.';
        let key = name
            .filter(|name| !name.is_empty() && name.chars().all(bare))
            .map(|name| self.key_at(at.start, name));
        let reason = error.message().replace('\n', "; ");
        let found = format!("{line:?}, which is not TOML ({reason})");
        let expected = "TOML: [table], key = 1.5, key = \"text\"";
        let mut mistake = self.mistake(place, key.as_deref(), found, expected);
        mistake.hint = backslash_hint(line).map(str::to_owned);
        mistake.into()
    }

    /// Returns the dotted key of a `name` at `offset`, from the enclosing inline table or the last
    /// header before it.
    fn key_at(&self, offset: usize, name: &str) -> String {
        let around = self.entries.iter().filter(|entry| {
            matches!(entry.kind, ValueKind::Table) && entry.value.contains(&offset)
        });
        let inline = around.max_by_key(|entry| entry.value.start);
        let before = self.before(offset).lines();
        let mut headers = before
            .map(str::trim_start)
            .filter(|line| line.starts_with('['));
        let header = headers.next_back().and_then(|line| {
            let line = line.trim_start_matches('[');
            line.split_once(']').map(|(table, _)| table.trim())
        });
        match (inline.map(|entry| entry.key.as_str()), header) {
            (Some(table), _) | (None, Some(table)) if table != name => format!("{table}.{name}"),
            _ => name.to_owned(),
        }
    }

    /// Converts an error of the TOML parser to the wording of all other errors, where its message
    /// is known.
    fn explain(&self, error: &toml::de::Error) -> Error {
        let message = error.message();
        let at = error.span().unwrap_or(0..0);
        let inside = |range: &Range<usize>| range.contains(&at.start);
        let entry = self
            .entries
            .iter()
            // The table of the complete file has an empty span.
            .filter(|entry| !at.is_empty() && (inside(&entry.at) || inside(&entry.value)))
            .max_by_key(|entry| entry.key.matches('.').count());
        let quoted = message.split('`').nth(1).unwrap_or_default();
        if message.starts_with("missing field") {
            return self.missing(&match entry {
                Some(table) => format!("{}.{quoted}", table.key),
                None => quoted.to_owned(),
            });
        }
        let (Some(entry), Some((found, expected))) = (entry, message.split_once(", expected "))
        else {
            let place = (!at.is_empty()).then_some(at.start);
            let key = entry.map(|entry| entry.key.as_str());
            return self.error(place, key, message, "a scene file");
        };
        let place = Some(at.start);
        let expected = expected.trim_start_matches("one of ");
        let choices: Vec<&str> = expected.split('`').skip(1).step_by(2).collect();
        if message.starts_with("unknown field") {
            return self.unknown_key(place, &entry.key, &choices);
        }
        if message.starts_with("unknown variant") {
            let expected: Vec<String> = choices.iter().map(|c| format!("{c:?}")).collect();
            let expected = join_choices(&expected);
            let hint = match renamed(quoted, &choices) {
                Some(new) => Some(format!("{quoted:?} has been renamed to {new:?}")),
                None => nearest(quoted, &choices).map(|near| format!("did you mean {near:?}?")),
            };
            return self.hinted(place, &entry.key, self.written(entry), &expected, hint);
        }
        let written = self.written(entry);
        let (found, expected) = match (found.strip_prefix("invalid length "), expected) {
            (Some(length), _) => (
                format!("{written}, a list of {length}"),
                expected.replace("an array of length", "a list of"),
            ),
            (_, "f64") => (written.into(), "a number".into()),
            (_, "u32") => (
                written.into(),
                format!("a whole number from 0 to {}", u32::MAX),
            ),
            (_, "u64") => (written.into(), "a whole number, not negative".into()),
            (_, "a boolean") => (written.into(), "true or false".into()),
            (_, "a map") => (written.into(), A_TABLE.into()),
            (_, "a string") => (written.into(), "text in quotation marks".into()),
            (_, "newtype variant") => {
                let key = written.trim_matches(['"', '\'']);
                (written.into(), format!("a table {{ {key} = … }}"))
            }
            (_, "a sequence") => (written.into(), "a list such as [1, 2]".into()),
            (_, table) if table.starts_with("struct ") => (written.into(), A_TABLE.into()),
            (_, other) => (written.into(), other.to_owned()),
        };
        self.error(place, Some(&entry.key), found, &expected)
    }

    fn unknown_key(&self, place: Option<usize>, key: &str, choices: &[&str]) -> Error {
        let (table, name) = key.rsplit_once('.').unwrap_or(("", key));
        let elsewhere: Vec<String> = keys::all()
            .filter(|known| known.rsplit_once('.').is_some_and(|(_, last)| last == name))
            .map(|known| {
                format!(
                    "[{}]",
                    known.rsplit_once('.').map_or("", |(table, _)| table)
                )
            })
            .collect();
        let hint = match (renamed(name, choices), nearest(name, choices)) {
            (Some(new), _) => Some(format!("{name} has been renamed to {new}")),
            (None, Some(near)) => Some(format!("did you mean {near}?")),
            (None, None) if elsewhere.is_empty() => None,
            (None, None) => Some(format!("{name} belongs in {}", join_choices(&elsewhere))),
        };
        let found = match table {
            "" if choices.contains(&"part") => "a key that a scene does not have".to_owned(),
            "" => "a key that a sensor does not have".to_owned(),
            _ => format!("a key that {} does not have", header(table)),
        };
        let choices: Vec<String> = choices.iter().map(|c| c.to_string()).collect();
        self.hinted(place, key, &found, &join_choices(&choices), hint)
    }

    fn hinted(
        &self,
        at: Option<usize>,
        key: &str,
        found: &str,
        expected: &str,
        hint: Option<String>,
    ) -> Error {
        let mut error = self.mistake(at, Some(key), found, expected);
        error.hint = hint;
        error.into()
    }

    fn error(
        &self,
        at: Option<usize>,
        key: Option<&str>,
        found: impl Into<String>,
        expected: &str,
    ) -> Error {
        self.mistake(at, key, found, expected).into()
    }

    /// Creates an error at byte offset `at`; without an offset, the error refers to the scene file.
    fn mistake(
        &self,
        at: Option<usize>,
        key: Option<&str>,
        found: impl Into<String>,
        expected: &str,
    ) -> InputError {
        let place = at.map_or(Place::File, |at| self.line(at));
        let file = &self.file(at.unwrap_or(0)).file;
        let mut error = InputError::new(file, place, found, expected);
        error.key = key.map(str::to_owned);
        error
    }
}

/// Alternative keys. If one file contains one key of a pair, the other key is not taken from a
/// different file.
const ALTERNATIVES: [[&str; 2]; 5] = [
    ["exposure_ms", "exposure"],
    ["focal_length_mm", "telecentric"],
    ["f_number", "telecentric"],
    ["focus_distance_mm", "focus"],
    ["tilt_deg", "focus"],
];

/// Inserts the values of `under` that `table` lacks, recursively for tables.
fn fill<'a>(table: &mut DeTable<'a>, under: DeTable<'a>) {
    let has: Vec<bool> = ALTERNATIVES
        .as_flattened()
        .iter()
        .map(|&name| table.contains_key(name))
        .collect();
    let other = |name: &str| {
        let places = ALTERNATIVES.as_flattened().iter().enumerate();
        // The alternatives form pairs, so `i ^ 1` is the index of the other key.
        places
            .filter(|&(_, known)| *known == name)
            .any(|(i, _)| has[i ^ 1])
    };
    for (name, value) in under {
        if other(name.get_ref()) {
            continue;
        }
        match table.get_mut(&**name.get_ref()) {
            None => {
                table.insert(name, value);
            }
            Some(own) => {
                if let (DeValue::Table(own), DeValue::Table(under)) =
                    (own.get_mut(), value.into_inner())
                {
                    fill(own, under);
                }
            }
        }
    }
}

/// Replaces a list `[[camera]]` by its table of index `camera`, or removes a shorter list. Returns the
/// number of tables, 0 if there is no list of tables.
fn select_camera(table: &mut DeTable, camera: usize) -> usize {
    let Some(DeValue::Array(list)) = table.get("camera").map(|value| value.get_ref()) else {
        return 0;
    };
    let is_table = |value: &Spanned<DeValue>| matches!(value.get_ref(), DeValue::Table(_));
    let count = list.iter().filter(|value| is_table(value)).count();
    if count == 0 || count < list.len() {
        return 0;
    }
    let selected = list.get(camera).cloned();
    match (selected, table.get_mut("camera")) {
        (Some(selected), Some(value)) => *value = selected,
        _ => drop(table.remove("camera")),
    }
    count
}

/// Replaces a list of files at `measure.calibration` by its element of index `camera`, if it has one.
/// Returns the number of elements, `None` if the value is no list.
fn select_calibration(table: &mut DeTable, camera: usize) -> Option<usize> {
    let DeValue::Table(measure) = table.get_mut("measure")?.get_mut() else {
        return None;
    };
    let value = measure.get_mut("calibration")?;
    let DeValue::Array(list) = value.get_ref() else {
        return None;
    };
    let count = list.len();
    if let Some(selected) = list.get(camera).cloned() {
        *value = selected;
    }
    Some(count)
}

const A_TABLE: &str = "a table of keys, [table] or { key = value }";

/// Formats the choices as `a`, `a or b`, or `a, b or c`.
fn join_choices(choices: &[String]) -> String {
    match choices.split_last() {
        None => String::new(),
        Some((last, [])) => last.clone(),
        Some((last, others)) => format!("{} or {last}", others.join(", ")),
    }
}

/// Returns the choice that `word` probably misspells. Candidates have a Jaro–Winkler similarity
/// above 0.8, the bound that cargo and clap use for command lines. The candidate with the smallest
/// edit distance wins; ties are resolved by similarity.
/// Returns the current name of a key or value of version 0.2.0, if it is among `choices`.
fn renamed<'a>(word: &str, choices: &[&'a str]) -> Option<&'a str> {
    let mut names = RENAMED.iter().filter(|(old, _)| *old == word);
    names.find_map(|(_, new)| choices.iter().copied().find(|choice| choice == new))
}

fn nearest<'a>(word: &str, choices: &[&'a str]) -> Option<&'a str> {
    let rated = choices.iter().map(|&c| (strsim::jaro_winkler(word, c), c));
    let similar = rated.filter(|(similarity, _)| *similarity > 0.8);
    let best = similar.min_by(|(a, first), (b, second)| {
        let edits = |choice: &str| strsim::osa_distance(word, choice);
        edits(first).cmp(&edits(second)).then(b.total_cmp(a))
    });
    best.map(|(_, choice)| choice)
}

/// Returns a hint if a line has a backslash in double quotes, as in Windows paths.
pub(crate) fn backslash_hint(line: &str) -> Option<&'static str> {
    let quoted = line
        .split_once('"')
        .is_some_and(|(_, text)| text.contains('\\'));
    quoted.then_some(
        "in double quotes a backslash begins an escape: write / between folders, or single quotes around the text",
    )
}

/// The kinds of TOML file that the program reads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum FileKind {
    Scene,
    Sensor,
    Sweep,
    Recipe,
}

impl FileKind {
    pub fn name(self) -> &'static str {
        match self {
            FileKind::Scene => "a scene",
            FileKind::Sensor => "a sensor's file",
            FileKind::Sweep => "a sweep",
            FileKind::Recipe => "a data set's recipe",
        }
    }
}

/// Returns the kind of a file from its top-level keys; `None` if they are ambiguous.
pub(crate) fn file_kind(has: impl Fn(&str) -> bool) -> Option<FileKind> {
    let any = |keys: &[&str]| keys.iter().any(|key| has(key));
    match () {
        () if any(&["part", "scan", "sensor"]) => Some(FileKind::Scene),
        () if has("scene") && has("samples") => Some(FileKind::Recipe),
        () if has("scene") => Some(FileKind::Sweep),
        () if any(&["seed", "speckle"]) => None,
        () if any(&["data_sheet", "laser", "camera"]) => Some(FileKind::Sensor),
        () => None,
    }
}

/// Returns the header of a table. Tables of a list have an index in their key.
fn header(table: &str) -> String {
    let indices = table.match_indices('.').map(|(dot, _)| dot);
    let index = indices.map(|dot| (&table[..dot], &table[dot + 1..]));
    let mut lists = index.filter_map(|(list, rest)| {
        let (index, inner) = rest.split_once('.').unwrap_or((rest, ""));
        index.parse::<usize>().ok().map(|_| (list, inner))
    });
    match lists.next() {
        None => format!("[{table}]"),
        Some((list, "")) => format!("[[{list}]]"),
        Some((list, inner)) => format!("{inner} of [[{list}]]"),
    }
}

fn collect(prefix: &str, table: &DeTable, entries: &mut Vec<Entry>) {
    for (name, value) in table.iter() {
        let key = match prefix {
            "" => name.get_ref().to_string(),
            _ => format!("{prefix}.{}", name.get_ref()),
        };
        let kind = match value.get_ref() {
            DeValue::Table(inner) => {
                collect(&key, inner, entries);
                ValueKind::Table
            }
            DeValue::Array(list) => {
                let mut kind = ValueKind::List;
                for (i, element) in list.iter().enumerate() {
                    if let DeValue::Table(inner) = element.get_ref() {
                        kind = ValueKind::Tables;
                        let key = format!("{key}.{i}");
                        collect(&key, inner, entries);
                        entries.push(Entry {
                            key,
                            at: element.span(),
                            value: element.span(),
                            kind: ValueKind::Table,
                        });
                    }
                }
                kind
            }
            _ => ValueKind::Value,
        };
        entries.push(Entry {
            key,
            at: name.span(),
            value: value.span(),
            kind,
        });
    }
}
