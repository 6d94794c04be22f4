//! What the lens's blur adds to a whole frame, from light to points, on the four bench scenes: each
//! tier over the frame of a sharp image, in interleaved pairs. Whatever the plan takes
//! else is the same. `LASERTRACE_PAIRS=11` takes fewer pairs than 51.

mod four;
mod pairs;
mod waves;

use lasertrace::frame::Blur;
use lasertrace::run::Simulation;
use pairs::{print_ratio, seconds};

fn main() {
    let pairs = std::env::var("LASERTRACE_PAIRS").map_or(51, |n| n.parse().expect("a number"));
    for mut timed in four::four() {
        let [sharp, mean, coherent] = [Blur::None, Blur::Mean, Blur::Coherent].map(|blur| {
            timed.scene.methods.defocus_model = Some(blur);
            Simulation::new(&timed.scene).unwrap()
        });
        let frame = |simulation: &Simulation| {
            let light = simulation.irradiance(timed.frame);
            let counts = simulation.counts_near_light(timed.frame, &light);
            let (_, points) = simulation.measure_near_light(timed.frame, &counts);
            assert!(points.len() > 100, "{} points", points.len());
        };
        for (name, other) in [("mean light", &mean), ("coherent", &coherent)] {
            frame(other);
            print_ratio(
                &format!(
                    "{}: frame with the lens, {name}, over a sharp one",
                    timed.name
                ),
                pairs,
                |_| seconds(|| frame(other)) / seconds(|| frame(&sharp)),
            );
        }
    }
}
