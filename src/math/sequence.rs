//! Low-discrepancy points of the unit square: the Sobol sequence (1967) in two dimensions, with
//! Owen scrambling (1995) by hashing (Laine & Karras 2011; Burley 2020).

use super::DVec2;
use super::rng::RngKey;

/// Scrambled two-dimensional Sobol sequence.
///
/// Every elementary interval of area 2⁻ᵏ contains exactly one point of each consecutive block of 2ᵏ
/// points, for all its aspect ratios. Different dimension pairs are independent.
#[derive(Debug, Clone, Copy)]
pub struct Sequence(RngKey);

impl Sequence {
    /// Returns the sequence of a key. Different keys give different sequences.
    pub fn new(key: RngKey) -> Sequence {
        Sequence(key)
    }

    /// Returns point number `index` of a pair of dimensions, in [0, 1)².
    pub fn pair(&self, index: u32, dimension: u32) -> DVec2 {
        let key = self.0.with(dimension as u64);
        let seeds = [key.bits(0), key.bits(1)];
        // The order of the points is scrambled as well, so that the pairs are independent.
        let index = scrambled(index, seeds[0] as u32);
        let of = |bits: u32, seed: u64| scrambled(bits, seed as u32) as f64 / 2f64.powi(32);
        DVec2::new(
            of(index.reverse_bits(), seeds[0] >> 32),
            of(second(index), seeds[1]),
        )
    }
}

/// Returns the second dimension of the Sobol sequence: binomial coefficients modulo 2.
///
/// The bits are the coefficients of a polynomial of x. They become the coefficients of the
/// polynomial in x + 1, because (x + 1)²ᵏ equals x²ᵏ + 1 modulo 2.
fn second(index: u32) -> u32 {
    let halves = [
        (1, 0x5555_5555),
        (2, 0x3333_3333),
        (4, 0x0f0f_0f0f),
        (8, 0x00ff_00ff),
        (16, 0x0000_ffff),
    ];
    let shifted = |bits: u32, (by, low): (u32, u32)| bits ^ (bits >> by & low);
    halves.into_iter().fold(index, shifted).reverse_bits()
}

/// Flips each bit depending on a hash of the higher bits.
fn scrambled(bits: u32, seed: u32) -> u32 {
    let mut x = bits.reverse_bits().wrapping_add(seed);
    for factor in [0x6c50_b47c, 0xb82f_1e52, 0xc7af_e638, 0x8d22_f6e6u32] {
        x ^= x.wrapping_mul(factor);
    }
    x.reverse_bits()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::Purpose;

    /// Tests that each box of area 2⁻¹⁰ contains one point of each block of 2¹⁰ consecutive points.
    #[test]
    fn every_box_has_its_point() {
        for dimension in 0..3 {
            let sequence = Sequence::new(RngKey::new(5, Purpose::Reflections));
            for block in 0..3 {
                for wide in 0..=10 {
                    let mut met = [false; 1024];
                    for i in 0..1024 {
                        let p = sequence.pair(1024 * block + i, dimension);
                        let (x, y) = (
                            (p.x * 2f64.powi(wide)) as usize,
                            (p.y * 2f64.powi(10 - wide)) as usize,
                        );
                        met[(x << (10 - wide)) + y] = true;
                    }
                    assert!(met.iter().all(|&met| met), "{dimension} {block} {wide}");
                }
            }
        }
    }

    /// Tests that numbers of two dimensions are uncorrelated: |r| below 5/√n.
    #[test]
    fn dimensions_are_independent() {
        let n = 4096;
        let sequence = Sequence::new(RngKey::new(6, Purpose::Reflections));
        let sum: f64 = (0..n)
            .map(|i| {
                let [a, b] = [0, 1].map(|dimension| sequence.pair(i, dimension) - 0.5);
                a.x * b.x + a.x * b.y + a.y * b.x
            })
            .sum();
        assert!(
            (sum * 12.0 / n as f64).abs() < 5.0 * (3.0 / n as f64).sqrt(),
            "{sum}"
        );
    }
}
