//! What simulations leave behind when they are dropped, alone in its process.

use lasertrace::{Scene, Simulation};
use peak_alloc::PeakAlloc;
use std::path::PathBuf;

#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

/// Rust's allocations after 100 simulations are those after the first few: what is made once
/// for all (tables, rayon's threads) is there by then.
#[test]
fn a_simulation_leaves_nothing_behind() {
    let plane = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("scenes/plane/scene.toml");
    let once = || {
        let simulation = Simulation::new(&Scene::load(&plane).unwrap()).unwrap();
        drop(simulation.image(0));
    };
    (0..3).for_each(|_| once());
    let before = MEMORY.current_usage();
    (0..100).for_each(|_| once());
    let grown = MEMORY.current_usage() as f64 - before as f64;
    // Less than a kilobyte each: queues of rayon's grow now and then.
    assert!(grown < 100.0 * 1024.0, "{grown} bytes");
}
