//! The OBJ reader agrees with an independent reader, `tobj`, vertex by vertex.

use crate::random::Random;
use lasertrace::math::DVec3;
use lasertrace::mesh::{self, Mesh};
use std::collections::BTreeSet;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Statements of files that contain only faces, names and attributes of vertices.
const STATEMENTS: [&str; 10] = ["v", "vt", "vn", "f", "g", "o", "s", "usemtl", "mtllib", "#"];

/// Returns whether a file contains only these statements. Files with weights of vertices, with
/// colours of some vertices only, and with continued lines are excluded: `tobj` divides by the
/// weights and refuses the others.
fn is_face_only(text: &str) -> bool {
    let mut numbers = BTreeSet::new();
    let mut plain = |line: &str| {
        let mut words = line.split_ascii_whitespace();
        let Some(first) = words.next() else {
            return true;
        };
        if first == "v" {
            numbers.insert(words.count());
        }
        first.starts_with('#') || STATEMENTS.contains(&first)
    };
    let known = text.lines().all(&mut plain);
    let alike = numbers.len() <= 1 && numbers.iter().all(|count| [3, 6].contains(count));
    known && alike && !text.contains('\\')
}

/// Returns the corners of each face of more than two corners, in the order of the file.
fn reference(text: &str) -> Result<Vec<Vec<DVec3>>, tobj::LoadError> {
    let options = tobj::LoadOptions {
        ignore_lines: true,
        ignore_points: true,
        ..tobj::LoadOptions::default()
    };
    let no_materials = |_: &Path| Err(tobj::LoadError::OpenFileFailed);
    let (models, _) = tobj::load_obj_buf(&mut text.as_bytes(), &options, no_materials)?;
    let mut faces = Vec::new();
    for tobj::Model { mesh, .. } in models {
        let corner = |&index: &u32| DVec3::from_slice(&mesh.positions[3 * index as usize..]);
        let mut corners = mesh.indices.iter().map(corner);
        // Without arities, all faces are triangles.
        let triangles = vec![3; mesh.indices.len() / 3];
        let arities = match mesh.face_arities.is_empty() {
            true => &triangles,
            false => &mesh.face_arities,
        };
        for &arity in arities {
            let face: Vec<DVec3> = corners.by_ref().take(arity as usize).collect();
            faces.extend(Some(face).filter(|face| face.len() > 2));
        }
    }
    Ok(faces)
}

/// Asserts that the triangles of `mesh` have the corners of `faces` in their order. A polygon of n
/// corners has n − 2 triangles with these corners and the same vector area.
fn assert_same(mesh: &Mesh, faces: &[Vec<DVec3>], name: &str) {
    let mut triangles = mesh
        .triangles
        .iter()
        .map(|triangle| triangle.map(|vertex| mesh.positions[vertex as usize]));
    for (k, face) in faces.iter().enumerate() {
        let parts: Vec<[DVec3; 3]> = triangles.by_ref().take(face.len() - 2).collect();
        assert_eq!(parts.len(), face.len() - 2, "{name}: face {k}");
        if let ([part], [_, _, _]) = (&parts[..], &face[..]) {
            assert_eq!(part, &face[..], "{name}: face {k}");
            continue;
        }
        let found = parts.as_flattened();
        let all = |a: &[DVec3], b: &[DVec3]| a.iter().all(|corner| b.contains(corner));
        assert!(all(found, face) && all(face, found), "{name}: face {k}");
        let area = |[a, b, c]: &[DVec3; 3]| (b - a).cross(c - a);
        let found: DVec3 = parts.iter().map(area).sum();
        let fan = face[1..]
            .windows(2)
            .map(|pair| area(&[face[0], pair[0], pair[1]]));
        // Each coordinate of a cross product has three roundings of terms up to 8·m², with the
        // largest coordinate m: differences are up to 2·m, and two of their products are added.
        let largest = face
            .iter()
            .map(|p| p.abs().max_element())
            .fold(0.0, f64::max);
        let rounding = face.len() as f64 * 2.0 * 3.0 * 8.0 * largest.powi(2) * f64::EPSILON;
        assert!(
            (found - fan.sum::<DVec3>()).length() <= rounding,
            "{name}: face {k}"
        );
    }
    assert!(triangles.next().is_none(), "{name}: more triangles");
}

/// Returns the OBJ files below a folder.
fn files(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        match path.extension() {
            _ if path.is_dir() => found.extend(files(&path)),
            Some(ending) if ending.eq_ignore_ascii_case("obj") => found.push(path),
            _ => {}
        }
    }
    found.sort();
    found
}

