//! Classification of glTF extensions: supported, without effect on the shape, or unsupported.

use super::document::{Document, Extensions, INSTANCING, VISIBILITY, names};
use crate::mesh::ignored::Collector;

/// Extensions that are supported.
const READ: [&str; 3] = [INSTANCING, VISIBILITY, "KHR_mesh_quantization"];

/// Compressed data, refused if the file has no uncompressed data.
pub const DRACO: &str = "KHR_draco_mesh_compression";
pub const MESHOPT: [&str; 2] = ["EXT_meshopt_compression", "KHR_meshopt_compression"];

/// Name prefixes of extensions for appearance, light, sound, animation, semantics or physics, which
/// leave the shape unchanged.
const HARMLESS: [&str; 36] = [
    "ADOBE_materials_",
    "AGI_",
    "CESIUM_primitive_outline",
    "EXT_feature_metadata",
    "EXT_instance_features",
    "EXT_lights_",
    "EXT_mesh_features",
    "EXT_mesh_manifold",
    "EXT_property_",
    "EXT_structural_metadata",
    "EXT_texture_",
    "FB_geometry_metadata",
    "GODOT_single_root",
    "KHR_animation",
    "KHR_audio",
    "KHR_blend",
    "KHR_environment_map",
    "KHR_interactivity",
    "KHR_lights_",
    "KHR_materials_",
    "KHR_node_hoverability",
    "KHR_node_selectability",
    "KHR_physics_",
    "KHR_techniques_webgl",
    "KHR_texture_",
    "KHR_xmp",
    "MPEG_audio_",
    "MPEG_texture_",
    "MSFT_audio_",
    // Coarser levels of detail; the mesh of the node itself is the finest.
    "MSFT_lod",
    "MSFT_packing_",
    "MSFT_texture_",
    "MX_materials_",
    "NV_materials_",
    "OMI_audio_",
    "OMI_physics_",
];

fn is_harmless(name: &str) -> bool {
    HARMLESS.iter().any(|start| name.starts_with(start))
}

/// Returns the first required extension that may change the shape and is unsupported.
pub fn needed(document: &Document) -> Option<&str> {
    let compressed = |name: &str| name == DRACO || MESHOPT.contains(&name);
    let names = document.extensions_required.iter().map(String::as_str);
    // Compressed data is refused at its use, since a file may require an extension that its scene
    // does not use.
    { names }.find(|name| !READ.contains(name) && !is_harmless(name) && !compressed(name))
}

/// Lists the unsupported extensions.
pub fn list<'a>(document: &'a Document, ignored: &mut Collector) {
    let mut listed: Vec<&'a String> = Vec::new();
    let mut of = |what: &str, extensions: Option<&'a Extensions>| {
        for name in names(extensions) {
            let compressed = name == DRACO || MESHOPT.contains(&&**name);
            if READ.contains(&&**name) || is_harmless(name) || compressed {
                continue;
            }
            ignored.shape(format!("the extension {name} of {what}"));
            if listed.len() < 100 && !listed.contains(&name) {
                listed.push(name);
            }
        }
    };
    of("the file", document.extensions.as_deref());
    document
        .scenes
        .iter()
        .for_each(|scene| of("a scene", scene.extensions.as_deref()));
    document
        .nodes
        .iter()
        .for_each(|node| of("a node", node.extensions.as_deref()));
    for mesh in &document.meshes {
        of("a mesh", mesh.extensions.as_deref());
        let primitives = mesh.primitives.iter();
        primitives.for_each(|p| of("a primitive", p.extensions.as_deref()));
    }
    document
        .skins
        .iter()
        .for_each(|skin| of("a skin", skin.extensions.as_deref()));
    for accessor in &document.accessors {
        of("an accessor", accessor.extensions.as_deref());
    }
    for view in &document.buffer_views {
        of("a buffer view", view.extensions.as_deref());
    }
    for buffer in &document.buffers {
        of("a buffer", buffer.extensions.as_deref());
    }
    let required = &document.extensions_required;
    let used = &document.extensions_used;
    let others = required
        .iter()
        .chain(used.iter().filter(|name| !required.contains(name)));
    for name in others {
        if READ.contains(&&**name) || listed.contains(&name) {
            continue;
        }
        ignored.harmless(format!("the extension {name}"));
    }
}
