//! A race of one round on a small sphere: not how fast, but that all run the same
//! course and are judged rightly.

use super::*;
use crate::mesh::shapes;

const EFFORT: Effort = Effort {
    rays: 4000,
    rounds: 1,
};

/// All answer as brute force does (f32 is wrong at an edge with chance below 1e-4 a
/// ray: 9 of 16 000 would be a defect), and the tree in Rust misses nothing.
#[test]
fn all_racers_find_the_same_hits() {
    let mesh = shapes::sphere(5.0, 0.01).unwrap();
    let race = race(&mesh, EFFORT, &|| Ok(())).unwrap();
    assert_eq!(race.racers.len(), RACERS);
    assert!(race.aimed_at_edges > 1000 && race.aimed_at_vertices > 1000);
    for racer in &race.racers {
        for laps in &racer.laps {
            assert!(laps.wrong < 9, "{}: {laps:?}", racer.name);
            assert!(laps.one_thread.median > 0.0 && laps.all_threads.median.is_finite());
        }
    }
    let rust = race.racers.iter().find(|r| r.name.contains("Rust"));
    let rust = rust.unwrap();
    assert_eq!((rust.missed_edges, rust.missed_vertices), (0, 0));
    let held = rust.bytes_per_triangle.unwrap();
    assert!(held[0] > 4.0 && held[1] >= held[0], "{held:?}");
    let (svg, text) = (plot(&race, "a & b"), table(&race));
    assert!(svg.contains("a &amp; b") && !svg.contains("NaN"), "{svg}");
    assert_eq!(text.matches("obvhs BVH2").count(), 3, "{text}");
}

/// Someone who never hits anything is found out.
#[test]
fn misses_and_wrong_answers_are_counted() {
    struct Blind;
    impl Racer for Blind {
        fn closest(&self, _: &[FlatRay], _: bool, _: &mut [FlatHit]) {}
        fn occluded(&self, _: &[FlatRay], _: bool, _: &mut [bool]) {}
    }
    let mesh = centred(&shapes::sphere(5.0, 0.1).unwrap());
    let aimed = aimed::rays(&mesh, 500);
    assert_eq!(aimed.edges.missed_by(&Blind, 1e-3), aimed.edges.rays.len());
    let accel = Accel::build(&mesh, 1).unwrap();
    let [camera, ..] = rays::sets(&accel, 900);
    let truth = truth(&mesh, &camera, 900);
    let hits = truth.iter().filter(|(_, t)| t.is_some()).count();
    // A disc in a square: π/4.
    assert!((600..=800).contains(&hits), "{hits}");
    assert_eq!(wrong(&Blind, &camera, &truth, 1e-3), hits);
}

/// An open sheet has no closed fan at its corners, and its edge of two triangles
/// is the only one aimed at.
#[test]
fn nothing_open_is_aimed_at() {
    let mesh = shapes::plane(glam::DVec2::new(3.0, 2.0)).unwrap();
    let aimed = aimed::rays(&mesh, 300);
    assert_eq!(aimed.vertices.rays.len(), 0);
    assert!(!aimed.edges.rays.is_empty() && aimed.edges.rays.len() < 200);
}
