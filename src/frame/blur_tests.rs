use super::super::direct_light::{Sampling, light};
use super::super::{DefocusSettings, PixelQuadrature, Speckle, SpeckleSource, expose, footprint};
use super::*;
use crate::accel::{Accel, TriangleClusters};
use crate::camera::{Camera, fixture};
use crate::frame::defocus::TAIL_GRAINS;
use crate::laser::{Beam, CUTOFF_RADII, Fan, FanProfile, Laser};
use crate::math::{Aperture, DVec3, Rigid};
use crate::mesh::Mesh;
use crate::speckle::frame_field::{FrameFields, PupilPosition, field_spec, wide_field_spec};
use crate::speckle::lookup::Coherence;
use crate::surface::Lambert;
use std::f64::consts::PI;

const SIDE: u32 = 2;

/// Calls `then` with a view of two planes, one `step` mm above the other, with an edge below the
/// line. The laser plane is perpendicular to them. The camera is 240 mm away, at 30° to the laser
/// plane.
fn over_a_step(
    step: f64,
    camera: &Camera,
    blur: Blur,
    then: impl FnOnce(&PoseView, &TriangleClusters),
) {
    let corner = |x: f64, y: f64, z: f64| DVec3::new(x, y, z);
    let plane = |low: f64, high: f64, z: f64| {
        [
            corner(low, -30.0, z),
            corner(high, -30.0, z),
            corner(high, 30.0, z),
            corner(low, 30.0, z),
        ]
    };
    let vertices = [plane(-30.0, 0.0, 0.0), plane(0.0, 30.0, step)].concat();
    let triangles = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]];
    let mesh = Mesh::from_triangles(vertices, triangles).unwrap();
    let clusters = TriangleClusters::new(&mesh);
    let accel = Accel::build(&mesh.into(), 1).unwrap();
    let laser = Laser {
        beam: Beam {
            wavelength: 660e-6,
            power_mw: 5.0,
            waist_radius: 0.15,
            waist_distance: 200.0,
            m_squared: 1.0,
        },
        fan: Some(Fan {
            angle: 0.1,
            profile: FanProfile::Uniform,
        }),
    };
    let looking = |from: DVec3| Rigid::from_z_and_x(from, -from, DVec3::X).unwrap();
    let view = PoseView {
        accel: &accel,
        surface: Lambert { reflectance: 0.5 }.into(),
        laser: &laser,
        part_from_laser: looking(DVec3::Z * 200.0),
        camera,
        part_from_camera: looking(DVec3::new(0.0, -120.0, 208.0)),
        speckle: None,
        grid: PixelQuadrature::Even { per_side: SIDE },
        sampling: Sampling::Planes,
        beam_cutoff_radii: CUTOFF_RADII,
        lens: DefocusSettings {
            blur,
            reach: 128,
            line_sigma: 2.0,
            narrowest_sigma: 2.0,
        },
        indirect: None,
        stop: None,
    };
    then(&view, &clusters);
}

fn focused_at(distance: f64, aperture: Aperture) -> Camera {
    let mut camera = fixture();
    camera.lens.focus_distance = distance;
    camera.lens.aperture = aperture;
    camera
}

fn sharp(view: &PoseView) -> DirectIrradiance {
    light(view, footprint(view, &TracedRegion::All))
}

fn total(light: &DirectIrradiance) -> f64 {
    let mean = |s: &[f32]| s.iter().map(|&e| e as f64).sum::<f64>() / s.len() as f64;
    light.pixels().map(|(_, _, s)| mean(s)).sum()
}

