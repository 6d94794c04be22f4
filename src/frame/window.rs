//! Bands of tiles at hand, and which pixels see the same surface as all around them.

use super::pixels::SIDE;
use super::rays::{Met, NORMAL_TOLERANCE, Plane};
use crate::accel::WIDTH;
use crate::math::DVec3;
use wide::f32x4;

/// Bands at hand: that of a pixel and of its neighbours.
const BANDS: usize = 3;

/// What the centres of the last bands filled in see.
#[derive(Default)]
pub(super) struct Window {
    bands: [Band; BANDS],
}

#[derive(Default)]
struct Band {
    /// For each tile of the band, counted from the left, its place in `tiles`.
    places: Vec<u32>,
    /// Those past the last place are left from other bands.
    tiles: Vec<[Met; WIDTH]>,
}

const MISSING: u32 = u32::MAX;

impl Band {
    /// `None` for a tile that was not filled in.
    fn tile(&self, tile: usize) -> Option<&[Met; WIDTH]> {
        let place = *self.places.get(tile)?;
        self.tiles.get(place as usize)
    }
}

/// Pixels of a tile, as bits, by what their centres and the eight around each see.
pub(super) struct Sorted {
    /// None is lit, nor does surface beyond the light lie on both sides of the laser's sheet: a wall between that
    /// is seen nearly edge-on may be lit.
    pub dark: u16,
    /// Others: all one plane, and where light can reach two of them, both lit or neither.
    pub flat: u16,
}

impl Window {
    /// Takes in the tiles of these first columns, from left to right, each as `centers`
    /// writes it, in the place of the band [`BANDS`] before.
    pub fn fill(
        &mut self,
        band: usize,
        firsts: impl Iterator<Item = usize>,
        centers: impl Fn(usize, &mut [Met; WIDTH]),
    ) {
        let Band { places, tiles } = &mut self.bands[band % BANDS];
        places.clear();
        for (place, first) in firsts.enumerate() {
            places.resize(first / SIDE, MISSING);
            places.push(place as u32);
            if place == tiles.len() {
                tiles.push([const { Met::Nothing }; WIDTH]);
            }
            centers(first, &mut tiles[place]);
        }
    }

    /// A tile filled in, by its first column.
    pub fn tile(&self, band: usize, first: usize) -> &[Met; WIDTH] {
        let tile = self.bands[band % BANDS].tile(first / SIDE);
        tile.expect("tiles are looked at after they are filled in")
    }

    /// Sorts the pixels of a tile that are `wanted` (as bits) by what they see with the eight
    /// around each. Past the sensor's border (`size`, columns and rows) are no pixels. All tiles
    /// around those wanted must have been filled in. `is_sheet`: the laser is a line. `turn`: the
    /// greatest difference of normals on one plane, if it is less than elsewhere.
    pub fn sorted(
        &self,
        band: usize,
        first: usize,
        size: [usize; 2],
        wanted: u16,
        is_sheet: bool,
        turn: Option<f32>,
    ) -> Sorted {
        let here = self.tile(band, first);
        // Where nothing is seen no planes are compared.
        let origin = here.iter().find_map(|center| Some(center.plane()?.point));
        Around::new(self, band, first, size, origin.unwrap_or_default())
            .sorted(wanted, is_sheet, turn)
    }
}

