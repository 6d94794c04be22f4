use super::*;
use crate::mesh::{UnitSource, parse, unit_by};
use std::io::{Cursor, Write};
use std::path::Path;

use zip::write::SimpleFileOptions;

const RELS: &str = r#"<?xml version="1.0" encoding="UTF-8"?>
<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">
<Relationship Target="/3D/3dmodel.model" Id="rel0" Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/>
</Relationships>"#;

/// Tetrahedron with corners at 1, 2 and 3 along the axes.
const TETRAHEDRON: &str = r#"<mesh><vertices><vertex x="0" y="0" z="0"/><vertex x="1" y="0" z="0"/>
<vertex x="0" y="2" z="0"/><vertex x="0" y="0" z="3"/></vertices><triangles><triangle v1="0" v2="2" v3="1"/>
<triangle v1="0" v2="1" v3="3"/><triangle v1="0" v2="3" v3="2"/><triangle v1="1" v2="2" v3="3"/></triangles></mesh>"#;

fn archive(files: &[(&str, &str)]) -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for (name, text) in files {
        zip.start_file(*name, SimpleFileOptions::default()).unwrap();
        zip.write_all(text.as_bytes()).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

fn model(attributes: &str, resources: &str, build: &str) -> String {
    format!(
        r#"<model xmlns="{CORE}" xmlns:p="{PRODUCTION}" xmlns:b="urn:bent" {attributes}>
        <resources>{resources}</resources><build>{build}</build></model>"#
    )
}

fn packed(attributes: &str, resources: &str, build: &str) -> Vec<u8> {
    let model = model(attributes, resources, build);
    archive(&[("_rels/.rels", RELS), ("3D/3dmodel.model", &model)])
}

fn object(id: &str, content: &str) -> String {
    format!(r#"<object id="{id}" type="model">{content}</object>"#)
}

fn meshed(bytes: &[u8]) -> Result<Mesh, String> {
    parse(Path::new("part.3mf"), bytes, None).map_err(|e| e.to_string())
}

#[test]
fn the_unit_is_the_files_and_another_is_refused() {
    for (unit, mm) in [
        ("", 1.0),
        (r#"unit="inch""#, 25.4),
        (r#"unit="micron""#, 1e-3),
    ] {
        let bytes = packed(unit, &object("1", TETRAHEDRON), r#"<item objectid="1"/>"#);
        let mesh = meshed(&bytes).unwrap();
        assert_eq!(mesh.triangles.len(), 4);
        assert_eq!(mesh.bounds().max, DVec3::new(1.0, 2.0, 3.0) * mm);
        assert_eq!(
            unit_by(Path::new("part"), &bytes).unwrap(),
            UnitSource::File
        );
        assert_eq!(parse(Path::new("part"), &bytes, mm).unwrap(), mesh);
        let error = parse(Path::new("part"), &bytes, 10.0)
            .unwrap_err()
            .to_string();
        assert!(
            error.contains(&format!("{mm} mm")) && error.contains("10 mm"),
            "{error}"
        );
    }
}

/// Tests three tetrahedra: a component moved by 10 along x in an object rotated by 90° about z, one
/// in a separate file, and a mirrored one. Each has a sixfold volume of 6, 18 in total.
#[test]
fn components_and_other_files_are_placed_and_mirrors_keep_the_outside() {
    let far = r#"<components><component objectid="1" transform="1 0 0 0 1 0 0 0 1 10 0 0"/></components>"#;
    let resources = object("1", TETRAHEDRON) + &object("2", far);
    let build = r#"<item objectid="2" transform="0 1 0 -1 0 0 0 0 1 0 0 0"/>
        <item objectid="7" p:path="/3D/other.model"/>
        <item objectid="1" transform="-1 0 0 0 1 0 0 0 1 -5 0 0"/>"#;
    let other = model("", &object("7", TETRAHEDRON), "");
    let bytes = archive(&[
        ("3D/other.model", &other),
        ("_rels/.rels", RELS),
        ("3D/3dmodel.model", &model("", &resources, build)),
    ]);
    let mesh = meshed(&bytes).unwrap();
    assert_eq!(mesh.triangles.len(), 12);
    let volume = |i| {
        let [a, b, c] = mesh.triangle(i);
        a.dot(b.cross(c))
    };
    assert!(((0..12).map(volume).sum::<f64>() - 18.0).abs() < 1e-9);
    // First: (x, y) becomes (−y, x + 10).
    assert_eq!(mesh.bounds().min, DVec3::new(-6.0, 0.0, 0.0));
    assert_eq!(mesh.bounds().max, DVec3::new(1.0, 11.0, 3.0));
}

#[test]
fn mistakes_are_named() {
    let one = object("1", TETRAHEDRON);
    let item = r#"<item objectid="1"/>"#;
    let loops = object("1", r#"<components><component objectid="1"/></components>"#);
    let swap = |from: &str, to: &str| object("1", &TETRAHEDRON.replacen(from, to, 1));
    for (bytes, words) in [
        (packed(r#"unit="yard""#, &one, item), "yard"),
        (packed("", &one, ""), "no triangles"),
        (packed("", &one, r#"<item objectid="2"/>"#), "object \"2\""),
        (packed("", &one, r#"<item/>"#), "without objectid"),
        (packed("", &loops, item), "components 64 deep"),
        (
            packed("", &one, r#"<item objectid="1" transform="1 2 3"/>"#),
            "3 numbers",
        ),
        (
            packed(
                "",
                &one,
                r#"<item objectid="1" transform="1 0 0 0 1 0 0 0 1 nan 0 0"/>"#,
            ),
            "finite",
        ),
        (packed("", &swap("x=\"1\"", "x=\"1,5\""), item), "comma"),
        (packed("", &swap("x=\"1\"", "x=\"inf\""), item), "finite"),
        (packed("", &swap("x=\"1\"", ""), item), "<vertex> without x"),
        (packed("", &swap("v3=\"3\"", "v3=\"4\""), item), "below 4"),
        (packed(r#"requiredextensions="b""#, &one, item), "urn:bent"),
        (
            archive(&[("_rels/.rels", RELS), ("3D/3dmodel.model", "<model")]),
            "3dmodel.model",
        ),
        (
            archive(&[
                ("_rels/.rels", "<Relationships/>"),
                ("3D/a.model", "<model/>"),
            ]),
            "without a 3D model",
        ),
    ] {
        let error = meshed(&bytes).unwrap_err();
        assert!(
            error.contains(words) && error.contains("part.3mf"),
            "{words}: {error}"
        );
    }
    // The production extension does not affect the shape.
    assert!(meshed(&packed(r#"requiredextensions="p""#, &one, item)).is_ok());
}

/// Tests 2⁴⁰ tetrahedra in a few hundred bytes.
#[test]
fn what_does_not_fit_is_refused_before_it_is_placed() {
    let twice = |below: usize| {
        let component = format!(r#"<component objectid="{below}"/>"#);
        object(
            &format!("{}", below + 1),
            &format!("<components>{component}{component}</components>"),
        )
    };
    let resources: String = (1..=40).map(twice).collect();
    let resources = object("1", TETRAHEDRON) + &resources;
    let bytes = packed("", &resources, r#"<item objectid="41"/>"#);
    let error = parse(Path::new("part.3mf"), &bytes, None).unwrap_err();
    assert_eq!(error.exit_code(), 75, "{error}");
}

#[test]
fn every_truncation_and_byte_change_ends_in_a_mesh_or_an_error() {
    let bytes = packed("", &object("1", TETRAHEDRON), r#"<item objectid="1"/>"#);
    for end in 0..bytes.len() {
        assert!(parse(Path::new("part"), &bytes[..end], None).is_err());
    }
    for at in 0..bytes.len() {
        for value in [0, 1, b'<', 0x7f, 0xff] {
            let mut changed = bytes.clone();
            changed[at] = value;
            if let Ok(mesh) = parse(Path::new("part"), &changed, 1.0) {
                assert!(mesh.positions.iter().all(|p| p.is_finite()));
            }
        }
    }
    // Changes of the XML text itself, which the checksums of the archive do not detect.
    let text = model("", &object("1", TETRAHEDRON), r#"<item objectid="1"/>"#);
    for at in 0..text.len() {
        for value in ["", "<", "\"", "9", "/>"] {
            let changed = format!("{}{value}{}", &text[..at], &text[at + 1..]);
            let bytes = archive(&[("_rels/.rels", RELS), ("3D/3dmodel.model", &changed)]);
            let _ = parse(Path::new("part"), &bytes, None);
        }
    }
}

/// Returns a box of 12 triangles, as vertices and triangles after `first` other vertices.
fn cuboid(size: f64, at: f64, first: usize) -> (String, String) {
    let corner = |i: usize| [i & 1, i >> 1 & 1, i >> 2].map(|bit| at + size * bit as f64);
    let faces = [
        [0, 2, 1],
        [1, 2, 3],
        [4, 5, 6],
        [5, 7, 6],
        [0, 1, 4],
        [1, 5, 4],
        [2, 6, 3],
        [3, 6, 7],
        [0, 4, 2],
        [2, 4, 6],
        [1, 3, 5],
        [3, 7, 5],
    ];
    let vertices = (0..8)
        .map(corner)
        .map(|[x, y, z]| format!(r#"<vertex x="{x}" y="{y}" z="{z}"/>"#));
    let triangles = faces.iter().map(|f| {
        let [a, b, c] = f.map(|v: usize| v + first);
        format!(r#"<triangle v1="{a}" v2="{b}" v3="{c}"/>"#)
    });
    (vertices.collect(), triangles.collect())
}

fn mesh_of(vertices: &str, triangles: &str) -> String {
    format!("<mesh><vertices>{vertices}</vertices><triangles>{triangles}</triangles></mesh>")
}

fn whole(bytes: &[u8]) -> crate::mesh::Contents {
    crate::mesh::parse_whole(Path::new("part.3mf"), bytes, None).unwrap()
}

/// Tests three boxes in random order. One is solid, and the others have slicer roles, as written by
/// PrusaSlicer and by Bambu Studio.
#[test]
#[expect(clippy::too_many_lines, reason = "files of two programs are made")]
fn parts_that_slicers_do_not_print_as_solid_are_left_out() {
    let roles = [
        ("NegativeVolume", "negative_part", true),
        ("ParameterModifier", "modifier_part", false),
        ("SupportBlocker", "support_blocker", false),
        ("SupportEnforcer", "support_enforcer", false),
    ];
    for seed in 0..12usize {
        let solid = seed % 3;
        let role_of = |i: usize| roles[(seed / 3 + i) % 4];
        let size = |i: usize| if i == solid { 10.0 } else { 6.0 };
        let (mut vertices, mut triangles, mut objects, mut components) =
            (String::new(), String::new(), String::new(), String::new());
        let (mut volumes, mut parts) = (String::new(), String::new());
        for i in 0..3 {
            let (own_vertices, own_triangles) = cuboid(size(i), 3.0 * i as f64, 8 * i);
            vertices += &own_vertices;
            triangles += &own_triangles;
            let (own_vertices, own_triangles) = cuboid(size(i), 3.0 * i as f64, 0);
            objects += &object(
                &format!("{}", i + 1),
                &mesh_of(&own_vertices, &own_triangles),
            );
            components += &format!(r#"<component objectid="{}"/>"#, i + 1);
            let (prusa, bambu, _) = if i == solid {
                ("ModelPart", "normal_part", false)
            } else {
                role_of(i)
            };
            volumes += &format!(
                r#"<volume firstid="{}" lastid="{}"><metadata type="volume" key="volume_type" value="{prusa}"/></volume>"#,
                12 * i,
                12 * i + 11
            );
            parts += &format!(
                r#"<part id="{}" subtype="{bambu}"><metadata key="name" value="x"/></part>"#,
                i + 1
            );
        }
        let one = model(
            "",
            &object("7", &mesh_of(&vertices, &triangles)),
            r#"<item objectid="7"/>"#,
        );
        let prusa = format!(r#"<config><object id="7">{volumes}</object></config>"#);
        let prusa = archive(&[
            ("_rels/.rels", RELS),
            ("3D/3dmodel.model", &one),
            ("Metadata/Slic3r_PE_model.config", &prusa),
        ]);
        let objects = objects + &object("9", &format!("<components>{components}</components>"));
        let of_three = model("", &objects, r#"<item objectid="9"/>"#);
        let bambu = format!(r#"<config><object id="9">{parts}</object></config>"#);
        let bambu = archive(&[
            ("_rels/.rels", RELS),
            ("3D/3dmodel.model", &of_three),
            ("Metadata/model_settings.config", &bambu),
        ]);
        let cuts = (0..3).any(|i| i != solid && role_of(i).2);
        for (bytes, is_prusa) in [(prusa, true), (bambu, false)] {
            let contents = whole(&bytes);
            let report = crate::mesh::report(&contents.mesh);
            assert_eq!(report.triangles, 12);
            assert!(
                (report.volume_mm3 - 1000.0).abs() < 1e-9,
                "{}",
                report.volume_mm3
            );
            for i in (0..3).filter(|&i| i != solid) {
                let role = if is_prusa { role_of(i).0 } else { role_of(i).1 };
                assert!(
                    contents
                        .ignored
                        .iter()
                        .any(|ignored| ignored.name.contains(role)),
                    "{role}"
                );
            }
            assert_eq!(
                contents.ignored.iter().any(|ignored| ignored.changes_shape),
                cuts
            );
        }
    }
}

/// Tests content of made-up extensions at each position, and content that the file itself omits.
#[test]
#[expect(clippy::too_many_lines, reason = "a table of one row a case")]
fn what_is_left_out_is_listed_by_name() {
    let one = object("1", TETRAHEDRON);
    let item = r#"<item objectid="1"/>"#;
    let both = r#"<item objectid="1"/><item objectid="2"/>"#;
    let with = |more: &str| one.clone() + more;
    let beams = TETRAHEDRON.replace("</mesh>", "<b:beams><b:beam/></b:beams></mesh>");
    let second = |kind: &str| {
        with(&format!(
            r#"<object id="2" type="{kind}">{TETRAHEDRON}</object>"#
        ))
    };
    let long = "urn:a-name-of-an-extension-that-is-longer-than-forty-characters";
    for (bytes, name, changes_shape) in [
        (
            packed("", &object("1", &beams), item),
            "<beams> of the extension \"urn:bent\"",
            true,
        ),
        (
            packed("", &with(r#"<object id="2"><b:shape/></object>"#), both),
            "object 2, made of <shape> of the extension",
            true,
        ),
        (packed("", &with("<b:stack/>"), item), "<stack>", false),
        (
            packed(
                "",
                &one.replace(r#"id="1""#, r#"id="1" b:meshresolution="lowres""#),
                item,
            ),
            "meshresolution=\"lowres\"",
            true,
        ),
        (
            packed("", &second("support"), both),
            "the type \"support\"",
            false,
        ),
        (
            packed("", &second("other"), both),
            "the type \"other\"",
            false,
        ),
        (
            packed(
                "",
                &second("model"),
                &both.replace(r#""2""#, r#""2" printable="0""#),
            ),
            "printable=\"0\"",
            false,
        ),
        (
            packed("", &with(r#"<object id="2"><components/></object>"#), both),
            "empty",
            false,
        ),
        (
            packed(
                &format!(r#"xmlns:l="{long}""#),
                &object("1", &beams.replace("b:", "l:")),
                item,
            ),
            long,
            true,
        ),
    ] {
        let contents = whole(&bytes);
        assert_eq!(contents.mesh.triangles.len(), 4, "{name}");
        let found = contents
            .ignored
            .iter()
            .find(|ignored| ignored.name.contains(name));
        let found = found.unwrap_or_else(|| panic!("{name} is not in {:?}", contents.ignored));
        assert_eq!(found.changes_shape, changes_shape, "{name}");
    }
    let rels = RELS.replace("<Relationship ", r#"<Relationship Target="3D\3DMODEL.model" Id="a" Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/><Relationship "#);
    let contents = whole(&archive(&[
        ("_rels/.rels", &rels),
        ("/3D/3dmodel.model", &model("", &one, item)),
    ]));
    assert!(
        contents.ignored[0].name.contains("another 3D model") && contents.ignored[0].changes_shape
    );
    let error = meshed(&packed(
        &format!(r#"xmlns:l="{long}" requiredextensions="l""#),
        &one,
        item,
    ))
    .unwrap_err();
    assert!(error.contains(long), "{error}");
    for material in [
        "http://schemas.microsoft.com/3dmanufacturing/material/2019/01",
        "http://schemas.3mf.io/3dmanufacturing/material/2025/07",
    ] {
        assert!(
            meshed(&packed(
                &format!(r#"xmlns:l="{material}" requiredextensions="l""#),
                &one,
                item
            ))
            .is_ok()
        );
    }
}

/// Tests that excessive work is refused before it is done. Covers XML a thousand times the file
/// size, 2⁶³ empty nested objects, deeply nested elements, and thousands of prefixes.
#[test]
fn work_is_bounded_by_the_file() {
    let twice = |below: usize| {
        let component = format!(r#"<component objectid="{below}"/>"#);
        object(
            &format!("{}", below + 1),
            &format!("<components>{component}{component}</components>"),
        )
    };
    let empty = object("1", "<mesh><vertices/><triangles/></mesh>");
    let resources: String = (1..=60).map(twice).collect();
    let items = r#"<item objectid="61"/>"#;
    let error = meshed(&packed("", &(empty + &resources), items)).unwrap_err();
    assert!(error.contains("no triangles"), "{error}");

    let one = object("1", TETRAHEDRON);
    let item = r#"<item objectid="1"/>"#;
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    zip.start_file("_rels/.rels", SimpleFileOptions::default())
        .unwrap();
    zip.write_all(RELS.as_bytes()).unwrap();
    zip.start_file("3D/3dmodel.model", SimpleFileOptions::default())
        .unwrap();
    zip.write_all(model("", &one, item).as_bytes()).unwrap();
    let blanks = vec![b' '; 1 << 20];
    (0..24).for_each(|_| zip.write_all(&blanks).unwrap());
    let bytes = zip.finish().unwrap().into_inner();
    assert!(bytes.len() < 100_000);
    let error = meshed(&bytes).unwrap_err();
    assert!(error.contains("30 times the archive's"), "{error}");

    let short = "<a/>".repeat(1_100_000);
    let error = meshed(&packed("", &(one.clone() + &short), item)).unwrap_err();
    assert!(error.contains("16 bytes an element"), "{error}");

    let deep = format!("{}{}", "<a>".repeat(1000), "</a>".repeat(1000));
    assert!(
        meshed(&packed("", &(one.clone() + &deep), item))
            .unwrap_err()
            .contains("64 deep")
    );
    let prefixes: String = (0..1000)
        .map(|i| format!(r#" xmlns:p{i}="u{i}""#))
        .collect();
    assert!(meshed(&packed("", &(one + &format!("<a{prefixes}/>")), item)).is_err());
}
