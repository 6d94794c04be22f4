//! Libraries in the race. Each is called as its documentation recommends, with triangles in leaf
//! order where that is recommended.

use super::rays::exact;
use crate::accel::embree_race::{BareEmbree, FlatHit, FlatRay};
use crate::accel::{Accel, Backend, WIDTH};
use crate::error::Result;
use crate::mesh::Mesh;
use bvh::aabb::Bounded;
use bvh::bounding_hierarchy::{BHShape, BoundingHierarchy};
use glam::{Vec3, Vec3A};
use nalgebra::{Point3, SVector};
use obvhs::BvhBuildParams;
use obvhs::bvh2::{Bvh2, builder::build_bvh2_from_tris};
use obvhs::cwbvh::{CwBvh, builder::build_cwbvh_from_tris};
use obvhs::ray::RayHit;
use obvhs::triangle::Triangle;
use parry3d::query::RayCast;
use parry3d::shape::{CompositeShapeRef, TriMesh};
use smallvec::SmallVec;
use std::sync::Arc;

/// Ray queries of a library. The number of results equals the number of rays.
pub trait BenchBackend: Sync {
    fn closest(&self, rays: &[FlatRay], coherent: bool, hits: &mut [FlatHit]);
    fn occluded(&self, rays: &[FlatRay], coherent: bool, blocked: &mut [bool]);
    /// Returns the current and the peak number of bytes outside Rust's allocator; `None` if they
    /// are unknown.
    fn foreign_bytes(&self) -> Option<[usize; 2]> {
        Some([0; 2])
    }
}

pub struct BackendEntry {
    pub name: &'static str,
    pub version: String,
    pub build: fn(&Arc<Mesh>) -> Result<Box<dyn BenchBackend>>,
}

/// Number of racers.
pub const RACERS: usize = 10;

pub fn entrants() -> [BackendEntry; RACERS] {
    let embree = Backend::Embree.version();
    let obvhs = Backend::Rust.version();
    let entrant = |name, version: &str, build| BackendEntry {
        name,
        version: version.into(),
        build,
    };
    [
        entrant("Embree, 1 ray, robust", &embree, |mesh| {
            single_embree(mesh, true)
        }),
        entrant("Embree, 1 ray, fast", &embree, |mesh| {
            single_embree(mesh, false)
        }),
        entrant("Embree, 16 rays, robust", &embree, |mesh| {
            packet_embree(mesh, true)
        }),
        entrant("Embree, 16 rays, fast", &embree, |mesh| {
            packet_embree(mesh, false)
        }),
        entrant("lasertrace, Embree + f64", &embree, |mesh| {
            ours(mesh, Backend::Embree)
        }),
        entrant("lasertrace, Rust f64", &obvhs, |mesh| {
            ours(mesh, Backend::Rust)
        }),
        entrant("obvhs BVH2", "obvhs 0.4", |mesh| {
            Ok(Box::new(ObvhsBvh2::new(mesh)))
        }),
        entrant("obvhs CWBVH", "obvhs 0.4", |mesh| {
            Ok(Box::new(ObvhsCwBvh::new(mesh)))
        }),
        entrant("parry3d", "parry3d 0.31", |mesh| Ok(Box::new(parry(mesh)))),
        entrant("bvh", "bvh 0.13", |mesh| Ok(Box::new(BvhCrate::new(mesh)))),
    ]
}

/// Embree, one ray per call.
struct Single(BareEmbree);
/// Embree, packets of sixteen rays.
struct Packets(BareEmbree);

fn single_embree(mesh: &Arc<Mesh>, robust: bool) -> Result<Box<dyn BenchBackend>> {
    let scene = BareEmbree::build(mesh, robust, rayon::current_num_threads())?;
    Ok(Box::new(Single(scene)))
}

fn packet_embree(mesh: &Arc<Mesh>, robust: bool) -> Result<Box<dyn BenchBackend>> {
    let scene = BareEmbree::build(mesh, robust, rayon::current_num_threads())?;
    Ok(Box::new(Packets(scene)))
}

impl BenchBackend for Single {
    fn closest(&self, rays: &[FlatRay], _: bool, hits: &mut [FlatHit]) {
        for (ray, hit) in rays.iter().zip(hits) {
            *hit = self.0.closest(ray);
        }
    }

    fn occluded(&self, rays: &[FlatRay], _: bool, blocked: &mut [bool]) {
        for (ray, blocked) in rays.iter().zip(blocked) {
            *blocked = self.0.occluded(ray);
        }
    }

    fn foreign_bytes(&self) -> Option<[usize; 2]> {
        Some(self.0.bytes())
    }
}

impl BenchBackend for Packets {
    fn closest(&self, rays: &[FlatRay], coherent: bool, hits: &mut [FlatHit]) {
        for (rays, hits) in rays.chunks(WIDTH).zip(hits.chunks_mut(WIDTH)) {
            self.0.closest16(rays, coherent, hits);
        }
    }

