//! Predictions against brute force.

use super::*;

fn error(bias: f64, deviation: f64) -> HeightError {
    HeightError::bias(Some(bias)).and(HeightError::random(deviation))
}

/// 99 of 100 of a normal number are within 2.5758 standard deviations; of errors of
/// two sizes the limit is where the mean of the shares is a hundredth; one lost point
/// in fifty leaves no limit.
#[test]
fn the_limit_holds_99_of_100() {
    let one = quantile(&[error(0.0, 2.0)]).unwrap();
    assert!((one - 2.0 * 2.575_829).abs() < 1e-5, "{one}");
    let shifted = quantile(&[error(3.0, 0.0)]).unwrap();
    assert!((shifted - 3.0).abs() < 1e-9, "{shifted}");
    let mixed = quantile(&[error(0.0, 1.0), error(0.0, 4.0)]).unwrap();
    let share = 0.5 * (libm::erfc(mixed / 2f64.sqrt()) + libm::erfc(mixed / 4.0 / 2f64.sqrt()));
    assert!((share - 0.01).abs() < 1e-6, "{mixed} {share}");
    // Of 25 in 1000 that err at all, 10 by more than what 60 % of a normal number keep.
    let rare = quantile(&[HeightError::rare(0.025 * 4.0, 0.025)]).unwrap();
    assert!((rare - 2.0 * 0.841_621).abs() < 1e-5, "{rare}");
    let mut lost = vec![error(0.0, 1.0); 49];
    lost.push(HeightError::bias(None));
    assert_eq!(quantile(&lost), None);
    assert_eq!(quantile(&[]), Some(0.0));
}

fn pilot(point: PilotPoint) -> Pilot {
    Pilot {
        frames: vec![0],
        points: vec![point; 10],
        lines: 10.0,
        pixels: 1000.0,
        columns: 10.0,
        dark: 0.0,
        step: 1.0,
        grain: None,
    }
}

const POINT: PilotPoint = PilotPoint {
    um_per_px: 10.0,
    sigma: 2.0,
    height: 500.0,
    speckle: 0.0,
    noise: 0.0,
    per_count: 0.0,
    blur: 0.0,
    geometry: Some(0.0),
    coarse: [Some(0.0); 2],
};

/// A Gaussian line of σ = 2 px of which one end is hidden, with light to z standard
/// deviations or to ten, pixel by pixel: the centroid of what is left moves by no more
/// than predicted, wherever the pixels lie.
#[test]
fn light_that_is_cut_off_moves_a_line_by_less_than_predicted() {
    let sigma = POINT.sigma;
    let centroid = |z: f64, phase: f64| {
        let light = |k: i32| {
            let middle = k as f64 + phase;
            let share = |y: f64| libm::erf(y / sigma / 2f64.sqrt()) / 2.0;
            let lit = middle <= z * sigma && k >= 0;
            (lit, middle, share(middle + 0.5) - share(middle - 0.5))
        };
        let (mut sum, mut moment) = (0.0, 0.0);
        for k in -40..40 {
            let (lit, middle, light) = light(k);
            // The other end, k < 0, is whole.
            if lit || k < 0 {
                sum += light;
                moment += light * middle;
            }
        }
        moment / sum
    };
    let mut base = plan();
    for radii in [1.25, 1.5, 2.0] {
        base.cutoff_radii = radii;
        let predicted = pilot(POINT).cutoff(&base)[0].bias / POINT.um_per_px;
        let moved = (0..20).map(|i| {
            let phase = i as f64 / 20.0;
            (centroid(2.0 * radii, phase) - centroid(20.0, phase)).abs()
        });
        let worst = moved.fold(0.0, f64::max);
        assert!(
            worst <= predicted && worst > 0.3 * predicted,
            "{radii}: {worst} {predicted}"
        );
    }
}

