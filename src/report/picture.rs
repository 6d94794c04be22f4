//! Pictures for the report: sensor frames, and the cloud over the shaded part.

use crate::accel::{Accel, Ray, WIDTH};
use crate::camera::Counts;
use crate::math::{Aabb, DVec3};
use base64::Engine;
use png::{BitDepth, ColorType, Compression, Filter};
use rayon::prelude::*;

/// Samples of `depth` bits, the higher byte first, row by row, as PNG.
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

/// PNG of 16-bit sensor counts as they are. Its `sBIT` chunk states how many of the lower bits
/// counts up to `max_count` use.
pub fn encode_counts(counts: &Counts, max_count: u16) -> Vec<u8> {
    let samples: Vec<[u8; 2]> = (counts.to_rows().iter().map(|c| c.to_be_bytes())).collect();
    let size = [counts.columns(), counts.rows()];
    let kind = (ColorType::Grayscale, BitDepth::Sixteen);
    // Of a line on noise the best filter of each row makes files some 3 % smaller than this one, and takes twice
    // the time.
    let bits = u16::BITS - max_count.leading_zeros();
    encode(
        samples.as_flattened(),
        size,
        kind,
        Filter::Up,
        Some(bits as u8),
    )
}

/// Counts for people: 8 bits, gamma 2.2, so that faint light shows.
pub fn for_eyes(counts: &[u16], max_count: u16) -> Vec<u8> {
    let shade = |c: u16| ((c as f64 / max_count as f64).powf(1.0 / 2.2) * 255.0).round() as u8;
    let shades: Vec<u8> = (0..=max_count).map(shade).collect();
    let samples = counts.iter().map(|&c| shades[c.min(max_count) as usize]);
    samples.collect()
}

/// PNG of counts, row by row, for people.
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

/// Grey and depth of the part along each ray; both stay where it is missed.
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

/// A parallel view of the part: `right` and `down` are unit vectors across each
/// other in the part's frame.
#[derive(Debug, Clone, Copy)]
pub struct ParallelView {
    /// Unit vector to the right of the picture.
    pub right: DVec3,
    /// Unit vector to its bottom.
    pub down: DVec3,
}

/// Least and greatest coordinate of a box along a unit vector.
fn extent(bounds: &Aabb, axis: DVec3) -> (f64, f64) {
    let along = bounds.corners().map(|c| c.dot(axis));
    let low = along.iter().copied().fold(f64::INFINITY, f64::min);
    let high = along.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    (low, high)
}

/// The part in a parallel view.
pub struct PartPicture {
    /// A PNG file.
    pub png: Vec<u8>,
    /// Coordinates of the picture's left and top edge along the view's axes, and
    /// its size, mm.
    pub left: f64,
    /// Along `down`, mm.
    pub top: f64,
    /// Along `right`, mm.
    pub width: f64,
    /// Along `down`, mm.
    pub height: f64,
}

/// The part in grey with coloured points on it, `size` pixels on its longer side. Points
/// behind the surface are hidden.
pub fn part_picture(
    accel: &Accel,
    points: impl IntoIterator<Item = (DVec3, [u8; 3])>,
    view: ParallelView,
    size: usize,
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
    for (p, color) in points {
        let x = (p.dot(view.right) - left + margin) * scale;
        let y = (p.dot(view.down) - top + margin) * scale;
        if !(x >= 0.0 && y >= 0.0 && (x as usize) < width && (y as usize) < height) {
            continue;
        }
        // Two pixels wide and high, so that a cloud as dense as the picture covers
        // the part.
        for (x, y) in
            [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(i, j)| (x as usize + i, y as usize + j))
        {
            let i = y * width + x;
            if x < width && y < height && p.dot(into) - start <= depth[i] + tolerance {
                pixels[i] = color;
            }
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::accel::Accel;
    use crate::mesh::shapes;

    /// Strips from 1/30 to 30 times as high as wide: all of them is in the picture, whose
    /// longer side is what was asked for, and the place of a point is where it is drawn.
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
            let picture = part_picture(&accel, [(corner, [1, 2, 3])], view, 300);
            let image = image::load_from_memory(&picture.png).unwrap().to_rgb8();
            assert_eq!(image.width().max(image.height()), 300);
            assert!(picture.left < -0.5 * x && picture.left + picture.width > 0.5 * x);
            assert!(picture.top < -0.5 * y && picture.top + picture.height > 0.5 * y);
            let drawn = image.enumerate_pixels().find(|(_, _, p)| p.0 == [1, 2, 3]);
            let (i, j, _) = drawn.expect("the point is in the picture");
            let scale = f64::from(image.width()) / picture.width;
            let expected = [corner.x - picture.left, -corner.y - picture.top];
            for (found, expected) in [i, j].into_iter().zip(expected) {
                // The pixel it lies in.
                assert!((f64::from(found) + 0.5 - expected * scale).abs() < 1.0);
            }
        }
    }
}
