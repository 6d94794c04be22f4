//! Data sets: the same bytes for any number of threads, shards and kills; the truth in them is true.

#![cfg(unix)]

use crate::program::{PLANE, folder_with, run, scene};
use std::collections::BTreeMap;
use std::fs;
use std::io::{Cursor, Read};
use std::path::Path;
use tempfile::TempDir;

const RECIPE: &str = r#"scene = "scene.toml"
samples = 11
samples_per_file = 3
seed = 5
[sample]
"camera.f_number" = { from = 6, to = 11, scale = "log" }
"laser.power_mw" = { from = 1, to = 2 }
"part.position_mm" = { from = [-1, -1, -1], to = [1, 1, 1] }
"#;

fn set_folder(recipe: &str) -> TempDir {
    let folder = folder_with(&scene(PLANE).replace("speckle = false", "speckle = true"));
    fs::write(folder.path().join("set.toml"), recipe).unwrap();
    folder
}

fn made(folder: &Path, more: &[&str]) -> (i32, String, String) {
    run(
        folder,
        &[&["dataset", "set.toml", "-o", "out"], more].concat(),
    )
}

fn contents(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let entries = fs::read_dir(folder.join("out")).unwrap();
    let paths = entries.map(|entry| entry.unwrap().path());
    let files = paths.filter(|path| path.is_file());
    let name = |path: &Path| path.file_name().unwrap().to_str().unwrap().to_owned();
    files
        .map(|path| (name(&path), fs::read(&path).unwrap()))
        .collect()
}

#[test]
fn threads_shards_and_losses_change_no_byte() {
    let whole = set_folder(RECIPE);
    let (code, said, stderr) = made(whole.path(), &["--threads", "1"]);
    assert!(code == 0 && said.contains("the set is whole"), "{stderr}");
    let expected = contents(whole.path());
    assert_eq!(expected.len(), 4 * 2 + 1, "{:?}", expected.keys());

    let folder = set_folder(RECIPE);
    for shard in ["1/2", "0/2"] {
        let (code, said, stderr) = made(folder.path(), &["--shard", shard, "--threads", "2"]);
        assert_eq!(code, 0, "{stderr}");
        assert_eq!(said.contains("the set is whole"), shard == "0/2");
    }
    assert!(contents(folder.path()) == expected);
    // A kill leaves an unfinished file; a file is cut, another lost.
    let out = folder.path().join("out");
    fs::write(out.join("samples-000003.tar.000000000000001f.part"), "cut").unwrap();
    fs::write(out.join("samples-000001.tar"), "cut").unwrap();
    fs::remove_file(out.join("samples-000002.tar")).unwrap();
    let (_, said, _) = made(folder.path(), &[]);
    assert!(said.contains("2 of them made now"), "{said}");
    assert!(contents(folder.path()) == expected);
    // Another recipe's files are not mixed with these.
    fs::write(
        folder.path().join("set.toml"),
        RECIPE.replace("to = 2 }", "to = 3 }"),
    )
    .unwrap();
    let (code, _, stderr) = made(folder.path(), &[]);
    assert!(
        code == 64 && stderr.contains("is of another run"),
        "{stderr}"
    );
}

/// Bytes that changed on the disk are found by the SHA-256 of the index: a run makes its own files again, and refuses
/// to call the set whole while another shard's are damaged.
#[test]
fn damaged_files_are_found_by_their_checksum() {
    let folder = set_folder(RECIPE);
    let out = folder.path().join("out");
    assert_eq!(made(folder.path(), &[]).0, 0);
    let expected = contents(folder.path());
    let mut state = 3_u64;
    for file in [0, 1, 3] {
        let tar = out.join(format!("samples-{file:06}.tar"));
        let mut bytes = fs::read(&tar).unwrap();
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1);
        let at = (state >> 33) as usize % bytes.len();
        bytes[at] ^= 1 << (at % 8);
        fs::write(&tar, &bytes).unwrap();
        fs::remove_file(out.join("index.json")).unwrap();
        let other = format!("{}/2", 1 - file % 2);
        let (code, _, stderr) = made(folder.path(), &["--shard", &other]);
        assert_eq!(code, 65, "{stderr}");
        let words = format!("samples-{file:06}.tar: found other bytes");
        let again = format!("run shard {} of 2 again", file % 2);
        assert!(
            stderr.contains(&words) && stderr.contains(&again),
            "{stderr}"
        );
        assert!(!out.join("index.json").exists());
        let (_, said, _) = made(folder.path(), &["--shard", &format!("{}/2", file % 2)]);
        assert!(said.contains("1 of them made now"), "{said}");
        assert!(contents(folder.path()) == expected);
    }
    // What cannot be read back is no success.
    let index = out.join("samples-000002.json");
    fs::remove_file(&index).unwrap();
    fs::create_dir(&index).unwrap();
    fs::remove_file(out.join("index.json")).unwrap();
    let (code, _, stderr) = made(folder.path(), &[]);
    assert!(
        code != 0 && stderr.contains("samples-000002.json"),
        "{stderr}"
    );
}

