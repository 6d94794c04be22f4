//! glTF 2.0, as JSON or binary (GLB): triangles of the default scene of the file, or of its first
//! scene.
//!
//! Axes are kept as in the file, with y pointing up. Triangles have the names of their materials.
//! Skins are read in the stored pose, morph targets with the stored weights, and instances of
//! `EXT_mesh_gpu_instancing` at their poses. Triangles of mirroring nodes are reversed, as the
//! format requires.
//!
//! A required extension that may change the shape is refused, as is compressed data. All other
//! unused content is listed by name: animations, lines, points, other scenes, other extensions.
//! Appearance, normals and texture coordinates are not part of the shape and are not listed.

use super::groups::{Groups, NONE, Namer};
use super::ignored::Collector;
use super::text::quote;
use super::{Mesh, MeshInput, memory};
use crate::error::{Error, Place, printable};
use crate::math::DVec3;
pub use accessors::buffer_files;
use accessors::{File, INDICES, POSITIONS, WHOLE};
use document::{Document, Node, OfMesh, Primitive, has, names};
use extensions::{DRACO, list, needed};
use glam::DAffine3;
use std::borrow::Cow;
use std::cell::OnceCell;

mod accessors;
mod document;
mod extensions;
mod pose;

/// Unit of the format, mm.
pub const METRE: f64 = 1000.0;

/// Upper bound of bytes per corner during transformation and welding.
const PLACED: u64 = 3 * 2 * 24 + 2 * 12;
/// Memory estimate in bytes per JSON object (such as a node or a primitive) and per list value.
const PER_OBJECT: u64 = 512;
const PER_VALUE: u64 = 48;

/// Primitive modes of the format.
const TRIANGLES: u32 = 4;
const STRIP: u32 = 5;
const FAN: u32 = 6;

pub fn read(source: &MeshInput, ignored: &mut Collector) -> Result<(Mesh, Groups), Error> {
    let (text, binary) = chunks(source, ignored)?;
    let document = parse(source, text, ignored)?;
    if !document.asset.version.starts_with("2.") {
        let found = format!("glTF {}", quote(document.asset.version.as_bytes()));
        return Err(source.error(Place::File, found, "glTF 2.0"));
    }
    if let Some(extension) = needed(&document) {
        let name = printable::short(extension);
        let found = format!("a file that requires the extension \"{name}\"");
        let expected =
            "extensions that leave the shape of triangles as it is, or the file exported without";
        return Err(source.error(Place::File, found, expected));
    }
    list(&document, ignored);
    for (list, name) in [
        (&document.animations, "animations"),
        (&document.cameras, "cameras"),
    ] {
        list.iter().for_each(|_| ignored.harmless(name));
    }
    let file = File {
        source,
        document: &document,
        binary,
        buffers: document.buffers.iter().map(|_| OnceCell::new()).collect(),
    };
    let placed = file.placed(ignored)?;
    let globals = match placed.iter().any(|of| of.skin.is_some()) {
        true => file.globals()?,
        false => Vec::new(),
    };
    let (mut positions, mut triangles) = (Vec::new(), Vec::new());
    let mut namer = Namer::default();
    for of in placed {
        let material = of
            .primitive
            .material
            .and_then(|i| document.materials.get(i));
        let name = material.and_then(|material| material.name.as_ref());
        let list = namer.list(name.into_iter().cloned().collect());
        namer.begin(triangles.len(), [list, NONE, NONE]);
        file.place(&of, &globals, &mut positions, &mut triangles)?;
    }
    if triangles.is_empty() {
        let instead = format!("{} vertices", positions.len());
        return Err(source.no_triangles_but(&instead, ignored));
    }
    let mesh = source.mesh(&positions, &triangles)?;
    Ok((mesh, namer.finish(triangles.len())))
}

/// Parses the document after checking that it fits in memory.
fn parse(source: &MeshInput, text: &[u8], ignored: &mut Collector) -> Result<Document, Error> {
    let count = |byte: u8| text.iter().filter(|&&b| b == byte).count() as u64;
    let need = 2 * text.len() as u64 + PER_OBJECT * count(b'{') + PER_VALUE * count(b',');
    let path = printable::path(source.path);
    let work = format!("{path}: reading a document of {} bytes", text.len());
    memory::require(work, need, memory::available())?;
    let wrong = |error: serde_json::Error| source.error(Place::File, error.to_string(), WHOLE);
    let error = match serde_json::from_slice(text) {
        Ok(document) => return Ok(document),
        Err(error) => error,
    };
    // JSON has no NaN, but some programs write it in content that does not affect the shape.
    let Cow::Owned(text) = without_nan(text) else {
        return Err(wrong(error));
    };
    let document = serde_json::from_slice(&text).map_err(|_| wrong(error))?;
    ignored.harmless("NaN or Infinity in the JSON");
    Ok(document)
}

