//! Scene files cut off and with turned bits, and what must hold of any input: parsers,
//! transforms, the camera and its inverse, the pattern's wrap, peak finders.

use crate::program::{PLANE, folder_with, scene};
use glam::UVec2;
use lasertrace::camera::Counts;
use lasertrace::camera::{CameraModel, Distortion};
use lasertrace::math::{DVec2, DVec3, Rigid};
use lasertrace::mesh::{self, Mesh};
use lasertrace::profile::{PeakFinder, PeakSettings, find_peaks};
use lasertrace::scene::Scene;
use lasertrace::speckle::coordinate::Coordinate;
use lasertrace::speckle::lookup::{Coherence, Method, SpeckleTexture};
use lasertrace::speckle::pattern::PatternSpec;
use proptest::prelude::*;
use std::fs;
use std::path::Path;
use std::sync::LazyLock;

/// A scene loads to finite poses, or is refused in one line with what was expected.
fn loads(path: &Path) -> bool {
    match Scene::load(path) {
        Ok(scene) => {
            assert!(!scene.mesh.triangles.is_empty());
            for frame in [0, scene.scan.frames - 1] {
                let pose = scene.part_from_head(frame);
                assert!(pose.translation.is_finite() && pose.rotation.is_finite());
            }
            true
        }
        Err(error) => {
            let text = error.to_string();
            assert!(text.contains("expected"), "{text}");
            assert_eq!((text.lines().count(), error.exit_code()), (1, 65), "{text}");
            false
        }
    }
}

/// A scene that reads its poses from a file and is measured by a calibration.
fn scene_of_files() -> tempfile::TempDir {
    let text = scene(PLANE).replace(
        "frames = 3\nstep_mm = 0.5\ndirection = [0, 1, 0]\n",
        "poses = \"path.csv\"\n",
    );
    let folder = folder_with(&format!("{text}\n[measure]\ncalibration = \"c.json\"\n"));
    let poses = "x_mm,y_mm,z_mm,qw,qx,qy,qz\n0,1,2,1,0,0,0\n0.5,-1e-1,2,0,0,0,1\n";
    fs::write(folder.path().join("path.csv"), poses).unwrap();
    let calibration = r#"{
"camera": {"resolution_px": [64, 48], "pixel_pitch_um": 30, "principal_distance_mm": 18.5,
"principal_point_px": [32, 24], "tilt_deg": [0, 0]},
"head_from_camera": {"rotation_vector_rad": [2.6, 0, 0], "position_mm": [0, -57.5, 99.6]},
"laser_plane": {"point_mm": [0, 0, 100], "normal": [0, 0.6, 0.8]}}
"#;
    fs::write(folder.path().join("c.json"), calibration).unwrap();
    folder
}

/// Every truncation and every turned bit of a scene and of the files beside it.
#[test]
fn scene_files_cut_off_or_with_a_turned_bit_load_or_are_refused() {
    let folder = scene_of_files();
    let main = folder.path().join("scene.toml");
    assert!(
        Scene::load(&main).is_ok(),
        "{}",
        Scene::load(&main).err().unwrap()
    );
    for name in ["scene.toml", "path.csv", "c.json"] {
        let file = folder.path().join(name);
        let whole = fs::read(&file).unwrap();
        let mut loaded = 0;
        for end in 0..whole.len() {
            fs::write(&file, &whole[..end]).unwrap();
            loaded += loads(&main) as usize;
        }
        // A table that is missing or half a table has no value for its keys; numbers
        // of the last line, or that end a file, may be cut.
        assert!(
            loaded < 60,
            "{name}: {loaded} of {} cuts went unnoticed",
            whole.len()
        );
        for bit in 0..8 * whole.len() {
            let mut bytes = whole.clone();
            bytes[bit / 8] ^= 1 << (bit % 8);
            fs::write(&file, &bytes).unwrap();
            loads(&main);
        }
        fs::write(&file, &whole).unwrap();
    }
}

