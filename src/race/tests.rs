//! Race of one round on a small sphere. The tests check that all racers have equal input and are
//! judged correctly; rates are not tested.

use super::*;
use crate::accel::embree_race::FlatRay;
use crate::mesh::shapes;
use crate::report::race_plot::plot;
use std::sync::Arc;

/// Global allocator of the program.
#[global_allocator]
static ALLOCATOR: PeakAlloc = PeakAlloc;

const EFFORT: BenchmarkBudget = BenchmarkBudget {
    rays: 4000,
    rounds: 1,
    seconds: 1e3,
};

/// All racers agree with brute force, and the BVH in Rust has no misses. The probability of an f32
/// error at an edge is below 1e-4 per ray, so 9 errors in 16 000 rays indicate a defect.
#[test]
fn all_racers_find_the_same_hits() {
    let mesh = shapes::sphere(5.0, 0.01).unwrap();
    let race = race(&mesh, EFFORT, &|_| (), &|| Ok(())).unwrap();
    assert_eq!(race.racers.len(), racers::RACERS);
    assert!(race.aimed_at_edges > 1000 && race.aimed_at_vertices > 1000);
    for racer in &race.racers {
        for laps in &racer.laps {
            assert!(laps.wrong < 9, "{}: {laps:?}", racer.name);
            let [one, all] = [laps.one_thread, laps.all_threads].map(Option::unwrap);
            assert!(one.median > 0.0 && all.median.is_finite());
        }
    }
    let rust = race.racers.iter().find(|r| r.name.contains("Rust"));
    let rust = rust.unwrap();
    assert_eq!((rust.edges.missed, rust.vertices.missed), (0, 0));
    let held = rust.bytes_per_triangle.unwrap();
    // Other tests of this process free memory meanwhile, so only the maximum has a lower bound.
    assert!(held[1] > 4.0 && held[1] >= held[0], "{held:?}");
    let (svg, text) = (plot(&race, "a & b"), table(&race));
    assert!(svg.contains("a &amp; b") && !svg.contains("NaN"), "{svg}");
    assert_eq!(text.matches("obvhs BVH2").count(), 3, "{text}");
}

/// A racer that never hits anything is detected.
#[test]
fn misses_and_wrong_answers_are_counted() {
    struct Blind;
    impl BenchBackend for Blind {
        fn closest(&self, _: &[FlatRay], _: bool, _: &mut [FlatHit]) {}
        fn occluded(&self, _: &[FlatRay], _: bool, _: &mut [bool]) {}
    }
    let mesh = centred(&shapes::sphere(5.0, 0.1).unwrap());
    let aimed = aimed::rays(&mesh, 500);
    let later = Instant::now() + Duration::from_secs(1000);
    let asked = aimed.edges.missed_by(&Blind, 1e-3, later);
    let all = aimed.edges.rays.len();
    assert_eq!((asked.rays, asked.missed), (all, all));
    let accel = Accel::build(&mesh.clone().into(), 1).unwrap();
    let [camera, ..] = rays::sets(&accel, 900);
    let truth = truth(&mesh, &camera, 900);
    let hits = truth.iter().filter(|(_, t)| t.is_some()).count();
    // The view is a square as wide as the diagonal of the bounding box, 2·√3·r, at a distance of
    // twice the diagonal. The disc covers π/12·48/47 of it, which is 241 of 900 rays. The tolerance
    // is half of the rays at the rim.
    assert!((213..=269).contains(&hits), "{hits}");
    assert_eq!(wrong(&Blind, &camera, &truth, 1e-3), hits);
}

/// A rectangle has no closed fan at its vertices. Its only target is the edge between its two
/// triangles.
#[test]
fn nothing_open_is_aimed_at() {
    let mesh = shapes::plane(glam::DVec2::new(3.0, 2.0)).unwrap();
    let aimed = aimed::rays(&mesh, 300);
    assert_eq!(aimed.vertices.rays.len(), 0);
    assert!(!aimed.edges.rays.is_empty() && aimed.edges.rays.len() < 200);
}

/// If there is no time, no racer has results; table and plot report this for every racer. With very
/// little time, every racer is built once and only some rays are traced.
#[test]
fn who_runs_out_of_time_is_reported() {
    let mesh = shapes::sphere(5.0, 0.01).unwrap();
    let mut runs = racers::entrants().map(|entrant| RacerRun::new(entrant, 60.0));
    let effort = BenchmarkBudget {
        rays: 20_000,
        rounds: 2,
        seconds: 50.0,
    };
    let centred = Arc::new(centred(&mesh));
    let course = BenchmarkSetup::new(&centred, effort).unwrap();
    for run in &mut runs {
        run.round(&course).unwrap();
    }
    let mut race = race(&mesh, EFFORT, &|_| (), &|| Ok(())).unwrap();
    race.racers = runs.into_iter().map(|run| run.finish(&course)).collect();
    let (svg, text) = (plot(&race, "a"), table(&race));
    assert_eq!(
        text.matches("not built, which would take about 60 s")
            .count(),
        racers::RACERS
    );
    assert_eq!(svg.matches("not built").count(), racers::RACERS);
    assert!(svg.matches("out of time").count() > racers::RACERS && !svg.contains("NaN"));
    assert_eq!(longest(&[60.0; 3], effort), 50.0);
    assert_eq!(longest(&[10.0, 60.0], effort), 95.0);

    let hurried = BenchmarkBudget {
        seconds: 1e-9,
        ..effort
    };
    let race = super::race(&mesh, hurried, &|_| (), &|| Ok(())).unwrap();
    for racer in &race.racers {
        assert_eq!(racer.rounds, 1, "{}", racer.name);
        assert!(racer.out_of_time.is_some(), "{}", racer.name);
    }
    let steps = std::cell::Cell::new(0);
    let count = || {
        steps.set(steps.get() + 1);
        Ok(())
    };
    super::race(&mesh, EFFORT, &|_| (), &count).unwrap();
    assert!(steps.get() <= EFFORT.steps());
    let stopped = super::race(&mesh, EFFORT, &|_| (), &|| {
        Err(crate::error::Error::Interrupted)
    });
    assert!(matches!(stopped, Err(crate::error::Error::Interrupted)));
}
