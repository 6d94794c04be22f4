//! Reader for one channel of an image file, with detection of the saturation count.

use crate::camera::Counts;
use image::codecs::pnm::PnmDecoder;
use image::{DynamicImage, ImageFormat, ImageReader, Limits};
use serde::Serialize;
use std::fmt;
use std::io::Cursor;

/// Channel of a colour image that is read as counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Channel {
    /// Channel whose columns have the highest maxima above their means.
    Brightest,
    /// First channel.
    Red,
    /// Second channel.
    Green,
    /// Third channel.
    Blue,
}

impl fmt::Display for Channel {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Channel::Brightest => "brightest",
            Channel::Red => "red",
            Channel::Green => "green",
            Channel::Blue => "blue",
        })
    }
}

/// Supported formats, for error messages.
pub(super) const FORMATS: &str = "an image (PNG, JPEG, TIFF, BMP or PGM)";

/// One channel of an image.
pub(super) struct ImageChannel {
    pub counts: Counts,
    /// Count at and above which a pixel is saturated.
    pub saturation: u16,
    /// Channel that was read; `None` for a grey image.
    pub channel: Option<Channel>,
}

/// Memory limit of the decoder, bytes.
const MOST_BYTES: u64 = 1 << 29;

/// Largest reduction of clipped pixels by JPEG compression, counts. It was measured for lines with
/// σ = 1.2 to 2.7 px and heights of 1.1 to 1.7 of full scale, at qualities from 75 to 95. Up to a
/// third of the columns had no pixel of 255, and almost all had a pixel of at least 252.
const JPEG_ERROR: u16 = 3;

/// Decodes an image with at most `most` bytes of memory. Returns the format of the file, too. The
/// error describes bytes that are not a supported image.
pub(super) fn decode(
    bytes: &[u8],
    most: u64,
) -> Result<(Option<ImageFormat>, DynamicImage), String> {
    let reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format();
    let mut reader = reader.map_err(|error| error.to_string())?;
    let mut limits = Limits::default();
    limits.max_alloc = Some(most);
    reader.limits(limits);
    let format = reader.format();
    let image = reader.decode().map_err(|error| error.to_string())?;
    Ok((format, image))
}

/// Reads `channel` of an image, transposed if `turned`. The error describes bytes that are not a
/// supported image.
pub(super) fn read_channel(
    bytes: &[u8],
    channel: Channel,
    turned: bool,
) -> Result<ImageChannel, String> {
    let in_words = |error: image::ImageError| error.to_string();
    let (format, image) = decode(bytes, MOST_BYTES)?;
    let declared = match format {
        Some(ImageFormat::Png) => significant_bits(bytes),
        Some(ImageFormat::Pnm) => Some(Declared::Highest(pnm_highest(bytes).map_err(in_words)?)),
        _ => None,
    };
    let planes = Planes::of(&image, declared)?;
    let read = |index: usize| {
        let counts = Counts::of_rows(&planes.channel(index), planes.width);
        match turned {
            false => counts,
            true => Counts::of_rows(counts.by_column(), counts.rows()),
        }
    };
    let (counts, channel) = match (planes.colors, channel) {
        (1, _) => (read(0), None),
        (_, Channel::Red) => (read(0), Some(Channel::Red)),
        (_, Channel::Green) => (read(1), Some(Channel::Green)),
        (_, Channel::Blue) => (read(2), Some(Channel::Blue)),
        (_, Channel::Brightest) => {
            let names = [Channel::Red, Channel::Green, Channel::Blue];
            let all = (0..3).map(read).zip(names);
            let (counts, name) = all
                .reduce(|a, b| {
                    if contrast(&b.0) > contrast(&a.0) {
                        b
                    } else {
                        a
                    }
                })
                .expect("three channels");
            (counts, Some(name))
        }
    };
    let lost = match format {
        Some(ImageFormat::Jpeg) => JPEG_ERROR,
        _ => 0,
    };
    let mut saturation = saturation(&counts, planes.full, declared).saturating_sub(lost);
    if lost > 0 {
        saturation = saturation.min(compressed_plateau(&counts).unwrap_or(saturation));
    }
    Ok(ImageChannel {
        saturation,
        counts,
        channel,
    })
}

/// Returns the sum over columns of the maximum minus the mean.
fn contrast(counts: &Counts) -> f64 {
    let of_column = |column: usize| {
        let pixels = counts.column(column);
        let sum: u64 = pixels.iter().map(|&count| u64::from(count)).sum();
        let highest = pixels.iter().max().copied().unwrap_or(0);
        f64::from(highest) - sum as f64 / pixels.len() as f64
    };
    (0..counts.columns()).map(of_column).sum()
}

/// Range of counts according to the file header.
#[derive(Clone, Copy)]
enum Declared {
    /// Number of significant bits of PNG samples (`sBIT`).
    Bits(u32),
    /// Highest sample value of a PGM file (`maxval`).
    Highest(u16),
}

