//! Light from the cut compared with 12 × 12 rays per pixel on generated parts that are hard to
//! sample.

use super::clearance::{CLEARANCE_PX, MAX_SPREAD_PX};
use super::*;
use crate::accel::{Accel, TriangleClusters};
use crate::frame::{DefocusSettings, PixelQuadrature, footprint};
use crate::laser::{Beam, CUTOFF_RADII, Fan, FanProfile, Laser};
use crate::math::rng::{Purpose, RngKey};
use crate::math::{DVec2, DVec3, Rigid};
use crate::mesh::{Mesh, shapes};
use crate::surface::Lambert;
use glam::UVec2;

/// Kinds of parts.
const KINDS: [&str; 10] = [
    "ribs",
    "wires",
    "perforated plate",
    "edge-on walls",
    "chamfers",
    "dense mesh",
    "noisy scan",
    "stacked balls",
    "clutter",
    "slats",
];

/// Fraction of the brightest pixel above which a column counts as lit, and below which it counts as
/// dark. A column between both is neither, because small errors would change its class.
const LIT: f64 = 0.02;
const DARK: f64 = LIT / 2.0;

/// Root mean square error, relative to the brightest pixel, that is negligible. Errors ε of the pixels
/// of a line of σ = 1.5 px, the widest line here, displace its centroid over ±3σ by 1.7·√σ·ε =
/// 2.1·ε px. A displacement by 0.1 µm of height is 1.2·10⁻³ px (0.05 mm per pixel, 40° between laser
/// and camera).
const NEGLIGIBLE: f64 = 5e-4;

/// Sequence of random numbers.
struct Random(RngKey, u64);

impl Random {
    fn between(&mut self, low: f64, high: f64) -> f64 {
        self.1 += 1;
        low + (high - low) * self.0.uniform(self.1)
    }

    fn vector(&mut self, half: DVec3) -> DVec3 {
        DVec3::new(
            self.between(-half.x, half.x),
            self.between(-half.y, half.y),
            self.between(-half.z, half.z),
        )
    }
}

/// Appends a box with these half sides, angles (degrees) and center.
fn append_box(mesh: &mut Mesh, half: DVec3, angles: DVec3, center: DVec3) {
    let corner = |i: u32| {
        let sign = |bit: u32| if i >> bit & 1 == 1 { 1.0 } else { -1.0 };
        half * DVec3::new(sign(0), sign(1), sign(2))
    };
    let quads = [
        [0, 2, 3, 1],
        [4, 5, 7, 6],
        [0, 1, 5, 4],
        [2, 6, 7, 3],
        [0, 4, 6, 2],
        [1, 3, 7, 5],
    ];
    let other = Mesh {
        positions: (0..8).map(corner).collect(),
        triangles: (quads.iter())
            .flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]])
            .collect(),
    };
    mesh.append(&other, &Rigid::from_euler_xyz(angles, center));
}

/// Returns a square of 10 mm with the given heights at (n + 1)² points.
fn relief(n: u32, mut height: impl FnMut(DVec2) -> f64) -> Mesh {
    let side = n + 1;
    let at = |i: u32| (i as f64 / n as f64 - 0.5) * 10.0;
    let points = (0..side * side).map(|i| DVec2::new(at(i % side), at(i / side)));
    Mesh {
        positions: points.map(|p| p.extend(height(p))).collect(),
        triangles: (0..n * n)
            .flat_map(|i| {
                let a = i / n * side + i % n;
                [[a, a + 1, a + side], [a + 1, a + side + 1, a + side]]
            })
            .collect(),
    }
}