/// All face-only files of the data that both readers accept agree. The refusals of this reader are
/// those of `REFUSED`, each for a fault that `tobj` does not report.
#[test]
fn face_only_files_are_read_as_by_tobj() {
    const REFUSED: [&str; 0] = [];
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    if !data.is_dir() {
        eprintln!("NOT TESTED: {} is absent", data.display());
        return;
    }
    let mut compared = 0;
    for path in files(&data) {
        let name = path.strip_prefix(&data).unwrap().display().to_string();
        let Ok(text) = std::fs::read_to_string(&path) else {
            continue;
        };
        if !is_face_only(&text) {
            continue;
        }
        match (mesh::load(&path, 1.0), reference(&text)) {
            (Ok(mesh), Ok(faces)) => {
                assert_same(&mesh, &faces, &name);
                compared += 1;
            }
            (Err(error), Ok(faces)) => {
                let refused = faces.is_empty() || REFUSED.contains(&name.as_str());
                assert!(refused, "{name}: {error}");
            }
            (Ok(_), Err(error)) => panic!("{name}: only tobj refuses it: {error}"),
            (Err(_), Err(_)) => {}
        }
    }
    eprintln!("{compared} files compared");
    assert!(compared >= 10, "{compared}");
}

/// Returns a number in one of the notations of the format.
fn number(random: &mut Random) -> String {
    let value = random.between(-1.0, 1.0) * random.scale(1e-3, 1e6);
    match random.choice(5) {
        0 => format!("{value:.3}"),
        1 => format!("{value:e}"),
        2 => format!("{value:E}"),
        3 if value > 0.0 => format!("+{value}"),
        4 if value.abs() < 1.0 => format!("{value:.17}").replacen("0.", ".", 1),
        _ => format!("{value:?}"),
    }
}

/// Returns a file of random vertices and faces, with absolute and relative indices, attributes of
/// corners, names and comments. Faces of more than three corners are convex and planar.
fn generated(seed: u64) -> String {
    let random = &mut Random::new(seed);
    let (mut text, mut vertices) = (String::from("# generated\nmtllib none.mtl\n"), 0);
    let color = [" 0.5 0.25 1", ""][random.choice(2)];
    for group in 0..1 + random.choice(4) {
        let kind = ["g", "o", "usemtl"][random.choice(3)];
        writeln!(text, "{kind} name{group}").unwrap();
        for _ in 0..3 + random.choice(30) {
            for _ in 0..3 {
                let [x, y, z] = [(); 3].map(|()| number(random));
                writeln!(text, "v {x}  {y}\t{z}{color}").unwrap();
            }
            let corners = 3 + random.choice(5);
            let (radius, height) = (random.scale(0.1, 100.0), random.between(-5.0, 5.0));
            for k in 0..corners {
                let turn = std::f64::consts::TAU * k as f64 / corners as f64;
                let [x, y] = [turn.cos(), turn.sin()].map(|c| c * radius);
                writeln!(
                    text,
                    "v {x:?} {y:?} {height:?}{color}\nvt 0.5 0.5\nvn 0 0 1"
                )
                .unwrap();
            }
            vertices += 3 + corners;
            let style = random.choice(5);
            let mut face = |first: usize, corners: usize| {
                let words = (first..first + corners).map(|vertex| match style {
                    0 => format!("{vertex}"),
                    1 => format!("{}", vertex as i64 - vertices as i64 - 1),
                    2 => format!("{vertex}/1"),
                    3 => format!("{vertex}//1"),
                    _ => format!("{vertex}/1/1"),
                });
                let words: Vec<String> = words.collect();
                writeln!(text, "f {}", words.join(" ")).unwrap();
            };
            face(vertices - corners - 2, 3);
            face(vertices - corners + 1, corners);
        }
    }
    text
}

/// Generated files agree for 40 seeds.
#[test]
fn generated_files_are_read_as_by_tobj() {
    for seed in 0..40 {
        let text = generated(seed);
        assert!(is_face_only(&text));
        let mesh = mesh::parse(Path::new("generated.obj"), text.as_bytes(), 1.0);
        let mesh = mesh.unwrap_or_else(|error| panic!("{seed}: {error}"));
        let faces = reference(&text).unwrap_or_else(|error| panic!("{seed}: {error}"));
        assert_same(&mesh, &faces, &format!("seed {seed}"));
    }
}

/// The comparison reports a moved vertex and a lost face.
#[test]
#[should_panic(expected = "face")]
fn another_vertex_is_reported() {
    let text = generated(1);
    let mut mesh = mesh::parse(Path::new("generated.obj"), text.as_bytes(), 1.0).unwrap();
    let vertex = mesh.triangles[4][1] as usize;
    mesh.positions[vertex].x = mesh.positions[vertex].x.next_up();
    assert_same(&mesh, &reference(&text).unwrap(), "moved");
}
