//! The finders of the laser line on an image of a real sensor.

use crate::camera::Counts;
use crate::error::input_file::{self, LARGEST_DATA};
use crate::error::{Error, InputError, Place, Result, printable};
use crate::profile::{Peak, PeakFinder, PeakSettings, find_peaks};
use crate::report::picture::encode_for_eyes;
use crate::report::svg::Svg;
use crate::run::output_folder::{Names, OutputFolder};
use crate::run::{Control, files};
use png::{BitDepth, Transformations};
use serde::Serialize;
use std::io::{Cursor, Write as _};
use std::path::{Path, PathBuf};

/// Which way the laser line runs in an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum LineAlong {
    /// From side to side: one point in each column.
    Columns,
    /// From top to bottom: one point in each row.
    Rows,
}

/// Counts of an image; transposed where the line runs along rows.
#[derive(Debug)]
pub struct GreyImage {
    /// With the line along the rows of this.
    pub counts: Counts,
    /// Highest count of the format.
    pub max_count: u16,
    line_along: LineAlong,
}

/// `line.json`.
#[derive(Debug, Serialize)]
pub struct ImageSummary {
    /// The image file.
    #[serde(serialize_with = "printable::in_json")]
    pub image: PathBuf,
    /// How the line runs.
    pub line_along: LineAlong,
    /// Columns in which a line was looked for; rows if it runs along these.
    pub columns: usize,
    /// One for each finder.
    pub finders: Vec<FoundLine>,
    /// Where the table of points was written.
    #[serde(serialize_with = "printable::in_json")]
    pub table: PathBuf,
    /// Where the picture was written.
    #[serde(serialize_with = "printable::in_json")]
    pub picture: PathBuf,
}

/// What one finder found.
#[derive(Debug, Serialize)]
pub struct FoundLine {
    /// Which one.
    pub finder: PeakFinder,
    /// Points it found.
    pub points: usize,
    /// Points with a flag.
    pub flagged: usize,
    /// Median standard deviation of the line across its length.
    pub median_sigma_px: f64,
}

const IMAGE: &str = "an image (PNG)";

/// Reads a PNG of 8 or 16 bits; of colours, their luminance. Errors: no regular
/// file, no such PNG.
pub fn read_image(path: &Path, line_along: LineAlong) -> Result<GreyImage> {
    let bytes = input_file::read(path, LARGEST_DATA, IMAGE)?;
    parse_image(path, &bytes, line_along)
}

fn wrong(path: &Path, found: String) -> Error {
    InputError::new(path, Place::File, found, IMAGE).into()
}

/// `read_image` for bytes already in memory; `path` only names them in errors.
pub fn parse_image(path: &Path, bytes: &[u8], line_along: LineAlong) -> Result<GreyImage> {
    let (counts, max_count) = decode(bytes).map_err(|found| wrong(path, found))?;
    let counts = match line_along {
        LineAlong::Columns => counts,
        LineAlong::Rows => Counts::of_rows(counts.by_column(), counts.rows()),
    };
    Ok(GreyImage {
        counts,
        max_count,
        line_along,
    })
}

/// Most bytes of an image in memory.
const MOST_BYTES: usize = 1 << 29;

/// Counts and the format's highest, or what was found in place of a PNG.
fn decode(bytes: &[u8]) -> std::result::Result<(Counts, u16), String> {
    let mut decoder = png::Decoder::new(Cursor::new(bytes));
    // Palettes as their colours, fewer bits than eight as eight.
    decoder.set_transformations(Transformations::EXPAND);
    let mut reader = decoder.read_info().map_err(|error| error.to_string())?;
    let size = reader.output_buffer_size();
    let size = size.filter(|&size| size <= MOST_BYTES);
    let mut samples = vec![0; size.ok_or("an image of more than 512 MiB")?];
    let frame = reader.next_frame(&mut samples);
    let frame = frame.map_err(|error| error.to_string())?;
    samples.truncate(frame.buffer_size());
    let (values, max_count): (Vec<u16>, u16) = match frame.bit_depth {
        BitDepth::Sixteen => {
            let pairs = samples.chunks_exact(2);
            (
                pairs.map(|p| u16::from_be_bytes([p[0], p[1]])).collect(),
                u16::MAX,
            )
        }
        _ => (samples.into_iter().map(u16::from).collect(), 255),
    };
    // Without what is transparent; of colours the luminance (ITU-R BT.709).
    let grey = |pixel: &[u16]| match *pixel {
        [red, green, blue, ..] => {
            let [red, green, blue] = [red, green, blue].map(u32::from);
            ((2126 * red + 7152 * green + 722 * blue) / 10_000) as u16
        }
        _ => pixel[0],
    };
    let pixels = values.chunks_exact(frame.color_type.samples());
    let counts: Vec<u16> = pixels.map(grey).collect();
    Ok((Counts::of_rows(&counts, frame.width as usize), max_count))
}

