//! Numeric data of a glTF file: buffers, views, and accessors over them.

use super::document::{Accessor, Buffer, Document, has};
use super::extensions::MESHOPT;
use crate::error::{Error, Place};
use crate::mesh::MeshInput;
use crate::mesh::text::quote;
use base64::Engine;
use base64::alphabet::STANDARD;
use base64::engine::{DecodePaddingMode, GeneralPurpose, GeneralPurposeConfig};
use std::borrow::Cow;
use std::cell::OnceCell;
use std::path::{Component as Part, Path, PathBuf};

pub const WHOLE: &str = "a whole glTF 2.0 file";

/// Numeric types of a component.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Component {
    I8,
    U8,
    I16,
    U16,
    U32,
    F32,
}
use Component::{F32, I8, I16, U8, U16, U32};

/// Types that may be indices.
pub const INDICES: &[Component] = &[U8, U16, U32];
/// Types that may be positions; integers require the extension `KHR_mesh_quantization`.
pub const POSITIONS: &[Component] = &[F32, I8, U8, I16, U16];
pub const FLOATS: &[Component] = &[F32];
pub const JOINTS: &[Component] = &[U8, U16];
pub const WEIGHTS: &[Component] = &[F32, U8, U16];
pub const ROTATIONS: &[Component] = &[F32, I8, I16];

impl Component {
    fn of(code: u32) -> Option<Component> {
        Some(match code {
            5120 => I8,
            5121 => U8,
            5122 => I16,
            5123 => U16,
            5125 => U32,
            5126 => F32,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            I8 | U8 => 1,
            I16 | U16 => 2,
            U32 | F32 => 4,
        }
    }

    /// Returns the value of `size()` bytes. A normalized integer is divided by the largest value.
    fn value(self, bytes: &[u8], normalized: bool) -> f64 {
        let mut low_first = [0; 4];
        low_first[..bytes.len()].copy_from_slice(bytes);
        let raw = u32::from_le_bytes(low_first);
        let (value, largest) = match self {
            I8 => (f64::from(raw as i8), 127.0),
            U8 => (f64::from(raw), 255.0),
            I16 => (f64::from(raw as i16), 32767.0),
            U16 => (f64::from(raw), 65535.0),
            U32 => (f64::from(raw), f64::from(u32::MAX)),
            F32 => return f64::from(f32::from_bits(raw)),
        };
        match normalized {
            true => (value / largest).max(-1.0),
            false => value,
        }
    }
}

pub struct File<'a> {
    pub source: &'a MeshInput<'a>,
    pub document: &'a Document,
    /// Binary chunk after the document.
    pub binary: Option<&'a [u8]>,
    /// Buffers, read at their first use.
    pub buffers: Vec<OnceCell<Cow<'a, [u8]>>>,
}

impl<'a> File<'a> {
    pub fn wrong(&self, found: impl Into<String>, expected: &str) -> Error {
        self.source.error(Place::File, found, expected)
    }

    /// Returns an element of a list of the file by its index.
    pub fn get<T>(&self, list: &'a [T], number: usize, what: &str) -> Result<&'a T, Error> {
        let found = || format!("{what} {number} of {}", list.len());
        let element = list.get(number);
        element.ok_or_else(|| self.wrong(found(), "a number below that"))
    }

    pub fn accessor(&self, number: usize) -> Result<&'a Accessor, Error> {
        self.get(&self.document.accessors, number, "accessor")
    }

