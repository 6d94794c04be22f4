//! Validation of the part's surfaces.

use super::file::PartTable;
use super::resolver::Resolver;
use super::surface_table::{
    CoatedDiffuseTable, DiffuseTable, LayTable, MetalTable, MirrorTable, SurfaceTable,
    TopographyTable,
};
use crate::error::{Result, printable};
use crate::math::Rigid;
use crate::math::rng::{Purpose, RngKey};
use crate::mesh::Groups;
use crate::surface::{
    CoatedDiffuse, Conductor, Ggx, Lambert, Lay, LayeredBrdf, Lobe, Material, Materials, Mirror,
    Surface, Topography, WAVELENGTHS_NM, metal_index, metal_names,
};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Smallest and largest roughness α; below the smallest, a lobe is modelled as a mirror.
const ROUGHNESS: [f64; 2] = [0.01, 1.0];

/// Smallest and largest autocorrelation length, mm.
const LENGTHS_MM: [f64; 2] = [1e-3, 1e6];

/// Table of a surface, with its dotted key.
struct SurfaceEntry<'a> {
    key: String,
    table: &'a SurfaceTable,
}

impl Resolver<'_> {
    /// Returns the surfaces of the mesh's triangles. `seed` selects the topographies. `polarised`
    /// computes the degree of polarisation of a non-Lambertian surface, if the scene does not state
    /// it.
    pub(super) fn surfaces(
        &self,
        part: &PartTable,
        (wavelength_nm, seed): (f64, u64),
        (groups, triangles): (&Groups, usize),
        polarised: impl Fn(&LayeredBrdf) -> f64,
    ) -> Result<Materials> {
        let named = |key: String, table| SurfaceEntry { key, table };
        let rest = (part.reflectance, part.surface.as_ref());
        let rest = self.base_surface(rest, "part", wavelength_nm)?;
        let kind = |name: Option<&String>, surface: Surface, topography| Material {
            name: name.cloned(),
            topography,
            degree_of_polarisation: (part.polarisation_degree)
                .unwrap_or_else(|| surface.glossy().map_or(1.0, &polarised)),
            surface,
        };
        let heights = self.heights(part.surface.as_ref(), "part.surface", (seed, 0))?;
        let mut kinds = vec![kind(None, rest, heights)];
        if part.surfaces.is_empty() {
            return Ok(Materials::new(kinds, Vec::new()));
        }
        let expected = format!("at most {} surfaces", Materials::MAX_MATERIALS - 1);
        let few = part.surfaces.len() < Materials::MAX_MATERIALS;
        self.check(few, "part.surfaces", &expected)?;
        let mut numbers = BTreeMap::new();
        let known = groups.names();
        for (name, table) in &part.surfaces {
            let key = format!("part.surfaces.{name}");
            self.check(known.contains(name.as_str()), &key, &names_of(&known))?;
            numbers.insert(name.as_str(), kinds.len() as u8);
            let heights = self.heights(Some(table), &key, (seed, kinds.len()))?;
            let surface = self.surface(&named(key, table), wavelength_nm)?;
            kinds.push(kind(Some(name), surface, heights));
        }
        let numbers = groups.numbers(triangles, &numbers);
        let of_triangle = numbers.map_err(|[one, other]| {
            let expected =
                format!("one surface a triangle; some triangles are in {one} and {other}");
            self.source
                .input_error(&format!("part.surfaces.{other}"), &expected)
        })?;
        Ok(Materials::new(kinds, of_triangle))
    }

    /// Returns the topography of surface number `number`, which the seed selects.
    pub(super) fn heights(
        &self,
        table: Option<&SurfaceTable>,
        key: &str,
        (seed, number): (u64, usize),
    ) -> Result<Option<Topography>> {
        let Some((table, heights)) = table.and_then(|t| Some((t, t.topography.as_ref()?))) else {
            return Ok(None);
        };
        let own = RngKey::new(seed, Purpose::Topography).with(number as u64);
        self.topography(heights, table, key, own).map(Some)
    }

    /// Returns the surface of a table with exactly one of `reflectance` and `surface`.
    pub(super) fn base_surface(
        &self,
        (reflectance, surface): (Option<f64>, Option<&SurfaceTable>),
        key: &str,
        wavelength_nm: f64,
    ) -> Result<Surface> {
        match (surface, reflectance) {
            (None, Some(reflectance)) => {
                let reflectance = self.share(reflectance, &format!("{key}.reflectance"))?;
                Ok(Lambert { reflectance }.into())
            }
            (Some(table), None) => {
                let key = format!("{key}.surface");
                self.surface(&SurfaceEntry { key, table }, wavelength_nm)
            }
            (Some(_), Some(_)) => {
                let key = format!("{key}.reflectance");
                let expected = format!(
                    "no {key} with [{}surface]",
                    key.trim_end_matches("reflectance")
                );
                Err(self.source.input_error(&key, &expected))
            }
            (None, None) => {
                let expected = format!("reflectance = ... in [{key}], or a table [{key}.surface]");
                Err(self.source.input_error(key, &expected))
            }
        }
    }

    fn surface(&self, named: &SurfaceEntry, wavelength_nm: f64) -> Result<Surface> {
        let SurfaceEntry { key, table } = named;
        let mut lobes = Vec::new();
        if let Some(metal) = &table.metal {
            lobes.push((
                metal.weight,
                Lobe::Metal(self.metal(metal, key, wavelength_nm)?),
            ));
        }
        if let Some(coat) = &table.coated_diffuse {
            lobes.push((coat.weight, Lobe::CoatedDiffuse(self.coat(coat, key)?)));
        }
        if let Some(DiffuseTable {
            reflectance,
            weight,
        }) = table.diffuse
        {
            self.share(reflectance, &format!("{key}.diffuse.reflectance"))?;
            lobes.push((weight, Lobe::Diffuse(Lambert { reflectance })));
        }
        if let Some(MirrorTable {
            reflectance,
            weight,
        }) = table.mirror
        {
            self.share(reflectance, &format!("{key}.mirror.reflectance"))?;
            lobes.push((weight, Lobe::Mirror(Mirror { reflectance })));
        }
        self.check(
            !lobes.is_empty(),
            key,
            "at least one of metal, coated_diffuse, diffuse and mirror",
        )?;
        let shares = || lobes.iter().map(|(share, _)| share);
        self.check(
            // The tolerance covers the rounding of a sum of decimal weights.
            shares().all(|s| (0.0..=1.0).contains(s)) && shares().sum::<f64>() <= 1.0 + 1e-9,
            key,
            "weights from 0 to 1 whose sum is at most 1",
        )?;
        let lay = table.lay.as_ref();
        let lay = lay.map(|lay| self.lay(lay, key)).transpose()?;
        let across = |across: Option<f64>| across.is_some();
        let needs_lay = table.metal.as_ref().is_some_and(|m| across(m.roughness_v))
            || table
                .coated_diffuse
                .as_ref()
                .is_some_and(|c| across(c.roughness_v));
        self.check(
            lay.is_some() || !needs_lay,
            key,
            "a table lay, as roughness_v is given",
        )?;
        Ok(Surface::Layered(Arc::new(LayeredBrdf { lobes, lay })))
    }

    fn share(&self, value: f64, key: &str) -> Result<f64> {
        self.check((0.0..=1.0).contains(&value), key, "a number from 0 to 1")
            .map(|()| value)
    }

    fn facets(&self, along: f64, across: Option<f64>, table: &str) -> Result<Ggx> {
        let key = |name: &str| format!("{table}.{name}");
        self.within(along, &key("roughness"), ROUGHNESS)?;
        let across = across.map(|across| self.within(across, &key("roughness_v"), ROUGHNESS));
        let across = across.transpose()?.unwrap_or(along);
        Ok(Ggx {
            alpha_u: along,
            alpha_v: across,
        })
    }

    fn metal(&self, table: &MetalTable, surface: &str, wavelength_nm: f64) -> Result<Conductor> {
        let own = format!("{surface}.metal");
        let facets = self.facets(table.roughness, table.roughness_v, &own)?;
        let (n, k) = match (&table.name, table.n, table.k) {
            (Some(name), None, None) => {
                let names: Vec<_> = metal_names().collect();
                let [from, to] = WAVELENGTHS_NM;
                let expected = format!(
                    "one of {}, with laser.wavelength_nm from {from} to {to}; or n and k",
                    names.join(", ")
                );
                let index = metal_index(name, wavelength_nm);
                let wrong = || self.source.input_error(&format!("{own}.name"), &expected);
                let (n, k, _) = index.ok_or_else(wrong)?;
                (n, k)
            }
            (None, Some(n), Some(k)) => (
                self.within(n, &format!("{own}.n"), [0.01, 100.0])?,
                self.within(k, &format!("{own}.k"), [0.0, 100.0])?,
            ),
            _ => {
                let expected = "either name, or n and k";
                return Err(self.source.input_error(&own, expected));
            }
        };
        Ok(Conductor::new(n, k, facets))
    }

    fn coat(&self, table: &CoatedDiffuseTable, surface: &str) -> Result<CoatedDiffuse> {
        let own = format!("{surface}.coated_diffuse");
        let facets = self.facets(table.roughness, table.roughness_v, &own)?;
        let index = self.within(table.index, &format!("{own}.index"), [1.05, 3.0])?;
        let reflectance = self.share(table.reflectance, &format!("{own}.reflectance"))?;
        Ok(CoatedDiffuse::new(index, reflectance, facets))
    }

    fn topography(
        &self,
        table: &TopographyTable,
        surface: &SurfaceTable,
        name: &str,
        own: RngKey,
    ) -> Result<Topography> {
        let key = |of: &str| format!("{name}.topography.{of}");
        let sq = self.within(table.sq_um, &key("sq_um"), [0.0, 1e4])? * 1e-3;
        let across = self.within(table.length_mm, &key("length_mm"), LENGTHS_MM)?;
        let lay = surface.lay.as_ref();
        let lay = lay.map(|lay| self.lay(lay, name)).transpose()?;
        let along = match table.length_along_mm {
            None => across,
            Some(along) => {
                let key = key("length_along_mm");
                self.check(lay.is_some(), &key, "a table lay of the surface with it")?;
                self.within(along, &key, [across, LENGTHS_MM[1]])?
            }
        };
        Ok(Topography::new(sq, [along, across], lay, own))
    }

    fn lay(&self, table: &LayTable, surface: &str) -> Result<Lay> {
        let key = |name: &str| format!("{surface}.lay.{name}");
        match (table.direction, table.axis_direction) {
            (Some(direction), None) => {
                let direction = self.direction(direction, &key("direction"))?;
                Ok(Lay::Along(direction))
            }
            (None, Some(axis)) => {
                let point = self.lengths(table.axis_point_mm, &key("axis_point_mm"))?;
                let axis = self.direction(axis, &key("axis_direction"))?;
                Ok(Lay::About {
                    point: point.into(),
                    axis,
                })
            }
            _ => {
                let expected = "exactly one of direction and axis_direction";
                Err(self.source.input_error(&format!("{surface}.lay"), expected))
            }
        }
    }
}

/// Lists the valid names for a mesh whose triangles have these group names.
fn names_of(names: &BTreeSet<&str>) -> String {
    const SHOWN: usize = 40;
    let shown: Vec<_> = names
        .iter()
        .take(SHOWN)
        .map(|name| printable::short(name))
        .collect();
    match names.len() {
        0 => "no such table, as the mesh names no groups of triangles (OBJ g, o or usemtl; PLY faces with \
              material_index; glTF materials)"
            .to_owned(),
        n if n > SHOWN => format!("a name of the mesh: {} and {} more", shown.join(", "), n - SHOWN),
        _ => format!("a name of the mesh: {}", shown.join(", ")),
    }
}

/// Fraction of the light that a surface perpendicular to the beam reflects to the camera without
/// transmission into the surface, on the optical axis.
pub(super) fn degree_of_polarisation(
    surface: &LayeredBrdf,
    head_from_laser: &Rigid,
    head_from_camera: &Rigid,
) -> f64 {
    let normal = -head_from_laser.rotation.z_axis;
    let towards_eye = -head_from_camera.rotation.z_axis;
    let lit = surface.lit(head_from_laser.translation, normal, normal);
    lit.degree_of_polarisation(towards_eye)
}
