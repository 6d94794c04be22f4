//! Lines that an edge along them cuts. What is left of one is darker and narrower than its
//! neighbours, as speckle makes single columns too; but an edge cuts neighbouring columns.

use super::locate::{PIXEL_VARIANCE, WINDOW_SIGMAS};
use super::neighbourhood::BESIDE;
use super::widths::Expected;
use super::{Flags, Peak};
use std::f64::consts::{SQRT_2, TAU};

/// How often an edge begins to cut an unbroken line, a column; at a column flagged
/// [`Flags::EDGE`], where the line ends or jumps, or [`Flags::DOUBLE`], which sees two surfaces,
/// it does as often as not.
const EDGES: f64 = 1e-3;

/// Columns in which an edge at 45° to a line of this width (σ, px) cuts it.
pub(super) fn columns_cut(sigma: f64) -> f64 {
    (4.0 * sigma).max(2.0)
}

/// Relative variance of a line's light between columns that speckle does not explain, at least:
/// that of the reflectance and slope of a smooth part.
const LEAST_VARIANCE: f64 = 0.02;

/// Relative variance by speckle of a column's width² over that of its light, to first order:
/// E² of a line of σ is a Gaussian of σ²/2, over which (x² − σ²)²/σ⁴ has the mean ¾.
const VARIANCE_OF_WIDTH: f64 = 0.75;

/// What is left of a Gaussian line of unit width and light beyond one place.
#[derive(Debug, Clone, Copy)]
pub(super) struct Left {
    pub light: f64,
    /// Distance of its centroid from the line's.
    pub off: f64,
    pub variance: f64,
}

/// φ(z)/q is the mean of what lies beyond z, q being how much does, and 1 + z·φ/q − (φ/q)² its
/// variance.
pub(super) fn beyond(z: f64) -> Left {
    let light = 0.5 * libm::erfc(z / SQRT_2);
    let off = (-0.5 * z * z).exp() / TAU.sqrt() / light;
    Left {
        light,
        off,
        variance: 1.0 + z * off - off * off,
    }
}

/// One of the remnants that lines are held against.
#[derive(Debug, Clone, Copy)]
struct Remnant {
    light: f64,
    off: f64,
    /// Variance.
    width: f64,
    /// How likely it is among the others: edges cut lines anywhere, by light.
    weight: f64,
    log_light: f64,
}

impl Remnant {
    fn new(light: f64, weight: f64) -> Remnant {
        let (mut low, mut high) = (-6.0, 6.0);
        for _ in 0..50 {
            let z: f64 = (low + high) / 2.0;
            match beyond(z).light > light {
                true => low = z,
                false => high = z,
            }
        }
        let Left { off, variance, .. } = beyond(low);
        Remnant {
            light,
            off,
            width: variance,
            weight,
            log_light: light.ln(),
        }
    }
}

/// Shares of light that edges leave, and of all shares those that each stands for.
const LEFT: [[f64; 2]; 12] = [
    [0.002, 0.0035],
    [0.005, 0.004],
    [0.01, 0.0075],
    [0.02, 0.015],
    [0.04, 0.025],
    [0.07, 0.035],
    [0.12, 0.06],
    [0.2, 0.1],
    [0.32, 0.14],
    [0.48, 0.18],
    [0.68, 0.2],
    [0.9, 0.23],
];

/// Looks for what edges leave.
#[derive(Debug, Clone)]
pub(super) struct Cuts {
    remnants: [Remnant; LEFT.len()],
    /// Share of neighbouring columns whose light is independent.
    independent: f64,
}

/// What an edge may have done to the line in a column.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Cut {
    /// Chance that one cuts it.
    pub chance: f64,
    /// Mean square of how far off the centroid then is, px².
    pub square: f64,
}

impl Cuts {
    /// `beside` is the variance of the mean light of the columns next to one over that of
    /// one, both by speckle.
    pub fn new(beside: f64) -> Cuts {
        Cuts {
            remnants: LEFT.map(|[light, weight]| Remnant::new(light, weight)),
            independent: 1.0 / ((2 * BESIDE + 1) as f64 * beside),
        }
    }

