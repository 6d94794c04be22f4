use super::*;
use crate::mesh::{UnitSource, load, parse, unit_by};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::{Value, json};
use std::path::Path;

/// Corners of a tetrahedron as 12 numbers, followed by its four triangles.
const CORNERS: [[f32; 3]; 4] = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]];
const TRIANGLES: [[u16; 3]; 4] = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];

fn bytes() -> Vec<u8> {
    let corners = CORNERS.iter().flatten().flat_map(|x| x.to_le_bytes());
    corners
        .chain(TRIANGLES.iter().flatten().flat_map(|v| v.to_le_bytes()))
        .collect()
}

/// Returns a document with the tetrahedron under the given nodes.
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

/// Returns six times the enclosed volume.
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
    assert_eq!(
        unit_by(Path::new("part"), &glb).unwrap(),
        UnitSource::Metres
    );

    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("a b.bin"), bytes()).unwrap();
    let beside = json!({ "byteLength": 72, "uri": "a%20b.bin" });
    let file = folder.path().join("part.gltf");
    std::fs::write(&file, document(json!([{ "mesh": 0 }]), beside).to_string()).unwrap();
    assert_eq!(load(&file, None).unwrap(), mesh);
    // The scene can override the unit, because many programs write millimetres.
    let millimetres = load(&file, 1.0).unwrap();
    assert_eq!(millimetres.bounds().max, DVec3::new(1.0, 2.0, 3.0));
}

/// Tests a child of a node rotated by 90° about z and moved along x, and a mirrored node. Both keep
/// outward normals.
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
    // (x, y) becomes (10 − y, 2x); f32 values are accurate to 10⁻⁷.
    let near = |a: DVec3, b: [f64; 3]| (a - DVec3::from_array(b) * 1000.0).length() < 0.01;
    assert!(
        near(bounds.min, [-6.0, 0.0, 0.0]) && near(bounds.max, [10.0, 2.0, 3.0]),
        "{bounds:?}"
    );
    // Six times the volume is 6 for each tetrahedron, doubled for the first.
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
            "without a scene|two parents|no triangles",
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
        ("/accessors/0/componentType", json!(5125), "for positions"),
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
    // The file does not use the extension.
    assert_eq!(meshed(&text), meshed(&good));
    let primitive = &mut text["meshes"][0]["primitives"][0];
    primitive["extensions"] = json!({ "KHR_draco_mesh_compression": { "bufferView": 0 } });
    assert!(
        meshed(&text)
            .unwrap_err()
            .contains("KHR_draco_mesh_compression")
    );
    // Two nodes share one child.
    let nodes = json!([{ "children": [2] }, { "children": [2] }, { "mesh": 0 }]);
    assert!(
        meshed(&document(nodes, inside()))
            .unwrap_err()
            .contains("two parents")
    );
}

/// Tests that any truncation or byte change of a binary file gives a mesh or an error.
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

/// Random numbers from 0 to 1 from a seed (SplitMix64).
struct Numbers(u64);

impl Numbers {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ z >> 31) >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Returns a vector of single-precision values, as stored in the file.
    fn vector<const N: usize>(&mut self) -> [f64; N] {
        [0; N].map(|_| f64::from((2.0 * self.next() - 1.0) as f32))
    }

    fn quaternion(&mut self) -> [f64; 4] {
        let length = |q: [f64; 4]| q.iter().map(|x| x * x).sum::<f64>().sqrt();
        let q = self.vector();
        q.map(|x| x / length(q))
    }
}

