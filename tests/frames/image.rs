//! Images of known scenes against closed forms.

use crate::cameras;
use glam::UVec2;
use lasertrace::accel::{Accel, Ray};
use lasertrace::camera::{Camera, Distortion};
use lasertrace::frame::{
    Blur, DefocusSettings, PixelQuadrature, PoseView, Sampling, TracedRegion, irradiance,
};
use lasertrace::inspect::cloud::CloudPoint;
use lasertrace::laser::{Beam, CUTOFF_RADII, Fan, FanProfile, Laser};
use lasertrace::math::rng::{Purpose, RngKey};
use lasertrace::math::{DVec2, DVec3, Rigid};
use lasertrace::mesh::{Mesh, shapes};
use lasertrace::run::Simulation;
use lasertrace::scene::Scene;
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
        let view = PoseView {
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
            grid: PixelQuadrature::Gauss {
                per_side: self.samples_per_side,
            },
            sampling: Sampling::Planes,
            beam_cutoff_radii: CUTOFF_RADII,
            lens: DefocusSettings::NONE,
            indirect: None,
            stop: None,
        };
        irradiance(&view, &TracedRegion::All).dense()
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
            lasertrace::math::rng::RngKey::new(1, lasertrace::math::rng::Purpose::SensorNoise),
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
    let key = RngKey::new(23, Purpose::SensorNoise);
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
        let bent = lens.irradiance_jacobian(seen.truncate() / seen.z);
        greatest = greatest.max((bent - 1.0).abs());
    }
    // And the lenses do concentrate light.
    assert!(greatest > 0.02, "{greatest}");
}

/// A plane of 20 mm through the origin, turned about x, y and z; the line of a laser 150 mm above it; and a camera that
/// looks at the origin from 150 mm, `angle` to the sheet, at 10 µm a pixel.
struct Slope {
    turned_deg: [f64; 3],
    angle: f64,
    waist_um: f64,
    resolution: [u32; 2],
    keys: String,
}

impl Slope {
    /// Drawn until `accepted` holds for the angles (degrees) to laser and camera of a plane's normal.
    fn drawn(seed: u64, accepted: impl Fn(f64, f64) -> bool) -> Slope {
        let key = RngKey::new(seed, Purpose::SensorNoise);
        let between = |k: u64, low: f64, high: f64| low + (high - low) * key.uniform(k);
        let angle = between(0, 25f64.to_radians(), 45f64.to_radians());
        let turned = |i: u64| {
            let degrees = [0, 1].map(|k| between(3 + 2 * i + k, -88.0, 88.0));
            let normal = Rigid::from_euler_xyz(
                DVec3::new(degrees[0].to_radians(), degrees[1].to_radians(), 0.0),
                DVec3::ZERO,
            )
            .vector(DVec3::Z);
            let camera = DVec3::new(0.0, -angle.sin(), angle.cos());
            let to = |v: DVec3| normal.dot(v).acos().to_degrees();
            accepted(to(DVec3::Z), to(camera)).then_some([degrees[0], degrees[1], 0.0])
        };
        Slope {
            turned_deg: (0..).find_map(turned).unwrap(),
            angle,
            waist_um: between(1, 30.0, 60.0),
            resolution: [40, 160],
            keys: String::new(),
        }
    }

    fn scene(&self) -> Scene {
        let (sin, cos) = self.angle.sin_cos();
        let text = format!(
            r#"seed = 1
speckle = false
[part]
plane = {{ size_mm = [20, 20] }}
rotation_deg = {:?}
reflectance = 0.5
[laser]
wavelength_nm = 660
power_mw = 5
waist_radius_um = {:?}
waist_distance_mm = 150
position_mm = [0, 0, 150]
direction = [0, 0, -1]
line = {{ fan_deg = 7, profile = "uniform", direction = [1, 0, 0] }}
[camera]
focal_length_mm = 50
f_number = 8
focus_distance_mm = 150
resolution_px = {:?}
pixel_pitch_um = 5
position_mm = [0, {:?}, {:?}]
look_at_mm = [0, 0, 0]
column_axis = [1, 0, 0]
exposure_ms = 0.1
quantum_efficiency = 0.5
gain_dn_per_e = 0.05
bit_depth = 12
full_well_e = 80000
{}
[scan]
direction = [0, 1, 0]
step_mm = 0.01
frames = 1
[model]
defocus_model = "none"
"#,
            self.turned_deg,
            self.waist_um,
            self.resolution,
            -150.0 * sin,
            150.0 * cos,
            self.keys,
        );
        Scene::parse(&text, "".as_ref()).unwrap()
    }
}