/// Returns a part of the kind with this index. The laser line is along x.
fn part(kind: usize, random: &mut Random) -> Mesh {
    let mut mesh = Mesh {
        positions: Vec::new(),
        triangles: Vec::new(),
    };
    if !matches!(kind, 5 | 6) {
        let tilt = random.vector(DVec3::new(5.0, 5.0, 30.0));
        append_box(&mut mesh, DVec3::new(6.0, 6.0, 0.5), tilt, DVec3::Z * -0.5);
    }
    let turn = random.between(-20.0, 20.0);
    match kind {
        0 => (0..12).for_each(|_| {
            let half = DVec3::new(random.between(0.005, 0.15), 4.0, random.between(0.1, 1.0));
            let center = DVec3::X * random.between(-4.0, 4.0);
            append_box(&mut mesh, half, DVec3::Z * turn, center);
        }),
        1 => (0..14).for_each(|_| {
            let width = random.between(0.01, 0.08);
            let angles = random.vector(DVec3::new(10.0, 10.0, 90.0));
            let center = random.vector(DVec3::new(3.0, 1.0, 0.5)) + DVec3::Z;
            append_box(&mut mesh, DVec3::new(6.0, width, width), angles, center);
        }),
        2 => (-16..16).for_each(|i| {
            let center = DVec3::new(i as f64 * 0.35, 0.0, 1.2);
            append_box(&mut mesh, DVec3::new(0.1, 4.0, 0.05), DVec3::ZERO, center);
            let center = DVec3::new(0.0, i as f64 * 0.35, 1.2);
            append_box(&mut mesh, DVec3::new(4.0, 0.09, 0.05), DVec3::ZERO, center);
        }),
        3 => (0..8).for_each(|i| {
            let angles = DVec3::new(random.between(-3.0, 3.0), random.between(-3.0, 3.0), turn);
            let center = DVec3::new(i as f64 - 4.0, random.between(-0.2, 0.2), 0.0);
            let half = DVec3::new(random.between(0.2, 0.4), 0.4, 1.5);
            append_box(&mut mesh, half, angles, center);
        }),
        4 => (0..6).for_each(|i| {
            let angles = DVec3::new(0.0, 45.0, turn);
            let center = DVec3::new(1.5 * i as f64 - 4.0, 0.0, random.between(-0.5, 0.3));
            append_box(&mut mesh, DVec3::new(0.6, 5.0, 0.6), angles, center);
        }),
        5 => {
            let (a, b) = (random.between(0.5, 2.0), random.between(0.0, 6.0));
            mesh = relief(300, |p| 0.4 * (a * p.x + b).sin() * (a * p.y).cos());
        }
        6 => mesh = relief(100, |p| 0.3 * p.x.sin() + random.between(-0.02, 0.02)),
        7 => (0..14).for_each(|_| {
            let radius = random.between(0.3, 1.2);
            let ball = shapes::sphere(radius, 2e-3).unwrap();
            let center = random.vector(DVec3::new(4.0, 1.5, 1.0)) + DVec3::Z * 0.5;
            mesh.append(&ball, &Rigid::translation(center));
        }),
        8 => (0..60).for_each(|_| {
            let half = random.vector(DVec3::splat(0.7)).abs() + 0.02;
            let angles = random.vector(DVec3::splat(90.0));
            let center = random.vector(DVec3::new(4.0, 2.0, 1.0)) + DVec3::Z * 0.5;
            append_box(&mut mesh, half, angles, center);
        }),
        _ => (0..20).for_each(|i| {
            let angles = DVec3::new(0.0, random.between(20.0, 70.0), turn / 2.0);
            let center = DVec3::new(0.45 * i as f64 - 4.5, 0.0, 0.6);
            append_box(&mut mesh, DVec3::new(0.3, 3.0, 0.03), angles, center);
        }),
    }
    mesh
}

