//! Surfaces of groups of a mesh's triangles: which has which, over borders and in speckle, and mistakes.

use lasertrace::accel::TriangleClusters;
use lasertrace::frame::{Sampling, TracedRegion, irradiance};
use lasertrace::run::{RunControl, Simulation, check};
use lasertrace::scene::Scene;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// A plate of 20 × 20 mm whose left part is `left` and whose right part is `right`; their border runs askew through
/// (0, 0).
const PLATE: &str = "v -10 -10 0\nv 2 -10 0\nv -2 10 0\nv -10 10 0\nv 10 -10 0\nv 10 10 0\n\
                     g left\nusemtl one\nf 1 2 3 4\ng right\nusemtl two words\nf 2 5 6 3\n";

/// The same with numbers for names.
const NUMBERED: &str = "ply\nformat ascii 1.0\nelement vertex 6\nproperty float x\nproperty float y\n\
                        property float z\nelement face 2\nproperty list uchar int vertex_indices\n\
                        property int material_index\nend_header\n-10 -10 0\n2 -10 0\n-2 10 0\n-10 10 0\n\
                        10 -10 0\n10 10 0\n4 0 1 2 3 0\n4 1 4 5 2 7\n";

fn folder(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR"))
        .join("groups")
        .join(name);
    std::fs::create_dir_all(&folder).unwrap();
    folder
}

