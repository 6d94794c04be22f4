//! Images of the report: sensor frames, and the point cloud over the shaded part.

use crate::accel::{Accel, Ray, WIDTH};
use crate::camera::Counts;
use crate::math::{Aabb, DVec3, median_of_sorted};
use base64::Engine;
use png::{BitDepth, ColorType, Compression, Filter};
use rayon::prelude::*;

/// Encodes samples of `depth` bits (big-endian, row-major) as PNG.
fn encode(
    samples: &[u8],
    [width, height]: [usize; 2],
    (color, depth): (ColorType, BitDepth),
    filter: Filter,
    significant_bits: Option<u8>,
) -> Vec<u8> {
    let mut file = Vec::new();
    let mut encoder = png::Encoder::new(&mut file, width as u32, height as u32);
    encoder.set_color(color);
    encoder.set_depth(depth);
    encoder.set_compression(Compression::Fast);
    encoder.set_filter(filter);
    let written = encoder.write_header().and_then(|mut writer| {
        if let Some(bits) = significant_bits {
            writer.write_chunk(png::chunk::sBIT, &[bits])?;
        }
        writer.write_image_data(samples)
    });
    written.expect("writing to memory does not fail");
    file
}

pub(super) fn base64(bytes: &[u8]) -> String {
    base64::engine::general_purpose::STANDARD.encode(bytes)
}

pub(super) fn data_url(png: &[u8]) -> String {
    format!("data:image/png;base64,{}", base64(png))
}

/// Encodes unmodified 16-bit sensor counts as PNG. The `sBIT` chunk states the number of
/// significant bits of counts up to `max_count`.
pub fn encode_counts(counts: &Counts, max_count: u16) -> Vec<u8> {
    let samples: Vec<[u8; 2]> = (counts.to_rows().iter().map(|c| c.to_be_bytes())).collect();
    let size = [counts.columns(), counts.rows()];
    let kind = (ColorType::Grayscale, BitDepth::Sixteen);
    // For a line on noise, selecting the best filter per row reduces the file size by 3 % and
    // doubles the time.
    let bits = u16::BITS - max_count.leading_zeros();
    encode(
        samples.as_flattened(),
        size,
        kind,
        Filter::Up,
        Some(bits as u8),
    )
}

/// Encodes values (row-major) as a 16-bit greyscale PNG.
pub fn encode_grey16(values: &[u16], size: [usize; 2]) -> Vec<u8> {
    let samples: Vec<[u8; 2]> = values.iter().map(|value| value.to_be_bytes()).collect();
    let kind = (ColorType::Grayscale, BitDepth::Sixteen);
    encode(samples.as_flattened(), size, kind, Filter::Up, None)
}

/// Converts counts to 8 bits with gamma 2.2, so that faint light is visible.
pub fn for_eyes(counts: &[u16], max_count: u16) -> Vec<u8> {
    let shade = |c: u16| ((c as f64 / max_count as f64).powf(1.0 / 2.2) * 255.0).round() as u8;
    let shades: Vec<u8> = (0..=max_count).map(shade).collect();
    let samples = counts.iter().map(|&c| shades[c.min(max_count) as usize]);
    samples.collect()
}

/// Encodes counts (row-major) as an 8-bit PNG for display.
pub fn encode_for_eyes(counts: &[u16], width: usize, max_count: u16) -> Vec<u8> {
    let samples = for_eyes(counts, max_count);
    let kind = (ColorType::Grayscale, BitDepth::Eight);
    encode(
        &samples,
        [width, counts.len() / width],
        kind,
        Filter::Adaptive,
        None,
    )
}

/// Computes grey value and depth of the part along each ray. Both are unchanged for rays that miss
/// the part.
fn shade(
    accel: &Accel,
    rays: &[Ray],
    towards_light: DVec3,
    pixels: &mut [[u8; 3]],
    depth: &mut [f64],
) {
    for (i, packet) in rays.chunks(WIDTH).enumerate() {
        let hits = accel.closest(packet, |_, _| true);
        for (j, hit) in hits[..packet.len()].iter().enumerate() {
            if let Some(hit) = hit {
                let grey = 70.0 + 110.0 * hit.normal.dot(towards_light).max(0.0);
                pixels[i * WIDTH + j] = [grey as u8; 3];
                depth[i * WIDTH + j] = hit.t;
            }
        }
    }
}

/// Parallel projection of the part. `right` and `down` are orthogonal unit vectors in the part
/// frame.
#[derive(Debug, Clone, Copy)]
pub struct ParallelView {
    /// Unit vector to the right of the image.
    pub right: DVec3,
    /// Unit vector to the bottom of the image.
    pub down: DVec3,
}

