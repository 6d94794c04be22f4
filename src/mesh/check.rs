//! Mesh report: defects of a mesh that can impair a simulation.

use std::fmt;

use rayon::prelude::*;
use serde::Serialize;
use smallvec::SmallVec;

use super::Mesh;
use super::vertex_edges::{self, HalfEdge, VertexEdges};
use crate::math::{Aabb, DVec3};

/// Orientation of the triangles of a mesh.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Orientation {
    /// Closed and consistently wound, with normals pointing out of the material.
    Outward,
    /// Closed and consistently wound, with normals pointing into the material.
    Inward,
    /// No boundary, but neighbours disagree or no volume is enclosed.
    Mixed,
    /// With a boundary, so the mesh has no inside.
    Open,
}

/// Counts of elements and defects of a mesh.
///
/// An edge is a pair of vertices; a triangle traverses each of its edges in one direction.
/// Triangles with a repeated vertex count as degenerate and have no edges.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MeshReport {
    /// Number of triangles, including degenerate ones.
    pub triangles: usize,
    /// Number of vertices after welding.
    pub vertices: usize,
    /// Smallest box around the vertices, mm.
    pub bounds_mm: Aabb,
    /// Distance between adjacent representable numbers at the largest coordinate, mm.
    ///
    /// The number type is f32 if all coordinates are f32 values in one of the usual units,
    /// otherwise f64. Finer detail was lost before the file was written.
    pub coordinate_step_mm: f64,
    /// Number of edges of exactly one triangle.
    pub boundary_edges: usize,
    /// Number of edges of more than two triangles.
    pub non_manifold_edges: usize,
    /// Number of edges that a triangle traverses in the direction of an earlier triangle. It is 0
    /// if all neighbours agree; one flipped triangle adds three.
    pub winding_conflicts: usize,
    /// Number of triangles without area, which are kept. Their height is at most 1e-12 of the
    /// longest side, the limit at which f64 resolves a difference from zero.
    pub degenerate_triangles: usize,
    /// Number of triangles on the vertices of an earlier triangle, in either winding.
    pub duplicate_triangles: usize,
    /// Orientation of the triangles.
    pub orientation: Orientation,
    /// Enclosed volume (mm³), negative for an inward mesh; 0 for an open mesh.
    pub volume_mm3: f64,
}

/// Units (mm) in which the coordinates of a file may be f32 values.
const UNITS_MM: [f64; 5] = [1.0, 1e-3, 10.0, 1000.0, 25.4];

/// Largest acceptable ratio of coordinate step to part size: 0.25 µm on a part of 250 mm.
const MAX_RELATIVE_COORDINATE_STEP: f64 = 1e-6;

fn coordinate_step(mesh: &Mesh) -> f64 {
    let bounds = mesh.bounds();
    let largest = bounds.min.abs().max(bounds.max.abs()).max_element();
    let unit = UNITS_MM.into_iter().find(|unit| {
        let is_f32 = |c: f64| f64::from((c / unit) as f32) * unit == c;
        let mut coordinates = mesh.positions.iter().flat_map(|p| p.to_array());
        coordinates.all(is_f32)
    });
    match unit {
        Some(unit) => {
            let number = (largest / unit) as f32;
            f64::from(number.next_up() - number) * unit
        }
        None => largest.next_up() - largest,
    }
}

/// Examines a mesh. Uses 12 bytes per triangle during the analysis.
pub fn report(mesh: &Mesh) -> MeshReport {
    let edges = edges(mesh);
    let volume = signed_volume(mesh);
    let orientation = if edges.boundary > 0 {
        Orientation::Open
    } else if edges.unbalanced > 0 {
        Orientation::Mixed
    } else {
        facing(mesh, volume)
    };
    MeshReport {
        triangles: mesh.triangles.len(),
        vertices: mesh.positions.len(),
        bounds_mm: mesh.bounds(),
        coordinate_step_mm: coordinate_step(mesh),
        boundary_edges: edges.boundary,
        non_manifold_edges: edges.non_manifold,
        winding_conflicts: edges.conflicts,
        degenerate_triangles: (0..mesh.triangles.len())
            .filter(|&i| is_degenerate(mesh.triangle(i)))
            .count(),
        duplicate_triangles: duplicates(mesh),
        orientation,
        volume_mm3: match orientation {
            Orientation::Outward | Orientation::Inward => volume,
            Orientation::Mixed | Orientation::Open => 0.0,
        },
    }
}

/// Returns the orientation of a closed and consistently wound mesh of this signed volume.
pub(super) fn facing(mesh: &Mesh, volume: f64) -> Orientation {
    // Below the rounding error of the sum: a surface that encloses no volume.
    let size = mesh.bounds().size().length();
    match volume {
        v if v.abs() <= 1e-14 * size.powi(3) => Orientation::Mixed,
        v if v > 0.0 => Orientation::Outward,
        _ => Orientation::Inward,
    }
}

