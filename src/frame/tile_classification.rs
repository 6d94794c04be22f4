//! Sliding window of traced tile rows, and classification of pixels by their neighbourhood.

use super::pixel_mask::SIDE;
use super::rays::{NORMAL_TOLERANCE, PixelHit, SurfaceElement};
use crate::accel::WIDTH;
use crate::math::DVec3;
use wide::f32x4;

/// Number of tile rows in the window: the current one and its two neighbours.
const BANDS: usize = 3;

/// Classified hits at the pixel centres of the latest tile rows.
#[derive(Default)]
pub(super) struct TileHitCache {
    bands: [TileRow; BANDS],
}

#[derive(Default)]
struct TileRow {
    /// Index in `tiles` for each tile of the tile row, counted from the left.
    places: Vec<u32>,
    /// Tiles of the row. Entries past the last index are unused and belong to earlier rows.
    tiles: Vec<[PixelHit; WIDTH]>,
}

const MISSING: u32 = u32::MAX;

impl TileRow {
    /// Returns a tile; `None` if it was not traced.
    fn tile(&self, tile: usize) -> Option<&[PixelHit; WIDTH]> {
        let place = *self.places.get(tile)?;
        self.tiles.get(place as usize)
    }
}

/// Classification of the pixels of a tile by their neighbourhoods of nine pixel centres, as bit
/// masks.
pub(super) struct TileClassification {
    /// Dark pixels: no centre is lit, and surface beyond the cut-off is on one side of the laser
    /// plane only. With surface on both sides, a wall between them that is nearly edge-on may be
    /// lit.
    pub dark: u16,
    /// Planar pixels, except dark ones: all centres are coplanar. Where light can reach two of
    /// them, both are lit or both are unlit.
    pub flat: u16,
}

impl TileHitCache {
    /// Traces the tiles with these first columns, in ascending order, by calling `centers` for
    /// each. They replace the tile row [`BANDS`] rows before.
    pub fn fill(
        &mut self,
        band: usize,
        firsts: impl Iterator<Item = usize>,
        centers: impl Fn(usize, &mut [PixelHit; WIDTH]),
    ) {
        let TileRow { places, tiles } = &mut self.bands[band % BANDS];
        places.clear();
        for (place, first) in firsts.enumerate() {
            places.resize(first / SIDE, MISSING);
            places.push(place as u32);
            if place == tiles.len() {
                tiles.push([const { PixelHit::Nothing }; WIDTH]);
            }
            centers(first, &mut tiles[place]);
        }
    }

    /// Returns the traced tile with this first column.
    pub fn tile(&self, band: usize, first: usize) -> &[PixelHit; WIDTH] {
        let tile = self.bands[band % BANDS].tile(first / SIDE);
        tile.expect("tiles are looked at after they are filled in")
    }

    /// Classifies the `wanted` pixels (bit mask) of a tile by their neighbourhoods. Positions
    /// beyond the sensor border (`size`, columns and rows) are ignored. All tiles around the wanted
    /// pixels must have been traced. `is_sheet`: true for a line laser. `turn`: maximum difference
    /// of normals on one plane, if it is less than the default.
    pub fn sorted(
        &self,
        band: usize,
        first: usize,
        size: [usize; 2],
        wanted: u16,
        is_sheet: bool,
        turn: Option<f32>,
    ) -> TileClassification {
        let here = self.tile(band, first);
        // Without any hit, planes are not compared.
        let origin = here.iter().find_map(|center| Some(center.plane()?.point));
        TileNeighborhood::new(self, band, first, size, origin.unwrap_or_default())
            .sorted(wanted, is_sheet, turn)
    }
}

