//! How fast frames are taken at 2048 × 1088 with speckle, and what limits it: sizes
//! of mesh, stages, threads, the footprint against every pixel, the integrator
//! against a bare Embree loop (`--features race`), geometry alone. Each answer is
//! checked. `LASERTRACE_TRIANGLES=1e7` adds a mesh of that size to 1e5 and 1e6: ten
//! million take 3 GB.
//!
//! Single figures move with the machine's load; ratios are medians of interleaved
//! pairs.

mod pairs;

use criterion::{Criterion, criterion_group, criterion_main};
use lasertrace::accel::Clusters;
use lasertrace::batch::Simulation;
use lasertrace::integrator::{Sampling, Sheet, footprint_image, irradiance_image};
use lasertrace::scene::Scene;
use pairs::{print_ratio, seconds};
use rayon::ThreadPoolBuilder;
use rayon::prelude::*;
use std::io::Write;
use std::path::Path;

/// Columns and rows of pixels.
const SENSOR: [usize; 2] = [2048, 1088];

/// A line 1.6 px in 1/e² half width over 85 % of the columns of a part of 90 × 60 mm.
const SCENE: &str = r#"
seed = 1
speckle = true

[part]
mesh = { file = "part.stl", unit = "mm" }
reflectance = 0.5

[laser]
wavelength_nm = 660
power_mw = 20
waist_radius_um = 80
waist_distance_mm = 200
position_mm = [0, 0, 200]
direction = [0, 0, -1]
line = { fan_deg = 24, profile = "uniform", direction = [1, 0, 0] }

[camera]
focal_length_mm = 25
f_number = 8
focus_distance_mm = 252
resolution_px = [2048, 1088]
pixel_pitch_um = 5.5
position_mm = [0, -126, 218.2]
look_at_mm = [0, 0, 0]
columns = [1, 0, 0]
exposure_ms = 0.15
quantum_efficiency = 0.5
gain_dn_per_e = 0.068
bit_depth = 10
full_well_e = 15000
black_level_dn = 8
read_noise_e = 10

[scan]
start_mm = [0, -25, 0]
direction = [0, 1, 0]
step_mm = 0.05
frames = 1000
"#;

/// Height (mm) of the part: waves, a rib, a slot and a pocket.
fn height(x: f64, y: f64) -> f64 {
    let mut z = 2.0 * (x / 7.0).sin() + (y / 5.0 + x / 11.0).sin();
    if (x - 20.0).abs() < 6.0 {
        z += 4.0;
    }
    if (x + 35.0).abs() < 1.0 {
        z += 6.0;
    }
    if (x + 20.0).hypot(y) < 7.0 {
        z -= 5.0;
    }
    z
}

/// The part in about so many triangles, as a binary STL.
fn write_part(path: &Path, triangles: f64) -> std::io::Result<()> {
    let nx = (triangles / 2.0 * 1.5).sqrt() as usize;
    let ny = (triangles / 2.0 / nx as f64) as usize;
    let corner = |i: usize, j: usize| {
        let x = 90.0 * i as f64 / nx as f64 - 45.0;
        let y = 60.0 * j as f64 / ny as f64 - 30.0;
        [x as f32, y as f32, height(x, y) as f32]
    };
    let mut out = std::io::BufWriter::new(std::fs::File::create(path)?);
    out.write_all(&[0; 80])?;
    out.write_all(&(2 * nx as u32 * ny as u32).to_le_bytes())?;
    for (i, j) in (0..ny).flat_map(|j| (0..nx).map(move |i| (i, j))) {
        let [a, b] = [corner(i, j), corner(i + 1, j)];
        let [c, d] = [corner(i + 1, j + 1), corner(i, j + 1)];
        for triangle in [[a, b, c], [a, c, d]] {
            let numbers = [[0.0, 0.0, 1.0], triangle[0], triangle[1], triangle[2]];
            for number in numbers.as_flattened() {
                out.write_all(&number.to_le_bytes())?;
            }
            out.write_all(&[0; 2])?;
        }
    }
    out.flush()
}

fn scene(triangles: f64) -> Scene {
    let folder = tempfile::tempdir().unwrap();
    write_part(&folder.path().join("part.stl"), triangles).unwrap();
    let path = folder.path().join("scene.toml");
    std::fs::write(&path, SCENE).unwrap();
    Scene::load(&path).unwrap()
}

/// A frame as a scan takes it, but for its files: number of points.
fn frame(simulation: &Simulation, frame: u32) -> usize {
    let counts = simulation.counts(frame, &simulation.irradiance(frame));
    simulation.measure(frame, &counts).1.len()
}

/// Frames taken together, as in a scan.
const TOGETHER: u32 = 16;

fn batch(simulation: &Simulation) -> usize {
    let frames = (0..TOGETHER).into_par_iter();
    frames.map(|i| frame(simulation, 470 + i)).sum()
}