#[derive(Default)]
struct Edges {
    boundary: usize,
    non_manifold: usize,
    conflicts: usize,
    /// Number of edges that are traversed more often in one direction than in the other.
    unbalanced: usize,
}

fn edges(mesh: &Mesh) -> Edges {
    vertex_edges::of_all(mesh, |VertexEdges { ups, downs }| {
        let mut edges = Edges::default();
        let (mut ups, mut downs) = (ups.as_slice(), downs.as_slice());
        let take = |list: &mut &[HalfEdge], higher| {
            let count = list.iter().take_while(|side| side.higher == higher).count();
            *list = &list[count..];
            count
        };
        while let Some(higher) = (ups.first().into_iter().chain(downs.first()))
            .map(|side| side.higher)
            .min()
        {
            let (up, down) = (take(&mut ups, higher), take(&mut downs, higher));
            edges.boundary += usize::from(up + down == 1);
            edges.non_manifold += usize::from(up + down > 2);
            edges.conflicts += up.saturating_sub(1) + down.saturating_sub(1);
            edges.unbalanced += usize::from(up != down);
        }
        edges
    })
    .reduce(Edges::default, |a, b| Edges {
        boundary: a.boundary + b.boundary,
        non_manifold: a.non_manifold + b.non_manifold,
        conflicts: a.conflicts + b.conflicts,
        unbalanced: a.unbalanced + b.unbalanced,
    })
}

/// Returns the number of edges that an odd number of triangles have in common. Vertices at equal
/// positions count as one.
pub fn odd_edges(mesh: &Mesh) -> usize {
    let welded = Mesh::welded(&mesh.positions, &mesh.triangles);
    let counts = vertex_edges::of_all(&welded, |VertexEdges { ups, downs }| {
        let sides = ups.iter().chain(downs).map(|side| side.higher);
        let mut ends: SmallVec<[u32; 32]> = sides.collect();
        ends.sort_unstable();
        let edges = ends.chunk_by(|a, b| a == b);
        edges.filter(|edge| edge.len() % 2 == 1).count()
    });
    counts.sum()
}

/// Returns the sum of the signed tetrahedron volumes over all triangles (mm³). The apex is the
/// center of the mesh, so that an offset causes no loss of precision.
pub(super) fn signed_volume(mesh: &Mesh) -> f64 {
    let middle = mesh.bounds().center();
    (0..mesh.triangles.len())
        .map(|i| {
            let [a, b, c] = mesh.triangle(i).map(|p| p - middle);
            a.dot(b.cross(c)) / 6.0
        })
        .sum()
}

/// True if at least one triangle has an area that rays can hit.
pub fn has_area(mesh: &Mesh) -> bool {
    (0..mesh.triangles.len()).any(|i| !is_degenerate(mesh.triangle(i)))
}

fn is_degenerate([a, b, c]: [DVec3; 3]) -> bool {
    let longest = (a - b)
        .length_squared()
        .max((b - c).length_squared())
        .max((c - a).length_squared());
    (b - a).cross(c - a).length() <= 1e-12 * longest
}

fn duplicates(mesh: &Mesh) -> usize {
    let mut keys = mesh.triangles.clone();
    keys.par_iter_mut().for_each(|t| t.sort_unstable());
    keys.par_sort_unstable();
    keys.windows(2).filter(|pair| pair[0] == pair[1]).count()
}

/// Formats a length in mm to a nanometre; smaller digits are rounding errors.
fn length(mm: f64) -> String {
    let text = format!("{mm:.6}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    match text {
        "-0" => "0".to_owned(),
        text => text.to_owned(),
    }
}

/// Formats a positive number to six significant digits.
fn six_digits(number: f64) -> String {
    let step = 10f64.powi(number.log10().floor() as i32 - 5);
    match step {
        step if step >= 1.0 => format!("{:.0}", (number / step).round() * step),
        _ => length(number),
    }
}

