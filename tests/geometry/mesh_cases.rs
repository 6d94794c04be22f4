//! Small files of the kinds that people's files are: what is read of each, and what is listed as not read. One test
//! compares it with the README of the files, which was written independently. `make verify` writes its table to
//! docs/mesh-cases.md. The other test holds every detail of each outcome.

use lasertrace::mesh;
use std::path::{Path, PathBuf};

/// What must come of a file: triangles, volume (mm³), largest coordinates (mm), and a word of what is listed as not
/// read ("": nothing is), which gives a warning or does not; or words of the error.
enum Outcome {
    Read(usize, f64, [f64; 3], &'static str),
    Warned(usize, f64, [f64; 3], &'static str),
    Refused(&'static str),
}
use Outcome::{Read, Refused, Warned};

/// Volume of the tetrahedron with legs of 10 mm.
const THIRD: f64 = 500.0 / 3.0;
const TEN: [f64; 3] = [10.0; 3];

/// glTF is in metres as numbers of single precision.
const CASES: [(&str, Outcome); 196] = [
    ("g00_plain.gltf", Read(4, THIRD, TEN, "")),
    ("g01_skin_node_moved.gltf", Read(4, THIRD, TEN, "")),
    (
        "g02_skin_joint_moved.gltf",
        Read(4, THIRD, [15.0, 10.0, 10.0], ""),
    ),
    (
        "g03_skin_joint_scaled.gltf",
        Read(4, 8.0 * THIRD, [20.0, 20.0, 20.0], ""),
    ),
    (
        "g04_morph_mesh_weight.gltf",
        Read(4, 2.0 * THIRD, [10.0, 10.0, 20.0], ""),
    ),
    (
        "g05_morph_node_weight.gltf",
        Read(4, 2.0 * THIRD, [10.0, 10.0, 20.0], ""),
    ),
    (
        "g06_instancing_used.gltf",
        Read(12, 500.0, [50.0, 10.0, 10.0], ""),
    ),
    (
        "g07_instancing_required.gltf",
        Read(12, 500.0, [50.0, 10.0, 10.0], ""),
    ),
    ("g08_uri_dot.gltf", Read(4, THIRD, TEN, "")),
    ("g09_uri_backslash.gltf", Read(4, THIRD, TEN, "")),
    ("g10_uri_subdir_dot.gltf", Read(4, THIRD, TEN, "")),
    ("g11_uri_plain.gltf", Read(4, THIRD, TEN, "")),
    (
        "g12_req_unlit.gltf",
        Read(4, THIRD, TEN, "KHR_materials_unlit"),
    ),
    (
        "g13_req_textransform.gltf",
        Read(4, THIRD, TEN, "KHR_texture_transform"),
    ),
    (
        "g14_req_basisu.gltf",
        Read(4, THIRD, TEN, "KHR_texture_basisu"),
    ),
    ("g15_req_webp.gltf", Read(4, THIRD, TEN, "EXT_texture_webp")),
    (
        "g16_req_lights.gltf",
        Read(4, THIRD, TEN, "KHR_lights_punctual"),
    ),
    (
        "g17_sparse.gltf",
        Read(4, 2.0 * THIRD, [10.0, 10.0, 20.0], ""),
    ),
    ("g18_quantised.gltf", Read(4, THIRD, TEN, "")),
    ("g19_no_scenes.gltf", Refused("without a scene")),
    (
        "g20_two_scenes_no_default.gltf",
        Read(4, THIRD, TEN, "another scene"),
    ),
    (
        "g21_two_scenes_second.gltf",
        Read(4, THIRD, [1010.0, 10.0, 10.0], "another scene"),
    ),
    ("g22_unused_buffer_absent.gltf", Read(4, THIRD, TEN, "")),
    (
        "g23_meshopt_fallback_buffer.gltf",
        Read(4, THIRD, TEN, "EXT_meshopt_compression"),
    ),
    ("g24_b64_nopad.gltf", Read(4, THIRD, TEN, "")),
    ("g25_b64_newlines.gltf", Read(4, THIRD, TEN, "")),
    ("g26_b64_charset.gltf", Read(4, THIRD, TEN, "")),
    ("g27_b64_no_mime.gltf", Read(4, THIRD, TEN, "")),
    ("g28_count_float.gltf", Refused("12.0")),
    ("g29_mirror.gltf", Read(4, THIRD, [0.0, 10.0, 10.0], "")),
    ("g30_no_indices.gltf", Read(4, THIRD, TEN, "")),
    ("g31_u8.gltf", Read(4, THIRD, TEN, "")),
    (
        "g32_draco_used_no_fallback.gltf",
        Refused("KHR_draco_mesh_compression"),
    ),
    ("g33_glb.glb", Read(4, THIRD, TEN, "")),
    (
        "g34_glb_tail_nul.glb",
        Read(4, THIRD, TEN, "4 bytes after the end"),
    ),
    (
        "g35_glb_tail_newline.glb",
        Read(4, THIRD, TEN, "1 byte after the end"),
    ),
    (
        "g36_mesh_twice.gltf",
        Read(8, 2.0 * THIRD, [30.0, 10.0, 10.0], ""),
    ),
    ("g37_name.gltf", Read(4, THIRD, TEN, "")),
    ("g38_nan_extras.gltf", Read(4, THIRD, TEN, "NaN")),
    ("g39_lone_surrogate.gltf", Refused("hex escape")),
    (
        "g40_hidden_node.gltf",
        Read(4, THIRD, TEN, "KHR_node_visibility"),
    ),
    ("g41_lod.gltf", Read(4, THIRD, TEN, "MSFT_lod")),
    ("m00_plain.3mf", Read(12, 1000.0, TEN, "")),
    (
        "m01_prusa_negative.3mf",
        Warned(12, 1000.0, TEN, "NegativeVolume"),
    ),
    (
        "m02_prusa_modifier.3mf",
        Read(12, 1000.0, TEN, "ParameterModifier"),
    ),
    (
        "m03_prusa_support_blocker.3mf",
        Read(12, 1000.0, TEN, "SupportBlocker"),
    ),
    ("m04_printable0.3mf", Read(12, 1000.0, TEN, "printable")),
    ("m05_type_support.3mf", Read(12, 1000.0, TEN, "support")),
    (
        "m06_type_other_in_build.3mf",
        Read(12, 1000.0, TEN, "other"),
    ),
    (
        "m07_bambu_negative.3mf",
        Warned(12, 1000.0, TEN, "negative_part"),
    ),
    (
        "m08_bambu_modifier.3mf",
        Read(12, 1000.0, TEN, "modifier_part"),
    ),
    ("m09_slice_lowres.3mf", Warned(12, 1000.0, TEN, "lowres")),
    ("m10_slice_lowres_required.3mf", Refused("slice/2015/07")),
    ("m11_slice_fullres.3mf", Read(12, 1000.0, TEN, "slicestack")),
    (
        "m12_beams_not_required.3mf",
        Warned(12, 1000.0, TEN, "beamlattice"),
    ),
    ("m13_beams_only.3mf", Refused("beamlattice")),
    (
        "m14_displacement_beside_box.3mf",
        Warned(12, 1000.0, TEN, "displacementmesh"),
    ),
    (
        "m15_empty_object_in_build.3mf",
        Read(12, 1000.0, TEN, "empty"),
    ),
    ("m16_empty_object_alone.3mf", Refused("no triangles")),
    ("m17_case.3mf", Read(12, 1000.0, TEN, "")),
    ("m18_entry_leading_slash.3mf", Read(12, 1000.0, TEN, "")),
    ("m19_target_relative.3mf", Read(12, 1000.0, TEN, "")),
    ("m20_target_dot.3mf", Read(12, 1000.0, TEN, "")),
    ("m21_target_percent.3mf", Read(12, 1000.0, TEN, "")),
    ("m22_target_percent_raw.3mf", Read(12, 1000.0, TEN, "")),
    ("m23_backslash_entry.3mf", Read(12, 1000.0, TEN, "")),
    ("m24_bom.3mf", Read(12, 1000.0, TEN, "")),
    ("m25_utf16.3mf", Refused("UTF-8")),
    ("m26_prefix.3mf", Read(12, 1000.0, TEN, "")),
    ("m27_comma_decimal.3mf", Refused("comma")),
    ("m28_unit_Millimeter.3mf", Refused("Millimeter")),
    ("m28_unit_empty.3mf", Refused("micron, millimeter")),
    (
        "m28_unit_foot.3mf",
        Read(12, 28316846592.0, [3048.0, 3048.0, 3048.0], ""),
    ),
    (
        "m28_unit_inch.3mf",
        Read(12, 16387064.0, [254.0, 254.0, 254.0], ""),
    ),
    (
        "m28_unit_meter.3mf",
        Read(12, 1000000000000.0, [10000.0, 10000.0, 10000.0], ""),
    ),
    (
        "m28_unit_micron.3mf",
        Read(12, 1e-06, [0.01, 0.01, 0.01], ""),
    ),
    ("m29_mirror.3mf", Read(12, 1000.0, [0.0, 10.0, 10.0], "")),
    ("m30_self.3mf", Refused("parts of themselves")),
    ("m31_store.3mf", Read(12, 1000.0, TEN, "")),
    ("m32_lzma.3mf", Refused("compression method")),
    ("m33_bz2.3mf", Refused("compression method")),
    ("m34_secure_not_required.3mf", Refused("object \"1\"")),
    ("m35_boolean_not_required.3mf", Refused("booleanshape")),
    (
        "m36_boolean_beside.3mf",
        Warned(12, 1000.0, [30.0, 10.0, 10.0], "booleanshape"),
    ),
    ("m37_req_materials2.3mf", Read(12, 1000.0, TEN, "")),
    ("m38_req_pbr.3mf", Read(12, 1000.0, TEN, "")),
    ("m39_req_undeclared.3mf", Refused("slic3rpe")),
    ("m40_alternatives.3mf", Warned(12, 1000.0, TEN, "b.model")),
    ("m41_thumb_first.3mf", Read(12, 1000.0, TEN, "")),
    ("o00.obj", Read(4, THIRD, TEN, "")),
    ("o01_freeform_beside.obj", Warned(4, THIRD, TEN, "surf")),
    ("o02_freeform_only.obj", Refused("surf")),
    ("o03_plain_header.obj", Warned(4, THIRD, TEN, "Exported")),
    ("o04_semicolon.obj", Warned(4, THIRD, TEN, ";")),
    ("o05_slashes.obj", Warned(4, THIRD, TEN, "//")),
    ("o06_upper.obj", Refused("beginning with \"V\"")),
    ("o07_vertex_rgba.obj", Read(4, THIRD, TEN, "")),
    ("o08_vertex_w.obj", Read(4, THIRD, TEN, "")),
    ("o09_vertex_w0.obj", Refused("weight")),
    ("o10_inline_mtl.obj", Warned(4, THIRD, TEN, "newmtl")),
    ("o11_face_trailing.obj", Refused("obj:5")),
    ("o12_face_slash_space.obj", Refused("obj:5")),
    ("o13_neg.obj", Read(4, THIRD, TEN, "")),
    ("o14_face_comma.obj", Refused("obj:5")),
    ("o15_two_vertex_dim.obj", Refused("obj:5")),
    ("o16_nul.obj", Read(4, THIRD, TEN, "NUL")),
    ("o17_call.obj", Warned(4, THIRD, TEN, "call")),
    ("o18_group_endofline_bs.obj", Read(4, THIRD, TEN, "")),
    ("o19_comment_bs.obj", Read(4, THIRD, TEN, "")),
    ("o20_utf8name.obj", Read(4, THIRD, TEN, "")),
    ("o21_latin1.obj", Read(4, THIRD, TEN, "")),
    ("o22_idx_float.obj", Refused("obj:5")),
    ("o23_exp_plus.obj", Refused("obj:2")),
    ("o24_concave.obj", Read(3, 0.0, [10.0, 10.0, 0.0], "")),
    ("o25_bom.obj", Read(4, THIRD, TEN, "")),
    ("o26_mtllib_missing.obj", Read(4, THIRD, TEN, "")),
    ("o27_lod.obj", Warned(8, 2.0 * THIRD, TEN, "lod")),
    ("o28_usemap.obj", Read(4, THIRD, TEN, "")),
    ("o29_unknown_kw.obj", Warned(4, THIRD, TEN, "sharing")),
    ("o30_in.obj", Warned(4, THIRD, TEN, "vcolor")),
    ("o40_continuation.obj", Read(4, THIRD, TEN, "")),
    ("o41_slashes_only.obj", Read(4, THIRD, TEN, "")),
    ("p00.ply", Read(4, THIRD, TEN, "")),
    ("p01_tristrips.ply", Read(3, 0.0, TEN, "")),
    ("p02_header_freetext.ply", Refused("ply:3")),
    ("p03_index_float_text.ply", Read(4, THIRD, TEN, "")),
    ("p04_float_list.ply", Refused("ply:7")),
    ("p05_upper_xyz.ply", Refused("ply:3")),
    ("p06_vertex_index_uint.ply", Read(4, THIRD, TEN, "")),
    ("p07_ushort.ply", Read(4, THIRD, TEN, "")),
    ("p08_end_header_space.ply", Read(4, THIRD, TEN, "")),
    ("p09_cr.ply", Read(4, THIRD, TEN, "")),
    ("p10_two_format_version.ply", Refused("ply:2")),
    ("p11_tabs.ply", Read(4, THIRD, TEN, "")),
    ("p12_comment_before_format.ply", Read(4, THIRD, TEN, "")),
    ("p13_quads.ply", Read(2, 0.0, [10.0, 10.0, 0.0], "")),
    ("p14_extra_col.ply", Refused("ply:10")),
    (
        "p15_ascii_trailing_nul.ply",
        Read(4, THIRD, TEN, "2 bytes after"),
    ),
    ("p16_negative_index.ply", Refused("ply:14")),
    ("p17_range_grid.ply", Refused("range_grid")),
    ("p20_le.ply", Read(4, THIRD, TEN, "")),
    ("p21_be_double_ushort.ply", Read(4, THIRD, TEN, "")),
    ("p22_uint_uint.ply", Read(4, THIRD, TEN, "")),
    ("p23_u8_idx.ply", Read(4, THIRD, TEN, "")),
    ("p24_be_crlf.ply", Read(4, THIRD, TEN, "")),
    (
        "p25_le_tail_newline.ply",
        Read(4, THIRD, TEN, "1 byte after"),
    ),
    ("p26_le_tail64.ply", Read(4, THIRD, TEN, "64 bytes after")),
    ("p27_face_props.ply", Read(4, THIRD, TEN, "")),
    ("p28_list_first_vertex.ply", Read(4, THIRD, TEN, "")),
    ("p29_edges.ply", Read(4, THIRD, TEN, "edge")),
    ("p30_vertexindices_name.ply", Refused("ply:7")),
    ("p31_trifan.ply", Read(2, 0.0, TEN, "")),
    ("p32_float16.ply", Refused("ply:4")),
    ("p33_int64.ply", Refused("ply:8")),
    ("p34_bom.ply", Read(4, THIRD, TEN, "")),
    ("p35_comma.ply", Refused("ply:11")),
    ("s00.stl", Read(4, THIRD, TEN, "")),
    ("s01_end_loop.stl", Read(4, THIRD, TEN, "")),
    ("s02_end_facet.stl", Read(4, THIRD, TEN, "")),
    ("s03_end_solid.stl", Read(4, THIRD, TEN, "")),
    ("s04_no_endsolid.stl", Warned(4, THIRD, TEN, "cut off")),
    ("s05_color_line.stl", Read(4, THIRD, TEN, "colours")),
    ("s06_facet_color.stl", Read(4, THIRD, TEN, "colours")),
    ("s07_long_name.stl", Read(4, THIRD, TEN, "")),
    ("s08_no_normal.stl", Read(4, THIRD, TEN, "")),
    (
        "s09_tail_text.stl",
        Warned(4, THIRD, TEN, "text after a solid"),
    ),
    ("s10_tail_nul.stl", Read(4, THIRD, TEN, "NUL")),
    ("s11_cr_only.stl", Read(4, THIRD, TEN, "")),
    ("s12_one_line.stl", Read(4, THIRD, TEN, "")),
    ("s13_upper.stl", Read(4, THIRD, TEN, "")),
    ("s14_normal_nan.stl", Read(4, THIRD, TEN, "")),
    ("s15_quad.stl", Refused("stl:7")),
    ("s16_nan_facet.stl", Refused("stl:32")),
    ("s17_solid_name_facet.stl", Read(4, THIRD, TEN, "")),
    ("s18_utf16bom.stl", Refused("UTF-16")),
    ("s19_two_solids.stl", Read(8, 2.0 * THIRD, TEN, "")),
    ("s20_normal_missing_values.stl", Read(4, THIRD, TEN, "")),
    ("s21_comment_slashes.stl", Read(4, THIRD, TEN, "comments")),
    ("s22_semicolon_comment.stl", Read(4, THIRD, TEN, "comments")),
    ("s23_leading_blank.stl", Read(4, THIRD, TEN, "")),
    (
        "s24_endsolid_missing_then_solid.stl",
        Warned(8, 2.0 * THIRD, TEN, "cut off"),
    ),
    ("s25_html_entities.stl", Read(4, THIRD, TEN, "")),
    ("s30_bin.stl", Read(4, THIRD, TEN, "")),
    ("s31_attr.stl", Read(4, THIRD, TEN, "")),
    ("s32_magics.stl", Read(4, THIRD, TEN, "")),
    ("s33_solid_head.stl", Read(4, THIRD, TEN, "")),
    (
        "s34_count0.stl",
        Refused("announces 0 triangles and holds 4"),
    ),
    (
        "s35_count_m1.stl",
        Refused("announces 3 triangles and holds 4"),
    ),
    (
        "s36_count_ff.stl",
        Refused("announces 4294967295 triangles and holds 4"),
    ),
    (
        "s37_tail49.stl",
        Warned(4, THIRD, TEN, "49 bytes after the 4 triangles"),
    ),
    (
        "s38_tail80.stl",
        Refused("announces 4 triangles and holds 5"),
    ),
    ("s39_nan_norm.stl", Read(4, THIRD, TEN, "")),
    (
        "s40_two_bin.stl",
        Refused("announces 4 triangles and holds 9"),
    ),
    ("s41_zero.stl", Refused("no triangles")),
    ("s42_bin_utf8bom.stl", Refused("holds 4 and 3 bytes")),
    ("s43_attr_len.stl", Warned(4, THIRD, TEN, "2 bytes after")),
];

/// What came of a file, in words, and whether that is right.
fn outcome(file: &Path, outcome: &Outcome) -> (String, bool) {
    let bytes = std::fs::read(file).unwrap();
    let states_unit = file
        .extension()
        .is_some_and(|e| e == "3mf" || e == "gltf" || e == "glb");
    let found = mesh::parse_whole(file, &bytes, (!states_unit).then_some(1.0));
    match (found, outcome) {
        (Ok(contents), outcome) => {
            let report = mesh::report(&contents.mesh);
            let max = contents.mesh.bounds().max.to_array();
            let listed: Vec<String> = contents.ignored.iter().map(ToString::to_string).collect();
            let warns = contents.ignored.iter().any(|ignored| ignored.changes_shape);
            let lists = match (warns, listed.is_empty()) {
                (true, _) => "; warning: ",
                (false, true) => "",
                (false, false) => "; listed: ",
            };
            let text = format!(
                "{} triangles, {:.6} mm³{lists}{}",
                report.triangles,
                report.volume_mm3,
                listed.join("; ")
            );
            let (triangles, volume, bounds, word, must_warn) = match outcome {
                Read(triangles, volume, bounds, word) => (triangles, volume, bounds, word, false),
                Warned(triangles, volume, bounds, word) => (triangles, volume, bounds, word, true),
                Refused(_) => return (text, false),
            };
            // Numbers of single precision are good to 6·10⁻⁸.
            let near = |a: f64, b: f64| (a - b).abs() <= 1e-6 * b.abs();
            let is_right = report.triangles == *triangles
                && near(report.volume_mm3, *volume)
                && max.iter().zip(bounds).all(|(a, b)| near(*a, *b))
                && warns == must_warn
                && listed.is_empty() == word.is_empty()
                && listed.join("; ").contains(word);
            (text, is_right)
        }
        (Err(error), outcome) => {
            let text = error.to_string();
            let is_right = matches!(outcome, Refused(words) if text.contains(words));
            // Without the folder, which is another on each machine.
            let folder = format!("{}/", file.parent().unwrap_or(file).display());
            let text = text.replace(&folder, "");
            (
                format!("refused: {text}"),
                is_right && error.exit_code() == 65,
            )
        }
    }
}

/// The folder of the files; `None`, with a message, where it is absent.
fn folder() -> Option<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/cases");
    let is_there = folder.is_dir();
    if !is_there {
        println!("*** NOT TESTED: {} is absent. ***", folder.display());
    }
    is_there.then_some(folder)
}

/// Names of the mesh files of the folder, in order.
fn meshes(folder: &Path) -> Vec<String> {
    let files = std::fs::read_dir(folder).unwrap();
    let names = files.map(|file| file.unwrap().file_name().into_string().unwrap());
    let is_mesh =
        |name: &String| name.starts_with(['g', 'm', 'o', 'p', 's']) && !name.ends_with(".bin");
    let mut names: Vec<String> = names.filter(is_mesh).collect();
    names.sort();
    names
}

#[test]
fn files_of_usual_kinds_are_read_or_refused_with_a_reason() {
    let Some(folder) = folder() else { return };
    let mut wrong = Vec::new();
    for (name, expected) in &CASES {
        let (actual, is_right) = outcome(&folder.join(name), expected);
        if !is_right {
            wrong.push(format!("{name}: {actual}"));
        }
    }
    for name in meshes(&folder) {
        if !CASES.iter().any(|(known, _)| *known == name) {
            wrong.push(format!("{name}: no outcome is stated for it"));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Files that the README calls right "as named": triangles and volume (mm³) that follow from their content.
const AS_NAMED: [(&str, usize, f64, &str); 14] = [
    ("g36", 8, 2.0 * THIRD, "the mesh is placed twice"),
    ("m28_unit_foot", 12, 28_316_846_592.0, "10 feet of 304.8 mm"),
    ("m28_unit_inch", 12, 16_387_064.0, "10 inches of 25.4 mm"),
    ("m28_unit_meter", 12, 1e12, "10 m"),
    ("m28_unit_micron", 12, 1e-6, "10 µm"),
    ("o24", 3, 0.0, "a plane polygon of five corners"),
    ("o27", 8, 2.0 * THIRD, "two levels of detail"),
    ("p01", 3, 0.0, "strips of four and of three corners"),
    ("p13", 2, 0.0, "a plane square"),
    ("p31", 2, 0.0, "a fan of four corners"),
    ("s19", 8, 2.0 * THIRD, "two solids"),
    ("s24", 8, 2.0 * THIRD, "two solids"),
    // The README has these among the wrong counts, for which it expects a refusal.
    (
        "s37",
        4,
        THIRD,
        "the count is right; 49 bytes follow the triangles",
    ),
    ("s39", 4, THIRD, "the count is right; a normal is NaN"),
];

/// Returns the text of the README for a file: of the row that names it, or else of the row of the others.
fn right_by_readme(readme: &str, file: &str) -> Option<String> {
    let number = |id: &str| id.get(1..3)?.parse::<u32>().ok();
    let [family, id] = [&file[..1], &file[..3]];
    let mut others = None;
    for row in readme.lines().filter(|line| line.starts_with("| ")) {
        let cells: Vec<&str> = row.trim_matches(['|', ' ']).split(" | ").collect();
        let [files, _, right] = cells[..] else {
            continue;
        };
        let names = || files.trim_start_matches("others ").split(", ");
        if files.starts_with("others ") {
            others = others.or(names().any(|name| name == family).then_some(right));
            continue;
        }
        let is_named = |name: &str| match name.split_once('–') {
            Some((first, last)) => {
                name.starts_with(family) && (number(first)..=number(last)).contains(&number(id))
            }
            None => name == id,
        };
        if names().any(is_named) {
            return Some(clause_for(right, file));
        }
    }
    others.map(str::to_owned)
}

/// Returns the clauses of a text without those of other files and kinds, as in "g02 moved; g03 twice as large" and
/// "negative: 820 mm³; modifier: 1000 mm³".
fn clause_for(right: &str, file: &str) -> String {
    let is_id = |word: &str| {
        word.len() == 3 && word.starts_with(&file[..1]) && word[1..].parse::<u32>().is_ok()
    };
    let holds = |clause: &&str| {
        let (before, _) = clause.split_once(':').unwrap_or((clause, ""));
        let mut words = before.split(|c: char| !c.is_alphanumeric());
        let ids: Vec<&str> = words.clone().filter(|word| is_id(word)).collect();
        match (ids.is_empty(), clause.contains(':')) {
            (false, _) => ids[0] == &file[..3],
            (true, true) => words.any(|word| !word.is_empty() && file.contains(word)),
            (true, false) => true,
        }
    };
    right
        .split("; ")
        .filter(holds)
        .collect::<Vec<_>>()
        .join("; ")
}

/// Returns the number before or after words.
fn number_at(text: &str, before: &str, after: &str) -> Option<f64> {
    let from = match before {
        "" => text
            .find(after)
            .map(|end| text[..end].rsplit(' ').next().unwrap_or(""))?,
        _ => text[text.find(before)? + before.len()..]
            .split(' ')
            .next()?,
    };
    from.trim_matches(|c: char| !c.is_ascii_digit())
        .parse()
        .ok()
}

/// What came of a file, in words, and whether the README allows it.
fn judged(path: &Path, file: &str, right: &str) -> (String, Result<(), String>) {
    let bytes = std::fs::read(path).unwrap();
    let states_unit = file.starts_with(['g', 'm']);
    let says = |words: &[&str]| words.iter().any(|word| right.contains(word));
    let by_name = says(&["a word", "by name"]);
    let named = AS_NAMED.iter().find(|(name, ..)| file.starts_with(name));
    match mesh::parse_whole(path, &bytes, (!states_unit).then_some(1.0)) {
        Err(error) => {
            let text = error.to_string();
            let folder = format!("{}/", path.parent().unwrap().display());
            let counts = text.contains("announces") && text.contains("holds");
            let allowed = match named {
                _ if error.exit_code() != 65 => Err(format!("exit code {}", error.exit_code())),
                _ if says(&["both counts named"]) && !counts => {
                    Err("counts are not named".to_owned())
                }
                _ if says(&["refused"]) || by_name => Ok(()),
                _ => Err("refused".to_owned()),
            };
            (format!("refused: {}", text.replace(&folder, "")), allowed)
        }
        Ok(contents) => judged_mesh(&contents, file, right),
    }
}

/// What was read of a file, in words, and whether the README allows it.
fn judged_mesh(contents: &mesh::Contents, file: &str, right: &str) -> (String, Result<(), String>) {
    let says = |words: &[&str]| words.iter().any(|word| right.contains(word));
    let by_name = says(&["a word", "by name"]);
    let named = AS_NAMED.iter().find(|(name, ..)| file.starts_with(name));
    let report = mesh::report(&contents.mesh);
    let z = contents.mesh.bounds().max.z;
    let x = contents.mesh.bounds().max.x;
    let warns = contents.ignored.iter().any(|ignored| ignored.changes_shape);
    let listed: Vec<String> = contents.ignored.iter().map(ToString::to_string).collect();
    let (default_n, default_volume) = match file.starts_with('m') {
        true => (12, 1000.0),
        false => (4, THIRD),
    };
    let [n, volume] = match named {
        Some((_, n, volume, _)) => [*n as f64, *volume],
        None if says(&["twice as large"]) => [4.0, 8.0 * THIRD],
        None if says(&["three placed copies"]) => [12.0, 3.0 * THIRD],
        // A tip twice as high.
        None if says(&["z = 20", "z max 20"]) => [4.0, 2.0 * THIRD],
        None => [
            number_at(right, "", " triangles").unwrap_or(f64::from(default_n)),
            number_at(right, "", " mm³").unwrap_or(default_volume),
        ],
    };
    // The README rounds 166.667 to 166.67.
    let near = |a: f64, b: f64| (a - b).abs() <= 1e-4 * b.abs();
    let z_right = number_at(right, "z max ", "").or(number_at(right, "z = ", ""));
    let x_right = number_at(right, "moved +", "").map(|by| 10.0 + by);
    let is_right = report.triangles as f64 == n
        && near(report.volume_mm3, volume)
        && z_right.is_none_or(|right| near(z, right))
        && x_right.is_none_or(|right| near(x, right));
    let lists = if warns { "; warning: " } else { "; listed: " };
    let lists = if listed.is_empty() { "" } else { lists };
    let text = format!(
        "{} triangles, {:.6} mm³{lists}{}",
        report.triangles,
        report.volume_mm3,
        listed.join("; ")
    );
    let allowed = if says(&["with a warning"]) && !warns {
        Err("no warning".to_owned())
    } else if says(&["with a word", "a word by name of what was left out"]) && listed.is_empty() {
        Err("nothing is listed".to_owned())
    } else if (by_name && warns) || (is_right && (named.is_some() || !right.starts_with("refused")))
    {
        Ok(())
    } else {
        Err(format!("expected {n} triangles, {volume:.6} mm³"))
    };
    (text, allowed)
}

/// No wrong geometry without a warning, and no harmless file refused without a reason, by what the README of the folder
/// calls right. It is read when the test runs.
#[test]
fn outcomes_are_what_the_readme_of_the_files_calls_right() {
    let Some(folder) = folder() else { return };
    let readme = std::fs::read_to_string(folder.join("README.md")).unwrap();
    let mut wrong = Vec::new();
    println!("\n| file | right, by the README of the files | actual |\n|---|---|---|");
    for file in meshes(&folder) {
        let Some(right) = right_by_readme(&readme, &file) else {
            wrong.push(format!("{file}: not in the README"));
            continue;
        };
        let (actual, allowed) = judged(&folder.join(&file), &file, &right);
        let why = AS_NAMED.iter().find(|(name, ..)| file.starts_with(name));
        let why = why.map_or(String::new(), |(.., why)| format!(" ({why})"));
        let verdict = allowed
            .as_ref()
            .err()
            .map_or(String::new(), |e| format!(" **{e}**"));
        println!("| {file} | {right}{why} | {actual}{verdict} |");
        if let Err(error) = allowed {
            wrong.push(format!("{file}: {right}: {actual}: {error}"));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}