/// A scene with this mesh and these lines of its part, in a folder of its own.
fn scene(name: &str, mesh: &str, part: &str, speckle: &str) -> Result<Scene, String> {
    let text = format!(
        "seed = 3\n{speckle}\n\n[part]\nmesh = {{ file = \"mesh\", unit = \"mm\" }}\n{part}\n
[laser]
wavelength_nm = 660
power_mw = 5
waist_radius_um = 60
waist_distance_mm = 150
position_mm = [0, 0, 150]
direction = [0, 0, -1]
line = {{ fan_deg = 6, profile = \"uniform\", direction = [1, 0, 0] }}

[camera]
focal_length_mm = 50
f_number = 11
focus_distance_mm = 150
resolution_px = [{COLUMNS}, 200]
pixel_pitch_um = 4
position_mm = [0, -106.066017, 106.066017]
look_at_mm = [0, 0, 0]
column_axis = [1, 0, 0]
exposure_ms = 1
quantum_efficiency = 0.5
gain_dn_per_e = 0.2
bit_depth = 12
full_well_e = 20000

[scan]
direction = [0, 1, 0]
start_mm = [0, 0, 0]
step_mm = 0.3
frames = {FRAMES}
"
    );
    let folder = folder(name);
    std::fs::write(folder.join("mesh"), mesh).unwrap();
    Scene::parse(&text, &folder).map_err(|error| error.to_string())
}

/// Light of each column of a frame, and the whole image.
fn light(scene: &Scene, sampling: Option<Sampling>) -> (Vec<f64>, Vec<f32>) {
    let simulation = Simulation::new(scene).unwrap();
    let clusters = TriangleClusters::new(&scene.mesh);
    let mut view = simulation.view(0);
    view.sampling = sampling.unwrap_or(view.sampling);
    let image = irradiance(&view, &TracedRegion::Lit(&clusters)).dense();
    assert!(image == irradiance(&view, &TracedRegion::All).dense());
    (columns(&image), image)
}

/// Light of each column of an image.
fn columns(image: &[f32]) -> Vec<f64> {
    let of = |column: usize| image[column..].iter().step_by(COLUMNS);
    let sum = |column| of(column).map(|&e| f64::from(e)).sum();
    (0..COLUMNS).map(sum).collect()
}

const COLUMNS: usize = 1600;
/// So far apart that speckle of each is its own.
const FRAMES: u32 = 8;

const LEFT: std::ops::Range<usize> = 300..700;
const RIGHT: std::ops::Range<usize> = 900..1300;

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Each side is as bright as a plate that is all of its surface, to the bytes of f32 where no pixel sees the other;
/// OBJ by group, by material, and PLY.
#[test]
fn each_group_has_its_surface() {
    let matt = |r: f64| format!("diffuse = {{ reflectance = {r} }}");
    let metal = "metal = { name = \"aluminium\", roughness = 0.3 }";
    let all = |surface: &str| format!("[part.surface]\n{surface}");
    let whole = |name: &str, surface: &str| {
        let scene = scene(name, PLATE, &all(surface), "speckle = false").unwrap();
        light(&scene, None).1
    };
    let (grey, shiny) = (whole("grey", &matt(0.5)), whole("shiny", metal));
    for (name, mesh, right) in [
        ("group", PLATE, "right"),
        ("material", PLATE, "\"two words\""),
        ("number", NUMBERED, "7"),
    ] {
        let part = format!("{}\n[part.surfaces.{right}]\n{metal}", all(&matt(0.5)));
        let scene = scene(name, mesh, &part, "speckle = false").unwrap();
        assert_eq!(scene.surface.counts(scene.mesh.triangles.len()), [2, 2]);
        let (_, mixed) = light(&scene, None);
        for (columns, alone) in [(LEFT, &grey), (RIGHT, &shiny)] {
            for i in
                (0..200).flat_map(|row| columns.clone().map(move |column| COLUMNS * row + column))
            {
                assert_eq!(mixed[i], alone[i], "{name} {i}");
            }
        }
    }
}

/// Pixels that both groups are seen in: a ray for every sample finds the border, and so does one ray a pixel, which
/// must not pass over it. Of a pixel that the border crosses the nearer of nine centres may all be one side's
/// only where the sliver beyond is thinner than half a pixel's corner.
#[test]
fn no_pixel_is_taken_for_flat_across_a_border() {
    let part = "surface = { diffuse = { reflectance = 0.9 } }\n[part.surfaces.right]\ndiffuse = { reflectance = 0.1 }";
    let scene = scene("border", PLATE, part, "speckle = false").unwrap();
    let (planes, _) = light(&scene, Some(Sampling::Planes));
    let (rays, _) = light(&scene, Some(Sampling::Rays));
    let bright = mean(&planes[LEFT]);
    // Rays differ over a pixel by what a plane's pixel takes as the same: 1e-3.
    for (column, (a, b)) in planes.iter().zip(&rays).enumerate() {
        assert!((a - b).abs() < 2e-3 * bright, "{column}: {a} {b}");
    }
    assert!((bright / mean(&planes[RIGHT]) - 9.0).abs() < 0.05);
}

/// Metal keeps the light's polarisation and matt paint loses it: contrasts of 1 and √½ (Goodman 2007, section 3.4), in one
/// image. By the columns' light: with C²/N for N grains along a column, and the same N on either side, the ratio of
/// the variances is 2.
#[test]
fn speckle_has_the_contrast_of_its_group() {
    let part = "surface = { diffuse = { reflectance = 0.5 } }\n[part.surfaces.right]\nmetal = { name = \"iron\", roughness = 0.4 }";
    let mut ratios = Vec::new();
    for blur in ["none", "incoherent", "coherent"] {
        let named = format!("{part}\n[model]\ndefocus_model = {blur:?}");
        let scene = scene(&format!("contrast-{blur}"), PLATE, &named, "speckle = true").unwrap();
        let simulation = Simulation::new(&scene).unwrap();
        let mut squares = [0.0; 2];
        for frame in 0..FRAMES {
            let columns = columns(&simulation.irradiance(frame).dense());
            for (sum, side) in squares.iter_mut().zip([LEFT, RIGHT]) {
                let middle = mean(&columns[side.clone()]);
                let off = columns[side].iter().map(|c| (c / middle - 1.0).powi(2));
                *sum += off.sum::<f64>();
            }
        }
        ratios.push((blur, squares[1] / squares[0]));
    }
    eprintln!("variance of metal over that of paint: {ratios:?}");
    // Grains are h = λ·d/D = 15 µm wide, 3.7 columns: of 400 columns some 100 are independent, of eight frames 800 on a
    // side. A variance of an integrated exponential scatters by √(3/800) at the most (its kurtosis is below 3 plus that
    // of few grains), the ratio of two by 9 %; four of that.
    for (blur, ratio) in ratios {
        assert!((ratio / 2.0 - 1.0).abs() < 0.36, "{blur} {ratio}");
    }
}

/// Facets less steep than half the pupil's angle (50/11/2/150 = 0.015) cannot rise by a quarter of a wavelength within a
/// grain: `check` says so, of speckle only.
#[test]
fn smooth_metal_is_warned_of() {
    let control = RunControl {
        progress: &|_| {},
        setup_progress: None,
        notice: None,
        stop: &AtomicBool::new(false),
    };
    for (roughness, speckle, warned) in [(0.012, true, 1), (0.012, false, 0), (0.02, true, 0)] {
        let part = format!(
            "reflectance = 0.5\n[part.surfaces.right]\nmetal = {{ name = \"iron\", roughness = {roughness} }}"
        );
        let speckle = format!("speckle = {speckle}");
        let scene = scene("smooth", PLATE, &part, &speckle).unwrap();
        let checked = check(&scene, &control).unwrap();
        let words = "too smooth for speckle";
        let found = checked
            .warnings
            .iter()
            .filter(|w| w.message.contains(words));
        assert_eq!(found.count(), warned, "{roughness} {speckle}");
    }
}

/// One degree of polarisation for all parts the speckle of different surfaces not.
#[test]
fn a_degree_that_is_given_holds_for_all() {
    let part = "polarisation_degree = 0.5\nsurface = { diffuse = { reflectance = 0.5 } }\n\
                [part.surfaces.right]\nmetal = { name = \"iron\", roughness = 0.4 }";
    let scene = scene("degree", PLATE, part, "speckle = true").unwrap();
    assert!(!scene.surface.polarisation_differs());
}

#[test]
fn mistakes_name_what_the_mesh_has() {
    let matt = "diffuse = { reflectance = 0.5 }";
    for (name, mesh, part, words) in [
        (
            "unknown",
            PLATE,
            format!("reflectance = 0.5\n[part.surfaces.middle]\n{matt}"),
            "part.surfaces.middle: found [part.surfaces.middle], expected a name of the mesh: left, one, right, two words",
        ),
        (
            "twice",
            PLATE,
            format!("reflectance = 0.5\n[part.surfaces.left]\n{matt}\n[part.surfaces.one]\n{matt}"),
            "some triangles are in left and one",
        ),
        (
            "nameless",
            "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
            format!("reflectance = 0.5\n[part.surfaces.left]\n{matt}"),
            "the mesh names no groups of triangles",
        ),
        (
            "no-default",
            PLATE,
            format!("[part.surfaces.left]\n{matt}"),
            "expected reflectance = ... in [part], or a table [part.surface]",
        ),
        (
            "rough",
            PLATE,
            "reflectance = 0.5\n[part.surfaces.left]\nmetal = { name = \"iron\", roughness = 2 }"
                .to_owned(),
            "part.surfaces.left.metal.roughness: found 2",
        ),
        (
            "misspelt",
            PLATE,
            "reflectance = 0.5\n[part.surfaces.left]\nmetl = { name = \"iron\", roughness = 0.2 }"
                .to_owned(),
            "did you mean metal?",
        ),
        (
            "not-a-table",
            PLATE,
            "reflectance = 0.5\nsurfaces = 3".to_owned(),
            "a table of keys",
        ),
    ] {
        let error = scene(name, mesh, &part, "speckle = false")
            .err()
            .expect(name);
        assert!(error.contains(words), "{name}: {error}");
    }
    let two = format!(
        "surface = {{ {matt} }}\n[part.surfaces.left]\nmetal = {{ name = \"iron\", roughness = 0.2 }}"
    );
    let trilinear = "speckle = true\nspeckle_method = \"trilinear\"";
    let error = scene("trilinear", PLATE, &two, trilinear).err().unwrap();
    assert!(error.contains("field, as surfaces differ"), "{error}");
}
