//! Hierarchy over a mesh. A backend finds the triangle; the refinement in f64 is common to all
//! backends.

#[cfg(feature = "embree")]
use super::edge_repair::{AmbiguousHit, AmbiguousHits};
use super::packet_soa::{Lane, Lanes3, RayPacketSoA};
#[cfg(feature = "embree")]
use super::part_bounds::Facing;
use super::part_bounds::PartBounds;
use super::prefetch::prefetch;
use super::refine::{nearest_on_triangle, refine};
use super::{Hit, Nearest, Ray, TriangleId, WIDTH, rust_bvh};
#[cfg(feature = "embree")]
use super::{embree, embree_device};
use crate::error::{Error, Result};
use crate::math::DVec3;
use crate::mesh::{Mesh, ProgressFn, memory};
use std::sync::Arc;
#[cfg(feature = "embree")]
use std::sync::OnceLock;

/// Backend that finds the triangle hit by a ray.
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
    /// Backends that are compiled in.
    pub const ALL: &[Backend] = &[
        #[cfg(feature = "embree")]
        Backend::Embree,
        Backend::Rust,
    ];

    /// Returns the peak memory per triangle while the hierarchy is built, bytes.
    pub fn build_bytes(self) -> u64 {
        match self {
            #[cfg(feature = "embree")]
            Backend::Embree => embree::BUILD,
            Backend::Rust => rust_bvh::BUILD,
        }
    }

    /// Returns the name and version of the underlying library, for manifests.
    pub fn version(self) -> String {
        match self {
            #[cfg(feature = "embree")]
            Backend::Embree => format!("Embree {}", embree_device::version()),
            Backend::Rust => format!("Rust, on obvhs {}", rust_bvh::OBVHS),
        }
    }
}

/// Largest move of a vertex for a refit, as a fraction of the largest side of the part.
const REFIT_LIMIT: f64 = 0.05;

enum Tree {
    #[cfg(feature = "embree")]
    Embree(embree::EmbreeScene),
    Rust(rust_bvh::RustBvh),
}

/// Bounding volume hierarchy over one mesh, in the frame of the mesh.
pub(super) struct Hierarchy {
    mesh: Arc<Mesh>,
    /// Mesh for which the hierarchy was built. Embree reads its triangles after a refit, too.
    built: Arc<Mesh>,
    part: PartBounds,
    tree: Tree,
    /// Hierarchy that visits all triangles along a ray if `tree` is Embree; built at the first use.
    #[cfg(feature = "embree")]
    exhaustive: OnceLock<rust_bvh::RustBvh>,
}

/// Hits of a packet as reported by the backend, before refinement. Sets of rays are bit masks.
#[derive(Default)]
pub(super) struct PacketCandidates {
    lanes: RayPacketSoA,
    /// Rays that are requested.
    some: u16,
    /// Requested rays that start inside the mesh.
    inside: u16,
    /// Rays with a hit, and rays that hit the back of a triangle.
    met: u16,
    backs: u16,
    /// Requested rays with a wanted hit.
    wanted: u16,
    triangles: [u32; WIDTH],
    t: Lane,
    /// Vertex indices of the triangles of wanted hits, set by `fetch`.
    vertices: [[u32; 3]; WIDTH],
}

#[cfg(feature = "embree")]
impl PacketCandidates {
    /// Returns the rays that hit the side of a triangle that cannot be their first hit.
    fn astray(&self) -> u16 {
        self.met & (self.backs ^ self.inside)
    }

    /// Returns the rays that should hit the mesh but hit nothing.
    fn lost(&self) -> u16 {
        self.inside & !self.met
    }
}

/// Iterates over the indices of the set bits.
#[inline(always)]
fn rays_of(mut bits: u16) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let ray = bits.trailing_zeros() as usize;
        (bits != 0).then(|| {
            bits &= bits - 1;
            ray
        })
    })
}

