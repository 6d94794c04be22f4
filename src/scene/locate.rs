//! Where in a scene file a key stands, so that an error can say so.

use crate::error::{Error, InputError, Place};
use std::ops::Range;
use std::path::{Path, PathBuf};
use toml::de::{DeTable, DeValue};

/// A scene file's text with its keys' places.
pub(super) struct Source {
    file: PathBuf,
    text: String,
    /// Dotted key, where the key stands, where its value stands.
    entries: Vec<(String, Range<usize>, Range<usize>)>,
}

impl Source {
    /// Errors: a file that cannot be read, is no regular file, or is not TOML.
    pub fn read(path: &Path) -> Result<Source, Error> {
        let kind = std::fs::metadata(path).map_err(Error::io("read", path))?;
        if !kind.is_file() {
            // A pipe may never end.
            let found = "something that is not a regular file";
            return Err(InputError::new(path, Place::File, found, "a scene file (TOML)").into());
        }
        let bytes = std::fs::read(path).map_err(Error::io("read", path))?;
        let text = String::from_utf8(bytes).map_err(|error| {
            let place = Place::Byte(error.utf8_error().valid_up_to() as u64);
            InputError::new(path, place, "bytes that are not UTF-8", "TOML text")
        })?;
        Source::parse(path, text)
    }

    fn parse(file: &Path, text: String) -> Result<Source, Error> {
        let mut source = Source {
            file: file.to_owned(),
            text,
            entries: Vec::new(),
        };
        let mut entries = Vec::new();
        match DeTable::parse(&source.text) {
            Ok(table) => collect("", table.get_ref(), &mut entries),
            Err(error) => return Err(source.not_toml(&error)),
        }
        source.entries = entries;
        Ok(source)
    }

    pub fn text(&self) -> &str {
        &self.text
    }

    fn line(&self, offset: usize) -> Place {
        let before = &self.text.as_bytes()[..offset.min(self.text.len())];
        Place::Line(1 + before.iter().filter(|&&b| b == b'\n').count())
    }

    /// The value of `key` as written; the line of its nearest ancestor if it is
    /// not in the file.
    pub fn wrong(&self, key: &str, expected: &str) -> Error {
        let mut path = key;
        let found = |path: &str| self.entries.iter().find(|(k, _, _)| k == path);
        let place = loop {
            match (found(path), path.rfind('.')) {
                (Some((_, at, _)), _) => break self.line(at.start),
                (None, Some(dot)) => path = &path[..dot],
                (None, None) => break Place::File,
            }
        };
        let value = found(key).map_or("no such key", |(_, _, value)| {
            let text = &self.text[value.clone()];
            text.lines().next().unwrap_or_default()
        });
        self.error(place, Some(key), value, expected)
    }

    fn not_toml(&self, error: &toml::de::Error) -> Error {
        let place = self.line(error.span().map_or(0, |span| span.start));
        let reason = error.message().replace('\n', "; ");
        let found = format!("text that is not TOML ({reason})");
        self.error(place, None, found, "TOML")
    }

    /// An error of the TOML reader, in our words where it has a pattern.
    pub fn explain(&self, error: &toml::de::Error) -> Error {
        let message = error.message();
        let at = error.span().unwrap_or(0..0);
        let inside = |range: &Range<usize>| range.contains(&at.start);
        let key = self
            .entries
            .iter()
            // The whole file's table has an empty span.
            .filter(|(_, k, v)| !at.is_empty() && (inside(k) || inside(v)))
            .max_by_key(|(key, _, _)| key.matches('.').count())
            .map(|(key, _, _)| key.clone());
        let quoted = message.split('`').nth(1).unwrap_or_default();
        let join = |key: Option<String>| match key {
            Some(table) => format!("{table}.{quoted}"),
            None => quoted.to_owned(),
        };
        let place = match at.is_empty() {
            true => Place::File,
            false => self.line(at.start),
        };
        if message.starts_with("missing field") {
            let key = join(key);
            return self.error(place, Some(&key), "no such key", "it to be given");
        }
        if message.starts_with("unknown field") {
            let expected = message.split_once(", expected ").map_or("", |(_, e)| e);
            return self.error(
                place,
                key.as_deref(),
                format!("unknown key `{quoted}`"),
                expected,
            );
        }
        let (found, expected) = message
            .split_once(", expected ")
            .unwrap_or((message, "TOML"));
        let found = found
            .trim_start_matches("invalid type: ")
            .trim_start_matches("invalid value: ")
            .replace("invalid length", "length");
        let expected = match expected {
            "f64" => "a number",
            "u32" | "u64" => "a whole number, not negative",
            "a sequence" => "an array",
            structure if structure.starts_with("struct ") => "a table",
            other => other,
        };
        self.error(place, key.as_deref(), found, expected)
    }

    fn error(
        &self,
        place: Place,
        key: Option<&str>,
        found: impl Into<String>,
        expected: &str,
    ) -> Error {
        let mut error = InputError::new(&self.file, place, found, expected);
        error.key = key.map(str::to_owned);
        error.into()
    }
}

fn collect(prefix: &str, table: &DeTable, entries: &mut Vec<(String, Range<usize>, Range<usize>)>) {
    for (key, value) in table.iter() {
        let path = match prefix {
            "" => key.get_ref().to_string(),
            _ => format!("{prefix}.{}", key.get_ref()),
        };
        if let DeValue::Table(inner) = value.get_ref() {
            collect(&path, inner, entries);
        }
        entries.push((path, key.span(), value.span()));
    }
}
