//! Coordinates as integers. Wrapping is a mask or at most a comparison. The hot loop contains no
//! `floor` and no checked cast, which are calls and branches on baseline x86-64.

use wide::{f32x4, i32x4};

/// Coordinate in steps of 2⁻²⁰, rounded to nearest, for |x| < 2³⁰. Its upper bits are meaningless.
#[derive(Debug, Clone, Copy)]
pub struct FixedPoint(u64);

/// Number of fractional bits.
pub const FRACTION_BITS: u32 = 20;
impl FixedPoint {
    #[inline(always)]
    pub fn new(x: f64) -> FixedPoint {
        // At this magnitude, the last bit of the mantissa is 2⁻²⁰. The low bits of the sum
        // therefore contain x in two's complement.
        const ALIGNER: f64 = 1.5 * (1u64 << (52 - FRACTION_BITS)) as f64;
        FixedPoint((x + ALIGNER).to_bits())
    }

    /// Returns ⌊x⌋ modulo `mask` + 1, a power of two.
    #[inline(always)]
    pub fn index(self, mask: usize) -> usize {
        (self.0 >> FRACTION_BITS) as usize & mask
    }

    /// Returns x − ⌊x⌋.
    #[inline(always)]
    pub fn fraction(self) -> f32 {
        let bits = self.0 & ((1 << FRACTION_BITS) - 1);
        bits as i32 as f32 * (1.0 / (1 << FRACTION_BITS) as f32)
    }

    /// Returns x·n in steps of 2⁻²⁰; the upper bits are meaningless.
    #[inline(always)]
    pub fn times(self, n: i64) -> u64 {
        self.0.wrapping_mul(n as u64)
    }
}

/// Period of a pattern in texels, at most 2¹³.
#[derive(Debug, Clone, Copy)]
pub struct PeriodicIndex {
    texels: f64,
    inverse: f64,
}

/// Number of fractional bits of four coordinates computed together.
const FOURS_BITS: u32 = 16;

impl PeriodicIndex {
    pub fn new(texels: usize) -> PeriodicIndex {
        debug_assert!(texels <= 1 << 13);
        PeriodicIndex {
            texels: texels as f64,
            inverse: 1.0 / texels as f64,
        }
    }

    /// Returns `x` − n·period in [0, period], for |x| < 2⁵⁰. Rounding may give the period itself.
    #[inline(always)]
    fn reduced(self, x: f64) -> f64 {
        // Rounds to integers, as `Fixed::new` rounds to its steps.
        const ALIGNER: f64 = 1.5 * (1u64 << 52) as f64;
        let rest = x - ((x * self.inverse + ALIGNER) - ALIGNER) * self.texels;
        if rest < 0.0 { rest + self.texels } else { rest }
    }

    /// Returns ⌊x⌋ modulo the period, and x − ⌊x⌋.
    #[inline(always)]
    pub fn place(self, x: f64) -> (usize, f32) {
        let x = FixedPoint::new(self.reduced(x));
        let index = x.index(2 * (1 << 13) - 1);
        let wrapped = if index == self.texels as usize {
            0
        } else {
            index
        };
        (wrapped, x.fraction())
    }

    /// Returns index and fraction of `around` plus each of four `offsets`, to 2⁻¹⁶. The offsets are
    /// at most [`REACH`] in size. The index may exceed the period by up to 2·`REACH`, so a table
    /// that repeats this many texels needs no wrapping.
    #[inline(always)]
    pub fn near(self, around: f64, offsets: f32x4) -> (i32x4, f32x4) {
        const ONE: i32 = 1 << FOURS_BITS;
        let low = self.reduced(around - REACH as f64);
        // Uses the bits directly, to avoid a checked cast.
        let low = FixedPoint::new(low).0 >> (FRACTION_BITS - FOURS_BITS);
        let offsets = (offsets * ONE as f32).fast_round_int();
        let steps: i32x4 = i32x4::splat(low as i32 + REACH as i32 * ONE) + offsets;
        let fractions = (steps & i32x4::splat(ONE - 1)).round_float() * (1.0 / ONE as f32);
        (steps >> FOURS_BITS, fractions)
    }
}

/// Largest distance, in texels, of four coordinates read together from their centre.
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
            let fixed = FixedPoint::new(x);
            assert_eq!(
                fixed.index(7),
                (x.floor() as i64).rem_euclid(8) as usize,
                "{x}"
            );
            assert_eq!(fixed.fraction() as f64, x - x.floor(), "{x}");
        }
    }

    /// Exact in steps of 2⁻¹⁶, on both sides of the wrap.
    #[test]
    fn places_are_floor_and_rest_modulo_the_period() {
        for size in [96, 384, 8192] {
            let period = PeriodicIndex::new(size);
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
            // Less than one step below zero wraps to zero, not to the period.
            assert_eq!(period.place(-1e-30), (0, 0.0));
        }
    }
}
