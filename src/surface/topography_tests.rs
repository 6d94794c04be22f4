//! Tests of the statistics of topographies.

use super::*;
use crate::math::rng::Purpose;

fn field(seed: u64, lengths: [f64; 2], lay: Option<Lay>) -> Topography {
    Topography::new(0.02, lengths, lay, RngKey::new(seed, Purpose::Topography))
}

/// Returns the autocorrelation over `count` pairs of points at a distance `by`.
fn autocorrelation(field: &Topography, at: impl Fn(usize) -> [DVec3; 2], count: usize) -> f64 {
    let (mut product, mut square) = (0.0, 0.0);
    for i in 0..count {
        let [a, b] = at(i).map(|point| field.height(point));
        product += a * b;
        square += (a * a + b * b) / 2.0;
    }
    product / square
}

/// Along one direction, heights have the variance Sq² and fall to a correlation of 0.2 at the
/// length of that direction. The tolerance is five times the sum of two standard deviations: 0.03
/// for the 512 waves and 1/√n for n independent points.
#[test]
fn the_autocorrelation_falls_to_a_fifth_at_the_stated_length() {
    let oblique = DVec3::new(1.0, 2.0, 2.0) / 3.0;
    let across = DVec3::new(2.0, -2.0, 1.0) / 3.0;
    for seed in [3, 14, 159] {
        for (lay, lengths) in [(None, [0.3, 0.3]), (Some(Lay::Along(oblique)), [1.5, 0.3])] {
            let field = field(seed, lengths, lay);
            for (direction, length) in [(oblique, lengths[0]), (across, lengths[1])] {
                let n = 4000;
                let start = |i: usize| DVec3::new(0.7, 0.9, -0.5) * i as f64;
                let found =
                    autocorrelation(&field, |i| [start(i), start(i) + direction * length], n);
                let limit = 5.0 * (0.03 + 1.0 / (n as f64).sqrt());
                assert!((found - 0.2).abs() < limit, "{seed} {lay:?}: {found}");
            }
            let heights = (0..4000).map(|i| field.height(across * f64::from(i) * 0.9));
            let mean_square = heights.map(|h| h * h).sum::<f64>() / 4000.0;
            // The standard error of a mean square of n normal numbers is √(2/n) of it.
            let limit = 5.0 * (2.0f64 / 4000.0).sqrt();
            assert!((mean_square / 0.02f64.powi(2) - 1.0).abs() < limit);
        }
    }
}

/// Circular grooves have the lengths of the lay at every azimuth, without a seam.
#[test]
fn grooves_about_an_axis_have_no_seam() {
    let axis = DVec3::new(0.0, 0.6, 0.8);
    let [x, y] = azimuth_axes(axis);
    let lay = Lay::About {
        point: DVec3::new(1.0, 2.0, 3.0),
        axis,
    };
    for seed in [2, 71, 828] {
        let field = field(seed, [2.0, 0.25], Some(lay));
        let at = |radius: f64, angle: f64| {
            DVec3::new(1.0, 2.0, 3.0) + (x * angle.cos() + y * angle.sin()) * radius
        };
        let seam = field.height(at(5.0, std::f64::consts::PI - 1e-9))
            - field.height(at(5.0, -std::f64::consts::PI + 1e-9));
        assert!(seam.abs() < 1e-8);
        let n = 4000;
        let limit = 5.0 * (0.03 + 1.0 / (n as f64).sqrt());
        let radius = |i: usize| 5.0 + 0.4 * i as f64;
        let along = |i: usize| {
            let start = 0.37 * i as f64;
            [at(radius(i), start), at(radius(i), start + 2.0 / radius(i))]
        };
        let outward = |i: usize| {
            let angle = 0.37 * i as f64;
            [at(radius(i), angle), at(radius(i) + 0.25, angle)]
        };
        for found in [
            autocorrelation(&field, along, n),
            autocorrelation(&field, outward, n),
        ] {
            assert!((found - 0.2).abs() < limit, "{seed}: {found}");
        }
    }
}

/// The average over a line agrees with a sum over the light, whose weights contain the brightness
/// of the facets: heights of 0.1 µm make the terms of second order negligible.
#[test]
fn the_average_is_the_centroid_of_the_light() {
    for (seed, shading, sigma) in [(1, 1.0, 0.05), (2, 0.4, 0.2), (3, 0.0, 0.4)] {
        let key = RngKey::new(seed, Purpose::Topography);
        let field = Topography::new(1e-4, [0.5, 0.5], None, key);
        let footprint = LineFootprint {
            across: DVec3::Y * sigma,
            shading,
            column: DVec3::X * 0.1,
            exposure: Vec::new(),
        };
        let point = DVec3::new(0.3, 0.7, 0.0);
        // The row of light at y is r = y − h and its brightness is 1 − ε·h′.
        let (mut sum, mut weights) = (0.0, 0.0);
        let steps = 400;
        for i in -steps..=steps {
            let u = 6.0 * f64::from(i) / f64::from(steps);
            for j in 0..20 {
                let x = 0.1 * ((f64::from(j) + 0.5) / 20.0 - 0.5);
                let at = point + DVec3::new(x, sigma * u, 0.0);
                let by = DVec3::Y * 1e-5;
                let slope = (field.height(at + by) - field.height(at - by)) / 2e-5;
                let weight = (-0.5 * u * u).exp() * (1.0 - shading * slope);
                sum += weight * (sigma * u - field.height(at));
                weights += weight;
            }
        }
        let centroid = -sum / weights;
        let found = field.averaged(point, &footprint);
        assert!((found - centroid).abs() < 1e-6, "{found} {centroid}");
    }
}
