use super::*;
use crate::camera::fixture;
use crate::math::rng::{Purpose, RngKey};
use crate::math::sinc;

const WAVELENGTH: f64 = 660e-6;

fn pupil(aperture: Aperture, place: DVec2, tilt_deg: f64) -> PupilOtf {
    let mut camera = fixture();
    camera.lens.aperture = aperture;
    camera.tilt = DVec2::X * tilt_deg.to_radians();
    PupilOtf::new(&camera, place, WAVELENGTH)
}

/// Returns the autocorrelation of the pupil by direct summation over n² points. In each row, the
/// ends have an error of up to half a step. An error of the order of 1/n therefore remains. Its
/// sign changes between rows with the positions of the ends.
fn by_sum(pupil: &PupilOtf, frequency: DVec2, blur: f64, n: usize) -> f64 {
    let lag = pupil.point(frequency);
    let slope = pupil.foreshortening * lag * blur;
    let contains =
        |u: DVec2| (pupil.aperture).contains(u / DVec2::new(1.0, pupil.aperture.ratio()));
    let (mut sum, mut open) = (0.0, 0.0);
    for k in 0..n * n {
        let u = (DVec2::new((k % n) as f64, (k / n) as f64) + 0.5) / n as f64 * 2.0 - 1.0;
        open += f64::from(contains(u));
        if contains(u + lag / 2.0) && contains(u - lag / 2.0) {
            sum += (2.0 * PI * u.dot(slope)).cos();
        }
    }
    sum / open
}

/// Returns [`PupilOtf::otf`] for a single frequency in f64, as a reference.
fn transfer(pupil: &PupilOtf, frequency: DVec2, blur: f64) -> f64 {
    let rule = gauss_legendre(20 + blur.abs().ceil() as usize);
    let lag = pupil.point(frequency);
    let slope = pupil.foreshortening * lag * blur;
    let ratio = pupil.aperture.ratio();
    match pupil.aperture {
        Aperture::Square => {
            let left = (DVec2::ONE - lag.abs()).max(DVec2::ZERO);
            left.x * left.y * sinc(slope.x * left.x) * sinc(slope.y * left.y)
        }
        Aperture::Circle | Aperture::Ellipse(_) => {
            // The ellipse is scaled to a disc. Two discs overlap in a lens shape, integrated in
            // strips across the lag.
            let (lag, slope) = (
                lag * DVec2::new(1.0, 1.0 / ratio),
                slope * DVec2::new(1.0, ratio),
            );
            let length = lag.length();
            if length >= 1.0 {
                return 0.0;
            }
            let along = lag.try_normalize().unwrap_or(DVec2::X);
            let (by, across) = (slope.dot(along), slope.dot(along.perp()));
            let widest = length.acos();
            let strip = |&(x, weight): &(f64, f64)| {
                let (sin, cos) = (x * widest).sin_cos();
                let phase = PI * by * (cos - length);
                weight * sin * sin * phase.cos() * sinc(across * sin)
            };
            4.0 / PI * widest * rule.iter().map(strip).sum::<f64>()
        }
    }
}

#[test]
fn the_transfer_is_the_pupils_autocorrelation() {
    for aperture in [Aperture::Circle, Aperture::Square, Aperture::Ellipse(0.4)] {
        for (place, tilt) in [
            (DVec2::new(400.0, 300.0), 0.0),
            (DVec2::new(10.0, 580.0), 15.0),
        ] {
            let pupil = pupil(aperture, place, tilt);
            let to_frequency = pupil.grains.transpose();
            for lag in [
                [0.0, 0.0],
                [0.3, 0.0],
                [0.0, 0.2],
                [-0.15, 0.25],
                [0.6, 0.1],
            ] {
                for blur in [0.0, 1.5, -8.0, 40.0] {
                    let frequency = to_frequency * DVec2::from(lag);
                    let ours = transfer(&pupil, frequency, blur);
                    let [x, y] = frequency.to_array().map(|f| f32x8::splat(f as f32));
                    let eight = pupil
                        .otf([x, y], blur, &PupilOtf::cubature_rule(blur))
                        .to_array()[3];
                    // Tolerance: f32 rounding of phases up to about 40 rad.
                    assert!((eight as f64 - ours).abs() < 1e-5, "{eight} {ours}");
                    let sum = by_sum(&pupil, frequency, blur, 1000);
                    assert!(
                        (ours - sum).abs() < 1e-3,
                        "{aperture:?} {place} {lag:?} {blur}: {ours} {sum}"
                    );
                }
            }
        }
    }
}

