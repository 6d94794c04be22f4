//! Tests of flags from neighbouring frames, on synthetic clouds.

use super::*;
use crate::laser::{Beam, Fan, FanProfile};
use crate::math::Rigid;
use crate::math::rng::{Purpose, RngKey};

const COLUMNS: u32 = 40;
/// Beam radius (1/e²), mm. Frames are outside the beam from 0.2 mm on.
const RADIUS: f64 = 0.1;
const SIGMA: f64 = 0.001;

pub fn laser() -> Laser {
    Laser {
        beam: Beam {
            wavelength: 660e-6,
            power_mw: 1.0,
            waist_radius: RADIUS,
            waist_distance: 100.0,
            m_squared: 1.0,
        },
        fan: Some(Fan {
            angle: 0.5,
            profile: FanProfile::Uniform,
        }),
    }
}

pub fn pose(frame: u32, step: f64) -> SensorPose {
    let moved = Rigid::translation(DVec3::new(0.0, step * frame as f64, 0.0));
    SensorPose {
        part_from_laser: moved,
        part_from_camera: moved,
    }
}

/// Returns the points of `frames` frames on a slope, `step` mm apart.
pub fn slope(frames: u32, step: f64) -> Vec<CloudPoint> {
    let point = |frame: u32, column: u32| {
        let y = step * frame as f64;
        CloudPoint {
            position: DVec3::new(0.05 * column as f64, y, 100.0 + 0.5 * y),
            deviation: 0.0,
            u_position: SIGMA,
            u_deviation: SIGMA,
            repeatability: SIGMA,
            correlation_length: 0.05,
            scan_correlation_length: 0.05,
            intensity: 1000.0,
            frame,
            column,
            row: 0.0,
            line_sigma_px: 1.0,
            flags: Flags::empty(),
            normal: glam::Vec3::Z,
            direct_fraction: 1.0,
        }
    };
    let frames = (0..frames).flat_map(|f| (0..COLUMNS).map(move |c| (f, c)));
    frames.map(|(f, c)| point(f, c)).collect()
}

fn compare(points: &mut [CloudPoint], frames: impl Iterator<Item = u32>, step: f64) {
    let scanned: Vec<_> = frames.map(|f| (f, pose(f, step))).collect();
    apply_cross_frame_flags(points, &scanned, &laser());
}

/// Returns the flags in column 20 of a frame, for three frames at a distance of 1 mm and a changed
/// cloud.
fn flags_of(frame: u32, change: impl Fn(&mut Vec<CloudPoint>)) -> Flags {
    let mut points = slope(3, 1.0);
    change(&mut points);
    compare(&mut points, 0..3, 1.0);
    let at = |p: &&CloudPoint| (p.frame, p.column) == (frame, 20);
    points.iter().find(at).unwrap().flags
}

fn of(points: &mut [CloudPoint], frame: u32, column: u32) -> &mut CloudPoint {
    let at = |p: &&mut CloudPoint| (p.frame, p.column) == (frame, column);
    points.iter_mut().find(at).unwrap()
}

#[test]
fn an_edge_is_taken_back_where_the_surface_goes_on() {
    let flagged =
        |points: &mut Vec<CloudPoint>, frame| of(points, frame, 20).flags = Flags::DISCONTINUITY;
    assert!(flags_of(1, |p| flagged(p, 1)).is_empty());
    // Distances from the chord just below and just above the limit. The component of a z shift
    // perpendicular to the slope is cos(atan ½).
    let shift = MAX_CHORD_DEVIATION_SIGMAS * SIGMA * 1.25f64.sqrt();
    for (share, left) in [(0.99, Flags::empty()), (1.01, Flags::DISCONTINUITY)] {
        let found = flags_of(1, |p| {
            flagged(p, 1);
            of(p, 1, 20).position.z += share * shift;
        });
        assert_eq!(found, left, "{share}");
    }
    // Missing frame before or after, missing adjacent column, or another flag.
    assert_eq!(flags_of(0, |p| flagged(p, 0)), Flags::DISCONTINUITY);
    assert_eq!(flags_of(2, |p| flagged(p, 2)), Flags::DISCONTINUITY);
    let hole = |p: &mut Vec<CloudPoint>, frame, column| {
        flagged(p, 1);
        p.retain(|p| (p.frame, p.column) != (frame, column));
    };
    for (frame, column) in [(1, 19), (1, 21), (0, 20), (2, 20)] {
        assert_eq!(
            flags_of(1, |p| hole(p, frame, column)),
            Flags::DISCONTINUITY
        );
    }
    for other in [
        Flags::MULTIPLE_PEAKS,
        Flags::WIDE,
        Flags::LOW_SIGNAL,
        Flags::IMAGE_BORDER,
    ] {
        let found = flags_of(1, |p| of(p, 1, 20).flags = Flags::DISCONTINUITY | other);
        assert_eq!(found, Flags::DISCONTINUITY | other);
    }
}

