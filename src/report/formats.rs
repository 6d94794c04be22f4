//! Export of the point cloud in formats other than PLY, and export of the profiles.

use super::color::diverging;
use super::ply::color_limit_um;
use crate::inspect::cloud::CloudPoint;
use e57::{E57Writer, Extension, Record, RecordDataType, RecordName, RecordValue};
use sha2::{Digest, Sha256};
use std::io::{self, Cursor, Write};

/// File format of the point cloud in addition to PLY.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CloudFormat {
    /// Text with one line per point.
    Csv,
    /// ASTM E2807, in metres as required by the standard.
    E57,
    /// Point Cloud Data of PCL, in metres as usual in ROS.
    Pcd,
}

impl CloudFormat {
    /// All formats in declaration order.
    pub const ALL: [CloudFormat; 3] = [CloudFormat::Csv, CloudFormat::E57, CloudFormat::Pcd];

    /// Returns the file name in the output folder of a scan.
    pub fn file_name(self) -> &'static str {
        match self {
            CloudFormat::Csv => "cloud.csv",
            CloudFormat::E57 => "cloud.e57",
            CloudFormat::Pcd => "cloud.pcd",
        }
    }

    /// Returns the file extension, which is also the name on the command line.
    pub fn ending(self) -> &'static str {
        match self {
            CloudFormat::Csv => "csv",
            CloudFormat::E57 => "e57",
            CloudFormat::Pcd => "pcd",
        }
    }

    /// Writes the points in this format.
    pub fn write(self, out: &mut impl Write, points: &[CloudPoint]) -> io::Result<()> {
        match self {
            CloudFormat::Csv => csv(out, points),
            // The E57 writer needs to seek, so the file is built in memory.
            CloudFormat::E57 => out.write_all(&e57(points).map_err(io::Error::other)?),
            CloudFormat::Pcd => pcd(out, points),
        }
    }
}

/// Writes CSV. The columns x, y and z (mm) come first, so readers of plain XYZ files accept the
/// file.
fn csv(out: &mut impl Write, points: &[CloudPoint]) -> io::Result<()> {
    writeln!(
        out,
        "x_mm,y_mm,z_mm,deviation_mm,u_position_mm,u_deviation_mm,intensity_dn,frame,column,flags,row_px,line_sigma_px,repeatability_mm,correlation_length_mm,scan_correlation_length_mm"
    )?;
    for p in points {
        let [x, y, z] = p.position.to_array();
        writeln!(
            out,
            "{x:.7},{y:.7},{z:.7},{:.7},{:.7},{:.7},{:.1},{},{},{},{:.5},{:.3},{:.7},{:.5},{:.5}",
            p.deviation,
            p.u_position,
            p.u_deviation,
            p.intensity,
            p.frame,
            p.column,
            p.flags.bits(),
            p.row,
            p.line_sigma_px,
            p.repeatability,
            p.correlation_length,
            p.scan_correlation_length
        )?;
    }
    Ok(())
}

/// Names of the attributes that E57 does not define.
const OWN: [&str; 4] = ["deviation", "uPosition", "uDeviation", "flags"];
const NAMESPACE: &str = "lasertrace";

/// Returns the columns of an E57 file. Readers based on libE57 (pye57) expect
/// `cartesianInvalidState`.
fn e57_prototype(points: &[CloudPoint]) -> Vec<Record> {
    let float = RecordDataType::Double {
        min: None,
        max: None,
    };
    let integer = |max: i64| RecordDataType::Integer { min: 0, max };
    let index =
        |of: &dyn Fn(&CloudPoint) -> i64| integer(points.iter().map(of).max().unwrap_or(0).max(1));
    let mut prototype = vec![
        Record::CARTESIAN_X_F64,
        Record::CARTESIAN_Y_F64,
        Record::CARTESIAN_Z_F64,
    ];
    let mut add = |name, data_type| prototype.push(Record { name, data_type });
    add(RecordName::CartesianInvalidState, integer(INVALID));
    for name in [
        RecordName::ColorRed,
        RecordName::ColorGreen,
        RecordName::ColorBlue,
    ] {
        add(name, integer(255));
    }
    add(RecordName::Intensity, float.clone());
    add(RecordName::RowIndex, index(&|p| p.frame as i64));
    add(RecordName::ColumnIndex, index(&|p| p.column as i64));
    for (i, name) in OWN.into_iter().enumerate() {
        let name = RecordName::Unknown {
            namespace: NAMESPACE.into(),
            name: name.into(),
        };
        add(
            name,
            match i {
                3 => integer(u16::MAX as i64),
                _ => float.clone(),
            },
        );
    }
    prototype
}