impl TileHitCache {
    /// Returns the `wanted` pixels (bit mask) of a tile whose neighbourhoods have a single
    /// material; see [`TileHitCache::sorted`].
    pub fn of_one_kind(&self, band: usize, first: usize, size: [usize; 2], wanted: u16) -> u16 {
        let kind = |column: usize, row: usize| {
            let tile = self.bands[row / SIDE % BANDS].tile(column / SIDE)?;
            let plane = tile[row % SIDE * SIDE + column % SIDE].plane()?;
            Some(plane.material_id)
        };
        let near = |at: usize, most: usize| at.saturating_sub(1)..=(at + 1).min(most - 1);
        let [columns, rows] = size;
        let mut alike = 0;
        for pixel in (0..WIDTH).filter(|pixel| wanted >> pixel & 1 == 1) {
            let (column, row) = (first + pixel % SIDE, SIDE * band + pixel / SIDE);
            let around = near(row, rows)
                .flat_map(|row| near(column, columns).map(move |column| (column, row)));
            let mut kinds = around.filter_map(|(column, row)| kind(column, row));
            let one = kinds.next();
            alike |= u16::from(kinds.all(|kind| Some(kind) == one)) << pixel;
        }
        alike
    }
}

impl PixelHit {
    fn plane(&self) -> Option<&SurfaceElement> {
        match self {
            PixelHit::Nothing | PixelHit::BeyondBeam { .. } => None,
            PixelHit::OutsideBeam(plane)
            | PixelHit::NeedsSubsampling(plane)
            | PixelHit::Shadowed(plane)
            | PixelHit::Lit(_, plane) => Some(plane),
        }
    }
}

/// Number of cells per row of [`TileNeighborhood`], including two unused ones.
const STRIDE: usize = 8;
const CELLS: usize = STRIDE * (SIDE + 2);
/// Bit mask of a 3 × 3 neighbourhood, starting at its first cell.
const NINE: u64 = 0x07 << (2 * STRIDE) | 0x07 << STRIDE | 0x07;

/// Tile and its adjacent pixels: planes relative to a point of the tile, in f32.
struct TileNeighborhood {
    /// Bit masks of cells without a hit, with lit surface and with unlit surface.
    nothing: u64,
    lit: u64,
    unlit: u64,
    /// Bit masks of cells with surface beyond the cut-off, above and below the laser plane.
    /// [`PixelHit::NeedsSubsampling`] sets both.
    above: u64,
    below: u64,
    points: [[f32; CELLS]; 3],
    normals: [[f32; CELLS]; 3],
    tolerances: [f32; CELLS],
}

impl TileNeighborhood {
    fn new(
        window: &TileHitCache,
        band: usize,
        first: usize,
        [columns, rows]: [usize; 2],
        origin: DVec3,
    ) -> TileNeighborhood {
        let mut around = TileNeighborhood {
            nothing: 0,
            lit: 0,
            unlit: 0,
            above: 0,
            below: 0,
            points: [[0.0; CELLS]; 3],
            normals: [[0.0; CELLS]; 3],
            tolerances: [0.0; CELLS],
        };
        for i in 0..SIDE + 2 {
            // Beyond the border, the nearest pixel is repeated.
            let row = (SIDE * band + i).saturating_sub(1).min(rows - 1);
            let tiles = &window.bands[row / SIDE % BANDS];
            for j in 0..SIDE + 2 {
                let column = (first + j).saturating_sub(1).min(columns - 1);
                let center = tiles.tile(column / SIDE).map_or(&PixelHit::Nothing, |t| {
                    &t[row % SIDE * SIDE + column % SIDE]
                });
                around.set(STRIDE * i + j, center, origin);
            }
        }
        around
    }

    #[inline(always)]
    fn set(&mut self, cell: usize, center: &PixelHit, origin: DVec3) {
        let bits = match center {
            PixelHit::Nothing | PixelHit::BeyondBeam { .. } => &mut self.nothing,
            PixelHit::OutsideBeam(_) | PixelHit::NeedsSubsampling(_) => &mut 0,
            PixelHit::Shadowed(_) => &mut self.unlit,
            PixelHit::Lit(..) => &mut self.lit,
        };
        *bits |= 1 << cell;
        let [above, below] = match center {
            PixelHit::BeyondBeam { above } => [*above, !above],
            PixelHit::OutsideBeam(plane) => [plane.point.y > 0.0, plane.point.y <= 0.0],
            PixelHit::NeedsSubsampling(_) => [true; 2],
            _ => [false; 2],
        };
        self.above |= u64::from(above) << cell;
        self.below |= u64::from(below) << cell;
        if let Some(plane) = center.plane() {
            let point = (plane.point - origin).as_vec3();
            let normal = plane.normal.as_vec3();
            for axis in 0..3 {
                self.points[axis][cell] = point[axis];
                self.normals[axis][cell] = normal[axis];
            }
            self.tolerances[cell] = plane.tolerance;
        }
    }

