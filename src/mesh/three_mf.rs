//! 3MF (3MF Consortium, core specification 1.3, with the production extension's parts in several files):
//! all that the file's build places.
//!
//! The file states its unit. Materials, metadata and thumbnails are passed over. Of the extensions that a
//! file says it requires, those that would change its shape are refused.

use super::text::{self, quote};
use super::{Mesh, Source, memory};
use crate::error::{Error, InputError, Place, printable};
use crate::math::DVec3;
use glam::{DAffine3, DMat3};
use quick_xml::events::{BytesStart, Event};
use quick_xml::name::{NamespaceResolver, PrefixDeclaration, ResolveResult};
use quick_xml::{NsReader, XmlVersion};
use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::io::{BufReader, Cursor, Read};
use std::path::Path;
use zip::ZipArchive;

const CORE: &str = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02";
const PRODUCTION: &str = "http://schemas.microsoft.com/3dmanufacturing/production/2015/06";
/// Extensions that leave the shape as it is.
const HARMLESS: [&str; 4] = [
    CORE,
    PRODUCTION,
    "http://schemas.microsoft.com/3dmanufacturing/material/2015/02",
    "http://schemas.microsoft.com/3dmanufacturing/trianglesets/2021/07",
];
const RELATIONSHIPS: &str = "http://schemas.openxmlformats.org/package/2006/relationships";
const MODEL: &str = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel";

/// Bytes a triangle takes at most while it is placed and welded: three corners of its own.
const PLACED: u64 = 3 * 2 * 24 + 2 * 12;
/// Bytes of memory for a byte of XML: the shortest vertex takes 24 for `<vertex x="0" y="0" z="0"/>`.
const PER_XML_BYTE: u64 = 1;
/// Components of components of so many are a mistake.
const DEEPEST: usize = 64;

const WHOLE: &str = "a whole 3MF file";

/// The mesh in mm; `given` is the unit (mm) that the scene states, which must be the file's.
pub fn read(source: &Source, given: Option<f64>) -> Result<Mesh, Error> {
    let zip_error = |error: zip::result::ZipError| wrong(source, error.to_string(), WHOLE);
    let mut package = Package {
        source,
        archive: ZipArchive::new(Cursor::new(source.bytes)).map_err(zip_error)?,
    };
    let root = package.root()?;
    let mut models = HashMap::new();
    let mut wanted = vec![root.clone()];
    while let Some(name) = wanted.pop() {
        let Entry::Vacant(place) = models.entry(name) else {
            continue;
        };
        let model = package.model(place.key())?;
        let objects = model.objects.values();
        let components = objects.flat_map(|object| match object {
            Object::Components(components) => &components[..],
            Object::Mesh { .. } => &[],
        });
        let others = components
            .chain(&model.build)
            .filter_map(|p| p.model.clone());
        wanted.extend(others);
        place.insert(model);
    }
    let unit_mm = models[&root].unit_mm;
    if let Some((name, model)) = models.iter().find(|(_, model)| model.unit_mm != unit_mm) {
        let found = format!("{name} in units of {} mm", model.unit_mm);
        return Err(wrong(source, found, &format!("{unit_mm} mm as in {root}")));
    }
    if let Some(given) = given.filter(|&given| given != unit_mm) {
        let found = format!("a 3MF file in units of {unit_mm} mm");
        let expected =
            format!("{given} mm as it is asked for; without a unit the file's own is taken");
        return Err(wrong(source, found, &expected));
    }
    let build = Build {
        source: &Source { unit_mm, ..*source },
        models: &models,
    };
    build.mesh(&root)
}

fn wrong(source: &Source, found: String, expected: &str) -> Error {
    source.error(Place::File, found, expected)
}

/// A file that holds XML files.
struct Package<'a> {
    source: &'a Source<'a>,
    archive: ZipArchive<Cursor<&'a [u8]>>,
}

struct Model {
    unit_mm: f64,
    objects: HashMap<String, Object>,
    build: Vec<Placed>,
}

enum Object {
    Mesh {
        positions: Vec<DVec3>,
        triangles: Vec<[u32; 3]>,
    },
    Components(Vec<Placed>),
}

/// An object where it stands.
#[derive(Clone)]
struct Placed {
    /// The file that it is in; `None`: in the same.
    model: Option<String>,
    object: String,
    part_from_object: DAffine3,
}

