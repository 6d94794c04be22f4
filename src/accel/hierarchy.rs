//! The hierarchy over a mesh: a backend finds the triangle, and what is done in f64
//! around it is the same for all backends.

#[cfg(feature = "embree")]
use super::astray::{Doubt, Doubts};
#[cfg(feature = "embree")]
use super::refine::Refined;
use super::refine::{Tolerance, nearest_on_triangle, refine};
use super::{Face, Hit, Nearest, Ray, WIDTH, rust_bvh};
#[cfg(feature = "embree")]
use super::{embree, embree_device};
use crate::error::Result;
use crate::math::{Aabb, DVec3};
use crate::mesh::{Mesh, Watch, memory};
use glam::Vec3;
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

/// The box around a mesh or an assembly, and what f32 relative to its middle is good for.
#[derive(Debug, Clone, Copy)]
pub(super) struct PartBox {
    pub bounds: Aabb,
    pub center: DVec3,
}

/// The part of a ray inside the box, narrowed to f32.
pub(super) struct Inside {
    /// Where the ray enters, relative to the middle of the box, mm.
    pub origin: Vec3,
    /// Distance from the ray's origin to there, mm.
    pub advanced: f64,
    pub length: f64,
}

impl PartBox {
    pub fn new(bounds: Aabb) -> PartBox {
        PartBox {
            bounds,
            center: bounds.center(),
        }
    }

    /// See [`super::Accel::resolution`].
    pub fn resolution(&self) -> f64 {
        (self.bounds.size() / 2.0).max_element() * 2f64.powi(-20)
    }

    /// How far beside a triangle f32 may take a ray to meet it, mm: some 60 roundings
    /// (2⁻¹⁸ of the half size), and on a plane seen at an angle θ from edge-on 1/sin θ
    /// times as far: down to 1° nothing is left out, and below only what lies beside an
    /// edge.
    #[cfg(feature = "embree")]
    pub fn overshoot(&self) -> f64 {
        self.resolution() * 256.0
    }

    /// See [`super::Accel::refinement`].
    pub fn refinement(&self) -> f64 {
        self.bounds.size().length() * 1e-3
    }

    /// What refinement makes of a hit that f32 reports.
    #[cfg(feature = "embree")]
    pub fn tolerance(&self) -> Tolerance {
        Tolerance {
            along: self.refinement(),
            beside: self.overshoot(),
        }
    }

    /// And of one that f64 reports, which is final.
    pub fn final_tolerance(&self) -> Tolerance {
        Tolerance {
            along: self.refinement(),
            beside: self.resolution(),
        }
    }

    /// Distances between which the ray is inside the box.
    fn interval(&self, ray: &Ray) -> Option<(f64, f64)> {
        let margin = DVec3::splat(2.0 * self.resolution());
        let inverse = ray.direction.recip();
        let near = (self.bounds.min - margin - ray.origin) * inverse;
        let far = (self.bounds.max + margin - ray.origin) * inverse;
        // A ray parallel to a slab and on its very face gives 0·∞ = NaN, which
        // these comparisons pass over. It is on the widened box, so it meets
        // nothing, and kept or dropped is the same. (f64::min and max cost four
        // times as much for what they promise about NaN.)
        let (mut enter, mut leave) = (0.0f64, ray.t_max);
        for axis in 0..3 {
            let (a, b) = (near[axis], far[axis]);
            let (first, last) = if a < b { (a, b) } else { (b, a) };
            enter = if first > enter { first } else { enter };
            leave = if last < leave { last } else { leave };
        }
        (enter <= leave).then_some((enter, leave))
    }

    /// A distance, mm, after which none of the rays from one point is further than an
    /// eighth of the half size before the box, and none past where it enters. `None` if
    /// there is no such distance, or the rays start at different points.
    #[cfg(feature = "embree")]
    pub fn approach(&self, rays: &[Ray]) -> Option<f64> {
        let start = rays.first()?.origin;
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for ray in rays {
            if ray.origin != start {
                return None;
            }
            (low, high) = (low.min(ray.direction), high.max(ray.direction));
        }
        let margin = DVec3::splat(2.0 * self.resolution());
        let (below, above) = (
            self.bounds.min - margin - start,
            start - self.bounds.max - margin,
        );
        // The least and the greatest distance of each axis' plane.
        let (mut nearest, mut furthest) = (0.0f64, 0.0f64);
        for axis in 0..3 {
            let (gap, slow, fast) = match below[axis] > above[axis] {
                true => (below[axis], low[axis], high[axis]),
                false => (above[axis], -high[axis], -low[axis]),
            };
            if gap > 0.0 {
                // A ray that runs past the box never comes to the plane.
                if slow <= 0.0 {
                    return None;
                }
                nearest = nearest.max(gap / fast);
                furthest = furthest.max(gap / slow);
            }
        }
        let half = (self.bounds.size() / 2.0).max_element();
        (furthest - nearest <= half / 8.0).then_some(nearest)
    }

    /// A ray advanced in f64 to the box, so that a long standoff costs no digits.
    pub fn inside(&self, ray: &Ray) -> Option<Inside> {
        let (advanced, leave) = self.interval(ray)?;
        Some(self.advanced(ray, advanced, leave))
    }

    /// The same of a ray that enters after `advanced` mm and leaves after `leave`.
    pub fn advanced(&self, ray: &Ray, advanced: f64, leave: f64) -> Inside {
        Inside {
            origin: (ray.origin + ray.direction * advanced - self.center).as_vec3(),
            advanced,
            length: leave - advanced,
        }
    }
}

/// The side of a triangle that a ray meets: front if its corners are seen in
/// counter-clockwise order.
#[cfg(feature = "embree")]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Side {
    Front,
    Back,
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
