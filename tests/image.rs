//! Images of known scenes against closed forms.

mod cameras;

use glam::UVec2;
use lasertrace::accel::Accel;
use lasertrace::camera::{Camera, Distortion};
use lasertrace::frame::{Grid, LensBlur, Region, Sampling, View, irradiance};
use lasertrace::laser::{Beam, CUTOFF_RADII, Fan, FanProfile, Laser};
use lasertrace::math::rng::{Key, Purpose};
use lasertrace::math::{DVec2, DVec3, Rigid};
use lasertrace::mesh::{Mesh, shapes};
use lasertrace::surface::Lambert;
use std::f64::consts::PI;

fn camera(columns: u32, rows: u32, tilt_deg: f64) -> Camera {
    let mut camera = cameras::camera();
    camera.lens.focal_length = 50.0;
    camera.lens.focus_distance = 150.0;
    camera.sensor.resolution = UVec2::new(columns, rows);
    camera.sensor.pixel_pitch = 0.005;
    camera.sensor.full_well_e = 1e9;
    camera.tilt.x = tilt_deg.to_radians();
    camera
}

fn beam(waist_radius: f64, waist_distance: f64) -> Beam {
    Beam {
        wavelength: 660e-6,
        power_mw: 5.0,
        waist_radius,
        waist_distance,
        m_squared: 1.0,
    }
}

/// A frame whose x axis is along the world's and whose z axis runs from `from` to
/// `to`.
fn looking(from: DVec3, to: DVec3) -> Rigid {
    Rigid::from_z_and_x(from, to - from, DVec3::X).unwrap()
}

struct Setup {
    mesh: Mesh,
    laser: Laser,
    part_from_laser: Rigid,
    camera: Camera,
    part_from_camera: Rigid,
    samples_per_side: u32,
}

const REFLECTANCE: f64 = 0.4;

impl Setup {
    fn image(&self) -> Vec<f32> {
        let accel = Accel::build(&self.mesh.clone().into(), 1).unwrap();
        let view = View {
            accel: &accel,
            surface: Lambert {
                reflectance: REFLECTANCE,
            }
            .into(),
            laser: &self.laser,
            part_from_laser: self.part_from_laser,
            camera: &self.camera,
            part_from_camera: self.part_from_camera,
            speckle: None,
            grid: Grid::Gauss {
                per_side: self.samples_per_side,
            },
            sampling: Sampling::Planes,
            cutoff_radii: CUTOFF_RADII,
            lens: LensBlur::NONE,
            indirect: None,
            stop: None,
        };
        irradiance(&view, &Region::All).dense()
    }
}

