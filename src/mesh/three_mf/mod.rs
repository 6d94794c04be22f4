//! 3MF (3MF Consortium, core specification 1.3, with parts in several files by the production
//! extension): all objects that the build of the file contains.
//!
//! The file states its unit. Appearance, thumbnails and metadata are not part of the shape. A
//! required extension that may change the shape is refused.
//!
//! Parts that a slicer does not print as solid (modifiers, support blockers, negative volumes) are
//! omitted, as are items with `printable="0"` and support objects. Omitted content is listed by
//! name, with a warning if it changes the shape.

use super::ignored::Collector;
use super::text::{self, quote};
use super::{Mesh, MeshInput, memory};
use crate::error::{Error, Place, printable};
use crate::math::DVec3;
use glam::{DAffine3, DMat3};
use package::{CORE, Package, StartTag, WHOLE, wrong};
use slicers::{Roles, is_negative};
use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, HashMap};

mod package;
mod slicers;

const PRODUCTION: &str = "http://schemas.microsoft.com/3dmanufacturing/production/2015/06";
const SLICES: &str = "http://schemas.microsoft.com/3dmanufacturing/slice/2015/07";
const RELATIONSHIPS: &str = "http://schemas.openxmlformats.org/package/2006/relationships";
const MODEL: &str = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel";

/// Upper bound of bytes per corner during transformation and welding.
const PLACED: u64 = 3 * 2 * 24 + 2 * 12;
/// Largest nesting depth of components; a greater depth is a mistake in the file.
const DEEPEST: usize = 64;

/// True if an extension leaves the shape unchanged, in any of its versions.
fn is_harmless(uri: &str) -> bool {
    const FOLDERS: [&str; 2] = [
        "http://schemas.microsoft.com/3dmanufacturing/",
        "http://schemas.3mf.io/3dmanufacturing/",
    ];
    let names = [
        "core",
        "production",
        "material",
        "materials",
        "trianglesets",
    ];
    let rest = FOLDERS.iter().find_map(|folder| uri.strip_prefix(folder));
    rest.and_then(|rest| rest.split('/').next())
        .is_some_and(|name| names.contains(&name))
}

