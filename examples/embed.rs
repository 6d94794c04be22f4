//! A program of your own around the simulator: an image and a profile as slices.
//!
//! ```sh
//! cargo run --release --example embed -- scenes/bracket/scene.toml 90
//! ```

use lasertrace::{Result, Scene, Simulation};
use std::path::PathBuf;

fn main() -> Result<()> {
    let mut arguments = std::env::args().skip(1);
    let path = arguments.next().map(PathBuf::from);
    let path = path.unwrap_or_else(|| "scenes/plane/scene.toml".into());
    let frame = arguments
        .next()
        .map_or(0, |n| n.parse().expect("the number of a frame"));

    let simulation = Simulation::new(&Scene::load(&path)?)?;
    let image = simulation.image(frame);
    let counts: &[u16] = image.by_column();
    let (_, points) = simulation.measure(frame, &image);

    println!(
        "{} × {} pixels, brightest {:?}",
        image.columns(),
        image.rows(),
        counts.iter().max()
    );
    for point in points.iter().step_by(points.len().div_ceil(10).max(1)) {
        let um = [point.deviation, point.u_deviation].map(|mm| 1e3 * mm);
        println!(
            "{:8.3}: {:+.2} µm from the CAD, ±{:.2}",
            point.position, um[0], um[1]
        );
    }
    Ok(())
}
