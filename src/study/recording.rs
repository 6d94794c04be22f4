//! Height maps and images of a line recorded by a sensor, described by a recording file.

use super::image_file::{Channel, decode};
use super::peak_image::{GreyImage, LineAlong, read_image};
use crate::error::input_file::{self, LARGEST_DATA};
use crate::error::{self, Error, InputError, Place};
use crate::inspect::HeightMap;
use crate::run::recipe::TomlFile;
use image::DynamicImage;
use serde::Deserialize;
use std::path::{Path, PathBuf};

const EXPECTED: &str = "a recording: file, z_scale_um, x_step_mm and y_step_mm";
const EXPECTED_IMAGES: &str = "a recording: images, and line_along if the line is vertical";
const FORMATS: &str = "a height map: 16-bit grey PNG or TIFF, CSV or NPY";
/// Memory limit of the image decoder, bytes.
const MOST_BYTES: u64 = 1 << 30;

/// Keys of a recording file.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct RecordingTable {
    file: PathBuf,
    z_scale_um: f64,
    x_step_mm: f64,
    y_step_mm: f64,
    invalid: Option<f64>,
    part: Option<RecordedPart>,
}

/// Keys of a recording file of images.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct ImagesTable {
    images: Vec<PathBuf>,
    line_along: Option<LineAlong>,
}

/// Part of a recording whose shape is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum RecordedPart {
    /// Plane that fills all profiles.
    Plane,
}

/// Content of a recording.
pub enum Recording {
    /// Height map.
    Map {
        path: PathBuf,
        map: HeightMap,
        part: Option<RecordedPart>,
    },
    /// Images of a line in one pose without motion; at least one.
    Images {
        paths: Vec<PathBuf>,
        images: Vec<GreyImage>,
    },
}

/// Reads a recording of a height map or of images.
///
/// # Errors
/// Returns the errors of [`read_recording`], and `Error::Input` for images that cannot be read or
/// differ in size.
pub fn read_any_recording(recording: &Path) -> error::Result<Recording> {
    let (written, table) = TomlFile::read::<toml::Table>(recording, EXPECTED)?;
    if !table.contains_key("images") {
        let (path, map, part) = read_map(recording)?;
        return Ok(Recording::Map { path, map, part });
    }
    let (_, table) = TomlFile::read::<ImagesTable>(recording, EXPECTED_IMAGES)?;
    if table.images.is_empty() {
        let at = written.text.find("images");
        return Err(written.input_error(at, Some("images"), "no files", "one or more images"));
    }
    let along = table.line_along.unwrap_or(LineAlong::Columns);
    let paths: Vec<PathBuf> = table
        .images
        .iter()
        .map(|name| written.sibling_path(name))
        .collect();
    let mut images: Vec<GreyImage> = Vec::new();
    for path in &paths {
        // All images of a recording have the channel of the first one.
        let channel = images.first().and_then(|image| image.channel);
        let image = read_image(path, along, channel.unwrap_or(Channel::Brightest))?;
        let size = |image: &GreyImage| [image.counts.columns(), image.counts.rows()];
        if let Some(first) = images.first().map(size)
            && first != size(&image)
        {
            let [columns, rows] = size(&image);
            let found = format!("{columns} by {rows} pixels");
            let expected = format!("{} by {} pixels, as in the first image", first[0], first[1]);
            return Err(InputError::new(path, Place::File, found, expected).into());
        }
        images.push(image);
    }
    Ok(Recording::Images { paths, images })
}

/// Reads the height map of a recording file. The path of the map is relative to the folder of
/// the recording file. Returns the path of the map and the map.
///
/// # Errors
/// Returns `Error::Input` if a key is missing or unknown, if a step or the scale is not positive
/// and finite, or if the map is not in a supported format or has no valid height.
pub fn read_recording(recording: &Path) -> error::Result<(PathBuf, HeightMap)> {
    read_map(recording).map(|(path, map, _)| (path, map))
}

fn read_map(recording: &Path) -> error::Result<(PathBuf, HeightMap, Option<RecordedPart>)> {
    let (written, table) = TomlFile::read::<RecordingTable>(recording, EXPECTED)?;
    let steps = [
        ("z_scale_um", table.z_scale_um),
        ("x_step_mm", table.x_step_mm),
        ("y_step_mm", table.y_step_mm),
    ];
    for (key, value) in steps {
        if !(value > 0.0 && value < f64::INFINITY) {
            let at = written.text.find(key);
            let expected = "a positive number";
            return Err(written.input_error(at, Some(key), &value.to_string(), expected));
        }
    }
    let folder = recording.parent().unwrap_or(Path::new(""));
    let path = folder.join(&table.file);
    let bytes = input_file::read(&path, LARGEST_DATA, FORMATS)?;
    let is_csv = path
        .extension()
        .is_some_and(|name| name.eq_ignore_ascii_case("csv"));
    let grid = match &bytes[..] {
        [0x93, b'N', b'U', b'M', b'P', b'Y', ..] => of_npy(&bytes).map_err(|found| (None, found)),
        _ if is_csv => of_csv(&bytes),
        _ => of_image(&bytes).map_err(|found| (None, found)),
    };
    let grid = grid.map_err(|(line, found)| {
        let place = line.map_or(Place::File, Place::Line);
        Error::from(InputError::new(&path, place, found, FORMATS))
    })?;
    let invalid = table.invalid.or(grid.is_image.then_some(0.0));
    let height = |value: f64| match Some(value) == invalid || !value.is_finite() {
        true => f64::NAN,
        false => value * table.z_scale_um * 1e-3,
    };
    let heights: Vec<f64> = grid.values.into_iter().map(height).collect();
    if heights.iter().all(|height| height.is_nan()) {
        let found = "no valid height";
        return Err(
            InputError::new(&path, Place::File, found, "heights other than `invalid`").into(),
        );
    }
    let map = HeightMap {
        columns: grid.columns,
        rows: heights.len() / grid.columns,
        x_step: table.x_step_mm,
        y_step: table.y_step_mm,
        heights,
    };
    Ok((path, map, table.part))
}