fn plan() -> Plan {
    use crate::laser::{Beam, Laser};
    use crate::math::{Aabb, DVec3, Rigid};
    let laser = Laser {
        beam: Beam {
            wavelength: 660e-6,
            power_mw: 1.0,
            waist_radius: 0.1,
            waist_distance: 100.0,
            m_squared: 1.0,
        },
        fan: None,
    };
    let mut camera = crate::camera::fixture();
    camera.lens.focus_distance = 100.0;
    camera.sensor.resolution = glam::UVec2::new(64, 64);
    camera.sensor.pixel_pitch = 0.01;
    let part = Aabb {
        min: DVec3::new(-1.0, -1.0, 99.0),
        max: DVec3::new(1.0, 1.0, 101.0),
    };
    let pose = Rigid::from_z_and_x(DVec3::ZERO, DVec3::Z, DVec3::X).unwrap();
    Plan::new(&laser, &camera, &pose, &[part], None, None)
}

/// With a tolerance that all keep, the cheapest plan is taken; with none that any keeps,
/// the most accurate, which says that it is not enough.
#[test]
fn the_cheapest_sufficient_plan_is_chosen() {
    let rough = PilotPoint {
        geometry: Some(3.0),
        coarse: [Some(0.5), Some(0.1)],
        ..POINT
    };
    let pilot = pilot(rough);
    let choose = |um| pilot.choose(candidates(&plan(), true), um);
    let (geometry, accuracy) = choose(40.0);
    assert!(geometry.geometry_only && accuracy.sufficient);
    let (one, accuracy) = choose(10.0);
    assert!(!one.geometry_only && one.samples_per_side == 1 && accuracy.sufficient);
    let (two, _) = choose(2.0);
    assert!(two.samples_per_side == 2);
    let (finest, accuracy) = choose(1e-6);
    assert!(finest.samples_per_side == 16 && !accuracy.sufficient);
    assert!(
        accuracy.statement.contains("not enough"),
        "{}",
        accuracy.statement
    );
}

/// A line on a sensor that rounds: centroids of midpoints n a pixel against those of 64,
/// 20 000 lines at random places with the same read noise of a count; that standard
/// deviation is known to half a percent. The formula says more by what pixels that differ
/// by d counts err less than d, ½·∫y²d²/∫y²|d| = 5 % at n = 4, and by what 64 miss, 2 % at 12.
#[test]
fn light_that_differs_by_less_than_a_count_errs_by_rounding() {
    use crate::math::rng::{Key, Purpose};
    use rand_distr::{Distribution, StandardNormal};
    let (sigma, height) = (POINT.sigma, POINT.height);
    let pixels = || -8i32..=8;
    let sums = pixels().map(|k| {
        let y = k as f64;
        (y * y, height * (-0.5 * (y / sigma).powi(2)).exp())
    });
    let (squares, light) = sums.fold((0.0, 0.0), |a, b| (a.0 + b.0, a.1 + b.1));
    let pilot = pilot(PilotPoint {
        per_count: squares.sqrt() / light,
        ..POINT
    });
    for n in [4, 6, 12] {
        let lines = 20_000;
        let mut square = 0.0;
        for i in 0..lines {
            let key = Key::new(5, Purpose::SensorNoise).with(i);
            let middle = key.uniform(0) - 0.5;
            let centroid = |n: u32| {
                let (mut sum, mut moment) = (0.0, 0.0);
                for k in pixels() {
                    let at = |s: u32| k as f64 - 0.5 + (s as f64 + 0.5) / n as f64 - middle;
                    let light = |s| height * (-0.5 * (at(s) / sigma).powi(2)).exp();
                    let mean = (0..n).map(light).sum::<f64>() / n as f64;
                    let mut stream = key.with(k as u64).stream();
                    let noise: f64 = StandardNormal.sample(&mut stream);
                    let count = (mean + noise).round();
                    sum += count;
                    moment += count * k as f64;
                }
                moment / sum
            };
            square += (centroid(n) - centroid(64)).powi(2);
        }
        let found = (square / lines as f64).sqrt();
        let plan = Plan {
            samples_per_side: n,
            ..plan()
        };
        let error = pilot.samples(&plan)[0];
        let predicted = (error.variance + error.share * error.rare).sqrt() / POINT.um_per_px;
        assert!(
            (0.93..1.02).contains(&(found / predicted)),
            "{n}: {found} {predicted}"
        );
    }
}
