//! What a whole frame takes, from light to points, over what a bare loop of Embree takes
//! for the rays that version 0.1.0 traced for that frame, whatever is traced now: the
//! measure of what the program adds to Embree. One thread, speckle and noise on, a sharp image as
//! version 0.1.0 had it; what the lens's blur adds is the bench `lens`'s.
//!
//! Medians of interleaved pairs with an interval that holds the median in 95 of 100 runs
//! if pairs are independent; the geometric mean of the scenes; of each the share by stage.
//! `LASERTRACE_PAIRS=11` takes fewer pairs than 51. Rows with `-cut` use the light from the cut.

mod four;
mod pairs;
mod waves;

use four::Timed;
use lasertrace::accel::embree_race::{BareEmbree, FlatHit, FlatRay};
use lasertrace::accel::{Ray, WIDTH};
use lasertrace::frame::{Blur, Sampling};
use lasertrace::math::quadrature::gauss_legendre;
use lasertrace::math::{DVec2, DVec3, Rigid};
use lasertrace::mesh::Mesh;
use lasertrace::run::Simulation;
use pairs::seconds;

/// Rays of a frame, packet by packet as version 0.1.0 traced them.
struct Rays {
    camera: Vec<Vec<FlatRay>>,
    shadow: Vec<Vec<FlatRay>>,
}

/// What version 0.1.0 asked of Embree for a scene's frame: for each packet the pixel at its
/// upper left, then of each ray the place and whether a shadow ray followed.
fn recorded(name: &str) -> &'static [u8] {
    match name {
        "waves" => include_bytes!("rays/waves.bin"),
        "bracket" => include_bytes!("rays/bracket.bin"),
        "balls" => include_bytes!("rays/balls.bin"),
        "machined" => include_bytes!("rays/machined.bin"),
        _ => panic!("no rays were recorded for {name}"),
    }
}

/// Places on the sensor of each packet's rays, and whether a shadow ray followed.
fn packets(bytes: &[u8]) -> Vec<Vec<(DVec2, bool)>> {
    let side = bytes[0] as usize;
    let nodes = gauss_legendre(side);
    let word = |at: usize| u16::from_le_bytes([bytes[at], bytes[at + 1]]) as usize;
    let mut packets = Vec::new();
    let mut at = 1;
    while at < bytes.len() {
        let corner = DVec2::new(word(at) as f64, word(at + 2) as f64);
        let count = bytes[at + 4] as usize;
        let ray = |i: usize| {
            let bits = word(at + 5 + 2 * i);
            let pixel = corner + DVec2::new((bits & 3) as f64, (bits >> 2 & 3) as f64);
            let off = match bits >> 5 {
                0 => DVec2::splat(0.5),
                node => DVec2::new(nodes[(node - 1) % side].0, nodes[(node - 1) / side].0),
            };
            (pixel + off, bits >> 4 & 1 == 1)
        };
        packets.push((0..count).map(ray).collect());
        at += 5 + 2 * count;
    }
    packets
}

fn flat(ray: &Ray) -> FlatRay {
    FlatRay {
        origin: ray.origin.as_vec3().to_array(),
        direction: ray.direction.as_vec3().to_array(),
        t_max: ray.t_max as f32,
    }
}

/// The recorded rays, the shadow rays from where the camera's meet the part.
fn rays(simulation: &Simulation, timed: &Timed) -> Rays {
    let view = simulation.view(timed.frame);
    let laser_from_part = view.part_from_laser.inverse();
    let eye = view.part_from_camera.translation;
    let (mut camera, mut shadow) = (Vec::new(), Vec::new());
    for packet in packets(recorded(timed.name)) {
        let ray = |&(place, _): &(DVec2, bool)| Ray {
            origin: eye,
            direction: (view.part_from_camera).vector(view.camera.direction(place).normalize()),
            t_max: f64::INFINITY,
        };
        let from_camera: Vec<Ray> = packet.iter().map(ray).collect();
        let hits = view.accel.closest(&from_camera, |_, _| true);
        let followed = packet.iter().zip(hits).filter_map(|((_, followed), hit)| {
            let hit = hit.filter(|_| *followed)?;
            let section = view.laser.section(laser_from_part.point(hit.point))?;
            let aperture = view.part_from_laser.point(section.aperture_point);
            let start = hit.point + hit.normal * view.accel.resolution();
            Ray::between(start, aperture)
        });
        let followed: Vec<FlatRay> = followed.map(|ray| flat(&ray)).collect();
        camera.push(from_camera.iter().map(flat).collect());
        if !followed.is_empty() {
            shadow.push(followed);
        }
    }
    Rays { camera, shadow }
}