/// Energy is conserved on flat surfaces and over steps, except for the light beyond the margin
/// along rows. The transfer function is 1 at zero frequency, and the weights of layers sum to 1. The
/// tail of the Airy pattern across a line holds 0.129/g of the light beyond g grains, and no pupil
/// of equal width along rows has more. The tolerance of 1e-4 is the f32 rounding of some 10⁵ samples.
#[test]
fn energy_is_kept() {
    for step in [0.0, 4.0] {
        for focus in [240.0, 225.0, 260.0] {
            for aperture in [Aperture::Circle, Aperture::Square, Aperture::Ellipse(0.5)] {
                let camera = focused_at(focus, aperture);
                over_a_step(step, &camera, Blur::Mean, |view, _| {
                    let before = total(&sharp(view));
                    let after = total(&blur(sharp(view), view, &TracedRegion::All));
                    let lost = 1.0 - after / before;
                    assert!(
                        (-1e-4..0.129 / TAIL_GRAINS + 1e-4).contains(&lost),
                        "{step} {focus}: {before} {after}"
                    );
                });
            }
        }
    }
}

/// Returns the irradiance at `places` by direct summation of the pupil's field for every lit
/// sample. It is the reference for tiles, layers and transfer functions.
fn by_sum(view: &PoseView, light: &DirectIrradiance, places: &[DVec2]) -> Vec<f64> {
    const POINTS: usize = 48;
    let middle = DVec2::new(400.0, 300.0);
    let pupil = PupilOtf::new(view.camera, middle, view.laser.beam.wavelength);
    let at = |i: usize| (i as f64 + 0.5) / POINTS as f64 - 0.5;
    let points: Vec<DVec2> = (0..POINTS * POINTS)
        .map(|k| DVec2::new(at(k % POINTS), at(k / POINTS)))
        .filter(|&u| view.camera.lens.aperture.contains(u))
        .collect();
    // ∫|H|² over the sensor, in pixels, is the area of the pupil.
    let area = points.len() as f64 / (POINTS * POINTS) as f64;
    let grains = pupil.grains.determinant();
    let field = |lag: DVec2, blur: f64| {
        let (mut re, mut im) = (0.0, 0.0);
        for &u in &points {
            let (sin, cos) = (PI * (blur * u.length_squared() - 2.0 * u.dot(lag))).sin_cos();
            (re, im) = (re + cos, im + sin);
        }
        (re * re + im * im) / (POINTS as f64).powi(4)
    };
    let mut sums = vec![0.0; places.len()];
    let numbers = (0..light.rows.pixels.rows).flat_map(|row| {
        let pixels = light.rows.pixels.of(row).zip(light.rows.start(row)..);
        pixels.map(move |(column, pixel)| (DVec2::new(column as f64, row as f64) + 0.5, pixel))
    });
    for (centre, pixel) in numbers {
        let samples = light.samples(pixel).iter().zip(light.blur(pixel));
        let nodes = light.nodes.places().iter().zip(light.nodes.weights());
        for ((&irradiance, &blur), (off, &weight)) in samples.zip(nodes) {
            if irradiance == 0.0 {
                continue;
            }
            let of_sample = (irradiance * weight) as f64 * grains / area;
            for (sum, &place) in sums.iter_mut().zip(places) {
                let lag = place - centre - *off;
                if lag.abs().max_element() < 30.0 {
                    *sum += of_sample * field(pupil.grains * lag, blur as f64);
                }
            }
        }
    }
    sums
}

/// Returns [simulated light, light by direct summation] for each pixel.
fn found_and_expected(view: &PoseView, pixels: &[DVec2]) -> Vec<[f64; 2]> {
    let before = sharp(view);
    // Pixel means are computed from two nodes along each side.
    let nodes = QuadratureNodes::new(PixelQuadrature::Gauss { per_side: 2 });
    let places: Vec<DVec2> = (pixels.iter())
        .flat_map(|&pixel| nodes.places().iter().map(move |&node| pixel + node))
        .collect();
    let at_nodes = by_sum(view, &before, &places);
    let expected = (at_nodes.chunks(4)).map(|nodes| nodes.iter().sum::<f64>() / 4.0);
    let after = blur(before, view, &TracedRegion::All);
    let found = |place: &DVec2| {
        let mut pixels = after.pixels();
        let own = |&(column, row, _): &(usize, usize, &[f32])| {
            (column, row) == (place.x as usize, place.y as usize)
        };
        pixels
            .find(own)
            .map_or(0.0, |(_, _, samples)| samples[0] as f64)
    };
    let both = pixels.iter().zip(expected);
    both.map(|(place, expected)| [found(place), expected])
        .collect()
}

