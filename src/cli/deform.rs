use super::Output;
use crate::error::printable::path;
use crate::error::{Error, Result};
use crate::math::DVec3;
use crate::mesh::deform::{Defect, binary_stl};
use crate::mesh::{self, UnitSource};
use crate::run::files::write_bytes;
use crate::scene::Unit;
use serde::Serialize;
use std::path::PathBuf;

#[derive(clap::Args)]
pub struct Arguments {
    /// Nominal mesh file: STL, OBJ, PLY, glTF or 3MF
    part: PathBuf,
    /// Unit of the mesh file's coordinates
    #[arg(long, value_enum)]
    unit: Option<Unit>,
    /// Depression of the face at X,Y,Z: radius and depth, mm
    #[arg(long, value_name = "X,Y,Z,RADIUS,DEPTH", value_parser = numbers::<5>, allow_hyphen_values = true)]
    dent: Vec<[f64; 5]>,
    /// Parabolic bend of the face at X,Y,Z along its longest direction: outward displacement of the
    /// ends, mm
    #[arg(long, value_name = "X,Y,Z,AMOUNT", value_parser = numbers::<4>, allow_hyphen_values = true)]
    warp: Vec<[f64; 4]>,
    /// Translation of the face at X,Y,Z, such as the wall of a hole, mm
    #[arg(long, value_name = "X,Y,Z,DX,DY,DZ", value_parser = numbers::<6>, allow_hyphen_values = true)]
    shift: Vec<[f64; 6]>,
    /// Uniform loss of material of the face at X,Y,Z, mm
    #[arg(long, value_name = "X,Y,Z,DEPTH", value_parser = numbers::<4>, allow_hyphen_values = true)]
    wear: Vec<[f64; 4]>,
    /// Output file (binary STL, mm)
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Replace an existing output file
    #[arg(long)]
    force: bool,
}

/// Distance from the surface within which a point names a face, relative to the part's size.
const REACH: f64 = 1e-3;

#[derive(Serialize)]
struct Deformed {
    triangles: usize,
    file: String,
}

pub fn run(arguments: &Arguments, output: &Output) -> Result<()> {
    let part = &arguments.part;
    let bytes = mesh::read(part, &|_| Ok(()))?;
    let unit = match (arguments.unit, mesh::unit_by(part, &bytes)?) {
        (None, UnitSource::User) => {
            return Err(Error::Usage(format!(
                "{}: found coordinates without a unit, expected --unit",
                path(part)
            )));
        }
        (unit, _) => unit.map(Unit::mm),
    };
    if arguments.output.exists() && !arguments.force {
        return Err(Error::Usage(format!(
            "{} exists; choose another file, or replace it with --force",
            path(&arguments.output)
        )));
    }
    let mut mesh = mesh::parse(part, &bytes, unit)?;
    let mut reach = REACH * mesh.bounds().size().length();
    for (option, defect) in arguments.defects() {
        mesh = defect
            .apply(&mesh, reach)
            .map_err(|wrong| Error::Usage(format!("--{option} on {}: {wrong}", path(part))))?;
        // Points refer to the nominal surface, which this defect displaced.
        reach += defect.amount();
    }
    write_bytes(&arguments.output, &binary_stl(&mesh))?;
    let result = Deformed {
        triangles: mesh.triangles.len(),
        file: arguments.output.display().to_string(),
    };
    let text = format!(
        "{}: {} triangles",
        path(&arguments.output),
        result.triangles
    );
    output.result(&result, &text)
}

impl Arguments {
    /// Returns the defects in the order dent, warp, shift, wear, with their options.
    fn defects(&self) -> Vec<(&'static str, Defect)> {
        let dents = self.dent.iter().map(|&[x, y, z, radius, depth]| {
            let at = DVec3::new(x, y, z);
            ("dent", Defect::Dent { at, radius, depth })
        });
        let warps = self.warp.iter().map(|&[x, y, z, amount]| {
            let at = DVec3::new(x, y, z);
            ("warp", Defect::Warp { at, amount })
        });
        let shifts = self.shift.iter().map(|&[x, y, z, dx, dy, dz]| {
            let at = DVec3::new(x, y, z);
            let by = DVec3::new(dx, dy, dz);
            ("shift", Defect::Shift { at, by })
        });
        let worn = self.wear.iter().map(|&[x, y, z, depth]| {
            let at = DVec3::new(x, y, z);
            ("wear", Defect::Wear { at, depth })
        });
        dents.chain(warps).chain(shifts).chain(worn).collect()
    }
}

/// Parses `N` finite numbers separated by commas.
fn numbers<const N: usize>(text: &str) -> std::result::Result<[f64; N], String> {
    let all: Vec<f64> = text
        .split(',')
        .filter_map(|number| number.trim().parse().ok())
        .filter(|number: &f64| number.is_finite() && number.abs() <= mesh::MAX_COORDINATE_MM)
        .collect();
    let count = text.split(',').count();
    match <[f64; N]>::try_from(all) {
        Ok(numbers) if count == N => Ok(numbers),
        _ => Err(format!("expected {N} numbers separated by commas")),
    }
}
