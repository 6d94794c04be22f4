//! One ray a pixel where the surface is flat, against a ray for every sample.

use lasertrace::accel::TriangleClusters;
use lasertrace::frame::{DefocusSettings, PixelQuadrature, Sampling, TracedRegion, irradiance};
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use std::path::Path;

/// Centroids of the columns' light, rows, of those that hold at least a twentieth of
/// the mean light of a lit column.
fn centroids(image: &[f32], columns: usize) -> Vec<Option<f64>> {
    let sums = |column: usize| {
        let pixels = image[column..].iter().step_by(columns).enumerate();
        pixels.fold((0.0, 0.0), |(sum, moment), (row, &e)| {
            (sum + e as f64, moment + e as f64 * row as f64)
        })
    };
    let sums: Vec<(f64, f64)> = (0..columns).map(sums).collect();
    let lit = sums.iter().filter(|(sum, _)| *sum > 0.0);
    let mean = lit.clone().map(|(sum, _)| sum).sum::<f64>() / lit.count() as f64;
    sums.iter()
        .map(|(sum, moment)| (*sum > 0.05 * mean).then(|| moment / sum))
        .collect()
}

/// Frames of the bracket, with speckle: through its fillet, ribs, holes and step.
/// On a plane the samples are where the rays' are, and what is taken from the pixel's
/// centre (distance, radius, solid angle) changes by under 1e-3 of itself over a
/// pixel and alike above and below the line: the median must be far below a
/// thousandth of a pixel, which sampling itself may err by. Where facets bend, half a
/// pixel off the plane is at most a quarter of the tolerance of 0.01 radii (1.6 px)
/// for a curve and half of it for a kink, 0.008 px, in single pixels; the centroid
/// of speckled pixels follows. Next to edges both send the same rays.
#[test]
fn lines_lie_where_a_ray_for_every_sample_has_them() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/bracket/scene.toml");
    let scene = Scene::load(&path).unwrap();
    let simulation = Simulation::new(&scene).unwrap();
    let clusters = TriangleClusters::new(&scene.mesh);
    let columns = scene.camera.sensor.resolution.x as usize;
    let mut shifts = Vec::new();
    for frame in [20, 55, 110, 170] {
        let mut view = simulation.view(frame);
        // A sharp image shows the least difference.
        view.lens = DefocusSettings::NONE;
        assert!(
            view.sampling == Sampling::Planes
                && view.grid != (PixelQuadrature::Gauss { per_side: 1 })
        );
        let planes = centroids(
            &irradiance(&view, &TracedRegion::Lit(&clusters)).dense(),
            columns,
        );
        view.sampling = Sampling::Rays;
        let rays = centroids(
            &irradiance(&view, &TracedRegion::Lit(&clusters)).dense(),
            columns,
        );
        for (a, b) in planes.iter().zip(&rays) {
            if let (Some(a), Some(b)) = (a, b) {
                shifts.push((a - b).abs());
            }
        }
    }
    shifts.sort_by(f64::total_cmp);
    let at = |share: f64| shifts[((shifts.len() - 1) as f64 * share) as usize];
    let [median, most, all] = [at(0.5), at(0.99), at(1.0)];
    eprintln!(
        "{} columns: median {median:.1e} px, 99 % {most:.1e}, all {all:.1e}",
        shifts.len()
    );
    assert!(shifts.len() > 2000);
    assert!(median < 1e-4 && most < 8e-3, "{median} {most}");
}
