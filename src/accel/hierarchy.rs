//! The hierarchy over a mesh: a backend finds the triangle, and what is done in f64
//! around it is the same for all backends.

use super::ask_for::ask_for;
#[cfg(feature = "embree")]
use super::astray::{Doubt, Doubts};
use super::lanes::{Lane, Lanes, Lanes3};
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

/// What a backend says that the rays of a packet meet. Rays are bits.
#[derive(Default)]
pub(super) struct Unsettled {
    lanes: Lanes,
    /// Those that are asked for.
    some: u16,
    /// Those of these that start inside the mesh.
    inside: u16,
    /// Those that meet something, and those of these that meet the back of a triangle.
    met: u16,
    backs: u16,
    /// Those that are asked for and meet something wanted.
    wanted: u16,
    triangles: [u32; WIDTH],
    t: Lane,
    /// Of the triangles of those that are wanted, once they are read.
    vertices: [[u32; 3]; WIDTH],
}

#[cfg(feature = "embree")]
impl Unsettled {
    /// Rays that meet the side of a triangle which cannot be the first they meet.
    fn astray(&self) -> u16 {
        self.met & (self.backs ^ self.inside)
    }

    /// Rays that meet nothing and should.
    fn lost(&self) -> u16 {
        self.inside & !self.met
    }
}

/// The rays of the set bits.
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
        let mut found = Unsettled::default();
        self.find(rays, some, anywhere, &wanted, &mut found);
        self.fetch(&mut found);
        self.settle(&found, wanted)
    }

    /// What the backend says that rays meet, of those that are `wanted`, for [`Self::fetch`] and then
    /// [`Self::settle`]. Memory that the one reads has been asked for.
    #[inline(always)]
    pub fn find(
        &self,
        rays: &[Ray],
        some: u16,
        anywhere: bool,
        wanted: impl Fn(usize, f64) -> bool,
        found: &mut Unsettled,
    ) {
        found.lanes.set(rays);
        (found.some, found.inside) = (some, 0);
        (found.met, found.backs, found.wanted) = (0, 0, 0);
        let Unsettled {
            lanes,
            met,
            backs,
            triangles,
            t: t_found,
            ..
        } = found;
        let meets = |ray: usize, triangle: u32, t: f64| {
            ask_for(&self.mesh.triangles, triangle);
            *met |= 1 << ray;
            (triangles[ray], t_found[ray]) = (triangle, t);
        };
        match &self.tree {
            #[cfg(feature = "embree")]
            Tree::Embree(tree) => {
                let mut meets = meets;
                tree.closest(lanes, some, &self.part, |ray, triangle, t, side| {
                    meets(ray, triangle, t);
                    *backs |= u16::from(side == Side::Back) << ray;
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

    /// Reads which vertices the triangles have, and asks for the memory in which they are, so that
    /// [`Self::settle`] need not wait for it.
    #[inline(always)]
    pub fn fetch(&self, found: &mut Unsettled) {
        for ray in rays_of(found.wanted) {
            let vertices = self.mesh.triangles[found.triangles[ray] as usize];
            found.vertices[ray] = vertices;
            for vertex in vertices {
                ask_for(&self.mesh.positions, vertex);
            }
        }
    }

    /// What was found, in f64.
    #[inline(always)]
    pub fn settle(
        &self,
        found: &Unsettled,
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
        let meetings = found.lanes.meet(&corners, &found.t, tolerance.along);
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

    /// Settles what f32 leaves in doubt, by the packets of rays that were traced together.
    #[cfg(feature = "embree")]
    #[cold]
    fn settle_doubts(
        &self,
        tree: &embree::Tree,
        found: &Unsettled,
        passed: u16,
        hits: &mut [Option<Hit>; WIDTH],
        wanted: impl Fn(usize, f64) -> bool,
    ) {
        let rays: [Ray; WIDTH] = std::array::from_fn(|i| found.lanes.ray(i));
        for first in (0..WIDTH).step_by(tree.together()) {
            let here = u16::MAX >> (WIDTH - tree.together()) << first;
            let doubt = |ray| Doubt {
                ray,
                triangle: found.triangles[ray],
                t: found.t[ray],
            };
            let in_f64 = |ray: usize| Doubt {
                t: hits[ray].map_or(found.t[ray], |hit| hit.t),
                ..doubt(ray)
            };
            let nothing = rays_of(found.lost() & here);
            let nothing = nothing.map(|ray| Doubt::of_nothing(ray, &rays[ray]));
            let mut doubts = Doubts {
                passed: rays_of(passed & here).map(in_f64).collect(),
                astray: rays_of(found.astray() & here)
                    .map(doubt)
                    .chain(nothing)
                    .collect(),
            };
            if !doubts.is_empty() {
                doubts.settle(tree, &self.part, &rays, found.inside, |ray, hit| {
                    hits[ray] = hit.filter(|hit| found.some >> ray & 1 == 1 && wanted(ray, hit.t));
                });
            }
        }
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