/// Irradiance at a place on the sensor of a plane, by the laser's closed form.
fn on_plane(view: &PoseView, (point, normal): (DVec3, DVec3), place: DVec2) -> f64 {
    let eye = view.part_from_camera.translation;
    let direction = view.part_from_camera.vector(view.camera.direction(place));
    let seen = eye + direction * (normal.dot(point - eye) / normal.dot(direction));
    let light = view.laser.at(view.part_from_laser.inverse().point(seen));
    let received = light.map_or(0.0, |light| {
        -view.part_from_laser.vector(light.flux).dot(normal)
    });
    0.5 / PI * received.max(0.0) * view.camera.pupil_solid_angle(place)
}

/// Its mean over each pixel by 32 × 32 places, row by row.
fn means_on_plane(view: &PoseView) -> Vec<f64> {
    const SIDE: usize = 32;
    let size = view.camera.sensor.resolution;
    let ray = Ray {
        origin: view.part_from_camera.translation,
        direction: view.part_from_camera.rotation.z_axis,
        t_max: f64::INFINITY,
    };
    let hit = view.accel.closest(&[ray], |_, _| true)[0].expect("the plane");
    let plane = (hit.point, hit.normal);
    let laser_from_part = view.part_from_laser.inverse();
    let off_sheet = |place: DVec2| {
        let direction = view.part_from_camera.vector(view.camera.direction(place));
        let way = plane.1.dot(plane.0 - ray.origin) / plane.1.dot(direction);
        laser_from_part.point(ray.origin + direction * way).y
    };
    let mean = |i: u32| {
        let corner = DVec2::new((i % size.x) as f64, (i / size.x) as f64);
        let corners = [(0, 0), (1, 0), (0, 1), (1, 1)]
            .map(|(x, y)| off_sheet(corner + DVec2::new(x as f64, y as f64)));
        let nearest = corners.iter().fold(f64::INFINITY, |a, b| a.min(b.abs()));
        let one_side = corners.iter().all(|y| (*y > 0.0) == (corners[0] > 0.0));
        if one_side && nearest > 5.0 * view.laser.beam.waist_radius {
            return 0.0;
        }
        let place = |k: usize| DVec2::new((k % SIDE) as f64 + 0.5, (k / SIDE) as f64 + 0.5);
        let values =
            (0..SIDE * SIDE).map(|k| on_plane(view, plane, corner + place(k) / SIDE as f64));
        values.sum::<f64>() / (SIDE * SIDE) as f64
    };
    (0..size.x * size.y).map(mean).collect()
}

/// Light and centroid of each column.
fn columns_of(image: &[f64], width: usize) -> Vec<[f64; 2]> {
    let column = |x: usize| {
        let rows = (0..image.len() / width).map(|y| (y as f64 + 0.5, image[y * width + x]));
        let sums = rows.fold([0.0; 2], |[sum, moment], (y, v)| [sum + v, moment + v * y]);
        [sums[0], sums[1] / sums[0]]
    };
    (0..width).map(column).collect()
}

