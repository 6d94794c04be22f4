//! glTF 2.0, as JSON or binary (GLB): the triangles of the file's default scene, or of its first.
//!
//! Axes stay as they are in the file, whose y axis points up. Triangles have the names of their materials. Lines,
//! points, skins, animations and what else materials say are passed over; triangles of a node that mirrors are turned, as the format says. What
//! needs an extension is refused, and so are sparse and quantized positions.

use super::groups::{Groups, NONE, Namer};
use super::text::quote;
use super::{Mesh, Source, memory};
use crate::error::{Error, Place, printable};
use crate::math::DVec3;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use glam::{DAffine3, DMat4, DQuat};
use serde::Deserialize;
use std::path::{Component, Path};

/// Millimetres that the format's unit is.
pub const METRE: f64 = 1000.0;

/// Bytes a triangle takes at most while it is placed and welded: three corners of its own.
const PLACED: u64 = 3 * 2 * 24 + 2 * 12;

const WHOLE: &str = "a whole glTF 2.0 file";
const PLAIN: &str = "positions as plain 32-bit numbers, and indices below their count";

/// Codes of the format for kinds of numbers and primitives.
const U8: u32 = 5121;
const U16: u32 = 5123;
const U32: u32 = 5125;
const F32: u32 = 5126;
const TRIANGLES: u32 = 4;
const STRIP: u32 = 5;
const FAN: u32 = 6;

/// What is read of a file; the crate `gltf` (1.4) panics where a number in it is of nothing.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Document {
    asset: Asset,
    #[serde(default)]
    extensions_required: Vec<String>,
    scene: Option<usize>,
    #[serde(default)]
    scenes: Vec<Scene>,
    #[serde(default)]
    nodes: Vec<Node>,
    #[serde(default)]
    meshes: Vec<OfMesh>,
    #[serde(default)]
    materials: Vec<Material>,
    #[serde(default)]
    accessors: Vec<Accessor>,
    #[serde(default)]
    buffer_views: Vec<View>,
    #[serde(default)]
    buffers: Vec<Buffer>,
}

#[derive(Deserialize)]
struct Asset {
    version: String,
}

#[derive(Deserialize)]
struct Scene {
    #[serde(default)]
    nodes: Vec<usize>,
}

#[derive(Deserialize)]
struct Node {
    mesh: Option<usize>,
    #[serde(default)]
    children: Vec<usize>,
    /// Column by column.
    matrix: Option<[f64; 16]>,
    translation: Option<[f64; 3]>,
    rotation: Option<[f64; 4]>,
    scale: Option<[f64; 3]>,
}

impl Node {
    /// parent_from_node. The file's quaternions are of length 1 to 10⁻⁷ only.
    fn pose(&self) -> DAffine3 {
        let scale = self.scale.map_or(DVec3::ONE, DVec3::from_array);
        let turn = self.rotation.map_or(DQuat::IDENTITY, DQuat::from_array);
        let by = self.translation.map_or(DVec3::ZERO, DVec3::from_array);
        match &self.matrix {
            Some(matrix) => DAffine3::from_mat4(DMat4::from_cols_array(matrix)),
            None => DAffine3::from_scale_rotation_translation(scale, turn.normalize(), by),
        }
    }
}

#[derive(Deserialize)]
struct OfMesh {
    primitives: Vec<Primitive>,
}

#[derive(Deserialize)]
struct Material {
    name: Option<String>,
}

#[derive(Deserialize)]
struct Primitive {
    material: Option<usize>,
    attributes: Attributes,
    indices: Option<usize>,
    mode: Option<u32>,
}

