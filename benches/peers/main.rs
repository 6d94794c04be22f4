//! Pure Rust's hierarchies as peers of `bindings/python/bench_rays.py`, which starts this
//! program and gives it the rays:
//!
//! `peers FOLDER` builds each on FOLDER/vertices (f64) and FOLDER/triangles (u32) and writes a line
//! with its name, then an empty line; then for each line `NAME RAYS` on stdin casts those
//! of FOLDER/RAYS (six f64 a ray: origin, direction), writes their distances in lengths of their
//! directions (f32) to FOLDER/distances, and the seconds it took to stdout. All numbers are
//! little endian.

use lasertrace::accel::embree_race::{FlatHit, FlatRay};
use lasertrace::math::DVec3;
use lasertrace::mesh::Mesh;
use lasertrace::race::racers::{BenchBackend, entrants};
use rayon::prelude::*;
use std::collections::HashMap;
use std::io::BufRead;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

const PEERS: [&str; 3] = ["obvhs BVH2", "obvhs CWBVH", "parry3d"];

fn numbers<const N: usize, T>(path: &Path, number: fn([u8; N]) -> T) -> Vec<T> {
    let bytes = std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let (chunks, _) = bytes.as_chunks();
    chunks.iter().map(|&bytes| number(bytes)).collect()
}

fn vectors(path: &Path) -> Vec<DVec3> {
    let values = numbers(path, f64::from_le_bytes);
    values.chunks_exact(3).map(DVec3::from_slice).collect()
}

struct Rays {
    rays: Vec<FlatRay>,
    lengths: Vec<f32>,
}

fn rays(path: &Path) -> Rays {
    let vectors = vectors(path);
    let pairs = vectors.chunks_exact(2);
    Rays {
        lengths: pairs.clone().map(|ray| ray[1].length() as f32).collect(),
        rays: pairs
            .map(|ray| FlatRay {
                origin: ray[0].as_vec3().to_array(),
                direction: ray[1].normalize().as_vec3().to_array(),
                t_max: f32::INFINITY,
            })
            .collect(),
    }
}

fn cast(racer: &dyn BenchBackend, rays: &[FlatRay]) -> Vec<FlatHit> {
    let mut hits = vec![FlatHit::NONE; rays.len()];
    rays.par_chunks(1024)
        .zip(hits.par_chunks_mut(1024))
        .for_each(|(rays, hits)| racer.closest(rays, false, hits));
    hits
}

fn main() {
    // `cargo bench` itself asks with --bench only.
    let Some(folder) = std::env::args().skip(1).find(|a| !a.starts_with("--")) else {
        println!("peers: bindings/python/bench.sh starts this with a folder of rays");
        return;
    };
    let folder = Path::new(&folder);
    let triangles = numbers(&folder.join("triangles"), u32::from_le_bytes);
    let triangles = triangles.chunks_exact(3).map(|t| [t[0], t[1], t[2]]);
    let mesh = Mesh::from_triangles(vectors(&folder.join("vertices")), triangles);
    let mesh = Arc::new(mesh.expect("a mesh"));
    let mut racers = HashMap::new();
    for entrant in entrants() {
        if PEERS.contains(&entrant.name) {
            let name = format!("{} ({})", entrant.name, entrant.version);
            println!("{name}");
            racers.insert(name, (entrant.build)(&mesh).expect("a hierarchy"));
        }
    }
    println!();
    let mut sets = HashMap::new();
    for line in std::io::stdin().lock().lines() {
        let line = line.expect("a line");
        let (name, set) = line.rsplit_once(' ').expect("a name and rays");
        let Rays { rays, lengths } = sets
            .entry(set.to_owned())
            .or_insert_with(|| rays(&folder.join(set)));
        let start = Instant::now();
        let hits = cast(racers[name].as_ref(), rays);
        let seconds = start.elapsed().as_secs_f64();
        let distances = hits
            .iter()
            .zip(lengths)
            .map(|(hit, length)| hit.t / *length);
        let bytes: Vec<u8> = distances.flat_map(f32::to_le_bytes).collect();
        std::fs::write(folder.join("distances"), bytes).expect("a folder to write to");
        println!("{seconds}");
    }
}
