//! Whether points far off say so: over the scenes, those whose error is more than three
//! times their expanded uncertainty (2σ, 95 %) carry a flag. Three times the standard
//! one would be passed by 27 of 10 000 points of which nothing is wrong.

mod scenes;

use self::scenes::{LOOKED_AT, drawn};
use lasertrace::inspect::cloud::CloudPoint;
use lasertrace::profile::Flags;
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
use rayon::prelude::*;
use std::path::Path;

/// Points of a scene of the repository.
fn points(name: &str) -> Vec<CloudPoint> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes");
    measured(&Scene::load(&root.join(name).join("scene.toml")).unwrap())
}

/// Points of 40 frames or so of a scene.
fn measured(scene: &Scene) -> Vec<CloudPoint> {
    let simulation = Simulation::new(scene).unwrap();
    let step = (scene.scan.frames / 40).max(1) as usize;
    let frames = || (0..scene.scan.frames).step_by(step);
    let taken = frames().collect::<Vec<u32>>().into_par_iter();
    let measured = taken.flat_map_iter(|frame| {
        let light = simulation.irradiance(frame);
        simulation
            .measure(frame, &simulation.counts(frame, &light))
            .1
    });
    let mut points: Vec<CloudPoint> = measured.collect();
    simulation.apply_cross_frame_flags(frames(), &mut points);
    points
}

/// Errors in expanded uncertainties.
fn excess(point: &CloudPoint) -> f64 {
    point.deviation.abs() / (2.0 * point.u_deviation)
}

#[derive(Default)]
struct Tally {
    points: usize,
    /// Off by more than three times the expanded uncertainty, and without a flag.
    off: usize,
    silent: usize,
    /// Within the expanded uncertainty, and flagged all the same.
    good: usize,
    suspected: usize,
    /// Without a flag, and of these within their 95 % interval.
    valid: usize,
    held: usize,
}

impl Tally {
    fn add(&mut self, points: &[CloudPoint]) {
        self.points += points.len();
        for point in points {
            let flagged = !point.flags.is_empty();
            self.valid += usize::from(!flagged);
            self.held += usize::from(!flagged && 2.0 * excess(point) <= 1.96);
            if excess(point) > 3.0 {
                self.off += 1;
                self.silent += usize::from(!flagged);
            } else if excess(point) <= 1.0 {
                self.good += 1;
                self.suspected += usize::from(flagged);
            }
        }
    }

    fn print(&self, name: &str) {
        println!(
            "| {name} | {} | {} | {} | {} | {} ({:.1} %) | {:.1} % |",
            self.points,
            self.off,
            self.silent,
            self.good,
            self.suspected,
            100.0 * self.suspected as f64 / self.good.max(1) as f64,
            100.0 * self.coverage()
        );
    }

    /// Share of the 95 % intervals of points without a flag that hold the truth.
    fn coverage(&self) -> f64 {
        self.held as f64 / self.valid as f64
    }
}

/// Scenes of the repository in which the sensor, or the part, cuts every line by construction.
const CUT: [&str; 2] = ["limits/border", "limits/edge"];

fn tally(points: &[CloudPoint], name: &str) -> Tally {
    let mut tally = Tally::default();
    tally.add(points);
    tally.print(name);
    tally
}

/// Prints the tables of docs/silent-outliers.md:
/// `cargo test --test points silent_outliers::report -- --ignored --nocapture`.
#[test]
#[ignore = "a report of some minutes, without a bound"]
fn report() {
    println!("| scene | points | far off | without a flag | good | with a flag | intervals hold |");
    let (mut all, mut rest) = (Tally::default(), Tally::default());
    for name in [
        "bracket",
        "accuracy",
        "plane",
        "step",
        "rotary",
        "limits/far",
        "limits/grazing",
        CUT[0],
        CUT[1],
    ] {
        let points = points(name);
        tally(&points, name);
        all.add(&points);
        if !CUT.contains(&name) {
            rest.add(&points);
        }
    }
    rest.print("all without the last two");
    all.print("all");
    let mut all = Tally::default();
    for other in &LOOKED_AT {
        let mut scene = other.scene();
        let mut points = Vec::new();
        for seed in 1..=4 {
            scene.seed = seed;
            points.append(&mut measured(&scene));
        }
        tally(&points, &other.name);
        all.add(&points);
    }
    all.print("all");
    // The second dozen was drawn when the rules stood.
    for seeds in [1..=24, 101..=112] {
        let mut all = Tally::default();
        for seed in seeds {
            let (name, scene) = drawn(seed);
            let points = measured(&scene);
            tally(&points, &name);
            all.add(&points);
        }
        all.print("all");
    }
}

/// Nothing good is flagged where nothing cuts the line, and everything where the sensor or the part
/// cuts every line.
#[test]
fn whole_lines_carry_no_flag_and_cut_ones_do() {
    for name in ["plane", "rotary"] {
        let points = points(name);
        let tally = tally(&points, name);
        assert_eq!((tally.off, tally.suspected), (0, 0), "{name}");
    }
    // Where the lens spreads the light of either side of the step to the other a column has two lines.
    for name in ["step", "limits/far"] {
        let points = points(name);
        assert_eq!(tally(&points, name).off, 0, "{name}");
        let mut flagged = points.iter().filter(|p| !p.flags.is_empty());
        let beside =
            |p: &CloudPoint| p.flags.contains(Flags::MULTIPLE_PEAKS) && p.position.x.abs() < 0.2;
        assert!(flagged.all(beside), "{name}");
    }
    for name in CUT {
        assert!(points(name).iter().all(|p| !p.flags.is_empty()), "{name}");
    }
}

/// Balls at any place, whose first and last frames graze the horizon; none of the rules was made
/// by them. A point off by more than six standard uncertainties is, by a Gaussian, one in 5·10⁸: of
/// some 48 000 none is to be without a flag, but for one run in 10 000. 95 % intervals hold what
/// errors 5 % larger or smaller than stated make of them, 93.8 and 96.1 %, and three standard errors
/// of 0.3 %, as grains make some 5000 of a scene's points independent.
#[test]
fn no_point_is_far_off_without_a_flag_where_the_sheet_grazes_a_ball() {
    for seed in [102, 105, 108, 111] {
        let (name, scene) = drawn(seed);
        let tally = tally(&measured(&scene), &name);
        assert_eq!(tally.silent, 0, "{name}");
        assert!((0.929..=0.970).contains(&tally.coverage()), "{name}");
    }
}