/// Returns the pixels of these columns in every fourth row across the line.
fn across(columns: impl IntoIterator<Item = usize>) -> Vec<DVec2> {
    let rows = |column: usize| {
        (-3..=3).map(move |row| DVec2::new(column as f64 + 0.5, 300.5 + 4.0 * row as f64))
    };
    columns.into_iter().flat_map(rows).collect()
}

/// Relative error of pixel means next to an end of the line; see [`defocus::grid`].
const END: f64 = 0.046;

/// Blurred light agrees with direct summation far from the step, at the step and next to it. Layers
/// have a step of ½ in β, tiles have a single pupil, and tails beyond ten grains wrap around.
/// Together these errors are below half a percent of the line's peak. With pixel means, the column
/// at the step has the larger tolerance [`END`].
fn light_is_spread(step: f64, focus: f64, aperture: Aperture, grid: PixelQuadrature) {
    let of_pixels = PixelQuadrature::Gauss { per_side: SIDE };
    let camera = focused_at(focus, aperture);
    over_a_step(step, &camera, Blur::Mean, |view, _| {
        let view = &PoseView {
            grid,
            ..view.clone()
        };
        let pixels = across([350, 400, 404]);
        let light = found_and_expected(view, &pixels);
        let peak = light.iter().map(|light| light[1]).fold(0.0, f64::max);
        for (place, [found, expected]) in pixels.iter().zip(light) {
            let of_end = match grid == of_pixels && place.x == 400.5 {
                true => END,
                false => 0.0,
            };
            assert!(
                (found - expected).abs() < (of_end + 5e-3) * peak,
                "{step} {focus} {aperture:?} {grid:?} {place}: {found} {expected} of {peak}"
            );
        }
    });
}

#[test]
fn light_is_spread_as_by_the_pupils_field() {
    let even = PixelQuadrature::Even { per_side: SIDE };
    light_is_spread(3.0, 232.0, Aperture::Circle, even);
}

#[test]
#[ignore = "a minute; run by tests/verify.sh"]
fn light_is_spread_as_by_the_fields_of_other_pupils() {
    let even = PixelQuadrature::Even { per_side: SIDE };
    let of_pixels = PixelQuadrature::Gauss { per_side: SIDE };
    light_is_spread(0.0, 225.0, Aperture::Circle, even);
    light_is_spread(0.0, 240.0, Aperture::Circle, even);
    light_is_spread(3.0, 232.0, Aperture::Circle, of_pixels);
    light_is_spread(3.0, 232.0, Aperture::Square, even);
    light_is_spread(0.0, 240.0, Aperture::Square, even);
}

/// A line that ends at the centre of a pixel has the tolerance of pixel means, in addition to the
/// tolerance of the previous test.
#[test]
fn light_that_ends_within_a_pixel_is_spread_nearly_as_well() {
    let mut camera = focused_at(240.0, Aperture::Circle);
    // x = 0, where the upper plane ends, is at the centre of column 400.
    camera.sensor.resolution.x = 801;
    for f_number in [5.6, 8.0] {
        camera.lens.f_number = f_number;
        over_a_step(-25.0, &camera, Blur::Mean, |view, _| {
            let view = &PoseView {
                sampling: Sampling::Rays,
                ..view.clone()
            };
            let pixels = [399, 400, 401, 402].map(|x| DVec2::new(x as f64 + 0.5, 300.5));
            let light = found_and_expected(view, &pixels);
            let peak = light.iter().map(|light| light[1]).fold(0.0, f64::max);
            for (place, [found, expected]) in pixels.iter().zip(light) {
                assert!(
                    (found - expected).abs() < (END + 5e-3) * peak,
                    "f/{f_number} {place}: {found} {expected} of {peak}"
                );
            }
        });
    }
}