/// Reads the mesh in mm. `given` is the unit (mm) that the scene states, which must equal the unit
/// of the file.
pub fn read(
    source: &MeshInput,
    given: Option<f64>,
    ignored: &mut Collector,
) -> Result<Mesh, Error> {
    let mut package = Package::new(source)?;
    let root = package.root(ignored)?;
    let mut models = BTreeMap::new();
    let mut wanted = vec![root.clone()];
    while let Some(name) = wanted.pop() {
        let Entry::Vacant(place) = models.entry(name) else {
            continue;
        };
        let model = package.model(place.key(), ignored)?;
        let objects = model.objects.values();
        let components = objects.flat_map(|object| match &object.content {
            Content::Components(components) => &components[..],
            _ => &[],
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
    let roles = Roles::read(&mut package)?;
    if let Some(model) = models.get_mut(&root) {
        model.leave_out(&roles, ignored);
    }
    let build = Build {
        source: &MeshInput { unit_mm, ..*source },
        models: &models,
    };
    build.mesh(&root, ignored)
}

struct Model {
    unit_mm: f64,
    objects: BTreeMap<String, Object>,
    build: Vec<PlacedObject>,
}

struct Object {
    /// Type of the object; "model" if unspecified.
    kind: String,
    content: Content,
}

enum Content {
    Mesh {
        positions: Vec<DVec3>,
        triangles: Vec<[u32; 3]>,
    },
    Components(Vec<PlacedObject>),
    /// Element of an unsupported extension, as named in messages.
    Extension(String),
}

/// Object with its pose.
#[derive(Clone)]
struct PlacedObject {
    /// File that contains the object; `None` for the current file.
    model: Option<String>,
    object: String,
    part_from_object: DAffine3,
}

impl Model {
    /// Removes the parts that slicers do not print as solid.
    fn leave_out(&mut self, roles: &Roles, ignored: &mut Collector) {
        for (id, object) in &mut self.objects {
            let mut list = |role: &str| {
                let id = printable::short(id);
                match is_negative(role) {
                    true => ignored.shape(format!(
                        "a negative volume (\"{role}\" of object {id}), which is not subtracted: \
                         subtract it in the CAD or slicer program before export"
                    )),
                    false => ignored.harmless(format!(
                        "a part that is not solid (\"{role}\" of object {id})"
                    )),
                }
            };
            match &mut object.content {
                Content::Mesh { triangles, .. } => {
                    let ranges = roles.ranges(id);
                    if ranges.is_empty() {
                        continue;
                    }
                    let mut stays = vec![true; triangles.len()];
                    for (first, last, role) in ranges {
                        list(role);
                        let end = last.saturating_add(1).min(stays.len());
                        if let Some(range) = stays.get_mut(*first..end) {
                            range.fill(false);
                        }
                    }
                    let mut stays = stays.into_iter();
                    triangles.retain(|_| stays.next().unwrap_or(true));
                }
                Content::Components(components) => components.retain(|placed| {
                    let role = roles.component(id, &placed.object);
                    role.is_none_or(|role| {
                        list(role);
                        false
                    })
                }),
                Content::Extension(_) => {}
            }
        }
    }
}

impl Package<'_> {
    /// Returns the name of the file that contains the build.
    fn root(&mut self, ignored: &mut Collector) -> Result<String, Error> {
        let mut root = None;
        let mut others = Vec::new();
        self.elements("_rels/.rels", |element| {
            let is_ours = element.namespace == RELATIONSHIPS && element.name == "Relationship";
            if is_ours && element.text("Type")?.as_deref() == Some(MODEL) {
                let target = element.needed("Target")?;
                match root {
                    None => root = Some(target),
                    Some(_) => others.push(target),
                }
            }
            Ok(())
        })?;
        for other in others {
            ignored.shape(format!("another 3D model of the file ({other})"));
        }
        let found = "a ZIP archive without a 3D model".to_owned();
        root.ok_or_else(|| wrong(self.source(), found, WHOLE))
    }

    fn model(&mut self, name: &str, ignored: &mut Collector) -> Result<Model, Error> {
        let mut unit_mm = None;
        let mut objects = BTreeMap::new();
        let mut build = None;
        let mut object: Option<(String, Object)> = None;
        let source = self.source();
        self.elements(name, |element| {
            let parents = element.parents();
            if element.namespace != CORE {
                if !is_harmless(element.namespace) {
                    element.of_extension(object.as_mut(), ignored);
                }
                return Ok(());
            }
            match (element.name, parents) {
                ("model", ["", _]) => {
                    element.require_harmless()?;
                    unit_mm = Some(element.unit()?);
                }
                ("object", ["resources", _]) => {
                    objects.extend(object.take());
                    object = Some((element.needed("id")?, element.object(ignored)?));
                }
                ("metadata", ["metadatagroup", "object"]) => element.of_cura(ignored)?,
                ("build", ["model", _]) => build = Some(Vec::new()),
                ("item", ["build", _]) => {
                    let placed = element.placed()?;
                    match element.text("printable")?.as_deref() {
                        Some("0" | "false") => {
                            let id = printable::short(&placed.object);
                            ignored.harmless(format!("object {id} with printable=\"0\""));
                        }
                        _ => build.get_or_insert_default().push(placed),
                    }
                }
                _ => {
                    if let Some((_, object)) = &mut object {
                        element.content(object, source)?;
                    }
                }
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
}

impl StartTag<'_> {
    /// Adds an element of the shape of an object to the object.
    fn content(&self, object: &mut Object, source: &MeshInput) -> Result<(), Error> {
        match (self.name, self.parents(), &mut object.content) {
            ("mesh", ["object", _], content) => {
                *content = Content::Mesh {
                    positions: Vec::new(),
                    triangles: Vec::new(),
                };
            }
            ("vertex", ["vertices", "mesh"], Content::Mesh { positions, .. }) => {
                let [x, y, z] = ["x", "y", "z"].map(|key| self.number(key));
                let position = DVec3::new(x?, y?, z?);
                if !source.usable(position) {
                    let found = format!("a vertex at {position}");
                    return Err(self.wrong(found, "finite coordinates within 1e12 mm"));
                }
                positions.push(position);
            }
            (
                "triangle",
                ["triangles", "mesh"],
                Content::Mesh {
                    positions,
                    triangles,
                },
            ) => {
                let [a, b, c] = ["v1", "v2", "v3"].map(|key| self.vertex(key, positions.len()));
                triangles.push([a?, b?, c?]);
            }
            ("component", ["components", "object"], Content::Components(components)) => {
                components.push(self.placed()?);
            }
            _ => {}
        }
        Ok(())
    }

    /// Returns the unit of the model in mm.
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

    /// Refuses a model whose shape requires an unsupported extension.
    fn require_harmless(&self) -> Result<(), Error> {
        let required = self.text("requiredextensions")?.unwrap_or_default();
        for prefix in required.split_whitespace() {
            let uri = self.uri(prefix).unwrap_or(prefix);
            if !is_harmless(uri) {
                let uri = printable::short(uri);
                let found = format!("a model that requires the extension \"{uri}\"");
                return Err(self.wrong(
                    found,
                    "extensions that leave the shape of triangles as it is",
                ));
            }
        }
        Ok(())
    }

    /// Creates an object without its content.
    fn object(&self, ignored: &mut Collector) -> Result<Object, Error> {
        let mut coarse = None;
        self.prefixed(|uri, name, key| {
            if is_harmless(uri) {
                return;
            }
            match name {
                "meshresolution" => coarse = Some(key.to_owned()),
                _ => ignored.add(&format!("{uri} {name}"), false, |_| {
                    format!("the attribute {name} of objects (extension {uri})")
                }),
            }
        });
        if let Some(key) = coarse
            && let Some(resolution) = self.text(&key)?.filter(|value| value != "fullres")
        {
            let id = self.text("id")?.unwrap_or_default();
            let slices = format!("whose slices ({SLICES}) are its shape");
            ignored.shape(format!("{key}=\"{resolution}\" of object {id}, {slices}"));
        }
        let kind = self.text("type")?;
        Ok(Object {
            kind: kind.unwrap_or_else(|| "model".to_owned()),
            content: Content::Components(Vec::new()),
        })
    }

    /// Lists an element of an unsupported extension.
    fn of_extension(&self, object: Option<&mut (String, Object)>, ignored: &mut Collector) {
        let parent = self.parents()[0];
        if parent.is_empty() {
            // Inside an element that is already listed.
            return;
        }
        let name = format!(
            "<{}> of the extension \"{}\"",
            printable::short(self.name),
            printable::short(self.namespace)
        );
        match (parent, object) {
            // Replaces the mesh: listed only if the object is part of the build.
            ("object", Some((_, object))) if matches!(&object.content, Content::Components(all) if all.is_empty()) =>
            {
                object.content = Content::Extension(name);
            }
            ("object" | "mesh" | "components" | "component" | "build" | "item", _) => {
                ignored.shape(name);
            }
            ("resources" | "model", _) => ignored.harmless(name),
            _ => {}
        }
    }

    /// Lists the roles of meshes that Cura does not print as solid.
    fn of_cura(&self, ignored: &mut Collector) -> Result<(), Error> {
        const ROLES: [&str; 4] = [
            "infill_mesh",
            "cutting_mesh",
            "anti_overhang_mesh",
            "support_mesh",
        ];
        let name = self.text("name")?.unwrap_or_default();
        if ROLES
            .iter()
            .any(|role| name.strip_prefix("cura:") == Some(role))
        {
            ignored.shape(format!("{name} of an object, which is read as solid"));
        }
        Ok(())
    }

    fn placed(&self) -> Result<PlacedObject, Error> {
        let mut key = None;
        self.prefixed(|uri, name, whole| {
            if uri == PRODUCTION && name == "path" {
                key = Some(whole.to_owned());
            }
        });
        let model = match key {
            Some(key) => self.text(&key)?,
            None => None,
        };
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
            // Images of the axes and of the origin.
            part_from_object = DAffine3::from_mat3_translation(DMat3::from_cols(x, y, z), by);
        }
        Ok(PlacedObject {
            model,
            object: self.needed("objectid")?,
            part_from_object,
        })
    }
}

/// Objects of the build with their poses in the part.
struct Build<'a> {
    source: &'a MeshInput<'a>,
    models: &'a BTreeMap<String, Model>,
}

impl Build<'_> {
    fn mesh(&self, root: &str, ignored: &mut Collector) -> Result<Mesh, Error> {
        let build = &self.models[root].build;
        let mut counts = CornerCounts::new();
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
        let mut placing = AssembledContent {
            counts,
            ignored,
            positions: Vec::new(),
            triangles: Vec::new(),
        };
        for item in build {
            self.place(root, item, DAffine3::IDENTITY, &mut placing)?;
        }
        let (positions, triangles) = (placing.positions, placing.triangles);
        if triangles.is_empty() {
            let instead = format!("{} items of the build", build.len());
            return Err(self.source.no_triangles_but(&instead, ignored));
        }
        self.source.mesh(&positions, &triangles)
    }

    /// Returns the referenced object, and the name of the model that contains it.
    fn object<'b>(
        &'b self,
        model: &'b str,
        placed: &'b PlacedObject,
    ) -> Result<(&'b str, &'b Object), Error> {
        let model = placed.model.as_deref().unwrap_or(model);
        let object = self.models[model].objects.get(&placed.object);
        let found = || format!("object {} in {model}", quote(placed.object.as_bytes()));
        let object = object.ok_or_else(|| {
            let expected = "an object that the file has and that is not encrypted";
            wrong(self.source, found(), expected)
        })?;
        Ok((model, object))
    }

    /// Returns the larger of the vertex count and the corner count over the complete subtree. Each
    /// object is evaluated once.
    fn corners<'b>(
        &'b self,
        model: &'b str,
        placed: &'b PlacedObject,
        depth: usize,
        counts: &mut CornerCounts<'b>,
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
        let count = match &object.content {
            Content::Mesh {
                positions,
                triangles,
            } => positions.len().max(3 * triangles.len()) as u64,
            Content::Components(components) => {
                let mut sum = 0u64;
                for placed in components {
                    sum = sum.saturating_add(self.corners(model, placed, depth + 1, counts)?);
                }
                sum
            }
            // Nonzero, so that the object is visited and listed.
            Content::Extension(_) => 1,
        };
        counts.insert((model, &placed.object), count);
        Ok(count)
    }

    /// Adds a referenced object and its components.
    fn place<'b>(
        &'b self,
        model: &'b str,
        placed: &'b PlacedObject,
        part_from_parent: DAffine3,
        placing: &mut AssembledContent<'b, '_>,
    ) -> Result<(), Error> {
        let (model, object) = self.object(model, placed)?;
        let id = || printable::short(&placed.object);
        // An empty object, or nested empty objects. A file may contain 2⁶⁴ of them.
        if placing.counts.get(&(model, &*placed.object)) == Some(&0) {
            placing
                .ignored
                .harmless(format!("object {}, which is empty", id()));
            return Ok(());
        }
        if !matches!(&*object.kind, "model" | "surface" | "") {
            let name = format!("object {} of the type \"{}\"", id(), object.kind);
            placing.ignored.harmless(name);
            return Ok(());
        }
        let part_from_object = part_from_parent * placed.part_from_object;
        match &object.content {
            Content::Extension(name) => {
                let name = format!("object {}, made of {name}", id());
                placing.ignored.shape(name);
            }
            Content::Components(components) => {
                for placed in components {
                    self.place(model, placed, part_from_object, placing)?;
                }
            }
            Content::Mesh {
                positions,
                triangles,
            } => {
                let first = placing.positions.len() as u32;
                for &position in positions {
                    let position = part_from_object.transform_point3(position);
                    if !self.source.usable(position) {
                        let what =
                            format!("object {} with a vertex", quote(placed.object.as_bytes()));
                        return Err(self.source.unusable(Place::File, &what, position));
                    }
                    placing.positions.push(position);
                }
                // A mirror reverses the triangles.
                let mirrored = part_from_object.matrix3.determinant() < 0.0;
                let triangles = triangles.iter().map(|&[a, b, c]| match mirrored {
                    false => [a, b, c].map(|v| first + v),
                    true => [a, c, b].map(|v| first + v),
                });
                placing.triangles.extend(triangles);
            }
        }
        Ok(())
    }
}

/// Number of corners of each object, by its model and its name.
type CornerCounts<'b> = HashMap<(&'b str, &'b str), u64>;

/// Content added until now.
struct AssembledContent<'b, 'c> {
    counts: CornerCounts<'b>,
    ignored: &'c mut Collector,
    positions: Vec<DVec3>,
    triangles: Vec<[u32; 3]>,
}

#[cfg(test)]
mod tests;