/// A mesh of some triangles in each of the formats.
fn written(corners: &[[f32; 3]], faces: &[[usize; 3]]) -> Vec<Vec<u8>> {
    let mut stl = vec![b' '; 80];
    stl.extend((faces.len() as u32).to_le_bytes());
    let mut ascii = String::from("solid a b\n");
    let mut obj = String::new();
    let header = |format: &str| {
        format!(
            "ply\nformat {format} 1.0\nelement vertex {}\nproperty float x\nproperty float y\n\
             property float z\nelement face {}\nproperty list uchar int vertex_indices\n\
             end_header\n",
            corners.len(),
            faces.len()
        )
    };
    let mut text = header("ascii");
    let mut big = header("binary_big_endian").into_bytes();
    for [x, y, z] in corners {
        obj += &format!("v {x:e} {y:?} {z}\n");
        text += &format!("{x} {y:e} {z:?}\n");
        big.extend([x, y, z].iter().flat_map(|c| c.to_be_bytes()));
    }
    for face in faces {
        stl.extend([0; 12]);
        ascii += "facet normal nan 0 0\nouter loop\n";
        for [x, y, z] in face.map(|v| corners[v]) {
            stl.extend([x, y, z].iter().flat_map(|c| c.to_le_bytes()));
            ascii += &format!("vertex {x} {y:?} {z:e}\n");
        }
        stl.extend([7; 2]);
        ascii += "endloop\nendfacet\n";
        let [a, b, c] = face;
        obj += &format!("f {}/1 {}//2 -{}\n", a + 1, b + 1, corners.len() - c);
        text += &format!("3 {a} {b} {c}\n");
        big.push(3);
        big.extend([a, b, c].iter().flat_map(|&&i| (i as u32).to_be_bytes()));
    }
    ascii += "endsolid\n";
    vec![
        stl,
        ascii.into_bytes(),
        obj.into_bytes(),
        text.into_bytes(),
        big,
    ]
}

fn corner() -> impl Strategy<Value = [f32; 3]> {
    // Small numbers too, so that some corners are the same, and those that no
    // decimal of seven digits tells apart.
    let coordinate = || {
        prop_oneof![
            (-3i8..3).prop_map(f32::from),
            -1e6f32..1e6,
            -1e-30f32..1e-30
        ]
    };
    [coordinate(), coordinate(), coordinate()]
}

fn unit() -> impl Strategy<Value = DVec3> {
    let half = -1.0..1.0f64;
    (half.clone(), half.clone(), half)
        .prop_map(DVec3::from)
        .prop_filter("a length", |v| (0.1..1.0).contains(&v.length()))
        .prop_map(DVec3::normalize)
}

/// Any pose; half of them from a hint that is 1 to 10⁻⁵ rad beside z.
fn pose(reach: f64) -> impl Strategy<Value = Rigid> {
    let beside = prop_oneof![Just(None), (0.0..5.0f64).prop_map(Some)];
    (unit(), unit(), unit(), 0.0..reach, beside).prop_filter_map(
        "parallel",
        |(z, x, at, far, beside)| {
            let hint = beside.map_or(x, |power| z + x * 10f64.powf(-power));
            Rigid::from_z_and_x(at * far, z, hint)
        },
    )
}

static PATTERN: LazyLock<[SpeckleTexture; 2]> = LazyLock::new(|| {
    let spec = PatternSpec {
        size: 128,
        slices: 16,
        ..PatternSpec::default()
    };
    [Method::Trilinear, Method::Field]
        .map(|method| SpeckleTexture::new(&spec, method, Coherence::FULL).unwrap())
});

fn row(counts: &[u16], finder: PeakFinder) -> Option<f64> {
    let settings = PeakSettings {
        finder,
        ..PeakSettings::new(u16::MAX)
    };
    let peaks = find_peaks(&Counts::of_rows(counts, 1), &settings);
    peaks.first().map(|peak| peak.row)
}