fn unpacked(tar: &[u8]) -> BTreeMap<String, Vec<u8>> {
    let mut files = BTreeMap::new();
    for entry in tar::Archive::new(tar).entries().unwrap() {
        let mut entry = entry.unwrap();
        let path = entry.path().unwrap().to_str().unwrap().to_owned();
        let mut content = Vec::new();
        entry.read_to_end(&mut content).unwrap();
        files.insert(path, content);
    }
    files
}

#[test]
fn a_sample_is_rendered_again_from_its_own_scene() {
    let folder = set_folder(RECIPE);
    assert_eq!(made(folder.path(), &["--shard", "1/4"]).0, 0);
    let files = unpacked(&contents(folder.path())["samples-000001.tar"]);
    assert_eq!(files.len(), 3 * 4, "{:?}", files.keys());
    let about: serde_json::Value = serde_json::from_slice(&files["000000004.json"]).unwrap();
    fs::write(folder.path().join("one.toml"), &files["000000004.toml"]).unwrap();
    let frame = about["frame"].to_string();
    let (code, _, stderr) = run(
        folder.path(),
        &["render", "one.toml", "--frame", &frame, "-o", "one"],
    );
    assert_eq!(code, 0, "{stderr}");
    let image = fs::read(folder.path().join(format!("one/frame-{frame:0>6}.png"))).unwrap();
    assert!(image == files["000000004.png"]);
}

/// The numbers of an array of NumPy's, after its header.
fn values(npy: &[u8]) -> &[u8] {
    &npy[10 + u16::from_le_bytes([npy[8], npy[9]]) as usize..]
}

/// On a plane, without noise, speckle and blur, the line's centre of light in each column is where the
/// truth says, by less than 0.01 px. Counts are rounded: half a count in each of ten pixels moves the centre of
/// 5000 counts by 0.003 px at most.
#[test]
fn the_line_in_a_set_is_where_the_light_is() {
    let folder = set_folder(RECIPE);
    let text = scene(PLANE) + "[model]\ndefocus_model = \"none\"\nnoise = false\n";
    let text = text.replace("gain_dn_per_e = 0.02", "gain_dn_per_e = 1");
    let text = text.replace("bit_depth = 10", "bit_depth = 16");
    fs::write(folder.path().join("scene.toml"), text).unwrap();
    let (code, _, stderr) = made(folder.path(), &[]);
    assert_eq!(code, 0, "{stderr}");
    let mut compared = 0;
    for (name, bytes) in contents(folder.path()) {
        if !name.ends_with(".tar") {
            continue;
        }
        let files = unpacked(&bytes);
        for (name, png) in files.iter().filter(|(name, _)| name.ends_with(".png")) {
            let image = image::load_from_memory(png).unwrap().to_luma16();
            let npz = &files[&name.replace(".png", ".npz")];
            let mut npz = zip::ZipArchive::new(Cursor::new(npz)).unwrap();
            let mut line = Vec::new();
            npz.by_name("line.npy")
                .unwrap()
                .read_to_end(&mut line)
                .unwrap();
            for point in values(&line).chunks_exact(12) {
                let column = u32::from_le_bytes(point[..4].try_into().unwrap());
                let row = f64::from_le_bytes(point[4..].try_into().unwrap());
                let (mut sum, mut moment) = (0.0, 0.0);
                for y in 0..image.height() {
                    let counts = f64::from(image.get_pixel(column, y).0[0]) - 8.0;
                    sum += counts;
                    moment += counts * (f64::from(y) + 0.5);
                }
                if sum > 5000.0 {
                    assert!(
                        (moment / sum - row).abs() < 0.01,
                        "{name}, column {column}: {} {row}",
                        moment / sum
                    );
                    compared += 1;
                }
            }
        }
    }
    assert!(compared > 100, "{compared}");
}

/// A channel of an EXR file.
fn layer(path: &Path, name: &str) -> Vec<f32> {
    let image = exr::prelude::read_first_flat_layer_from_file(path).unwrap();
    let channels = image.layer_data.channel_data.list;
    let channel = channels.iter().find(|channel| channel.name.eq(name));
    channel.unwrap().sample_data.values_as_f32().collect()
}