/// Samples of an image as 16-bit numbers, for any bit depth of the file.
struct Planes {
    samples: Vec<u16>,
    width: usize,
    /// Number of samples per pixel.
    channels: usize,
    /// Number of colour channels without alpha: 3 for a colour image, 1 for a grey image.
    colors: usize,
    /// Highest sample value of the file format.
    full: u16,
}

impl Planes {
    fn of(image: &DynamicImage, declared: Option<Declared>) -> Result<Planes, String> {
        let color = image.color();
        let channels = usize::from(color.channel_count());
        let bytes = image.as_bytes();
        let (mut samples, mut full): (Vec<u16>, u16) =
            match usize::from(color.bytes_per_pixel()) / channels {
                1 => (bytes.iter().copied().map(u16::from).collect(), 255),
                2 => {
                    let pairs = bytes.as_chunks().0.iter();
                    (
                        pairs.map(|&pair| u16::from_ne_bytes(pair)).collect(),
                        u16::MAX,
                    )
                }
                _ => return Err("an image of floating-point numbers".into()),
            };
        // The decoder scales 16-bit PGM to 65535.
        if let (Some(Declared::Highest(highest)), u16::MAX) = (declared, full) {
            let (from, to) = (u32::from(u16::MAX), u32::from(highest));
            for sample in &mut samples {
                *sample = ((u32::from(*sample) * to + from / 2) / from) as u16;
            }
            full = highest;
        }
        if full == u16::MAX {
            full /= scaled_down(&mut samples);
        }
        if samples.is_empty() {
            return Err("an image without pixels".into());
        }
        Ok(Planes {
            samples,
            width: image.width() as usize,
            channels,
            colors: if color.has_color() { 3 } else { 1 },
            full,
        })
    }

    fn channel(&self, index: usize) -> Vec<u16> {
        let pixels = self.samples.chunks_exact(self.channels);
        pixels.map(|pixel| pixel[index]).collect()
    }
}

/// Divides 16-bit samples by the factor that scaled smaller samples to 16 bits, and returns the
/// factor. It is 257 for 8 bits, or a power of two up to 256 for shifted bits. The result is in
/// camera counts, which the finders require, as they estimate background noise in integer counts.
fn scaled_down(samples: &mut [u16]) -> u16 {
    let factor = if samples.iter().all(|sample| sample.is_multiple_of(257)) {
        257
    } else {
        let used = samples.iter().fold(0, |used, sample| used | sample);
        1 << used.trailing_zeros().min(8)
    };
    for sample in samples {
        *sample /= factor;
    }
    factor
}

/// Returns the largest number of significant bits of the PNG colour channels.
fn significant_bits(bytes: &[u8]) -> Option<Declared> {
    let reader = png::Decoder::new(Cursor::new(bytes)).read_info().ok()?;
    let bits = reader.info().sbit.as_deref()?.iter().copied().max()?;
    Some(Declared::Bits(u32::from(bits)))
}

/// Returns the `maxval` of a PGM or PPM file.
fn pnm_highest(bytes: &[u8]) -> image::ImageResult<u16> {
    let (_, header) = PnmDecoder::new(Cursor::new(bytes))?.into_inner();
    Ok(header.maximal_sample().min(u32::from(u16::MAX)) as u16)
}

/// Returns the saturation count: the count of a plateau if there is one, otherwise the end of the
/// scale.
fn saturation(counts: &Counts, full: u16, declared: Option<Declared>) -> u16 {
    let top = counts.by_column().iter().max().copied().unwrap_or(0);
    if is_plateau(counts, top) {
        return top;
    }
    match declared {
        // The counts may be in the lower or the upper bits.
        Some(Declared::Bits(bits)) if full == u16::MAX && (1..16).contains(&bits) => {
            let highest = u16::MAX >> (16 - bits);
            if top <= highest {
                highest
            } else {
                highest << (16 - bits)
            }
        }
        _ if is_end_of_scale(top) => top,
        _ => full,
    }
}

/// Smallest bit depth of a camera.
const FEWEST_BITS: u32 = 8;

/// Whether a count is the maximum of 8 to 16 bits, stored in the lower or the upper bits of 16.
fn is_end_of_scale(top: u16) -> bool {
    let ones = top.count_ones();
    ones >= FEWEST_BITS && (ones == top.trailing_ones() || ones == top.leading_ones())
}

/// Whether the light of an image is clipped at its highest count, `top`. Either of two signs is
/// sufficient, and neither occurs in unclipped lines:
///
/// - a flat top with steep sides, in any column;
/// - far more pixels at `top` than at the next lower counts.
fn is_plateau(counts: &Counts, top: u16) -> bool {
    let mut times = vec![0u64; usize::from(top) + 1];
    for &count in counts.by_column() {
        times[usize::from(count)] += 1;
    }
    let mut occurring = (0..=top).rev().filter(|&c| times[usize::from(c)] > 0);
    // Counts that were scaled to 16 bits have gaps. The smallest difference is one camera count.
    let steps = occurring.clone().zip(occurring.clone().skip(1));
    let step = steps.map(|(upper, lower)| upper - lower).min().unwrap_or(1);
    let is_flat = |column: usize| has_flat_top(counts.column(column), top, step);
    if (0..counts.columns()).any(is_flat) {
        return true;
    }
    // Pixels of a smooth top within k counts of its height are within a distance proportional to
    // √k. The highest count therefore has at most 1/(√4 − 1) of the pixels of the next three
    // counts. Noise lowers this ratio. The factor of two and the ten extra pixels exclude random
    // exceedance.
    let at_top = occurring.next().map_or(0, |c| times[usize::from(c)]);
    let next: u64 = occurring.take(3).map(|c| times[usize::from(c)]).sum();
    next > 0 && at_top > 2 * next + 10
}

