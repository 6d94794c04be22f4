//! Peak finders applied to an image of a real sensor.

use super::image_file::{Channel, FORMATS, read_channel};
use crate::camera::Counts;
use crate::error::input_file::{self, LARGEST_DATA};
use crate::error::{InputError, Place, Result, printable};
use crate::profile::{Peak, PeakFinder, PeakSettings, find_peaks};
use crate::report::axes::{Axes, Axis, ChartPoint, legend};
use crate::report::picture::encode_for_eyes;
use crate::report::svg::Svg;
use crate::run::output_folder::{Names, OutputFolder};
use crate::run::{RunControl, files};
use serde::{Deserialize, Serialize};
use std::io::Write as _;
use std::path::{Path, PathBuf};

/// Direction of the laser line in an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LineAlong {
    /// Horizontal line: one point in each column.
    Columns,
    /// Vertical line: one point in each row.
    Rows,
}

/// Counts of one channel of an image, transposed if the line is vertical.
#[derive(Debug)]
pub struct GreyImage {
    /// Counts, with the line along the rows.
    pub counts: Counts,
    /// Count at and above which a pixel is saturated.
    pub saturation_dn: u16,
    /// Channel that was read; `None` for a grey image.
    pub channel: Option<Channel>,
    line_along: LineAlong,
}

/// Content of `line.json`.
#[derive(Debug, Serialize)]
pub struct ImageSummary {
    /// Path of the image file.
    #[serde(serialize_with = "printable::in_json")]
    pub image: PathBuf,
    /// Direction of the line.
    pub line_along: LineAlong,
    /// Channel that was read; `None` for a grey image.
    pub channel: Option<Channel>,
    /// Count at and above which a pixel is saturated.
    pub saturation_dn: u16,
    /// Number of evaluated columns, or rows for a vertical line.
    pub columns: usize,
    /// Results of each finder.
    pub finders: Vec<FoundLine>,
    /// Path of the table of points.
    #[serde(serialize_with = "printable::in_json")]
    pub table: PathBuf,
    /// Path of the plot.
    #[serde(serialize_with = "printable::in_json")]
    pub picture: PathBuf,
}

/// Results of one finder.
#[derive(Debug, Serialize)]
pub struct FoundLine {
    /// Peak finder.
    pub finder: PeakFinder,
    /// Number of detected points.
    pub points: usize,
    /// Number of points with a flag.
    pub flagged: usize,
    /// Median over the points of the line's standard deviation, px.
    pub median_sigma_px: f64,
}

/// Reads one channel of an image file (PNG, JPEG, TIFF, BMP or PGM, with 8 or 16 bits). Returns an
/// error if the file is not a regular file or not a supported image.
pub fn read_image(path: &Path, line_along: LineAlong, channel: Channel) -> Result<GreyImage> {
    let bytes = input_file::read(path, LARGEST_DATA, FORMATS)?;
    parse_image(path, &bytes, line_along, channel)
}

/// Reads an image as [`read_image`] does, from bytes in memory; `path` is only used in errors.
pub fn parse_image(
    path: &Path,
    bytes: &[u8],
    line_along: LineAlong,
    channel: Channel,
) -> Result<GreyImage> {
    let read = read_channel(bytes, channel, line_along == LineAlong::Rows);
    let read = read.map_err(|found| InputError::new(path, Place::File, found, FORMATS))?;
    Ok(GreyImage {
        counts: read.counts,
        saturation_dn: read.saturation,
        channel: read.channel,
        line_along,
    })
}

impl GreyImage {
    /// Returns the line found by one finder, the strongest in each column.
    pub fn peaks(&self, finder: PeakFinder) -> Vec<Peak> {
        let settings = PeakSettings {
            finder,
            ..PeakSettings::new(self.saturation_dn)
        };
        find_peaks(&self.counts, &settings)
    }
}

