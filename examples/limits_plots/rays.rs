//! Rays and triangles at their limits.

use crate::random::Random;
use glam::{DVec2, DVec3};
use lasertrace::accel::{Accel, Hit, Ray, WIDTH};
use lasertrace::math::Rigid;
use lasertrace::mesh::{Mesh, shapes};
use lasertrace::report::limits_plot::{LimitsCurve, LimitsPanel};

fn closest(accel: &Accel, rays: &[Ray]) -> Vec<Option<Hit>> {
    let packets = rays.chunks(WIDTH);
    packets
        .flat_map(|packet| accel.closest(packet, |_, _| true)[..packet.len()].to_vec())
        .collect()
}

fn endless(from: DVec3, to: DVec3) -> Ray {
    Ray {
        t_max: f64::INFINITY,
        ..Ray::between(from, to).expect("two places")
    }
}

/// A ball of size 1, so many of its sizes from the world's origin.
pub fn poses() -> LimitsPanel {
    let mesh = shapes::sphere(0.5, 1e-4).unwrap();
    let accel = Accel::build(&mesh.clone().into(), 1).unwrap();
    let (mut own, mut posed, mut narrowed) = (Vec::new(), Vec::new(), Vec::new());
    for power in 0..=7 {
        let sizes = 10f64.powi(power);
        let mut random = Random::new(1);
        let mut worst = [0.0f64; 3];
        for _ in 0..4000 {
            let at = random.direction() * sizes;
            let pose = Rigid::from_euler_xyz(random.vector(1.0) * 3.0, at);
            let (eye, target) = (at + random.direction() * 3.0, at + random.vector(1.0) * 0.2);
            let inverse = pose.inverse();
            let ray = endless(inverse.point(eye), inverse.point(target));
            let Some(hit) = &accel.closest(&[ray], |_, _| true)[0] else {
                continue;
            };
            let off_ray =
                |from: DVec3, direction: DVec3, p: DVec3| (p - from).cross(direction).length();
            let world = pose.point(hit.point);
            let found = [
                off_ray(ray.origin, ray.direction, hit.point),
                off_ray(eye, (target - eye).normalize(), world),
                world.distance(world.as_vec3().as_dvec3()),
            ];
            for (worst, found) in worst.iter_mut().zip(found) {
                *worst = worst.max(found);
            }
        }
        own.push((sizes, worst[0]));
        posed.push((sizes, worst[1]));
        narrowed.push((sizes, worst[2]));
    }
    LimitsPanel {
        title: "Part far from the origin",
        x: "distance / part's size",
        y: "hit off its ray / part's size, worst of 4000",
        powers: (-17, 1),
        curves: vec![
            LimitsCurve {
                label: "f32 in world coordinates would round",
                points: narrowed,
            },
            LimitsCurve {
                label: "in the world: what the pose rounds",
                points: posed,
            },
            LimitsCurve {
                label: "in the part's own coordinates",
                points: own,
            },
        ],
    }
}

/// Where barycentric coordinates by the normal equations put a point of a triangle.
fn by_barycentric(p: DVec3, [a, b, c]: [DVec3; 3]) -> DVec3 {
    let (e, f, d) = (b - a, c - a, p - a);
    let (ee, ef, ff) = (e.dot(e), e.dot(f), f.dot(f));
    let area = ee * ff - ef * ef;
    let u = (ff * d.dot(e) - ef * d.dot(f)) / area;
    let v = (ee * d.dot(f) - ef * d.dot(e)) / area;
    a + e * u + f * v
}