/// Values of a file, row by row.
struct Grid {
    columns: usize,
    values: Vec<f64>,
    is_image: bool,
}

fn of_image(bytes: &[u8]) -> Result<Grid, String> {
    let (_, image) = decode(bytes, MOST_BYTES)?;
    match image {
        DynamicImage::ImageLuma16(image) => Ok(Grid {
            columns: image.width() as usize,
            values: image.iter().map(|&count| f64::from(count)).collect(),
            is_image: true,
        }),
        other => Err(format!("an image of type {:?}", other.color())),
    }
}

/// Reads rows of numbers; an empty field is a missing height. The error has the line.
fn of_csv(bytes: &[u8]) -> Result<Grid, (Option<usize>, String)> {
    let mut reader = csv::ReaderBuilder::new()
        .has_headers(false)
        .from_reader(bytes);
    let (mut columns, mut values) = (0, Vec::new());
    for record in reader.records() {
        let record = record.map_err(|error| {
            let line = error.position().map(|at| at.line() as usize);
            (line, error.to_string())
        })?;
        let line = record.position().map(|at| at.line() as usize);
        columns = record.len();
        for field in &record {
            let value = match field.trim() {
                "" => Ok(f64::NAN),
                text => text.parse().map_err(|_| (line, format!("{text:?}"))),
            };
            values.push(value?);
        }
    }
    match columns {
        0 => Err((None, "no rows".to_owned())),
        _ => Ok(Grid {
            columns,
            values,
            is_image: false,
        }),
    }
}

/// Reads a two-dimensional array in the NPY format, versions 1 to 3 (NumPy enhancement proposal 1).
fn of_npy(bytes: &[u8]) -> Result<Grid, String> {
    let wide = bytes.get(6).is_some_and(|&major| major > 1);
    let (start, length): (usize, Option<usize>) = match wide {
        false => (
            10,
            bytes
                .get(8..10)
                .map(|b| usize::from(u16::from_le_bytes([b[0], b[1]]))),
        ),
        true => (
            12,
            bytes
                .get(8..12)
                .map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as usize),
        ),
    };
    let header = length.and_then(|length| bytes.get(start..start.checked_add(length)?));
    let header = header.ok_or("an NPY file without a complete header")?;
    let text = std::str::from_utf8(header).map_err(|_| "an NPY header that is not text")?;
    let after = |key: &str| {
        text.split_once(&format!("'{key}':"))
            .map(|(_, rest)| rest.trim_start())
    };
    let kind = after("descr").and_then(|rest| rest.strip_prefix('\'')?.split_once('\''));
    let kind = kind.map_or("", |(kind, _)| kind);
    let shape = after("shape").and_then(|rest| rest.strip_prefix('(')?.split_once(')'));
    let shape: Vec<usize> = shape.map_or(Vec::new(), |(shape, _)| {
        shape
            .split(',')
            .filter_map(|n| n.trim().parse().ok())
            .collect()
    });
    let by_rows = after("fortran_order").is_some_and(|rest| rest.starts_with("False"));
    let &[rows, columns] = &shape[..] else {
        return Err(format!(
            "an array of shape {shape:?}; expected two dimensions"
        ));
    };
    let data = &bytes[start + header.len()..];
    let count = rows
        .checked_mul(columns)
        .filter(|&n| n > 0)
        .ok_or("an empty array")?;
    let values: Option<Vec<f64>> = match kind {
        "<f8" => numbers(data, count, f64::from_le_bytes),
        "<f4" => numbers(data, count, |b| f64::from(f32::from_le_bytes(b))),
        "<u2" => numbers(data, count, |b| f64::from(u16::from_le_bytes(b))),
        "<i2" => numbers(data, count, |b| f64::from(i16::from_le_bytes(b))),
        "<i4" => numbers(data, count, |b| f64::from(i32::from_le_bytes(b))),
        _ => {
            return Err(format!(
                "an array of type {kind:?}; expected <f8, <f4, <u2, <i2 or <i4"
            ));
        }
    };
    let values =
        values.ok_or_else(|| format!("{} bytes of data for {count} numbers", data.len()))?;
    let values = match by_rows {
        true => values,
        false => (0..count)
            .map(|i| values[i % columns * rows + i / columns])
            .collect(),
    };
    Ok(Grid {
        columns,
        values,
        is_image: false,
    })
}

/// Returns `count` numbers of `N` bytes each; `None` if the number of bytes differs.
fn numbers<const N: usize>(data: &[u8], count: usize, of: fn([u8; N]) -> f64) -> Option<Vec<f64>> {
    let (items, rest) = data.as_chunks::<N>();
    (items.len() == count && rest.is_empty()).then(|| items.iter().map(|&b| of(b)).collect())
}