/// Returns the smallest and largest coordinate of a box along a unit vector.
fn extent(bounds: &Aabb, axis: DVec3) -> (f64, f64) {
    let along = bounds.corners().map(|c| c.dot(axis));
    let low = along.iter().copied().fold(f64::INFINITY, f64::min);
    let high = along.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    (low, high)
}

/// Image of the part in a parallel projection.
pub struct PartPicture {
    /// The image as a PNG file.
    pub png: Vec<u8>,
    /// Coordinate of the left image border along `right`, mm.
    pub left: f64,
    /// Coordinate of the upper image border along `down`, mm.
    pub top: f64,
    /// Image width along `right`, mm.
    pub width: f64,
    /// Image height along `down`, mm.
    pub height: f64,
}

/// Renders the part in grey with points on it; the longer side has `size` pixels. A point covers a
/// square of `spacing` mm, at least one pixel. Each pixel has the colour of the median value of its
/// points, because the front or the last point would be a biased choice. Points behind the surface
/// are hidden.
pub fn part_picture(
    accel: &Accel,
    points: impl IntoIterator<Item = (DVec3, f32)>,
    color: &dyn Fn(f64) -> [u8; 3],
    view: ParallelView,
    (size, spacing): (usize, f64),
) -> PartPicture {
    let bounds = accel.bounds();
    let into = view.right.cross(view.down);
    let (left, right) = extent(&bounds, view.right);
    let (top, bottom) = extent(&bounds, view.down);
    let (near, far) = extent(&bounds, into);
    let margin = 0.04 * (right - left).max(bottom - top);
    let sides = [right - left, bottom - top].map(|side| side + 2.0 * margin);
    let scale = size as f64 / sides[0].max(sides[1]);
    let [width, height] = sides.map(|side| (side * scale).round().max(1.0) as usize);
    let start = near - (far - near) * 0.1 - margin;

    let towards_light = (view.right * -0.4 + view.down * -0.5 - into).normalize();
    let mut pixels = vec![[255u8; 3]; width * height];
    let mut depth = vec![f64::INFINITY; width * height];
    pixels
        .par_chunks_mut(width)
        .zip(depth.par_chunks_mut(width))
        .enumerate()
        .for_each(|(y, (pixels, depth))| {
            let rays: Vec<Ray> = (0..width)
                .map(|x| Ray {
                    origin: view.right * (left - margin + (x as f64 + 0.5) / scale)
                        + view.down * (top - margin + (y as f64 + 0.5) / scale)
                        + into * start,
                    direction: into,
                    t_max: f64::INFINITY,
                })
                .collect();
            shade(accel, &rays, towards_light, pixels, depth);
        });

    let tolerance = 0.01 * bounds.size().length();
    let mut values: Vec<(u32, f32)> = Vec::new();
    let reach = (spacing * scale / 2.0).ceil() as i64;
    for (p, value) in points.into_iter().filter(|(_, value)| !value.is_nan()) {
        let x = ((p.dot(view.right) - left + margin) * scale).floor() as i64;
        let y = ((p.dot(view.down) - top + margin) * scale).floor() as i64;
        let columns = (x - reach).max(0)..(x + reach + 1).min(width as i64);
        for row in (y - reach).max(0)..(y + reach + 1).min(height as i64) {
            for column in columns.clone() {
                let i = row as usize * width + column as usize;
                let off_surface = p.dot(into) - start - depth[i];
                // Outside the pixel that contains it, a point does not cover the background.
                if off_surface <= tolerance && (reach == 0 || depth[i].is_finite()) {
                    values.push((i as u32, value));
                }
            }
        }
    }
    values.par_sort_unstable_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let mut medians = vec![f64::NAN; width * height];
    for pixel in values.chunk_by(|a, b| a.0 == b.0) {
        medians[pixel[0].0 as usize] =
            median_of_sorted(pixel.iter().map(|&(_, value)| f64::from(value)));
    }
    for (i, pixel) in pixels.iter_mut().enumerate() {
        if let Some(value) = pixel_value(&medians, width, i) {
            *pixel = color(value);
        }
    }
    PartPicture {
        png: encode(
            pixels.as_flattened(),
            [width, height],
            (ColorType::Rgb, BitDepth::Eight),
            Filter::Adaptive,
            None,
        ),
        left: left - margin,
        top: top - margin,
        width: width as f64 / scale,
        height: height as f64 / scale,
    }
}

