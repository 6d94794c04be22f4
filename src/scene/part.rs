//! Description of the part of a scene as text.

use super::file::PartTable;
use super::unit::Unit;

impl PartTable {
    /// Returns the mesh file and its unit, or the shape and its size.
    pub(super) fn to_text(&self) -> String {
        if let Some(mesh) = &self.mesh {
            let unit = mesh
                .unit
                .map_or(String::new(), |unit| format!(" in {}", name(unit)));
            return mesh.file.clone() + &unit;
        }
        if let Some(plane) = &self.plane {
            let [x, y] = plane.size_mm;
            return format!("plane of {x} × {y} mm");
        }
        if let Some(sphere) = &self.sphere {
            return format!("sphere of {} mm radius", sphere.radius_mm);
        }
        if let Some(cylinder) = &self.cylinder {
            let (radius, length) = (cylinder.radius_mm, cylinder.length_mm);
            return format!("cylinder of {radius} mm radius and {length} mm length");
        }
        let block = self.step_block.as_ref();
        block.map_or(String::new(), |block| {
            let [x, y, z] = block.size_mm;
            format!(
                "block of {x} × {y} × {z} mm with a step of {} mm",
                block.step_mm
            )
        })
    }
}

/// Returns the symbol of the unit.
fn name(unit: Unit) -> &'static str {
    match unit {
        Unit::Micrometre => "µm",
        Unit::Millimetre => "mm",
        Unit::Centimetre => "cm",
        Unit::Metre => "m",
        Unit::Inch => "inch",
    }
}