/// All copies of a mesh as one.
fn one_mesh(mesh: &Mesh, copies: &[Rigid]) -> Mesh {
    let place = |pose: &Rigid| {
        let pose = *pose;
        mesh.positions.iter().map(move |&p: &DVec3| pose.point(p))
    };
    let vertices = mesh.positions.len() as u32;
    let triangles = (0..copies.len() as u32).flat_map(|copy| {
        let triangles = mesh.triangles.iter();
        triangles.map(move |t| t.map(|v| v + copy * vertices))
    });
    Mesh {
        positions: copies.iter().flat_map(place).collect(),
        triangles: triangles.collect(),
    }
}

/// Traces all; how many of the camera's rays meet the part.
fn trace(embree: &BareEmbree, rays: &Rays) -> usize {
    let mut met = 0;
    let mut hits = [FlatHit::NONE; WIDTH];
    for packet in &rays.camera {
        let hits = &mut hits[..packet.len()];
        embree.closest16(packet, true, hits);
        met += hits.iter().filter(|hit| **hit != FlatHit::NONE).count();
    }
    let mut blocked = [false; WIDTH];
    for packet in &rays.shadow {
        embree.occluded16(packet, true, &mut blocked[..packet.len()]);
    }
    std::hint::black_box(blocked);
    met
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn main() {
    let one = rayon::ThreadPoolBuilder::new().num_threads(1);
    one.build_global().unwrap();
    let pairs = std::env::var("LASERTRACE_PAIRS").map_or(51, |n| n.parse().expect("a number"));
    println!(
        "| scene | frame / bare Embree | 95 % interval | light, counts, points: share | rays |"
    );
    println!("|---|---|---|---|---|");
    let mut scenes = four::four();
    let (mut products, count) = ([1.0; 2], scenes.len());
    for timed in &mut scenes {
        timed.scene.methods.defocus_model = Some(Blur::None);
        let whole = one_mesh(&timed.scene.mesh, &timed.scene.copies);
        let embree = BareEmbree::build(&whole.into(), true, 1).unwrap();
        // Without a choice, and with the light from the cut.
        for (sampling, product) in [None, Some(Sampling::PlaneCut)]
            .into_iter()
            .zip(&mut products)
        {
            timed.scene.methods.pixel_sampling = sampling;
            *product *= ratio(timed, sampling, &embree, pairs);
        }
    }
    let [mean, of_cut] = products.map(|product| product.powf(1.0 / count as f64));
    println!("\nframe over Embree: {mean:.3} (geometric mean of {count} scenes)");
    println!(
        "frame over Embree, light from the cut: {of_cut:.3} (geometric mean of {count} scenes)"
    );
}

/// Prints the row of a scene and returns the median of the time of its frame over the time of Embree.
fn ratio(timed: &Timed, sampling: Option<Sampling>, embree: &BareEmbree, pairs: usize) -> f64 {
    let simulation = Simulation::new(&timed.scene).unwrap();
    let rays = rays(&simulation, timed);
    let count = |packets: &[Vec<FlatRay>]| packets.iter().map(Vec::len).sum::<usize>();
    let (camera, shadow) = (count(&rays.camera), count(&rays.shadow));
    assert!(trace(embree, &rays) > camera / 2);
    let mut stages = [const { Vec::new() }; 3];
    let mut ratios: Vec<f64> = Vec::new();
    for i in 0..=pairs {
        let bare = seconds(|| trace(embree, &rays));
        let (mut light, mut counts) = (None, None);
        let times = [
            seconds(|| light = Some(simulation.irradiance(timed.frame))),
            seconds(|| {
                counts = light
                    .as_ref()
                    .map(|l| simulation.counts_near_light(timed.frame, l))
            }),
            seconds(|| {
                let counts = counts.as_ref().expect("it was drawn");
                let (_, points) = simulation.measure_near_light(timed.frame, counts);
                assert!(points.len() > 100, "{} points", points.len());
            }),
        ];
        // The first is to warm up.
        if i > 0 {
            let whole: f64 = times.iter().sum();
            ratios.push(whole / bare);
            for (stage, time) in stages.iter_mut().zip(times) {
                stage.push(time / whole);
            }
        }
    }
    let middle = median(&mut ratios);
    // Order statistics: binomial with p = ½, ±1.96 standard deviations.
    let half = 0.98 * (pairs as f64).sqrt();
    let rank = |sign: f64| (pairs as f64 / 2.0 + sign * half).round() as usize;
    let interval = [rank(-1.0), rank(1.0)].map(|r| ratios[r.min(pairs - 1)]);
    let [a, b, c] = stages.each_mut().map(|s| median(s));
    let method = sampling.map_or("", |_| "-cut");
    println!(
        "| {}{method} | {middle:.2} | {:.2} to {:.2} | {a:.2}, {b:.2}, {c:.2} | {camera} + {shadow} |",
        timed.name, interval[0], interval[1]
    );
    middle
}
