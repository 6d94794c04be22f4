//! Measures how errors grow as methods come to their limits and draws
//! `docs/limits.svg`, the picture of LIMITS.md. From the project's root:
//!
//!     cargo run --release --example limits_plots

#[path = "../../tests/common/random.rs"]
mod random;
mod rays;

use glam::DVec2;
use lasertrace::camera::Counts;
use lasertrace::inspect::cloud::CloudPoint;
use lasertrace::math::Aperture;
use lasertrace::profile::{Flags, Peak, PeakSettings, find_peaks};
use lasertrace::report::limits_plot::{LimitsCurve, LimitsPanel, limits_plot};
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use lasertrace::speckle::lookup::{Coherence, Coordinate, Method, SpeckleTexture};
use lasertrace::speckle::pattern::PatternSpec;
use lasertrace::speckle::theory::integrated_contrast;
use std::path::Path;

fn main() {
    let panels = [
        rays::poses(),
        rays::slivers(),
        rays::shells(),
        wall(),
        saturation(),
        border(),
        grains(),
        lookups(),
    ];
    for panel in &panels {
        println!("{}: {} over {}", panel.title, panel.y, panel.x);
        for curve in &panel.curves {
            println!("  {}", curve.label);
            for (x, y) in &curve.points {
                println!("    {x:10.3e} {y:10.3e}");
            }
        }
    }
    std::fs::write("docs/limits.svg", limits_plot(&panels)).expect("docs/ of the project");
}