    fn occluded(&self, rays: &[FlatRay], coherent: bool, blocked: &mut [bool]) {
        for (rays, blocked) in rays.chunks(WIDTH).zip(blocked.chunks_mut(WIDTH)) {
            self.0.occluded16(rays, coherent, blocked);
        }
    }

    fn foreign_bytes(&self) -> Option<[usize; 2]> {
        Some(self.0.bytes())
    }
}

/// Acceleration structure of the program itself, with rays and hits in f64.
struct LasertraceBackend(Accel, Backend);

fn ours(mesh: &Arc<Mesh>, backend: Backend) -> Result<Box<dyn BenchBackend>> {
    let threads = rayon::current_num_threads();
    let accel = Accel::build_with(backend, mesh, threads, &|_| Ok(()))?;
    Ok(Box::new(LasertraceBackend(accel, backend)))
}

fn packet(rays: &[FlatRay]) -> SmallVec<[crate::accel::Ray; WIDTH]> {
    rays.iter().map(exact).collect()
}

impl BenchBackend for LasertraceBackend {
    fn closest(&self, rays: &[FlatRay], _: bool, hits: &mut [FlatHit]) {
        let mut hits = hits.chunks_mut(WIDTH);
        self.0
            .trace_in_turn(rays.chunks(WIDTH).map(packet), false, |found| {
                let hits = hits.next().expect("there are as many as rays");
                for (hit, found) in hits.iter_mut().zip(found) {
                    *hit = found.map_or(FlatHit::NONE, |found| FlatHit {
                        t: found.t as f32,
                        triangle: found.face.triangle,
                    });
                }
            });
    }

    fn occluded(&self, rays: &[FlatRay], _: bool, blocked: &mut [bool]) {
        for (rays, blocked) in rays.chunks(WIDTH).zip(blocked.chunks_mut(WIDTH)) {
            let bits = self.0.occluded(&packet(rays));
            for (i, blocked) in blocked.iter_mut().enumerate() {
                *blocked = bits >> i & 1 == 1;
            }
        }
    }

    fn foreign_bytes(&self) -> Option<[usize; 2]> {
        (self.1 == Backend::Rust).then_some([0; 2])
    }
}

fn corners(mesh: &Mesh, triangle: usize) -> [Vec3; 3] {
    mesh.triangle(triangle).map(|p| p.as_vec3())
}

fn obvhs_triangles(mesh: &Mesh) -> Vec<Triangle> {
    (0..mesh.triangles.len())
        .map(|i| {
            let [v0, v1, v2] = corners(mesh, i).map(Vec3A::from);
            Triangle { v0, v1, v2 }
        })
        .collect()
}

fn in_order(triangles: &[Triangle], order: &[u32]) -> Vec<Triangle> {
    order.iter().map(|&i| triangles[i as usize]).collect()
}

fn obvhs_ray(ray: &FlatRay) -> obvhs::ray::Ray {
    obvhs::ray::Ray::new(ray.origin.into(), ray.direction.into(), 0.0, ray.t_max)
}

struct ObvhsBvh2 {
    bvh: Bvh2,
    triangles: Vec<Triangle>,
}

impl ObvhsBvh2 {
    fn new(mesh: &Mesh) -> ObvhsBvh2 {
        let triangles = obvhs_triangles(mesh);
        let medium = BvhBuildParams::medium_build();
        let bvh = build_bvh2_from_tris(&triangles, medium, &mut Default::default());
        let triangles = in_order(&triangles, &bvh.primitive_indices);
        ObvhsBvh2 { bvh, triangles }
    }
}

struct ObvhsCwBvh {
    bvh: CwBvh,
    triangles: Vec<Triangle>,
}

impl ObvhsCwBvh {
    fn new(mesh: &Mesh) -> ObvhsCwBvh {
        let triangles = obvhs_triangles(mesh);
        let medium = BvhBuildParams::medium_build();
        let bvh = build_cwbvh_from_tris(&triangles, medium, &mut Default::default());
        let triangles = in_order(&triangles, &bvh.primitive_indices);
        ObvhsCwBvh { bvh, triangles }
    }
}

/// Implements `BenchBackend` for both trees of obvhs.
macro_rules! race_obvhs {
    ($tree:ty) => {
        impl BenchBackend for $tree {
            fn closest(&self, rays: &[FlatRay], _: bool, hits: &mut [FlatHit]) {
                for (ray, out) in rays.iter().zip(hits) {
                    let mut hit = RayHit::none();
                    let test = |ray: &obvhs::ray::Ray, i: usize| self.triangles[i].intersect(ray);
                    let found = self.bvh.ray_traverse(obvhs_ray(ray), &mut hit, test);
                    *out = match found || hit.primitive_id != u32::MAX {
                        false => FlatHit::NONE,
                        true => FlatHit {
                            t: hit.t,
                            triangle: self.bvh.primitive_indices[hit.primitive_id as usize],
                        },
                    };
                }
            }

            fn occluded(&self, rays: &[FlatRay], _: bool, blocked: &mut [bool]) {
                for (ray, blocked) in rays.iter().zip(blocked) {
                    let test = |ray: &obvhs::ray::Ray, i: usize| self.triangles[i].intersect(ray);
                    *blocked = !self.bvh.ray_traverse_miss(obvhs_ray(ray), test);
                }
            }
        }
    };
}