/// Returns the matrix of a translation, a quaternion and a scale, computed from the definition.
fn matrix(by: [f64; 3], [x, y, z, w]: [f64; 4], scale: [f64; 3]) -> [[f64; 4]; 4] {
    let turn = [
        [
            1.0 - 2.0 * (y * y + z * z),
            2.0 * (x * y - w * z),
            2.0 * (x * z + w * y),
        ],
        [
            2.0 * (x * y + w * z),
            1.0 - 2.0 * (x * x + z * z),
            2.0 * (y * z - w * x),
        ],
        [
            2.0 * (x * z - w * y),
            2.0 * (y * z + w * x),
            1.0 - 2.0 * (x * x + y * y),
        ],
    ];
    let row = |i: usize| {
        [
            turn[i][0] * scale[0],
            turn[i][1] * scale[1],
            turn[i][2] * scale[2],
            by[i],
        ]
    };
    [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
}

fn times(a: [[f64; 4]; 4], b: [[f64; 4]; 4]) -> [[f64; 4]; 4] {
    let at = |i: usize, j: usize| (0..4).map(|k| a[i][k] * b[k][j]).sum();
    [0, 1, 2, 3].map(|i| [0, 1, 2, 3].map(|j| at(i, j)))
}

fn moved(m: [[f64; 4]; 4], p: DVec3) -> DVec3 {
    let row = |i: usize| m[i][0] * p.x + m[i][1] * p.y + m[i][2] * p.z + m[i][3];
    DVec3::new(row(0), row(1), row(2))
}

/// Adds a separate buffer with its view and accessor. Returns the index of the accessor.
fn add(text: &mut Value, bytes: &[u8], count: usize, kind: (u32, &str, bool)) -> usize {
    let list = |text: &mut Value, name: &str, value: Value| {
        let list = text[name].as_array_mut().unwrap();
        list.push(value);
        list.len() - 1
    };
    let uri = format!("data:;base64,{}", STANDARD.encode(bytes));
    let buffer = list(
        text,
        "buffers",
        json!({ "byteLength": bytes.len(), "uri": uri }),
    );
    let view = json!({ "buffer": buffer, "byteLength": bytes.len() });
    let view = list(text, "bufferViews", view);
    let (component, form, normalized) = kind;
    let accessor = json!({ "bufferView": view, "componentType": component, "count": count, "type": form,
        "normalized": normalized });
    list(text, "accessors", accessor)
}

fn floats(numbers: impl IntoIterator<Item = f64>) -> Vec<u8> {
    { numbers.into_iter() }
        .flat_map(|x| (x as f32).to_le_bytes())
        .collect()
}

/// Compares corners in metres with the expected corners; f32 values are accurate to 10⁻⁷ each.
fn assert_corners(text: &Value, expected: &[DVec3], what: &str) {
    let mesh = meshed(text).unwrap();
    assert_eq!(mesh.triangles.len(), 4, "{what}");
    for (i, wanted) in TRIANGLES.iter().enumerate() {
        let wanted = wanted.map(|v| expected[v as usize] * 1000.0);
        let mut found = mesh.triangle(i);
        // A mirror reverses each triangle.
        if (found[1] - wanted[1]).length() > 0.1 {
            found.swap(1, 2);
        }
        for (found, wanted) in found.iter().zip(wanted) {
            assert!(
                (*found - wanted).length() < 1e-4 * (1.0 + wanted.length()),
                "{what}: {found} {wanted}"
            );
        }
    }
    // With or without a mirror, normals point outward if the corners keep their orientation.
    let [o, x, y, z] = [0, 1, 2, 3].map(|i| expected[i]);
    let sense = (x - o).dot((y - o).cross(z - o)).signum();
    assert!(volume(&mesh) != 0.0 && sense != 0.0, "{what}");
}

/// Tests skins of three joints in a chain, with random poses, scales and weights, in each weight
/// format. The node of the mesh has a different pose. Every second case also has a morph target.
#[test]
#[expect(
    clippy::too_many_lines,
    reason = "a file is made and its vertices worked out"
)]
fn skins_and_morph_targets_are_in_the_pose_that_is_stored() {
    for seed in 0..30 {
        let mut numbers = Numbers(seed);
        let mut pose = || {
            let scale: [f64; 3] = numbers.vector();
            (
                numbers.vector::<3>(),
                numbers.quaternion(),
                scale.map(|x| 1.0 + 0.5 * x),
            )
        };
        let poses = [pose(), pose(), pose(), pose()];
        let inverse = [pose(), pose(), pose()].map(|(by, turn, scale)| matrix(by, turn, scale));
        let node = |(by, turn, scale): ([f64; 3], [f64; 4], [f64; 3]), more: Value| {
            let mut node = json!({ "translation": by, "rotation": turn, "scale": scale });
            let more = more.as_object().unwrap().clone();
            node.as_object_mut().unwrap().extend(more);
            node
        };
        let nodes = json!([
            node(poses[0], json!({ "mesh": 0, "skin": 0 })),
            node(poses[1], json!({ "children": [2] })),
            node(poses[2], json!({ "children": [3] })),
            node(poses[3], json!({})),
        ]);
        let mut text = document(nodes, inside());
        let columns = inverse
            .iter()
            .flat_map(|m| (0..16).map(|i| m[i % 4][i / 4]));
        let matrices = add(&mut text, &floats(columns), 3, (5126, "MAT4", false));
        text["skins"] = json!([{ "joints": [1, 2, 3], "inverseBindMatrices": matrices }]);
        // Two joints per corner; the third has zero weight and an invalid joint index.
        let joints: Vec<[usize; 2]> = (0..4)
            .map(|_| [0; 2].map(|_| (numbers.next() * 3.0) as usize))
            .collect();
        let parts: Vec<f64> = (0..4)
            .map(|_| (numbers.next() * 255.0).round() / 255.0)
            .collect();
        let of_joints: Vec<u8> = joints
            .iter()
            .flat_map(|&[a, b]| [a as u8, b as u8, 200, 0])
            .collect();
        let of_joints = add(&mut text, &of_joints, 4, (5121, "VEC4", false));
        let rows = parts.iter().flat_map(|&w| [w, 1.0 - w, 0.0, 0.0]);
        let weights = match seed % 3 {
            0 => add(&mut text, &floats(rows), 4, (5126, "VEC4", false)),
            1 => {
                let bytes: Vec<u8> = rows.map(|w| (w * 255.0).round() as u8).collect();
                add(&mut text, &bytes, 4, (5121, "VEC4", true))
            }
            _ => {
                let bytes = rows.flat_map(|w| ((w * 65535.0).round() as u16).to_le_bytes());
                add(
                    &mut text,
                    &bytes.collect::<Vec<_>>(),
                    4,
                    (5123, "VEC4", true),
                )
            }
        };
        let primitive = &mut text["meshes"][0]["primitives"][0];
        primitive["attributes"]["JOINTS_0"] = json!(of_joints);
        primitive["attributes"]["WEIGHTS_0"] = json!(weights);
        let mut corners = CORNERS.map(|c| DVec3::from_array(c.map(f64::from)));
        if seed % 2 == 0 {
            let ways: Vec<[f64; 3]> = (0..4).map(|_| numbers.vector()).collect();
            let weight = f64::from(numbers.next() as f32);
            let target = add(
                &mut text,
                &floats(ways.iter().flatten().copied()),
                4,
                (5126, "VEC3", false),
            );
            text["meshes"][0]["primitives"][0]["targets"] =
                json!([{ "NORMAL": 99 }, { "POSITION": target }]);
            // The weights of the node override the weights of the mesh.
            text["meshes"][0]["weights"] = json!([0.0, 7.0]);
            text["nodes"][0]["weights"] = json!([0.5, weight]);
            for (corner, way) in corners.iter_mut().zip(ways) {
                *corner += weight * DVec3::from_array(way);
            }
        }
        let of = |i: usize| matrix(poses[i].0, poses[i].1, poses[i].2);
        let global = [
            of(1),
            times(of(1), of(2)),
            times(times(of(1), of(2)), of(3)),
        ];
        let bone = |i: usize, p: DVec3| moved(times(global[i], inverse[i]), p);
        let expected: Vec<DVec3> = (0..4)
            .map(|i| {
                parts[i] * bone(joints[i][0], corners[i])
                    + (1.0 - parts[i]) * bone(joints[i][1], corners[i])
            })
            .collect();
        assert_corners(&text, &expected, &format!("seed {seed}"));
    }
}