/// Where light is reflected more than once, a set has the share that was reflected once: that of the layers that `render`
/// writes of the same sample.
#[test]
fn a_set_says_which_share_of_the_light_was_reflected_once() {
    let corner = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/corner");
    let folder = set_folder(&RECIPE.replace("samples = 11", "samples = 1"));
    let text = fs::read_to_string(corner.join("scene.toml")).unwrap();
    let text = text.replace("resolution_px = [640, 480]", "resolution_px = [40, 30]");
    let text = text.replace("pixel_pitch_um = 11", "pixel_pitch_um = 176");
    fs::write(folder.path().join("scene.toml"), text).unwrap();
    fs::copy(corner.join("corner.stl"), folder.path().join("corner.stl")).unwrap();
    let (code, _, stderr) = made(folder.path(), &[]);
    assert_eq!(code, 0, "{stderr}");
    let files = unpacked(&contents(folder.path())["samples-000000.tar"]);
    let mut npz = zip::ZipArchive::new(Cursor::new(&files["000000000.npz"])).unwrap();
    let mut share = Vec::new();
    let mut file = npz.by_name("direct.npy").unwrap();
    file.read_to_end(&mut share).unwrap();
    let number = |bytes: &[u8]| f32::from_le_bytes(bytes.try_into().unwrap());
    let share: Vec<f32> = values(&share).chunks_exact(4).map(number).collect();

    fs::write(folder.path().join("one.toml"), &files["000000000.toml"]).unwrap();
    let about: serde_json::Value = serde_json::from_slice(&files["000000000.json"]).unwrap();
    let frame = about["frame"].to_string();
    let arguments = ["render", "one.toml", "--frame", &frame, "-o", "one"];
    assert_eq!(run(folder.path(), &arguments).0, 0);
    let exr = folder.path().join(format!("one/frame-{frame:0>6}.exr"));
    let [direct, more] = ["direct", "reflections"].map(|name| layer(&exr, name));
    let expected = direct
        .iter()
        .zip(&more)
        .map(|(direct, more)| match direct + more {
            0.0 => 1.0,
            all => direct / all,
        });
    assert!(share == expected.collect::<Vec<f32>>());
    assert!(share.contains(&0.0) && share.iter().any(|&s| s > 0.9 && s < 1.0));
}

/// An array of a sample's truth, without its header.
fn array(npz: &[u8], name: &str) -> Vec<u8> {
    let mut npz = zip::ZipArchive::new(Cursor::new(npz)).unwrap();
    let mut file = npz.by_name(name).unwrap();
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes).unwrap();
    values(&bytes).to_vec()
}

type Image16 = image::ImageBuffer<image::Luma<u16>, Vec<u16>>;

/// The samples of a set by number: image, truth and description.
fn samples(folder: &Path) -> Vec<(Image16, Vec<u8>, serde_json::Value)> {
    let mut samples = Vec::new();
    for (name, tar) in contents(folder) {
        if !name.ends_with(".tar") {
            continue;
        }
        let files = unpacked(&tar);
        for (name, png) in files.iter().filter(|(name, _)| name.ends_with(".png")) {
            let of = |ending: &str| &files[&name.replace(".png", ending)];
            samples.push((
                image::load_from_memory(png).unwrap().to_luma16(),
                of(".npz").clone(),
                serde_json::from_slice(of(".json")).unwrap(),
            ));
        }
    }
    samples
}

/// The noise-free image is the image but for the sensor's noise: without noise in the plan they are equal, and
/// with it their difference has no mean beyond chance (five standard errors) on the line's pixels. The
/// mask holds the pixel of the line's centre in each column with light, and only pixels with light.
#[test]
fn a_set_has_the_noise_free_image_and_the_mask_of_the_line() {
    for noise in [false, true] {
        let folder = set_folder(&RECIPE.replace("samples = 11", "samples = 3"));
        let text = scene(PLANE).replace("speckle = false", "speckle = true");
        let text = format!("{text}[model]\nnoise = {noise}\n");
        fs::write(folder.path().join("scene.toml"), text).unwrap();
        let (code, _, stderr) = made(folder.path(), &[]);
        assert_eq!(code, 0, "{stderr}");
        for (image, npz, _) in samples(folder.path()) {
            let columns = image.width() as usize;
            let clean = array(&npz, "noise_free.npy");
            let clean = clean
                .chunks_exact(2)
                .map(|two| u16::from_le_bytes([two[0], two[1]]));
            let clean: Vec<f64> = clean.map(f64::from).collect();
            let mask = array(&npz, "mask.npy");
            assert_eq!((clean.len(), mask.len()), (image.len(), image.len()));
            let pairs = image.iter().zip(&clean).zip(&mask);
            let on_line = pairs.filter(|&(_, &on)| on == 1);
            let off: Vec<f64> = on_line.map(|((&a, b), _)| f64::from(a) - b).collect();
            let n = off.len() as f64;
            assert!(n > 100.0, "{n}");
            let mean = off.iter().sum::<f64>() / n;
            let spread = (off.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n).sqrt();
            match noise {
                false => assert!(image.iter().zip(&clean).all(|(&a, &b)| f64::from(a) == b)),
                true => assert!(
                    spread > 0.3 && mean.abs() < 5.0 * spread / n.sqrt(),
                    "{mean} {spread}"
                ),
            }
            for point in array(&npz, "line.npy").chunks_exact(12) {
                let column = u32::from_le_bytes(point[..4].try_into().unwrap()) as usize;
                let row = f64::from_le_bytes(point[4..].try_into().unwrap());
                let is_lit = |row: usize| mask[row * columns + column] == 1;
                let lit = (0..image.height() as usize).any(is_lit);
                assert!(!lit || is_lit(row as usize), "column {column}, row {row}");
            }
        }
    }
}