    /// Of each peak, in the order of columns; `sigmas` are the widths of its line, px,
    /// `variances` those of the light of such lines by speckle, relative, and `spreads` what the lens
    /// adds to the widths², also of what an edge leaves, px².
    ///
    /// A hidden Markov chain of two states, whole and cut, along the columns (Rabiner 1989,
    /// forward and backward). A column's evidence is its light and its width over what is
    /// expected of them, gamma-distributed by speckle; that of neighbours is weighed by how much of
    /// it is independent.
    pub fn find(
        &self,
        peaks: &[Peak],
        expected: &[Option<Expected>],
        sigmas: &[f64],
        variances: &[f64],
        spreads: &[f64],
    ) -> Vec<Cut> {
        let mut widths = Widths::default();
        let seen: Vec<(f64, f64)> = (0..peaks.len())
            .map(|i| match &expected[i] {
                Some(expected) if !expected.alone => {
                    self.evidence(&peaks[i], expected, variances[i], spreads[i], &mut widths)
                }
                _ => (1.0, 0.0),
            })
            .collect();
        let ends = |i: usize| peaks[i].flags.intersects(Flags::EDGE | Flags::DOUBLE);
        // Chances that a whole line is cut in the next column, and a cut one whole.
        let step = |i: usize| {
            let cut = if ends(i) || ends(i + 1) { 0.5 } else { EDGES };
            (cut, columns_cut(sigmas[i]).recip())
        };
        let normal = |[whole, cut]: [f64; 2]| [whole / (whole + cut), cut / (whole + cut)];
        let mut chances = vec![[1.0; 2]; peaks.len()];
        let mut from = [0.5; 2];
        for i in 0..peaks.len() {
            let here = normal([from[0], from[1] * seen[i].0]);
            chances[i] = here;
            if i + 1 < peaks.len() {
                let (cut, whole) = step(i);
                let cut = here[0] * cut + here[1] * (1.0 - whole);
                from = [1.0 - cut, cut];
            }
        }
        let mut onward = [1.0; 2];
        for i in (0..peaks.len()).rev() {
            let [whole, cut] = chances[i];
            chances[i] = normal([whole * onward[0], cut * onward[1]]);
            if i > 0 {
                let here = [onward[0], onward[1] * seen[i].0];
                let (cut, whole) = step(i - 1);
                onward = normal([
                    (1.0 - cut) * here[0] + cut * here[1],
                    whole * here[0] + (1.0 - whole) * here[1],
                ]);
            }
        }
        let cut = |(chance, seen): (&[f64; 2], &(f64, f64))| Cut {
            chance: if seen.1 > 0.0 { chance[1] } else { 0.0 },
            square: seen.1,
        };
        chances.iter().zip(&seen).map(cut).collect()
    }

    /// How much likelier a column is if its line is cut than if it is whole, and how far
    /// off its centroid then is, mean square, px².
    ///
    /// A gamma-distributed x of shape M is likelier with the mean m than with 1 by
    /// e^(−M·(ln m + x/m − x)).
    fn evidence(
        &self,
        peak: &Peak,
        expected: &Expected,
        variance: f64,
        spread: f64,
        widths: &mut Widths,
    ) -> (f64, f64) {
        let variance = variance.max(LEAST_VARIANCE);
        let whole = expected.sigma.powi(2) + PIXEL_VARIANCE;
        // Of the line without the lens; at least a tenth of what it is with it.
        let square = (expected.sigma.powi(2) - spread).max(0.01 * expected.sigma.powi(2));
        let light = peak.intensity / expected.light;
        let width = (peak.sigma.powi(2) + PIXEL_VARIANCE) / whole;
        // Of a width² by noise: Σx⁴ over the window.
        let half = WINDOW_SIGMAS * whole.sqrt();
        let noise = (peak.noise / peak.intensity).powi(2) * 0.4 * half.powi(5);
        let of_width = VARIANCE_OF_WIDTH * variance + noise / (whole * whole);
        let (mut sum, mut off) = (f64::MIN_POSITIVE, 0.0);
        let narrow = widths.of(&self.remnants, (whole - square) / square);
        for (remnant, &(narrow, log_narrow)) in self.remnants.iter().zip(narrow) {
            let dark = remnant.log_light + light / remnant.light - light;
            let unlikely = dark / variance + (log_narrow + width / narrow - width) / of_width;
            // Most are, and an exponential takes its time.
            if unlikely < 40.0 {
                let likely = remnant.weight * (-unlikely).min(300.0).exp();
                sum += likely;
                off += likely * remnant.off.powi(2);
            }
        }
        // One column says no more than that.
        let ratio = sum.powf(self.independent).clamp(1e-12, 1e12);
        (ratio, off / sum * square)
    }
}

/// Widths² of remnants, with their pixels and lens, over that of the whole line, and their logarithms; for
/// one share of pixels and lens in it at a time, to 2 %.
#[derive(Default)]
struct Widths {
    key: i32,
    narrow: [(f64, f64); LEFT.len()],
}

impl Widths {
    const PER_E_FOLD: f64 = 25.0;