/// Returns the text with each `NaN` and `Infinity` outside of strings replaced by a string, so that
/// none is parsed as a number.
fn without_nan(text: &[u8]) -> Cow<'_, [u8]> {
    let mut text = Cow::Borrowed(text);
    let mut at = 0;
    let mut quoted = false;
    while let Some(&byte) = text.get(at) {
        let word = [&b"NaN"[..], b"-Infinity", b"Infinity"]
            .into_iter()
            .find(|word| !quoted && text[at..].starts_with(word));
        match (byte, word) {
            (_, Some(word)) => {
                let bytes = &mut text.to_mut()[at..at + word.len()];
                bytes.fill(b'?');
                bytes[0] = b'"';
                bytes[word.len() - 1] = b'"';
                at += word.len();
            }
            (b'\\', _) if quoted => at += 2,
            (b'"', _) => {
                quoted = !quoted;
                at += 1;
            }
            _ => at += 1,
        }
    }
    text
}

/// Returns the JSON text of a file and the binary chunk after it.
fn chunks<'a>(
    source: &MeshInput<'a>,
    ignored: &mut Collector,
) -> Result<(&'a [u8], Option<&'a [u8]>), Error> {
    let bytes = source.bytes;
    if !bytes.starts_with(b"glTF") {
        return Ok((bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes), None));
    }
    let number = |at: usize| {
        let bytes = bytes.get(at..at.checked_add(4)?)?.try_into().ok()?;
        Some(u32::from_le_bytes(bytes))
    };
    let wrong = |place: usize, found: &str, expected: &str| {
        Err(source.error(Place::Byte(place as u64), found, expected))
    };
    if number(4) != Some(2) {
        return wrong(4, "another version of binary glTF", "version 2");
    }
    let length = number(8).unwrap_or(u32::MAX) as usize;
    let Some(bytes) = bytes.get(..length) else {
        let found = format!(
            "{} bytes of the {length} that the file's head states",
            bytes.len()
        );
        return wrong(8, &found, "all of them (is it cut off?)");
    };
    if bytes.len() < source.bytes.len() {
        let surplus = super::text::count(source.bytes.len() - bytes.len(), "byte");
        ignored.harmless(format!("{surplus} after the end of the binary glTF"));
    }
    let chunk = |at: usize, kind: &[u8; 4]| {
        let length = number(at)? as usize;
        let body = at.checked_add(8)?;
        let is_it = bytes.get(at + 4..body)? == kind;
        bytes.get(body..body.checked_add(length)?).filter(|_| is_it)
    };
    match chunk(12, b"JSON") {
        None => wrong(12, "no whole chunk of JSON", WHOLE),
        Some(text) => Ok((text, chunk(20 + text.len(), b"BIN\0"))),
    }
}

/// Primitive with triangles under a node of the scene.
struct PlacedPrimitive<'a> {
    node: &'a Node,
    mesh: &'a OfMesh,
    primitive: &'a Primitive,
    /// Accessor of the positions.
    positions: usize,
    /// Index of the skin that deforms the primitive.
    skin: Option<usize>,
    scene_from_node: DAffine3,
}

