//! Coordinates as integers: wrapping is masking or a comparison at most, and neither
//! `floor` nor a checked cast, calls and branches on baseline x86-64, is in the hot loop.

use wide::{f32x4, i32x4};

/// A coordinate in steps of 2⁻²⁰, rounded to nearest; its upper bits are
/// meaningless. For |x| < 2³⁰.
#[derive(Debug, Clone, Copy)]
pub struct Fixed(u64);

/// Bits after the point.
pub const FRACTION_BITS: u32 = 20;
impl Fixed {
    #[inline(always)]
    pub fn new(x: f64) -> Fixed {
        // At this magnitude the last bit of the mantissa is worth 2⁻²⁰, so
        // the sum holds x, in two's complement, in its low bits.
        const ALIGNER: f64 = 1.5 * (1u64 << (52 - FRACTION_BITS)) as f64;
        Fixed((x + ALIGNER).to_bits())
    }

    /// ⌊x⌋ modulo `mask` + 1, a power of two.
    #[inline(always)]
    pub fn index(self, mask: usize) -> usize {
        (self.0 >> FRACTION_BITS) as usize & mask
    }

    /// x − ⌊x⌋.
    #[inline(always)]
    pub fn fraction(self) -> f32 {
        let bits = self.0 & ((1 << FRACTION_BITS) - 1);
        bits as i32 as f32 * (1.0 / (1 << FRACTION_BITS) as f32)
    }

    /// x·n in steps of 2⁻²⁰, its upper bits meaningless.
    #[inline(always)]
    pub fn times(self, n: i64) -> u64 {
        self.0.wrapping_mul(n as u64)
    }
}

/// A number of texels after which a pattern repeats, at most 2¹³.
#[derive(Debug, Clone, Copy)]
pub struct Period {
    texels: f64,
    inverse: f64,
}

/// Bits after the point of four coordinates together.
const FOURS_BITS: u32 = 16;

impl Period {
    pub fn new(texels: usize) -> Period {
        debug_assert!(texels <= 1 << 13);
        Period {
            texels: texels as f64,
            inverse: 1.0 / texels as f64,
        }
    }

    /// `x` − n·period from 0 to the period, which rounding may give; |x| < 2⁵⁰.
    #[inline(always)]
    fn reduced(self, x: f64) -> f64 {
        // Rounds to whole numbers, as `Fixed::new` does to its steps.
        const ALIGNER: f64 = 1.5 * (1u64 << 52) as f64;
        let rest = x - ((x * self.inverse + ALIGNER) - ALIGNER) * self.texels;
        if rest < 0.0 { rest + self.texels } else { rest }
    }

    /// ⌊x⌋ modulo the period, and x − ⌊x⌋.
    #[inline(always)]
    pub fn place(self, x: f64) -> (usize, f32) {
        let x = Fixed::new(self.reduced(x));
        let index = x.index(2 * (1 << 13) - 1);
        let wrapped = if index == self.texels as usize {
            0
        } else {
            index
        };
        (wrapped, x.fraction())
    }

    /// The same for `around` + each of four `offsets` of at most [`REACH`] in size, to
    /// 2⁻¹⁶, but that the index may pass the period by twice as much: a table that goes
    /// on so far needs no wrapping.
    #[inline(always)]
    pub fn near(self, around: f64, offsets: f32x4) -> (i32x4, f32x4) {
        const ONE: i32 = 1 << FOURS_BITS;
        let low = self.reduced(around - REACH as f64);
        // Not a checked cast.
        let low = Fixed::new(low).0 >> (FRACTION_BITS - FOURS_BITS);
        let offsets = (offsets * ONE as f32).fast_round_int();
        let steps: i32x4 = i32x4::splat(low as i32 + REACH as i32 * ONE) + offsets;
        let fractions = (steps & i32x4::splat(ONE - 1)).round_float() * (1.0 / ONE as f32);
        (steps >> FOURS_BITS, fractions)
    }
}

/// Texels that four coordinates together may be off their middle.
pub const REACH: usize = 8;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn index_and_fraction_are_floor_and_rest_modulo_the_period() {
        for x in [
            0.0,
            0.25,
            7.75,
            8.0,
            1e6 + 0.5,
            -0.25,
            -8.0,
            -12345.625,
            5e8 + 0.5,
        ] {
            let fixed = Fixed::new(x);
            assert_eq!(
                fixed.index(7),
                (x.floor() as i64).rem_euclid(8) as usize,
                "{x}"
            );
            assert_eq!(fixed.fraction() as f64, x - x.floor(), "{x}");
        }
    }

    /// Exact in steps of 2⁻¹⁶, on both sides of where a table wraps.
    #[test]
    fn places_are_floor_and_rest_modulo_the_period() {
        for size in [96, 384, 8192] {
            let period = Period::new(size);
            for x in [0.25, 8191.75, -0.5, 1e6 + 0.5, -384.0, 383.75, 95.5] {
                let offsets = [0.0, 0.75, -8.0, 8.0];
                let (indices, fractions) = period.near(x, f32x4::from(offsets));
                for (i, offset) in offsets.into_iter().enumerate() {
                    let at = x + offset as f64;
                    let index = (at.floor() as i64).rem_euclid(size as i64) as usize;
                    let place = (index, (at - at.floor()) as f32);
                    assert_eq!(period.place(at), place, "{size} {x} {offset}");
                    let found = indices.to_array()[i] as usize;
                    assert!(found <= size + 2 * REACH, "{size} {x} {offset}: {found}");
                    let four = (found % size, fractions.to_array()[i]);
                    assert_eq!(four, place, "{size} {x} {offset}");
                }
            }
            // Below zero by less than a step: at zero again, not at the period.
            assert_eq!(period.place(-1e-30), (0, 0.0));
        }
    }
}
