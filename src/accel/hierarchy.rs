//! The hierarchy over a mesh: a backend finds the triangle, and what is done in f64
//! around it is the same for all backends.

#[cfg(feature = "embree")]
use super::astray::{Doubt, Doubts};
use super::lanes::Lanes;
#[cfg(feature = "embree")]
use super::lanes::Lanes3;
use super::part_box::PartBox;
#[cfg(feature = "embree")]
use super::part_box::Side;
use super::refine::{nearest_on_triangle, refine};
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

    /// See [`super::Accel::closest`] and [`super::Accel::closest_some`]. `anywhere`: rays
    /// may start inside the part, or else none that matters does.
    pub fn closest(
        &self,
        rays: &[Ray],
        some: u16,
        anywhere: bool,
        wanted: impl Fn(usize, f64) -> bool,
    ) -> [Option<Hit>; WIDTH] {
        let mut hits = [None; WIDTH];
        #[cfg(not(feature = "embree"))]
        let _ = anywhere;
        let lanes = Lanes::new(rays);
        match &self.tree {
            #[cfg(feature = "embree")]
            Tree::Embree(tree) => {
                let wanted = |ray: usize, t: f64| some >> ray & 1 == 1 && wanted(ray, t);
                let inside = match anywhere {
                    true => tree.starting_inside(rays, &self.part) & some,
                    false => 0,
                };
                // By the packets of rays that are traced together.
                let mut doubts: [Doubts; PACKETS] = Default::default();
                let (mut met, mut triangles, mut t_found) = (0u16, [0; WIDTH], [0.0; WIDTH]);
                let mut lost = inside;
                tree.closest(&lanes, some, &self.part, |ray, triangle, t, side| {
                    let doubt = Doubt { ray, triangle, t };
                    lost &= !(1 << ray);
                    if (side == Side::Back) != (inside >> ray & 1 == 1) {
                        doubts[ray / tree.together()].astray.push(doubt);
                    }
                    met |= u16::from(wanted(ray, t)) << ray;
                    (triangles[ray], t_found[ray]) = (triangle, t);
                });
                for ray in (0..rays.len()).filter(|ray| lost >> ray & 1 == 1) {
                    let nothing = Doubt::of_nothing(ray, &rays[ray]);
                    doubts[ray / tree.together()].astray.push(nothing);
                }
                let met = || (0..rays.len()).filter(|ray| met >> ray & 1 == 1);
                // All are read before the first is looked at: a packet waits for memory
                // twice then, and not twice a ray.
                let mut vertices = [[0; 3]; WIDTH];
                for ray in met() {
                    vertices[ray] = self.mesh.triangles[triangles[ray] as usize];
                }
                let mut corners = [Lanes3::ZERO; 3];
                for ray in met() {
                    for (corners, vertex) in corners.iter_mut().zip(vertices[ray]) {
                        corners.set(ray, self.mesh.positions[vertex as usize]);
                    }
                }
                let tolerance = self.part.tolerance();
                let meetings = lanes.meet(&corners, &t_found, tolerance.along);
                for ray in met() {
                    let (triangle, t) = (triangles[ray], t_found[ray]);
                    if let Some(meeting) = meetings.get(ray) {
                        hits[ray] = Some(meeting.hit(triangle));
                        continue;
                    }
                    let corners = corners.map(|corners| corners.get(ray));
                    hits[ray] = refine(&rays[ray], triangle, corners, t, tolerance).hit();
                    let t = hits[ray].map_or(t, |hit: Hit| hit.t);
                    let doubts = &mut doubts[ray / tree.together()];
                    doubts.passed.push(Doubt { ray, triangle, t });
                }
                for doubts in doubts.iter_mut().filter(|doubts| !doubts.is_empty()) {
                    doubts.settle(tree, &self.part, rays, inside, |ray, hit| {
                        hits[ray] = hit.filter(|hit| wanted(ray, hit.t));
                    });
                }
            }
            Tree::Rust(tree) => tree.closest(rays, &lanes, &self.part, |i, triangle, t| {
                if some >> i & 1 == 1 && wanted(i, t) {
                    let corners = self.mesh.triangle(triangle as usize);
                    let tolerance = self.part.final_tolerance();
                    hits[i] = refine(&rays[i], triangle, corners, t, tolerance).hit();
                }
            }),
        }
        hits
    }

    /// See [`super::Accel::occluded`].
    pub fn occluded(&self, rays: &[Ray]) -> u16 {
        let lanes = Lanes::new(rays);
        match &self.tree {
            #[cfg(feature = "embree")]
            Tree::Embree(tree) => tree.occluded(&lanes, &self.part),
            Tree::Rust(tree) => tree.occluded(rays, &lanes, &self.part),
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
