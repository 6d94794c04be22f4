//! Lists of poses from robots and tracking systems, as text with separators.
//!
//! Column names define units and conventions. They are in the header, or in `scan.poses_columns`
//! for a file without a header.

use crate::error::{Error, InputError, Place, Result};
use crate::math::{DMat3, DVec3, Rigid};
use crate::mesh::MAX_COORDINATE_MM;
use csv::{ErrorKind, ReaderBuilder, StringRecord, Trim};
use glam::DQuat;
use std::fmt;
use std::path::Path;

/// Quantity of a column.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum PoseQuantity {
    Time,
    /// Coordinate along x, y or z.
    Position(usize),
    /// Rotation about the fixed x, y or z axis, in this order.
    Fixed(usize),
    /// Rotation A about z, B about the new y, C about the new x.
    Abc(usize),
    /// Component x, y, z or w.
    Quaternion(usize),
    Ignored,
}

/// Column names, their quantities, and the factors that convert to seconds, millimetres and
/// degrees.
const COLUMNS: [(&str, PoseQuantity, f64); 19] = [
    ("time_s", PoseQuantity::Time, 1.0),
    ("time_ms", PoseQuantity::Time, 1e-3),
    ("x_mm", PoseQuantity::Position(0), 1.0),
    ("y_mm", PoseQuantity::Position(1), 1.0),
    ("z_mm", PoseQuantity::Position(2), 1.0),
    ("x_m", PoseQuantity::Position(0), 1e3),
    ("y_m", PoseQuantity::Position(1), 1e3),
    ("z_m", PoseQuantity::Position(2), 1e3),
    ("rx_deg", PoseQuantity::Fixed(0), 1.0),
    ("ry_deg", PoseQuantity::Fixed(1), 1.0),
    ("rz_deg", PoseQuantity::Fixed(2), 1.0),
    ("a_deg", PoseQuantity::Abc(0), 1.0),
    ("b_deg", PoseQuantity::Abc(1), 1.0),
    ("c_deg", PoseQuantity::Abc(2), 1.0),
    ("qx", PoseQuantity::Quaternion(0), 1.0),
    ("qy", PoseQuantity::Quaternion(1), 1.0),
    ("qz", PoseQuantity::Quaternion(2), 1.0),
    ("qw", PoseQuantity::Quaternion(3), 1.0),
    ("-", PoseQuantity::Ignored, 1.0),
];

/// Description of the expected columns, for error messages.
pub(super) const EXPECTED_COLUMNS: &str = "x_mm,y_mm,z_mm or x_m,y_m,z_m; then rx_deg,ry_deg,rz_deg \
     (about fixed axes), a_deg,b_deg,c_deg (about z, y', x'') or qx,qy,qz,qw; and time_s or time_ms if there \
     are times";

