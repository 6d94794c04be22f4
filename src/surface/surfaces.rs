//! The surfaces of a part that is not all of one.

use super::{Glossy, Surface};
use std::sync::Arc;

/// A part's surface, or that of each of its triangles.
#[derive(Clone)]
pub struct Surfaces {
    /// The first is that of triangles without one of their own.
    kinds: Arc<[Kind]>,
    /// Number of each triangle's kind; empty where there is but one.
    of_triangle: Arc<[u8]>,
}

/// What some of a part's triangles are.
#[derive(Clone)]
pub struct Kind {
    /// The name of these triangles; `None`: those without a surface of their own.
    pub name: Option<String>,
    /// How they scatter light.
    pub surface: Surface,
    /// Degree of polarisation, 0 to 1, of what they send to the camera.
    pub polarised: f64,
}

impl<T: Into<Surface>> From<T> for Surfaces {
    /// The same everywhere, of light that stays polarised.
    fn from(surface: T) -> Surfaces {
        let kind = Kind {
            name: None,
            surface: surface.into(),
            polarised: 1.0,
        };
        Surfaces::new(vec![kind], Vec::new())
    }
}

impl Surfaces {
    /// Most kinds.
    pub const MOST: usize = 256;

    /// At least one and at most [`Surfaces::MOST`] kinds, and the number of each triangle's, if there are
    /// several.
    pub fn new(kinds: Vec<Kind>, of_triangle: Vec<u8>) -> Surfaces {
        debug_assert!((1..=Surfaces::MOST).contains(&kinds.len()));
        debug_assert!(
            of_triangle
                .iter()
                .all(|&kind| usize::from(kind) < kinds.len())
        );
        Surfaces {
            kinds: kinds.into(),
            of_triangle: of_triangle.into(),
        }
    }

    /// The number of a triangle's kind.
    #[inline(always)]
    pub fn number(&self, triangle: u32) -> usize {
        let kind = self.of_triangle.get(triangle as usize);
        kind.map_or(0, |&kind| usize::from(kind))
    }

    /// A triangle's surface.
    pub fn of(&self, triangle: u32) -> &Surface {
        &self.kinds[self.number(triangle)].surface
    }

    /// All kinds, by their numbers.
    pub fn kinds(&self) -> &[Kind] {
        &self.kinds
    }

    /// Those that are not Lambert's.
    pub fn glossy(&self) -> impl Iterator<Item = &Glossy> {
        self.kinds.iter().filter_map(|kind| kind.surface.glossy())
    }

    /// How many of so many triangles are of each kind.
    pub fn counts(&self, triangles: usize) -> Vec<usize> {
        let mut counts = vec![0; self.kinds.len()];
        self.of_triangle
            .iter()
            .for_each(|&kind| counts[usize::from(kind)] += 1);
        counts[0] += triangles - self.of_triangle.len();
        counts
    }

    /// Whether speckle has another contrast on some kinds than on others.
    pub fn polarisation_differs(&self) -> bool {
        let first = self.kinds[0].polarised;
        self.kinds.iter().any(|kind| kind.polarised != first)
    }
}

impl serde::Serialize for Surfaces {
    /// One surface as itself, several by name.
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match &self.kinds[..] {
            [kind] => kind.surface.serialize(serializer),
            kinds => {
                let name = |kind: &Kind| kind.name.clone().unwrap_or_default();
                serializer.collect_map(kinds.iter().map(|kind| (name(kind), &kind.surface)))
            }
        }
    }
}
