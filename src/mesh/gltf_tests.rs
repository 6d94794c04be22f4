use super::*;
use crate::mesh::{UnitBy, load, parse, unit_by};
use serde_json::{Value, json};

/// A tetrahedron's corners as 12 numbers, then its four triangles.
const CORNERS: [[f32; 3]; 4] = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]];
const TRIANGLES: [[u16; 3]; 4] = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];

fn bytes() -> Vec<u8> {
    let corners = CORNERS.iter().flatten().flat_map(|x| x.to_le_bytes());
    corners
        .chain(TRIANGLES.iter().flatten().flat_map(|v| v.to_le_bytes()))
        .collect()
}

/// The tetrahedron under these nodes.
fn document(nodes: Value, buffer: Value) -> Value {
    let roots = nodes.as_array().unwrap().iter().enumerate();
    let children: Vec<&Value> = (nodes.as_array().unwrap().iter())
        .flat_map(|node| node["children"].as_array().into_iter().flatten())
        .collect();
    let roots: Vec<usize> = roots
        .map(|(i, _)| i)
        .filter(|i| !children.contains(&&json!(i)))
        .collect();
    json!({
        "asset": { "version": "2.0" },
        "scenes": [{ "nodes": roots }],
        "nodes": nodes,
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0 }, "indices": 1 }] }],
        "accessors": [
            { "bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3",
              "min": [0, 0, 0], "max": [1, 2, 3] },
            { "bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR" },
        ],
        "bufferViews": [
            { "buffer": 0, "byteOffset": 0, "byteLength": 48 },
            { "buffer": 0, "byteOffset": 48, "byteLength": 24 },
        ],
        "buffers": [buffer],
    })
}

fn inside() -> Value {
    let data = STANDARD.encode(bytes());
    let uri = format!("data:application/octet-stream;base64,{data}");
    json!({ "byteLength": 72, "uri": uri })
}

fn binary(document: &Value) -> Vec<u8> {
    let mut text = document.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let chunk = |bytes: &[u8], kind: &[u8; 4]| {
        let length = (bytes.len() as u32).to_le_bytes();
        [&length[..], kind, bytes].concat()
    };
    let chunks = [chunk(&text, b"JSON"), chunk(&bytes(), b"BIN\0")].concat();
    let length = 12 + chunks.len() as u32;
    [&b"glTF\x02\0\0\0"[..], &length.to_le_bytes(), &chunks].concat()
}

fn meshed(document: &Value) -> Result<Mesh, String> {
    let bytes = document.to_string();
    parse(Path::new("part.gltf"), bytes.as_bytes(), None).map_err(|e| e.to_string())
}

/// Six times the volume inside.
fn volume(mesh: &Mesh) -> f64 {
    let of = |i| {
        let [a, b, c] = mesh.triangle(i);
        a.dot(b.cross(c))
    };
    (0..mesh.triangles.len()).map(of).sum()
}

#[test]
fn metres_in_text_in_binary_and_beside_the_file_are_one_mesh() {
    let text = document(json!([{ "mesh": 0 }]), inside());
    let mesh = meshed(&text).unwrap();
    let wanted = CORNERS.map(|c| DVec3::from_array(c.map(f64::from)) * 1000.0);
    assert_eq!(mesh.triangles.len(), 4);
    for (of, wanted_of) in mesh.triangles.iter().zip(TRIANGLES) {
        for (&v, w) in of.iter().zip(wanted_of) {
            assert_eq!(mesh.positions[v as usize], wanted[w as usize]);
        }
    }
    let glb = binary(&document(
        json!([{ "mesh": 0 }]),
        json!({ "byteLength": 72 }),
    ));
    assert_eq!(parse(Path::new("part"), &glb, None).unwrap(), mesh);
    assert_eq!(unit_by(Path::new("part"), &glb).unwrap(), UnitBy::Metres);

    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("a b.bin"), bytes()).unwrap();
    let beside = json!({ "byteLength": 72, "uri": "a%20b.bin" });
    let file = folder.path().join("part.gltf");
    std::fs::write(&file, document(json!([{ "mesh": 0 }]), beside).to_string()).unwrap();
    assert_eq!(load(&file, None).unwrap(), mesh);
    // A scene may know better: many programs write millimetres.
    let millimetres = load(&file, 1.0).unwrap();
    assert_eq!(millimetres.bounds().max, DVec3::new(1.0, 2.0, 3.0));
}