/// Planes at 80° to 85° to the camera, whose line is seen 2 to 10 times as narrow as across the beam, and walls at
/// 80° to the light, each with the samples that the plan chooses, and with one, three and four samples along each side of a pixel: pixels,
/// light of columns and their centroids are those of the closed form. A sample has the mean of the beam's profile over its
/// cell where it would move the centroid by 10⁻³ px or more, so that elsewhere light may be off by 5·10⁻⁴ (an alias a of the light is
/// one of the centroid of 4πσ²a, σ = 0.6 px); over a pixel the profile is taken as one of a uniform change, which
/// perspective at 85° bends by 2·10⁻³ (tan 85° · 10 µm/150 mm, twice) of the change. The reference errs by (1/32)²/24
/// of the light's slope over a pixel, 4·10⁻⁵/σ: 4·10⁻⁴ at 0.1 px. Together 3·10⁻³ of the brightest pixel.
#[test]
fn steep_planes_have_the_light_of_the_closed_form() {
    for seed in 1..=3 {
        let to_camera = |laser: f64, camera: f64| laser < 75.0 && (80.0..85.0).contains(&camera);
        let to_light = |laser: f64, camera: f64| (79.0..81.0).contains(&laser) && camera < 84.0;
        for slope in [Slope::drawn(seed, to_camera), Slope::drawn(seed, to_light)] {
            let scene = slope.scene();
            let reference = means_on_plane(&Simulation::new(&scene).unwrap().view(0));
            let brightest = reference.iter().copied().fold(0.0, f64::max);
            let methods =
                [Sampling::Rays, Sampling::PlaneCut].map(|s| [1, 3, 4].map(|side| (s, side)));
            for method in std::iter::once(None).chain(methods.into_iter().flatten().map(Some)) {
                let mut scene = scene.clone();
                scene.methods.pixel_sampling = method.map(|(sampling, _)| sampling);
                scene.methods.samples_per_side = method.map(|(_, side)| side);
                let simulation = Simulation::new(&scene).unwrap();
                let image: Vec<f64> = (simulation.irradiance(0).dense().iter())
                    .map(|&e| e as f64)
                    .collect();
                let pixels = image.iter().zip(&reference).map(|(a, b)| (a - b).abs());
                let worst = pixels.fold(0.0, f64::max) / brightest;
                let width = slope.resolution[0] as usize;
                let both = columns_of(&image, width)
                    .into_iter()
                    .zip(columns_of(&reference, width));
                // Where the sensor sees the line.
                let both: Vec<_> = both.filter(|(_, b)| b[0] > 0.5 * brightest).collect();
                assert!(!both.is_empty());
                let light = both.iter().map(|(a, b)| (a[0] / b[0] - 1.0).abs());
                let light = light.fold(0.0, f64::max);
                let centroid = both.iter().map(|(a, b)| (a[1] - b[1]).abs());
                let centroid = centroid.fold(0.0, f64::max);
                println!(
                    "{seed} {:.1?} waist {:.0} µm, {method:?}: pixels {worst:.1e} of the brightest, light {light:.1e}, \
                     centroid {centroid:.1e} px",
                    slope.turned_deg, slope.waist_um
                );
                // One place in a pixel is not its mean, but sums over columns are those of the means.
                let pixels_count = simulation.plan.samples_per_side >= 3;
                assert!(worst < 3e-3 || !pixels_count, "{seed}");
                assert!(light < 3e-3 && centroid < 3e-3, "{seed}");
            }
        }
    }
}

