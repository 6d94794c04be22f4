//! Tolerance bands of a scan: the regions' sums are those of the cloud's verdicts, and these follow from its
//! deviations and their uncertainties.

use crate::program::{PLANE, assert_error, folder_with, run, scene};
use serde_json::Value;
use std::fs;

/// Name, type and offset of each property of a vertex, the bytes of all vertices, and the bytes per vertex.
type Ply<'a> = (Vec<(String, String, usize)>, &'a [u8], usize);

fn ply(bytes: &[u8]) -> Ply<'_> {
    let end = b"end_header\n";
    let header = bytes.windows(end.len()).position(|w| w == end).unwrap() + end.len();
    let text = std::str::from_utf8(&bytes[..header]).unwrap();
    let (mut properties, mut at) = (Vec::new(), 0);
    for line in text.lines() {
        if let Some((kind, name)) = line
            .strip_prefix("property ")
            .and_then(|p| p.split_once(' '))
        {
            let size = match kind {
                "double" => 8,
                "uchar" => 1,
                _ => 4,
            };
            properties.push((name.to_owned(), kind.to_owned(), at));
            at += size;
        }
    }
    (properties, &bytes[header..], at)
}

/// A plane 0.1 mm too high for its CAD would be all fail; here it is as it should be, and the bands differ.
#[test]
#[expect(clippy::too_many_lines, reason = "one scan and all that is said of it")]
fn regions_sum_up_the_verdicts_of_the_cloud() {
    let bands = "[inspect]\ntolerance_mm = [-1, 1]\n\
                 [inspect.regions.left]\nbounds_mm = [[-20, -20, -1], [0, 20, 1]]\ntolerance_mm = [0.2, 0.4]\n\
                 [inspect.regions.\"far off\"]\nbounds_mm = [[50, 50, 50], [60, 60, 60]]\n\
                 [inspect.regions.tight]\nbounds_mm = [[1, -20, -1], [2, 20, 1]]\ntolerance_mm = [-1e-9, 1e-9]\n";
    let folder = folder_with(&(scene(PLANE) + bands));
    let (code, said, stderr) = run(folder.path(), &["scan", "scene.toml", "-o", "out"]);
    assert_eq!(code, 0, "{stderr}");
    assert!(
        said.contains("tolerance:  ")
            && said.contains("100.0 % of the measured area of part is within"),
        "{said}"
    );
    let summary = fs::read(folder.path().join("out/summary.json")).unwrap();
    let summary: Value = serde_json::from_slice(&summary).unwrap();
    let bytes = fs::read(folder.path().join("out/cloud.ply")).unwrap();
    let (properties, vertices, size) = ply(&bytes);
    let of = |name: &str, vertex: &[u8]| {
        let (_, kind, at) = properties.iter().find(|p| p.0 == name).unwrap();
        let bytes = &vertex[*at..];
        match kind.as_str() {
            "double" => f64::from_le_bytes(bytes[..8].try_into().unwrap()),
            "float" => f32::from_le_bytes(bytes[..4].try_into().unwrap()).into(),
            "int" => i32::from_le_bytes(bytes[..4].try_into().unwrap()).into(),
            other => panic!("{name} is {other}"),
        }
    };
    // In the order of the numbers in the cloud: the rest, and then by name.
    let names = ["part", "far off", "left", "tight"];
    let limits = [[-1.0, 1.0], [-1.0, 1.0], [0.2, 0.4], [-1e-9, 1e-9]];
    let mut counts = [[0; 4]; 4];
    for vertex in vertices.chunks_exact(size) {
        let [x, d, u] =
            ["x", "scalar_deviation", "scalar_u_deviation"].map(|name| of(name, vertex));
        let flags = of("scalar_flags", vertex) as u32;
        let (verdict, region) = (
            of("scalar_verdict", vertex) as usize,
            of("scalar_region", vertex),
        );
        if flags & !64 != 0 {
            assert_eq!((verdict, region), (0, -1.0));
            continue;
        }
        let expected = match x {
            x if x <= 0.0 => 2,
            x if (1.0..=2.0).contains(&x) => 3,
            _ => 0,
        };
        assert_eq!(region, f64::from(expected));
        let [lower, upper] = limits[expected as usize];
        let says = match () {
            () if flags & 64 != 0 => 3,
            () if lower + 2.0 * u <= d && d <= upper - 2.0 * u => 1,
            () if d < lower - 2.0 * u || d > upper + 2.0 * u => 2,
            () => 3,
        };
        assert_eq!(verdict, says, "{d} {u}");
        counts[expected as usize][verdict] += 1;
    }
    let regions = summary["tolerance"].as_array().unwrap();
    for (i, region) in regions.iter().enumerate() {
        assert_eq!(region["name"], names[i]);
        let of = |key: &str| region[key].as_u64().unwrap();
        assert_eq!(
            [of("pass"), of("fail"), of("unsure")],
            [1, 2, 3].map(|v| counts[i][v]),
            "{region}"
        );
        assert!(region.get("verdict").is_none(), "{region}");
        let area = |key: &str| region["area"][key].as_f64();
        match names[i] {
            // All points have the same verdict there.
            "part" => assert_eq!(area("within"), Some(1.0), "{region}"),
            "left" => assert_eq!(area("beyond"), Some(1.0), "{region}"),
            "far off" => assert!(region["area"].is_null(), "{region}"),
            _ => {
                // A band narrower than any uncertainty passes nothing.
                let sum = area("beyond").unwrap() + area("across").unwrap();
                assert!((sum - 1.0).abs() < 1e-9, "{region}");
            }
        }
    }
    assert!(counts[2][2] > 20 && counts[0][1] > 20, "{counts:?}");
    let report = fs::read_to_string(folder.path().join("out/report.html")).unwrap();
    assert!(report.contains("<h2>Tolerance</h2>") && report.contains("far off"));
}

#[test]
fn wrong_bands_are_refused_at_their_line() {
    for (lines, words) in [
        (
            "tolerance_mm = [1, 1]",
            "scene.toml:45: inspect.tolerance_mm: found [1, 1], expected a lower limit and an upper one",
        ),
        (
            "tolerance_mm = [nan, 1]",
            "inspect.tolerance_mm: found [nan, 1], expected finite numbers",
        ),
        (
            "tolerance_mm = 1",
            "inspect.tolerance_mm: found 1, expected a list",
        ),
        (
            "regions.a = { bounds_mm = [[0, 0, 0], [1, 1, 1]] }",
            "inspect.regions.a.tolerance_mm is missing, expected tolerance_mm",
        ),
        (
            "regions.a = { tolerance_mm = [0, 1] }",
            "inspect.regions.a.bounds_mm is missing",
        ),
        (
            "regions.a = { tolerance_mm = [0, 1], bounds_mm = [[0, 0, 0], [1, 0, 1]] }",
            "inspect.regions.a.bounds_mm: found [[0, 0, 0], [1, 0, 1]], expected a lower corner",
        ),
        (
            "regions.a = { tolerance_mm = [0, 1], box = 3 }",
            "inspect.regions.a.box",
        ),
        (
            "tolerance_mm = [0, 1]\nregions.part = { bounds_mm = [[0, 0, 0], [1, 1, 1]] }",
            "expected another name",
        ),
    ] {
        let folder = folder_with(&(scene(PLANE) + "[inspect]\n" + lines + "\n"));
        assert_error(folder.path(), &["check", "scene.toml"], 65, &[words]);
    }
}
