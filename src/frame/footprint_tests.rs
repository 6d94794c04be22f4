//! That the footprint is small; that it is large enough is tests/footprint.rs.

use super::*;
use crate::frame::{Grid, LensBlur, Sampling};
use crate::laser::{Beam, Fan};
use crate::mesh::{Mesh, shapes};
use crate::surface::Lambert;
use glam::UVec2;

const COLUMNS: u32 = 800;
const ROWS: u32 = 600;

/// The footprint on `mesh`, whose top is about z = 0: laser straight
/// above with its line along x, camera 30° before it, 0.05 mm a pixel.
fn seen(mesh: &Mesh, waist_radius: f64, fan: Option<Fan>) -> Pixels {
    let accel = crate::accel::Accel::build(&mesh.clone().into(), 1).unwrap();
    let mut camera = crate::camera::fixture();
    camera.sensor.resolution = UVec2::new(COLUMNS, ROWS);
    camera.sensor.pixel_pitch = 0.05 * 25.0 / 215.0;
    let laser = Laser {
        beam: Beam {
            wavelength: 660e-6,
            power_mw: 5.0,
            waist_radius,
            waist_distance: 200.0,
            m_squared: 1.0,
        },
        fan,
    };
    let looking = |from: DVec3| Rigid::from_z_and_x(from, -from, DVec3::X).unwrap();
    let view = View {
        accel: &accel,
        surface: Lambert { reflectance: 0.5 }.into(),
        laser: &laser,
        part_from_laser: looking(DVec3::Z * 200.0),
        camera: &camera,
        part_from_camera: looking(DVec3::new(0.0, -120.0, 240.0 * 0.75f64.sqrt())),
        speckle: None,
        grid: Grid::Gauss { per_side: 1 },
        sampling: Sampling::Planes,
        cutoff_radii: crate::laser::CUTOFF_RADII,
        lens: LensBlur::NONE,
        indirect: None,
        stop: None,
    };
    footprint(&view, &Region::Lit(&Clusters::new(mesh)))
}

fn count(pixels: &Pixels) -> usize {
    (0..pixels.rows).map(|row| pixels.count(row)).sum()
}

/// Pixels by which a footprint on the plane may be longer than what is lit, along an
/// axis: half of one at each end, on average; what light may lie beside the triangle it
/// belongs to is less than a thousandth of a pixel.
const MORE: f64 = 2.0;

/// Rows that see light to 4 radii on a plane across the beam: 2·4·w·cos 30° at
/// 0.05 mm a pixel, and as the width grows off the axis, under 2 %.
#[test]
fn the_footprint_of_a_plane_is_the_line() {
    let fan = Some(Fan {
        angle: 0.5,
        profile: FanProfile::Uniform,
    });
    let plane = shapes::plane(DVec2::splat(100.0)).unwrap();
    // The same plane in 20 000 triangles, 20 px wide, and in 2 million, 2 px: those
    // are taken whole, in groups.
    for (mesh, whole) in [(plane, 0.0), (grid(100), 0.0), (grid(1000), 2.0)] {
        for waist in [0.05, 0.2] {
            let rows = 8.0 * waist * 0.75f64.sqrt() / 0.05;
            let found = count(&seen(&mesh, waist, fan)) as f64 / COLUMNS as f64;
            assert!(found >= rows, "{found} of {rows}");
            assert!(
                found <= 1.02 * rows + MORE + 2.0 * whole,
                "{found} of {rows}"
            );
        }
    }
}

/// A fan of 0.1 rad lights 20.02 mm of the 40 mm in view, a point 8 by 6.9 pixels.
#[test]
fn a_narrow_fan_and_a_point_are_narrow_on_the_sensor() {
    let plane = shapes::plane(DVec2::splat(100.0)).unwrap();
    let fan = Fan {
        angle: 0.1,
        profile: FanProfile::Uniform,
    };
    let narrow = seen(&plane, 0.05, Some(fan));
    let rows = 0..ROWS as usize;
    let mut columns: Vec<usize> = rows.flat_map(|row| narrow.of(row)).collect();
    columns.sort_unstable();
    columns.dedup();
    let lit = 2.0 * 200.0 * 0.05f64.tan() / 0.05;
    let found = columns.len() as f64;
    assert!((lit..=lit + MORE).contains(&found), "{found} of {lit}");
    let point = count(&seen(&plane, 0.05, None)) as f64;
    let lit = DVec2::new(8.0, 8.0 * 0.75f64.sqrt());
    let most = lit * 1.02 + MORE;
    assert!(
        (lit.x * lit.y..=most.x * most.y).contains(&point),
        "{point}"
    );
}

/// 100 mm square at z = 0 in n × n squares.
fn grid(n: u32) -> Mesh {
    let at = |i: u32| (i as f64 / n as f64 - 0.5) * 100.0;
    let side = n + 1;
    Mesh {
        positions: (0..side * side)
            .map(|i| DVec3::new(at(i % side), at(i / side), 0.0))
            .collect(),
        triangles: (0..n * n)
            .flat_map(|i| {
                let a = i / n * side + i % n;
                [[a, a + 1, a + side], [a + 1, a + side + 1, a + side]]
            })
            .collect(),
    }
}