/// Calls `then` with a view of a part, and its clusters. The camera looks at 30° to 50° to the
/// beam, with 0.05 mm per pixel.
fn seen(kind: usize, seed: u64, then: impl FnOnce(&PoseView, &TriangleClusters)) {
    let key = RngKey::new(46, Purpose::SensorNoise).with(kind as u64);
    let mut random = Random(key.with(seed), 0);
    let mesh = part(kind, &mut random);
    let accel = Accel::build(&mesh.clone().into(), 1).unwrap();
    let mut camera = crate::camera::fixture();
    camera.sensor.resolution = UVec2::new(160, 120);
    camera.sensor.pixel_pitch = 0.05 * 25.0 / 215.0;
    let laser = Laser {
        beam: Beam {
            wavelength: 660e-6,
            power_mw: 5.0,
            waist_radius: random.between(0.06, 0.15),
            waist_distance: 200.0,
            m_squared: 1.0,
        },
        fan: Some(Fan {
            angle: random.between(0.03, 0.3),
            profile: FanProfile::Uniform,
        }),
    };
    let looking = |from: DVec3| Rigid::from_z_and_x(from, -from, DVec3::X).unwrap();
    let (sin, cos) = random.between(30.0, 50.0).to_radians().sin_cos();
    let view = PoseView {
        accel: &accel,
        surface: Lambert { reflectance: 0.5 }.into(),
        laser: &laser,
        part_from_laser: looking(DVec3::new(random.between(-20.0, 20.0), 0.0, 200.0)),
        camera: &camera,
        part_from_camera: looking(DVec3::new(0.0, -sin, cos) * 240.0),
        speckle: None,
        grid: PixelQuadrature::Gauss { per_side: 2 },
        sampling: Sampling::PlaneCut,
        beam_cutoff_radii: CUTOFF_RADII,
        lens: DefocusSettings::NONE,
        indirect: None,
        stop: None,
    };
    then(&view, &TriangleClusters::new(&mesh));
}

/// Returns the mean of every pixel, row by row.
fn means(light: &DirectIrradiance) -> Vec<f64> {
    let mut image = vec![0.0; light.rows.pixels.columns * light.rows.pixels.rows];
    for (column, row, samples) in light.pixels() {
        let weighted = samples.iter().zip(light.nodes.weights());
        image[row * light.rows.pixels.columns + column] =
            weighted.map(|(&e, &weight)| e as f64 * weight as f64).sum();
    }
    image
}

/// Deviation of an image from the reference.
#[derive(Debug)]
struct Deviation {
    /// Root of the mean squared deviation of the lit pixels, relative to the brightest pixel.
    rms: f64,
    /// Columns that are lit in one of both images only.
    columns: Vec<usize>,
}

impl Deviation {
    fn of(image: &[f64], reference: &[f64], width: usize) -> Deviation {
        let brightest = reference.iter().copied().fold(0.0, f64::max);
        let squares = image.iter().zip(reference).map(|(a, b)| (a - b).powi(2));
        let lit = reference.iter().filter(|&&e| e > 0.0).count();
        let maximum = |image: &[f64], column: usize| {
            let column = image.iter().skip(column).step_by(width);
            column.copied().fold(0.0, f64::max) / brightest
        };
        Deviation {
            rms: (squares.sum::<f64>() / lit as f64).sqrt() / brightest,
            columns: (0..width)
                .filter(|&x| {
                    let [a, b] = [image, reference].map(|image| maximum(image, x));
                    a.max(b) > LIT && a.min(b) < DARK
                })
                .collect(),
        }
    }
}

/// Returns the deviations of the cut, of rays per pixel, and of 8 × 8 rays from 12 × 12 rays per pixel,
/// and prints them.
fn deviations(kind: usize, seed: u64) -> [Deviation; 3] {
    let mut found = None;
    seen(kind, seed, |view, clusters| {
        let region = TracedRegion::Lit(clusters);
        let pixels = || footprint(view, &region);
        let [coarser, reference] = [8, 12].map(|per_side| {
            let view = PoseView {
                grid: PixelQuadrature::Gauss { per_side },
                sampling: Sampling::Rays,
                ..view.clone()
            };
            means(&direct_light::light(&view, pixels()))
        });
        let start = std::time::Instant::now();
        let cut = light(view, &region).unwrap();
        let middle = start.elapsed();
        let rays = PoseView {
            sampling: Sampling::Planes,
            ..view.clone()
        };
        let rays = direct_light::light(&rays, pixels());
        let times = [middle, start.elapsed() - middle].map(|time| time.as_secs_f64() * 1e3);
        let [cut, rays, coarser] = [means(&cut), means(&rays), coarser]
            .map(|image| Deviation::of(&image, &reference, 160));
        let all = [cut, rays, coarser];
        println!("{} {seed}: {all:?}, {times:.1?} ms", KINDS[kind]);
        found = Some(all);
    });
    found.unwrap()
}

