use super::*;

#[test]
fn squared_weights_sum_to_one_and_products_to_the_correlation() {
    for i in 0..200 {
        let x = -3.0 + 0.0437 * f64::from(i);
        let nodes = |x: f64| {
            let mut all = Vec::new();
            along(x, 2.5, &mut |k, w| all.push((k, w)));
            all
        };
        let here = nodes(x);
        let sum: f64 = here.iter().map(|(_, w)| w * w).sum();
        assert!((sum - 1.0).abs() < 1e-12);
        for distance in [0.3, 1.0, 2.5, 4.0] {
            let there = nodes(x + distance);
            let product = |(k, w): &(i64, f64)| {
                let other = there.iter().find(|(j, _)| j == k);
                other.map_or(0.0, |(_, v)| w * v)
            };
            let found: f64 = here.iter().map(product).sum();
            let correlation = (-(distance / 2.5f64).powi(2)).exp();
            // By Poisson summation, the weights vary by 2·exp(−π²) = 1e-4.
            assert!((found - correlation).abs() < 3e-4, "{x} {distance} {found}");
        }
    }
}
