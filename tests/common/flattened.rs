//! An assembly without copies: the oracle of one with them.

use lasertrace::math::Rigid;
use lasertrace::mesh::Mesh;

/// All copies of a mesh as one.
pub fn flattened(mesh: &Mesh, poses: &[Rigid]) -> Mesh {
    let vertices = mesh.positions.len() as u32;
    let places = poses
        .iter()
        .flat_map(|pose| mesh.positions.iter().map(|&p| pose.point(p)));
    let numbers = (0..poses.len() as u32).flat_map(|copy| {
        let triangles = mesh.triangles.iter();
        triangles.map(move |t| t.map(|v| v + copy * vertices))
    });
    Mesh {
        positions: places.collect(),
        triangles: numbers.collect(),
    }
}
