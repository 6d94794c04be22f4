//! Triangle sides grouped by the lower of their two vertices, which brings together all sides of an
//! edge.

use super::Mesh;
use rayon::prelude::*;
use smallvec::SmallVec;

/// Side of a triangle.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct HalfEdge {
    /// Higher of the two vertex indices.
    pub higher: u32,
    pub triangle: u32,
    /// Corner of the triangle at which the side starts; it ends at the next corner.
    pub corner: u32,
}

/// Sides with a common lower vertex, sorted by the higher one.
#[derive(Debug, Default)]
pub(super) struct VertexEdges {
    /// Sides that run to the higher vertex.
    pub ups: SmallVec<[HalfEdge; 16]>,
    /// Sides that come from the higher vertex.
    pub downs: SmallVec<[HalfEdge; 16]>,
}

/// Triangles at each vertex. A triangle is omitted at its highest vertex.
///
/// A triangle with a repeated vertex has no sides and is omitted. Uses 12 bytes per triangle.
struct Stars<'m> {
    mesh: &'m Mesh,
    /// Start of the triangles of each vertex in `triangles`, and the end.
    starts: Vec<usize>,
    triangles: Vec<u32>,
}

impl Stars<'_> {
    fn new(mesh: &Mesh) -> Stars<'_> {
        let mut starts = vec![0; mesh.positions.len() + 1];
        for vertex in mesh.triangles.iter().flat_map(lower_two) {
            starts[vertex as usize + 1] += 1;
        }
        for vertex in 0..mesh.positions.len() {
            starts[vertex + 1] += starts[vertex];
        }
        let mut triangles = vec![0; starts[mesh.positions.len()]];
        let mut next = starts.clone();
        for (triangle, number) in mesh.triangles.iter().zip(0..) {
            for vertex in lower_two(triangle) {
                let next = &mut next[vertex as usize];
                triangles[*next] = number;
                *next += 1;
            }
        }
        Stars {
            mesh,
            starts,
            triangles,
        }
    }

    fn fill(&self, vertex: u32, star: &mut VertexEdges) {
        star.ups.clear();
        star.downs.clear();
        let v = vertex as usize;
        for &triangle in &self.triangles[self.starts[v]..self.starts[v + 1]] {
            let corners = self.mesh.triangles[triangle as usize];
            for corner in 0..3 {
                let (from, to) = (corners[corner], corners[(corner + 1) % 3]);
                let side = |higher| HalfEdge {
                    higher,
                    triangle,
                    corner: corner as u32,
                };
                match from.min(to) == vertex {
                    true if from == vertex => star.ups.push(side(to)),
                    true => star.downs.push(side(from)),
                    false => {}
                }
            }
        }
        star.ups.sort_unstable();
        star.downs.sort_unstable();
    }
}

/// Returns the lower two vertices of a triangle, if it has three distinct vertices.
fn lower_two(&[a, b, c]: &[u32; 3]) -> impl Iterator<Item = u32> + use<> {
    let three = a != b && b != c && c != a;
    let highest = a.max(b).max(c);
    [a, b, c]
        .into_iter()
        .filter(move |&vertex| three && vertex != highest)
}

/// Applies `of` to the star of each vertex.
pub(super) fn of_all<'m, T: Send>(
    mesh: &'m Mesh,
    of: impl Fn(&VertexEdges) -> T + Sync + Send + 'm,
) -> impl ParallelIterator<Item = T> + 'm {
    let stars = Stars::new(mesh);
    let vertices = (0..mesh.positions.len() as u32).into_par_iter();
    vertices.map_init(VertexEdges::default, move |star, vertex| {
        stars.fill(vertex, star);
        of(star)
    })
}
