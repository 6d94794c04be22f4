//! The hierarchy over a mesh: a backend finds the triangle, and what is done in f64
//! around it is the same for all backends.

#[cfg(feature = "embree")]
use super::astray::{Doubt, Doubts};
use super::part_box::PartBox;
#[cfg(feature = "embree")]
use super::part_box::Side;
#[cfg(feature = "embree")]
use super::refine::Refined;
use super::refine::{Tolerance, nearest_on_triangle, refine};
use super::{Face, Hit, Nearest, Ray, WIDTH, rust_bvh};
#[cfg(feature = "embree")]
use super::{embree, embree_device};
use crate::error::Result;
use crate::math::DVec3;
use crate::mesh::{Mesh, Watch, memory};
use std::sync::Arc;

/// What finds the triangle a ray meets.
#[derive(
    Debug,
    Clone,
    Copy,
    PartialEq,
    Eq,
    Default,
    serde::Serialize,
    serde::Deserialize,
    schemars::JsonSchema,
)]
#[cfg_attr(feature = "cli", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum Backend {
    /// Embree, in f32
    #[cfg(feature = "embree")]
    #[default]
    Embree,
    /// Pure Rust, in f64: slower, and without a miss at edges and vertices
    #[cfg_attr(not(feature = "embree"), default)]
    Rust,
}

impl Backend {
    /// Those that are built in.
    pub const ALL: &[Backend] = &[
        #[cfg(feature = "embree")]
        Backend::Embree,
        Backend::Rust,
    ];

    /// Most memory a triangle takes while the hierarchy is built, bytes.
    pub fn build_bytes(self) -> u64 {
        match self {
            #[cfg(feature = "embree")]
            Backend::Embree => embree::BUILD,
            Backend::Rust => rust_bvh::BUILD,
        }
    }

    /// Name and version of the library behind it, for manifests.
    pub fn version(self) -> String {
        match self {
            #[cfg(feature = "embree")]
            Backend::Embree => format!("Embree {}", embree_device::version()),
            Backend::Rust => format!("Rust, on obvhs {}", rust_bvh::OBVHS),
        }
    }
}

/// Packets that 16 rays may be traced in.
#[cfg(feature = "embree")]
const PACKETS: usize = 2;

enum Tree {
    #[cfg(feature = "embree")]
    Embree(embree::Tree),
    Rust(rust_bvh::Tree),
}

/// Bounding-volume hierarchy over one mesh, in the mesh's own frame.
pub(super) struct Hierarchy {
    mesh: Arc<Mesh>,
    part: PartBox,
    tree: Tree,
}

impl Hierarchy {
    /// See [`super::Accel::build_with`].
    pub fn build(
        backend: Backend,
        mesh: &Arc<Mesh>,
        threads: usize,
        watch: &Watch,
    ) -> Result<Hierarchy> {
        let (count, bytes) = (mesh.triangles.len() as u64, backend.build_bytes());
        let work = format!("building the hierarchy over {count} triangles at {bytes} bytes each");
        memory::require(work, count * bytes, memory::available())?;
        let part = PartBox::new(mesh.bounds());
        #[cfg(not(feature = "embree"))]
        let _ = threads;
        let tree = match backend {
            #[cfg(feature = "embree")]
            Backend::Embree => Tree::Embree(embree::Tree::build(mesh, &part, threads, watch)?),
            Backend::Rust => Tree::Rust(rust_bvh::Tree::build(mesh, &part)),
        };
        watch(1.0)?;
        Ok(Hierarchy {
            mesh: mesh.clone(),
            part,
            tree,
        })
    }

    pub fn mesh(&self) -> &Arc<Mesh> {
        &self.mesh
    }

    pub fn part(&self) -> &PartBox {
        &self.part
    }

    /// See [`super::Accel::closest`] and [`super::Accel::closest_some`].
    pub fn closest(
        &self,
        rays: &[Ray],
        some: u16,
        wanted: impl Fn(usize, f64) -> bool,
    ) -> [Option<Hit>; WIDTH] {
        let mut hits = [None; WIDTH];
        let refined = |i: usize, triangle: u32, t: f64, tolerance: Tolerance| {
            let corners = self.mesh.triangle(triangle as usize);
            refine(&rays[i], triangle, corners, t, tolerance)
        };
        match &self.tree {
            #[cfg(feature = "embree")]
            Tree::Embree(tree) => {
                let wanted = |ray: usize, t: f64| some >> ray & 1 == 1 && wanted(ray, t);
                // By the packets of rays that are traced together.
                let mut doubts: [Doubts; PACKETS] = Default::default();
                tree.closest(rays, some, &self.part, |ray, triangle, t, side| {
                    let doubts = &mut doubts[ray / tree.together()];
                    if side == Side::Back {
                        doubts.backs.push(Doubt { ray, triangle, t });
                    }
                    if !wanted(ray, t) {
                        return;
                    }
                    let refined = refined(ray, triangle, t, self.part.tolerance());
                    hits[ray] = refined.hit();
                    if !matches!(refined, Refined::On(_)) {
                        let t = hits[ray].map_or(t, |hit: Hit| hit.t);
                        doubts.passed.push(Doubt { ray, triangle, t });
                    }
                });
                for doubts in doubts.into_iter().filter(|doubts| !doubts.is_empty()) {
                    doubts.settle(tree, &self.part, rays, |ray, hit| {
                        hits[ray] = hit.filter(|hit| wanted(ray, hit.t));
                    });
                }
            }
            Tree::Rust(tree) => tree.closest(rays, &self.part, |i, triangle, t| {
                if some >> i & 1 == 1 && wanted(i, t) {
                    hits[i] = refined(i, triangle, t, self.part.final_tolerance()).hit();
                }
            }),
        }
        hits
    }

    /// See [`super::Accel::occluded`].
    pub fn occluded(&self, rays: &[Ray]) -> u16 {
        match &self.tree {
            #[cfg(feature = "embree")]
            Tree::Embree(tree) => tree.occluded(rays, &self.part),
            Tree::Rust(tree) => tree.occluded(rays, &self.part),
        }
    }

    /// The point of the mesh nearest to `p`, if it is nearer than `best`; of several,
    /// that of the first triangle.
    pub fn nearest(&self, p: DVec3, best: Nearest) -> Nearest {
        match &self.tree {
            #[cfg(feature = "embree")]
            Tree::Embree(tree) => tree.nearest(p, &self.part, best),
            Tree::Rust(tree) => tree.nearest(p, &self.part, best),
        }
    }

    /// Its point nearest to `p` on one triangle.
    pub fn nearest_on(&self, triangle: u32, p: DVec3) -> Nearest {
        let point = nearest_on_triangle(self.mesh.triangle(triangle as usize), p);
        Nearest {
            face: Face::of_mesh(triangle),
            point,
            distance: point.distance(p),
        }
    }
}

#[cfg(test)]
#[path = "hierarchy_tests.rs"]
pub(super) mod tests;