/// Refuses to build a hierarchy for which memory is insufficient.
fn require_memory(backend: Backend, mesh: &Mesh) -> Result<()> {
    let (count, bytes) = (mesh.triangles.len() as u64, backend.build_bytes());
    let work = format!("building the hierarchy over {count} triangles at {bytes} bytes each");
    memory::require(work, count * bytes, memory::available())
}

impl Hierarchy {
    /// Builds the hierarchy; see [`super::Accel::build_with`].
    pub fn build(
        backend: Backend,
        mesh: &Arc<Mesh>,
        threads: usize,
        watch: &ProgressFn,
    ) -> Result<Hierarchy> {
        require_memory(backend, mesh)?;
        let part = PartBounds::new(mesh.bounds());
        #[cfg(not(feature = "embree"))]
        let _ = threads;
        let tree = match backend {
            #[cfg(feature = "embree")]
            Backend::Embree => {
                Tree::Embree(embree::EmbreeScene::build(mesh, &part, threads, watch)?)
            }
            Backend::Rust => Tree::Rust(rust_bvh::RustBvh::build(mesh, &part)),
        };
        watch(1.0)?;
        Ok(Hierarchy {
            mesh: mesh.clone(),
            built: mesh.clone(),
            part,
            tree,
            #[cfg(feature = "embree")]
            exhaustive: OnceLock::new(),
        })
    }

    /// Builds the hierarchy for [`Self::along`] if there is none. Returns `Error::Memory` if memory
    /// is insufficient.
    pub fn prepare_along(&self) -> Result<()> {
        #[cfg(feature = "embree")]
        if let Tree::Embree(_) = self.tree
            && self.exhaustive.get().is_none()
        {
            require_memory(Backend::Rust, &self.mesh)?;
            let built = rust_bvh::RustBvh::build(&self.mesh, &self.part);
            // Another thread may have built it meanwhile. No lock is held during the build, because
            // a worker thread that waits for a part of it may run a task that needs the lock.
            let _ = self.exhaustive.set(built);
        }
        Ok(())
    }

    /// Calls `visit` with every triangle that a ray may cross up to its `t_max`, after
    /// [`Self::prepare_along`].
    pub fn along(&self, ray: &Ray, visit: impl FnMut(u32)) {
        // Without Embree, one variant is left.
        #[allow(clippy::infallible_destructuring_match)]
        let tree = match &self.tree {
            #[cfg(feature = "embree")]
            Tree::Embree(_) => self.exhaustive.get().expect("prepare_along was called"),
            Tree::Rust(tree) => tree,
        };
        tree.along(ray, &self.part, visit);
    }

    /// Adapts the hierarchy to moved vertices; see [`super::Accel::refit`]. `positions` are valid
    /// and as many as before.
    pub fn refit(mut self, positions: Vec<DVec3>) -> Result<Hierarchy> {
        let size = self.built.bounds().size().max_element();
        let limit = REFIT_LIMIT * size;
        let mut moved = positions.iter().zip(&self.built.positions);
        if let Some(vertex) = moved.position(|(to, from)| to.distance(*from) > limit) {
            return Err(Error::Usage(format!(
                "vertex {vertex} moved by {} mm since the hierarchy was built, expected at most \
                 {limit} mm, 5 % of the part; build a new hierarchy",
                positions[vertex].distance(self.built.positions[vertex])
            )));
        }
        let mesh = Arc::new(Mesh {
            positions,
            triangles: self.mesh.triangles.clone(),
        });
        self.part = PartBounds::new(mesh.bounds());
        match &mut self.tree {
            #[cfg(feature = "embree")]
            Tree::Embree(tree) => {
                tree.refit(&mesh, &self.part)?;
                if let Some(tree) = self.exhaustive.get_mut() {
                    tree.refit(&mesh, &self.part);
                }
            }
            Tree::Rust(tree) => tree.refit(&mesh, &self.part),
        }
        self.mesh = mesh;
        Ok(self)
    }

