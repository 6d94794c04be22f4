//! Tests that the footprint is small. A test that it is large enough is in tests/frames/footprint.rs.

use super::*;
use crate::frame::{DefocusSettings, PixelQuadrature, Sampling};
use crate::laser::{Beam, Fan, FanProfile};
use crate::mesh::{Mesh, shapes};
use crate::surface::Lambert;
use glam::UVec2;

const COLUMNS: u32 = 800;
const ROWS: u32 = 600;

/// Returns the footprint on `mesh`, whose top is near z = 0. The laser is above it with its line
/// along x. The camera is at 30° to the laser, with 0.05 mm per pixel.
fn seen(mesh: &Mesh, waist_radius: f64, fan: Option<Fan>) -> PixelMask {
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
    let view = PoseView {
        accel: &accel,
        surface: Lambert { reflectance: 0.5 }.into(),
        laser: &laser,
        part_from_laser: looking(DVec3::Z * 200.0),
        camera: &camera,
        part_from_camera: looking(DVec3::new(0.0, -120.0, 240.0 * 0.75f64.sqrt())),
        speckle: None,
        grid: PixelQuadrature::Gauss { per_side: 1 },
        sampling: Sampling::Planes,
        beam_cutoff_radii: crate::laser::CUTOFF_RADII,
        lens: DefocusSettings::NONE,
        indirect: None,
        stop: None,
    };
    footprint(&view, &TracedRegion::Lit(&TriangleClusters::new(mesh)))
}

fn count(pixels: &PixelMask) -> usize {
    (0..pixels.rows).map(|row| pixels.count(row)).sum()
}

/// Number of pixels by which a footprint on the plane may exceed the lit area along an axis. On
/// average, it exceeds the area by half a pixel at each end. Light outside the triangle it belongs
/// to contributes less than a thousandth of a pixel.
const MORE: f64 = 2.0;

/// The footprint has the rows that receive light up to 4 radii on a plane perpendicular to the
/// beam: 2·4·w·cos 30° at 0.05 mm per pixel. The growth of the width off the axis adds less than 2
/// %.
#[test]
fn the_footprint_of_a_plane_is_the_line() {
    let fan = Some(Fan {
        angle: 0.5,
        profile: FanProfile::Uniform,
    });
    let plane = shapes::plane(DVec2::splat(100.0)).unwrap();
    // The plane is also divided into 20 000 triangles, 20 px wide, and into 2 million, 2 px wide.
    // The latter are marked in groups without clipping.
    for (mesh, whole) in [(plane, 0.0), (grid(100), 0.0), (grid(1000), 2.0)] {
        for waist in [0.05, 0.2] {
            let rows = 8.0 * waist * 0.75f64.sqrt() / 0.05;
            let found = count(&seen(&mesh, waist, fan.clone())) as f64 / COLUMNS as f64;
            assert!(found >= rows, "{found} of {rows}");
            assert!(
                found <= 1.02 * rows + MORE + 2.0 * whole,
                "{found} of {rows}"
            );
        }
    }
}

/// A fan of 0.1 rad lights 20.02 mm of the 40 mm in view, and a point laser lights 8 by 6.9 pixels.
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

/// Returns a square of 100 mm at z = 0, divided into n × n squares.
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
