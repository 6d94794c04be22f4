//! 3MF file as an archive of XML files.

use crate::error::{Error, InputError, Place, printable};
use crate::mesh::text::{self, quote};
use crate::mesh::{MeshInput, memory};
use quick_xml::events::{BytesStart, Event};
use quick_xml::name::{NamespaceResolver, PrefixDeclaration, ResolveResult};
use quick_xml::{NsReader, XmlVersion};
use std::collections::HashMap;
use std::io::{BufReader, Cursor, Read};
use std::path::{Path, PathBuf};
use zip::ZipArchive;

pub(super) const CORE: &str = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02";

pub(super) const WHOLE: &str = "a whole 3MF file";

pub(super) fn wrong(source: &MeshInput, found: String, expected: &str) -> Error {
    source.error(Place::File, found, expected)
}

/// Bytes of memory per byte of XML: the shortest vertex takes 24 for `<vertex x="0" y="0" z="0"/>`.
const PER_XML_BYTE: u64 = 1;
/// Largest ratio of the total XML size to the archive size. Meshes, including regular grids,
/// compress to a tenth; the archive format allows a thousandth.
const LARGEST_RATIO: u64 = 30;
/// Bytes of XML that any archive may contain.
const ANYWAY: u64 = 1 << 24;
/// Smallest average size of an element, bytes, beyond the first million elements. A triangle has at
/// least 31.
const LEAST_PER_ELEMENT: u64 = 16;
const MANY: u64 = 1_000_000;
/// Largest nesting depth of elements; real files have ten levels.
const DEEPEST: usize = 64;

pub struct Package<'a> {
    source: &'a MeshInput<'a>,
    archive: ZipArchive<Cursor<&'a [u8]>>,
    /// Indices of the entries by their names as normalized by [`plain`].
    entries: HashMap<String, usize>,
    /// Bytes of XML that may still be read.
    left: u64,
}

impl<'a> Package<'a> {
    pub fn new(source: &'a MeshInput<'a>) -> Result<Package<'a>, Error> {
        let archive = ZipArchive::new(Cursor::new(source.bytes));
        let archive = archive.map_err(|error| wrong(source, error.to_string(), WHOLE))?;
        let names = archive.file_names_raw().enumerate();
        let entries = names.map(|(i, name)| (plain(&String::from_utf8_lossy(name)), i));
        Ok(Package {
            source,
            entries: entries.collect(),
            archive,
            left: (LARGEST_RATIO * source.bytes.len() as u64).max(ANYWAY),
        })
    }

    pub fn source(&self) -> &'a MeshInput<'a> {
        self.source
    }

    pub fn has(&self, name: &str) -> bool {
        self.entries.contains_key(&plain(name))
    }

    /// Calls `take` for each element of an XML file, in file order.
    #[expect(
        clippy::too_many_lines,
        reason = "one case of XML events after the other"
    )]
    pub fn elements(
        &mut self,
        name: &str,
        mut take: impl FnMut(&StartTag) -> Result<(), Error>,
    ) -> Result<(), Error> {
        // A name in the archive may begin with a slash.
        let path = self.source.path.join(name.trim_start_matches('/'));
        let missing = || wrong(self.source, format!("{name}: no such file in it"), WHOLE);
        let number = *self.entries.get(&plain(name)).ok_or_else(missing)?;
        let entry = self.archive.by_index(number);
        let entry = entry.map_err(|e| wrong(self.source, format!("{name}: {e}"), WHOLE))?;
        let size = entry.size();
        let work = format!("{}: reading {size} bytes", printable::path(&path));
        memory::require(work, size.saturating_mul(PER_XML_BYTE), memory::available())?;
        self.left = self.left.checked_sub(size).ok_or_else(|| {
            let found = format!("{name} of {size} bytes in an archive");
            let most = (LARGEST_RATIO * self.source.bytes.len() as u64).max(ANYWAY);
            let expected = format!(
                "at most {most} bytes of XML, {LARGEST_RATIO} times the archive's {}",
                self.source.bytes.len()
            );
            wrong(self.source, found, &expected)
        })?;
        let mut reader = NsReader::from_reader(BufReader::new(entry.take(size)));
        let (mut buffer, mut around) = (Vec::new(), Vec::<Name>::new());
        let mut count = 0u64;
        loop {
            buffer.clear();
            let at = reader.buffer_position();
            let wrong = |error: String, expected: &str| {
                Error::from(InputError::new(&path, Place::Byte(at), error, expected))
            };
            let (is_empty, start) = match reader.read_event_into(&mut buffer) {
                Err(error) => return Err(wrong(error.to_string(), "whole XML")),
                Ok(Event::Eof) if around.is_empty() => return Ok(()),
                Ok(Event::Eof) => {
                    return Err(wrong("the end of the file".to_owned(), "whole XML"));
                }
                Ok(Event::End(_)) => {
                    around.pop();
                    continue;
                }
                Ok(Event::Start(start)) => (false, start),
                Ok(Event::Empty(start)) => (true, start),
                Ok(_) => continue,
            };
            count += 1;
            if count > MANY && count * LEAST_PER_ELEMENT > at {
                let found = format!("{count} elements in {at} bytes");
                return Err(wrong(found, "at least 16 bytes an element"));
            }
            let names = reader.resolver();
            let (of, local) = names.resolve_element(start.name());
            let of = match &of {
                ResolveResult::Bound(uri) => uri.as_ref(),
                _ => "",
            };
            let element = StartTag {
                path: &path,
                at,
                namespace: of,
                name: local.into_inner(),
                around: &around,
                start: &start,
                names,
            };
            take(&element)?;
            if !is_empty {
                if around.len() == DEEPEST {
                    let found = format!("elements {DEEPEST} deep");
                    return Err(wrong(found, "fewer"));
                }
                let core = of == CORE;
                let own = element.name;
                around.push(if core { own.to_owned() } else { String::new() });
            }
        }
    }
}