/// Returns the value of a pixel. An empty pixel takes the median of its left, upper and upper-left
/// neighbours. A cloud about as dense as the image then covers the part. Returns `None` if all are
/// NaN.
fn pixel_value(medians: &[f64], width: usize, i: usize) -> Option<f64> {
    if !medians[i].is_nan() {
        return Some(medians[i]);
    }
    let (x, y) = (i % width, i / width);
    let beside = [(1, 0), (0, 1), (1, 1)].into_iter().filter_map(|(dx, dy)| {
        let (x, y) = (x.checked_sub(dx)?, y.checked_sub(dy)?);
        Some(medians[y * width + x]).filter(|value| !value.is_nan())
    });
    let mut values: Vec<f64> = beside.collect();
    values.sort_by(f64::total_cmp);
    (!values.is_empty()).then(|| median_of_sorted(values.into_iter()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::accel::Accel;
    use crate::mesh::shapes;

    /// Strips with aspect ratios from 1/30 to 30 fit completely into the image. Its longer side has
    /// the requested size, and a point appears at its projected position.
    #[test]
    fn a_part_of_any_shape_fits_its_picture() {
        for (x, y) in [(1.0, 30.0), (2.0, 9.0), (5.0, 5.0), (30.0, 1.0)] {
            let mesh = shapes::plane([x, y].into()).unwrap();
            let accel = Accel::build(&mesh.into(), 1).unwrap();
            let view = ParallelView {
                right: DVec3::X,
                down: -DVec3::Y,
            };
            let corner = DVec3::new(0.49 * x, -0.49 * y, 0.0);
            let picture = part_picture(&accel, [(corner, 0.0)], &|_| [1, 2, 3], view, (300, 0.0));
            let image = image::load_from_memory(&picture.png).unwrap().to_rgb8();
            assert_eq!(image.width().max(image.height()), 300);
            assert!(picture.left < -0.5 * x && picture.left + picture.width > 0.5 * x);
            assert!(picture.top < -0.5 * y && picture.top + picture.height > 0.5 * y);
            let drawn = image.enumerate_pixels().find(|(_, _, p)| p.0 == [1, 2, 3]);
            let (i, j, _) = drawn.expect("the point is in the picture");
            let scale = f64::from(image.width()) / picture.width;
            // The square covers a pixel with its neighbours and one more row and column.
            let spacing = (300, 1.9 / scale);
            let middle = [(DVec3::ZERO, 0.0)];
            let wide = part_picture(&accel, middle, &|_| [1, 2, 3], view, spacing);
            let wide = image::load_from_memory(&wide.png).unwrap().to_rgb8();
            let covered = wide.pixels().filter(|p| p.0 == [1, 2, 3]).count();
            assert_eq!(covered, 16);
            let expected = [corner.x - picture.left, -corner.y - picture.top];
            for (found, expected) in [i, j].into_iter().zip(expected) {
                // The pixel that contains the point.
                assert!((f64::from(found) + 0.5 - expected * scale).abs() < 1.0);
            }
        }
    }

    /// For zero-mean noise on a plane with three points per pixel, red and blue pixels are equally
    /// frequent in views from both sides. The image has at least 10 000 pixels. The red fraction
    /// has a standard deviation of at most √(4·¼/10 000) = 0.01, even if groups of four neighbours
    /// have equal colour. The bound is five standard deviations, 0.05.
    #[test]
    fn noise_has_no_colour_from_either_side() {
        use crate::math::rng::{Purpose, RngKey};
        let accel = Accel::build(&shapes::plane([10.0, 10.0].into()).unwrap().into(), 1).unwrap();
        for seed in [1, 2, 3] {
            let key = RngKey::new(seed, Purpose::Samples);
            let points: Vec<(DVec3, f32)> = (0..120_000)
                .map(|i| {
                    let u = |k: u64| key.with(i).uniform(k) - 0.5;
                    // Sums of uniform numbers; at most one pixel away from the plane.
                    let value = 0.05 * (u(2) + u(3) + u(4));
                    (DVec3::new(9.9 * u(0), 9.9 * u(1), value), value as f32)
                })
                .collect();
            for side in [-1.0, 1.0] {
                let right = DVec3::X * side;
                let down = DVec3::new(0.0, -side, -1.0).normalize();
                let down = if right.cross(down).z < 0.0 {
                    down
                } else {
                    -down
                };
                let paint = |value: f64| {
                    if value > 0.0 {
                        [255, 0, 0]
                    } else {
                        [0, 0, 255]
                    }
                };
                let view = ParallelView { right, down };
                let picture =
                    part_picture(&accel, points.iter().copied(), &paint, view, (200, 0.0));
                let image = image::load_from_memory(&picture.png).unwrap().to_rgb8();
                let count = |color: [u8; 3]| image.pixels().filter(|p| p.0 == color).count() as f64;
                let (red, blue) = (count([255, 0, 0]), count([0, 0, 255]));
                assert!(red + blue > 10_000.0, "{red} {blue}");
                assert!(
                    (red / (red + blue) - 0.5).abs() < 0.05,
                    "{seed} {side}: {red} {blue}"
                );
            }
        }
    }
}