/// Runs all finders on an image. Writes `line.csv`, `line.json` and `line.svg`: the image with the
/// detected line, and the deviations of each finder from it.
pub fn peaks_of_image<'a>(
    path: &Path,
    line_along: LineAlong,
    channel: Channel,
    out: impl Into<OutputFolder<'a>>,
    control: &RunControl,
) -> Result<ImageSummary> {
    let image = read_image(path, line_along, channel)?;
    let names = Names::of(["line.csv", "line.json", "line.svg"]);
    let out = out.into().claim(&[path.to_owned()], &names)?.path;
    let lines = PeakFinder::ALL.map(|finder| (finder, image.peaks(finder)));
    control.check()?;
    let summary = ImageSummary {
        image: path.to_owned(),
        line_along,
        channel: image.channel,
        saturation_dn: image.saturation_dn,
        columns: image.counts.columns(),
        finders: lines.iter().map(|(f, peaks)| found(*f, peaks)).collect(),
        table: out.join("line.csv"),
        picture: out.join("line.svg"),
    };
    files::write(&summary.table, |file| {
        writeln!(
            file,
            "finder,column,row_px,intensity_dn,line_sigma_px,flags"
        )?;
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

const FOUND: &str = "fill='#ff5040'";
const VALID: &str = "fill='#2471a3'";
const FLAGGED: &str = "fill='#d55e00'";
/// Left edge and width of all panels, px. On a page of this width, text of 12 px is readable.
const SIDES: [f64; 2] = [75.0, 800.0];
/// Maximum height of the image, px.
const TALLEST: f64 = 700.0;
const PANEL: f64 = 110.0;
const BETWEEN: f64 = 80.0;

/// Plots the image in its original orientation with the median row of the finders. Panels below it
/// show the deviations of each finder from the median.
fn overlay(image: &GreyImage, lines: &[(PeakFinder, Vec<Peak>)]) -> String {
    let (columns, rows) = (image.counts.columns(), image.counts.rows());
    let png = encode_for_eyes(&image.counts.to_rows(), columns, image.saturation_dn);
    let (size, turn, along) = match image.line_along {
        LineAlong::Columns => ([columns as f64, rows as f64], "", "column"),
        LineAlong::Rows => ([rows as f64, columns as f64], "matrix(0 1 1 0 0 0)", "row"),
    };
    let scale = (SIDES[1] / size[0]).min(TALLEST / size[1]);
    let medians = median_rows(columns, lines);
    let below = 50.0 + scale * size[1];
    let height = below + (PANEL + BETWEEN) * lines.len() as f64 + 40.0;
    let mut svg = Svg::file([SIDES[0] + SIDES[1] + 25.0, height], 12.0);
    legend(
        &mut svg,
        [SIDES[0], 25.0],
        [0.0; 2],
        &[(ChartPoint::Dot, FOUND, "median of the finders")],
    );
    let style = format!(
        "transform='translate({} 40) scale({scale}) {turn}'",
        SIDES[0]
    );
    svg.group(&style, "", |svg| {
        svg.image([0.0, 0.0, columns as f64, rows as f64], &png);
        for (column, row) in medians.iter().enumerate() {
            if let Some(row) = row {
                svg.circle([column as f64 + 0.5, *row], 0.8 / scale, FOUND);
            }
        }
    });
    panels(&mut svg, (along, below + 40.0), lines, &medians);
    let marks = [
        (ChartPoint::Dot, VALID, "point"),
        (ChartPoint::Dot, FLAGGED, "flagged point"),
    ];
    legend(&mut svg, [SIDES[0], height - 15.0], [110.0, 0.0], &marks);
    svg.finish()
}

/// Plots a panel for each finder, from `top` downwards, with the deviations of its points from the
/// median.
fn panels(
    svg: &mut Svg,
    (along, top): (&str, f64),
    lines: &[(PeakFinder, Vec<Peak>)],
    medians: &[Option<f64>],
) {
    let from_median = |peak: &Peak| medians[peak.column as usize].map(|row| peak.row - row);
    let mut off: Vec<f64> = (lines.iter().flat_map(|(_, peaks)| peaks))
        .filter_map(|peak| from_median(peak).map(f64::abs))
        .collect();
    off.sort_by(f64::total_cmp);
    // The axis covers 98 % of the points. Outliers are plotted at the end of the axis.
    let reach = 1.3
        * off
            .get(off.len() * 98 / 100)
            .copied()
            .unwrap_or(0.0)
            .max(0.02);
    for (k, (finder, peaks)) in lines.iter().enumerate() {
        let flagged = peaks.iter().filter(|peak| !peak.flags.is_empty()).count();
        let title = format!(
            "{}: {} points, {flagged} of them flagged",
            name(*finder),
            peaks.len()
        );
        let axes = Axes {
            frame: [
                SIDES[0],
                top + (PANEL + BETWEEN) * k as f64,
                SIDES[1],
                PANEL,
            ],
            beyond: [0.0; 2],
            title: &title,
            x: Axis::linear(along, [0.0, medians.len() as f64]),
            y: Axis::linear("from median, px", [-reach, reach]),
        };
        axes.draw(svg);
        for peak in peaks {
            if let Some(off) = from_median(peak) {
                let style = if peak.flags.is_empty() {
                    VALID
                } else {
                    FLAGGED
                };
                svg.circle(axes.at(f64::from(peak.column) + 0.5, off), 1.3, style);
            }
        }
    }
}

/// Returns the median row of the finders in each column.
fn median_rows(columns: usize, lines: &[(PeakFinder, Vec<Peak>)]) -> Vec<Option<f64>> {
    let mut rows = vec![Vec::new(); columns];
    for peak in lines.iter().flat_map(|(_, peaks)| peaks) {
        rows[peak.column as usize].push(peak.row);
    }
    let median = |mut rows: Vec<f64>| {
        rows.sort_by(f64::total_cmp);
        let last = rows.len().checked_sub(1)?;
        Some((rows[last / 2] + rows[rows.len() / 2]) / 2.0)
    };
    rows.into_iter().map(median).collect()
}