impl GreyImage {
    /// The line by one finder, the strongest in each column.
    pub fn peaks(&self, finder: PeakFinder) -> Vec<Peak> {
        let settings = PeakSettings {
            finder,
            ..PeakSettings::new(self.max_count)
        };
        find_peaks(&self.counts, &settings)
    }
}

/// Runs all finders on an image; writes `line.csv`, `line.json` and `line.svg`, the
/// image with what they found over it.
pub fn peaks_of_image<'a>(
    path: &Path,
    line_along: LineAlong,
    out: impl Into<OutputFolder<'a>>,
    control: &Control,
) -> Result<ImageSummary> {
    let image = read_image(path, line_along)?;
    let names = Names::of(["line.csv", "line.json", "line.svg"]);
    let out = out.into().claim(&[path.to_owned()], &names)?.path;
    let lines = PeakFinder::ALL.map(|finder| (finder, image.peaks(finder)));
    control.check()?;
    let summary = ImageSummary {
        image: path.to_owned(),
        line_along,
        columns: image.counts.columns(),
        finders: lines.iter().map(|(f, peaks)| found(*f, peaks)).collect(),
        table: out.join("line.csv"),
        picture: out.join("line.svg"),
    };
    files::write(&summary.table, |file| {
        writeln!(file, "finder,column,row_px,intensity_dn,width_px,flags")?;
        for (finder, peaks) in &lines {
            for p in peaks {
                let (name, flags) = (name(*finder), p.flags);
                let numbers = format!("{:.4},{:.1},{:.3}", p.row, p.intensity, p.sigma);
                writeln!(file, "{name},{},{numbers},{flags}", p.column)?;
            }
        }
        Ok(())
    })?;
    files::write_bytes(&summary.picture, overlay(&image, &lines).as_bytes())?;
    files::write_json(&out.join("line.json"), &summary)?;
    Ok(summary)
}

fn found(finder: PeakFinder, peaks: &[Peak]) -> FoundLine {
    let mut sigmas: Vec<f64> = peaks.iter().map(|p| p.sigma).collect();
    sigmas.sort_by(f64::total_cmp);
    FoundLine {
        finder,
        points: peaks.len(),
        flagged: peaks.iter().filter(|p| !p.flags.is_empty()).count(),
        median_sigma_px: sigmas.get(sigmas.len() / 2).copied().unwrap_or(0.0),
    }
}

fn name(finder: PeakFinder) -> String {
    let value = serde_json::to_value(finder).expect("a name");
    value.as_str().expect("a name").to_owned()
}

const COLORS: [&str; 4] = ["#ff5040", "#40a0ff", "#30d060", "#ffc000"];

/// The image for people as it was, and above it each finder's points.
fn overlay(image: &GreyImage, lines: &[(PeakFinder, Vec<Peak>)]) -> String {
    let (columns, rows) = (image.counts.columns(), image.counts.rows());
    let png = encode_for_eyes(&image.counts.to_rows(), columns, image.max_count);
    let (width, height, turn) = match image.line_along {
        LineAlong::Columns => (columns as f64, rows as f64, ""),
        LineAlong::Rows => (rows as f64, columns as f64, "matrix(0 1 1 0 0 0)"),
    };
    let size = width / 60.0;
    let head = 3.0 * size;
    let mut svg = Svg::file([width, height + head], size);
    for (k, (finder, peaks)) in lines.iter().enumerate() {
        let x = size * (1.0 + 14.0 * k as f64);
        let fill = format!("fill='{}'", COLORS[k]);
        svg.circle([x, head - 1.5 * size], size / 3.0, &fill);
        let label = format!("{}: {} points", name(*finder), peaks.len());
        svg.text([x + size * 0.7, head - 1.15 * size], "", &label);
    }
    svg.group(
        &format!("transform='translate(0 {head}) {turn}'"),
        "",
        |svg| {
            svg.image([0.0, 0.0, columns as f64, rows as f64], &png);
            for ((_, peaks), color) in lines.iter().zip(COLORS) {
                svg.group(&format!("fill='{color}'"), "", |svg| {
                    for p in peaks {
                        svg.circle([p.column as f64 + 0.5, p.row], width / 900.0, "");
                    }
                });
            }
        },
    );
    svg.finish()
}
