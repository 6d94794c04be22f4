//! The light of a scene's first frame, reflected once and more than once, as numbers that other programs can be held
//! against (`tests/against_mitsuba.py`). Metals are without what several facets reflect, which these leave out.
//!
//!     cargo run --release --example light_apart -- SCENE FILE REFLECTIONS PATHS IMAGES
//!
//! Writes images of f32, row by row, mW/mm²: of light reflected once, and IMAGES of light reflected up to REFLECTIONS
//! times, with seeds of their own, by PATHS paths from the laser each. Prints how long each image took, s: of light
//! reflected once alone, and of all.

use lasertrace::frame::Reflections;
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use lasertrace::surface::{LayeredBrdf, Lobe, Material, Materials, Surface};
use std::sync::Arc;
use std::time::Instant;

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [scene, file, reflections, paths, images] = &arguments[..] else {
        panic!("expected SCENE FILE REFLECTIONS PATHS IMAGES");
    };
    let number = |text: &str| text.parse::<u32>().expect("a number");
    let mut scene = Scene::load(scene.as_ref()).expect("a scene");
    // The number of reflections is named here, and not planned.
    scene.methods.max_bounces = Some(1);
    let kinds: Vec<Material> = scene.surface.kinds().iter().cloned().map(once).collect();
    assert_eq!(kinds.len(), 1, "a part of one surface");
    scene.surface = Materials::new(kinds, Vec::new());
    let mut simulation = Simulation::new(&scene).expect("a scene that can be simulated");
    simulation.plan.reflections = Some(Reflections {
        most: number(reflections),
        from_laser: number(paths),
        per_pixel: 0.0,
        line: false,
    });
    let mut values = Vec::new();
    for seed in 0..u64::from(number(images)) {
        simulation.scene.seed = seed;
        let reflections = simulation.plan.reflections.take();
        let once = seconds(&simulation);
        simulation.plan.reflections = reflections;
        println!("{once:.4} {:.4}", seconds(&simulation));
        let [direct, more] = simulation.direct_and_indirect(0);
        if seed == 0 {
            values.extend(direct.dense());
        }
        values.extend(more.dense());
    }
    let bytes: Vec<u8> = values
        .iter()
        .flat_map(|value| value.to_le_bytes())
        .collect();
    std::fs::write(file, bytes).expect("a folder that can be written to");
}

fn seconds(simulation: &Simulation) -> f64 {
    let start = Instant::now();
    simulation.image(0);
    start.elapsed().as_secs_f64()
}

fn once(kind: Material) -> Material {
    let Surface::Layered(glossy) = &kind.surface else {
        return kind;
    };
    let lobes = glossy.lobes.iter().cloned();
    let lobes = lobes.map(|(share, lobe)| match lobe {
        Lobe::Metal(metal) => (share, Lobe::Metal(metal.single_scattering_only())),
        other => (share, other),
    });
    let glossy = LayeredBrdf {
        lobes: lobes.collect(),
        lay: glossy.lay,
    };
    Material {
        surface: Surface::Layered(Arc::new(glossy)),
        ..kind
    }
}