/// Name, quantity and factor of every column of a list.
#[derive(Debug)]
pub(super) struct Layout(Vec<(&'static str, PoseQuantity, f64)>);

impl Layout {
    /// Returns the layout of columns with these names. The error describes the mistake in the
    /// names.
    pub(super) fn of<'a>(
        names: impl IntoIterator<Item = &'a str>,
    ) -> std::result::Result<Layout, String> {
        let known = |name: &str| COLUMNS.into_iter().find(|column| column.0 == name);
        let columns = names
            .into_iter()
            .map(|name| known(name).ok_or_else(|| format!("the unknown column {name:?}")))
            .collect::<std::result::Result<Vec<_>, _>>()?;
        let layout = Layout(columns);
        for (i, column) in layout.0.iter().enumerate() {
            let again = |other: &&(_, PoseQuantity, _)| other.1 == column.1;
            if column.1 != PoseQuantity::Ignored && layout.0[..i].iter().any(|other| again(&other))
            {
                return Err(format!("{} a second time", column.0));
            }
        }
        let mut scales = layout
            .0
            .iter()
            .filter(|c| matches!(c.1, PoseQuantity::Position(_)));
        if let Some(first) = scales.next()
            && let Some(other) = scales.find(|other| other.2 != first.2)
        {
            return Err(format!("{} and {}, of two units", first.0, other.0));
        }
        layout.require("positions", 3, |q| matches!(q, PoseQuantity::Position(_)))?;
        let is_fixed = |q| matches!(q, PoseQuantity::Fixed(_));
        let is_abc = |q| matches!(q, PoseQuantity::Abc(_));
        let is_quaternion = |q| matches!(q, PoseQuantity::Quaternion(_));
        let kinds = [
            layout.any(is_fixed),
            layout.any(is_abc),
            layout.any(is_quaternion),
        ];
        match kinds.iter().filter(|&&kind| kind).count() {
            0 => return Err("no rotation".to_owned()),
            1 => {}
            _ => return Err("two kinds of rotation".to_owned()),
        }
        match kinds {
            [true, ..] => layout.require("angles", 3, is_fixed)?,
            [_, true, _] => layout.require("angles", 3, is_abc)?,
            _ => layout.require("parts of a quaternion", 4, is_quaternion)?,
        }
        Ok(layout)
    }

    fn any(&self, is: impl Fn(PoseQuantity) -> bool) -> bool {
        self.0.iter().any(|column| is(column.1))
    }

    fn require(
        &self,
        what: &str,
        count: usize,
        is: impl Fn(PoseQuantity) -> bool,
    ) -> std::result::Result<(), String> {
        let found = self.0.iter().filter(|column| is(column.1)).count();
        match found == count {
            true => Ok(()),
            false => Err(format!("{found} of {count} {what}")),
        }
    }

    fn has_times(&self) -> bool {
        self.any(|quantity| quantity == PoseQuantity::Time)
    }
}

impl fmt::Display for Layout {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let names: Vec<&str> = self.0.iter().map(|column| column.0).collect();
        f.write_str(&names.join(","))
    }
}

/// A list of poses.
#[derive(Debug)]
pub(super) struct PoseList {
    pub poses: Vec<Rigid>,
    /// Time of every pose, s, ascending; `None` without a time column.
    pub times: Option<Vec<f64>>,
}

/// Returns the poses of a file in the order of its lines. See `read`.
pub fn parse(file: &Path, bytes: &[u8]) -> Result<Vec<Rigid>> {
    read(file, bytes, None).map(|list| list.poses)
}

/// Reads a list of poses: a header that names the columns ([`EXPECTED_COLUMNS`]), then numbers.
/// With `layout`, the header may be absent. Values are separated by commas, semicolons, tabs or
/// spaces; with semicolons, numbers may have decimal commas. Lines that begin with # are comments.
/// Errors name the file, line and column.
pub(super) fn read(file: &Path, bytes: &[u8], layout: Option<Layout>) -> Result<PoseList> {
    let separator = separator(bytes);
    let mut reader = ReaderBuilder::new()
        .trim(Trim::All)
        .flexible(true)
        .has_headers(false)
        .comment(Some(b'#'))
        .delimiter(separator)
        .from_reader(bytes);
    let mut records = reader.records();
    let first = records.next().transpose();
    let first = first.map_err(|error| unreadable(file, &error))?;
    let texts = first
        .as_ref()
        .map_or(Vec::new(), |first| values(separator, first));
    let is_text = |text: &&str| number(separator, text).is_none();
    let is_header = !texts.is_empty() && texts.iter().all(is_text);
    let at = first
        .as_ref()
        .map_or(Place::Line(1), |first| place(bytes, first));
    let layout = layout_of_file(file, at, &texts, is_header, layout)?;
    let first = first.filter(|_| !is_header);
    let mut list = PoseList {
        poses: Vec::new(),
        times: layout.has_times().then(Vec::new),
    };
    for record in first.map(Ok).into_iter().chain(records) {
        let record = record.map_err(|error| unreadable(file, &error))?;
        let wrong = |(column, found, expected): Mistake| {
            let mut error = InputError::new(file, place(bytes, &record), found, expected);
            error.key = column.map(str::to_owned);
            error
        };
        let (time, pose) = pose(&layout, separator, &record).map_err(wrong)?;
        list.poses.push(pose);
        if let Some(times) = &mut list.times {
            if let Some(&last) = times.last()
                && time <= last
            {
                let (found, expected) = (format!("{time} s"), format!("a time after {last} s"));
                return Err(wrong((Some("time"), found, expected)).into());
            }
            times.push(time);
        }
    }
    if list.poses.is_empty() || list.poses.len() > u32::MAX as usize {
        let found = format!("{} poses", list.poses.len());
        let error = InputError::new(file, Place::File, found, "from 1 to 4294967295");
        return Err(error.into());
    }
    Ok(list)
}

