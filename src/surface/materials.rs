//! Surfaces of a part with several materials.

use super::{LayeredBrdf, Surface, Topography};
use std::sync::Arc;

/// Surface of a part, or of each of its triangles.
#[derive(Clone)]
pub struct Materials {
    /// Materials; the first applies to triangles without a separate material.
    kinds: Arc<[Material]>,
    /// Material index of each triangle; empty for a single material.
    material_ids: Arc<[u8]>,
}

/// Material of some triangles of a part.
#[derive(Clone)]
pub struct Material {
    /// Name of the material; `None` for triangles without a separate material.
    pub name: Option<String>,
    /// Reflection model.
    pub surface: Surface,
    /// Degree of polarisation, 0 to 1, of the light towards the camera.
    pub degree_of_polarisation: f64,
    /// Heights of the surface; `None` for a smooth surface.
    pub topography: Option<Topography>,
}

impl<T: Into<Surface>> From<T> for Materials {
    /// Creates a uniform surface whose light stays polarised.
    fn from(surface: T) -> Materials {
        let kind = Material {
            name: None,
            surface: surface.into(),
            degree_of_polarisation: 1.0,
            topography: None,
        };
        Materials::new(vec![kind], Vec::new())
    }
}

impl Materials {
    /// Maximum number of materials.
    pub const MAX_MATERIALS: usize = 256;

    /// Creates surfaces from one to [`Materials::MAX_MATERIALS`] materials. `of_triangle` holds the
    /// material index of each triangle if there are several materials.
    pub fn new(kinds: Vec<Material>, of_triangle: Vec<u8>) -> Materials {
        debug_assert!((1..=Materials::MAX_MATERIALS).contains(&kinds.len()));
        debug_assert!(
            of_triangle
                .iter()
                .all(|&kind| usize::from(kind) < kinds.len())
        );
        Materials {
            kinds: kinds.into(),
            material_ids: of_triangle.into(),
        }
    }

    /// Returns the material index of a triangle.
    #[inline(always)]
    pub fn number(&self, triangle: u32) -> usize {
        let kind = self.material_ids.get(triangle as usize);
        kind.map_or(0, |&kind| usize::from(kind))
    }

    /// Returns the surface of a triangle.
    pub fn of(&self, triangle: u32) -> &Surface {
        &self.material(triangle).surface
    }

    /// Returns the material of a triangle.
    pub fn material(&self, triangle: u32) -> &Material {
        &self.kinds[self.number(triangle)]
    }

    /// Returns whether any material has a topography.
    pub fn has_topography(&self) -> bool {
        self.kinds.iter().any(|kind| kind.topography.is_some())
    }

    /// Returns all materials in the order of their indices.
    pub fn kinds(&self) -> &[Material] {
        &self.kinds
    }

    /// Returns the surfaces that are not Lambertian.
    pub fn glossy(&self) -> impl Iterator<Item = &LayeredBrdf> {
        self.kinds.iter().filter_map(|kind| kind.surface.glossy())
    }

    /// Returns the number of triangles of each material, given the total number of triangles.
    pub fn counts(&self, triangles: usize) -> Vec<usize> {
        let mut counts = vec![0; self.kinds.len()];
        self.material_ids
            .iter()
            .for_each(|&kind| counts[usize::from(kind)] += 1);
        counts[0] += triangles - self.material_ids.len();
        counts
    }

    /// Returns whether the speckle contrast differs between materials.
    pub fn polarisation_differs(&self) -> bool {
        let first = self.kinds[0].degree_of_polarisation;
        self.kinds
            .iter()
            .any(|kind| kind.degree_of_polarisation != first)
    }
}

impl serde::Serialize for Materials {
    /// Serialises one surface directly, and several surfaces by name.
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match &self.kinds[..] {
            [kind] => kind.surface.serialize(serializer),
            kinds => {
                let name = |kind: &Material| kind.name.clone().unwrap_or_default();
                serializer.collect_map(kinds.iter().map(|kind| (name(kind), &kind.surface)))
            }
        }
    }
}
