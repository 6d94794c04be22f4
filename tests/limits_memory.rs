//! Memory that reading a mesh takes, at its peak, as a multiple of the file. Alone in
//! its program, since the peak is that of all threads.
// With the race's rivals the program counts allocations itself, and there is one
// allocator to a program.
#![cfg(not(feature = "race"))]

use lasertrace::mesh;
use peak_alloc::PeakAlloc;
use std::path::Path;

#[global_allocator]
static ALLOCATED: PeakAlloc = PeakAlloc;

/// Bytes taken beside the file while it is parsed, and whether it is a mesh.
fn taken(bytes: &[u8]) -> (usize, bool) {
    let before = ALLOCATED.current_usage();
    ALLOCATED.reset_peak_usage();
    let is_mesh = mesh::parse(Path::new("part"), bytes, 1.0).is_ok();
    (ALLOCATED.peak_usage().saturating_sub(before), is_mesh)
}

/// What every reader may take whatever the file: tables of the weld and stacks of
/// the threads.
const ANYWAY: usize = 1 << 20;

fn stl(count: u32, announced: u32) -> Vec<u8> {
    let mut bytes = vec![b' '; 80];
    bytes.extend(announced.to_le_bytes());
    for i in 0..count {
        bytes.extend([0; 12]);
        for k in 0..9 {
            bytes.extend(((i * 9 + k) as f32).to_le_bytes());
        }
        bytes.extend([0; 2]);
    }
    bytes
}

fn ply(encoding: &str, [vertices, faces]: [u64; 2], body: &[u8]) -> Vec<u8> {
    let header = format!(
        "ply\nformat {encoding} 1.0\nelement vertex {vertices}\nproperty uchar x\n\
         property uchar y\nproperty uchar z\nelement face {faces}\n\
         property list uchar uchar vertex_indices\nend_header\n"
    );
    [header.as_bytes(), body].concat()
}

/// What a file holds, how many times itself it may take, whether it is a mesh, and it.
type Case = (&'static str, usize, bool, Vec<u8>);

/// The shortest statements of each format, over and over, and counts that promise
/// more than there is.
fn hostile() -> Vec<Case> {
    const N: usize = 400_000;
    let repeated = |head: &str, line: &str, n: usize| [head, &line.repeat(n)].concat().into_bytes();
    let points = "v 0 0 0\nv 1 0 0\nv 0 1 0\n";
    let facet = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n";
    let polygon = format!(
        "{points}{}",
        ["f", &" 1 2 3".repeat(100), "\n"].concat().repeat(400)
    );
    let faces = [&[0u8, 0, 0, 1, 0, 0, 0, 1, 0][..], &[3, 0, 1, 2].repeat(N)].concat();
    vec![
        ("binary STL", 6, true, stl(100_000, 100_000)),
        ("STL that promises more", 6, false, stl(1000, u32::MAX)),
        (
            "ASCII STL",
            6,
            true,
            [
                repeated("solid a\n", facet, N / 8),
                b"endsolid a\n".to_vec(),
            ]
            .concat(),
        ),
        (
            "ASCII STL, cut",
            6,
            false,
            repeated("solid a\nfacet normal 0 0 1\n", "outer loop ", N),
        ),
        ("OBJ of faces", 30, true, repeated(points, "f 1 2 3\n", N)),
        (
            "OBJ of shorter faces",
            30,
            true,
            repeated(points, "f 1 1 1\n", N),
        ),
        (
            "OBJ of vertices",
            30,
            true,
            repeated("f 1 2 3\n", "v 0 0 0\n", N),
        ),
        ("OBJ of one long line", 30, false, repeated("v", " 1", N)),
        ("OBJ of polygons", 30, true, polygon.into_bytes()),
        (
            "PLY of faces",
            30,
            true,
            ply("binary_little_endian", [3, N as u64], &faces),
        ),
        (
            "PLY of too many",
            30,
            false,
            ply("ascii", [u64::MAX, 1], b"0 0 0\n"),
        ),
        (
            "PLY of many vertices",
            30,
            false,
            ply("ascii", [N as u64, 1], "0 0 0\n".repeat(N).as_bytes()),
        ),
        ("text", 30, false, b"v ".repeat(N)),
    ]
}

/// Within 6 times the file for STL and 30 times for the others, as `mesh::load` says.
#[test]
fn no_mesh_file_takes_more_memory_than_is_stated() {
    for (name, times, expected, bytes) in hostile() {
        let (taken, is_mesh) = taken(&bytes);
        println!("{name}: {:.2}", taken as f64 / bytes.len() as f64);
        assert_eq!(is_mesh, expected, "{name}");
        assert!(
            taken <= times * bytes.len() + ANYWAY,
            "{name}: {taken} bytes for a file of {}",
            bytes.len()
        );
    }
    every_bit();
}

/// Every bit of small files turned round: a count is a number of 32 bits, and one bit
/// makes it 4 billion.
fn every_bit() {
    let little = [0f32, 0., 0., 1., 0., 0., 0., 1., 0.].map(f32::to_le_bytes);
    let text = "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\n\
                property float y\nproperty float z\nelement face 1\n\
                property list uint uint vertex_indices\nend_header\n";
    let list = [3u32, 0, 1, 2].map(u32::to_le_bytes);
    let ply = [text.as_bytes(), little.as_flattened(), list.as_flattened()].concat();
    assert!(taken(&ply).1);
    for file in [
        ply,
        stl(2, 2),
        b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n".to_vec(),
    ] {
        for bit in 0..8 * file.len() {
            let mut file = file.clone();
            file[bit / 8] ^= 1 << (bit % 8);
            let (taken, _) = taken(&file);
            assert!(
                taken <= 30 * file.len() + ANYWAY,
                "bit {bit}: {taken} bytes"
            );
        }
    }
}