/// Tests instances by `EXT_mesh_gpu_instancing` with random poses, with and without each attribute.
#[test]
fn copies_are_placed() {
    for seed in 0..16usize {
        let mut numbers = Numbers(seed as u64);
        let node_by: [f64; 3] = numbers.vector();
        let mut text = document(json!([{ "mesh": 0, "translation": node_by }]), inside());
        let mut attributes = json!({ "_ID": 0 });
        attributes.as_object_mut().unwrap().clear();
        let by: Vec<[f64; 3]> = (0..3).map(|_| numbers.vector()).collect();
        let turn: Vec<[f64; 4]> = (0..3).map(|_| numbers.quaternion()).collect();
        let scale: Vec<[f64; 3]> = (0..3)
            .map(|_| numbers.vector::<3>().map(|x| 1.0 + 0.5 * x))
            .collect();
        let mut of = |name: &str, rows: Vec<f64>, form: &str| {
            attributes[name] = json!(add(&mut text, &floats(rows), 3, (5126, form, false)));
        };
        let uses = [seed % 2 == 1, seed / 2 % 2 == 1, seed / 4 % 2 == 1];
        if uses[0] || !uses[1] && !uses[2] {
            of("TRANSLATION", by.concat(), "VEC3");
        }
        if uses[1] {
            of("ROTATION", turn.concat(), "VEC4");
        }
        if uses[2] {
            of("SCALE", scale.concat(), "VEC3");
        }
        text["nodes"][0]["extensions"] =
            json!({ "EXT_mesh_gpu_instancing": { "attributes": attributes } });
        let names = json!(["EXT_mesh_gpu_instancing"]);
        text["extensionsUsed"] = names.clone();
        if seed >= 8 {
            text["extensionsRequired"] = names;
        }
        let mesh = meshed(&text).unwrap();
        assert_eq!(mesh.triangles.len(), 12);
        for copy in 0..3 {
            let by = if uses[0] || !uses[1] && !uses[2] {
                by[copy]
            } else {
                [0.0; 3]
            };
            let turn = if uses[1] {
                turn[copy]
            } else {
                [0.0, 0.0, 0.0, 1.0]
            };
            let scale = if uses[2] { scale[copy] } else { [1.0; 3] };
            for (i, corners) in TRIANGLES.iter().enumerate() {
                let found = mesh.triangle(4 * copy + i);
                for (found, &v) in found.iter().zip(corners) {
                    let corner = DVec3::from_array(CORNERS[v as usize].map(f64::from));
                    let wanted =
                        moved(matrix(by, turn, scale), corner) + DVec3::from_array(node_by);
                    assert!(
                        (*found / 1000.0 - wanted).length() < 1e-5,
                        "seed {seed}: {found} {wanted}"
                    );
                }
            }
        }
    }
}