/// Name of an element of the core specification, "" for any other element.
type Name = String;

/// Normalizes the name of an entry for comparison. Removes case, leading slashes and `./`, replaces
/// `\` by `/`, and decodes percent escapes.
pub fn plain(name: &str) -> String {
    let bytes = name.as_bytes();
    let mut decoded = Vec::with_capacity(bytes.len());
    let mut at = 0;
    while let Some(&byte) = bytes.get(at) {
        let digits = (byte == b'%').then(|| name.get(at + 1..at + 3)).flatten();
        match digits.and_then(|digits| u8::from_str_radix(digits, 16).ok()) {
            Some(byte) => {
                decoded.push(byte);
                at += 3;
            }
            None => {
                decoded.push(byte);
                at += 1;
            }
        }
    }
    let decoded = String::from_utf8_lossy(&decoded).replace('\\', "/");
    let mut name = decoded.as_str();
    while let Some(rest) = name.strip_prefix('/').or(name.strip_prefix("./")) {
        name = rest;
    }
    name.to_lowercase()
}

/// Start tag of an XML element.
pub struct StartTag<'a> {
    path: &'a PathBuf,
    /// Byte offset in the file.
    at: u64,
    /// Namespace URI, "" if absent.
    pub namespace: &'a str,
    pub name: &'a str,
    around: &'a [Name],
    start: &'a BytesStart<'a>,
    names: &'a NamespaceResolver,
}

impl StartTag<'_> {
    /// Returns the names of the two innermost enclosing elements, innermost first.
    pub fn parents(&self) -> [&str; 2] {
        let mut around = self.around.iter().rev().map(String::as_str);
        [0; 2].map(|_| around.next().unwrap_or_default())
    }

    pub fn wrong(&self, found: String, expected: &str) -> Error {
        InputError::new(Path::new(self.path), Place::Byte(self.at), found, expected).into()
    }

    /// Returns the value of an attribute, `None` if it is absent.
    pub fn text(&self, key: &str) -> Result<Option<String>, Error> {
        let unreadable = |error: String| self.wrong(error, "whole XML");
        let found = self.start.try_get_attribute(key);
        let Some(found) = found.map_err(|e| unreadable(e.to_string()))? else {
            return Ok(None);
        };
        let value = found.normalized_value(XmlVersion::Implicit1_0);
        let value = value.map_err(|e| unreadable(e.to_string()))?;
        Ok(Some(value.into_owned()))
    }

    pub fn needed(&self, key: &str) -> Result<String, Error> {
        let missing = || self.wrong(format!("<{}> without {key}", self.name), WHOLE);
        self.text(key)?.ok_or_else(missing)
    }

    pub fn number(&self, key: &str) -> Result<f64, Error> {
        let value = self.needed(key)?;
        text::number(value.trim().as_bytes()).map_err(|found| self.wrong(found, text::NUMBER))
    }

    /// Returns a vertex index, which must be below `count`.
    pub fn vertex(&self, key: &str, count: usize) -> Result<u32, Error> {
        let value = self.needed(key)?;
        let number = value.trim().parse::<u32>().ok();
        let wrong = || self.wrong(quote(value.as_bytes()), &format!("a vertex below {count}"));
        number.filter(|&n| (n as usize) < count).ok_or_else(wrong)
    }

    /// Calls `take` with namespace, name and prefixed name of each attribute of a different
    /// namespace.
    pub fn prefixed(&self, mut take: impl FnMut(&str, &str, &str)) {
        for attribute in self.start.attributes().with_checks(false).flatten() {
            let (of, name) = self.names.resolve_attribute(attribute.key);
            if let ResolveResult::Bound(uri) = of {
                take(uri.as_ref(), name.as_ref(), attribute.key.as_ref());
            }
        }
    }

    /// Returns the namespace of a prefix.
    pub fn uri(&self, prefix: &str) -> Option<&str> {
        let mut bound = self.names.bindings();
        let found = bound.find(|(name, _)| *name == PrefixDeclaration::Named(prefix));
        found.map(|(_, uri)| uri.into_inner())
    }
}