#[test]
fn an_edge_is_set_where_the_surface_ends_in_half_the_light() {
    let dim = |share: f64, lit: [u32; 2]| {
        flags_of(1, |points| {
            points.retain(|p| p.frame == 1 || lit.contains(&p.frame));
            let middle = points.iter_mut().filter(|p| p.frame == 1);
            middle.for_each(|p| p.intensity *= share);
        })
    };
    for lit in [[0, 0], [2, 2]] {
        assert_eq!(dim(0.49, lit), Flags::DISCONTINUITY);
        assert!(dim(0.51, lit).is_empty());
    }
    // The surface continues on both sides, or only one frame is lit.
    assert!(dim(0.49, [0, 2]).is_empty());
    assert!(dim(0.49, [1, 1]).is_empty());
}

/// Frames 0.06 mm apart. The three frames within the beam do not influence the flags.
#[test]
fn frames_within_the_beam_say_nothing() {
    let flags = |missing: &[u32]| {
        let mut points = slope(20, 0.06);
        of(&mut points, 10, 20).flags = Flags::DISCONTINUITY;
        points.retain(|p| !missing.contains(&p.frame));
        compare(&mut points, 0..20, 0.06);
        of(&mut points, 10, 20).flags
    };
    assert!(flags(&[7, 8, 9, 11, 12, 13]).is_empty());
    // The first frame outside the beam has no line.
    assert_eq!(flags(&[6]), Flags::DISCONTINUITY);
}

/// For random clouds with holes, dim regions and flags, pieces with the frames of [`frames_beside`]
/// have the flags of the complete cloud.
#[test]
fn pieces_have_the_flags_of_the_whole() {
    let frames = 24;
    for seed in 0..30 {
        let key = RngKey::new(seed, Purpose::SensorNoise);
        let step = 0.02 + 0.3 * key.uniform(0);
        let mut points = slope(frames, step);
        points.retain_mut(|p| {
            let key = key.with(p.frame as u64).with(p.column as u64 + 1);
            // Regions of four frames and eight columns.
            let stretch = RngKey::new(seed, Purpose::SensorNoise)
                .with(1000 + p.frame as u64 / 4)
                .with(p.column as u64 / 8);
            if key.uniform(0) < 0.3 {
                p.flags = Flags::DISCONTINUITY;
            }
            p.position.z += 4.0 * SIGMA * key.uniform(1);
            p.intensity *= if stretch.uniform(0) < 0.3 { 0.3 } else { 1.0 };
            stretch.uniform(1) > 0.2 && key.uniform(2) > 0.02
        });
        let mut whole = points.clone();
        compare(&mut whole, 0..frames, step);
        assert_ne!(whole, points);
        let cut = 1 + (key.uniform(1) * (frames - 1) as f64) as u32;
        for piece in [0..cut, cut..frames] {
            let own = |p: &&CloudPoint| piece.contains(&p.frame);
            let of_piece: Vec<CloudPoint> = points.iter().filter(own).copied().collect();
            let beside = frames_beside(&piece, frames, &of_piece, |f| pose(f, step), &laser());
            let seen = |f: &u32| piece.contains(f) || beside.contains(f);
            let mut found: Vec<CloudPoint> = points.clone();
            found.retain(|p| seen(&p.frame));
            compare(&mut found, (0..frames).filter(seen), step);
            found.retain(|p| piece.contains(&p.frame));
            let expected: Vec<CloudPoint> = whole.iter().filter(own).copied().collect();
            assert!(found == expected, "{seed} {piece:?}");
        }
    }
}