impl Package<'_> {
    /// Name of the file with the build.
    fn root(&mut self) -> Result<String, Error> {
        let mut root = None;
        self.elements("_rels/.rels", RELATIONSHIPS, |element, _| {
            if element.name == "Relationship" && element.text("Type")?.as_deref() == Some(MODEL) {
                root = Some(element.needed("Target")?);
            }
            Ok(())
        })?;
        let root = root.map(|root| root.trim_start_matches('/').to_owned());
        let found = "a ZIP archive without a 3D model".to_owned();
        root.ok_or_else(|| wrong(self.source, found, WHOLE))
    }

    fn model(&mut self, name: &str) -> Result<Model, Error> {
        let mut unit_mm = None;
        let mut objects = HashMap::new();
        let mut build = None;
        let mut object: Option<(String, Object)> = None;
        let source = self.source;
        self.elements(name, CORE, |element, parent| {
            match (element.name, parent) {
                ("model", "") => {
                    element.require_harmless()?;
                    unit_mm = Some(element.unit()?);
                }
                ("object", "resources") => {
                    objects.extend(object.take());
                    let nothing = Object::Components(Vec::new());
                    object = Some((element.needed("id")?, nothing));
                }
                ("mesh", "object") => {
                    if let Some((_, object)) = &mut object {
                        *object = Object::Mesh {
                            positions: Vec::new(),
                            triangles: Vec::new(),
                        };
                    }
                }
                ("vertex", "vertices") => {
                    if let Some((_, Object::Mesh { positions, .. })) = &mut object {
                        let [x, y, z] = ["x", "y", "z"].map(|key| element.number(key));
                        let position = DVec3::new(x?, y?, z?);
                        if !source.usable(position) {
                            let found = format!("a vertex at {position}");
                            return Err(element.wrong(found, "finite coordinates within 1e12 mm"));
                        }
                        positions.push(position);
                    }
                }
                ("triangle", "triangles") => {
                    if let Some((
                        _,
                        Object::Mesh {
                            positions,
                            triangles,
                        },
                    )) = &mut object
                    {
                        let [a, b, c] =
                            ["v1", "v2", "v3"].map(|key| element.vertex(key, positions.len()));
                        triangles.push([a?, b?, c?]);
                    }
                }
                ("component", "components") => {
                    if let Some((_, Object::Components(components))) = &mut object {
                        components.push(element.placed()?);
                    }
                }
                ("build", "model") => build = Some(Vec::new()),
                ("item", "build") => {
                    let placed = element.placed()?;
                    build.get_or_insert_default().push(placed);
                }
                _ => {}
            }
            Ok(())
        })?;
        objects.extend(object);
        let missing = |what: &str| wrong(source, format!("{name} without {what}"), WHOLE);
        Ok(Model {
            unit_mm: unit_mm.ok_or_else(|| missing("a model"))?,
            objects,
            build: build.ok_or_else(|| missing("a build"))?,
        })
    }

    /// Calls `take` for each element of the namespace, in the file's order, with the name of the element
    /// around it ("" for the first, and for one of another namespace).
    fn elements(
        &mut self,
        name: &str,
        namespace: &str,
        mut take: impl FnMut(&Element, &str) -> Result<(), Error>,
    ) -> Result<(), Error> {
        let path = self.source.path.join(name);
        let entry = self.archive.by_name(name);
        let entry = entry.map_err(|e| wrong(self.source, format!("{name}: {e}"), WHOLE))?;
        let size = entry.size();
        let work = format!("{}: reading {size} bytes", printable::path(&path));
        memory::require(work, size.saturating_mul(PER_XML_BYTE), memory::available())?;
        let mut reader = NsReader::from_reader(BufReader::new(entry.take(size)));
        let (mut buffer, mut around) = (Vec::new(), Vec::<String>::new());
        loop {
            buffer.clear();
            let at = reader.buffer_position();
            let wrong = |error: String| {
                let expected = "whole XML";
                Error::from(InputError::new(&path, Place::Byte(at), error, expected))
            };
            let (is_empty, start) = match reader.read_event_into(&mut buffer) {
                Err(error) => return Err(wrong(error.to_string())),
                Ok(Event::Eof) if around.is_empty() => return Ok(()),
                Ok(Event::Eof) => return Err(wrong("the end of the file".to_owned())),
                Ok(Event::End(_)) => {
                    around.pop();
                    continue;
                }
                Ok(Event::Start(start)) => (false, start),
                Ok(Event::Empty(start)) => (true, start),
                Ok(_) => continue,
            };
            let (of, local) = reader.resolver().resolve_element(start.name());
            let mut own = String::new();
            if matches!(of, ResolveResult::Bound(uri) if uri.as_ref() == namespace) {
                local.as_ref().clone_into(&mut own);
                let element = Element {
                    path: &path,
                    at,
                    name: &own,
                    start: &start,
                    names: reader.resolver(),
                };
                take(&element, around.last().map_or("", |name| name))?;
            }
            if !is_empty {
                around.push(own);
            }
        }
    }
}