/// Value of `cartesianInvalidState` for a point without meaningful coordinates.
const INVALID: i64 = 2;

fn e57(points: &[CloudPoint]) -> e57::Result<Vec<u8>> {
    let mut hash = Sha256::new();
    for p in points {
        for x in p.position.to_array() {
            hash.update(x.to_le_bytes());
        }
    }
    let guid: String = hash.finalize().iter().map(|b| format!("{b:02x}")).collect();
    let mut file = Cursor::new(Vec::new());
    let mut writer = E57Writer::new(&mut file, &guid)?;
    writer.register_extension(Extension {
        namespace: NAMESPACE.into(),
        url: "urn:lasertrace:point".into(),
    })?;
    let prototype = e57_prototype(points);
    let columns = prototype.clone();
    let mut cloud = writer.add_pointcloud(&guid, prototype)?;
    cloud.set_name(Some("lasertrace scan, frame of the part".into()));
    let limit = color_limit_um(points, |p| p.deviation);
    for p in points {
        let [x, y, z] = (p.position * 1e-3).to_array().map(RecordValue::Double);
        let color = diverging(p.deviation * 1e3, limit);
        let [red, green, blue] = color.map(|part| RecordValue::Integer(part.into()));
        cloud.add_point(vec![
            x,
            y,
            z,
            RecordValue::Integer(0),
            red,
            green,
            blue,
            RecordValue::Double(p.intensity),
            RecordValue::Integer(p.frame as i64),
            RecordValue::Integer(p.column as i64),
            RecordValue::Double(p.deviation * 1e-3),
            RecordValue::Double(p.u_position * 1e-3),
            RecordValue::Double(p.u_deviation * 1e-3),
            RecordValue::Integer(p.flags.bits() as i64),
        ])?;
    }
    if points.is_empty() {
        // libE57 cannot open a cloud with zero records. A record marked as invalid does not count
        // as a point.
        let value = |record: Record| match (record.name, record.data_type) {
            (RecordName::CartesianInvalidState, _) => RecordValue::Integer(INVALID),
            (_, RecordDataType::Integer { .. }) => RecordValue::Integer(0),
            _ => RecordValue::Double(0.0),
        };
        cloud.add_point(columns.into_iter().map(value).collect())?;
    }
    cloud.finalize()?;
    writer.finalize()?;
    drop(writer);
    Ok(file.into_inner())
}

/// Fields of a point in a PCD file: name, and `F` for float or `U` for unsigned integer, 4 bytes
/// each. PCL recognises x, y, z, normals, rgb and intensity by these names, and only as 4-byte
/// floats.
const PCD_FIELDS: [(&str, char); 17] = [
    ("x", 'F'),
    ("y", 'F'),
    ("z", 'F'),
    ("normal_x", 'F'),
    ("normal_y", 'F'),
    ("normal_z", 'F'),
    ("rgb", 'F'),
    ("intensity", 'F'),
    ("deviation", 'F'),
    ("u_position", 'F'),
    ("u_deviation", 'F'),
    ("repeatability", 'F'),
    ("correlation_length", 'F'),
    ("scan_correlation_length", 'F'),
    ("frame", 'U'),
    ("column", 'U'),
    ("flags", 'U'),
];

fn pcd(out: &mut impl Write, points: &[CloudPoint]) -> io::Result<()> {
    let all = |of: &dyn Fn((&str, char)) -> String| PCD_FIELDS.map(of).join(" ");
    let count = points.len();
    write!(
        out,
        "# .PCD v0.7 - Point Cloud Data file format\n\
         # lasertrace: metres, frame of the part\n\
         VERSION 0.7\nFIELDS {}\nSIZE {}\nTYPE {}\nCOUNT {}\n\
         WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n",
        all(&|(name, _)| name.into()),
        all(&|_| "4".into()),
        all(&|(_, kind)| kind.into()),
        all(&|_| "1".into()),
    )?;
    let limit = color_limit_um(points, |p| p.deviation);
    for p in points {
        let mut floats = |values: &[f64]| {
            let mut bytes = values.iter().map(|&value| (value as f32).to_le_bytes());
            bytes.try_for_each(|bytes| out.write_all(&bytes))
        };
        floats(&(p.position * 1e-3).to_array())?;
        floats(&p.normal.as_dvec3().to_array())?;
        let [red, green, blue] = diverging(p.deviation * 1e3, limit);
        // PCL stores the bytes of a colour as a float.
        out.write_all(&[blue, green, red, 0])?;
        let lengths = [
            p.deviation,
            p.u_position,
            p.u_deviation,
            p.repeatability,
            p.correlation_length,
            p.scan_correlation_length,
        ];
        for value in [p.intensity].into_iter().chain(lengths.map(|mm| mm * 1e-3)) {
            out.write_all(&(value as f32).to_le_bytes())?;
        }
        for number in [p.frame, p.column, p.flags.bits().into()] {
            out.write_all(&number.to_le_bytes())?;
        }
    }
    Ok(())
}

