//! The laser's field of flux against closed forms.

use lasertrace::laser::{Beam, Fan, FanProfile, Laser};
use lasertrace::math::DVec3;
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use std::f64::consts::PI;
use std::path::Path;

fn beam() -> Beam {
    Beam {
        wavelength: 660e-6,
        power_mw: 5.0,
        waist_radius: 0.02,
        waist_distance: 150.0,
        m_squared: 1.0,
    }
}

/// Power through the plane through (0, 0, `distance`) whose normal is tilted by
/// `tilt` about x and `roll` about z, by the rectangle rule with `n`² cells over
/// ±`extent` in the plane. On a smooth function that vanishes at the border the
/// rule converges faster than any power of n (Trefethen & Weideman 2014).
fn power_through(laser: &Laser, distance: f64, tilt: f64, extent: [f64; 2], n: usize) -> f64 {
    let normal = DVec3::new(0.0, tilt.sin(), -tilt.cos());
    let (u, v) = (DVec3::X, DVec3::new(0.0, tilt.cos(), tilt.sin()));
    let at = |i: usize, half: f64| half * ((2 * i + 1) as f64 / n as f64 - 1.0);
    let cell = 4.0 * extent[0] * extent[1] / (n * n) as f64;
    let mut sum = 0.0;
    for i in 0..n {
        for j in 0..n {
            let p = DVec3::Z * distance + u * at(i, extent[0]) + v * at(j, extent[1]);
            if let Some(light) = laser.at(p) {
                sum -= light.flux.dot(normal) * cell;
            }
        }
    }
    sum
}

/// The cutoff at 4 radii drops e⁻³² of a round beam and less of a sheet; 400
/// nodes across 4.5 radii leave a quadrature error below that, so rounding of
/// 160 000 terms (1e-13) rules: 1e-12 is demanded. On a tilted plane the beam's
/// border is cut where w differs, which costs no more.
#[test]
fn power_through_planes_equals_the_power_of_a_round_beam() {
    let laser = Laser {
        beam: beam(),
        fan: None,
    };
    // From 60 mm on, even the plane tilted by 80° meets the beam before the
    // aperture nowhere.
    for distance in [60.0, 150.0, 151.0, 400.0] {
        for tilt in [0.0f64, 0.3, 1.0, 80f64.to_radians()] {
            let w = laser.beam.radius(distance);
            // The tilted cut reaches where the beam is wider or narrower.
            let reach = (1..40).fold(w, |w, _| {
                laser
                    .beam
                    .radius(distance + 4.2 * w * tilt.tan())
                    .max(laser.beam.radius(distance - 4.2 * w * tilt.tan()))
            });
            let extent = [4.2 * reach, 4.2 * reach / tilt.cos()];
            let power = power_through(&laser, distance, tilt, extent, 600);
            let error = power / laser.beam.power_mw - 1.0;
            assert!(error.abs() < 1e-12, "{distance} {tilt}: {error:e}");
        }
    }
}

/// A Gaussian fan vanishes smoothly at its ends (as far as ±π/2 lets it) and is
/// integrated like the round beam; the plane must hold x = ρ·tan φ out to where
/// exp(-2φ²/φ_w²) is e⁻³², φ = 4φ_w = 40° here.
#[test]
fn power_through_planes_equals_the_power_of_a_sheet() {
    let fan = Fan {
        angle: 20f64.to_radians(),
        profile: FanProfile::Gaussian,
    };
    let laser = Laser {
        beam: beam(),
        fan: Some(fan),
    };
    for (distance, tilt) in [(100.0, 0.0f64), (150.0, 0.4), (300.0, -1.0)] {
        let half_x = distance * 40f64.to_radians().tan();
        let w = laser
            .beam
            .radius(distance)
            .max(laser.beam.radius(distance / 40f64.to_radians().cos()));
        let extent = [half_x, 6.0 * w / tilt.cos()];
        let power = power_through(&laser, distance, tilt, extent, 1200);
        let error = power / laser.beam.power_mw - 1.0;
        assert!(error.abs() < 1e-9, "{distance} {tilt}: {error:e}");
    }
}

/// Whatever the fan, p(φ) integrates to 1. The uniform one jumps at its ends:
/// the midpoint rule is off by at most one cell in 20 000.
#[test]
fn fan_profiles_hold_all_the_power() {
    for profile in [FanProfile::Uniform, FanProfile::Gaussian] {
        for degrees in [0.1f64, 30.0, 90.0, 179.0] {
            let fan = Fan {
                angle: degrees.to_radians(),
                profile: profile.clone(),
            };
            let n = 200_000;
            let reach = (PI / 2.0).min(4.0 * fan.angle);
            let step = 2.0 * reach / n as f64;
            let sum: f64 = (0..n)
                .map(|i| fan.power_per_radian(-reach + (i as f64 + 0.5) * step) * step)
                .sum();
            assert!(
                (sum - 1.0).abs() < step / fan.angle + 1e-9,
                "{fan:?}: {sum}"
            );
        }
    }
}

