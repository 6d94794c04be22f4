//! Topography of surfaces in the points, compared with meshes that contain the same heights.

use crate::random::Random;
use lasertrace::math::DVec3;
use lasertrace::math::rng::{Purpose, RngKey};
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use lasertrace::surface::Topography;
use std::collections::BTreeMap;
use std::fmt::Write;
use std::fs;
use std::path::Path;
use tempfile::TempDir;

/// Sizes of the part in x and y, mm.
const SIZE: [f64; 2] = [3.8, 1.5];
const FRAMES: u32 = 12;

/// Surface, line and pose of a part.
struct Case {
    seed: u64,
    sq_um: f64,
    length_mm: f64,
    /// Standard deviation of the line, mm.
    u_position_mm: f64,
    rotation_deg: [f64; 3],
    surface: &'static str,
}

impl Case {
    fn scene(&self, folder: &Path, shape: &str, topography: bool) -> Scene {
        let heights = match topography {
            true => format!(
                "topography = {{ sq_um = {}, length_mm = {} }}\n",
                self.sq_um, self.length_mm
            ),
            false => String::new(),
        };
        let text = format!(
            "seed = {}\nspeckle = false\n[part]\n{shape}\nrotation_deg = {:?}\n[part.surface]\n{}\n{heights}\
             [laser]\nwavelength_nm = 660\npower_mw = 1\nwaist_radius_um = {}\nwaist_distance_mm = 150\n\
             position_mm = [0, 0, 150]\ndirection = [0, 0, -1]\n\
             line = {{ fan_deg = 10, profile = \"uniform\", direction = [1, 0, 0] }}\n\
             [camera]\nfocal_length_mm = 25\nf_number = 8\nfocus_distance_mm = 150\n\
             resolution_px = [128, 128]\npixel_pitch_um = 5\nposition_mm = [0, -75, 130]\n\
             look_at_mm = [0, 0, 0]\ncolumn_axis = [1, 0, 0]\nexposure = \"auto\"\nauto_exposure_target = 0.6\n\
             quantum_efficiency = 0.5\ngain_dn_per_e = 2\nbit_depth = 16\nfull_well_e = 30000\n\
             [scan]\nstart_mm = [0, -0.3, 0]\ndirection = [0, 1, 0]\nstep_mm = 0.05\nframes = {FRAMES}\n[model]\nmax_bounces = 1\ndefocus_model = \"none\"\n",
            self.seed,
            self.rotation_deg,
            self.surface,
            2e3 * self.u_position_mm
        );
        Scene::parse(&text, folder).unwrap()
    }

    fn topography(&self) -> Topography {
        let key = RngKey::new(self.seed, Purpose::Topography).with(0);
        Topography::new(1e-3 * self.sq_um, [self.length_mm; 2], None, key)
    }

    /// Writes a plane with the heights of the topography as a mesh.
    fn write_mesh(&self, path: &Path) {
        let topography = self.topography();
        // Linear interpolation changes the variance by a sixth of the squared phase per step: 0.2 %.
        let step = self.length_mm / 16.0;
        let cells = SIZE.map(|size| (size / step).ceil() as usize);
        let mut text = String::new();
        for j in 0..=cells[1] {
            for i in 0..=cells[0] {
                let [x, y] = [(i, 0), (j, 1)]
                    .map(|(i, axis)| SIZE[axis] * (i as f64 / cells[axis] as f64 - 0.5));
                let z = topography.height(DVec3::new(x, y, 0.0));
                writeln!(text, "v {x} {y} {z}").unwrap();
            }
        }
        let row = cells[0] + 1;
        for j in 0..cells[1] {
            for i in 0..cells[0] {
                let a = j * row + i + 1;
                writeln!(text, "f {a} {} {}", a + 1, a + row + 1).unwrap();
                writeln!(text, "f {a} {} {}", a + row + 1, a + row).unwrap();
            }
        }
        fs::write(path, text).unwrap();
    }

    /// Returns the heights of both clouds by frame and column, µm: topography, mesh.
    fn heights(&self) -> BTreeMap<(u32, u32), [f64; 2]> {
        let folder = TempDir::new().unwrap();
        let folder = folder.path();
        self.write_mesh(&folder.join("heights.obj"));
        let plane = format!("plane = {{ size_mm = {SIZE:?} }}");
        let mesh = "mesh = { file = \"heights.obj\", unit = \"mm\" }";
        let of = |shape: &str, topography| {
            let scene = self.scene(folder, shape, topography);
            let simulation = Simulation::new(&scene).unwrap();
            let frames = (0..FRAMES).flat_map(|frame| simulation.take(frame).2);
            let points = frames.map(|p| ((p.frame, p.column), 1e3 * p.position.z));
            points.collect::<BTreeMap<_, _>>()
        };
        let (smooth, rough) = (of(&plane, true), of(mesh, false));
        let pairs = smooth
            .iter()
            .filter_map(|(&at, &z)| Some((at, [z, *rough.get(&at)?])));
        pairs.collect()
    }
}

/// Statistics of the heights of both clouds: topography, mesh.
struct Compared {
    /// Mean squares, µm².
    mean_square: [f64; 2],
    /// Mean squares of differences at a lag of 2, 6 and 18 columns, µm².
    structure: [[f64; 2]; 3],
    /// Mean square of the difference of both clouds, µm².
    difference: f64,
}

