//! Rays aimed at edges and vertices of closed meshes, where every triangle around
//! faces the ray: how many are lost, and how many hit what is not there.
//!
//!     cargo run --release --example aimed_rays -- 100000000 [rust]
//!
//! What is there, the tree in Rust says, watertight and in f64, and where nothing else
//! stands in the way it must be the target. A ray is lost if it meets nothing, or
//! something behind that by more than 1e-9 of the part's size; a hit as far before it is
//! false. Half of the eyes stand along an axis, as pixels of a parallel view would, half
//! anywhere. Shadow rays are counted twice: those that end just behind the surface they
//! are aimed at and cross it only, and those that cross the whole part, as one out of a
//! closed part does. The last column is the time of coherent camera rays at the whole part.

use clap::ValueEnum;
use lasertrace::accel::{Accel, Backend, Ray, WIDTH};
use lasertrace::math::DVec3;
use lasertrace::math::rng::{Purpose, RngKey};
use lasertrace::mesh::{self, Mesh, shapes};
use rayon::prelude::*;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// The triangles around each vertex of a mesh.
fn fans(mesh: &Mesh) -> Vec<Vec<u32>> {
    let mut fans = vec![Vec::new(); mesh.positions.len()];
    for (i, corners) in mesh.triangles.iter().enumerate() {
        for &v in corners {
            fans[v as usize].push(i as u32);
        }
    }
    fans
}

/// A ray at a vertex (`on_edge` false) or a place on an edge, and the distance to it;
/// `None` where a triangle there faces it by less than 6°.
fn aimed(accel: &Accel, fans: &[Vec<u32>], key: RngKey, on_edge: bool) -> Option<Ray> {
    let (mesh, size) = (accel.mesh(), accel.bounds().size().length());
    let count = mesh.triangles.len() as f64;
    let [a, b, _] = mesh.triangles[(key.uniform(0) * count) as usize];
    let from = mesh.positions[a as usize];
    let target = match on_edge {
        true => from.lerp(mesh.positions[b as usize], key.uniform(1)),
        false => from,
    };
    let away = match key.uniform(2) < 0.5 {
        true => DVec3::AXES[(key.uniform(3) * 3.0) as usize] * (key.uniform(4) - 0.5).signum(),
        false => {
            let random = |k| 2.0 * key.uniform(k) - 1.0;
            DVec3::new(random(4), random(5), random(6)).try_normalize()?
        }
    };
    let ray = Ray::between(target + away * size * (1.0 + key.uniform(7)), target)?;
    let around = fans[a as usize].iter();
    let faces = |&&t: &&u32| {
        let [p, q, r] = mesh.triangle(t as usize);
        let other = !on_edge || mesh.triangles[t as usize].contains(&b);
        let normal = (q - p).cross(r - p).normalize();
        !other || normal.dot(ray.direction) < -0.1
    };
    (around.filter(faces).count() == fans[a as usize].len()).then_some(ray)
}

#[derive(Debug, Default, Clone, Copy)]
struct Tally {
    rays: u64,
    lost: u64,
    falsely: u64,
    shadows_lost: u64,
    shadows_through_lost: u64,
}

impl Tally {
    fn plus(self, other: Tally) -> Tally {
        Tally {
            rays: self.rays + other.rays,
            lost: self.lost + other.lost,
            falsely: self.falsely + other.falsely,
            shadows_lost: self.shadows_lost + other.shadows_lost,
            shadows_through_lost: self.shadows_through_lost + other.shadows_through_lost,
        }
    }
}

fn packet(accel: &Accel, oracle: &Accel, rays: &[Ray]) -> Tally {
    let tolerance = 1e-9 * accel.bounds().size().length();
    let endless: Vec<Ray> = (rays.iter())
        .map(|&ray| Ray {
            t_max: f64::INFINITY,
            ..ray
        })
        .collect();
    let ended: Vec<Ray> = (rays.iter())
        .map(|&ray| Ray {
            t_max: ray.t_max + 4.0 * accel.resolution(),
            ..ray
        })
        .collect();
    let hits = accel.closest(&endless, |_, _| true);
    let truth = oracle.closest(&endless, |_, _| true);
    let offs = (0..rays.len()).map(|i| {
        let truth = truth[i].expect("the oracle loses no ray").t;
        assert!(truth <= rays[i].t_max + tolerance, "{:?}", rays[i]);
        hits[i].map_or(f64::INFINITY, |hit| hit.t - truth)
    });
    let lit = |rays: &[Ray]| rays.len() as u64 - accel.occluded(rays).count_ones() as u64;
    Tally {
        rays: rays.len() as u64,
        lost: offs.clone().filter(|&t| t > tolerance).count() as u64,
        falsely: offs.filter(|&t| t < -tolerance).count() as u64,
        shadows_lost: lit(&ended),
        shadows_through_lost: lit(&endless),
    }
}

