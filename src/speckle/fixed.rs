//! Coordinates as integers: wrapping is masking, and neither `floor` nor a
//! checked cast, calls and branches on baseline x86-64, is in the hot loop.

use wide::{f32x4, i32x4};

/// A coordinate in steps of 2⁻²⁰, rounded to nearest; its upper bits are
/// meaningless. For |x| < 2³⁰.
#[derive(Debug, Clone, Copy)]
pub struct Fixed(u64);

/// Bits after the point.
pub const FRACTION_BITS: u32 = 20;
/// Of four coordinates together.
const FOURS_BITS: u32 = 19;

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

/// Four coordinates together, in steps of 2⁻¹⁹, modulo 2¹³.
#[derive(Clone, Copy)]
pub struct FixedFour(i32x4);

impl FixedFour {
    /// `around` + `offsets`, which are finite and less than 2¹² in size.
    #[inline(always)]
    pub fn new(around: Fixed, offsets: f32x4) -> FixedFour {
        let around = (around.0 >> (FRACTION_BITS - FOURS_BITS)) as i32;
        let steps = offsets * (1 << FOURS_BITS) as f32;
        FixedFour(i32x4::splat(around) + steps.fast_round_int())
    }

    /// ⌊x⌋ modulo `mask` + 1, a power of two up to 2¹³.
    #[inline(always)]
    pub fn indices(self, mask: usize) -> [usize; 4] {
        let indices = (self.0 >> FOURS_BITS) & i32x4::splat(mask as i32);
        indices.to_array().map(|index| index as usize)
    }

    /// x − ⌊x⌋.
    #[inline(always)]
    pub fn fractions(self) -> f32x4 {
        let bits = self.0 & i32x4::splat((1 << FOURS_BITS) - 1);
        bits.round_float() * (1.0 / (1 << FOURS_BITS) as f32)
    }
}

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

    #[test]
    fn four_are_like_each() {
        for x in [0.25, 8191.75, -0.5, 1e6 + 0.5] {
            let offsets = [0.0, 0.75, -3.5, 1000.25];
            let four = FixedFour::new(Fixed::new(x), f32x4::from(offsets));
            let each = offsets.map(|offset| Fixed::new(x + offset as f64));
            assert_eq!(four.indices(8191), each.map(|x| x.index(8191)), "{x}");
            assert_eq!(
                four.fractions().to_array(),
                each.map(Fixed::fraction),
                "{x}"
            );
        }
    }
}