/// The start of an XML element.
struct Element<'a> {
    path: &'a Path,
    /// Byte of the file.
    at: u64,
    name: &'a str,
    start: &'a BytesStart<'a>,
    names: &'a NamespaceResolver,
}

impl Element<'_> {
    fn wrong(&self, found: String, expected: &str) -> Error {
        InputError::new(self.path, Place::Byte(self.at), found, expected).into()
    }

    /// The value of an attribute; `None` where it has none of this name.
    fn text(&self, key: &str) -> Result<Option<String>, Error> {
        let unreadable = |error: String| self.wrong(error, "whole XML");
        let found = self.start.try_get_attribute(key);
        let Some(found) = found.map_err(|e| unreadable(e.to_string()))? else {
            return Ok(None);
        };
        let value = found.normalized_value(XmlVersion::Implicit1_0);
        let value = value.map_err(|e| unreadable(e.to_string()))?;
        Ok(Some(value.into_owned()))
    }

    fn needed(&self, key: &str) -> Result<String, Error> {
        let missing = || self.wrong(format!("<{}> without {key}", self.name), WHOLE);
        self.text(key)?.ok_or_else(missing)
    }

    fn number(&self, key: &str) -> Result<f64, Error> {
        let value = self.needed(key)?;
        text::number(value.trim().as_bytes()).map_err(|found| self.wrong(found, text::NUMBER))
    }

    /// The number of a vertex, of so many before it.
    fn vertex(&self, key: &str, count: usize) -> Result<u32, Error> {
        let value = self.needed(key)?;
        let number = value.trim().parse::<u32>().ok();
        let wrong = || self.wrong(quote(value.as_bytes()), &format!("a vertex below {count}"));
        number.filter(|&n| (n as usize) < count).ok_or_else(wrong)
    }

    /// Millimetres a unit of the model.
    fn unit(&self) -> Result<f64, Error> {
        let unit = self.text("unit")?;
        Ok(match unit.as_deref().unwrap_or("millimeter") {
            "micron" => 1e-3,
            "millimeter" => 1.0,
            "centimeter" => 10.0,
            "inch" => 25.4,
            "foot" => 304.8,
            "meter" => 1000.0,
            other => {
                let expected = "micron, millimeter, centimeter, inch, foot or meter";
                return Err(self.wrong(quote(other.as_bytes()), expected));
            }
        })
    }

    /// Refuses a model whose shape needs an extension.
    fn require_harmless(&self) -> Result<(), Error> {
        let required = self.text("requiredextensions")?.unwrap_or_default();
        for prefix in required.split_whitespace() {
            let mut bound = self.names.bindings();
            let uri = bound.find(|(name, _)| *name == PrefixDeclaration::Named(prefix));
            let uri = uri.map_or(prefix, |(_, uri)| uri.into_inner());
            if !HARMLESS.contains(&uri) {
                let found = format!("a model that needs the extension {}", quote(uri.as_bytes()));
                return Err(self.wrong(found, "one of triangles alone"));
            }
        }
        Ok(())
    }

    fn placed(&self) -> Result<Placed, Error> {
        let mut model = None;
        for attribute in self.start.attributes().flatten() {
            let (of, key) = self.names.resolve_attribute(attribute.key);
            let is_path = matches!(of, ResolveResult::Bound(uri) if uri.as_ref() == PRODUCTION)
                && key.as_ref() == "path";
            if is_path {
                model = self.text(attribute.key.as_ref())?;
            }
        }
        let mut part_from_object = DAffine3::IDENTITY;
        if let Some(transform) = self.text("transform")? {
            let numbers: Vec<f64> = (transform.split_whitespace())
                .map(|word| text::number(word.as_bytes()))
                .collect::<Result<_, _>>()
                .map_err(|found| self.wrong(found, text::NUMBER))?;
            let [x, y, z, by] = match numbers.as_chunks::<3>() {
                (&[x, y, z, by], []) => [x, y, z, by].map(DVec3::from_array),
                _ => {
                    let found = format!("a transform of {} numbers", numbers.len());
                    return Err(self.wrong(found, "12 numbers"));
                }
            };
            // Where the axes and the origin go.
            part_from_object = DAffine3::from_mat3_translation(DMat3::from_cols(x, y, z), by);
        }
        Ok(Placed {
            model: model.map(|path| path.trim_start_matches('/').to_owned()),
            object: self.needed("objectid")?,
            part_from_object,
        })
    }
}

