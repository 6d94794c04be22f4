//! Height maps and images of a line recorded by a sensor, described by a recording file.

use super::image_file::{Channel, decode};
use super::peak_image::{GreyImage, LineAlong, read_image};
use super::round::Profile;
use crate::error::input_file::{self, LARGEST_DATA};
use crate::error::{self, Error, InputError, Place};
use crate::inspect::HeightMap;
use crate::math::{Aabb, DVec3};
use crate::mesh::points_of_ply;
use crate::run::recipe::TomlFile;
use image::DynamicImage;
use serde::Deserialize;
use std::path::{Path, PathBuf};

const EXPECTED: &str = "a recording: file, z_scale_um, x_step_mm and y_step_mm, or images";
const FORMATS: &str =
    "a height map: 16-bit grey PNG or TIFF, CSV, NPY, or the points of a PLY file";
/// Largest number of cells of a grid of points, per point.
const MOST_CELLS_PER_POINT: f64 = 100.0;
/// Memory limit of the image decoder, bytes.
const MOST_BYTES: u64 = 1 << 30;

/// Keys of a recording file: those of a height map, or `images` and `line_along`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct RecordingTable {
    file: Option<PathBuf>,
    z_scale_um: Option<f64>,
    x_step_mm: Option<f64>,
    y_step_mm: Option<f64>,
    invalid: Option<f64>,
    part: Option<RecordedPart>,
    columns: Option<[usize; 2]>,
    profiles: Option<[usize; 2]>,
    min_z_mm: Option<f64>,
    images: Option<Vec<PathBuf>>,
    line_along: Option<LineAlong>,
}

/// Part of a recording whose shape is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum RecordedPart {
    /// Plane that fills all profiles.
    Plane,
    /// Cylinder whose axis is the direction of motion.
    Cylinder,
    /// Sphere.
    Sphere,
    /// Step across the profiles: two planes with an edge along the direction of motion.
    Step,
}

/// Height map of a recording.
#[derive(Debug)]
pub struct RecordedMap {
    /// Path of the map.
    pub path: PathBuf,
    /// Heights in the region that the recording names.
    pub map: HeightMap,
    /// Shape of the part; `None` for any surface.
    pub part: Option<RecordedPart>,
}

impl RecordedMap {
    /// Returns the profiles: x along the profile, y along the motion, z upwards.
    pub fn profiles(&self) -> Vec<Profile> {
        let map = &self.map;
        let profile = |(y, heights): (usize, &[f64])| {
            let point = |(x, &z): (usize, &f64)| {
                let position = DVec3::new(x as f64 * map.x_step, y as f64 * map.y_step, z);
                (x as i64, position)
            };
            let points = heights.iter().enumerate().map(point);
            points.filter(|(_, p)| p.z.is_finite()).collect()
        };
        map.heights
            .chunks(map.columns)
            .enumerate()
            .map(profile)
            .collect()
    }
}

/// Images of a line in one pose without motion; at least one.
#[derive(Debug)]
pub struct RecordedImages {
    /// Paths of the images.
    pub paths: Vec<PathBuf>,
    /// Images in the order of the paths.
    pub images: Vec<GreyImage>,
}

/// Content of a recording.
#[derive(Debug)]
pub enum Recording {
    /// Height map.
    Map(RecordedMap),
    /// Images of a line.
    Images(RecordedImages),
}

impl Recording {
    /// Reads a recording. Paths are relative to the folder of the recording file.
    ///
    /// # Errors
    /// Returns `Error::Input` if a key is missing, unknown or out of range, if a file is not in a
    /// supported format or has no valid height, and if images differ in size.
    pub fn read(recording: &Path) -> error::Result<Recording> {
        let (written, table) = TomlFile::read::<RecordingTable>(recording, EXPECTED)?;
        let of_map = [
            ("file", table.file.is_some()),
            ("z_scale_um", table.z_scale_um.is_some()),
            ("x_step_mm", table.x_step_mm.is_some()),
            ("y_step_mm", table.y_step_mm.is_some()),
            ("invalid", table.invalid.is_some()),
            ("part", table.part.is_some()),
            ("columns", table.columns.is_some()),
            ("profiles", table.profiles.is_some()),
            ("min_z_mm", table.min_z_mm.is_some()),
        ];
        let (has_images, along) = (table.images.is_some(), table.line_along.is_some());
        if let Some((key, _)) = of_map.iter().find(|(_, given)| has_images && *given) {
            let found = "a key of height maps";
            let expected = "a recording of images has images and line_along";
            return Err(written.input_error(written.text.find(key), Some(key), found, expected));
        }
        if along && !has_images {
            let (at, found) = (written.text.find("line_along"), "a key of images");
            return Err(written.input_error(at, Some("line_along"), found, EXPECTED));
        }
        match has_images {
            true => read_images(&written, table).map(Recording::Images),
            false => read_map(&written, table).map(Recording::Map),
        }
    }

    /// Returns the paths of the recorded files.
    pub fn paths(&self) -> &[PathBuf] {
        match self {
            Recording::Map(map) => std::slice::from_ref(&map.path),
            Recording::Images(images) => &images.paths,
        }
    }
}

fn read_images(written: &TomlFile, table: RecordingTable) -> error::Result<RecordedImages> {
    let names = table.images.unwrap_or_default();
    if names.is_empty() {
        let at = written.text.find("images");
        return Err(written.input_error(at, Some("images"), "no files", "one or more images"));
    }
    let along = table.line_along.unwrap_or(LineAlong::Columns);
    let paths: Vec<PathBuf> = names
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
    Ok(RecordedImages { paths, images })
}