/// A child under a turn by 90° about z and a way along x, and a mirrored one: both have their
/// outside outside.
#[test]
fn nodes_are_placed_and_mirrors_keep_the_outside() {
    let half = 0.5f64.sqrt();
    let nodes = json!([
        { "rotation": [0, 0, half, half], "translation": [10, 0, 0], "children": [1] },
        { "mesh": 0, "scale": [2, 1, 1] },
        { "mesh": 0, "matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, -5, 0, 0, 1] },
    ]);
    let mesh = meshed(&document(nodes, inside())).unwrap();
    assert_eq!(mesh.triangles.len(), 8);
    let bounds = mesh.bounds();
    // (x, y) becomes (10 − y, 2x); numbers of f32 are good to 10⁻⁷.
    let near = |a: DVec3, b: [f64; 3]| (a - DVec3::from_array(b) * 1000.0).length() < 0.01;
    assert!(
        near(bounds.min, [-6.0, 0.0, 0.0]) && near(bounds.max, [10.0, 2.0, 3.0]),
        "{bounds:?}"
    );
    // Six times the volume: 6 each, twice as much for the first.
    assert!(
        (volume(&mesh) / 1e9 - 18.0).abs() < 1e-5,
        "{}",
        volume(&mesh)
    );
}

#[test]
fn strips_and_fans_are_triangles() {
    let corners = |mode: u32| {
        let mut text = document(json!([{ "mesh": 0 }]), inside());
        text["meshes"][0]["primitives"][0]["mode"] = json!(mode);
        text["meshes"][0]["primitives"][0]
            .as_object_mut()
            .unwrap()
            .remove("indices");
        let mesh = meshed(&text)?;
        let of = |triangle: &[u32; 3]| triangle.map(|v| mesh.positions[v as usize] / 1000.0);
        Ok::<_, String>(mesh.triangles.iter().map(of).collect::<Vec<_>>())
    };
    let c = CORNERS.map(|c| DVec3::from_array(c.map(f64::from)));
    assert_eq!(
        corners(5).unwrap(),
        [[c[0], c[1], c[2]], [c[2], c[1], c[3]]]
    );
    assert_eq!(
        corners(6).unwrap(),
        [[c[0], c[1], c[2]], [c[0], c[2], c[3]]]
    );
    // Lines and points have no area.
    for mode in [0, 1, 3] {
        assert!(corners(mode).unwrap_err().contains("no triangles"));
    }
    assert!(corners(4).unwrap_err().contains("4 corners"));
}

#[test]
fn mistakes_are_named() {
    let good = document(json!([{ "mesh": 0 }]), inside());
    let with = |path: &str, value: Value| {
        let mut text = good.clone();
        *text.pointer_mut(path).unwrap() = value;
        meshed(&text).unwrap_err()
    };
    for (path, value, words) in [
        (
            "/nodes/0",
            json!({ "mesh": 0, "children": [0] }),
            "without a scene|two places|no triangles",
        ),
        ("/accessors/0/count", json!(5), "does not fit"),
        ("/accessors/0/count", json!(u64::MAX), ""),
        (
            "/accessors/1/count",
            json!(9_000_000_000_000_000_000u64),
            "",
        ),
        ("/accessors/1/componentType", json!(5125), "does not fit"),
        ("/accessors/1/componentType", json!(5126), "for indices"),
        ("/accessors/0/componentType", json!(5122), "for positions"),
        ("/bufferViews/0/byteOffset", json!(60), "does not fit"),
        ("/buffers/0/uri", json!("../part.bin"), "own folder"),
        ("/buffers/0/uri", json!("/etc/passwd"), "own folder"),
        (
            "/buffers/0/uri",
            json!("https://example.org/a.bin"),
            "own folder",
        ),
        ("/buffers/0/uri", json!("data:;base64,????"), "base64"),
        ("/buffers/0/byteLength", json!(73), "73 bytes"),
        ("/meshes/0/primitives/0/attributes/POSITION", json!(7), ""),
        ("/nodes/0/mesh", json!(3), ""),
        ("/scenes", json!([]), "without a scene"),
        ("/asset/version", json!("1.0"), ""),
    ] {
        let error = with(path, value);
        let any = words.split('|').any(|word| error.contains(word));
        assert!(any && error.contains("part.gltf"), "{path}: {error}");
    }
    let needs = json!(["KHR_draco_mesh_compression"]);
    let mut text = good.clone();
    text["extensionsRequired"] = needs.clone();
    text["extensionsUsed"] = needs;
    assert!(meshed(&text).is_err());
    // Two nodes with one child.
    let nodes = json!([{ "children": [2] }, { "children": [2] }, { "mesh": 0 }]);
    assert!(
        meshed(&document(nodes, inside()))
            .unwrap_err()
            .contains("two places")
    );
}

/// Whatever is changed in a binary file gives a mesh or an error.
#[test]
fn every_truncation_and_byte_change_ends_in_a_mesh_or_an_error() {
    let glb = binary(&document(
        json!([{ "mesh": 0 }]),
        json!({ "byteLength": 72 }),
    ));
    for end in 0..glb.len() {
        let _ = parse(Path::new("part"), &glb[..end], 1.0);
    }
    for at in 0..glb.len() {
        for value in [0, 1, b'-', b'9', 0x7f, 0xff] {
            let mut changed = glb.clone();
            changed[at] = value;
            if let Ok(mesh) = parse(Path::new("part"), &changed, 1.0) {
                assert!(mesh.positions.iter().all(|p| p.is_finite()));
            }
        }
    }
}
