//! A milled pocket of aluminium and a turned shaft of steel as the camera sees them: light reflected once, and beside it all light.
//!
//!     cargo run --release --example reflections
//!
//! Writes `docs/reflections-pocket.png` and `docs/reflections-shaft.png`: counts to the power of 0.4, so that what is faint is seen.

use image::{GrayImage, Luma};
use lasertrace::camera::Counts;
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use std::path::Path;

/// Pixels to a side of one in the picture.
const BIN: usize = 2;
/// Between both images.
const GAP: u32 = 4;

fn main() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    for (name, frame) in [("pocket", 19), ("shaft", 3)] {
        let scene = root.join("scenes/corner").join(name).with_extension("toml");
        let mut simulation = Simulation::new(&Scene::load(&scene).unwrap()).unwrap();
        let all = simulation.image(frame);
        println!("{name}: {:?}", simulation.plan.reflections);
        simulation.plan.reflections = None;
        let once = simulation.image(frame);
        let picture = beside(&simulation, [&once, &all]);
        picture
            .save(root.join(format!("docs/reflections-{name}.png")))
            .unwrap();
    }
}

fn beside(simulation: &Simulation, images: [&Counts; 2]) -> GrayImage {
    let sensor = &simulation.scene.camera.sensor;
    let (columns, rows) = (images[0].columns() / BIN, images[0].rows() / BIN);
    let full = f64::from((1u32 << sensor.bit_depth) - 1) - sensor.black_level_dn;
    let width = columns as u32;
    let mut picture = GrayImage::from_pixel(2 * width + GAP, rows as u32, Luma([255]));
    for (counts, left) in images.iter().zip([0, width + GAP]) {
        for (column, row) in (0..columns).flat_map(|column| (0..rows).map(move |row| (column, row)))
        {
            let pixels = (0..BIN).flat_map(|i| {
                let rows = &counts.column(BIN * column + i)[BIN * row..][..BIN];
                rows.iter().map(|&count| f64::from(count))
            });
            let mean = pixels.sum::<f64>() / (BIN * BIN) as f64 - sensor.black_level_dn;
            let gray = 255.0 * (mean / full).clamp(0.0, 1.0).powf(0.4);
            picture.put_pixel(left + column as u32, row as u32, Luma([gray as u8]));
        }
    }
    picture
}