race_obvhs!(ObvhsBvh2);
race_obvhs!(ObvhsCwBvh);

fn parry(mesh: &Mesh) -> TriMesh {
    let positions = mesh.positions.iter();
    let vertices = positions.map(|p| p.as_vec3().to_array().into()).collect();
    TriMesh::new(vertices, mesh.triangles.clone()).expect("a mesh has triangles")
}

fn parry_ray(ray: &FlatRay) -> parry3d::query::Ray {
    parry3d::query::Ray::new(ray.origin.into(), ray.direction.into())
}

impl BenchBackend for TriMesh {
    fn closest(&self, rays: &[FlatRay], _: bool, hits: &mut [FlatHit]) {
        for (ray, out) in rays.iter().zip(hits) {
            let mesh = CompositeShapeRef(self);
            let hit = mesh.cast_local_ray(&parry_ray(ray), ray.t_max, false);
            *out = hit.map_or(FlatHit::NONE, |(triangle, t)| FlatHit { t, triangle });
        }
    }

    fn occluded(&self, rays: &[FlatRay], _: bool, blocked: &mut [bool]) {
        for (ray, blocked) in rays.iter().zip(blocked) {
            *blocked = self.intersects_local_ray(&parry_ray(ray), ray.t_max);
        }
    }
}

struct TriangleShape {
    corners: [Vec3; 3],
    triangle: u32,
    node: usize,
}

impl Bounded<f32, 3> for TriangleShape {
    fn aabb(&self) -> bvh::aabb::Aabb<f32, 3> {
        let [a, b, c] = self.corners;
        let point = |p: Vec3| Point3::from(p.to_array());
        bvh::aabb::Aabb::with_bounds(point(a.min(b).min(c)), point(a.max(b).max(c)))
    }
}

impl BHShape<f32, 3> for TriangleShape {
    fn set_bh_node_index(&mut self, node: usize) {
        self.node = node;
    }

    fn bh_node_index(&self) -> usize {
        self.node
    }
}

/// Tree of the crate `bvh` with a two-sided triangle test, because the test in the crate is
/// one-sided.
struct BvhCrate {
    bvh: bvh::bvh::Bvh<f32, 3>,
    shapes: Vec<TriangleShape>,
}

impl BvhCrate {
    fn new(mesh: &Mesh) -> BvhCrate {
        let shape = |i: usize| TriangleShape {
            corners: corners(mesh, i),
            triangle: i as u32,
            node: 0,
        };
        let mut shapes: Vec<TriangleShape> = (0..mesh.triangles.len()).map(shape).collect();
        let bvh = bvh::bvh::Bvh::build_par(&mut shapes);
        BvhCrate { bvh, shapes }
    }

    /// Returns the nearest hit, or the first hit found if `any`.
    fn search(&self, ray: &FlatRay, any: bool) -> FlatHit {
        let [origin, direction] = [ray.origin, ray.direction];
        let walker = bvh::ray::Ray::new(Point3::from(origin), SVector::from(direction));
        let mut best = FlatHit::NONE;
        for shape in self
            .bvh
            .nearest_child_traverse_iterator(&walker, &self.shapes)
        {
            let t = moeller_trumbore(shape.corners, origin.into(), direction.into());
            if t < best.t && t <= ray.t_max {
                best = FlatHit {
                    t,
                    triangle: shape.triangle,
                };
                if any {
                    break;
                }
            }
        }
        best
    }
}

/// Returns the distance to a triangle, or infinity for a miss (Möller & Trumbore 1997).
fn moeller_trumbore([a, b, c]: [Vec3; 3], origin: Vec3, direction: Vec3) -> f32 {
    let (e1, e2) = (b - a, c - a);
    let p = direction.cross(e2);
    let inverse = e1.dot(p).recip();
    let s = origin - a;
    let u = s.dot(p) * inverse;
    let q = s.cross(e1);
    let v = direction.dot(q) * inverse;
    let t = e2.dot(q) * inverse;
    match u >= 0.0 && v >= 0.0 && u + v <= 1.0 && t >= 0.0 {
        true => t,
        false => f32::INFINITY,
    }
}

impl BenchBackend for BvhCrate {
    fn closest(&self, rays: &[FlatRay], _: bool, hits: &mut [FlatHit]) {
        for (ray, hit) in rays.iter().zip(hits) {
            *hit = self.search(ray, false);
        }
    }

    fn occluded(&self, rays: &[FlatRay], _: bool, blocked: &mut [bool]) {
        for (ray, blocked) in rays.iter().zip(blocked) {
            *blocked = self.search(ray, true) != FlatHit::NONE;
        }
    }
}