/// A beam 5 m in radius lights a plane of 10 mm evenly: E = 2P/(πw²) to 2e-6. The
/// count of the pixel on the axis is then η·A·t·λ/(hc) · E·ρ/π · π/(4N²(1+m)²),
/// and others fall with cos⁴. All factors are written out here again.
#[test]
fn an_evenly_lit_plane_gives_the_analytic_count() {
    let eye = DVec3::new(0.0, -60.0, (150.0f64 * 150.0 - 3600.0).sqrt());
    let mut laser = Laser {
        beam: beam(5000.0, 0.0),
        fan: None,
    };
    laser.beam.power_mw = 3e7;
    let setup = Setup {
        mesh: shapes::plane(DVec2::splat(10.0)).unwrap(),
        laser,
        part_from_laser: looking(DVec3::Z * 1000.0, DVec3::ZERO),
        camera: camera(201, 151, 0.0),
        part_from_camera: looking(eye, DVec3::ZERO),
        samples_per_side: 2,
    };
    let image = setup.image();
    let irradiance = 2.0 * 3e7 / (PI * 5000.0f64.powi(2));
    let m = 50.0 / (150.0 - 50.0);
    let on_axis = irradiance * REFLECTANCE / PI * PI / (4.0 * 64.0 * (1.0f64 + m).powi(2));
    let sensor = &setup.camera.sensor;
    for (column, row) in [(100, 75), (0, 0), (200, 150), (13, 140)] {
        let x = (column as f64 - 100.0) * 0.005;
        let y = (row as f64 - 75.0) * 0.005;
        let b2: f64 = 75.0 * 75.0;
        let expected = on_axis * (b2 / (b2 + x * x + y * y)).powi(2);
        let found = image[row * 201 + column] as f64;
        // 2e-6 from the beam, 6e-8 from f32, 1e-6 from cos⁴ within the pixel.
        assert!(
            (found / expected - 1.0).abs() < 5e-6,
            "{column} {row}: {found} {expected}"
        );
        // Planck 2019, Bureau International des Poids et Mesures.
        let photon_mj = 6.62607015e-34 * 299_792_458.0 / 660e-9 * 1e3;
        let electrons = 0.5 * expected * 25e-6 * 1e-3 / photon_mj;
        let count = sensor.count(
            found * sensor.electrons_per_irradiance(660e-6),
            lasertrace::math::rng::Key::new(1, lasertrace::math::rng::Purpose::SensorNoise),
        );
        // The rounding of the count, and 5e-6 of it.
        assert!(
            (count as f64 - electrons * 0.1).abs() <= 0.5 + 1e-5 * electrons,
            "{count} {electrons}"
        );
        assert!((1000..4000).contains(&count), "{count} tells nothing");
    }
}

/// The line's centroid in every column against the exact projection of the line
/// in which sheet and plane meet, for untilted and tilted sensors and planes.
/// 0.01 px is what is promised; perspective across the width of the line, real
/// and not an error of sampling, takes up to 0.002 of it.
#[test]
fn the_centroid_of_a_line_on_a_plane_is_its_projection() {
    for (tilt_deg, slope, width) in [(0.0, 0.0, 0.03), (-18.0, 0.2, 0.03), (0.0, -0.3, 0.012)] {
        let setup = Setup {
            mesh: shapes::plane(DVec2::splat(20.0)).unwrap(),
            laser: Laser {
                beam: beam(width, 150.0),
                fan: Some(Fan {
                    angle: 0.09,
                    profile: FanProfile::Uniform,
                }),
            },
            part_from_laser: looking(
                DVec3::new(0.0, -150.0 * f64::sin(slope), 150.0 * f64::cos(slope)),
                DVec3::ZERO,
            ),
            camera: camera(320, 100, tilt_deg),
            part_from_camera: looking(DVec3::new(0.0, -106.0, 106.0), DVec3::ZERO),
            samples_per_side: 2,
        };
        let image = setup.image();
        let camera_from_part = setup.part_from_camera.inverse();
        let project = |x: f64| {
            let p = camera_from_part.point(DVec3::new(x, 0.0, 0.0));
            setup.camera.project(p).unwrap()
        };
        for column in 0..320 {
            let (mut low, mut high) = (-5.0, 5.0);
            for _ in 0..60 {
                let middle = (low + high) / 2.0;
                if project(middle).x < column as f64 + 0.5 {
                    low = middle;
                } else {
                    high = middle;
                }
            }
            let expected = project(low).y;
            let (mut sum, mut moment) = (0.0, 0.0);
            for row in 0..100 {
                let value = image[row * 320 + column] as f64;
                sum += value;
                moment += value * (row as f64 + 0.5);
            }
            let found = moment / sum;
            assert!(
                (found - expected).abs() < 0.01,
                "tilt {tilt_deg} slope {slope} column {column}: {found} {expected}"
            );
        }
    }
}

