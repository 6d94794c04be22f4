//! Objects that are not inspected. Their triangles follow the triangles of the part in one mesh.

use super::object_table::ObjectTable;
use super::resolve::{Nominal, SceneMesh};
use super::resolver::Resolver;
use crate::error::Result;
use crate::math::Rigid;
use crate::mesh::{Groups, Mesh};
use crate::surface::{LayeredBrdf, Material, Materials};
use std::sync::Arc;

impl Resolver<'_> {
    /// Adds the objects to the mesh and the surfaces of the part. The part becomes the nominal
    /// geometry if the scene has no other. `merged` is the mesh of an existing scene with the same
    /// objects.
    pub(super) fn with_objects(
        &self,
        tables: &[ObjectTable],
        (part, groups): (SceneMesh, &Arc<Groups>),
        merged: Option<Arc<Mesh>>,
        (wavelength_nm, seed): (f64, u64),
        polarised: &dyn Fn(&LayeredBrdf) -> f64,
    ) -> Result<SceneMesh> {
        let count = part.mesh.triangles.len();
        let mut kinds = part.surface.kinds().to_vec();
        let mut of_triangle: Vec<u8> = (0..count as u32)
            .map(|triangle| part.surface.number(triangle) as u8)
            .collect();
        let expected = format!("at most {} surfaces and objects", Materials::MAX_MATERIALS);
        let few = kinds.len() + tables.len() <= Materials::MAX_MATERIALS;
        self.check(few, "object", &expected)?;
        let mut mesh = Mesh::clone(&part.mesh);
        let mut hash = Vec::new();
        for (i, table) in tables.iter().enumerate() {
            let key = format!("object.{i}");
            let reflectance = (table.reflectance, table.surface.as_ref());
            let surface = self.base_surface(reflectance, &key, wavelength_nm)?;
            let pose = self.pose(table.position_mm, table.rotation_deg, &key)?;
            let found = self.mesh_of_file(&table.file, table.unit, &key)?;
            hash.extend(found.hash);
            mesh.append(&found.mesh, &pose);
            of_triangle.resize(mesh.triangles.len(), kinds.len() as u8);
            let own = (seed, kinds.len());
            let topography =
                self.heights(table.surface.as_ref(), &format!("{key}.surface"), own)?;
            kinds.push(Material {
                name: Some(format!("object {}", i + 1)),
                topography,
                degree_of_polarisation: surface.glossy().map_or(1.0, polarised),
                surface,
            });
        }
        Ok(SceneMesh {
            mesh: merged.unwrap_or_else(|| Arc::new(mesh)),
            surface: Materials::new(kinds, of_triangle),
            nominal: part.nominal.or(Some(Nominal {
                mesh: part.mesh,
                groups: groups.clone(),
                part_from_nominal: Rigid::IDENTITY,
            })),
            part_triangles: Some(count as u32),
            hash,
        })
    }
}