pub fn slivers() -> LimitsPanel {
    let (mut naive, mut repaired) = (Vec::new(), Vec::new());
    for power in 0..=9 {
        let width = 10f64.powi(-power);
        let mut random = Random::new(4);
        let mut mesh = Mesh {
            positions: vec![DVec3::ZERO],
            triangles: Vec::new(),
        };
        for i in 0..200u32 {
            let tip = random.direction() * 10.0;
            mesh.positions
                .extend([tip, tip + random.vector(1.0) * 10.0 * width]);
            mesh.triangles.push([0, 2 * i + 1, 2 * i + 2]);
        }
        let accel = Accel::build(&mesh.clone().into(), 1).unwrap();
        let (mut off, mut beside) = (0.0f64, 0.0f64);
        for i in 0..20_000 {
            let triangle = mesh.triangle(i % 200);
            let (u, v) = (random.between(0.0, 0.5), random.between(0.0, 0.5));
            let [a, b, c] = triangle;
            let p = a + (b - a) * u + (c - a) * v;
            off = off.max(by_barycentric(p, triangle).distance(p) / 10.0);
            beside = beside.max(accel.nearest(p, None).distance / 10.0);
        }
        naive.push((width, if off.is_finite() { off } else { 1.0 }));
        repaired.push((width, beside));
    }
    LimitsPanel {
        title: "Slivers",
        x: "width / length",
        y: "nearest point off / length, worst of 20 000",
        powers: (-17, 1),
        curves: vec![
            LimitsCurve {
                label: "barycentric coordinates, not used any more",
                points: naive,
            },
            LimitsCurve {
                label: "as repaired",
                points: repaired,
            },
        ],
    }
}

/// Two sheets one above the other: points of the upper that are taken for the lower, or
/// are in the other's shade.
pub fn shells() -> LimitsPanel {
    let share = |half: f64, gap: f64| {
        let mut mesh = shapes::plane(DVec2::splat(2.0 * half)).unwrap();
        let upper: Vec<DVec3> = mesh.positions.iter().map(|&p| p + DVec3::Z * gap).collect();
        mesh.positions.extend(upper);
        let below = mesh.triangles.clone();
        mesh.triangles
            .extend(below.iter().map(|t| t.map(|v| v + 4)));
        let turn = Rigid::from_euler_xyz(DVec3::new(0.3, 0.5, 0.2), DVec3::ZERO);
        mesh.positions.iter_mut().for_each(|p| *p = turn.point(*p));
        let accel = Accel::build(&mesh.clone().into(), 1).unwrap();
        let mut random = Random::new(5);
        let eye = turn.point(DVec3::new(0.1, -1.0, 2.0) * half);
        let lamp = turn.point(DVec3::new(0.3, 0.2, 2.5) * half);
        let target = |random: &mut Random| (random.vector(1.0) * 0.9 * half).with_z(gap);
        let rays: Vec<Ray> = (0..20_000)
            .map(|_| endless(eye, turn.point(target(&mut random))))
            .collect();
        let hits: Vec<Hit> = closest(&accel, &rays).into_iter().flatten().collect();
        let lower = |hit: &&Hit| turn.inverse().point(hit.point).z < gap / 2.0;
        let lower = hits.iter().filter(lower).count();
        let lamps: Vec<Ray> = (hits.iter())
            .filter_map(|hit| Ray::between(hit.point + hit.normal * accel.resolution(), lamp))
            .collect();
        let packets = lamps.chunks(WIDTH);
        let dark: u32 = packets.map(|rays| accel.occluded(rays).count_ones()).sum();
        [lower as f64 / 2e4, dark as f64 / 2e4]
    };
    let gaps: Vec<f64> = (0..=12)
        .map(|i| 10f64.powf(-6.0 + 0.5 * i as f64))
        .collect();
    let both = |half: f64| -> Vec<[f64; 2]> { gaps.iter().map(|&gap| share(half, gap)).collect() };
    let (small, large) = (both(100.0), both(1000.0));
    let curve = |label, of: &[[f64; 2]], k: usize| LimitsCurve {
        label,
        points: gaps.iter().zip(of).map(|(&gap, of)| (gap, of[k])).collect(),
    };
    LimitsPanel {
        title: "Two shells",
        x: "gap between them, mm",
        y: "share of 20 000 points",
        powers: (-5, 0),
        curves: vec![
            curve("on the lower for the upper, part of 0.2 m", &small, 0),
            curve("the same, part of 2 m", &large, 0),
            curve("in the other's shade, part of 2 m", &large, 1),
        ],
    }
}