/// A part without symmetry: three small plates. Its image must not be mirrored or
/// turned: the plate at +x is seen right, the one at +y (away from the camera)
/// higher up, the raised one higher still.
#[test]
fn an_asymmetric_part_is_seen_the_right_way_round() {
    let plate = |center: DVec3| {
        let corner = |x: f64, y: f64| center + DVec3::new(x, y, 0.0);
        [
            corner(-0.2, -0.2),
            corner(0.2, -0.2),
            corner(0.2, 0.2),
            corner(-0.2, 0.2),
        ]
    };
    let centers = [
        DVec3::new(0.6, 0.0, 0.0),
        DVec3::new(-0.6, 0.5, 0.0),
        DVec3::new(0.0, 0.0, 0.5),
    ];
    let part_from_camera = looking(DVec3::new(0.0, -106.0, 106.0), DVec3::ZERO);
    let mut seen = Vec::new();
    for center in centers {
        let setup = Setup {
            mesh: Mesh {
                positions: plate(center).to_vec(),
                triangles: vec![[0, 1, 2], [0, 2, 3]],
            },
            laser: Laser {
                beam: beam(5.0, 150.0),
                fan: None,
            },
            part_from_laser: looking(DVec3::Z * 150.0, DVec3::ZERO),
            camera: camera(320, 240, 0.0),
            part_from_camera,
            samples_per_side: 1,
        };
        let image = setup.image();
        let (mut sum, mut x, mut y) = (0.0, 0.0, 0.0);
        for (i, value) in image.iter().enumerate() {
            sum += *value as f64;
            x += *value as f64 * ((i % 320) as f64 + 0.5);
            y += *value as f64 * ((i / 320) as f64 + 0.5);
        }
        let centroid = DVec2::new(x, y) / sum;
        let expected = setup
            .camera
            .project(part_from_camera.inverse().point(center))
            .unwrap();
        // Perspective and the beam's profile shift a plate 80 px wide a little.
        assert!(
            (centroid - expected).length() < 0.5,
            "{centroid} {expected}"
        );
        seen.push(centroid);
    }
    let (right, back, raised) = (seen[0], seen[1], seen[2]);
    assert!(right.x > 160.0 && back.x < 160.0);
    assert!(back.y < right.y && raised.y < right.y);
}

/// The seed's picture: a point laser nearly parallel to a diffuse surface. At 1°
/// the spot is stretched 57 times, and all the power that the beam carries is on
/// the plane. Seen from straight above, the sum of the irradiance over the image is
/// P·ρ/π·Ω·(m/pitch)². The pupil's cos⁴ takes 2·(x/150)² of it, with x the spot's
/// standard deviation, 1.4 mm at 1°: 2e-4; the rectangle rule is exact far beyond
/// that. Lower angles need a wider beam: a beam's rays are hyperbolas, and at 1°
/// those of one narrower than 45 µm start below the plane, which blocks them.
#[test]
fn a_beam_grazing_a_plane_leaves_all_its_power_there() {
    for degrees in [1.0f64, 2.0, 10.0] {
        let angle = degrees.to_radians();
        let setup = Setup {
            mesh: shapes::plane(DVec2::splat(100.0)).unwrap(),
            laser: Laser {
                beam: beam(0.05, 40.0),
                fan: None,
            },
            part_from_laser: Rigid::from_z_and_x(
                DVec3::new(-40.0 * angle.cos(), 0.0, 40.0 * angle.sin()),
                DVec3::new(angle.cos(), 0.0, -angle.sin()),
                DVec3::Y,
            )
            .unwrap(),
            camera: camera(3000, 120, 0.0),
            part_from_camera: looking(DVec3::Z * 150.0, DVec3::ZERO),
            samples_per_side: 2,
        };
        let image = setup.image();
        let sum: f64 = image.iter().map(|&e| e as f64).sum();
        let m = setup.camera.lens.magnification();
        let solid_angle = PI / (4.0 * 64.0 * (1.0 + m).powi(2));
        let power_of_one = 5.0 * REFLECTANCE / PI * solid_angle * (m / 0.005).powi(2);
        let share = sum / power_of_one;
        assert!((share - 1.0).abs() < 4e-4, "{degrees}°: {share}");
        assert!(image.iter().all(|e| e.is_finite()));
    }
}