proptest! {
    /// Every format gives the same triangles over the same numbers.
    #[test]
    fn formats_agree_on_any_mesh(
        corners in prop::collection::vec(corner(), 3..12),
        picks in prop::collection::vec([0usize..64, 0..64, 0..64], 1..12),
    ) {
        let faces: Vec<_> = picks.iter().map(|f| f.map(|v| v % corners.len())).collect();
        let files = written(&corners, &faces);
        let read = |bytes: &Vec<u8>| mesh::parse(Path::new("a"), bytes, 1.0).unwrap();
        let first: Mesh = read(&files[0]);
        for (i, face) in faces.iter().enumerate() {
            let expected = face.map(|v| DVec3::from(corners[v].map(f64::from)));
            prop_assert_eq!(first.triangle(i), expected);
        }
        for file in &files[1..] {
            // Their numbers were written by f32, and are read as f64.
            let mut other = read(file);
            for p in &mut other.positions {
                *p = p.as_vec3().as_dvec3();
            }
            prop_assert_eq!(&other.triangles, &first.triangles);
            prop_assert_eq!(&other.positions, &first.positions);
        }
    }

    /// A transform and its inverse, and two after each other: 16 roundings of the
    /// lengths that meet in it.
    #[test]
    fn transforms_invert_and_compose(a in pose(1e6), b in pose(1e6), p in unit(), far in 0.0..1e6f64) {
        let p = p * far;
        let bound = 16.0 * f64::EPSILON * (p.length() + a.translation.length() + b.translation.length());
        prop_assert!(a.inverse().point(a.point(p)).distance(p) <= bound);
        prop_assert!((a * b).point(p).distance(a.point(b.point(p))) <= bound);
        prop_assert!((a.vector(p).length() - p.length()).abs() <= bound);
        prop_assert!((a.rotation.determinant() - 1.0).abs() < 1e-14);
    }

    /// What a pixel looks at is seen by that pixel, through any tilt and distortion
    /// that is taken: to 1e-9 px, as Newton's inverse converges.
    #[test]
    fn the_camera_sees_a_point_where_it_looks(
        tilt in (-60.0..60.0f64, -60.0..60.0f64), radial in [-0.3..0.3f64, -0.1..0.1, -0.1..0.1],
        tangential in [-0.01..0.01f64, -0.01..0.01], at in (0.0..1.0f64, 0.0..1.0f64),
        distance in 1e-3..1e6f64, focal in 8.0..100.0f64,
    ) {
        let mut model = CameraModel {
            resolution: UVec2::new(1280, 512),
            pixel_pitch: 0.0055,
            principal_distance: focal,
            principal_point: DVec2::new(611.0, 270.0),
            tilt: DVec2::new(tilt.0.to_radians(), tilt.1.to_radians()),
            distortion: None,
        };
        if let Some(reach) = model.reach() {
            model.distortion = Distortion::new(radial, tangential, reach).ok();
        }
        let pixel = DVec2::new(at.0 * 1280.0, at.1 * 512.0);
        let seen = model.direction(pixel);
        prop_assert!((seen.length() - 1.0).abs() < 1e-14);
        let back = model.project(seen * distance).expect("it lies before the lens");
        prop_assert!(back.distance(pixel) < 1e-9, "{back} {pixel}");
        prop_assert!(model.project(-seen * distance).is_none());
    }

    /// The pattern repeats in all three coordinates. f32 cells: a coordinate of 10⁶ is
    /// known to 2⁻³³ of a texel in f64, which is nothing beside the weights' 2⁻²⁴.
    #[test]
    fn the_pattern_wraps(s in -1e3..1e3f64, t in -1e3..1e3f64, u in -99.0..99.0f64, n in -99i32..99) {
        let n = f64::from(n);
        for lookup in PATTERN.iter() {
            let here = lookup.intensity(Coordinate { s, t, u });
            prop_assert!(here.is_finite() && here >= 0.0);
            for [i, j, k] in [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, -2.0, 3.0]] {
                let there = Coordinate {
                    s: s + i * n * 128.0,
                    t: t + j * n * 128.0,
                    u: u + k * n * 16.0,
                };
                prop_assert!((lookup.intensity(there) - here).abs() < 1e-4 * (1.0 + here));
            }
        }
    }

    /// A line of any shape on a dark column: moved by whole pixels it is found as much
    /// further on; with 2 or 3 times the counts where it was. A centroid's window
    /// settles to 1e-6 px; so do the fits' steps. The Gaussian fit only of lines that
    /// are one hump: on others its squares have several minima, and rounding may
    /// decide which is met.
    #[test]
    fn finders_follow_shift_and_scale(
        line in prop::collection::vec(0u16..9000, 1..14), peak in 9000u16..15000,
        sigma in 0.7..3.0f64, skew in 0.0..1.2f64, share in 0.0..1.0f64,
        shift in 1usize..200, gain in 2u16..4,
    ) {
        let mut line = line;
        let middle = line.len() / 2;
        line[middle] = peak;
        let hump: Vec<u16> = (0..40)
            .map(|i| {
                let x = f64::from(i) - 20.3;
                let at = |x: f64| (-0.5 * (x / sigma).powi(2)).exp();
                (f64::from(peak) * (at(x) + share * at(x - skew * sigma)) / 2.0) as u16
            })
            .collect();
        let column = |line: &[u16], at: usize, gain: u16| {
            let mut counts = vec![0u16; 600];
            for (count, value) in counts[at..].iter_mut().zip(line) {
                *count = value * gain;
            }
            counts
        };
        for finder in PeakFinder::ALL {
            let line = match finder {
                PeakFinder::GaussianFit => &hump,
                _ => &line,
            };
            let here = row(&column(line, 150, 1), finder).expect("a line");
            let moved = row(&column(line, 150 + shift, 1), finder).expect("a line");
            let brighter = row(&column(line, 150, gain), finder).expect("a line");
            prop_assert!((moved - here - shift as f64).abs() < 1e-5, "{finder:?} {here} {moved}");
            prop_assert!((brighter - here).abs() < 1e-5, "{finder:?} {here} {brighter}");
        }
    }
}