#[derive(Deserialize)]
struct Attributes {
    #[serde(rename = "POSITION")]
    position: Option<usize>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Accessor {
    buffer_view: Option<usize>,
    #[serde(default)]
    byte_offset: usize,
    component_type: u32,
    count: usize,
    r#type: String,
    sparse: Option<serde::de::IgnoredAny>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct View {
    buffer: usize,
    #[serde(default)]
    byte_offset: usize,
    byte_length: usize,
    byte_stride: Option<usize>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Buffer {
    byte_length: usize,
    uri: Option<String>,
}

pub fn read(source: &Source) -> Result<(Mesh, Groups), Error> {
    let (text, binary) = chunks(source)?;
    let document: Document = serde_json::from_slice(text)
        .map_err(|error| source.error(Place::File, error.to_string(), WHOLE))?;
    if !document.asset.version.starts_with("2.") {
        let found = format!("glTF {}", quote(document.asset.version.as_bytes()));
        return Err(source.error(Place::File, found, "glTF 2.0"));
    }
    if let Some(extension) = document.extensions_required.first() {
        let found = format!(
            "a file that needs the extension {}",
            quote(extension.as_bytes())
        );
        return Err(source.error(Place::File, found, "one of triangles alone"));
    }
    let buffers = document.buffers.iter().enumerate();
    let buffers = buffers.map(|(i, buffer)| data(source, i, buffer, binary));
    let file = File {
        source,
        buffers: buffers.collect::<Result<_, _>>()?,
        document: &document,
    };
    let placed = file.placed()?;
    let (mut positions, mut triangles) = (Vec::new(), Vec::new());
    let mut namer = Namer::default();
    for (primitive, part_from_node) in placed {
        let material = primitive.material.and_then(|i| document.materials.get(i));
        let name = material.and_then(|material| material.name.as_ref());
        let list = namer.list(name.into_iter().cloned().collect());
        namer.begin(triangles.len(), [list, NONE, NONE]);
        file.place(primitive, part_from_node, &mut positions, &mut triangles)?;
    }
    let mesh = source.mesh(&positions, &triangles)?;
    Ok((mesh, namer.finish(triangles.len())))
}

/// The JSON of a file, and the binary chunk behind it.
fn chunks<'a>(source: &Source<'a>) -> Result<(&'a [u8], Option<&'a [u8]>), Error> {
    let bytes = source.bytes;
    if !bytes.starts_with(b"glTF") {
        return Ok((bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes), None));
    }
    let number = |at: usize| {
        let bytes = bytes.get(at..at.checked_add(4)?)?.try_into().ok()?;
        Some(u32::from_le_bytes(bytes))
    };
    let chunk = |at: usize, kind: &[u8; 4]| {
        let length = number(at)? as usize;
        let body = at.checked_add(8)?;
        let is_it = bytes.get(at + 4..body)? == kind;
        bytes.get(body..body.checked_add(length)?).filter(|_| is_it)
    };
    let wrong = |place: usize, found: &str, expected: &str| {
        Err(source.error(Place::Byte(place as u64), found, expected))
    };
    if number(4) != Some(2) {
        return wrong(4, "another version of binary glTF", "version 2");
    }
    if number(8) != Some(bytes.len() as u32) {
        let found = format!("{} bytes", bytes.len());
        return wrong(
            8,
            &found,
            "the length that the file's head says (is it cut off?)",
        );
    }
    match chunk(12, b"JSON") {
        None => wrong(12, "no whole chunk of JSON", WHOLE),
        Some(text) => Ok((text, chunk(20 + text.len(), b"BIN\0"))),
    }
}

struct File<'a> {
    source: &'a Source<'a>,
    document: &'a Document,
    buffers: Vec<Vec<u8>>,
}

impl<'a> File<'a> {
    fn wrong(&self, found: String, expected: &str) -> Error {
        self.source.error(Place::File, found, expected)
    }

    /// An element of a list of the file by its number.
    fn get<T>(&self, list: &'a [T], number: usize, what: &str) -> Result<&'a T, Error> {
        let found = || format!("{what} {number} of {}", list.len());
        let element = list.get(number);
        element.ok_or_else(|| self.wrong(found(), "a number below that"))
    }

    fn accessor(&self, number: usize) -> Result<&'a Accessor, Error> {
        self.get(&self.document.accessors, number, "accessor")
    }