/// The intrinsics and the pose of the camera bring each measured point back to the pixel that it was measured at: to
/// rounding, for the scan's calibration is the true one. With distortion and a tilted sensor.
#[test]
fn the_intrinsics_of_a_set_project_its_points_to_their_pixels() {
    for (tilt, distortion) in [
        ("[0, 0]", ""),
        (
            "[3, -2]",
            "distortion = { k1 = -0.3, k2 = 0.1, k3 = 0.02, p1 = 0.002, p2 = -0.001 }\n",
        ),
    ] {
        let folder = set_folder(&RECIPE.replace("samples = 11", "samples = 3"));
        let text = scene(PLANE);
        let lens = format!("tilt_deg = {tilt}\n{distortion}");
        let text = text.replace("tilt_deg = [0, 0]\n", &lens);
        fs::write(folder.path().join("scene.toml"), text).unwrap();
        let (code, _, stderr) = made(folder.path(), &[]);
        assert_eq!(code, 0, "{stderr}");
        for (_, npz, about) in samples(folder.path()) {
            let numbers = |value: &serde_json::Value| -> Vec<f64> {
                value
                    .as_array()
                    .unwrap()
                    .iter()
                    .map(|x| x.as_f64().unwrap())
                    .collect()
            };
            let pose: Vec<_> = about["part_from_camera"]
                .as_array()
                .unwrap()
                .iter()
                .map(numbers)
                .collect();
            let matrix: Vec<_> = about["camera"]["matrix"]
                .as_array()
                .unwrap()
                .iter()
                .map(numbers)
                .collect();
            let [k1, k2, p1, p2, k3] = numbers(&about["camera"]["distortion"]).try_into().unwrap();
            let points = array(&npz, "points.npy");
            assert!(points.len() > 106 * 30);
            for point in points.chunks_exact(106) {
                let float = |at: usize| f64::from_le_bytes(point[at..at + 8].try_into().unwrap());
                let column = u32::from_le_bytes(point[4..8].try_into().unwrap());
                let place = [float(32), float(40), float(48)];
                let from_camera = |j: usize| -> f64 {
                    (0..3).map(|i| pose[i][j] * (place[i] - pose[i][3])).sum()
                };
                let (x, y) = (
                    from_camera(0) / from_camera(2),
                    from_camera(1) / from_camera(2),
                );
                let r2 = x * x + y * y;
                let radial = 1.0 + k1 * r2 + k2 * r2 * r2 + k3 * r2 * r2 * r2;
                let behind = [
                    x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                    y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
                    1.0,
                ];
                let row = |i: usize| -> f64 { (0..3).map(|j| matrix[i][j] * behind[j]).sum() };
                let found = [row(0) / row(2), row(1) / row(2)];
                let off = [found[0] - f64::from(column) - 0.5, found[1] - float(8)];
                assert!(off.iter().all(|x| x.abs() < 1e-6), "{tilt}: {off:?}");
            }
        }
    }
}

/// 16-bit PNG is clipped by decoders that convert to 8 bits: the index names one that does not.
#[test]
fn the_index_of_a_set_names_decoders() {
    let folder = set_folder(&RECIPE.replace("samples = 11", "samples = 1"));
    assert_eq!(made(folder.path(), &[]).0, 0);
    let index = fs::read(folder.path().join("out/index.json")).unwrap();
    let index: serde_json::Value = serde_json::from_slice(&index).unwrap();
    let files = unpacked(&contents(folder.path())["samples-000000.tar"]);
    for name in files.keys() {
        let ending = name.split_once('.').unwrap().1;
        assert!(index["decoders"][ending].is_string(), "{ending}");
    }
    let png = index["decoders"]["png"].as_str().unwrap();
    assert!(png.contains("IMREAD_UNCHANGED"), "{png}");
}
