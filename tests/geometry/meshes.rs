//! Mesh files as they come: real parts, broken and unusual files, and every
//! truncation and byte change of small ones.

use std::fs;
use std::path::{Path, PathBuf};

use lasertrace::mesh::{self, Mesh, Orientation};

/// What must come of a file: triangles, boundary edges, non-manifold edges and
/// winding conflicts; or words of the error.
enum Outcome {
    Counts(usize, usize, usize, usize),
    Error(&'static str),
}
use Outcome::{Counts, Error};

fn shared(folder: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let path = path.join(folder);
    if path.is_dir() {
        return Some(path);
    }
    eprintln!(
        "\n*** NOT TESTED: {} is absent, so no real mesh was read. ***\n",
        path.display()
    );
    None
}

/// Loads every file of a folder, and fails with a list of all disagreements,
/// files without an expectation included.
fn check(folder: &str, expected: &[(&str, Outcome)]) {
    let Some(path) = shared(folder) else { return };
    let mut wrong = Vec::new();
    for entry in fs::read_dir(path).unwrap() {
        let file = entry.unwrap().path();
        let name = file.file_name().unwrap().to_str().unwrap();
        let Some((_, outcome)) = expected.iter().find(|(n, _)| *n == name) else {
            wrong.push(format!("{name}: no outcome is stated for it"));
            continue;
        };
        let found = mesh::load(&file, 1.0);
        match (outcome, &found) {
            (Counts(triangles, boundary, non_manifold, winding), Ok(mesh)) => {
                assert_valid(mesh);
                let r = mesh::report(mesh);
                let counts = [
                    r.triangles,
                    r.boundary_edges,
                    r.non_manifold_edges,
                    r.winding_conflicts,
                ];
                if counts != [*triangles, *boundary, *non_manifold, *winding] {
                    wrong.push(format!("{name}: {counts:?}"));
                }
            }
            (Error(words), Err(error)) if error.to_string().contains(words) => {
                assert!(error.to_string().contains(name), "{error}");
                assert_eq!(error.exit_code(), 65, "{error}");
            }
            _ => wrong.push(format!(
                "{name}: {:?}",
                found.map(|m| m.triangles.len()).map_err(|e| e.to_string())
            )),
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

fn assert_valid(mesh: &Mesh) {
    let vertices = mesh.positions.len();
    assert!(!mesh.triangles.is_empty());
    assert!(
        mesh.triangles
            .as_flattened()
            .iter()
            .all(|&v| (v as usize) < vertices)
    );
    assert!(mesh.positions.iter().all(|p| p.is_finite()));
}

/// The figures are those of the folder's manifest, found by another program.
#[test]
fn real_parts_load_with_the_known_counts() {
    check(
        "meshes",
        &[
            ("NIST_MBE_PMI_1.stp", Error("STEP")),
            ("NIST_MBE_PMI_11.stp", Error("STEP")),
            ("NIST_MBE_PMI_3.stp", Error("STEP")),
            ("NIST_MBE_PMI_5.stp", Error("STEP")),
            ("tinymovr_gimbal_bracket.stp", Error("STEP")),
            ("trimesh_featuretype.STEP", Error("STEP")),
            ("NIST_MBE_PMI_1_l0.1.stl", Counts(5192, 0, 0, 0)),
            ("NIST_MBE_PMI_3_l0.1.stl", Counts(4980, 0, 0, 0)),
            ("NIST_MBE_PMI_5_l0.1.stl", Counts(33460, 0, 0, 0)),
            ("NIST_MBE_PMI_5_l1.stl", Counts(4084, 0, 0, 0)),
            ("abb6640_cylinder.stl", Counts(12828, 0, 0, 204)),
            ("abb6640_link_5.stl", Counts(26238, 0, 0, 118)),
            ("gotti_gear.ply", Counts(34756, 0, 0, 0)),
            ("numpystl_bwb.stl", Counts(4464, 0, 0, 0)),
            ("prius_hybrid_body.obj", Counts(1676, 86, 70, 70)),
            ("sick_Hinge.ply", Counts(17047, 3, 0, 0)),
            ("trimesh_1002_tray_bottom.STL", Counts(4520, 0, 0, 0)),
            ("trimesh_ADIS16480.STL", Counts(7436, 0, 0, 0)),
            ("trimesh_cycloidal.ply", Counts(43368, 0, 242, 484)),
            ("trimesh_featuretype.STL", Counts(3476, 576, 0, 0)),
            ("trimesh_octagonal_pocket.stl", Counts(3262, 54, 0, 0)),
            ("trimesh_plate_holes.STL", Counts(1252, 0, 0, 0)),
            ("trimesh_unit_sphere.STL", Counts(1280, 0, 0, 0)),
        ],
    );
}

#[test]
#[expect(clippy::too_many_lines, reason = "a table of one row a case")]
fn every_nasty_file_gives_the_right_mesh_or_an_error_that_names_the_problem() {
    check(
        "nasty",
        &[
            (
                "3mf_MUSTFAIL_Chapter3.4b_MissingBuildElement.3mf",
                Error("without a build"),
            ),
            (
                "3mf_MUSTPASS_Chapter3.2b_UnitsMeasurementMM.3mf",
                Counts(12, 0, 0, 0),
            ),
            ("assimp_box_UTF16BE.obj", Error("UTF-16")),
            ("assimp_box_without_lineending.obj", Counts(12, 0, 0, 0)),
            // The manifest's 63, 2, 3 are of a fan, which overlaps itself here.
            ("assimp_concave_polygon.obj", Counts(64, 64, 0, 0)),
            (
                "assimp_cube_binary_header_with_RN_newline.ply",
                Counts(12, 0, 0, 0),
            ),
            ("assimp_empty.obj", Error("empty")),
            ("assimp_empty.ply", Error("empty")),
            // Announces a list that no vertex has.
            (
                "assimp_issue623.ply",
                Error("623.ply:14: found the end of the line"),
            ),
            ("assimp_malformed.obj", Error("vertex \"0\"")),
            ("assimp_malformed2.obj", Counts(10, 4, 0, 0)),
            ("assimp_triangle_with_empty_solid.stl", Counts(1, 3, 0, 0)),
            ("assimp_triangle_with_two_solids.stl", Counts(2, 6, 0, 0)),
            ("d_ascii_comma_decimal.stl", Error("comma")),
            ("d_ascii_fortran_exp.stl", Counts(50, 44, 0, 0)),
            ("d_ascii_name_with_facet.stl", Counts(400, 288, 0, 0)),
            // With a warning.
            ("d_ascii_no_endsolid.stl", Counts(400, 288, 0, 0)),
            ("d_ascii_tabs_crlf_upper.stl", Counts(400, 288, 0, 0)),
            ("d_ascii_trunc.stl", Error("cut off")),
            ("d_ascii_utf16.stl", Error("UTF-16")),
            ("d_ascii_utf8_bom.stl", Counts(400, 288, 0, 0)),
            ("d_big_endian.ply", Counts(1760, 0, 0, 0)),
            ("d_big_endian_double.ply", Counts(1760, 0, 0, 0)),
            ("d_binary_header_solid_facet.stl", Counts(400, 288, 0, 0)),
            ("d_coplanar_shell_0p1um.stl", Counts(3520, 0, 0, 0)),
            (
                "d_count_ffffffff.stl",
                Error("announces 4294967295 triangles and holds 200"),
            ),
            (
                "d_count_too_big.stl",
                Error("announces 1200 triangles and holds 200"),
            ),
            (
                "d_count_too_small.stl",
                Error("announces 150 triangles and holds 200"),
            ),
            ("d_dup_faces.stl", Counts(2346, 0, 1062, 1758)),
            ("d_face_count_too_big.ply", Error("cut off")),
            ("d_half_flipped.stl", Counts(1760, 0, 0, 1266)),
            ("d_hole.stl", Counts(1753, 21, 0, 0)),
            ("d_html_error_page.stl", Error("HTML")),
            ("d_in_metres.stl", Counts(1760, 0, 0, 0)),
            (
                "d_index_out_of_range.ply",
                Error("vertex 855, expected one of the 848"),
            ),
            ("d_inside_out.stl", Counts(1760, 0, 0, 0)),
            ("d_list_before_indices_ushort.ply", Counts(300, 198, 0, 0)),
            (
                "d_mixed_bad.obj",
                Error("bad.obj:24: found a face with vertex \"0\""),
            ),
            (
                "d_nan_inf_vertices.stl",
                Error("triangle 61 with a corner at (NaN"),
            ),
            ("d_nan_normals.stl", Counts(1760, 0, 0, 0)),
            ("d_nonmanifold_fin.stl", Counts(1761, 2, 1, 1)),
            ("d_offset_utm.obj", Counts(1760, 0, 0, 0)),
            ("d_offset_utm_f32.stl", Counts(1760, 0, 0, 0)),
            ("d_trunc_header.stl", Error("60 bytes")),
            (
                "d_trunc_mid_triangle.stl",
                Error("holds 880 and 17 bytes of another"),
            ),
            ("d_zero_area.stl", Counts(1810, 100, 50, 50)),
            ("f3d_lfs_suzanne.stl", Error("git lfs pull")),
            ("manifold_boxNotManifold.obj", Counts(12, 4, 0, 0)),
            (
                "manifold_openscad-nonmanifold-crash.obj",
                Counts(1442, 0, 18, 36),
            ),
            ("numpystl_stl_ascii_Moon_Chinese.stl", Counts(116, 0, 0, 0)),
            ("numpystl_stl_binary_Cube.stl", Counts(12, 0, 0, 0)),
            (
                "numpystl_stl_binary_CubeInvalidUnicode.stl",
                Counts(12, 0, 0, 0),
            ),
            ("numpystl_stl_tests_dos.stl", Counts(116, 0, 0, 0)),
            ("numpystl_stl_tests_unix.stl", Counts(116, 0, 0, 0)),
            ("o3dv_cube_rgb_binary.ply", Counts(12, 0, 0, 0)),
            (
                "o3dv_single_triangle_negative_indices.obj",
                Counts(1, 3, 0, 0),
            ),
            ("o3dv_single_triangle_with_comments.stl", Counts(1, 3, 0, 0)),
            ("tinyobj_invalid-face-definition.obj", Error("no triangles")),
            (
                "tinyobj_invalid-relative-vertex-index.obj",
                Error("vertex \"-4\""),
            ),
            // The manifest's program takes index 0 for the last vertex.
            (
                "tinyobj_issue-140-zero-face-idx.obj",
                Error("vertex \"0/0/0\""),
            ),
            (
                "tinyobj_leading-decimal-dot-issue-201.obj",
                Counts(1, 3, 0, 0),
            ),
            (
                "tinyobj_leading-zero-in-exponent-notation-issue-210.obj",
                Counts(1, 3, 0, 0),
            ),
            // The manifest's program counts negative indices from the file's
            // end (hence its 28 duplicates), not from the face.
            ("tinyobj_missing_material_file.obj", Counts(36, 8, 0, 0)),
            ("tinyobj_test-nan.obj", Error("1.#IND")),
            (
                "tobj_invalid_index.obj",
                Error("vertex 7, expected one of the file's 6"),
            ),
            ("trimesh_BoxTextured.ply", Counts(12, 0, 0, 0)),
            ("trimesh_busted.STL", Counts(3878, 0, 0, 0)),
            ("trimesh_empty.stl", Error("no triangles")),
            ("trimesh_joined_tetrahedra.obj", Counts(8, 0, 3, 6)),
            ("trimesh_metadata.ply", Counts(2, 4, 0, 0)),
            ("trimesh_multibody.stl", Counts(32, 0, 0, 12)),
            ("trimesh_nancolor.obj", Counts(12, 0, 0, 0)),
            ("trimesh_negative_indices.obj", Counts(12, 0, 0, 0)),
            ("trimesh_notenoughindices.obj", Counts(1, 3, 0, 0)),
            ("trimesh_origin_inside.STL", Counts(28, 0, 0, 0)),
            ("trimesh_points_ascii_with_lists.ply", Error("no triangles")),
            ("trimesh_polygonfaces.obj", Counts(3, 5, 0, 0)),
            ("trimesh_soup.stl", Counts(100, 300, 0, 0)),
            ("trimesh_stl_empty_ascii.stl", Error("no triangles")),
            ("trimesh_stl_empty_bin.stl", Error("no triangles")),
            ("trimesh_tet.ply", Counts(4, 0, 0, 0)),
        ],
    );
}

#[test]
fn twins_say_the_same_and_units_are_kept() {
    let Some(nasty) = shared("nasty") else { return };
    let load = |name: &str, unit_mm| mesh::load(&nasty.join(name), unit_mm).unwrap();
    let dos = load("numpystl_stl_tests_dos.stl", 1.0);
    assert_eq!(dos, load("numpystl_stl_tests_unix.stl", 1.0));
    let plain = load("d_big_endian.ply", 1.0);
    assert_eq!(plain, load("d_big_endian_double.ply", 1.0));
    // Stored in metres as f32: 2⁻²⁴ of 0.25 m is 15 nm.
    let (metres, size) = (load("d_in_metres.stl", 1000.0), plain.bounds().size());
    assert!((metres.bounds().size() - size).abs().max_element() < 5e-5);
    // Written with six decimals at 5200 km; f64 keeps them.
    let far = load("d_offset_utm.obj", 1.0);
    assert!((far.bounds().size() - size).abs().max_element() < 2e-5);
    let inverted = mesh::report(&load("d_inside_out.stl", 1.0));
    let valid = mesh::report(&plain);
    assert_eq!(
        (valid.orientation, inverted.orientation),
        (Orientation::Outward, Orientation::Inward)
    );
    assert!((valid.volume_mm3 + inverted.volume_mm3).abs() < 1e-9 * valid.volume_mm3);
}

const TETRAHEDRON: [[f32; 3]; 4] = [
    [0.0, 0.0, 0.0],
    [1.0, 0.0, 0.0],
    [0.0, 1.0, 0.0],
    [0.0, 0.0, 1.0],
];
const FACES: [[usize; 3]; 4] = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];

/// The same tetrahedron in every format, with what shows a cut: the number of
/// bytes at the end that a reader can do without.
fn tetrahedra() -> Vec<(&'static str, Vec<u8>, usize)> {
    let mut stl = vec![b' '; 80];
    stl.extend(4u32.to_le_bytes());
    let mut ascii = String::from("solid a\n");
    for face in FACES {
        stl.extend([0; 12]);
        ascii += "facet normal 0 0 0\nouter loop\n";
        for [x, y, z] in face.map(|v| TETRAHEDRON[v]) {
            stl.extend([x, y, z].iter().flat_map(|c| c.to_le_bytes()));
            ascii += &format!("vertex {x} {y} {z}\n");
        }
        stl.extend([0; 2]);
        ascii += "endloop\nendfacet\n";
    }
    ascii += "endsolid a\n";
    let mut obj = String::from("# a\n");
    let header = |format: &str| {
        format!(
            "ply\nformat {format} 1.0\nelement vertex 4\nproperty float x\nproperty float y\n\
             property float z\nelement face 4\nproperty list uchar int vertex_indices\nend_header\n"
        )
    };
    let mut ply = header("ascii");
    let (mut little, mut big) = (
        header("binary_little_endian").into_bytes(),
        header("binary_big_endian").into_bytes(),
    );
    for [x, y, z] in TETRAHEDRON {
        obj += &format!("v {x:?} {y:?} {z:?}\n");
        ply += &format!("{x} {y} {z}\n");
        little.extend([x, y, z].iter().flat_map(|c| c.to_le_bytes()));
        big.extend([x, y, z].iter().flat_map(|c| c.to_be_bytes()));
    }
    for [a, b, c] in FACES {
        obj += &format!("f {} {} {}\n", a + 1, b + 1, c + 1);
        ply += &format!("3 {a} {b} {c}\n");
        little.push(3);
        little.extend([a, b, c].iter().flat_map(|&i| (i as u32).to_le_bytes()));
        big.push(3);
        big.extend([a, b, c].iter().flat_map(|&i| (i as u32).to_be_bytes()));
    }
    let obj_length = obj.len();
    vec![
        ("binary STL", stl, 0),
        ("ASCII STL", ascii.into_bytes(), " a\n".len()),
        // The format has no end mark and no counts.
        ("OBJ", obj.into_bytes(), obj_length),
        ("ASCII PLY", ply.into_bytes(), "\n".len()),
        ("little-endian PLY", little, 0),
        ("big-endian PLY", big, 0),
    ]
}

fn parse(bytes: &[u8]) -> Option<Mesh> {
    let mesh = mesh::parse(Path::new("part"), bytes, 1.0);
    // Every error prints; every mesh is valid and can be reported on.
    match mesh {
        Ok(mesh) => {
            assert_valid(&mesh);
            assert!(!mesh::report(&mesh).to_string().contains("NaN"));
            Some(mesh)
        }
        Err(error) => {
            assert!(error.to_string().contains("expected"));
            None
        }
    }
}

#[test]
fn all_formats_give_the_same_mesh() {
    let all = tetrahedra();
    let first = parse(&all[0].1).unwrap();
    // One rounding a term, of four.
    assert!((mesh::report(&first).volume_mm3 * 6.0 - 1.0).abs() < 8.0 * f64::EPSILON);
    for (name, bytes, _) in &all {
        assert_eq!(parse(bytes).as_ref(), Some(&first), "{name}");
    }
}

#[test]
fn truncated_files_are_refused() {
    for (name, bytes, spare) in tetrahedra() {
        let whole = parse(&bytes);
        for end in 0..bytes.len() {
            let cut = parse(&bytes[..end]);
            if bytes.len() - end > spare {
                let contents = mesh::parse_whole(Path::new("a"), &bytes[..end], 1.0);
                let warns = contents.is_ok_and(|c| c.ignored.iter().any(|i| i.changes_shape));
                // A text that ends after a facet may be whole.
                let may_be_whole = name == "ASCII STL" && warns;
                assert!(cut.is_none() || may_be_whole, "{name} cut at {end}");
            } else if name != "OBJ" {
                assert_eq!(cut, whole, "{name} cut at {end}");
            }
        }
    }
}

/// Every byte of every format as each other value, missing, and twice.
#[test]
fn no_changed_or_missing_byte_brings_a_reader_down() {
    for (_, bytes, _) in tetrahedra() {
        for at in 0..bytes.len() {
            let mut changed = bytes.clone();
            for value in 0..=255 {
                changed[at] = value;
                parse(&changed);
            }
            changed.remove(at);
            parse(&changed);
            changed.splice(at..at, [bytes[at]; 2]);
            parse(&changed);
        }
    }
}

proptest::proptest! {
    /// Several changes at once, and pieces of one format inside another.
    #[test]
    fn no_mixture_brings_a_reader_down(
        pick in 0..6usize, other in 0..6usize, at in 0..2000usize, from in 0..2000usize, length in 0..60usize,
        changes in proptest::collection::vec((0..2000usize, proptest::prelude::any::<u8>()), 0..6),
    ) {
        let all = tetrahedra();
        let (mut bytes, donor) = (all[pick].1.clone(), &all[other].1);
        let from = from % donor.len();
        let piece = &donor[from..donor.len().min(from + length)];
        let at = at % bytes.len();
        let end = bytes.len().min(at + length / 2);
        bytes.splice(at..end, piece.iter().copied());
        for (at, value) in changes {
            let at = at % bytes.len();
            bytes[at] = value;
        }
        parse(&bytes);
    }
}