/// Returns the layout of a file from the texts of its first line. Returns an error if the file has
/// no layout, or contradicts `stated`.
fn layout_of_file(
    file: &Path,
    at: Place,
    texts: &[&str],
    is_header: bool,
    stated: Option<Layout>,
) -> Result<Layout> {
    let (found, expected) = match (stated, Layout::of(texts.iter().copied())) {
        (None, Ok(layout)) => return Ok(layout),
        (Some(stated), Ok(header)) if stated.0 != header.0 => (
            format!("the header \"{header}\""),
            format!("{stated}, as scan.poses_columns states, or a scene without this key"),
        ),
        (Some(stated), _) => return Ok(stated),
        (None, Err(reason)) => {
            let reason = match is_header {
                true => format!(" ({reason})"),
                false => String::new(),
            };
            (
                format!("{:?}{reason}", texts.join(",")),
                format!("the header {EXPECTED_COLUMNS}; or scan.poses_columns to name them"),
            )
        }
    };
    Err(InputError::new(file, at, found, expected).into())
}

/// Reads the ascending times of a file, s: one per line under the header `time_s` or `time_ms`.
/// Errors name the file and line.
pub(super) fn read_times(file: &Path, bytes: &[u8]) -> Result<Vec<f64>> {
    let wrong = |line: usize, found: String, expected: &str| {
        Error::from(InputError::new(file, Place::Line(line), found, expected))
    };
    let text = String::from_utf8_lossy(bytes);
    let text = text.strip_prefix('\u{feff}').unwrap_or(&text);
    let lines = (1..).zip(text.lines().map(str::trim));
    let mut lines = lines.filter(|(_, line)| !line.is_empty() && !line.starts_with('#'));
    let header = "the header time_s or time_ms, then one number a line";
    let scale = match lines.next() {
        Some((_, "time_s")) => 1.0,
        Some((_, "time_ms")) => 1e-3,
        Some((line, other)) => return Err(wrong(line, format!("{other:?}"), header)),
        None => return Err(wrong(1, "\"\"".into(), header)),
    };
    let mut times: Vec<f64> = Vec::new();
    for (line, text) in lines {
        let time = text.parse::<f64>().ok().filter(|time| time.is_finite());
        let expected = "one number, the time of a frame";
        let time = time.ok_or_else(|| wrong(line, format!("{text:?}"), expected))? * scale;
        if let Some(last) = times.last().filter(|&&last| time <= last) {
            return Err(wrong(
                line,
                format!("{time} s"),
                &format!("a time after {last} s"),
            ));
        }
        times.push(time);
    }
    if times.is_empty() || times.len() > u32::MAX as usize {
        let found = format!("{} times", times.len());
        return Err(InputError::new(file, Place::File, found, "from 1 to 4294967295").into());
    }
    Ok(times)
}

/// Returns the separator of the first line that is not blank and not a comment.
fn separator(bytes: &[u8]) -> u8 {
    let lines = bytes.split(|&b| b == b'\n').map(<[u8]>::trim_ascii);
    let mut lines = lines.filter(|line| !line.is_empty() && !line.starts_with(b"#"));
    let first = lines.next().unwrap_or_default();
    let separators = [b';', b'\t', b','].into_iter();
    let found = separators
        .into_iter()
        .find(|separator| first.contains(separator));
    match found {
        None if first.contains(&b' ') => b' ',
        found => found.unwrap_or(b','),
    }
}