/// A scene of the repository with some of its text replaced.
fn scene(name: &str, changes: &[(&str, String)]) -> Scene {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("scenes")
        .join(name);
    let mut text = std::fs::read_to_string(folder.join("scene.toml")).unwrap();
    for (from, to) in changes {
        assert!(text.contains(from), "{name}: {from}");
        text = text.replace(from, to);
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.toml");
    std::fs::write(&path, text).unwrap();
    Scene::load(&path).unwrap()
}

fn measured(scene: &Scene) -> Vec<CloudPoint> {
    let simulation = Simulation::new(scene).unwrap();
    let frame = |frame| {
        let counts = simulation.counts(frame, &simulation.irradiance(frame));
        simulation.measure(frame, &counts).1
    };
    (0..scene.scan.frames).flat_map(frame).collect()
}

/// A plane that comes near to being parallel to the light.
fn wall() -> LimitsPanel {
    let (mut off, mut stated) = (Vec::new(), Vec::new());
    for from_parallel in [60.0, 30.0, 20.0, 10.0, 7.0, 5.0, 3.0, 2.0, 1.0, 0.5, 0.2] {
        let turn = format!("rotation_deg = [{}, 0, 0]", 90.0 - from_parallel);
        let points = measured(&scene(
            "limits/grazing",
            &[("rotation_deg = [88, 0, 0]", turn)],
        ));
        if points.is_empty() {
            continue;
        }
        let worst = |of: &dyn Fn(&CloudPoint) -> f64| points.iter().map(of).fold(0.0, f64::max);
        off.push((from_parallel, 1e3 * worst(&|p| p.deviation.abs())));
        stated.push((from_parallel, 2e3 * worst(&|p| p.u_deviation)));
    }
    LimitsPanel {
        title: "Plane along the light",
        x: "angle between plane and light, °",
        y: "µm, worst of three frames",
        powers: (-2, 2),
        curves: vec![
            LimitsCurve {
                label: "off",
                points: off,
            },
            LimitsCurve {
                label: "stated (2σ)",
                points: stated,
            },
        ],
    }
}

const SIGMA: f64 = 3.0;
const FULL_SCALE: f64 = 1023.0;

/// The peak of a line of two Gaussians, one of `second` of the other's height and 2σ
/// behind it, in a column of 400 rows; with the centre of gravity of its light.
fn synthetic(row: f64, height: f64, second: f64) -> (Option<Peak>, f64) {
    let light = |i: f64, row: f64| {
        let edge = |y: f64| libm::erf((y - row) / (SIGMA * 2f64.sqrt()));
        (edge(i + 1.0) - edge(i)) / 2.0 * SIGMA * std::f64::consts::TAU.sqrt()
    };
    let count = |i: usize| {
        let shape = light(i as f64, row) + second * light(i as f64, row + 2.0 * SIGMA);
        (height * shape + 8.0).round().min(FULL_SCALE) as u16
    };
    let counts: Vec<u16> = (0..400).map(count).collect();
    let peaks = find_peaks(
        &Counts::of_rows(&counts, 1),
        &PeakSettings::new(FULL_SCALE as u16),
    );
    let truth = row + second / (1.0 + second) * 2.0 * SIGMA;
    (peaks.first().copied(), truth)
}

/// Root mean square over places in the pixel of a peak's error, px; NaN without one.
fn error(row: f64, height: f64, second: f64) -> f64 {
    let squares = (0..16).map(|i| {
        let (peak, truth) = synthetic(row + i as f64 / 16.0, height, second);
        peak.map_or(f64::NAN, |peak| (peak.row - truth).powi(2))
    });
    (squares.sum::<f64>() / 16.0).sqrt()
}

fn saturation() -> LimitsPanel {
    let factors = [0.3, 0.7, 1.0, 1.5, 2.0, 4.0, 10.0, 30.0, 100.0, 1000.0];
    let of = |second: f64| {
        let at = |&factor: &f64| (factor, error(200.0, factor * FULL_SCALE, second));
        factors.iter().map(at).collect()
    };
    LimitsPanel {
        title: "Saturation",
        x: "height of the line / full scale",
        y: "error of the centroid, px (σ = 3 px)",
        powers: (-5, 1),
        curves: vec![
            LimitsCurve {
                label: "symmetric line",
                points: of(0.0),
            },
            LimitsCurve {
                label: "with half as much light 2σ beside it",
                points: of(0.5),
            },
        ],
    }
}

fn border() -> LimitsPanel {
    let (mut off, mut flagged) = (Vec::new(), Vec::new());
    for distance in [
        0.1, 0.3, 0.6, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 7.0, 10.0,
    ] {
        let row = distance * SIGMA;
        let border = |peak: &Peak| peak.flags.contains(Flags::IMAGE_BORDER);
        let curve = match synthetic(row, 600.0, 0.0).0.as_ref().is_some_and(border) {
            true => &mut flagged,
            false => &mut off,
        };
        curve.push((distance, error(row, 600.0, 0.0)));
    }
    LimitsPanel {
        title: "Sensor's border",
        x: "distance from the line's middle / σ",
        y: "error of the centroid, px (σ = 3 px)",
        powers: (-5, 1),
        curves: vec![
            LimitsCurve {
                label: "without a flag",
                points: off,
            },
            LimitsCurve {
                label: "flag IMAGE_BORDER",
                points: flagged,
            },
        ],
    }
}

/// Error of a plane's points over what is stated, by the number of grains across the line.
fn grains() -> LimitsPanel {
    let (mut ratio, mut outside) = (Vec::new(), Vec::new());
    for f_number in [2.8, 5.6, 11.0, 22.0, 45.0, 64.0, 90.0, 128.0, 200.0f64] {
        let exposure = 0.05 * (f_number / 8.0).powi(2);
        let scene = scene(
            "plane",
            &[
                ("speckle = false", "speckle = true".into()),
                ("waist_radius_um = 30", "waist_radius_um = 120".into()),
                ("f_number = 8", format!("f_number = {f_number}")),
                ("exposure_ms = 0.05", format!("exposure_ms = {exposure}")),
                ("full_well_e = 20000", "full_well_e = 200000".into()),
                (
                    "gain_dn_per_e = 0.2",
                    "gain_dn_per_e = 0.04\nread_noise_e = 5".into(),
                ),
                ("step_mm = 0.1", "step_mm = 0.5".into()),
            ],
        );
        let points = measured(&scene);
        let grain = scene.camera.speckle_size(scene.laser.beam.wavelength);
        // Twice the standard deviation of the line in pixels: it is 12 px of 10 µm wide.
        let across = 12.0 * scene.camera.sensor.pixel_pitch / grain;
        let squares = points.iter().map(|p| (p.deviation / p.u_deviation).powi(2));
        let rms = (squares.sum::<f64>() / points.len() as f64).sqrt();
        let flagged = points
            .iter()
            .filter(|p| p.flags.contains(Flags::UNCERTAINTY_NOT_VALID));
        let curve = match 2 * flagged.count() > points.len() {
            true => &mut outside,
            false => &mut ratio,
        };
        curve.push((across, rms));
    }
    LimitsPanel {
        title: "Few grains across the line",
        x: "2w of the line / grain",
        y: "true over stated standard deviation",
        powers: (-1, 1),
        curves: vec![
            LimitsCurve {
                label: "most without a flag",
                points: ratio,
            },
            LimitsCurve {
                label: "most flagged UNCERTAINTY_NOT_VALID",
                points: outside,
            },
        ],
    }
}

/// Patterns of two seeds.
fn rings(method: Method) -> Vec<SpeckleTexture> {
    let ring = |seed| {
        let spec = PatternSpec {
            size: 512,
            seed,
            ..PatternSpec::default()
        };
        SpeckleTexture::new(&spec, method, Coherence::FULL).unwrap()
    };
    (1..=2).map(ring).collect()
}

/// Contrast of pixels of `q` grains by `side` × `side` readings each.
fn contrast(rings: &[SpeckleTexture], q: f64, side: usize) -> f64 {
    const LEVELS: usize = 32;
    let width = q * PatternSpec::default().texels_per_speckle;
    // Half a texel more than a grain, so that every fraction of a texel is met.
    let step = width.max(4.5);
    let cells = (512.0 / step) as usize;
    let (mut n, mut sum, mut squares) = (0.0, 0.0, 0.0);
    for ring in rings {
        for cell in 0..LEVELS * cells * cells {
            let corner = DVec2::new((cell % cells) as f64, (cell / cells % cells) as f64) * step;
            let reading = |k: usize| {
                let off = DVec2::new((k % side) as f64, (k / side) as f64) + 0.5;
                let at = corner + off * width / side as f64;
                let u = (cell / (cells * cells)) as f64 * 2.03;
                ring.intensity(Coordinate {
                    s: at.x,
                    t: at.y,
                    u,
                }) as f64
            };
            let value = (0..side * side).map(reading).sum::<f64>() / (side * side) as f64;
            n += 1.0;
            sum += value;
            squares += value * value;
        }
    }
    let mean: f64 = sum / n;
    (squares / n - mean * mean).sqrt() / mean
}

fn lookups() -> LimitsPanel {
    let off = |rings: &[SpeckleTexture], q: f64, side: usize| {
        let theory = integrated_contrast(Aperture::Circle, q);
        (q, (contrast(rings, q, side) / theory - 1.0).abs())
    };
    let sizes = [0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0];
    let by_readings = |method| {
        let rings = rings(method);
        sizes.iter().map(|&q| off(&rings, q, 6)).collect()
    };
    LimitsPanel {
        title: "Contrast of speckle over a pixel",
        x: "pixel / grain",
        y: "relative error (chance: to 0.005 left, 0.02 right)",
        powers: (-4, 0),
        curves: vec![
            LimitsCurve {
                label: "intensities, trilinear, 6 × 6 readings",
                points: by_readings(Method::Trilinear),
            },
            LimitsCurve {
                label: "fields, 6 × 6 readings",
                points: by_readings(Method::Field),
            },
        ],
    }
}