/// A spot near the corner of the image, through lenses, tilts and views drawn at random:
/// what its pixels take in is what goes through the entrance pupil, ∫ρE/π·A·cosθ·cosθ_s/d²
/// over the plane. A pixel p wide has the pupil's solid angle of its centre and a lens that
/// is linear in it, which errs by the squares of p over the lens's distance and of k·p/σ, σ
/// the spot's: 1e-6 at most. f32 is good to 6e-8.
#[test]
fn a_distorting_lens_takes_in_what_its_entrance_pupil_does() {
    let key = Key::new(23, Purpose::SensorNoise);
    let mut greatest: f64 = 0.0;
    for i in 0..6 {
        let random = |k: u64| 2.0 * key.with(i).uniform(k) - 1.0;
        let mut camera = cameras::camera();
        camera.lens.focal_length = 12.0;
        camera.lens.focus_distance = 60.0;
        camera.sensor.resolution = UVec2::splat(1000);
        camera.sensor.pixel_pitch = 0.01;
        camera.tilt = DVec2::new(0.2 * random(0), 0.2 * random(1));
        let k1 = if i % 2 == 0 { -0.1 } else { 0.1 };
        let tangential = [0.01 * random(2), 0.01 * random(3)];
        let reach = camera.model().reach().unwrap();
        let lens = Distortion::new([k1, 0.1 * random(4), 0.0], tangential, reach).unwrap();
        camera.lens.distortion = Some(lens);
        let part_from_camera = looking(DVec3::new(5.0 * random(5), -20.0, 60.0), DVec3::ZERO);
        // Where a place near the corner looks.
        let place = DVec2::new(820.0 + 50.0 * random(6), 180.0 + 50.0 * random(7));
        let towards = part_from_camera.vector(camera.direction(place));
        let eye = part_from_camera.translation;
        let spot = eye - towards * (eye.z / towards.z);
        let laser = Laser {
            beam: beam(0.3, 150.0),
            fan: None,
        };
        let above = DVec3::new(0.0, 0.0, 150.0);
        let setup = Setup {
            mesh: shapes::plane(DVec2::splat(200.0)).unwrap(),
            part_from_laser: looking(spot + above, spot),
            laser,
            camera,
            part_from_camera,
            samples_per_side: 2,
        };
        let pixels = setup.image().iter().map(|&e| e as f64).sum::<f64>();
        let on_sensor = pixels * setup.camera.sensor.pixel_pitch.powi(2);
        // Steps of σ/10 to 8 σ: exact to rounding.
        let step = 0.015;
        let axis = part_from_camera.rotation.z_axis;
        let through_pupil: f64 = (0..161 * 161)
            .map(|k| {
                spot + step * DVec3::new((k % 161) as f64 - 80.0, (k / 161) as f64 - 80.0, 0.0)
            })
            .map(|p| {
                let irradiance =
                    2.0 * 5.0 / (PI * 0.09) * (-2.0 * (p - spot).length_squared() / 0.09).exp();
                let (way, distance) = (p - eye, p.distance(eye));
                let cosines = way.dot(axis) / distance * (eye.z / distance);
                REFLECTANCE / PI * irradiance * cosines / (distance * distance)
            })
            .sum::<f64>()
            * (step * step * setup.camera.lens.pupil_area());
        let ratio = on_sensor / through_pupil;
        assert!((ratio - 1.0).abs() < 2e-6, "{i}: {ratio}");
        let seen = part_from_camera.rotation.transpose() * towards;
        let bent = lens.concentration(seen.truncate() / seen.z);
        greatest = greatest.max((bent - 1.0).abs());
    }
    // And the lenses do concentrate light.
    assert!(greatest > 0.02, "{greatest}");
}