/// Splits a record into its texts. Consecutive spaces or tabs count as one separator.
fn values(separator: u8, record: &StringRecord) -> Vec<&str> {
    let blank = matches!(separator, b' ' | b'\t');
    record
        .iter()
        .filter(|text| !(blank && text.is_empty()))
        .collect()
}

/// Parses a number. A decimal comma is accepted in files separated by semicolons.
fn number(separator: u8, text: &str) -> Option<f64> {
    match separator {
        b';' if text.matches(',').count() == 1 && !text.contains('.') => {
            text.replace(',', ".").parse().ok()
        }
        _ => text.parse().ok(),
    }
}

/// Returns the line of a record. The reader reports the position before blank lines and comments,
/// so these are skipped here.
pub(super) fn place(bytes: &[u8], record: &StringRecord) -> Place {
    let mut start = record.position().map_or(0, |at| at.byte() as usize);
    loop {
        let blank = |b: &&u8| matches!(b, b'\r' | b'\n');
        start += bytes[start..].iter().take_while(blank).count();
        match bytes.get(start) {
            Some(b'#') => start += bytes[start..].iter().take_while(|&&b| b != b'\n').count(),
            _ => break,
        }
    }
    let before = &bytes[..start];
    Place::Line(1 + before.iter().filter(|&&b| b == b'\n').count())
}

/// Returns the error of a file that is not CSV text.
pub(super) fn unreadable(file: &Path, error: &csv::Error) -> Error {
    let place = match error.position() {
        Some(at) => Place::Line(at.line() as usize),
        None => Place::File,
    };
    let found = match error.kind() {
        ErrorKind::Utf8 { .. } => "bytes that are not UTF-8".to_owned(),
        _ => error.to_string(),
    };
    InputError::new(file, place, found, "CSV text").into()
}