    /// Returns the wanted pixels for which `is(first of the nine cells)` holds.
    fn pixels(wanted: u16, is: impl Fn(usize) -> bool) -> u16 {
        let wanted = (0..WIDTH).filter(|pixel| wanted >> pixel & 1 == 1);
        let pixels = wanted.filter(|pixel| is(STRIDE * (pixel / SIDE) + pixel % SIDE));
        pixels.fold(0, |bits, pixel| bits | 1 << pixel)
    }

    fn sorted(&self, wanted: u16, is_sheet: bool, turn: Option<f32>) -> TileClassification {
        let near = |bits: u64, cell: usize| bits >> cell & NINE != 0;
        let centre = |bits: u64, cell: usize| bits >> (cell + STRIDE + 1) & 1 == 1;
        let both_sides = |cell: usize| near(self.above, cell) && near(self.below, cell);
        let dark = TileNeighborhood::pixels(wanted, |cell| match is_sheet {
            true => !near(self.lit, cell) && !both_sides(cell),
            false => self.nothing >> cell & NINE == NINE,
        });
        let surface = TileNeighborhood::pixels(wanted & !dark, |cell| {
            let parted = centre(self.lit, cell) && near(self.unlit, cell)
                || centre(self.unlit, cell) && near(self.lit, cell);
            let is_coarse = centre(self.above & self.below, cell);
            !near(self.nothing, cell) && !parted && !is_coarse
        });
        let rows = (0..SIDE).filter(|row| surface >> (SIDE * row) & 0xf != 0);
        let flat = rows.fold(0, |bits, row| {
            bits | self.planar_mask(row, turn) << (SIDE * row)
        });
        TileClassification {
            dark,
            flat: surface & flat,
        }
    }

    /// Returns the pixels of a tile's row that are coplanar with their neighbours.
    fn planar_mask(&self, row: usize, turn: Option<f32>) -> u16 {
        let four = |values: &[f32; CELLS], cell: usize| {
            f32x4::from(<[f32; 4]>::try_from(&values[cell..cell + 4]).expect("four of them"))
        };
        let three = |values: &[[f32; CELLS]; 3], cell| [0, 1, 2].map(|k| four(&values[k], cell));
        let dot = |a: [f32x4; 3], b: [f32x4; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let first = STRIDE * row;
        let here = first + STRIDE + 1;
        let (point, normal) = (three(&self.points, here), three(&self.normals, here));
        let tolerance = four(&self.tolerances, here);
        let mut flat = f32x4::splat(f32::from_bits(u32::MAX));
        for cell in [0, 1, 2].map(|i| first + STRIDE * i) {
            for cell in cell..cell + 3 {
                let (p, n) = (three(&self.points, cell), three(&self.normals, cell));
                let beside = dot(normal, [0, 1, 2].map(|k| p[k] - point[k])).abs();
                // Comparisons with NaN are false, so such pixels are not planar.
                flat &= beside.simd_le(tolerance);
                flat &= dot(normal, n).simd_ge(f32x4::splat(NORMAL_TOLERANCE));
                if let Some(turn) = turn {
                    // Normals are compared by difference, because the f32 cosine of small angles
                    // rounds to 1.
                    let apart = [0, 1, 2].map(|k| n[k] - normal[k]);
                    flat &= dot(apart, apart).simd_le(f32x4::splat(turn * turn));
                }
            }
        }
        flat.to_bitmask() as u16
    }
}
