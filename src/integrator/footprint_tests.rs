//! That the footprint is small; that it is large enough is tests/footprint.rs.

use super::*;
use crate::camera::{Camera, Lens, Sensor};
use crate::integrator::Sampling;
use crate::laser::{Beam, Fan};
use crate::mesh::{Mesh, shapes};
use crate::surface::Lambert;
use glam::UVec2;

const COLUMNS: u32 = 800;
const ROWS: u32 = 600;

/// Blocks of the footprint on `mesh`, whose top is about z = 0: laser straight
/// above with its line along x, camera 30° before it, 0.05 mm a pixel.
fn count(mesh: &Mesh, waist_radius: f64, fan: Option<Fan>) -> usize {
    let accel = crate::accel::Accel::build(mesh, 1).unwrap();
    let camera = Camera {
        lens: Lens {
            focal_length: 25.0,
            f_number: 8.0,
            focus_distance: 240.0,
            aperture: crate::camera::Aperture::Circle,
            distortion: None,
        },
        sensor: Sensor {
            resolution: UVec2::new(COLUMNS, ROWS),
            pixel_pitch: 0.05 * 25.0 / 215.0,
            exposure_ms: 1.0,
            quantum_efficiency: 0.5,
            gain_dn_per_e: 0.1,
            bit_depth: 12,
            full_well_e: 20_000.0,
            black_level_dn: 0.0,
            noise: None,
        },
        tilt: DVec2::ZERO,
    };
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
        surface: Lambert { reflectance: 0.5 },
        laser: &laser,
        part_from_laser: looking(DVec3::Z * 200.0),
        camera: &camera,
        part_from_camera: looking(DVec3::new(0.0, -120.0, 240.0 * 0.75f64.sqrt())),
        speckle: None,
        samples_per_side: 1,
        sampling: Sampling::Planes,
        cutoff_radii: crate::laser::CUTOFF_RADII,
    };
    let sight = Sight::new(&camera, &view.part_from_camera);
    footprint(&view, &sight, &Clusters::new(mesh)).count()
}

/// Rows that see light to 4 radii on a plane across the beam: 2·4·w·cos 30° at
/// 0.05 mm a pixel. One row more at each edge is allowed for rounding, the
/// margin and the width's growth off the axis, under 2 %.
#[test]
fn the_footprint_of_a_plane_is_the_line() {
    let fan = Some(Fan {
        angle: 0.5,
        profile: FanProfile::Uniform,
    });
    let plane = shapes::plane(DVec2::splat(100.0)).unwrap();
    // The same plane in 20 000 triangles, 14 px wide, and in 2 million, 1.4 px.
    let meshes = [plane, grid(100), grid(1000)];
    for waist in [0.05, 0.2] {
        let rows = 8.0 * waist * 0.75f64.sqrt() / 0.05;
        for mesh in &meshes {
            let found = count(mesh, waist, fan) as f64 / (COLUMNS as f64 / 16.0);
            assert!(found >= rows.floor(), "{found} of {rows}");
            // A triangle's width more where triangles are small and taken whole.
            let most = if mesh.triangles.len() > 1_000_000 {
                5.0
            } else {
                2.5
            };
            assert!(found <= 1.02 * rows + most, "{found} of {rows}");
        }
    }
}

/// A fan of 0.1 rad lights 20 mm of the 40 mm in view; a point 0.4 mm, which is
/// eight columns: one block or two a row.
#[test]
fn a_narrow_fan_and_a_point_are_narrow_on_the_sensor() {
    let plane = shapes::plane(DVec2::splat(100.0)).unwrap();
    let fan = |angle| {
        Some(Fan {
            angle,
            profile: FanProfile::Uniform,
        })
    };
    let (wide, narrow) = (count(&plane, 0.05, fan(0.5)), count(&plane, 0.05, fan(0.1)));
    let share = narrow as f64 / wide as f64;
    assert!((0.5..0.56).contains(&share), "{share}");
    assert!((6..=20).contains(&count(&plane, 0.05, None)));
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