impl<'a> File<'a> {
    /// Returns the nodes with triangles and their poses, in file order.
    fn placed(&self, ignored: &mut Collector) -> Result<Vec<PlacedPrimitive<'a>>, Error> {
        let file = self.document;
        if file.scenes.is_empty() {
            return Err(self.wrong("a file without a scene", WHOLE));
        }
        let number = file.scene.unwrap_or(0);
        let scene = self.get(&file.scenes, number, "scene")?;
        (1..file.scenes.len()).for_each(|_| ignored.harmless("another scene"));
        let mut seen = vec![false; file.nodes.len()];
        let mut placed = Vec::new();
        let mut corners = 0u64;
        let available = memory::available();
        let roots = scene.nodes.iter().rev();
        let mut next: Vec<_> = roots.map(|&node| (node, DAffine3::IDENTITY)).collect();
        while let Some((number, scene_from_parent)) = next.pop() {
            let node = self.get(&file.nodes, number, "node")?;
            if std::mem::replace(&mut seen[number], true) {
                let found = format!("node {number} with two parents");
                return Err(self.wrong(found, "nodes that are a tree"));
            }
            let extensions = node.extensions.as_deref();
            if extensions.is_some_and(|all| all.is_hidden) {
                ignored.harmless("a hidden node (KHR_node_visibility), with all below it");
                continue;
            }
            let scene_from_node = scene_from_parent * node.pose();
            if let Some(mesh) = node.mesh {
                let mesh = self.get(&file.meshes, mesh, "mesh")?;
                for primitive in &mesh.primitives {
                    let Some(positions) = self.with_triangles(primitive, ignored)? else {
                        continue;
                    };
                    let of = PlacedPrimitive {
                        node,
                        mesh,
                        primitive,
                        positions,
                        skin: self.skin_of(node, primitive, ignored),
                        scene_from_node,
                    };
                    corners = corners.saturating_add(self.corners(&of)?);
                    if available.is_some_and(|free| corners.saturating_mul(PLACED) > free) {
                        let path = printable::path(self.source.path);
                        let work =
                            format!("{path}: placing {corners} corners at {PLACED} bytes each");
                        memory::require(work, corners.saturating_mul(PLACED), available)?;
                    }
                    placed.push(of);
                }
            }
            let children = node.children.iter().rev();
            next.extend(children.map(|&child| (child, scene_from_node)));
        }
        Ok(placed)
    }

    /// Returns the position accessor of a primitive; `None` if it has no triangles.
    fn with_triangles(
        &self,
        primitive: &Primitive,
        ignored: &mut Collector,
    ) -> Result<Option<usize>, Error> {
        match primitive.mode {
            None | Some(TRIANGLES | STRIP | FAN) => {}
            Some(0..TRIANGLES) => {
                ignored.harmless("points or lines");
                return Ok(None);
            }
            Some(mode) => {
                let found = format!("a primitive of mode {mode}");
                return Err(self.wrong(found, "a mode from 0 to 6"));
            }
        }
        let extensions = primitive.extensions.as_deref();
        let Some(&positions) = primitive.attributes.get("POSITION") else {
            ignored.shape("a primitive without positions");
            return Ok(None);
        };
        for accessor in [Some(positions), primitive.indices].into_iter().flatten() {
            let of = self.accessor(accessor)?;
            let compressed = has(extensions, DRACO);
            let required = self
                .document
                .extensions_required
                .iter()
                .any(|name| name == DRACO);
            let has_data = of.buffer_view.is_some() || of.sparse.is_some();
            if compressed && (required || !has_data) {
                let found = format!("triangles compressed by the extension {DRACO}");
                return Err(self.wrong(found, "triangles without compression"));
            }
            if !has_data {
                let found = match names(extensions) {
                    [] => format!("accessor {accessor} without data"),
                    all => format!(
                        "accessor {accessor} without data, in a primitive with the extension {}",
                        printable::short(&all.join(", "))
                    ),
                };
                return Err(self.wrong(found, WHOLE));
            }
        }
        Ok(Some(positions))
    }

    /// Returns the skin that deforms a primitive of a node.
    fn skin_of(
        &self,
        node: &Node,
        primitive: &Primitive,
        ignored: &mut Collector,
    ) -> Option<usize> {
        let skin = node.skin?;
        let has_joints =
            { ["JOINTS_0", "WEIGHTS_0"] }.map(|name| primitive.attributes.contains_key(name));
        if has_joints != [true; 2] {
            ignored.shape("a skin of a primitive without joints and weights");
            return None;
        }
        if node
            .extensions
            .as_ref()
            .is_some_and(|all| all.instances.is_some())
        {
            ignored.shape("copies (EXT_mesh_gpu_instancing) of a mesh with a skin");
        }
        Some(skin)
    }

    /// Returns a bound of the work for a primitive: the vertices or corners of all instances,
    /// whichever is larger, plus morph targets and joints.
    fn corners(&self, of: &PlacedPrimitive) -> Result<u64, Error> {
        let count = |accessor: usize| Ok::<u64, Error>(self.accessor(accessor)?.count as u64);
        let vertices = count(of.positions)?;
        let corners = of.primitive.indices.map_or(Ok(0), count)?;
        let extensions = of.node.extensions.as_deref();
        let instances = extensions.and_then(|all| all.instances.as_ref());
        let copies = match instances {
            Some(attributes) => self.number_of_copies(attributes)? as u64,
            None => 1,
        };
        let mut sum = vertices.max(corners).max(1).saturating_mul(copies.max(1));
        let morphs = of.primitive.targets.len() as u64;
        sum = sum.saturating_add(morphs.saturating_mul(vertices));
        if let Some(skin) = of.skin {
            let joints = self.get(&self.document.skins, skin, "skin")?.joints.len() as u64;
            sum = sum.saturating_add(vertices).saturating_add(joints);
        }
        Ok(sum)
    }

    /// Adds the vertices and triangles of a primitive.
    fn place(
        &self,
        of: &PlacedPrimitive,
        globals: &[Option<DAffine3>],
        positions: &mut Vec<DVec3>,
        triangles: &mut Vec<[u32; 3]>,
    ) -> Result<(), Error> {
        let local = self.vectors::<3>(of.positions, POSITIONS, "positions")?;
        let mut local: Vec<DVec3> = local.into_iter().map(DVec3::from_array).collect();
        let corners = match of.primitive.indices {
            Some(indices) => self.indices(indices, local.len())?,
            None => (0..local.len() as u32).collect(),
        };
        let local_triangles = self.triangles(of.primitive.mode, &corners)?;
        self.morph((of.node, of.mesh, of.primitive), &mut local)?;
        let (mirrored, poses) = match of.skin {
            Some(skin) => {
                let mirrored = self.skin(skin, of.primitive, globals, &mut local)?;
                (mirrored, vec![DAffine3::IDENTITY])
            }
            None => (Vec::new(), self.copies(of.node)?),
        };
        for node_from_copy in poses {
            let pose = match of.skin {
                Some(_) => node_from_copy,
                None => of.scene_from_node * node_from_copy,
            };
            let first = positions.len();
            if u32::try_from(first + local.len()).is_err() {
                let found = format!("{} vertices", first + local.len());
                return Err(self.wrong(found, "fewer than 4294967296"));
            }
            for &vertex in &local {
                let position = pose.transform_point3(vertex);
                if !self.source.usable(position) {
                    let what = format!("vertex {} of the file", positions.len());
                    return Err(self.source.unusable(Place::File, &what, position));
                }
                positions.push(position);
            }
            let turns = pose.matrix3.determinant() < 0.0;
            triangles.extend(local_triangles.iter().map(|&[a, b, c]| {
                let turns_here = turns || mirrored.get(a as usize).is_some_and(|&turns| turns);
                let of = if turns_here { [a, c, b] } else { [a, b, c] };
                of.map(|v| first as u32 + v)
            }));
        }
        Ok(())
    }

    fn triangles(&self, mode: Option<u32>, corners: &[u32]) -> Result<Vec<[u32; 3]>, Error> {
        Ok(match mode {
            Some(STRIP) => {
                let windows = corners.windows(3).enumerate();
                windows
                    .map(|(i, of)| [of[i % 2], of[1 - i % 2], of[2]])
                    .collect()
            }
            Some(FAN) => {
                let windows = corners.windows(2).skip(1);
                windows.map(|of| [corners[0], of[0], of[1]]).collect()
            }
            _ => {
                let (whole, rest) = corners.as_chunks::<3>();
                if !rest.is_empty() {
                    let found = format!("{} corners of triangles", corners.len());
                    return Err(self.wrong(found, "three of each"));
                }
                whole.to_vec()
            }
        })
    }

    /// Returns vertex indices after checking that all are below `count`.
    fn indices(&self, number: usize, count: usize) -> Result<Vec<u32>, Error> {
        let values = self.vectors::<1>(number, INDICES, "indices")?;
        match values.iter().find(|[value]| *value as usize >= count) {
            None => Ok(values.into_iter().map(|[value]| value as u32).collect()),
            Some([value]) => {
                let found = format!("vertex {value} of a mesh of {count}");
                Err(self.wrong(found, "indices below the number of vertices"))
            }
        }
    }
}

#[cfg(test)]
mod tests;