/// Light does not depend on the selection of traced dark pixels, nor do columns depend on the
/// selection of other columns.
#[test]
fn regions_have_the_same_light() {
    let camera = focused_at(228.0, Aperture::Circle);
    over_a_step(2.0, &camera, Blur::Mean, |view, clusters| {
        let of = |region: &TracedRegion| {
            let light = light(view, footprint(view, region));
            expose(blur(light, view, region), view).dense()
        };
        let all = of(&TracedRegion::All);
        assert!(all == of(&TracedRegion::Lit(clusters)));
        let columns = 371..430;
        let some = of(&TracedRegion::Columns(clusters, columns.clone()));
        for (i, (some, all)) in some.iter().zip(&all).enumerate() {
            let expected = if columns.contains(&(i % 800)) {
                *all
            } else {
                0.0
            };
            assert_eq!(*some, expected, "{i}");
        }
    });
}

/// Statistics of a line under speckle, over its columns.
struct LineScatter {
    /// Contrast over all pixels of the centre row.
    contrast: f64,
    /// Standard deviation of centroids, pixels.
    noise: f64,
    /// Sum of all light.
    light: f64,
    columns: usize,
}

/// Simulates `draws` independent fields on a flat surface, with a centred line of ±190 columns.
fn lines(camera: &Camera, waist: f64, blur_by: Blur, draws: usize) -> LineScatter {
    let (mut sums, mut squares, mut count) = (0.0, 0.0, 0.0);
    let (mut off, mut off2, mut columns) = (0.0, 0.0, 0);
    let mut all = 0.0;
    over_a_step(0.0, camera, blur_by, |view, clusters| {
        let laser = Laser {
            beam: Beam {
                waist_radius: waist,
                ..view.laser.beam
            },
            ..view.laser.clone()
        };
        let wavelength = laser.beam.wavelength;
        let grain = camera.speckle_angle(wavelength);
        let wider = 1.8;
        let coherent = blur_by == Blur::Coherent;
        let spec = match coherent {
            true => wide_field_spec(1, camera.lens.aperture, wider),
            false => field_spec(1, camera.lens.aperture),
        };
        let wider = if coherent { wider } else { 1.0 };
        let fields = FrameFields::new(&spec, Coherence::FULL).unwrap();
        let map = fields.map(grain / wider, camera.lens.image_distance());
        for draw in 0..draws {
            let place = PupilPosition {
                shift: DVec2::new(3.0 * draw as f64, 0.0) / wider,
                defocus: 0.0,
            };
            let view = PoseView {
                surface: view.surface.clone(),
                laser: &laser,
                speckle: Some(Speckle {
                    patterns: SpeckleSource::Frame {
                        fields: &fields,
                        place,
                    },
                    map,
                    displacement: DVec2::ZERO,
                    pupil_scale: coherent.then_some(wider),
                }),
                grid: PixelQuadrature::Gauss { per_side: 2 },
                ..*view
            };
            let region = TracedRegion::Lit(clusters);
            let light = light(&view, footprint(&view, &region));
            let image = expose(blur(light, &view, &region), &view).dense();
            all += image.iter().map(|&e| e as f64).sum::<f64>();
            for column in 230..570 {
                let of = |row: usize| image[800 * row + column] as f64;
                let middle = of(300);
                (sums, squares, count) = (sums + middle, squares + middle * middle, count + 1.0);
                let rows = 200..400;
                let sum: f64 = rows.clone().map(of).sum();
                let centre = rows.map(|row| (row as f64 - 300.0) * of(row)).sum::<f64>() / sum;
                (off, off2, columns) = (off + centre, off2 + centre * centre, columns + 1);
            }
        }
    });
    let mean = sums / count;
    let n = columns as f64;
    LineScatter {
        contrast: (squares / count - mean * mean).sqrt() / mean,
        noise: (off2 / n - (off / n).powi(2)).sqrt(),
        light: all / draws as f64,
        columns,
    }
}