/// Transfer functions agree with the reference for random frequencies and blurs. Near the axis they
/// are tabulated with the stated error, elsewhere they are integrated.
#[test]
fn passes_are_transfers() {
    let key = RngKey::new(3, Purpose::SpecklePattern);
    let (mut by_table, mut summed) = (0, 0);
    for (aperture, tilt) in [(Aperture::Circle, 12.0), (Aperture::Ellipse(0.6), 0.0)] {
        for i in 0..60 {
            let uniform = |k: u64| key.with(i).uniform(k);
            let place = DVec2::new(uniform(0) * 800.0, uniform(1) * 600.0);
            let pupil = pupil(aperture, place, tilt);
            let blur = (uniform(2) - 0.5) * 2.0 * 200f64.powf(uniform(3));
            let lag = |k: u64| DVec2::new(uniform(10 + k) - 0.5, uniform(60 + k) - 0.5);
            // Frequencies are concentrated where the transfer function of the blur is significant.
            let shrunk = |k: u64| lag(k) * 2.0 / (1.0 + (k % 3) as f64 * blur.abs() / 2.0);
            let frequencies: Vec<DVec2> = (0..43)
                .map(|k| pupil.grains.transpose() * shrunk(k))
                .collect();
            let near =
                pupil.direction.length_squared() <= 0.06 && blur.abs() < circular_otf::MAX_BLUR;
            let tabulated = near && aperture == Aperture::Circle;
            by_table += i32::from(tabulated);
            summed += i32::from(!tabulated);
            let bound = if tabulated { 1e-3 } else { 5e-5 };
            let passes = pupil.passes(&frequencies).at(blur);
            for (&frequency, pass) in frequencies.iter().zip(passes) {
                let expected = transfer(&pupil, frequency, blur);
                assert!(
                    (pass as f64 - expected).abs() < bound,
                    "{aperture:?} {place} {blur} {frequency}: {pass} {expected}"
                );
            }
        }
    }
    assert!(by_table > 20 && summed > 60, "{by_table} {summed}");
}

/// A defocused point is blurred to the shadow of the pupil. Its edge is where a ray through the
/// pupil's edge hits the sensor, for a thin lens.
#[test]
fn the_reach_is_the_shadow_of_the_pupil() {
    for tilt in [0.0, 15.0] {
        let mut camera = fixture();
        camera.tilt = DVec2::X * f64::to_radians(tilt);
        let place = DVec2::new(700.0, 80.0);
        let pupil = PupilOtf::new(&camera, place, WAVELENGTH);
        let point = camera.direction(place) * 180.0;
        let image_z = camera.lens.image_of(point.z).unwrap();
        // Image of the point, and sensor positions of rays to it from the edge of the pupil.
        let to_image = camera.sensor_point(place) * (image_z / camera.sensor_point(place).z);
        let normal = camera.model().sensor_axes().z_axis;
        let edge = |angle: f64| {
            let x = DVec2::from_angle(angle).extend(0.0) * camera.lens.pupil_diameter() / 2.0;
            let way = to_image - x;
            let t = normal.dot(camera.sensor_point(DVec2::ZERO) - x) / normal.dot(way);
            let axes = camera.model().sensor_axes();
            let off = x + way * t - camera.sensor_point(place);
            DVec2::new(axes.x_axis.dot(off), axes.y_axis.dot(off)) / camera.sensor.pixel_pitch
        };
        let edges: Vec<DVec2> = (0..64).map(|i| edge(i as f64 * PI / 32.0)).collect();
        let most = edges.iter().map(|e| e.abs()).fold(DVec2::ZERO, DVec2::max);
        let vergence = 1.0 / point.z - 1.0 / 25.0 + 1.0 / camera.sensor_point(place).z;
        let blur = camera.lens.pupil_diameter().powi(2) / WAVELENGTH * vergence;
        let reach = pupil.reach(blur.abs(), 0.0);
        // Tolerance: the grain size at the position is used for the complete blur, over which it
        // varies on a tilted sensor.
        assert!(
            (reach / most - 1.0).abs().max_element() < 0.02,
            "{tilt}: {reach} {most}"
        );
    }
}