#[test]
fn radius_follows_the_closed_form() {
    let beam = Beam {
        m_squared: 1.3,
        ..beam()
    };
    let (w0, lambda) = (0.02, 660e-6);
    for z in [0.0, 100.0, 150.0, 170.0, 1000.0] {
        // The seed's form, with M² multiplying λ.
        let x: f64 = (z - 150.0) * lambda * 1.3 / (w0 * w0 * PI);
        let expected = w0 * (1.0 + x * x).sqrt();
        assert!((beam.radius(z) / expected - 1.0).abs() < 1e-14);
    }
    assert!((beam.radius(150.0 + beam.rayleigh_range()) / w0 - 2f64.sqrt()).abs() < 1e-14);
}

#[test]
fn irradiance_on_axis_is_the_closed_form() {
    let beam = beam();
    let point = Laser { beam, fan: None };
    let line = Laser {
        beam,
        fan: Some(Fan {
            angle: 0.5,
            profile: FanProfile::Uniform,
        }),
    };
    for z in [1.0, 150.0, 320.0] {
        let w = beam.radius(z);
        let p = DVec3::new(0.0, 0.0, z);
        let on_axis = point.at(p).unwrap().flux;
        assert!((on_axis.z / (2.0 * 5.0 / (PI * w * w)) - 1.0).abs() < 1e-14);
        assert_eq!((on_axis.x, on_axis.y), (0.0, 0.0));
        let on_sheet = line.at(p).unwrap().flux;
        let expected = 5.0 / 0.5 / z * (2.0 / PI).sqrt() / w;
        assert!((on_sheet.z / expected - 1.0).abs() < 1e-14);
    }
    assert!(point.at(DVec3::new(0.0, 0.0, -1.0)).is_none());
    assert!(
        line.at(DVec3::new(60.0, 0.0, 100.0)).is_none(),
        "past the fan"
    );
}

/// The aperture point keeps relative radius and azimuth.
#[test]
fn aperture_points_keep_their_relative_radius() {
    let laser = Laser {
        beam: beam(),
        fan: None,
    };
    let p = DVec3::new(0.02, -0.01, 180.0);
    let s = laser.at(p).unwrap().aperture_point;
    let scale = laser.beam.radius(0.0) / laser.beam.radius(180.0);
    assert!((s - DVec3::new(0.02, -0.01, 0.0) * scale).length() < 1e-15);
}

/// Returns the irradiance of a plane at 40° to a line laser, without speckle.
fn irradiance(folder: &Path, laser: &str) -> lasertrace::error::Result<Vec<f32>> {
    let text = format!(
        "seed = 1\nspeckle = false\n[part]\nplane = {{ size_mm = [60, 60] }}\n\
         rotation_deg = [0, 40, 0]\nreflectance = 0.5\n\
         [laser]\nwavelength_nm = 660\npower_mw = 1\nwaist_distance_mm = 150\n\
         position_mm = [0, 0, 150]\ndirection = [0, 0, -1]\n{laser}\n\
         [camera]\nfocal_length_mm = 16\nf_number = 8\nfocus = \"laser-plane\"\n\
         resolution_px = [240, 160]\npixel_pitch_um = 20\n\
         position_mm = [0, -80, 140]\nlook_at_mm = [0, 0, 0]\ncolumn_axis = [1, 0, 0]\n\
         exposure = \"auto\"\nquantum_efficiency = 0.5\ngain_dn_per_e = 0.1\n\
         bit_depth = 12\nfull_well_e = 20000\n\
         [scan]\nframes = 1\nstep_mm = 0\ndirection = [0, 1, 0]\n"
    );
    let scene = Scene::parse(&text, folder)?;
    Ok(Simulation::new(&scene)?.irradiance(0).dense())
}

/// Returns a CSV file of a line profile.
fn profile(half_deg: f64, count: i32, sample: impl Fn(f64) -> [f64; 2]) -> String {
    let mut text = "angle_deg,power,width\n".to_owned();
    for i in -count..=count {
        let angle = half_deg * f64::from(i) / f64::from(count);
        let [power, width] = sample(angle);
        text += &format!("{angle},{power},{width}\n");
    }
    text
}