/// Tests positions as integers of each type, and with sparse elements.
#[test]
fn quantised_and_sparse_positions_are_read() {
    let quantised = |component: u32, normalized: bool, bytes: Vec<u8>| {
        let mut text = document(json!([{ "mesh": 0 }]), inside());
        let number = add(&mut text, &bytes, 4, (component, "VEC3", normalized));
        text["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = json!(number);
        meshed(&text).unwrap().bounds().max
    };
    let corners = |unit: f64| {
        let whole = CORNERS.map(|corner| corner.map(|x| f64::from(x) * unit));
        whole.into_iter().flatten().collect::<Vec<f64>>()
    };
    let i8s = |unit: f64| {
        corners(unit)
            .iter()
            .map(|&x| x as i8 as u8)
            .collect::<Vec<_>>()
    };
    let i16s = |unit: f64| {
        corners(unit)
            .iter()
            .flat_map(|&x| (x as i32 as u16).to_le_bytes())
            .collect::<Vec<_>>()
    };
    let wanted = DVec3::new(1.0, 2.0, 3.0) * 1000.0;
    for (found, wanted) in [
        (quantised(5120, false, i8s(1.0)), wanted),
        (quantised(5121, false, i8s(1.0)), wanted),
        (quantised(5122, false, i16s(1.0)), wanted),
        (quantised(5123, false, i16s(1.0)), wanted),
        (quantised(5120, true, i8s(42.0)), wanted * (42.0 / 127.0)),
        (quantised(5121, true, i8s(42.0)), wanted * (42.0 / 255.0)),
        (quantised(5122, true, i16s(1e4)), wanted * (1e4 / 32767.0)),
        (quantised(5123, true, i16s(1e4)), wanted * (1e4 / 65535.0)),
    ] {
        assert!((found - wanted).length() < 1e-9, "{found} {wanted}");
    }
    for seed in 0..8 {
        let mut numbers = Numbers(seed);
        let mut text = document(json!([{ "mesh": 0 }]), inside());
        let at = (numbers.next() * 4.0) as usize;
        let to: [f64; 3] = numbers.vector();
        let index = [
            (5121, vec![at as u8]),
            (5123, vec![at as u8, 0]),
            (5125, vec![at as u8, 0, 0, 0]),
        ];
        let (kind, bytes) = index[seed as usize % 3].clone();
        add(&mut text, &bytes, 1, (kind, "SCALAR", false));
        add(&mut text, &floats(to), 1, (5126, "VEC3", false));
        text["accessors"][0]["sparse"] = json!({ "count": 1,
            "indices": { "bufferView": 2, "componentType": kind }, "values": { "bufferView": 3 } });
        let mut expected = CORNERS.map(|c| DVec3::from_array(c.map(f64::from)));
        expected[at] = DVec3::from_array(to);
        assert_corners(&text, &expected, &format!("seed {seed}"));
        // The sparse index exceeds the element count.
        text["accessors"][0]["count"] = json!(at);
        assert!(meshed(&text).is_err());
    }
}

fn ignored(text: &Value) -> Vec<(String, bool)> {
    let bytes = text.to_string();
    let contents = crate::mesh::parse_whole(Path::new("part.gltf"), bytes.as_bytes(), None);
    let ignored = contents.unwrap().ignored.into_iter();
    ignored
        .map(|ignored| (ignored.name, ignored.changes_shape))
        .collect()
}

/// Tests that required extensions for appearance are listed and those for the shape are refused.
/// Optional extensions in the geometry give a warning.
#[test]
fn what_is_not_read_is_listed_by_name() {
    let good = document(json!([{ "mesh": 0 }]), inside());
    assert_eq!(ignored(&good), []);
    for name in [
        "KHR_materials_clearcoat",
        "KHR_materials_variants",
        "KHR_texture_basisu",
        "EXT_texture_webp",
        "MSFT_texture_dds",
        "KHR_lights_punctual",
        "KHR_xmp_json_ld",
        "KHR_animation_pointer",
        "KHR_materials_pbrSpecularGlossiness",
        "EXT_lights_image_based",
        "EXT_structural_metadata",
    ] {
        let mut text = good.clone();
        text["extensionsRequired"] = json!([name]);
        text["extensionsUsed"] = json!([name]);
        assert_eq!(ignored(&text), [(format!("the extension {name}"), false)]);
    }
    let mut text = good.clone();
    text["nodes"][0]["extensions"] = json!({ "ACME_bent": { "by": 3 } });
    text["animations"] = json!([{}, {}]);
    text["scenes"].as_array_mut().unwrap().push(json!({}));
    let listed = ignored(&text);
    assert_eq!(
        listed[0],
        ("the extension ACME_bent of a node".to_owned(), true)
    );
    assert_eq!(
        listed[1..],
        [
            ("animations".to_owned(), false),
            ("another scene".to_owned(), false)
        ]
    );
    text["extensionsRequired"] =
        json!(["ACME_bent_and_a_name_that_is_longer_than_forty_characters"]);
    let error = meshed(&text).unwrap_err();
    assert!(
        error.contains("ACME_bent_and_a_name_that_is_longer_than_forty_characters"),
        "{error}"
    );
    // NaN in ignored content, and NaN where a number is required.
    let extras = good
        .to_string()
        .replacen('{', r#"{"extras":{"x":[NaN,-Infinity,"NaN\""]},"#, 1);
    let read = |text: &str| parse(Path::new("part"), text.as_bytes(), None);
    assert_eq!(read(&extras).unwrap(), meshed(&good).unwrap());
    assert!(read(&good.to_string().replace("\"mesh\":0", "\"mesh\":NaN")).is_err());
}

#[test]
fn hidden_nodes_stay_away_and_lost_data_is_named() {
    let hidden = json!({ "KHR_node_visibility": { "visible": false } });
    let nodes =
        json!([{ "mesh": 0 }, { "mesh": 0, "extensions": hidden, "children": [2] }, { "mesh": 0 }]);
    let text = document(nodes, inside());
    assert_eq!(meshed(&text).unwrap().triangles.len(), 4);
    assert!(ignored(&text)[0].0.contains("hidden"));
    // An unused buffer may be missing. A buffer without data must not use the data of the first
    // one.
    let mut text = document(json!([{ "mesh": 0 }]), inside());
    let buffers = text["buffers"].as_array_mut().unwrap();
    buffers.push(json!({ "byteLength": 4, "uri": "absent.bin" }));
    buffers.push(json!({ "byteLength": 72 }));
    assert!(meshed(&text).is_ok());
    text["bufferViews"][0]["extensions"] = json!({ "EXT_meshopt_compression": { "buffer": 0 } });
    text["bufferViews"][0]["buffer"] = json!(2);
    assert!(
        meshed(&text)
            .unwrap_err()
            .contains("EXT_meshopt_compression")
    );
    for (pointer, value) in [
        ("/skins", json!([])),
        ("/skins", json!([{ "joints": [9] }])),
        ("/skins", json!([{ "joints": [] }])),
    ] {
        let mut text = document(json!([{ "mesh": 0, "skin": 0 }]), inside());
        add(&mut text, &[0; 16], 4, (5121, "VEC4", false));
        add(&mut text, &floats([1.0; 16]), 4, (5126, "VEC4", false));
        text["meshes"][0]["primitives"][0]["attributes"] =
            json!({ "POSITION": 0, "JOINTS_0": 2, "WEIGHTS_0": 3 });
        text[&pointer[1..]] = value;
        assert!(meshed(&text).is_err());
    }
    for uri in ["./x.bin", "sub/../x.bin", ".\\x.bin", "x%2ebin"] {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("x.bin"), bytes()).unwrap();
        let file = folder.path().join("part.gltf");
        let text = document(
            json!([{ "mesh": 0 }]),
            json!({ "byteLength": 72, "uri": uri }),
        );
        std::fs::write(&file, text.to_string()).unwrap();
        assert!(load(&file, None).is_ok(), "{uri}");
    }
}

/// Tests counts that exceed the content of the file.
#[test]
fn memory_is_bounded_by_the_file() {
    let huge = json!(4_000_000_000u64);
    for pointer in ["/accessors/0/count", "/accessors/1/count"] {
        for without in [true, false] {
            let mut text = document(json!([{ "mesh": 0 }]), inside());
            add(&mut text, &[0, 0], 1, (5123, "SCALAR", false));
            add(&mut text, &floats([0.0; 3]), 1, (5126, "VEC3", false));
            *text.pointer_mut(pointer).unwrap() = huge.clone();
            if without {
                let accessor = text["accessors"][0].as_object_mut().unwrap();
                accessor.remove("bufferView");
                accessor.insert("sparse".to_owned(), json!({ "count": 1,
                    "indices": { "bufferView": 2, "componentType": 5123 }, "values": { "bufferView": 3 } }));
            }
            assert!(meshed(&text).is_err(), "{pointer}");
        }
    }
}