    /// What has triangles, and how it is placed; in the file's order.
    fn placed(&self) -> Result<Vec<(&'a Primitive, DAffine3)>, Error> {
        let file = self.document;
        if file.scenes.is_empty() {
            return Err(self.wrong("a file without a scene".to_owned(), WHOLE));
        }
        let scene = self.get(&file.scenes, file.scene.unwrap_or(0), "scene")?;
        let mut seen = vec![false; file.nodes.len()];
        let mut placed = Vec::new();
        let mut corners = 0u64;
        let roots = scene.nodes.iter().rev();
        let mut next: Vec<_> = roots.map(|&node| (node, DAffine3::IDENTITY)).collect();
        while let Some((number, part_from_parent)) = next.pop() {
            let node = self.get(&file.nodes, number, "node")?;
            if std::mem::replace(&mut seen[number], true) {
                let found = format!("node {number} in two places");
                return Err(self.wrong(found, "nodes that are a tree"));
            }
            let part_from_node = part_from_parent * node.pose();
            if let Some(mesh) = node.mesh {
                let mesh = self.get(&file.meshes, mesh, "mesh")?;
                let with_area = mesh.primitives.iter().filter(|p| p.has_triangles());
                for primitive in with_area {
                    // A strip has as many triangles as corners.
                    let of = primitive.indices.or(primitive.attributes.position);
                    if let Some(of) = of {
                        corners = corners.saturating_add(self.accessor(of)?.count as u64);
                        placed.push((primitive, part_from_node));
                    }
                }
            }
            next.extend(
                node.children
                    .iter()
                    .rev()
                    .map(|&child| (child, part_from_node)),
            );
        }
        let path = printable::path(self.source.path);
        let work = format!("{path}: placing {corners} corners at {PLACED} bytes each");
        memory::require(work, corners.saturating_mul(PLACED), memory::available())?;
        Ok(placed)
    }

    /// Adds what a primitive has.
    fn place(
        &self,
        primitive: &Primitive,
        part_from_node: DAffine3,
        positions: &mut Vec<DVec3>,
        triangles: &mut Vec<[u32; 3]>,
    ) -> Result<(), Error> {
        let Some(number) = primitive.attributes.position else {
            return Ok(());
        };
        let vertices = self.accessor(number)?;
        if (vertices.component_type, &*vertices.r#type) != (F32, "VEC3") {
            let form = vertices.form();
            let found = format!("accessor {number} of {form} for positions");
            return Err(self.wrong(found, PLAIN));
        }
        let first = positions.len();
        for vertex in self.elements(number, 12)? {
            let (xyz, _) = vertex.as_chunks::<4>();
            let local = DVec3::from_array([0, 1, 2].map(|i| f32::from_le_bytes(xyz[i]).into()));
            let position = part_from_node.transform_point3(local);
            if !self.source.usable(position) {
                let what = format!("vertex {} of the file", positions.len());
                return Err(self.source.unusable(Place::File, &what, position));
            }
            positions.push(position);
        }
        let corners = match primitive.indices {
            Some(indices) => self.indices(indices, vertices.count)?,
            None => (0..vertices.count as u32).collect(),
        };
        let [a, b] = match part_from_node.matrix3.determinant() < 0.0 {
            false => [1, 2],
            true => [2, 1],
        };
        if u32::try_from(positions.len()).is_err() {
            let found = format!("{} vertices", positions.len());
            return Err(self.wrong(found, "fewer than 4294967296"));
        }
        let mut add =
            |of: [u32; 3]| triangles.push([of[0], of[a], of[b]].map(|v| first as u32 + v));
        match primitive.mode {
            Some(STRIP) => {
                for (i, of) in corners.windows(3).enumerate() {
                    add([of[i % 2], of[1 - i % 2], of[2]]);
                }
            }
            Some(FAN) => {
                for of in corners.windows(2).skip(1) {
                    add([corners[0], of[0], of[1]]);
                }
            }
            _ => {
                let (whole, rest) = corners.as_chunks::<3>();
                if !rest.is_empty() {
                    let found = format!("{} corners of triangles", corners.len());
                    return Err(self.wrong(found, "three of each"));
                }
                whole.iter().for_each(|&of| add(of));
            }
        }
        Ok(())
    }

    /// Numbers of vertices, all below `count`.
    fn indices(&self, number: usize, count: usize) -> Result<Vec<u32>, Error> {
        let accessor = self.accessor(number)?;
        let size = match (accessor.component_type, &*accessor.r#type) {
            (U8, "SCALAR") => 1,
            (U16, "SCALAR") => 2,
            (U32, "SCALAR") => 4,
            _ => {
                let form = accessor.form();
                let found = format!("accessor {number} of {form} for indices");
                return Err(self.wrong(found, PLAIN));
            }
        };
        let value = |bytes: &[u8]| {
            let mut low_first = [0; 4];
            low_first[..size].copy_from_slice(bytes);
            u32::from_le_bytes(low_first)
        };
        let values: Vec<u32> = self.elements(number, size)?.map(value).collect();
        match values.iter().find(|&&value| value as usize >= count) {
            None => Ok(values),
            Some(value) => {
                let found = format!("vertex {value} of a mesh of {count}");
                Err(self.wrong(found, PLAIN))
            }
        }
    }