/// Images with a measured profile equal images with the same profile from a closed form.
///
/// - A constant profile is a uniform fan, up to rounding of f32 sums.
/// - A Gaussian sampled in steps s of its 1/e² half angle deviates by s²/8 times its largest relative
///   curvature of 4 between the samples: 5e-5 for s = 0.01. The light beyond four half angles is 1e-14.
/// - A line of twice the width has the twofold waist radius and the fourfold M², so that the Rayleigh
///   range is equal.
#[test]
fn images_with_measured_profiles_equal_those_of_closed_forms() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: String| std::fs::write(folder.path().join(name), text).unwrap();
    write("constant.csv", profile(12.0, 7, |_| [3.0, 1.0]));
    write(
        "gaussian.csv",
        profile(16.0, 400, |angle| {
            [(-2.0 * (angle / 4.0).powi(2)).exp(), 1.0]
        }),
    );
    write("wide.csv", profile(12.0, 7, |_| [3.0, 2.0]));
    let line = |fan: f64, profile: &str| {
        format!("line = {{ fan_deg = {fan}, profile = {profile}, direction = [1, 0, 0] }}")
    };
    let file = |fan: f64, name: &str| line(fan, &format!("{{ file = \"{name}\" }}"));
    let beam = |radius: f64, m_squared: f64| {
        format!("waist_radius_um = {radius}\nm_squared = {m_squared}\n")
    };
    let uniform = line(24.0, "\"uniform\"");
    for (measured, closed, tolerance) in [
        (
            beam(60.0, 1.0) + &file(24.0, "constant.csv"),
            beam(60.0, 1.0) + &uniform,
            1e-6,
        ),
        (
            beam(60.0, 1.0) + &file(32.0, "gaussian.csv"),
            beam(60.0, 1.0) + &line(8.0, "\"gaussian\""),
            1e-3,
        ),
        (
            beam(60.0, 1.0) + &file(24.0, "wide.csv"),
            beam(120.0, 4.0) + &uniform,
            1e-6,
        ),
    ] {
        let [found, expected] =
            [&measured, &closed].map(|laser| irradiance(folder.path(), laser).unwrap());
        let greatest = expected.iter().copied().fold(0.0, f32::max);
        let error = |(a, b): (&f32, &f32)| (a - b).abs() / greatest;
        let error = found.iter().zip(&expected).map(error).fold(0.0, f32::max);
        assert!(greatest > 0.0 && error < tolerance, "{error} {measured}");
    }
}

/// A linear change of the power along the fan appears in the light of the columns.
///
/// The ratio to the light of a uniform fan is the power at the angle of the column over the mean power.
/// It is between 1/2 and 3/2, monotonic, and below 0.8 and above 1.2 at the ends of the visible line.
#[test]
fn power_along_the_fan_appears_in_the_columns() {
    let folder = tempfile::tempdir().unwrap();
    let text = profile(12.0, 1, |angle| [2.0 + angle / 12.0, 1.0]);
    std::fs::write(folder.path().join("ramp.csv"), text).unwrap();
    let of = |profile: &str| {
        let laser = format!(
            "waist_radius_um = 60\nline = {{ fan_deg = 24, profile = {profile}, direction = [1, 0, 0] }}"
        );
        let light = irradiance(folder.path(), &laser).unwrap();
        let column = |x: usize| {
            light
                .iter()
                .skip(x)
                .step_by(240)
                .map(|&e| f64::from(e))
                .sum::<f64>()
        };
        (0..240).map(column).collect::<Vec<f64>>()
    };
    let [ramp, uniform] = [of("{ file = \"ramp.csv\" }"), of("\"uniform\"")];
    // Beyond the plane, the light consists of the tails of the lens blur.
    let least = 1e-2 * uniform.iter().copied().fold(0.0, f64::max);
    let lit: Vec<f64> = ramp
        .iter()
        .zip(&uniform)
        .filter(|(_, uniform)| **uniform > least)
        .map(|(ramp, uniform)| ramp / uniform)
        .collect();
    let [first, last] = [lit[0], lit[lit.len() - 1]];
    let rises = lit.windows(2).all(|pair| pair[1] > pair[0]);
    let falls = lit.windows(2).all(|pair| pair[1] < pair[0]);
    assert!(lit.len() > 100 && (rises || falls), "{} columns", lit.len());
    let [low, high] = [first.min(last), first.max(last)];
    assert!(
        (0.5..0.8).contains(&low) && (1.2..1.5).contains(&high),
        "{low} {high}"
    );
}

/// The word `file` without the name of a file is refused, and the message has the correct form.
#[test]
fn a_profile_without_a_file_is_refused() {
    let laser = "waist_radius_um = 60\n\
                 line = { fan_deg = 24, profile = \"file\", direction = [1, 0, 0] }";
    let message = irradiance(Path::new(""), laser).unwrap_err().to_string();
    assert!(
        message.contains("expected a table { file = … }"),
        "{message}"
    );
}
