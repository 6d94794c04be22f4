//! What the part's surface is.

use super::file::{CoatTable, LayTable, MattTable, MetalTable, MirrorTable, PartTable};
use super::resolver::Resolver;
use crate::error::Result;
use crate::math::Rigid;
use crate::surface::{
    Coat, Ggx, Glossy, Lambert, Lay, Lobe, Metal, Mirror, Surface, WAVELENGTHS_NM, metal_index,
    metal_names,
};
use std::sync::Arc;

/// Roughness α of a lobe that is not taken for a mirror, and of the roughest.
const ROUGHNESS: [f64; 2] = [0.01, 1.0];

impl Resolver<'_> {
    pub(super) fn surface(&self, part: &PartTable, wavelength_nm: f64) -> Result<Surface> {
        let table = match (&part.surface, part.reflectance) {
            (None, Some(reflectance)) => {
                self.share(reflectance, "part.reflectance")?;
                return Ok(Lambert { reflectance }.into());
            }
            (Some(table), None) => table,
            _ => {
                let expected = "exactly one of reflectance and surface";
                return Err(self.source.wrong("part", expected));
            }
        };
        let mut lobes = Vec::new();
        if let Some(metal) = &table.metal {
            lobes.push((metal.share, Lobe::Metal(self.metal(metal, wavelength_nm)?)));
        }
        if let Some(coat) = &table.coat {
            lobes.push((coat.share, Lobe::Coat(self.coat(coat)?)));
        }
        if let Some(MattTable { reflectance, share }) = table.matt {
            self.share(reflectance, "part.surface.matt.reflectance")?;
            lobes.push((share, Lobe::Matt(Lambert { reflectance })));
        }
        if let Some(MirrorTable { reflectance, share }) = table.mirror {
            self.share(reflectance, "part.surface.mirror.reflectance")?;
            lobes.push((share, Lobe::Mirror(Mirror { reflectance })));
        }
        let key = "part.surface";
        self.check(
            !lobes.is_empty(),
            key,
            "at least one of metal, coat, matt and mirror",
        )?;
        let shares = || lobes.iter().map(|(share, _)| share);
        self.check(
            // Rounding of a few decimal shares.
            shares().all(|s| (0.0..=1.0).contains(s)) && shares().sum::<f64>() <= 1.0 + 1e-9,
            key,
            "shares from 0 to 1 whose sum is at most 1",
        )?;
        let lay = table.lay.as_ref().map(|lay| self.lay(lay)).transpose()?;
        let across = |across: Option<f64>| across.is_some();
        let needs_lay = table
            .metal
            .as_ref()
            .is_some_and(|m| across(m.roughness_across))
            || table
                .coat
                .as_ref()
                .is_some_and(|c| across(c.roughness_across));
        self.check(
            lay.is_some() || !needs_lay,
            key,
            "a table lay, as roughness_across is given",
        )?;
        Ok(Surface::Glossy(Arc::new(Glossy { lobes, lay })))
    }

    fn share(&self, value: f64, key: &str) -> Result<f64> {
        self.check((0.0..=1.0).contains(&value), key, "a number from 0 to 1")
            .map(|()| value)
    }

    fn facets(&self, along: f64, across: Option<f64>, table: &str) -> Result<Ggx> {
        let key = |name: &str| format!("part.surface.{table}.{name}");
        self.within(along, &key("roughness"), ROUGHNESS)?;
        let across = across.map(|across| self.within(across, &key("roughness_across"), ROUGHNESS));
        let across = across.transpose()?.unwrap_or(along);
        Ok(Ggx { along, across })
    }

    fn metal(&self, table: &MetalTable, wavelength_nm: f64) -> Result<Metal> {
        let facets = self.facets(table.roughness, table.roughness_across, "metal")?;
        let (n, k) = match (&table.name, table.n, table.k) {
            (Some(name), None, None) => {
                let names: Vec<_> = metal_names().collect();
                let [from, to] = WAVELENGTHS_NM;
                let expected = format!(
                    "one of {}, with laser.wavelength_nm from {from} to {to}; or n and k",
                    names.join(", ")
                );
                let index = metal_index(name, wavelength_nm);
                let wrong = || self.source.wrong("part.surface.metal.name", &expected);
                let (n, k, _) = index.ok_or_else(wrong)?;
                (n, k)
            }
            (None, Some(n), Some(k)) => (
                self.within(n, "part.surface.metal.n", [0.01, 100.0])?,
                self.within(k, "part.surface.metal.k", [0.0, 100.0])?,
            ),
            _ => {
                let expected = "either name, or n and k";
                return Err(self.source.wrong("part.surface.metal", expected));
            }
        };
        Ok(Metal::new(n, k, facets))
    }

    fn coat(&self, table: &CoatTable) -> Result<Coat> {
        let facets = self.facets(table.roughness, table.roughness_across, "coat")?;
        let index = self.within(table.index, "part.surface.coat.index", [1.05, 3.0])?;
        let reflectance = self.share(table.reflectance, "part.surface.coat.reflectance")?;
        Ok(Coat::new(index, reflectance, facets))
    }

    fn lay(&self, table: &LayTable) -> Result<Lay> {
        match (table.direction, table.axis_direction) {
            (Some(direction), None) => {
                let direction = self.direction(direction, "part.surface.lay.direction")?;
                Ok(Lay::Along(direction))
            }
            (None, Some(axis)) => {
                let point = self.lengths(table.axis_point_mm, "part.surface.lay.axis_point_mm")?;
                let axis = self.direction(axis, "part.surface.lay.axis_direction")?;
                Ok(Lay::About {
                    point: point.into(),
                    axis,
                })
            }
            _ => {
                let expected = "exactly one of direction and axis_direction";
                Err(self.source.wrong("part.surface.lay", expected))
            }
        }
    }
}

/// Share of the light that a surface across the beam sends to the camera without having let it in, where the
/// optical axis passes.
pub(super) fn polarised(
    surface: &Glossy,
    head_from_laser: &Rigid,
    head_from_camera: &Rigid,
) -> f64 {
    let normal = -head_from_laser.rotation.z_axis;
    let towards_eye = -head_from_camera.rotation.z_axis;
    let lit = surface.lit(head_from_laser.translation, normal, normal);
    lit.polarised(towards_eye)
}