/// Points on planes at 80° to 85° to the camera, without speckle: no more than one in twenty lies further from the plane
/// than 1.96 of its stated uncertainty, and three standard deviations of the binomial distribution more.
#[test]
fn points_on_steep_planes_are_as_sure_as_they_say() {
    for seed in 11..=14 {
        let to_camera = |laser: f64, camera: f64| laser < 75.0 && (80.0..85.0).contains(&camera);
        let mut slope = Slope::drawn(seed, to_camera);
        slope.waist_um *= 1.5;
        slope.resolution = [240, 200];
        slope.keys = "read_noise_e = 10".into();
        let mut scene = slope.scene();
        let simulation = Simulation::new(&scene).unwrap();
        let brightest = (simulation.irradiance(0).dense().into_iter()).fold(0.0, f32::max) as f64;
        let sensor = &scene.camera.sensor;
        let electrons = brightest * sensor.electrons_per_irradiance(660e-6);
        scene.camera.sensor.exposure_ms *= 40_000.0 / electrons;
        let simulation = Simulation::new(&scene).unwrap();
        let (_, _, points) = simulation.take(0);
        let is_within = |point: &&CloudPoint| point.deviation.abs() <= 1.96 * point.u_deviation;
        let within = points.iter().filter(is_within).count();
        let valid = points.iter().filter(|point| point.flags.is_valid()).count();
        let mean = |of: fn(&CloudPoint) -> f64| {
            let square = points.iter().map(|point| of(point).powi(2)).sum::<f64>();
            1e3 * (square / points.len() as f64).sqrt()
        };
        println!(
            "{seed} {:.1?} waist {:.0} µm: {} points, {valid} valid, {within} within, {:.2} µm off, {:.2} µm stated, \
             width {:.2} px, {}",
            slope.turned_deg,
            slope.waist_um,
            points.len(),
            mean(|point| point.deviation),
            mean(|point| point.u_deviation),
            points[points.len() / 2].line_sigma_px,
            points[points.len() / 2].flags,
        );
        let count = points.len() as f64;
        let least = 0.95 * count - 3.0 * (0.95 * 0.05 * count).sqrt();
        assert!(count > 100.0 && within as f64 >= least, "{seed}");
    }
}

/// Through a lens that is out of focus, on sensors tilted by up to 15°, a line on sixteen plates that rise like stairs over all
/// rows is the sum of its pieces, each imaged alone: light is blurred by its own place, whatever other light is
/// around. The pupil and the blur that a piece has may each be off by 0.5 % of its peak, in one image and in the other.
#[test]
fn blur_depends_on_no_other_light() {
    for (seed, tilt_deg) in [(2, 10.0), (3, 15.0), (4, -10.0)] {
        let key = RngKey::new(seed, Purpose::SensorNoise);
        let between = |k: u64, low: f64, high: f64| low + (high - low) * key.uniform(k);
        let mut camera = camera(64, 460, tilt_deg);
        camera.lens.focal_length = 20.0;
        camera.lens.focus_distance = between(0, 105.0, 115.0);
        camera.sensor.pixel_pitch = 0.01;
        let rise = between(1, 8.0, 10.0);
        let plates: Vec<f64> = (0..16).map(|i| 0.26 * (i as f64 - 8.0)).collect();
        let image = |plates: &[f64]| {
            let corners = plates.iter().flat_map(|&x| {
                let corner = |(a, y)| DVec3::new(x + a, y, rise * x);
                [(0.0, -0.6), (0.2, -0.6), (0.2, 0.6), (0.0, 0.6)].map(corner)
            });
            let triangles = (0..plates.len() as u32)
                .flat_map(|i| [[4 * i, 4 * i + 1, 4 * i + 2], [4 * i, 4 * i + 2, 4 * i + 3]]);
            let mesh = Mesh {
                positions: corners.collect(),
                triangles: triangles.collect(),
            };
            let accel = Accel::build(&mesh.into(), 1).unwrap();
            let view = PoseView {
                accel: &accel,
                surface: Lambert {
                    reflectance: REFLECTANCE,
                }
                .into(),
                laser: &Laser {
                    beam: beam(0.12, 150.0),
                    fan: Some(Fan {
                        angle: 0.09,
                        profile: FanProfile::Uniform,
                    }),
                },
                part_from_laser: looking(DVec3::Z * 150.0, DVec3::ZERO),
                camera: &camera,
                part_from_camera: looking(DVec3::new(0.0, -106.0, 106.0), DVec3::ZERO),
                speckle: None,
                grid: PixelQuadrature::Gauss { per_side: 2 },
                sampling: Sampling::Planes,
                beam_cutoff_radii: CUTOFF_RADII,
                lens: DefocusSettings {
                    blur: Blur::Mean,
                    reach: 64,
                    line_sigma: 0.6,
                    narrowest_sigma: 0.6,
                },
                indirect: None,
                stop: None,
            };
            irradiance(&view, &TracedRegion::All).dense()
        };
        let all = image(&plates);
        let each: Vec<_> = plates.iter().map(|&plate| image(&[plate])).collect();
        let peak = all.iter().copied().fold(0.0, f32::max);
        let sum = |i: usize| each.iter().map(|image| image[i]).sum::<f32>();
        let off = (0..all.len()).map(|i| (all[i] - sum(i)).abs());
        let worst = off.fold(0.0, f32::max) / peak;
        println!("{tilt_deg}°, rise {rise:.1}: {worst:.2e} of the peak");
        assert!(worst < 0.02, "{tilt_deg}°: {worst}");
    }
}