fn throughput(c: &mut Criterion) {
    ThreadPoolBuilder::new()
        .num_threads(1)
        .build_global()
        .unwrap();
    let two_threads = ThreadPoolBuilder::new().num_threads(2).build().unwrap();
    let large = std::env::var("LASERTRACE_TRIANGLES").ok();
    let large = large.map(|n| n.parse().expect("a number of triangles"));
    let sizes = [1e5, 1e6].into_iter().chain(large);
    let scenes: Vec<Scene> = sizes.map(scene).collect();
    let made = |scene| Simulation::new(scene).unwrap();
    let simulations: Vec<Simulation> = scenes.iter().map(made).collect();
    let mut group = c.benchmark_group("throughput");
    group.sample_size(20);
    for simulation in &simulations {
        let triangles = simulation.scene.mesh.triangles.len();
        assert!(frame(simulation, 480) > SENSOR[0] / 2);
        group.bench_function(format!("frame, {triangles} triangles"), |b| {
            b.iter(|| frame(simulation, 480))
        });
    }
    for larger in &simulations[1..] {
        let triangles = larger.scene.mesh.triangles.len();
        let name = format!("frame, {triangles} triangles / 100 000");
        print_ratio(&name, 31, |i| {
            let number = 450 + i as u32;
            seconds(|| frame(larger, number)) / seconds(|| frame(&simulations[0], number))
        });
    }
    let simulation = &simulations[1];
    let clusters = Clusters::new(&simulation.scene.mesh);
    let view = simulation.view(480);
    let light = footprint_image(&view, &clusters);
    let counts = simulation.counts(480, &light);
    group.bench_function("light", |b| b.iter(|| footprint_image(&view, &clusters)));
    let mut dull = simulation.view(480);
    dull.speckle = None;
    group.bench_function("light without speckle", |b| {
        b.iter(|| footprint_image(&dull, &clusters))
    });
    group.bench_function("counts", |b| b.iter(|| simulation.counts(480, &light)));
    group.bench_function("peaks", |b| b.iter(|| simulation.peaks(&counts)));
    group.bench_function("peaks, points, deviation", |b| {
        b.iter(|| simulation.measure(480, &counts))
    });
    geometry(&mut group, simulation.scene);
    against_all(simulation, &clusters);
    #[cfg(feature = "race")]
    bare::against_integrator(simulation);
    let found = batch(simulation);
    print_ratio("frames a second, two threads / one", 5, |_| {
        let one = seconds(|| assert_eq!(batch(simulation), found));
        let two = seconds(|| assert_eq!(two_threads.install(|| batch(simulation)), found));
        println!("two threads: {:.1} frames a second", TOGETHER as f64 / two);
        one / two
    });
    group.finish();
}

/// The footprint against every pixel, and against a ray for every sample of them.
fn against_all(simulation: &Simulation, clusters: &Clusters) {
    let view = simulation.view(480);
    let light = footprint_image(&view, clusters);
    for (name, sampling) in [
        ("every pixel / footprint", Sampling::Planes),
        ("every sample / footprint", Sampling::Rays),
    ] {
        let mut all = simulation.view(480);
        all.sampling = sampling;
        if sampling == view.sampling {
            assert_eq!(irradiance_image(&all).dense(), light.dense());
        }
        print_ratio(name, 3, |_| {
            seconds(|| irradiance_image(&all)) / seconds(|| footprint_image(&view, clusters))
        });
    }
}

/// Laser rays without images, by the profile: the rays of a sheet.
fn geometry(
    group: &mut criterion::BenchmarkGroup<criterion::measurement::WallTime>,
    scene: &Scene,
) {
    let simulation = Simulation::geometry(scene).unwrap();
    let camera_from_laser = scene.head_from_camera.inverse() * scene.head_from_laser;
    let fan = scene.laser.fan.as_ref().unwrap();
    let sheet = Sheet::new(fan, &scene.camera, &camera_from_laser);
    let view = simulation.view(480);
    assert!(sheet.profile(&view).len() > SENSOR[0] / 2);
    group.throughput(criterion::Throughput::Elements(sheet.rays() as u64));
    group.bench_function("geometry alone, laser rays", |b| {
        b.iter(|| sheet.profile(&view))
    });
}

#[cfg(feature = "race")]
mod bare {
    //! The rays through the centres of all pixels, packed beforehand, by Embree
    //! alone: no shading, no f64, and no shadow rays, of which there are few.

    use super::*;
    use lasertrace::accel::WIDTH;
    use lasertrace::accel::embree_race::{BareEmbree, FlatHit, FlatRay};
    use lasertrace::math::DVec2;

    pub fn against_integrator(simulation: &Simulation) {
        let mut view = simulation.view(480);
        (view.samples_per_side, view.speckle) = (1, None);
        let mesh = &simulation.scene.mesh;
        let embree = BareEmbree::build(mesh, true, 1).unwrap();
        let eye = view.part_from_camera.translation;
        let ray = |i: usize| {
            let pixel = DVec2::new((i % SENSOR[0]) as f64 + 0.5, (i / SENSOR[0]) as f64 + 0.5);
            let direction = view.part_from_camera.vector(view.camera.direction(pixel));
            FlatRay {
                origin: eye.as_vec3().to_array(),
                direction: direction.as_vec3().to_array(),
                t_max: f32::INFINITY,
            }
        };
        let rays: Vec<FlatRay> = (0..SENSOR[0] * SENSOR[1]).map(ray).collect();
        let mut hits = vec![FlatHit::NONE; rays.len()];
        let mut trace = || {
            for (rays, hits) in rays.chunks(WIDTH).zip(hits.chunks_mut(WIDTH)) {
                embree.closest16(rays, true, hits);
            }
        };
        print_ratio("rays a second, integrator / bare Embree", 5, |_| {
            let bare = seconds(&mut trace);
            let whole = seconds(|| irradiance_image(&view));
            let rate = rays.len() as f64 / whole * 1e-6;
            println!("integrator: {rate:.2} Mrays/s");
            bare / whole
        });
        let met = hits.iter().filter(|hit| **hit != FlatHit::NONE).count();
        assert!(met > rays.len() / 2, "{met}");
    }
}

criterion_group!(benches, throughput);
criterion_main!(benches);
