//! Vertex positions of a glTF primitive: morph targets, skins and instances.

use super::accessors::{FLOATS, File, JOINTS, POSITIONS, ROTATIONS, WEIGHTS};
use super::document::{Attributes, Node, OfMesh, Primitive};
use crate::error::Error;
use crate::math::DVec3;
use glam::{DAffine3, DMat3, DMat4, DQuat};

impl File<'_> {
    /// Returns the instance poses of a node by `EXT_mesh_gpu_instancing`, in the frame of the node.
    /// Without the extension, returns one identity pose.
    pub fn copies(&self, node: &Node) -> Result<Vec<DAffine3>, Error> {
        let extensions = node.extensions.as_deref();
        let Some(attributes) = extensions.and_then(|all| all.instances.as_ref()) else {
            return Ok(vec![DAffine3::IDENTITY]);
        };
        let count = self.number_of_copies(attributes)?;
        let scale = self.of_copies(attributes, "SCALE", FLOATS, [1.0; 3], count)?;
        let turn = self.of_copies(
            attributes,
            "ROTATION",
            ROTATIONS,
            [0.0, 0.0, 0.0, 1.0],
            count,
        )?;
        let by = self.of_copies(attributes, "TRANSLATION", FLOATS, [0.0; 3], count)?;
        let pose = |i: usize| {
            let turn = DQuat::from_array(turn[i]).normalize();
            let [scale, by] = [scale[i], by[i]].map(DVec3::from_array);
            DAffine3::from_scale_rotation_translation(scale, turn, by)
        };
        Ok((0..count).map(pose).collect())
    }

    /// Returns the number of instances, on which all attributes must agree.
    pub fn number_of_copies(&self, attributes: &Attributes) -> Result<usize, Error> {
        let mut count = None;
        for (name, &accessor) in attributes {
            let this = self.accessor(accessor)?.count;
            if *count.get_or_insert(this) != this {
                let found = format!("{this} elements of {name} for copies of a mesh");
                return Err(self.wrong(found, "as many of each attribute"));
            }
        }
        Ok(count.unwrap_or(0))
    }

    fn of_copies<const N: usize>(
        &self,
        attributes: &Attributes,
        name: &str,
        kinds: &[super::accessors::Component],
        usual: [f64; N],
        count: usize,
    ) -> Result<Vec<[f64; N]>, Error> {
        match attributes.get(name) {
            Some(&accessor) => self.vectors(accessor, kinds, name),
            None => Ok(vec![usual; count]),
        }
    }

    /// Moves vertices by the morph targets with nonzero weights.
    pub fn morph(
        &self,
        (node, mesh, primitive): (&Node, &OfMesh, &Primitive),
        positions: &mut [DVec3],
    ) -> Result<(), Error> {
        let weights = node.weights.as_ref().or(mesh.weights.as_ref());
        let weights = weights.map_or(&[][..], |weights| weights);
        let targets = &primitive.targets;
        let surplus = weights
            .get(targets.len()..)
            .is_some_and(|w| w.iter().any(|&w| w != 0.0));
        if surplus {
            let found = format!(
                "{} weights of {} morph targets",
                weights.len(),
                targets.len()
            );
            return Err(self.wrong(found, "a weight for each target"));
        }
        for (target, &weight) in targets.iter().zip(weights) {
            let Some(&accessor) = target.get("POSITION").filter(|_| weight != 0.0) else {
                continue;
            };
            let ways = self.vectors::<3>(accessor, POSITIONS, "a morph target")?;
            if ways.len() != positions.len() {
                let found = format!("a morph target of {} vertices", ways.len());
                return Err(self.wrong(found, &format!("{}, as the mesh has", positions.len())));
            }
            for (position, way) in positions.iter_mut().zip(ways) {
                *position += weight * DVec3::from_array(way);
            }
        }
        Ok(())
    }

    /// Returns the transform scene_from_node of every node. It is `None` for ambiguous nodes, which
    /// have two parents or belong to a cycle.
    pub fn globals(&self) -> Result<Vec<Option<DAffine3>>, Error> {
        let nodes = &self.document.nodes;
        let mut parents = vec![0u8; nodes.len()];
        for &child in nodes.iter().flat_map(|node| &node.children) {
            self.get(nodes, child, "node")?;
            parents[child] = parents[child].saturating_add(1);
        }
        let mut globals = vec![None; nodes.len()];
        let roots = (0..nodes.len()).filter(|&node| parents[node] == 0);
        let mut next: Vec<_> = roots.map(|root| (root, DAffine3::IDENTITY)).collect();
        while let Some((number, scene_from_parent)) = next.pop() {
            let scene_from_node = scene_from_parent * nodes[number].pose();
            globals[number] = Some(scene_from_node);
            let children = nodes[number].children.iter();
            let once = children.filter(|&&child| parents[child] == 1);
            next.extend(once.map(|&child| (child, scene_from_node)));
        }
        Ok(globals)
    }

    /// Moves vertices by the joints of a skin in their stored pose. Returns, per vertex, whether
    /// the joints mirror the surface.
    ///
    /// The pose of the node itself is ignored, as the format requires.
    pub fn skin(
        &self,
        skin: usize,
        primitive: &Primitive,
        globals: &[Option<DAffine3>],
        positions: &mut [DVec3],
    ) -> Result<Vec<bool>, Error> {
        let bones = self.bones(skin, globals)?;
        let count = positions.len();
        let mut sums = vec![(DMat3::ZERO, DVec3::ZERO, 0.0); count];
        for set in 0.. {
            let of = |name: &str| primitive.attributes.get(&format!("{name}_{set}")).copied();
            let (Some(joints), Some(weights)) = (of("JOINTS"), of("WEIGHTS")) else {
                break;
            };
            let joints = self.vectors::<4>(joints, JOINTS, "joints")?;
            let weights = self.vectors::<4>(weights, WEIGHTS, "weights")?;
            if [joints.len(), weights.len()] != [count; 2] {
                let found = format!("{} joints and {} weights", joints.len(), weights.len());
                return Err(self.wrong(found, &format!("{count} of each, as vertices")));
            }
            for ((sum, joints), weights) in sums.iter_mut().zip(joints).zip(weights) {
                for (joint, weight) in joints.into_iter().zip(weights) {
                    if weight == 0.0 {
                        continue;
                    }
                    let Some(bone) = bones.get(joint as usize) else {
                        let found = format!("joint {joint} of a skin of {}", bones.len());
                        return Err(self.wrong(found, "a number below that"));
                    };
                    sum.0 += bone.matrix3 * weight;
                    sum.1 += bone.translation * weight;
                    sum.2 += weight;
                }
            }
        }
        let mut mirrored = Vec::with_capacity(count);
        for (i, (position, (turn, by, weight))) in positions.iter_mut().zip(sums).enumerate() {
            if weight.is_nan() || weight <= 0.0 {
                let found = format!("vertex {i} of a skin whose weights have the sum {weight}");
                return Err(self.wrong(found, "a sum of 1"));
            }
            *position = (turn * *position + by) / weight;
            mirrored.push(turn.determinant() < 0.0);
        }
        Ok(mirrored)
    }

    /// Returns the transform scene_from_bind of each joint of a skin.
    fn bones(&self, number: usize, globals: &[Option<DAffine3>]) -> Result<Vec<DAffine3>, Error> {
        let skin = self.get(&self.document.skins, number, "skin")?;
        let inverse = match skin.inverse_bind_matrices {
            Some(accessor) => self.vectors::<16>(accessor, FLOATS, "inverse bind matrices")?,
            None => vec![DMat4::IDENTITY.to_cols_array(); skin.joints.len()],
        };
        if inverse.len() < skin.joints.len() {
            let found = format!("{} inverse bind matrices", inverse.len());
            return Err(self.wrong(found, &format!("{}, as joints", skin.joints.len())));
        }
        let bone = |(&joint, inverse): (&usize, &[f64; 16])| {
            self.get(&self.document.nodes, joint, "node")?;
            let Some(scene_from_joint) = globals[joint] else {
                let found = format!("joint {joint} of skin {number} with two parents");
                return Err(self.wrong(found, "nodes that are a tree"));
            };
            let joint_from_bind = DAffine3::from_mat4(DMat4::from_cols_array(inverse));
            Ok(scene_from_joint * joint_from_bind)
        };
        skin.joints.iter().zip(&inverse).map(bone).collect()
    }
}