    /// Returns the elements of an accessor, `N` numbers each, whose type must be one of `kinds`.
    pub fn vectors<const N: usize>(
        &self,
        number: usize,
        kinds: &[Component],
        what: &str,
    ) -> Result<Vec<[f64; N]>, Error> {
        let accessor = self.accessor(number)?;
        let wanted = match N {
            1 => "SCALAR",
            3 => "VEC3",
            4 => "VEC4",
            _ => "MAT4",
        };
        let component = Component::of(accessor.component_type);
        let component = component.filter(|c| kinds.contains(c) && accessor.r#type == wanted);
        let Some(component) = component else {
            let form = quote(accessor.r#type.as_bytes());
            let code = accessor.component_type;
            let found = format!("accessor {number} of {code} {form} for {what}");
            return Err(self.wrong(found, &format!("{wanted} of {kinds:?}")));
        };
        let size = component.size();
        let decode = |bytes: &[u8]| {
            std::array::from_fn(|i| {
                component.value(&bytes[i * size..][..size], accessor.normalized)
            })
        };
        let of = || format!("accessor {number}");
        let sparse = match &accessor.sparse {
            None => None,
            Some(sparse) => Some((
                self.sparse_indices(sparse, accessor.count, &of())?,
                self.slices(&sparse.values, sparse.count, N * size, false, &of())?
                    .map(decode)
                    .collect::<Vec<_>>(),
            )),
        };
        let mut values: Vec<[f64; N]> = match accessor.buffer_view {
            Some(view) => {
                let at = (view, accessor.byte_offset);
                self.slices(&at, accessor.count, N * size, true, &of())?
                    .map(decode)
                    .collect()
            }
            // All zeros. The other content of the file has at least a byte for each element, so
            // memory stays within a multiple of the file size.
            None if accessor.count <= self.bytes() => vec![[0.0; N]; accessor.count],
            None => {
                let found = format!("{} of {} elements without data", of(), accessor.count);
                return Err(self.wrong(found, "no more elements than the file has bytes"));
            }
        };
        if let Some((indices, of_indices)) = sparse {
            for (index, value) in indices.into_iter().zip(of_indices) {
                values[index] = value;
            }
        }
        Ok(values)
    }

    fn sparse_indices(
        &self,
        sparse: &super::document::Sparse,
        count: usize,
        of: &str,
    ) -> Result<Vec<usize>, Error> {
        let kind = sparse.indices.component_type.and_then(Component::of);
        let Some(kind) = kind.filter(|kind| INDICES.contains(kind)) else {
            let found = format!("{of} with sparse indices that are no whole numbers");
            return Err(self.wrong(found, WHOLE));
        };
        let indices = self.slices(&sparse.indices, sparse.count, kind.size(), false, of)?;
        let indices: Vec<usize> = indices.map(|b| kind.value(b, false) as usize).collect();
        match indices.iter().find(|&&index| index >= count) {
            None => Ok(indices),
            Some(index) => {
                let found = format!("{of} of {count} elements with a sparse index {index}");
                Err(self.wrong(found, "an index below their number"))
            }
        }
    }

    /// Returns the bytes of each of `count` elements of a view, with `size` bytes per element.
    fn slices(
        &self,
        at: &impl InView,
        count: usize,
        size: usize,
        strided: bool,
        of: &str,
    ) -> Result<impl Iterator<Item = &[u8]>, Error> {
        let (number, offset) = at.place();
        let view = self.get(&self.document.buffer_views, number, "buffer view")?;
        let extensions = view.extensions.as_deref();
        let compressed = MESHOPT.into_iter().find(|name| has(extensions, name));
        if let Some(name) = compressed {
            let buffer = self.get(&self.document.buffers, view.buffer, "buffer")?;
            let required = self.document.extensions_required.iter().any(|r| r == name);
            if required || buffer.uri.is_none() && (view.buffer > 0 || self.binary.is_none()) {
                let found = format!("{of} with data compressed by the extension {name}");
                return Err(self.wrong(found, "data without compression"));
            }
        }
        let buffer = self.buffer(view.buffer)?;
        let stride = view.byte_stride.filter(|_| strided).unwrap_or(size);
        let bytes = || {
            let end = view.byte_offset.checked_add(view.byte_length)?;
            let view = buffer.get(view.byte_offset..end)?;
            let Some(before_last) = count.checked_sub(1) else {
                return Some(&view[..0]);
            };
            let before_last = stride.checked_mul(before_last)?;
            let bytes = view.get(offset..)?;
            bytes.get(..before_last.checked_add(size)?)
        };
        match bytes().filter(|_| stride >= size) {
            Some(bytes) => Ok(bytes.chunks(stride).map(move |element| &element[..size])),
            None => Err(self.wrong(format!("{of} that does not fit its buffer"), WHOLE)),
        }
    }

    /// Returns the size in bytes of the file and the buffers read until now.
    fn bytes(&self) -> usize {
        let buffers = self.buffers.iter().filter_map(OnceCell::get);
        self.source.bytes.len() + buffers.map(|buffer| buffer.len()).sum::<usize>()
    }

    fn buffer(&self, number: usize) -> Result<&[u8], Error> {
        let buffer = self.get(&self.document.buffers, number, "buffer")?;
        let read = &self.buffers[number];
        match read.get() {
            Some(bytes) => Ok(bytes),
            None => {
                let bytes = self.data(number, buffer)?;
                Ok(read.get_or_init(|| bytes))
            }
        }
    }

    /// Returns the bytes of a buffer, from the file itself or from a sibling file.
    fn data(&self, number: usize, buffer: &Buffer) -> Result<Cow<'a, [u8]>, Error> {
        let bytes = match &buffer.uri {
            // The binary chunk belongs to the first buffer.
            None => match self.binary.filter(|_| number == 0) {
                Some(bytes) => Cow::Borrowed(bytes),
                None => return Err(self.wrong(format!("buffer {number} without data"), WHOLE)),
            },
            Some(uri) => match uri.strip_prefix("data:") {
                Some(uri) => {
                    let found = || format!("buffer {number} that is not base64");
                    Cow::Owned(decoded(uri).ok_or_else(|| self.wrong(found(), WHOLE))?)
                }
                None => {
                    let file = beside(uri).ok_or_else(|| {
                        let found = format!("buffer {number} in {}", quote(uri.as_bytes()));
                        self.wrong(found, "a file in the mesh's own folder or below it")
                    })?;
                    let folder = self.source.path.parent().unwrap_or(Path::new(""));
                    Cow::Owned(crate::mesh::read(&folder.join(file), &|_| Ok(()))?)
                }
            },
        };
        if bytes.len() < buffer.byte_length {
            let found = format!("buffer {number} of {} bytes", bytes.len());
            return Err(self.wrong(found, &format!("{} bytes", buffer.byte_length)));
        }
        Ok(bytes)
    }
}

/// Location in a buffer view.
trait InView {
    /// Returns the index of the view and the offset in it.
    fn place(&self) -> (usize, usize);
}

impl InView for (usize, usize) {
    fn place(&self) -> (usize, usize) {
        *self
    }
}

impl InView for super::document::SparsePart {
    fn place(&self) -> (usize, usize) {
        (self.buffer_view, self.byte_offset)
    }
}

/// Decodes a data URI without its `data:` prefix. Line breaks between digits and missing padding
/// are allowed.
fn decoded(uri: &str) -> Option<Vec<u8>> {
    let (head, digits) = uri.split_once(',')?;
    head.strip_suffix(";base64")?;
    let config = GeneralPurposeConfig::new()
        .with_decode_padding_mode(DecodePaddingMode::Indifferent)
        .with_decode_allow_trailing_bits(true);
    let engine = GeneralPurpose::new(&STANDARD, config);
    match digits.contains(|c: char| c.is_ascii_whitespace()) {
        true => {
            let digits: Vec<u8> = digits
                .bytes()
                .filter(|b| !b.is_ascii_whitespace())
                .collect();
            engine.decode(digits).ok()
        }
        false => engine.decode(digits).ok(),
    }
}

/// Returns the files of the buffers that a JSON glTF file references, relative to its folder.
pub fn buffer_files(text: &[u8]) -> Vec<PathBuf> {
    let document: serde_json::Value = serde_json::from_slice(text).unwrap_or_default();
    let buffers = document["buffers"].as_array();
    let uris = buffers.into_iter().flatten();
    let uris = uris.filter_map(|buffer| buffer["uri"].as_str());
    let files = uris.filter(|uri| !uri.starts_with("data:"));
    files.filter_map(beside).collect()
}

/// Returns the path of a relative URI that stays within the folder. Percent escapes are decoded,
/// `.` and `..` are resolved, and `\` separates folders as on Windows.
fn beside(uri: &str) -> Option<PathBuf> {
    let mut pieces = uri.split('%');
    let mut path = pieces.next()?.as_bytes().to_vec();
    for piece in pieces {
        path.push(u8::from_str_radix(piece.get(..2)?, 16).ok()?);
        path.extend(&piece.as_bytes()[2..]);
    }
    let path = String::from_utf8(path).ok()?.replace('\\', "/");
    if path.contains(':') {
        return None;
    }
    let mut resolved = PathBuf::new();
    for part in Path::new(&path).components() {
        match part {
            Part::Normal(name) => resolved.push(name),
            Part::CurDir => {}
            Part::ParentDir if resolved.pop() => {}
            _ => return None,
        }
    }
    (resolved != Path::new("")).then_some(resolved)
}