impl Window {
    /// Which pixels of a tile see one kind of surface with the eight around each, of those `wanted`, as bits; see
    /// [`Window::sorted`].
    pub fn of_one_kind(&self, band: usize, first: usize, size: [usize; 2], wanted: u16) -> u16 {
        let kind = |column: usize, row: usize| {
            let tile = self.bands[row / SIDE % BANDS].tile(column / SIDE)?;
            let plane = tile[row % SIDE * SIDE + column % SIDE].plane()?;
            Some(plane.kind)
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

impl Met {
    fn plane(&self) -> Option<&Plane> {
        match self {
            Met::Nothing | Met::Far { .. } => None,
            Met::Dark(plane) | Met::Beside(plane) | Met::Unlit(plane) | Met::Lit(_, plane) => {
                Some(plane)
            }
        }
    }
}

/// Cells of a row of [`Around`], of which six are used.
const STRIDE: usize = 8;
const CELLS: usize = STRIDE * (SIDE + 2);
/// A cell with the eight around it, as bits from the first of them on.
const NINE: u64 = 0x07 << (2 * STRIDE) | 0x07 << STRIDE | 0x07;

/// A tile and the pixels around it: planes relative to a point of the tile, in f32.
struct Around {
    /// Which cells see nothing, lit and unlit surface, as bits.
    nothing: u64,
    lit: u64,
    unlit: u64,
    /// And which surface beyond the light, above the laser's sheet and below it; [`Met::Beside`] is both.
    above: u64,
    below: u64,
    points: [[f32; CELLS]; 3],
    normals: [[f32; CELLS]; 3],
    tolerances: [f32; CELLS],
}

impl Around {
    fn new(
        window: &Window,
        band: usize,
        first: usize,
        [columns, rows]: [usize; 2],
        origin: DVec3,
    ) -> Around {
        let mut around = Around {
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
            // Past the border a pixel stands for itself.
            let row = (SIDE * band + i).saturating_sub(1).min(rows - 1);
            let tiles = &window.bands[row / SIDE % BANDS];
            for j in 0..SIDE + 2 {
                let column = (first + j).saturating_sub(1).min(columns - 1);
                let center = tiles
                    .tile(column / SIDE)
                    .map_or(&Met::Nothing, |t| &t[row % SIDE * SIDE + column % SIDE]);
                around.set(STRIDE * i + j, center, origin);
            }
        }
        around
    }

    #[inline(always)]
    fn set(&mut self, cell: usize, center: &Met, origin: DVec3) {
        let bits = match center {
            Met::Nothing | Met::Far { .. } => &mut self.nothing,
            Met::Dark(_) | Met::Beside(_) => &mut 0,
            Met::Unlit(_) => &mut self.unlit,
            Met::Lit(..) => &mut self.lit,
        };
        *bits |= 1 << cell;
        let [above, below] = match center {
            Met::Far { above } => [*above, !above],
            Met::Dark(plane) => [plane.point.y > 0.0, plane.point.y <= 0.0],
            Met::Beside(_) => [true; 2],
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

    /// Those pixels of the tile for which `is(first of the nine cells)` holds.
    fn pixels(wanted: u16, is: impl Fn(usize) -> bool) -> u16 {
        let wanted = (0..WIDTH).filter(|pixel| wanted >> pixel & 1 == 1);
        let pixels = wanted.filter(|pixel| is(STRIDE * (pixel / SIDE) + pixel % SIDE));
        pixels.fold(0, |bits, pixel| bits | 1 << pixel)
    }

    fn sorted(&self, wanted: u16, is_sheet: bool, turn: Option<f32>) -> Sorted {
        let near = |bits: u64, cell: usize| bits >> cell & NINE != 0;
        let centre = |bits: u64, cell: usize| bits >> (cell + STRIDE + 1) & 1 == 1;
        let both_sides = |cell: usize| near(self.above, cell) && near(self.below, cell);
        let dark = Around::pixels(wanted, |cell| match is_sheet {
            true => !near(self.lit, cell) && !both_sides(cell),
            false => self.nothing >> cell & NINE == NINE,
        });
        let surface = Around::pixels(wanted & !dark, |cell| {
            let parted = centre(self.lit, cell) && near(self.unlit, cell)
                || centre(self.unlit, cell) && near(self.lit, cell);
            let is_coarse = centre(self.above & self.below, cell);
            !near(self.nothing, cell) && !parted && !is_coarse
        });
        let rows = (0..SIDE).filter(|row| surface >> (SIDE * row) & 0xf != 0);
        let flat = rows.fold(0, |bits, row| bits | self.flat(row, turn) << (SIDE * row));
        Sorted {
            dark,
            flat: surface & flat,
        }
    }

    /// Which pixels of a row of the tile lie on one plane with those around them.
    fn flat(&self, row: usize, turn: Option<f32>) -> u16 {
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
                // NaN is neither.
                flat &= beside.simd_le(tolerance);
                flat &= dot(normal, n).simd_ge(f32x4::splat(NORMAL_TOLERANCE));
                if let Some(turn) = turn {
                    // Not by the cosine: of small angles f32 leaves nothing of it.
                    let apart = [0, 1, 2].map(|k| n[k] - normal[k]);
                    flat &= dot(apart, apart).simd_le(f32x4::splat(turn * turn));
                }
            }
        }
        flat.to_bitmask() as u16
    }
}