fn race(accel: &Accel, oracle: &Accel, on_edge: bool, count: u64) -> Tally {
    let fans = fans(accel.mesh());
    let key = RngKey::new(on_edge as u64, Purpose::RaceRays);
    const TASK: u64 = 1 << 14;
    let task = |task: u64| {
        let rays: Vec<Ray> = (task * TASK..(task + 1) * TASK)
            .filter_map(|i| aimed(accel, &fans, key.with(i), on_edge))
            .collect();
        let tallies = rays.chunks(WIDTH).map(|rays| packet(accel, oracle, rays));
        tallies.fold(Tally::default(), Tally::plus)
    };
    let mut tally = Tally::default();
    let mut next = 0;
    while tally.rays < count {
        let tasks = (next..next + 64).into_par_iter().map(task);
        tally = tally.plus(tasks.reduce(Tally::default, Tally::plus));
        next += 64;
    }
    tally
}

/// Nanoseconds a ray of a camera that sees the whole part, least of five runs.
fn camera(accel: &Accel) -> f64 {
    const SIDE: usize = 512;
    let (center, size) = (accel.bounds().center(), accel.bounds().size().length());
    let eye = center + DVec3::new(0.3, -0.55, 0.78) * 2.0 * size;
    let (x, y) = (
        DVec3::X,
        (center - eye).normalize().cross(DVec3::X).normalize(),
    );
    let ray = |column: usize, row: usize| {
        let at = |i: usize| ((i as f64 + 0.5) / SIDE as f64 - 0.5) * size;
        let mut ray = Ray::between(eye, center + x * at(column) + y * at(row)).unwrap();
        ray.t_max = f64::INFINITY;
        ray
    };
    let rays: Vec<Ray> = (0..SIDE * SIDE).map(|i| ray(i % SIDE, i / SIDE)).collect();
    let run = |_| {
        let start = Instant::now();
        let hits = |rays| accel.closest(rays, |_, _| true).iter().flatten().count();
        let hits: usize = rays.chunks(WIDTH).map(hits).sum();
        assert!(hits > 0);
        start.elapsed().as_secs_f64() / rays.len() as f64 * 1e9
    };
    (0..5).map(run).fold(f64::INFINITY, f64::min)
}

fn main() {
    let mut arguments = std::env::args().skip(1);
    let count: u64 = arguments.next().map_or(10_000_000, |n| n.parse().unwrap());
    let backend = arguments.next().map_or(Backend::default(), |name| {
        Backend::from_str(&name, true).unwrap()
    });
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut far = shapes::sphere(4.0, 0.004).unwrap();
    let offset = DVec3::new(900.0, -70.0, 3.0);
    far.positions.iter_mut().for_each(|p| *p += offset);
    let meshes = [
        ("sphere of 8000, off the origin", far),
        ("sphere of 800 000", shapes::sphere(40.0, 4e-4).unwrap()),
        (
            "sphere of 5 million, as quads",
            shapes::sphere(40.0, 6e-5).unwrap(),
        ),
        (
            "cylinder of slivers",
            shapes::cylinder(5.0, 60.0, 1e-4).unwrap(),
        ),
        (
            "bracket",
            mesh::load(&root.join("scenes/bracket/bracket.stl"), 1.0).unwrap(),
        ),
    ];
    println!("{backend:?}; rays, lost, false, shadow rays lost, those through; ns a camera ray");
    for (name, mesh) in meshes {
        let mesh = Arc::new(mesh);
        let accel = Accel::build_with(backend, &mesh, 1, &|_| Ok(())).unwrap();
        let oracle = Accel::build_with(Backend::Rust, &mesh, 1, &|_| Ok(())).unwrap();
        let camera = camera(&accel);
        for (what, on_edge) in [("vertices", false), ("edges", true)] {
            let t = race(&accel, &oracle, on_edge, count / 10);
            println!(
                "{name}, {what}: {} {} {} {} {}; {camera:.1}",
                t.rays, t.lost, t.falsely, t.shadows_lost, t.shadows_through_lost
            );
        }
    }
}
