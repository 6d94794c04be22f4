//! Parts of objects that are not solid, as slicers state in separate files.

use super::package::Package;
use crate::error::Error;
use std::collections::HashMap;

/// Files of PrusaSlicer and Bambu Studio, and of their derivatives.
const PRUSA: [&str; 2] = [
    "Metadata/Slic3r_PE_model.config",
    "Metadata/SuperSlicer_model.config",
];
const BAMBU: &str = "Metadata/model_settings.config";

/// Parts of objects that are not solid.
#[derive(Default)]
pub struct Roles {
    /// First and last triangle, and the role, of each part, by object.
    ranges: HashMap<String, Vec<(usize, usize, String)>>,
    /// Roles of components, by their object and the object that they reference.
    components: HashMap<(String, String), String>,
}

impl Roles {
    pub fn read(package: &mut Package) -> Result<Roles, Error> {
        let mut roles = Roles::default();
        for name in PRUSA {
            if package.has(name) {
                roles.read_prusa(package, name)?;
            }
        }
        if package.has(BAMBU) {
            roles.read_bambu(package)?;
        }
        Ok(roles)
    }

    fn read_prusa(&mut self, package: &mut Package, name: &str) -> Result<(), Error> {
        let mut object = String::new();
        let mut range = None;
        package.elements(name, |element| {
            match element.name {
                "object" => object = element.text("id")?.unwrap_or_default(),
                "volume" => {
                    let number = |key: &str| {
                        let value = element.text(key)?;
                        Ok::<_, Error>(value.and_then(|value| value.trim().parse().ok()))
                    };
                    range = number("firstid")?.zip(number("lastid")?);
                }
                "metadata" => {
                    let [kind, key, value] = ["type", "key", "value"].map(|key| element.text(key));
                    let (kind, key, value) = (kind?, key?, value?.unwrap_or_default());
                    let of_volume = kind.as_deref().is_none_or(|kind| kind == "volume");
                    let role = match key.as_deref() {
                        Some("volume_type") if value != "ModelPart" => value,
                        // Written by versions without volume_type.
                        Some("modifier") if value == "1" => "ParameterModifier".to_owned(),
                        _ => return Ok(()),
                    };
                    if let Some((first, last)) = range.filter(|_| of_volume) {
                        let ranges = self.ranges.entry(object.clone()).or_default();
                        ranges.push((first, last, role));
                    }
                }
                _ => {}
            }
            Ok(())
        })
    }

    fn read_bambu(&mut self, package: &mut Package) -> Result<(), Error> {
        let mut object = String::new();
        package.elements(BAMBU, |element| {
            match element.name {
                "object" => object = element.text("id")?.unwrap_or_default(),
                "part" => {
                    let part = element.text("id")?.unwrap_or_default();
                    let role = element.text("subtype")?;
                    if let Some(role) = role.filter(|role| role != "normal_part") {
                        self.components.insert((object.clone(), part), role);
                    }
                }
                _ => {}
            }
            Ok(())
        })
    }

    /// Returns the triangle ranges of an object that are not solid.
    pub fn ranges(&self, object: &str) -> &[(usize, usize, String)] {
        self.ranges.get(object).map_or(&[], |ranges| ranges)
    }

    /// Returns the role of a component that is not solid.
    pub fn component(&self, object: &str, placed: &str) -> Option<&str> {
        if self.components.is_empty() {
            return None;
        }
        let key = (object.to_owned(), placed.to_owned());
        self.components.get(&key).map(String::as_str)
    }
}

/// True if a part removes material from other parts.
pub fn is_negative(role: &str) -> bool {
    role.to_lowercase().contains("negative")
}