    pub fn mesh(&self) -> &Arc<Mesh> {
        &self.mesh
    }

    pub fn part(&self) -> &PartBounds {
        &self.part
    }

    /// Returns the hits as [`super::Accel::closest`] and [`super::Accel::closest_some`] do. If
    /// `anywhere` is false, the requested rays must start outside the part.
    pub fn closest(
        &self,
        rays: &[Ray],
        some: u16,
        anywhere: bool,
        wanted: impl Fn(usize, f64) -> bool,
    ) -> [Option<Hit>; WIDTH] {
        let mut found = PacketCandidates::default();
        self.find(rays, some, anywhere, &wanted, &mut found);
        self.prefetch(&mut found);
        self.refine_hits(&found, wanted)
    }

    /// Finds the `wanted` hits of the backend, as input for [`Self::prefetch`] and then
    /// [`Self::refine_hits`]. Prefetches the memory that [`Self::prefetch`] reads.
    #[inline(always)]
    pub fn find(
        &self,
        rays: &[Ray],
        some: u16,
        anywhere: bool,
        wanted: impl Fn(usize, f64) -> bool,
        found: &mut PacketCandidates,
    ) {
        found.lanes.set(rays);
        (found.some, found.inside) = (some, 0);
        (found.met, found.backs, found.wanted) = (0, 0, 0);
        let PacketCandidates {
            lanes,
            met,
            backs,
            triangles,
            t: t_found,
            ..
        } = found;
        let meets = |ray: usize, triangle: u32, t: f64| {
            prefetch(&self.mesh.triangles, triangle);
            *met |= 1 << ray;
            (triangles[ray], t_found[ray]) = (triangle, t);
        };
        match &self.tree {
            #[cfg(feature = "embree")]
            Tree::Embree(tree) => {
                let mut meets = meets;
                tree.closest(lanes, some, &self.part, |ray, triangle, t, side| {
                    meets(ray, triangle, t);
                    *backs |= u16::from(side == Facing::Back) << ray;
                });
                if anywhere {
                    found.inside = tree.starting_inside(rays, &self.part) & some;
                }
            }
            Tree::Rust(tree) => tree.closest(rays, lanes, &self.part, meets),
        }
        #[cfg(not(feature = "embree"))]
        let _ = (anywhere, backs);
        for ray in rays_of(found.met & some) {
            found.wanted |= u16::from(wanted(ray, found.t[ray])) << ray;
        }
    }

    /// Reads the vertex indices of the triangles and prefetches the vertices, so that
    /// [`Self::refine_hits`] does not wait for them.
    #[inline(always)]
    pub fn prefetch(&self, found: &mut PacketCandidates) {
        for ray in rays_of(found.wanted) {
            let vertices = self.mesh.triangles[found.triangles[ray] as usize];
            found.vertices[ray] = vertices;
            for vertex in vertices {
                prefetch(&self.mesh.positions, vertex);
            }
        }
    }

    /// Returns the hits, refined in f64.
    #[inline(always)]
    pub fn refine_hits(
        &self,
        found: &PacketCandidates,
        wanted: impl Fn(usize, f64) -> bool,
    ) -> [Option<Hit>; WIDTH] {
        let mut hits = [None; WIDTH];
        let mut corners = [Lanes3::ZERO; 3];
        for ray in rays_of(found.wanted) {
            for (corners, vertex) in corners.iter_mut().zip(found.vertices[ray]) {
                corners.set(ray, self.mesh.positions[vertex as usize]);
            }
        }
        let tolerance = match &self.tree {
            #[cfg(feature = "embree")]
            Tree::Embree(_) => self.part.tolerance(),
            Tree::Rust(_) => self.part.final_tolerance(),
        };
        let meetings = found
            .lanes
            .intersect_plane(&corners, &found.t, tolerance.depth_mm);
        let mut passed = 0;
        for ray in rays_of(found.wanted) {
            let (triangle, t) = (found.triangles[ray], found.t[ray]);
            hits[ray] = match meetings.get(ray) {
                Some(meeting) => Some(meeting.hit(triangle)),
                None => {
                    passed |= 1 << ray;
                    let corners = corners.map(|corners| corners.get(ray));
                    refine(&found.lanes.ray(ray), triangle, corners, t, tolerance).hit()
                }
            };
        }
        #[cfg(feature = "embree")]
        if let Tree::Embree(tree) = &self.tree
            && passed | found.astray() | found.lost() != 0
        {
            self.settle_doubts(tree, found, passed, &mut hits, wanted);
        }
        #[cfg(not(feature = "embree"))]
        let _ = (passed, wanted);
        hits
    }