/// Coherent blur preserves the mean light and fully developed speckle at every defocus. Its
/// centroid noise exceeds the noise of incoherent blur by the law of [`defocus_noise`], which has
/// an error of 3 %. Columns at a distance of one grain are independent. For n columns, the relative
/// standard error of light or contrast is at most 1/√n. The relative standard error of a standard
/// deviation is 1/√(2n). The tolerance is four standard errors for both images, which fails in 6 of
/// 10⁵ cases.
///
/// [`defocus_noise`]: crate::speckle::theory::defocus_noise
#[test]
fn fields_through_the_lens_are_speckle_as_blur_makes_it() {
    let waist = 0.45;
    for (aperture, focus) in [
        (Aperture::Circle, 240.0),
        (Aperture::Circle, 208.0),
        (Aperture::Ellipse(0.6), 215.0),
    ] {
        let mut camera = focused_at(focus, aperture);
        camera.lens.f_number = 16.0;
        let h = camera.speckle_size(660e-6) / 0.0055;
        let [mean, field] =
            [Blur::Mean, Blur::Coherent].map(|blur| lines(&camera, waist, blur, 24));
        let b = camera.defocus_blur(DVec3::Z * 240.0).unwrap() / 0.0055;
        // The line is on a plane viewed at 30°.
        let to_sensor = camera.lens.image_distance() / 240.0 * 30f64.to_radians().cos();
        let sigma = waist / 2.0 * to_sensor / 0.0055;
        let w = crate::speckle::theory::centroid_noise(h, sigma, 1.0);
        let k = crate::speckle::theory::defocus_noise(aperture, 1.0 / h, sigma / h);
        let law = (k * b * (h / sigma).sqrt() / w).hypot(1.0);
        let error = 4.0 * 2f64.sqrt() / (field.columns as f64 / h).sqrt();
        let [light, noise] = [field.light / mean.light, field.noise / mean.noise];
        let contrast = field.contrast / mean.contrast;
        println!(
            "{aperture:?} σ {sigma:.2} h {h:.2} b {b:.2} px: light {light:.3}, contrast {contrast:.3}, \
             noise {noise:.3}, law {law:.3}"
        );
        assert!((light - 1.0).abs() < error, "{light}");
        assert!((contrast - 1.0).abs() < error, "{contrast}");
        let open = 0.03 + error / 2f64.sqrt();
        assert!((noise / law - 1.0).abs() < open, "{noise} {law}");
    }
}

/// With the pupil wide open and in focus, blur has almost no effect.
#[test]
fn a_sharp_lens_spreads_nothing() {
    let mut camera = focused_at(240.0, Aperture::Square);
    camera.lens.f_number = 0.5;
    over_a_step(0.0, &camera, Blur::Mean, |view, _| {
        let before = sharp(view);
        let peak = before
            .pixels()
            .flat_map(|(_, _, s)| s)
            .copied()
            .fold(0.0, f32::max);
        let sharp: Vec<f32> = expose(before, view).dense();
        let spread = expose(blur(self::sharp(view), view, &TracedRegion::All), view).dense();
        // The centre column is in focus.
        let column = |image: &[f32]| {
            image
                .iter()
                .skip(400)
                .step_by(800)
                .copied()
                .collect::<Vec<_>>()
        };
        for (a, b) in column(&sharp).iter().zip(column(&spread)) {
            assert!((a - b).abs() < 0.02 * peak, "{a} {b} of {peak}");
        }
    });
}