/// Writes the profiles of all frames as a NumPy structured array.
pub fn npy(out: &mut impl Write, points: &[CloudPoint]) -> io::Result<()> {
    let fields = [
        ("frame", "<u4"),
        ("column", "<u4"),
        ("row_px", "<f8"),
        ("line_sigma_px", "<f8"),
        ("intensity_dn", "<f8"),
        ("x_mm", "<f8"),
        ("y_mm", "<f8"),
        ("z_mm", "<f8"),
        ("deviation_mm", "<f8"),
        ("u_position_mm", "<f8"),
        ("u_deviation_mm", "<f8"),
        ("repeatability_mm", "<f8"),
        ("correlation_length_mm", "<f8"),
        ("scan_correlation_length_mm", "<f8"),
        ("flags", "<u2"),
    ];
    let fields = fields.map(|(name, kind)| format!("('{name}', '{kind}')"));
    npy_header(out, &format!("[{}]", fields.join(", ")), &[points.len()])?;
    for p in points {
        out.write_all(&p.frame.to_le_bytes())?;
        out.write_all(&p.column.to_le_bytes())?;
        let [x, y, z] = p.position.to_array();
        for value in [
            p.row,
            p.line_sigma_px,
            p.intensity,
            x,
            y,
            z,
            p.deviation,
            p.u_position,
            p.u_deviation,
            p.repeatability,
            p.correlation_length,
            p.scan_correlation_length,
        ] {
            out.write_all(&value.to_le_bytes())?;
        }
        out.write_all(&p.flags.bits().to_le_bytes())?;
    }
    Ok(())
}