    /// The bytes of each element of an accessor, of so many each.
    fn elements(&self, number: usize, size: usize) -> Result<impl Iterator<Item = &[u8]>, Error> {
        let accessor = self.accessor(number)?;
        let found = |what: &str| format!("accessor {number} {what}");
        let Some(view) = accessor.buffer_view.filter(|_| accessor.sparse.is_none()) else {
            return Err(self.wrong(found("that is sparse or without data"), PLAIN));
        };
        let view = self.get(&self.document.buffer_views, view, "buffer view")?;
        self.get(&self.document.buffers, view.buffer, "buffer")?;
        let stride = view.byte_stride.unwrap_or(size);
        let bytes = || {
            let end = view.byte_offset.checked_add(view.byte_length)?;
            let view = self.buffers[view.buffer].get(view.byte_offset..end)?;
            let before_last = stride.checked_mul(accessor.count.checked_sub(1)?)?;
            let bytes = view.get(accessor.byte_offset..)?;
            bytes.get(..before_last.checked_add(size)?)
        };
        match bytes().filter(|_| stride >= size) {
            Some(bytes) => Ok(bytes.chunks(stride).map(move |element| &element[..size])),
            None => Err(self.wrong(found("that does not fit its buffer"), WHOLE)),
        }
    }
}

impl Primitive {
    /// Not points or lines.
    fn has_triangles(&self) -> bool {
        matches!(self.mode, None | Some(TRIANGLES | STRIP | FAN))
    }
}

impl Accessor {
    /// Its kind of numbers, as the file has it.
    fn form(&self) -> String {
        format!("{} {}", self.component_type, quote(self.r#type.as_bytes()))
    }
}

/// The bytes of a buffer: in the file, or in one beside it.
fn data(
    source: &Source,
    number: usize,
    buffer: &Buffer,
    binary: Option<&[u8]>,
) -> Result<Vec<u8>, Error> {
    let wrong = |found: String, expected: &str| source.error(Place::File, found, expected);
    let bytes = match &buffer.uri {
        None => binary.map(<[u8]>::to_vec).ok_or_else(|| {
            let found = format!("buffer {number} without its binary chunk");
            wrong(found, WHOLE)
        })?,
        Some(uri) => match uri.strip_prefix("data:") {
            Some(uri) => {
                let encoded = uri.split_once(";base64,").map(|(_, data)| data);
                let bytes = encoded.and_then(|data| STANDARD.decode(data).ok());
                let found = || format!("buffer {number} that is not base64");
                bytes.ok_or_else(|| wrong(found(), WHOLE))?
            }
            None => {
                let file = beside(uri).ok_or_else(|| {
                    let found = format!("buffer {number} in {}", quote(uri.as_bytes()));
                    wrong(found, "a file in the mesh's own folder or below it")
                })?;
                let folder = source.path.parent().unwrap_or(Path::new(""));
                super::read(&folder.join(file), &|_| Ok(()))?
            }
        },
    };
    if bytes.len() < buffer.byte_length {
        let found = format!("buffer {number} of {} bytes", bytes.len());
        return Err(wrong(found, &format!("{} bytes", buffer.byte_length)));
    }
    Ok(bytes)
}

/// The files of buffers that a glTF file in JSON names, relative to its folder.
pub fn buffer_files(text: &[u8]) -> Vec<String> {
    let document: serde_json::Value = serde_json::from_slice(text).unwrap_or_default();
    let buffers = document["buffers"].as_array();
    let uris = buffers.into_iter().flatten();
    let uris = uris.filter_map(|buffer| buffer["uri"].as_str());
    let files = uris.filter(|uri| !uri.starts_with("data:"));
    files.filter_map(beside).collect()
}

/// A relative path without `..`, whose %20 is a blank.
fn beside(uri: &str) -> Option<String> {
    let mut pieces = uri.split('%');
    let mut path = pieces.next()?.as_bytes().to_vec();
    for piece in pieces {
        path.push(u8::from_str_radix(piece.get(..2)?, 16).ok()?);
        path.extend(&piece.as_bytes()[2..]);
    }
    let path = String::from_utf8(path).ok()?;
    let parts = Path::new(&path).components();
    let stays = parts
        .into_iter()
        .all(|part| matches!(part, Component::Normal(_)));
    (stays && !path.contains(':')).then_some(path)
}

#[cfg(test)]
#[path = "gltf_tests.rs"]
mod tests;