/// Name of the erroneous column, its text, and the expected values.
type Mistake = (Option<&'static str>, String, String);

/// Returns the time and pose of a line.
fn pose(
    layout: &Layout,
    separator: u8,
    record: &StringRecord,
) -> std::result::Result<(f64, Rigid), Mistake> {
    let texts = values(separator, record);
    if texts.len() != layout.0.len() {
        let expected = format!("{}, one a column", layout.0.len());
        return Err((None, format!("{} values", texts.len()), expected));
    }
    let (mut time, mut position) = (0.0, [0.0; 3]);
    let (mut fixed, mut abc, mut quaternion) = ([0.0; 3], [0.0; 3], [0.0; 4]);
    for (text, &(name, quantity, scale)) in texts.into_iter().zip(&layout.0) {
        let (to, limit, expected) = match quantity {
            PoseQuantity::Time => (&mut time, 1e15, "a number, the time of the pose"),
            PoseQuantity::Position(i) => (
                &mut position[i],
                MAX_COORDINATE_MM,
                "a number within 1e12 mm",
            ),
            PoseQuantity::Fixed(i) => (&mut fixed[i], 360.0, "an angle from -360 to 360"),
            PoseQuantity::Abc(i) => (&mut abc[i], 360.0, "an angle from -360 to 360"),
            PoseQuantity::Quaternion(i) => (&mut quaternion[i], 1.01, "a number from -1 to 1"),
            PoseQuantity::Ignored => continue,
        };
        // A text that is not a number becomes NaN, which fails the comparison.
        let value = scale * number(separator, text).unwrap_or(f64::NAN);
        let holds = value.abs() <= limit;
        if !holds {
            return Err((Some(name), format!("{text:?}"), expected.to_owned()));
        }
        *to = value;
    }
    let position = DVec3::from(position);
    if layout.any(|quantity| matches!(quantity, PoseQuantity::Quaternion(_))) {
        let quaternion = DQuat::from_array(quaternion);
        let length = quaternion.length();
        // The bound allows numbers with three digits. A larger deviation indicates that the values
        // are not a quaternion.
        if (length - 1.0).abs() > 0.01 {
            let found = format!("a quaternion of length {length:.4}");
            return Err((None, found, "length 1".to_owned()));
        }
        let pose = Rigid {
            rotation: DMat3::from_quat(quaternion.normalize()),
            translation: position,
        };
        return Ok((time, pose));
    }
    let [a, b, c] = abc;
    // Only one of the two angle conventions is present; the other angles are zero.
    let angles = (DVec3::from(fixed) + DVec3::new(c, b, a)).map(f64::to_radians);
    Ok((time, Rigid::from_euler_xyz(angles, position)))
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: &str = "x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\n";
    const TURNED: &str = "x_mm,y_mm,z_mm,qw,qx,qy,qz\n";

    fn parsed(text: &str) -> Result<Vec<Rigid>> {
        parse(Path::new("path.csv"), text.as_bytes())
    }

    #[test]
    fn angles_and_quaternions_say_the_same() {
        // The text has a byte-order mark, CR LF, spaces, quotes and blank lines, as programs write
        // them.
        let angles = format!(
            "\u{feff}{}\r\n1, 2,-3e1,0,0,90\r\n\r\n\"4\",5,6,0,0,0",
            HEADER.trim()
        );
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let turned = format!("{TURNED}1,2,-30,{half},0,0,{half}\n4,5,6,-1,0,0,0\n");
        let (a, b) = (parsed(&angles).unwrap(), parsed(&turned).unwrap());
        assert_eq!((a.len(), b.len()), (2, 2));
        for (a, b) in a.iter().zip(&b) {
            assert_eq!(a.translation, b.translation);
            assert!((a.vector(DVec3::X) - b.vector(DVec3::X)).length() < 1e-15);
            assert!((a.vector(DVec3::Y) - b.vector(DVec3::Y)).length() < 1e-15);
        }
        assert!((a[0].vector(DVec3::X) - DVec3::Y).length() < 1e-15);
    }

    #[test]
    fn a_mistake_is_named_with_line_and_column() {
        let body = |lines: &str| format!("{HEADER}{lines}");
        let turned = |lines: &str| format!("{TURNED}{lines}");
        for (text, message) in [
            (
                "".into(),
                "path.csv:1: found \"\", expected the header x_mm,",
            ),
            (
                "1,2,3,0,0,0\n".into(),
                "path.csv:1: found \"1,2,3,0,0,0\", expected the header",
            ),
            (HEADER.into(), "path.csv: found 0 poses, expected from 1"),
            (
                body("1,2,3,0,0,0\n1,2,3,0,0\n"),
                "path.csv:3: found 5 values, expected 6",
            ),
            (
                body("1,2,3,0,0,0,7\n"),
                "path.csv:2: found 7 values, expected 6",
            ),
            (
                body("1,two,3,0,0,0\n"),
                "path.csv:2: y_mm: found \"two\", expected a number",
            ),
            (
                body("1,2,,0,0,0\n"),
                "path.csv:2: z_mm: found \"\", expected a number",
            ),
            (
                body("\n\nnan,2,3,0,0,0\n"),
                "path.csv:4: x_mm: found \"nan\"",
            ),
            (body("inf,2,3,0,0,0\n"), "path.csv:2: x_mm: found \"inf\""),
            (
                body("1e13,2,3,0,0,0\n"),
                "path.csv:2: x_mm: found \"1e13\", expected a number within",
            ),
            (
                body("1,2,3,0,361,0\n"),
                "path.csv:2: ry_deg: found \"361\", expected an angle",
            ),
            (
                turned("1,2,3,1,1.5,0,0\n"),
                "path.csv:2: qx: found \"1.5\", expected a number from",
            ),
            (
                turned("1,2,3,1,0,0,0\n1,2,3,0.5,0,0,0\n"),
                "path.csv:3: found a quaternion of length 0.5000",
            ),
            (body("1;2;3;0;0;0\n"), "path.csv:2: found 1 values"),
        ] {
            let error = parsed(&text).unwrap_err();
            assert_eq!(error.exit_code(), 65);
            let error = error.to_string();
            assert!(error.starts_with(message), "{text:?}: {error}");
        }
        let error = parse(Path::new("path.csv"), b"x_mm,\xff\n1").unwrap_err();
        assert!(error.to_string().contains("UTF-8"), "{error}");
    }
}
