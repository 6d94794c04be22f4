//! Parts of a glTF document that the reader uses.

use crate::math::DVec3;
use glam::{DAffine3, DMat4, DQuat};
use serde::de::{IgnoredAny, MapAccess, Visitor};
use serde::{Deserialize, Deserializer};
use std::collections::BTreeMap;
use std::fmt;

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Document {
    pub asset: Asset,
    #[serde(default)]
    pub extensions_required: Vec<String>,
    #[serde(default)]
    pub extensions_used: Vec<String>,
    pub scene: Option<usize>,
    #[serde(default)]
    pub scenes: Vec<GltfScene>,
    #[serde(default)]
    pub nodes: Vec<Node>,
    #[serde(default)]
    pub meshes: Vec<OfMesh>,
    #[serde(default)]
    pub skins: Vec<Skin>,
    #[serde(default)]
    pub materials: Vec<GltfMaterial>,
    #[serde(default)]
    pub accessors: Vec<Accessor>,
    #[serde(default)]
    pub buffer_views: Vec<BufferView>,
    #[serde(default)]
    pub buffers: Vec<Buffer>,
    #[serde(default)]
    pub animations: Vec<IgnoredAny>,
    #[serde(default)]
    pub cameras: Vec<IgnoredAny>,
    pub extensions: Option<Box<Extensions>>,
}

#[derive(Deserialize)]
pub struct Asset {
    pub version: String,
}

#[derive(Deserialize)]
pub struct GltfScene {
    #[serde(default)]
    pub nodes: Vec<usize>,
    pub extensions: Option<Box<Extensions>>,
}

#[derive(Deserialize)]
pub struct Node {
    pub mesh: Option<usize>,
    pub skin: Option<usize>,
    #[serde(default)]
    pub children: Vec<usize>,
    /// Matrix elements in column-major order.
    matrix: Option<Box<[f64; 16]>>,
    translation: Option<[f64; 3]>,
    rotation: Option<[f64; 4]>,
    scale: Option<[f64; 3]>,
    /// Weights of the morph targets of the mesh; they override the weights in the mesh.
    pub weights: Option<Vec<f64>>,
    pub extensions: Option<Box<Extensions>>,
}

impl Node {
    /// Returns the transform parent_from_node. Quaternions of the file have unit length to 10⁻⁷
    /// only, so they are normalized.
    pub fn pose(&self) -> DAffine3 {
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
pub struct OfMesh {
    pub primitives: Vec<Primitive>,
    pub weights: Option<Vec<f64>>,
    pub extensions: Option<Box<Extensions>>,
}

#[derive(Deserialize)]
pub struct GltfMaterial {
    pub name: Option<String>,
}

/// Accessor indices by attribute name.
pub type Attributes = BTreeMap<String, usize>;

#[derive(Deserialize)]
pub struct Primitive {
    pub material: Option<usize>,
    pub attributes: Attributes,
    pub indices: Option<usize>,
    pub mode: Option<u32>,
    #[serde(default)]
    pub targets: Vec<Attributes>,
    pub extensions: Option<Box<Extensions>>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Skin {
    pub joints: Vec<usize>,
    pub inverse_bind_matrices: Option<usize>,
    pub extensions: Option<Box<Extensions>>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Accessor {
    pub buffer_view: Option<usize>,
    #[serde(default)]
    pub byte_offset: usize,
    pub component_type: u32,
    #[serde(default)]
    pub normalized: bool,
    pub count: usize,
    pub r#type: String,
    pub sparse: Option<Box<Sparse>>,
    pub extensions: Option<Box<Extensions>>,
}

/// Elements of an accessor that override the values of its buffer view.
#[derive(Deserialize)]
pub struct Sparse {
    pub count: usize,
    pub indices: SparsePart,
    pub values: SparsePart,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct SparsePart {
    pub buffer_view: usize,
    #[serde(default)]
    pub byte_offset: usize,
    /// Component type; `None` for values, which use the type of the accessor.
    pub component_type: Option<u32>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct BufferView {
    pub buffer: usize,
    #[serde(default)]
    pub byte_offset: usize,
    pub byte_length: usize,
    pub byte_stride: Option<usize>,
    pub extensions: Option<Box<Extensions>>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub struct Buffer {
    pub byte_length: usize,
    pub uri: Option<String>,
    pub extensions: Option<Box<Extensions>>,
}

/// Extensions of an object: the content of supported extensions, and the names of all.
#[derive(Default)]
pub struct Extensions {
    pub names: Vec<String>,
    /// Attributes of `EXT_mesh_gpu_instancing`.
    pub instances: Option<Attributes>,
    /// True if `KHR_node_visibility` hides the node.
    pub is_hidden: bool,
}

pub const INSTANCING: &str = "EXT_mesh_gpu_instancing";
pub const VISIBILITY: &str = "KHR_node_visibility";

#[derive(Deserialize)]
struct Instancing {
    #[serde(default)]
    attributes: Attributes,
}

#[derive(Deserialize)]
struct Visibility {
    visible: Option<bool>,
}

impl<'de> Deserialize<'de> for Extensions {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Extensions, D::Error> {
        struct Reader;

        impl<'de> Visitor<'de> for Reader {
            type Value = Extensions;

            fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
                f.write_str("an object of extensions")
            }

            fn visit_map<M: MapAccess<'de>>(self, mut map: M) -> Result<Extensions, M::Error> {
                let mut all = Extensions::default();
                while let Some(name) = map.next_key::<String>()? {
                    match &*name {
                        INSTANCING => {
                            all.instances = Some(map.next_value::<Instancing>()?.attributes);
                        }
                        VISIBILITY => {
                            let visibility: Visibility = map.next_value()?;
                            all.is_hidden = visibility.visible == Some(false);
                        }
                        _ => {
                            map.next_value::<IgnoredAny>()?;
                        }
                    }
                    all.names.push(name);
                }
                Ok(all)
            }
        }

        deserializer.deserialize_map(Reader)
    }
}

/// Returns the names of the extensions of an object.
pub fn names(extensions: Option<&Extensions>) -> &[String] {
    extensions.map_or(&[], |extensions| &extensions.names)
}

pub fn has(extensions: Option<&Extensions>, name: &str) -> bool {
    names(extensions).iter().any(|known| known == name)
}