fn read_map(written: &TomlFile, table: RecordingTable) -> error::Result<RecordedMap> {
    let missing = |key: &str| written.input_error(None, Some(key), "no value", EXPECTED);
    let positive = |key: &str, value: Option<f64>| {
        let value = value.ok_or_else(|| missing(key))?;
        match value > 0.0 && value < f64::INFINITY {
            true => Ok(value),
            false => {
                let (at, found) = (written.text.find(key), value.to_string());
                Err(written.input_error(at, Some(key), &found, "a positive number"))
            }
        }
    };
    let file = table.file.as_ref().ok_or_else(|| missing("file"))?;
    let z_scale = 1e-3 * positive("z_scale_um", table.z_scale_um)?;
    let x_step = positive("x_step_mm", table.x_step_mm)?;
    let y_step = positive("y_step_mm", table.y_step_mm)?;
    let path = written.sibling_path(file);
    let grid = read_grid(&path, [x_step, y_step].map(|step| step / z_scale))?;
    let invalid = table.invalid.or(grid.is_image.then_some(0.0));
    let height = |value: f64| match Some(value) == invalid || !value.is_finite() {
        true => f64::NAN,
        false => value * z_scale,
    };
    let rows = grid.values.len() / grid.columns;
    let region = |key: &str, range: Option<[usize; 2]>, size: usize| match range {
        None => Ok(0..size),
        Some([first, last]) if first <= last && last < size => Ok(first..last + 1),
        Some([first, last]) => {
            let expected = format!("first and last index, 0 to {}", size - 1);
            let found = format!("[{first}, {last}]");
            Err(written.input_error(written.text.find(key), Some(key), &found, &expected))
        }
    };
    let columns = region("columns", table.columns, grid.columns)?;
    let profiles = region("profiles", table.profiles, rows)?;
    let lowest = table.min_z_mm.unwrap_or(f64::NEG_INFINITY);
    let at = |y: usize, x: usize| {
        let z = height(grid.values[y * grid.columns + x]);
        if z < lowest { f64::NAN } else { z }
    };
    let points = profiles
        .clone()
        .flat_map(|y| columns.clone().map(move |x| (y, x)));
    let heights: Vec<f64> = points.map(|(y, x)| at(y, x)).collect();
    if heights.iter().all(|height| height.is_nan()) {
        let expected = "heights in the region of the recording other than `invalid`";
        return Err(InputError::new(&path, Place::File, "no valid height", expected).into());
    }
    let map = HeightMap {
        columns: columns.len(),
        rows: profiles.len(),
        x_step,
        y_step,
        heights,
    };
    Ok(RecordedMap {
        path,
        map,
        part: table.part,
    })
}

/// Reads a map. `steps` are the distances of points and profiles in the unit of a PLY file.
fn read_grid(path: &Path, steps: [f64; 2]) -> error::Result<Grid> {
    let bytes = input_file::read(path, LARGEST_DATA, FORMATS)?;
    if bytes.starts_with(b"ply") {
        let grid = of_points(&points_of_ply(path, &bytes)?, steps);
        return grid.map_err(|found| InputError::new(path, Place::File, found, FORMATS).into());
    }
    let is_csv = path
        .extension()
        .is_some_and(|name| name.eq_ignore_ascii_case("csv"));
    let grid = match &bytes[..] {
        [0x93, b'N', b'U', b'M', b'P', b'Y', ..] => of_npy(&bytes).map_err(|found| (None, found)),
        _ if is_csv => of_csv(&bytes),
        _ => of_image(&bytes).map_err(|found| (None, found)),
    };
    grid.map_err(|(line, found)| {
        let place = line.map_or(Place::File, Place::Line);
        Error::from(InputError::new(path, place, found, FORMATS))
    })
}

/// Values of a file, row by row.
struct Grid {
    columns: usize,
    values: Vec<f64>,
    is_image: bool,
}

/// Sorts points into a grid with the given steps of x and y. A height is the mean of the points of
/// its cell.
fn of_points(points: &[DVec3], [x_step, y_step]: [f64; 2]) -> Result<Grid, String> {
    let valid = || points.iter().filter(|point| point.is_finite());
    let bounds = Aabb::of(valid().copied());
    let steps = DVec3::new(x_step, y_step, 1.0);
    let size = (bounds.size() / steps).round();
    // The number of cells is limited, as a wrong step or an outlier would fill the memory.
    let cells = (size.x + 1.0) * (size.y + 1.0);
    let most = MOST_CELLS_PER_POINT * points.len() as f64;
    if !(size.x >= 0.0 && cells <= most) {
        return Err(format!(
            "{} points in {cells} cells of x_step_mm by y_step_mm",
            points.len()
        ));
    }
    let (columns, rows) = (size.x as usize + 1, size.y as usize + 1);
    let mut sums = vec![[0.0, 0.0]; columns * rows];
    for &point in valid() {
        let at = ((point - bounds.min) / steps).round();
        let cell = &mut sums[at.y as usize * columns + at.x as usize];
        *cell = [cell[0] + point.z, cell[1] + 1.0];
    }
    Ok(Grid {
        columns,
        // 0/0 of an empty cell is NaN, a missing height.
        values: sums.into_iter().map(|[sum, count]| sum / count).collect(),
        is_image: false,
    })
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