impl fmt::Display for MeshReport {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let (min, size) = (self.bounds_mm.min, self.bounds_mm.size());
        let orientation = match self.orientation {
            Orientation::Outward => "closed, normals outward",
            Orientation::Inward => "closed, normals INWARD",
            Orientation::Mixed => "closed, but some normals outward and some inward",
            Orientation::Open => "open",
        };
        writeln!(f, "triangles         {}", self.triangles)?;
        writeln!(f, "vertices          {}", self.vertices)?;
        writeln!(
            f,
            "size              {} × {} × {} mm",
            length(size.x),
            length(size.y),
            length(size.z)
        )?;
        writeln!(
            f,
            "lowest corner     ({}, {}, {}) mm",
            length(min.x),
            length(min.y),
            length(min.z)
        )?;
        let step = self.coordinate_step_mm;
        write!(f, "coordinate step   {step:.1e} mm")?;
        if step > MAX_RELATIVE_COORDINATE_STEP * size.length() {
            write!(
                f,
                ": TOO COARSE, detail is lost; move the part to its origin where the file is made"
            )?;
        }
        writeln!(f)?;
        write!(f, "surface           {orientation}")?;
        if self.volume_mm3 != 0.0 {
            write!(f, ", volume {} mm³", six_digits(self.volume_mm3.abs()))?;
        }
        writeln!(f)?;
        let faults = [
            (self.boundary_edges, "edges of one triangle only"),
            (self.non_manifold_edges, "edges of more than two triangles"),
            (
                self.winding_conflicts,
                "edges whose triangles face opposite ways",
            ),
            (self.degenerate_triangles, "triangles without area"),
            (self.duplicate_triangles, "triangles given twice"),
        ];
        let faults = faults.iter().filter(|(count, _)| *count > 0);
        let faults: Vec<String> = faults.map(|(n, what)| format!("{n} {what}")).collect();
        match faults.is_empty() {
            true => write!(f, "faults            none"),
            false => write!(f, "faults            {}", faults.join(", ")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::shapes;

    fn changed(change: impl FnOnce(&mut Vec<[u32; 3]>)) -> MeshReport {
        let mut mesh = shapes::step_block(DVec3::new(4.0, 2.0, 3.0), 1.0).unwrap();
        change(&mut mesh.triangles);
        report(&mesh)
    }

    #[test]
    fn a_sound_block_and_its_inside_out_twin() {
        let valid = changed(|_| ());
        assert_eq!((valid.triangles, valid.vertices), (20, 12));
        assert_eq!(valid.orientation, Orientation::Outward);
        assert!((valid.volume_mm3 - 20.0).abs() < 1e-12);
        assert_eq!(
            [
                valid.boundary_edges,
                valid.non_manifold_edges,
                valid.winding_conflicts
            ],
            [0; 3]
        );
        assert_eq!(
            [valid.degenerate_triangles, valid.duplicate_triangles],
            [0; 2]
        );
        let inside_out = changed(|t| t.iter_mut().for_each(|t| t.swap(0, 1)));
        assert_eq!(inside_out.orientation, Orientation::Inward);
        assert!((inside_out.volume_mm3 + 20.0).abs() < 1e-12);
        assert!(inside_out.to_string().contains("INWARD"));
    }

    #[test]
    fn each_fault_is_counted() {
        let hole = changed(|t| t.truncate(19));
        assert_eq!(
            (hole.boundary_edges, hole.orientation),
            (3, Orientation::Open)
        );
        let flipped = changed(|t| t[5].swap(0, 1));
        assert_eq!(
            (flipped.winding_conflicts, flipped.orientation),
            (3, Orientation::Mixed)
        );
        assert_eq!(flipped.volume_mm3, 0.0);
        let twice = changed(|t| t.push([t[3][1], t[3][0], t[3][2]]));
        assert_eq!(
            (twice.duplicate_triangles, twice.non_manifold_edges),
            (1, 3)
        );
        let collapsed = changed(|t| t.push([7, 7, 3]));
        assert_eq!(
            (collapsed.degenerate_triangles, collapsed.boundary_edges),
            (1, 0)
        );
    }

    /// Tests the coordinate step: half a metre for f32 at 5200 km, and 2⁻²⁰ mm for f64. The step of
    /// a part in inches is an f32 step in inches.
    #[test]
    fn a_part_too_far_from_its_origin_is_said_to_be() {
        for (offset, unit, narrow, step, coarse) in [
            (0.0, 1.0, true, 2f64.powi(-22), false),
            (5.2e9, 1.0, true, 512.0, true),
            (5.2e9, 1.0, false, 2f64.powi(-20), false),
            (64.0, 25.4, true, 25.4 * 2f64.powi(-17), true),
            (1e4, 1000.0, true, 1000.0 * 2f64.powi(-10), true),
        ] {
            let mut mesh = shapes::step_block(DVec3::new(4.0, 2.1, 3.0), 1.3).unwrap();
            for p in &mut mesh.positions {
                *p += offset;
                if narrow {
                    *p = p.as_vec3().as_dvec3();
                }
                *p *= unit;
            }
            let report = report(&mesh);
            assert_eq!(report.coordinate_step_mm, step, "{offset} {unit}");
            assert_eq!(
                report.to_string().contains("TOO COARSE"),
                coarse,
                "{offset}"
            );
        }
    }

    #[test]
    fn a_doubled_sheet_encloses_nothing() {
        let mut mesh = shapes::plane(crate::math::DVec2::ONE).unwrap();
        assert_eq!(report(&mesh).orientation, Orientation::Open);
        let back: Vec<_> = mesh.triangles.iter().map(|&[a, b, c]| [c, b, a]).collect();
        mesh.triangles.extend(back);
        assert_eq!(report(&mesh).orientation, Orientation::Mixed);
    }
}