/// Whether a column has at least three consecutive pixels of count `top`, with sides too steep for
/// a rounded parabola.
///
/// Let n pixels of a parabola y = c·x² round to one count, so they differ by at most one step. The
/// pixel nearest to the vertex is within 1/2 of it, which implies c·(((n − 1)/2)² − 1/4) ≤ 1 step.
/// The nearer of the two adjacent pixels is within (n + 1)/2 of the vertex, and rounding adds at
/// most one step. It is therefore lower by at most (n + 1)²/(n·(n − 2)) + 1 steps.
fn has_flat_top(column: &[u16], top: u16, step: u16) -> bool {
    let mut row = 0;
    column.chunk_by(|a, b| a == b).any(|run| {
        let (start, n) = (row, run.len());
        row += n;
        if run[0] != top || n < 3 || start == 0 || row == column.len() {
            return false;
        }
        let drop = top - column[start - 1].max(column[row]);
        let n = n as f64;
        let smooth = (n + 1.0).powi(2) / (n * (n - 2.0)) + 1.0;
        f64::from(drop) > smooth * f64::from(step)
    })
}

/// Heights of the windows in which [`compressed_plateau`] searches, counts. JPEG compression at
/// qualities of 75 to 95 spreads a plateau over 6 to 27 counts.
const PLATEAU_WINDOWS: [u16; 3] = [8, 16, 32];

/// Smallest excess of plateau pixels in units of its standard deviation. An unclipped image exceeds
/// it in one of the three windows with a probability of at most 3·exp(−4²/2) = 10⁻³.
const PLATEAU_EXCESS: f64 = 4.0;

/// Columns of a JPEG block. Compression errors of different blocks are independent.
const JPEG_BLOCK: usize = 8;

/// Returns the lowest count of a plateau that compression has spread over several counts.
///
/// Let n pixels of a column lie less than w counts below the highest count of the image, and m more
/// less than 4·w. A parabola has twice the width at 4·w that it has at w, so n ≤ 2·m for n ≥ 3 and
/// any position in the pixel raster (n ≤ m on average over positions). A Gaussian line widens more
/// than a parabola, and a line below the highest count more than one that reaches it. The sides of
/// a clipped line are steeper.
///
/// The sum of n − 2·m over the columns is compared with the root of the sum of squares over blocks.
/// For a sum of B independent symmetric terms, this ratio exceeds x with a probability of at most
/// exp(−x²/2) (Efron 1969). It is at most √B, so images need at least 17 blocks of eight columns.
fn compressed_plateau(counts: &Counts) -> Option<u16> {
    let top = counts.by_column().iter().max().copied()?;
    let is_clipped = |window: u16| {
        let (mut sum, mut squares) = (0.0, 0.0);
        for start in (0..counts.columns()).step_by(JPEG_BLOCK) {
            let columns = start..(start + JPEG_BLOCK).min(counts.columns());
            let excess: f64 = columns
                .map(|column| plateau_excess(counts.column(column), top, window))
                .sum();
            sum += excess;
            squares += excess * excess;
        }
        sum > PLATEAU_EXCESS * f64::sqrt(squares)
    };
    // A window that includes dark pixels describes no line.
    let mut windows = PLATEAU_WINDOWS.into_iter().filter(|w| 4 * w < top);
    let window = windows.find(|&window| is_clipped(window))?;
    Some(top - window + 1)
}

/// Returns n − 2·m of a column for the longest run of at least three pixels within `window` below
/// `top`, and 0 for a column without such a run.
fn plateau_excess(column: &[u16], top: u16, window: u16) -> f64 {
    let is_high = |count: &u16| *count > top - window;
    let is_side = |count: &&u16| **count > top - 4 * window;
    let mut row = 0;
    let runs = column.chunk_by(|a, b| is_high(a) == is_high(b)).map(|run| {
        row += run.len();
        (row - run.len(), run)
    });
    let plateaus = runs.filter(|(_, run)| run.len() >= 3 && is_high(&run[0]));
    let Some((start, run)) = plateaus.max_by_key(|(_, run)| run.len()) else {
        return 0.0;
    };
    let above = column[..start].iter().rev().take_while(is_side).count();
    let below = column[start + run.len()..].iter().take_while(is_side);
    run.len() as f64 - 2.0 * (above + below.count()) as f64
}
