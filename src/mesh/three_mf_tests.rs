use super::*;
use crate::mesh::{UnitBy, parse, unit_by};
use std::io::Write;
use zip::write::SimpleFileOptions;

const RELS: &str = r#"<?xml version="1.0" encoding="UTF-8"?>
<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">
<Relationship Target="/3D/3dmodel.model" Id="rel0" Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/>
</Relationships>"#;

/// A tetrahedron with corners at 1, 2 and 3 along the axes.
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
        assert_eq!(unit_by(Path::new("part"), &bytes).unwrap(), UnitBy::File);
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

/// A component moved by 10 along x in an object that is turned by 90° about z, one in a file of its own,
/// and one mirrored: 18 triangles' worth of three tetrahedra, each with six times the volume of 6.
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
    // The first: (x, y) becomes (−y, x + 10).
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
    // Production is no matter of shape.
    assert!(meshed(&packed(r#"requiredextensions="p""#, &one, item)).is_ok());
}

/// 2⁴⁰ tetrahedra in a few hundred bytes.
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
    // And of the XML, which the archive's sums do not guard.
    let text = model("", &object("1", TETRAHEDRON), r#"<item objectid="1"/>"#);
    for at in 0..text.len() {
        for value in ["", "<", "\"", "9", "/>"] {
            let changed = format!("{}{value}{}", &text[..at], &text[at + 1..]);
            let bytes = archive(&[("_rels/.rels", RELS), ("3D/3dmodel.model", &changed)]);
            let _ = parse(Path::new("part"), &bytes, None);
        }
    }
}
