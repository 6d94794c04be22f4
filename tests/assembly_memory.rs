//! Memory of an assembly: what one copy takes, and a hundred bytes for each. Alone in
//! its program, since what is counted is of all threads.
// With the race's rivals the program counts allocations itself, and there is one
// allocator to a program.
#![cfg(not(feature = "race"))]

use lasertrace::accel::{Accel, Backend, TriangleClusters};
use lasertrace::math::{DVec3, Rigid};
use lasertrace::mesh::shapes;
use peak_alloc::PeakAlloc;
use std::sync::Arc;

#[global_allocator]
static ALLOCATED: PeakAlloc = PeakAlloc;

/// With the tree in Rust, all of which this counts; Embree's, which it does not, is
/// built before there are copies. A pose is 96 bytes, a copy in the tree two nodes of 32
/// and a number of 4, and a tree's vector may have grown by half too much. While the tree
/// is built a copy takes the 220 bytes that are asked for, and rayon's stacks of work.
#[test]
fn a_thousand_copies_take_what_one_does() {
    let small = Arc::new(shapes::sphere(1.0, 0.1).unwrap());
    let places = (0..200_000).map(|i| DVec3::new((i % 500) as f64, (i / 500) as f64, 0.0));
    let poses: Arc<[Rigid]> = places.map(Rigid::translation).collect();
    let accel = Accel::build_with(Backend::Rust, &small, 1, &|_| Ok(())).unwrap();
    let before = ALLOCATED.current_usage();
    ALLOCATED.reset_peak_usage();
    drop(accel.with_copies(poses.clone()).unwrap());
    let each = (ALLOCATED.peak_usage() - before) / poses.len();
    println!("{each} bytes a copy while their tree is built");
    assert!(each < 220, "{each}");

    let mesh = Arc::new(shapes::sphere(1.0, 2e-5).unwrap());
    let build = |count: usize| {
        let before = ALLOCATED.current_usage();
        let places = (0..count).map(|i| DVec3::new((i % 32) as f64, (i / 32) as f64, 0.0) * 1.7);
        let poses: Arc<[Rigid]> = places.map(Rigid::translation).collect();
        let clusters = TriangleClusters::new(&mesh);
        let accel = Accel::build_with(Backend::Rust, &mesh, 1, &|_| Ok(())).unwrap();
        let accel = accel.with_copies(poses.clone()).unwrap();
        let taken = ALLOCATED.current_usage() - before;
        assert_eq!(accel.poses().len(), count);
        drop(clusters);
        taken
    };
    let (one, thousand) = (build(1), build(1000));
    println!(
        "{} triangles: {one} bytes, with 1000 copies {thousand}",
        mesh.triangles.len()
    );
    assert!(
        one > 20 * mesh.triangles.len() && thousand - one < 1000 * 250,
        "{one} {thousand}"
    );
}