    /// `added` is what pixels and lens add to the square of the line's own width, over that.
    fn of(&mut self, remnants: &[Remnant], added: f64) -> &[(f64, f64)] {
        let key = (added.min(1e6).ln() * Widths::PER_E_FOLD).round() as i32;
        if key != self.key || self.narrow[0].0 == 0.0 {
            let added = (key as f64 / Widths::PER_E_FOLD).exp();
            let of = |remnant: &Remnant| (remnant.width + added) / (1.0 + added);
            for (narrow, remnant) in self.narrow.iter_mut().zip(remnants) {
                *narrow = (of(remnant), of(remnant).ln());
            }
            self.key = key;
        }
        &self.narrow
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const VARIANCE: f64 = 0.2;

    /// Lines of σ = 2 px of which these shares are left beyond an edge, on unflagged columns.
    fn found(left: &[f64]) -> Vec<Cut> {
        let line = |(column, left): (usize, &f64)| {
            let remnant = Remnant::new(*left, 1.0);
            Peak {
                column: column as u32,
                row: 10.0,
                intensity: 1e4 * left,
                height: 1e3,
                sigma: 2.0 * remnant.width.sqrt(),
                noise: 1.0,
                flags: Flags::empty(),
            }
        };
        let peaks: Vec<Peak> = left.iter().enumerate().map(line).collect();
        let whole = Expected {
            sigma: 2.0,
            climb: 0.0,
            light: 1e4,
            alone: false,
        };
        let variances = vec![VARIANCE; left.len()];
        let sigmas = vec![whole.sigma; left.len()];
        let sharp = vec![0.0; left.len()];
        Cuts::new(0.3).find(
            &peaks,
            &vec![Some(whole); left.len()],
            &sigmas,
            &variances,
            &sharp,
        )
    }

    /// By tables, beyond 1.5 σ lie 0.0668 of a Gaussian, 1.9388 σ off its middle on average; their
    /// variance is 1 + 1.5·1.9388 − 1.9388² = 0.1493. Beyond the middle: 1 − 2/π.
    #[test]
    fn remnants_are_those_of_a_gaussian() {
        let tail = Remnant::new(0.066_807, 1.0);
        assert!((tail.off - 1.938_8).abs() < 1e-3 && (tail.width - 0.149_3).abs() < 2e-3);
        let half = Remnant::new(0.5, 1.0);
        assert!((half.width - (1.0 - 4.0 / TAU)).abs() < 1e-9, "{half:?}");
        let weights: f64 = LEFT.iter().map(|[_, weight]| weight).sum();
        assert!((weights - 1.0).abs() < 1e-9, "{weights}");
    }

    /// Six columns that keep a tenth are cut, and their centroids 1.755 σ = 3.51 px off, to a
    /// tenth: speckle leaves the share open by a third, and an offset goes with its fourth root.
    /// The more whole ones lie between, the less likely is a column.
    #[test]
    fn neighbouring_columns_that_are_dark_and_narrow_are_cut() {
        let mut left = vec![1.0 - 1e-6; 40];
        left[20..26].fill(0.1);
        let cuts = found(&left);
        for (i, cut) in cuts.iter().enumerate().take(32).skip(10) {
            let distance = match i {
                ..20 => 20 - i,
                20..26 => 0,
                _ => i - 25,
            };
            if distance == 0 {
                assert!(cut.chance > 0.99, "{i} {cut:?}");
                assert!((cut.square.sqrt() / 3.51 - 1.0).abs() < 0.1, "{i} {cut:?}");
            } else {
                let most = 0.3f64.powi(distance as i32).max(2e-3);
                assert!(cut.chance < most, "{i} {cut:?}");
            }
        }
    }

    /// Of 18 000 columns of whole lines whose light and width vary as speckle makes them, each by
    /// itself, less than one in a thousand is taken to be cut.
    #[test]
    fn speckle_is_not_taken_for_edges() {
        use crate::math::rng::{Key, Purpose};
        use rand_distr::{Distribution, Gamma};
        let shape = 1.0 / VARIANCE;
        let light = Gamma::new(shape, VARIANCE).unwrap();
        let width = Gamma::new(shape / 0.75, 0.75 * VARIANCE).unwrap();
        let mut stream = Key::new(3, Purpose::SensorNoise).stream();
        let mut wrong = 0;
        for _ in 0..50 {
            let peak = |column: u32| Peak {
                column,
                row: 10.0,
                intensity: 1e4 * light.sample(&mut stream),
                height: 1e3,
                sigma: (4.0 * width.sample(&mut stream)).sqrt(),
                noise: 1.0,
                flags: Flags::empty(),
            };
            let peaks: Vec<Peak> = (0..400).map(peak).collect();
            let whole = Expected {
                sigma: 2.0,
                climb: 0.0,
                light: 1e4,
                alone: false,
            };
            // All columns independent: the mean of five has a fifth of one's variance.
            let cuts = Cuts::new(0.2).find(
                &peaks,
                &[Some(whole); 400],
                &[whole.sigma; 400],
                &[VARIANCE; 400],
                &[0.0; 400],
            );
            // The line's ends are as likely cut as not.
            let inner = &cuts[20..380];
            wrong += inner.iter().filter(|cut| cut.chance > 0.5).count();
        }
        assert!(wrong < 18, "{wrong}");
    }
}