impl Compared {
    fn of(case: &Case) -> Compared {
        let heights = case.heights();
        let mean_square = |of: &dyn Fn(&[f64; 2]) -> f64| {
            let values: Vec<f64> = heights.values().map(of).collect();
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            values.iter().map(|z| (z - mean).powi(2)).sum::<f64>() / values.len() as f64
        };
        let structure = |lag: u32, i: usize| {
            let pairs = heights.iter().filter_map(|(&(frame, column), z)| {
                Some((heights.get(&(frame, column + lag))?[i] - z[i]).powi(2))
            });
            let squares: Vec<f64> = pairs.collect();
            squares.iter().sum::<f64>() / squares.len() as f64
        };
        Compared {
            mean_square: [0, 1].map(|i| mean_square(&|z| z[i])),
            structure: [2, 6, 18].map(|lag| [0, 1].map(|i| structure(lag, i))),
            difference: mean_square(&|z| z[0] - z[1]),
        }
    }
}

/// Returns a case whose autocorrelation length is `ratio` standard deviations of the line.
fn case(seed: u64, ratio: f64, surface: &'static str) -> Case {
    let mut random = Random::new(seed);
    let u_position_mm = random.between(0.035, 0.055);
    let length_mm = u_position_mm * ratio;
    Case {
        seed,
        // Slopes of 0.02 rms.
        sq_um: 10.0 * length_mm,
        length_mm,
        u_position_mm,
        rotation_deg: [
            random.between(-15.0, 15.0),
            random.between(-10.0, 10.0),
            0.0,
        ],
        surface,
    }
}

const MATT: &str = "diffuse = { reflectance = 0.5 }";

/// Variance and structure function agree to 2 % where line and pixels resolve the heights.
fn assert_resolved(case: &Case) {
    let compared = Compared::of(case);
    let [ours, mesh] = compared.mean_square;
    println!(
        "{} seed {} sigma {:.3} length {:.3}: variance {:.4}, structure {:.4?}, difference {:.4}",
        case.surface,
        case.seed,
        case.u_position_mm,
        case.length_mm,
        ours / mesh,
        compared.structure.map(|[ours, mesh]| ours / mesh),
        (compared.difference / mesh).sqrt()
    );
    assert!((ours / mesh - 1.0).abs() < 0.02, "{ours} {mesh}");
    for [ours, mesh] in &compared.structure[1..] {
        assert!((ours / mesh - 1.0).abs() < 0.02, "{ours} {mesh}");
    }
}

#[test]
fn the_cloud_has_the_heights_of_a_mesh() {
    for seed in 1..4 {
        assert_resolved(&case(seed, 16.0, MATT));
    }
}

/// The line attenuates heights that it does not resolve to less than 80 % of Sq. Both clouds agree to 2 % of Sq.
#[test]
fn the_line_attenuates_fine_heights() {
    for seed in 1..4 {
        let case = case(seed, 2.5, MATT);
        let compared = Compared::of(&case);
        let relative = |square: f64| square.sqrt() / case.sq_um;
        let [ours, mesh] = compared.mean_square.map(relative);
        println!("seed {seed}: {ours:.4} {mesh:.4} of Sq");
        assert!(ours < 0.8 && mesh < 0.8, "{ours} {mesh}");
        assert!((ours - mesh).abs() < 0.02, "{ours} {mesh}");
    }
}

/// The gloss of a coat changes the weight of inclined facets.
#[test]
fn coated_surfaces_have_the_heights_of_a_mesh() {
    for seed in 1..4 {
        let coat = "coated_diffuse = { index = 1.5, roughness = 0.4, reflectance = 0.5 }";
        assert_resolved(&case(seed, 16.0, coat));
    }
}

/// Without the key, and with heights of 0, points are byte-identical. The field is the same from another pose:
/// a plane rotated by 180° about its normal under a rotated sensor path shows the same heights at the same
/// places of the part.
#[test]
fn the_field_is_fixed_to_the_part() {
    let folder = TempDir::new().unwrap();
    let folder = folder.path();
    let plane = format!("plane = {{ size_mm = {SIZE:?} }}");
    let smooth = Case {
        sq_um: 0.0,
        rotation_deg: [0.0; 3],
        ..case(7, 16.0, MATT)
    };
    let points = |case: &Case, topography| {
        let simulation = Simulation::new(&case.scene(folder, &plane, topography)).unwrap();
        (0..FRAMES)
            .flat_map(|frame| simulation.take(frame).2)
            .collect::<Vec<_>>()
    };
    let bits = |points: &[lasertrace::inspect::cloud::CloudPoint]| {
        let all = points
            .iter()
            .map(|p| p.position.to_array().map(f64::to_bits));
        all.collect::<Vec<_>>()
    };
    assert_eq!(bits(&points(&smooth, true)), bits(&points(&smooth, false)));
    for seed in [7, 8, 9] {
        let case = Case {
            rotation_deg: [0.0; 3],
            ..case(seed, 16.0, MATT)
        };
        let turned = Case {
            rotation_deg: [0.0, 0.0, 180.0],
            ..case
        };
        let field = case.topography();
        let expected = case.sq_um;
        for case in [&case, &turned] {
            let points = points(case, true);
            let n = points.len() as f64;
            let error = |p: &lasertrace::inspect::cloud::CloudPoint| {
                let on_plane = DVec3::new(p.position.x, p.position.y, 0.0);
                (1e3 * (p.position.z - field.height(on_plane))).powi(2)
            };
            let rms = (points.iter().map(error).sum::<f64>() / n).sqrt();
            // The line averages heights: 1.5·κ² of a wave, with κ = 1.8/16 for each direction.
            let averaged = 1.5 * (1.794_f64 / 16.0).powi(2) * 3f64.sqrt();
            assert!(
                points.len() > 1000 && rms < 1.5 * averaged * expected,
                "{rms} {expected}"
            );
        }
    }
}