/// Writes the header of a NumPy file with elements of type `kind`: format version 1.0 (NumPy
/// enhancement proposal 1), padded to a multiple of 64 bytes.
pub fn npy_header(out: &mut impl Write, kind: &str, shape: &[usize]) -> io::Result<()> {
    let shape: String = shape.iter().map(|n| format!("{n}, ")).collect();
    let shape = shape.trim_end();
    let mut header = format!("{{'descr': {kind}, 'fortran_order': False, 'shape': ({shape}), }}");
    const PREFIX: usize = 10;
    while !(PREFIX + header.len() + 1).is_multiple_of(64) {
        header.push(' ');
    }
    header.push('\n');
    out.write_all(b"\x93NUMPY\x01\x00")?;
    out.write_all(&(header.len() as u16).to_le_bytes())?;
    out.write_all(header.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::DVec3;
    use crate::profile::Flags;
    use e57::E57Reader;

    fn points() -> Vec<CloudPoint> {
        (0..200)
            .map(|i| CloudPoint {
                position: DVec3::new(i as f64 / 3.0, -1.5, 1e-3),
                deviation: -0.002,
                u_position: 0.003,
                u_deviation: 0.001,
                repeatability: 0.0005,
                correlation_length: 0.2,
                scan_correlation_length: 0.2,
                intensity: 1234.5,
                frame: i / 20,
                column: i % 20,
                row: 31.25,
                line_sigma_px: 1.5,
                flags: Flags::DISCONTINUITY,
                normal: glam::Vec3::Z,
                direct_fraction: 1.0,
            })
            .collect()
    }

    fn written(write: impl Fn(&mut Vec<u8>) -> io::Result<()>) -> Vec<u8> {
        let mut bytes = Vec::new();
        write(&mut bytes).unwrap();
        bytes
    }

    /// Reads the file with an independent reader: coordinates in metres, and the custom attributes.
    #[test]
    fn an_e57_is_read_back() {
        let points = points();
        let bytes = written(|out| CloudFormat::E57.write(out, &points));
        assert_eq!(bytes, written(|out| CloudFormat::E57.write(out, &points)));
        let mut reader = E57Reader::new(Cursor::new(bytes)).unwrap();
        let cloud = reader.pointclouds().remove(0);
        assert_eq!(cloud.records, 200);
        let read: Vec<_> = reader
            .pointcloud_raw(&cloud)
            .unwrap()
            .collect::<Result<_, _>>()
            .unwrap();
        let last = &read[199];
        assert_eq!(last[0], RecordValue::Double(199.0 / 3.0 * 1e-3));
        assert_eq!(last[3], RecordValue::Integer(0));
        assert_eq!(last[8], RecordValue::Integer(9));
        assert_eq!(last[10], RecordValue::Double(-0.002 * 1e-3));
        assert_eq!(last[13], RecordValue::Integer(32));
    }

    /// libE57 cannot read zero records, so an empty cloud has one invalid record.
    #[test]
    fn an_e57_without_points_has_a_record_that_is_no_point() {
        let bytes = written(|out| CloudFormat::E57.write(out, &[]));
        let mut reader = E57Reader::new(Cursor::new(bytes)).unwrap();
        let cloud = reader.pointclouds().remove(0);
        assert_eq!(cloud.records, 1);
        let record = reader.pointcloud_raw(&cloud).unwrap().next().unwrap();
        assert_eq!(record.unwrap()[3], RecordValue::Integer(2));
    }

    /// Compares the values of the header and the bytes of the second point.
    #[test]
    fn a_pcd_is_laid_out_as_its_header_states() {
        let bytes = written(|out| CloudFormat::Pcd.write(out, &points()));
        let data = b"DATA binary\n";
        let start = bytes.windows(data.len()).position(|w| w == data).unwrap() + data.len();
        let header = std::str::from_utf8(&bytes[..start]).unwrap();
        let line = |key: &str| {
            let mut lines = header.lines().filter_map(|line| line.strip_prefix(key));
            lines.next().unwrap().split_whitespace().collect::<Vec<_>>()
        };
        for key in ["FIELDS", "SIZE", "TYPE", "COUNT"] {
            assert_eq!(line(key).len(), 17);
        }
        assert_eq!((line("WIDTH"), line("POINTS")), (vec!["200"], vec!["200"]));
        let second = &bytes[start + 68..start + 136];
        assert_eq!(bytes.len() - start, 200 * 68);
        let float = |at: usize| f32::from_le_bytes(second[4 * at..][..4].try_into().unwrap());
        assert_eq!(float(0), (1e-3f64 / 3.0) as f32);
        assert_eq!(float(5), 1.0);
        assert_eq!(float(7), 1234.5);
        assert_eq!(float(8), (-0.002f64 * 1e-3) as f32);
        let flags = u32::from(Flags::DISCONTINUITY.bits());
        assert_eq!(
            second[60..],
            [1u32, flags].map(u32::to_le_bytes).as_flattened()[..]
        );
    }

    /// Tests the rules of the NumPy header and the bytes of the first point.
    #[test]
    fn an_npy_is_laid_out_as_numpy_wants_it() {
        let bytes = written(|out| npy(out, &points()));
        let length = u16::from_le_bytes([bytes[8], bytes[9]]) as usize;
        assert_eq!((10 + length) % 64, 0);
        let header = std::str::from_utf8(&bytes[10..10 + length]).unwrap();
        assert!(header.contains("'shape': (200,)") && header.ends_with('\n'));
        let data = &bytes[10 + length..];
        assert_eq!(data.len(), 200 * 106);
        let second = &data[106..];
        assert_eq!(second[4..8], 1u32.to_le_bytes());
        assert_eq!(second[8..16], 31.25f64.to_le_bytes());
        assert_eq!(second[32..40], (1.0f64 / 3.0).to_le_bytes());
    }

    #[test]
    fn a_csv_has_a_line_a_point_and_an_empty_cloud_is_no_error() {
        let text =
            String::from_utf8(written(|out| CloudFormat::Csv.write(out, &points()))).unwrap();
        assert_eq!(text.lines().count(), 201);
        assert_eq!(text.lines().nth(1).unwrap().split(',').count(), 15);
        for format in CloudFormat::ALL {
            assert!(format.write(&mut Vec::new(), &[]).is_ok(), "{format:?}");
        }
    }
}