/// What is placed, in the part.
struct Build<'a> {
    source: &'a Source<'a>,
    models: &'a HashMap<String, Model>,
}

impl Build<'_> {
    fn mesh(&self, root: &str) -> Result<Mesh, Error> {
        let build = &self.models[root].build;
        let mut counts = HashMap::new();
        let mut corners = 0u64;
        for item in build {
            corners = corners.saturating_add(self.corners(root, item, 0, &mut counts)?);
        }
        let path = printable::path(self.source.path);
        let work = format!("{path}: placing {corners} corners at {PLACED} bytes each");
        memory::require(work, corners.saturating_mul(PLACED), memory::available())?;
        if corners > u64::from(u32::MAX) {
            let found = format!("{corners} corners of all that is placed");
            return Err(wrong(self.source, found, "fewer than 4294967296"));
        }
        let (mut positions, mut triangles) = (Vec::new(), Vec::new());
        for item in build {
            self.place(
                root,
                item,
                DAffine3::IDENTITY,
                &mut positions,
                &mut triangles,
            )?;
        }
        self.source.mesh(&positions, &triangles)
    }

    /// The object that is placed, and the name of the model that it is in.
    fn object<'b>(
        &'b self,
        model: &'b str,
        placed: &'b Placed,
    ) -> Result<(&'b str, &'b Object), Error> {
        let model = placed.model.as_deref().unwrap_or(model);
        let object = self.models[model].objects.get(&placed.object);
        let found = || format!("object {} in {model}", quote(placed.object.as_bytes()));
        let object = object.ok_or_else(|| wrong(self.source, found(), "one that the file has"))?;
        Ok((model, object))
    }

    /// Vertices and corners of all triangles below, whichever are more; each object is counted once.
    fn corners<'b>(
        &'b self,
        model: &'b str,
        placed: &'b Placed,
        depth: usize,
        counts: &mut HashMap<(&'b str, &'b str), u64>,
    ) -> Result<u64, Error> {
        let (model, object) = self.object(model, placed)?;
        if let Some(&count) = counts.get(&(model, &*placed.object)) {
            return Ok(count);
        }
        if depth == DEEPEST {
            let found = format!("components {DEEPEST} deep");
            return Err(wrong(
                self.source,
                found,
                "objects that are not parts of themselves",
            ));
        }
        let count = match object {
            Object::Mesh {
                positions,
                triangles,
            } => positions.len().max(3 * triangles.len()) as u64,
            Object::Components(components) => {
                let mut sum = 0u64;
                for placed in components {
                    sum = sum.saturating_add(self.corners(model, placed, depth + 1, counts)?);
                }
                sum
            }
        };
        counts.insert((model, &placed.object), count);
        Ok(count)
    }

    /// Adds what is placed.
    fn place(
        &self,
        model: &str,
        placed: &Placed,
        part_from_parent: DAffine3,
        all_positions: &mut Vec<DVec3>,
        all_triangles: &mut Vec<[u32; 3]>,
    ) -> Result<(), Error> {
        let (model, object) = self.object(model, placed)?;
        let part_from_object = part_from_parent * placed.part_from_object;
        match object {
            Object::Components(components) => {
                for placed in components {
                    self.place(
                        model,
                        placed,
                        part_from_object,
                        all_positions,
                        all_triangles,
                    )?;
                }
            }
            Object::Mesh {
                positions,
                triangles,
            } => {
                let first = all_positions.len() as u32;
                for &position in positions {
                    let position = part_from_object.transform_point3(position);
                    if !self.source.usable(position) {
                        let what =
                            format!("object {} with a vertex", quote(placed.object.as_bytes()));
                        return Err(self.source.unusable(Place::File, &what, position));
                    }
                    all_positions.push(position);
                }
                // A mirror turns triangles inside out.
                let mirrored = part_from_object.matrix3.determinant() < 0.0;
                all_triangles.extend(triangles.iter().map(|&[a, b, c]| match mirrored {
                    false => [a, b, c].map(|v| first + v),
                    true => [a, c, b].map(|v| first + v),
                }));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
#[path = "three_mf_tests.rs"]
mod tests;