/// Transfer of the mean light by a round pupil in focus, at so many cycles a grain.
fn in_focus(frequency: f64) -> f64 {
    let f = frequency.min(1.0);
    2.0 / PI * (f.acos() - f * (1.0 - f * f).sqrt())
}

/// A line in focus, 2 to 12 grains in standard deviation, as the plan of its own accord images it: peak and second moment within
/// five standard deviations are those of the line's Gaussian through the transfer of the pupil and over the
/// pixel. The plan may leave the lens out where that lowers the peak by less than 2 %; light
/// beyond ten grains (1.3 %) may come in on the other side, of which 1/30 falls on the peak's row.
#[test]
fn diffraction_is_there_where_it_counts() {
    for seed in 1..=5 {
        let key = RngKey::new(seed, Purpose::SensorNoise);
        let between = |k: u64, low: f64, high: f64| low + (high - low) * key.uniform(k);
        let grain_px = 0.66e-3 * 8.0 * 1.5 / 5e-3;
        let grains = [2.0, 3.0, 4.5, 7.0, 12.0][seed as usize - 1] * between(0, 0.9, 1.1);
        let mut slope = Slope::drawn(seed, |laser, _| laser < 90.0);
        slope.turned_deg = [0.0; 3];
        let sigma_px = grains * grain_px;
        slope.waist_um = 2.0 * sigma_px * 10.0 / slope.angle.cos();
        slope.resolution = [64, 400];
        let mut scene = slope.scene();
        scene.methods.defocus_model = None;
        let simulation = Simulation::new(&scene).unwrap();
        let image = simulation.irradiance(0).dense();
        let profile: Vec<f64> = (0..400).map(|y| image[y * 64 + 32] as f64).collect();
        let total: f64 = profile.iter().sum();
        let middle = profile
            .iter()
            .enumerate()
            .map(|(y, v)| (y as f64 + 0.5) * v)
            .sum::<f64>()
            / total;
        let expected = |y: f64| {
            let step = 1e-4;
            let term = |i: usize| {
                let f = (i as f64 + 0.5) * step;
                let line = (-2.0 * (PI * sigma_px * f).powi(2)).exp();
                let pixel = (PI * f).sin() / (PI * f);
                line * in_focus(f * grain_px) * pixel * (2.0 * PI * f * (y - middle)).cos()
            };
            2.0 * step * (0..5000).map(term).sum::<f64>()
        };
        let rows: Vec<f64> = (0..400)
            .map(|y| y as f64 + 0.5)
            .filter(|y| (y - middle).abs() < 5.0 * sigma_px)
            .collect();
        let moment = |value: &dyn Fn(f64) -> f64| {
            let sums = rows
                .iter()
                .map(|&y| (value(y), value(y) * (y - middle).powi(2)));
            let sums = sums.fold((0.0, 0.0), |a, b| (a.0 + b.0, a.1 + b.1));
            (sums.1 / sums.0).sqrt()
        };
        let of_image = |y: f64| profile[y as usize] / total;
        let at = middle.floor() + 0.5;
        let peak = of_image(at) / expected(at) - 1.0;
        let width = moment(&of_image) / moment(&expected) - 1.0;
        println!(
            "σ = {grains:.2} grains, blur {:?}: peak {:+.2} %, width {:+.2} %",
            simulation.plan.blur,
            100.0 * peak,
            100.0 * width
        );
        assert!(peak.abs() < 0.02 && width.abs() < 0.03, "{seed}");
    }
}