    /// Resolves ambiguous f32 results, for each group of rays that were traced together.
    #[cfg(feature = "embree")]
    #[cold]
    fn settle_doubts(
        &self,
        tree: &embree::EmbreeScene,
        found: &PacketCandidates,
        passed: u16,
        hits: &mut [Option<Hit>; WIDTH],
        wanted: impl Fn(usize, f64) -> bool,
    ) {
        let rays: [Ray; WIDTH] = std::array::from_fn(|i| found.lanes.ray(i));
        for first in (0..WIDTH).step_by(tree.together()) {
            let here = u16::MAX >> (WIDTH - tree.together()) << first;
            let doubt = |ray| AmbiguousHit {
                ray,
                triangle: found.triangles[ray],
                t: found.t[ray],
            };
            let in_f64 = |ray: usize| AmbiguousHit {
                t: hits[ray].map_or(found.t[ray], |hit| hit.t),
                ..doubt(ray)
            };
            let nothing = rays_of(found.lost() & here);
            let nothing = nothing.map(|ray| AmbiguousHit::of_nothing(ray, &rays[ray]));
            let mut doubts = AmbiguousHits {
                missed_in_f64: rays_of(passed & here).map(in_f64).collect(),
                ambiguous_backfaces: rays_of(found.astray() & here)
                    .map(doubt)
                    .chain(nothing)
                    .collect(),
            };
            if !doubts.is_empty() {
                doubts.refine_hits(tree, &self.part, &rays, found.inside, |ray, hit| {
                    hits[ray] = hit.filter(|hit| found.some >> ray & 1 == 1 && wanted(ray, hit.t));
                });
            }
        }
    }

    /// Returns the occluded rays; see [`super::Accel::occluded`].
    pub fn occluded(&self, rays: &[Ray]) -> u16 {
        let lanes = RayPacketSoA::new(rays);
        match &self.tree {
            #[cfg(feature = "embree")]
            Tree::Embree(tree) => tree.occluded(&lanes, &self.part),
            Tree::Rust(tree) => tree.occluded(rays, &lanes, &self.part),
        }
    }

    /// Returns the point of the mesh nearest to `p` if it is nearer than `best`, and `best`
    /// otherwise. On equal distances, the first triangle is returned.
    pub fn nearest(&self, p: DVec3, best: Nearest) -> Nearest {
        match &self.tree {
            #[cfg(feature = "embree")]
            Tree::Embree(tree) => tree.nearest(p, &self.part, best),
            Tree::Rust(tree) => tree.nearest(p, &self.part, best),
        }
    }

    /// Returns the point of one triangle nearest to `p`.
    pub fn nearest_on(&self, triangle: u32, p: DVec3) -> Nearest {
        let point = nearest_on_triangle(self.mesh.triangle(triangle as usize), p);
        Nearest {
            face: TriangleId::of_mesh(triangle),
            point,
            distance: point.distance(p),
        }
    }
}

#[cfg(test)]
#[path = "hierarchy_tests.rs"]
pub(super) mod tests;