/// The cut is at least as accurate as one ray per flat pixel and 2 × 2 rays elsewhere, or its error is
/// negligible. The allowance is the error of the reference. The deviation of 8 × 8 rays exceeds it,
/// because more rays are more accurate.
fn is_at_least_as_accurate(seeds: Range<u64>) {
    let mut missed = Vec::new();
    for (kind, name) in KINDS.iter().enumerate() {
        for seed in seeds.clone() {
            let [cut, rays, coarser] = deviations(kind, seed);
            let rms = (rays.rms + coarser.rms).max(NEGLIGIBLE);
            if cut.rms > rms || cut.columns.len() > rays.columns.len() + coarser.columns.len() {
                missed.push((name, seed, cut, rays));
            }
        }
    }
    assert!(missed.is_empty(), "{} scenes: {missed:#?}", missed.len());
}

#[test]
fn light_from_the_cut_is_at_least_as_accurate_as_rays() {
    is_at_least_as_accurate(0..2);
}

/// Rays confirm that clear chains are visible. Queries ignore surface up to the clearance above a run,
/// which deviates from its plane by the spread. Such heights hide at most their number of rows from the
/// camera and from the laser. Rays locate the ends of visible rows within 2⁻⁶ of the
/// distance of two tests, 0.25 rows, at each of up to four ends.
#[test]
fn clear_chains_are_visible() {
    const MOST_HIDDEN: f64 = 2.0 * (CLEARANCE_PX + MAX_SPREAD_PX) + 4.0 * 0.25 / 64.0;
    let mut tested = 0;
    for (kind, name) in KINDS.iter().enumerate() {
        seen(kind, 200, |view, clusters| {
            let cut = BeamSection::new(view, &TracedRegion::Lit(clusters)).unwrap();
            let facets = ColumnFacets::new(&cut);
            let slice = |column| Slice::new(&cut, facets.of(column), column as f64 + 0.5);
            let mut slices: Vec<Slice> = facets.touched().map(slice).collect();
            mark_clear_chains(&cut, clusters, &mut slices);
            for slice in &mut slices {
                let clear: Vec<bool> = slice.chains.iter().map(|chain| chain.is_clear).collect();
                slice
                    .chains
                    .iter_mut()
                    .for_each(|chain| chain.is_clear = false);
                let slices = std::slice::from_ref(slice);
                let pieces = visible_pieces(&cut, slices, 0.25);
                for (k, chain) in slices[0]
                    .chains
                    .iter()
                    .enumerate()
                    .filter(|(k, _)| clear[*k])
                {
                    let pieces = pieces.iter().filter(|piece| piece.chain == k);
                    let seen: f64 = pieces.map(|piece| piece.rows[1] - piece.rows[0]).sum();
                    let hidden = chain.rows[1] - chain.rows[0] - seen;
                    assert!(
                        hidden <= MOST_HIDDEN,
                        "{name}: {hidden} rows at {}",
                        slices[0].x
                    );
                    tested += 1;
                }
            }
        });
    }
    // One run of the smallest length per part.
    assert!(tested >= 10 * 16, "{tested} chains");
}

#[test]
#[ignore = "200 scenes"]
fn light_from_the_cut_is_at_least_as_accurate_on_two_hundred_parts() {
    is_at_least_as_accurate(0..20);
}

#[test]
fn light_does_not_depend_on_the_number_of_threads() {
    for (kind, name) in KINDS.iter().enumerate() {
        seen(kind, 100, |view, clusters| {
            let region = TracedRegion::Lit(clusters);
            let with = |threads: usize| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
                let pool = pool.build().unwrap();
                let light = pool.install(|| light(view, &region).unwrap());
                light
                    .irradiance
                    .iter()
                    .map(|e| e.to_bits())
                    .collect::<Vec<_>>()
            };
            let one = with(1);
            assert!(one.iter().any(|&bits| bits != 0));
            assert!(one == with(2) && one == with(8), "{name}");
        });
    }
}
