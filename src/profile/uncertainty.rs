//! How surely the row of a line is known, from what data sheets tell of sensor and
//! light: speckle, shot noise, uneven pixels, background noise, rounding.

use super::blurred::Blurred;
use super::clipping::{Clipped, Clipping};
use super::cut::{Cuts, columns_cut};
use super::filter::{Drift, FrameStep};
use super::horizon::{UNSAID, offsets};
use super::influence::bias;
use super::locate::PIXEL_VARIANCE;
use super::neighbourhood::BESIDE;
use super::slope::{Run, runs};
use super::variances::{Places, SIGMAS_PX, SpeckleGrain, Variances, along_row, column_correlation};
use super::widths::{Expected, expected};
use super::{Flags, Peak, PeakFinder};
use crate::math::DVec2;

/// Greatest relative variance of a column's light, 1/M for M independent grains
/// across the line, up to which errors were found normal and of first order
/// (`tests/uncertainty.rs`).
pub const LARGEST_LIGHT_VARIANCE: f64 = 0.5;
/// The same of a pixel's light for finders that take its shape as a Gaussian's, not
/// its centre of gravity.
pub const LARGEST_SHAPE_VARIANCE: f64 = 0.02;
/// Narrowest line for finders other than the centroid, whose bias is not known below.
const LEAST_SHAPE_SIGMA_PX: f64 = 0.7;
/// Variance by speckle of the centroid of an even stretch over that of a Gaussian of the
/// same width: ∫E²x²/(∫E)² is σ/√12 for the one and σ/(4√π) for the other.
const SPECKLE_OF_A_STRETCH: f64 = 2.0466;

/// How far a peak's row may be off.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RowError {
    /// Standard uncertainty, px: the scatter from place to place, speckle in it.
    pub sigma: f64,
    /// The part of it that another image of the same place draws anew, px: shot noise and the
    /// background's (read noise and rounding). Speckle and the patterns of pixels stay where nothing moves.
    pub noise: f64,
    /// Whether an edge is so near that either of the surfaces it joins may be nearest: one
    /// that cuts the line has the greater part in `sigma`, or the line ends within the columns
    /// in which one at 45° would cut it.
    pub beside_edge: bool,
    /// Rows a column that the line climbs, 0 where it ends or jumps.
    pub slope: f64,
    /// How what is not `noise` correlates with the errors of frames in which the surface lies elsewhere.
    pub drift: Drift,
    /// Whether `sigma` is that of lines like this one.
    pub(super) is_valid: bool,
    /// Whether there are whole lines around to compare this one with.
    pub(super) compared: bool,
    /// Whether an edge along the line rather cuts it than not.
    pub(super) is_cut: bool,
    /// Whether one may have cut more of it than its neighbours show.
    pub(super) cut_unseen: bool,
    /// Whether it saturates and keeps enough of its light.
    pub(super) keeps_light: bool,
}

/// An exposure that pixels are taken from where the next longer one is full.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Merged {
    /// Counts above background from which on it is taken.
    pub from_dn: f64,
    /// The longest exposure over it: its shot noise has as many times the variance.
    pub ratio: f64,
}

/// Predicts the standard uncertainty of the rows of peaks.
///
/// To first order a finder moves by Σ w_i·δ_i if the light of pixel i, of Gaussian
/// share G_i, errs by δ_i; w is `influence`. Then, N being the counts of the line,
/// K counts an electron and s the background's noise (read noise, rounding and DSNU),
///
/// ```text
/// u² = C²·Σ w_i·G_i·w_j·G_j·ρ(i−j) + P²·Σ w_i²·G_i² + K/N·Σ w_i²·G_i + (s/N)²·Σ w_i² + b²/3
/// ```
///
/// with P the standard deviation of the pixels' responses (PRNU), which is the same in every frame but another at every
/// place, as DSNU is; Σ w_i²·G_i of the centroid that of the column's own light as measured; ρ the covariance of the light of two parts of pixels of the column
/// ([`crate::speckle::theory::strip_covariance`]), evenly lit as pixels are not by a narrow line,
/// under grains as long and wide as they are there, and b the greatest bias of the finder (GUM 4.3.7). For
/// pixels ≪ h ≪ σ and the centroid the first term is (32/3π²)·hσ/(4√π)·C². Added to
/// this are, squared, what a bend of the line within the column does (`bend_variance`) and
/// what an edge along the line that cuts it, times the chance that there is one (`Cuts`); on a
/// steep surface σ is that of the column's stretch of the line; and of a line that saturates the
/// first term is what clipping leaves of it (`Clipping`); behind a lens that blurs, what the blur makes
/// of it ([`Blurred`]). The
/// ratio that a centroid is has terms of second order too, left out here: with few grains
/// across the line it strays less than stated (`tests/uncertainty.rs` sums them exactly).
///
/// Valid for a Gaussian line that no flag speaks against, measured as σ = 0.4 … 64 px
/// wide (0.7 px for finders other than the centroid), whose columns hold two grains or more ([`LARGEST_LIGHT_VARIANCE`]); for finders other than the
/// centroid if speckle is all but averaged out ([`LARGEST_SHAPE_VARIANCE`]). What edges and clipping
/// do is that of grains in the sensor's middle.
#[derive(Debug, Clone)]
pub struct ErrorModel {
    finder: PeakFinder,
    gain_dn_per_e: f64,
    prnu: f64,
    fixed_share: f64,
    merged: Vec<Merged>,
    /// Ways between two poses of an exposure, each with the fraction of pairs that have it.
    poses: Vec<(FrameStep, f64)>,
    cuts: Cuts,
    clipping: Clipping,
    places: Places,
    grain: Option<SpeckleGrain>,
    /// `None`: images are sharp.
    blurred: Option<Blurred>,
}

impl ErrorModel {
    /// `gain_dn_per_e`: counts per electron, 0 for light without shot noise.
    pub fn new(finder: PeakFinder, gain_dn_per_e: f64, grain: Option<SpeckleGrain>) -> ErrorModel {
        let columns = grain.map_or(vec![0.0], |grain| {
            let middle = grain.resolution.as_dvec2() / 2.0;
            along_row(&grain, middle, 2 * BESIDE + 1)
        });
        ErrorModel {
            finder,
            gain_dn_per_e,
            prnu: 0.0,
            fixed_share: 0.0,
            merged: Vec::new(),
            poses: Vec::new(),
            cuts: Cuts::new(variance_of_mean(&columns)),
            clipping: Clipping::new(columns[0]),
            places: Places::new(finder, grain.as_ref()),
            grain,
            blurred: None,
        }
    }

    /// The same for images behind a lens that blurs.
    pub fn behind_lens(self, blurred: Blurred) -> ErrorModel {
        ErrorModel {
            blurred: Some(blurred),
            ..self
        }
    }

    /// Correlations of what speckle does to the rows of lines 0, 1, 2, … columns apart, in the sensor's
    /// middle, for a line whose light has a standard deviation of `sigma` px there in the sharp image; [1] without speckle.
    pub fn column_correlation(&self, sigma: f64) -> Vec<f64> {
        let of = |grain: &SpeckleGrain| {
            let middle = grain.resolution.as_dvec2() / 2.0;
            column_correlation(self.finder, grain, middle, self.measured(middle, sigma))
        };
        self.grain.as_ref().map_or(vec![1.0], of)
    }

    /// The same for pixels whose responses have this relative standard deviation, where so great a share of the background's
    /// variance is the same in every image (DSNU).
    pub fn with_patterns(self, prnu: f64, fixed_share: f64) -> ErrorModel {
        ErrorModel {
            prnu,
            fixed_share,
            ..self
        }
    }

    /// The same for images of several exposures, in rising order.
    pub fn with_exposures(self, merged: Vec<Merged>) -> ErrorModel {
        ErrorModel { merged, ..self }
    }

    /// Returns the model for images that average uniformly spread poses of an exposure. `poses` lists the ways from
    /// the first pose to each, beginning with 0.
    pub fn with_poses(self, poses: &[FrameStep]) -> ErrorModel {
        let n = poses.len() as f64;
        let pairs = poses.iter().enumerate().map(|(apart, step)| {
            let signs = if apart == 0 { 1.0 } else { 2.0 };
            (*step, signs * (n - apart as f64) / (n * n))
        });
        ErrorModel {
            poses: pairs.collect(),
            ..self
        }
    }

    /// The same for light without shot noise.
    pub fn without_shot(self) -> ErrorModel {
        ErrorModel {
            gain_dn_per_e: 0.0,
            ..self
        }
    }

    /// How errors by speckle correlate while the surface moves under a line that was measured `width` px wide at a place.
    pub fn drift(&self, place: DVec2, width: f64) -> Drift {
        self.drift_of(width, &self.at_rest(place, width))
    }

    /// Returns the correlation for a line whose centroid has the variance V and whose light has the relative variance L.
    ///
    /// A lens images the fields of the surface that the line lights in both frames. That surface is lit like a line of
    /// the same σ, half way between the two lines and darker by exp(−u²/4). V becomes
    /// exp(−u²/4)·(V − u²σ²·L/4). In a sharp image the pattern multiplies the line: R(u) = exp(−u²/4)·(1 − u²/2)
    /// is convolved with the covariance of the grains, which widens σ² to τ² = σ⁴·L/2V (exact for a Gaussian covariance).
    fn drift_of(&self, width: f64, at: &Variances) -> Drift {
        if at.light <= 0.0 || at.speckle <= 0.0 {
            return Drift::FINE;
        }
        let square = at.sharp.powi(2) * at.light / at.speckle;
        match &self.blurred {
            Some(_) => Drift {
                decay: 0.25,
                turn: 0.25 * square,
            },
            None => {
                let widened = width * width * at.light / (2.0 * at.speckle);
                Drift {
                    decay: 0.25 / widened,
                    turn: 0.5 / widened,
                }
            }
        }
    }

    /// Returns the variances of a line that was measured `width` px wide at a place, without motion in the exposure.
    fn at_rest(&self, place: DVec2, width: f64) -> Variances {
        match &self.blurred {
            None => self.places.at(place, width),
            Some(blurred) => blurred.at(&self.places, place, width),
        }
    }

    /// Returns the variances under the motion of an exposure, and the correlation over frames.
    ///
    /// The errors of the mean over all poses have the mean of the correlations of all pairs of poses.
    fn exposed(&self, place: DVec2, width: f64) -> (Variances, Drift) {
        let at = self.at_rest(place, width);
        let drift = self.drift_of(width, &at);
        if self.poses.len() < 2 {
            return (at, drift);
        }
        let mean = |drift: Drift| -> f64 {
            let pairs = self.poses.iter();
            let sum: f64 = pairs
                .map(|(step, share)| share * drift.correlation(step))
                .sum();
            sum.max(0.0)
        };
        let of_light = mean(Drift { turn: 0.0, ..drift });
        let exposed = Variances {
            speckle: at.speckle * mean(drift),
            light: at.light * of_light,
            pixel: at.pixel * of_light,
            ..at
        };
        (exposed, drift)
    }

    /// Returns the width, px, that a line of standard deviation `sigma` px is measured to have behind the lens.
    pub(crate) fn measured(&self, place: DVec2, sigma: f64) -> f64 {
        let blurred = self.blurred.as_ref();
        blurred.map_or(sigma, |blurred| {
            blurred.measured(&self.places, place, sigma)
        })
    }

    /// How far each peak's row may be off. `peaks` are those of one frame, in the order of its
    /// `columns`; a line's width is that of its neighbourhood, as one column's is mostly speckle,
    /// and that of its climb.
    pub fn row_errors(&self, peaks: &[Peak], columns: usize) -> Vec<RowError> {
        let runs = runs(peaks);
        let expected = expected(peaks, &runs);
        let clipped = self.clipped(peaks, &expected);
        let width = |(peak, e): (&Peak, &Option<Expected>)| e.map_or(peak.sigma, |e| e.sigma);
        let sigmas: Vec<f64> = peaks.iter().zip(&expected).map(width).collect();
        let lined = peaks.iter().zip(&sigmas);
        let lined = lined.map(|(peak, &sigma)| self.exposed(peak.place(), sigma));
        let (variances, drifts): (Vec<Variances>, Vec<Drift>) = lined.unzip();
        let lights: Vec<f64> = variances.iter().map(|v| v.light).collect();
        let spread = |(width, at): (&f64, &Variances)| (width * width - at.sharp.powi(2)).max(0.0);
        let spreads: Vec<f64> = sigmas.iter().zip(&variances).map(spread).collect();
        let cuts = self.cuts.find(peaks, &expected, &sigmas, &lights, &spreads);
        let unseen = offsets(peaks, &runs);
        let near_ends = near_ends(peaks, &sigmas, columns);
        let of = |i: usize| {
            let (peak, width, expected) = (&peaks[i], sigmas[i], &expected[i]);
            let climb = expected.map_or(0.0, |e| e.climb);
            let whole = clipped[i].unwrap_or(Clipped::WHOLE);
            let variance = self.variance(peak, width, climb, &variances[i], &whole);
            let uncut = variance + bend_variance(&runs[i], variance);
            let cut = cuts[i].chance * cuts[i].square;
            let sigma = (uncut + cut).sqrt();
            let noise = self.noise_variance(peak, &variances[i]).sqrt();
            RowError {
                sigma,
                noise,
                beside_edge: near_ends[i] || cut > uncut,
                slope: runs[i].slope,
                drift: drifts[i],
                is_valid: expected.is_some() && self.is_valid(width, &variances[i]),
                compared: expected.is_some_and(|e| !e.alone),
                is_cut: cuts[i].chance > 0.5,
                cut_unseen: unseen[i] > UNSAID * sigma,
                keeps_light: clipped[i].is_some(),
            }
        };
        (0..sigmas.len()).map(of).collect()
    }

    /// What saturation leaves of each line that saturates, of those of which it leaves enough.
    fn clipped(&self, peaks: &[Peak], expected: &[Option<Expected>]) -> Vec<Option<Clipped>> {
        let saturated = |peak: &&Peak| peak.flags.contains(Flags::SATURATED);
        let heights = peaks.iter().filter(saturated).map(|peak| peak.height);
        let full = heights.fold(0.0, f64::max);
        let of = |expected: &Option<Expected>| {
            let expected = expected.filter(|e| !e.alone)?;
            let sigma = (expected.sigma.powi(2) + PIXEL_VARIANCE).sqrt();
            let clipped = self.clipping.at(expected.light, sigma, full);
            clipped.filter(Clipped::keeps_enough)
        };
        if full == 0.0 || self.finder != PeakFinder::Centroid {
            return vec![None; peaks.len()];
        }
        expected.iter().map(of).collect()
    }

    fn is_valid(&self, sigma: f64, at: &Variances) -> bool {
        let centroid = self.finder == PeakFinder::Centroid;
        let least = if centroid {
            SIGMAS_PX.0
        } else {
            LEAST_SHAPE_SIGMA_PX
        };
        (least..=SIGMAS_PX.1).contains(&sigma)
            && at.light <= LARGEST_LIGHT_VARIANCE
            && (centroid || at.pixel <= LARGEST_SHAPE_VARIANCE)
    }

    /// Variance of the row from what each image draws anew, px². Shot noise comes where the column has its light: the centroid's
    /// is as far off as the measured light itself is wide. Columns that speckle leaves dark in their middle are wider and have less light,
    /// which a common width would miss.
    fn noise_variance(&self, peak: &Peak, at: &Variances) -> f64 {
        let n = peak.intensity;
        let shot = match self.finder {
            PeakFinder::Centroid => peak.sigma.powi(2) + PIXEL_VARIANCE,
            _ => at.shot,
        };
        let drawn = peak.noise.powi(2) - self.fixed(peak);
        shot * self.shorter_exposures(peak) * self.gain_dn_per_e / n + at.white * drawn / (n * n)
    }

    /// What shorter exposures make of the shot noise of a line whose middle they are for: Σ(r_k − r_(k−1))·(erf u − 2u·e^(−u²)/√π), of a Gaussian the
    /// share of Σ w²·G that lies where it is higher than the k-th begins, u² = ln(height/from).
    fn shorter_exposures(&self, peak: &Peak) -> f64 {
        let mut before = 1.0;
        let added = self.merged.iter().map(|merged| {
            let more = merged.ratio - before;
            before = merged.ratio;
            let u = (peak.height / merged.from_dn).max(1.0).ln().sqrt();
            let share = libm::erf(u) - 2.0 * u * (-u * u).exp() / std::f64::consts::PI.sqrt();
            more * share
        });
        1.0 + added.sum::<f64>()
    }

    /// Square of the background's noise that is the same in every image, counts².
    fn fixed(&self, peak: &Peak) -> f64 {
        self.fixed_share * peak.noise.powi(2)
    }

    /// Variance of the row of an unbroken line of width `sigma`, px².
    fn variance(
        &self,
        peak: &Peak,
        sigma: f64,
        climb: f64,
        at: &Variances,
        clipped: &Clipped,
    ) -> f64 {
        let shape = 1.0 + (SPECKLE_OF_A_STRETCH - 1.0) * climb;
        at.speckle * clipped.variance * shape
            + self.noise_variance(peak, at)
            + at.white * self.fixed(peak) / peak.intensity.powi(2)
            + at.response * self.prnu.powi(2)
            + bias(self.finder, sigma).powi(2) / 3.0
    }
}

/// Whether the line, so wide, ends so near to each peak that an edge there may cut it. At the
/// sensor's border, on any side, it does not end.
fn near_ends(peaks: &[Peak], sigmas: &[f64], columns: usize) -> Vec<bool> {
    let mut near = Vec::with_capacity(peaks.len());
    for run in peaks.chunk_by(|a, b| a.column + 1 == b.column) {
        let ends = [run[0], run[run.len() - 1]];
        let (first, last) = (ends[0].column, ends[1].column);
        let [begins, ends] = ends.map(|peak| !peak.flags.contains(Flags::BORDER));
        for peak in run {
            let reach = columns_cut(sigmas[near.len()]);
            let before = first > 0 && begins && f64::from(peak.column - first) <= reach;
            let after =
                (last as usize + 1) < columns && ends && f64::from(last - peak.column) <= reach;
            near.push(before || after);
        }
    }
    near
}

/// Variance (px²) of the difference between the mean row of a line over a column and its
/// row in the column's middle, where it bends by K rows a column at a place t of it:
/// K·(½ − |t|)²/2, whose mean square over all t is K²/320. Of the bend that was measured
/// errors of the rows, of this `variance`, make six times theirs.
fn bend_variance(run: &Run, variance: f64) -> f64 {
    (run.bend.powi(2) - 6.0 * variance).max(0.0) / 320.0
}

/// Variance of the mean of as many neighbours as [`BESIDE`] says over that of one; without
/// speckle as if each varied by itself.
fn variance_of_mean(covariance: &[f64]) -> f64 {
    let n = 2 * BESIDE + 1;
    let at = |lag: usize| covariance.get(lag).copied().unwrap_or(0.0);
    if at(0) == 0.0 {
        return 1.0 / n as f64;
    }
    let pairs: f64 = (1..n).map(|lag| 2.0 * (n - lag) as f64 * at(lag)).sum();
    (n as f64 + pairs / at(0)) / (n * n) as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    /// An even stretch of σ = W/√12 has ∫E²x²/(∫E)² = W/12, a Gaussian σ/(4√π); and the
    /// bias of a bend is the mean row less that in the middle, here summed.
    #[test]
    fn constants_of_stretches_and_bends_are_what_they_are_said_to_be() {
        let ratio = (12f64.sqrt() / 12.0) / (1.0 / (4.0 * PI.sqrt()));
        assert!((ratio - SPECKLE_OF_A_STRETCH).abs() < 1e-4, "{ratio}");
        let n = 400;
        let at = |i: usize| (i as f64 + 0.5) / n as f64 - 0.5;
        let row = |x: f64, t: f64| (x - t).max(0.0);
        let bias = |t: f64| (0..n).map(|i| row(at(i), t)).sum::<f64>() / n as f64 - row(0.0, t);
        let square = (0..n).map(|i| bias(at(i)).powi(2)).sum::<f64>() / n as f64;
        let run = Run {
            slope: 0.0,
            bend: 1.0,
        };
        assert!(
            (square / bend_variance(&run, 0.0) - 1.0).abs() < 1e-3,
            "{square}"
        );
        assert_eq!(bend_variance(&run, 1.0), 0.0);
    }
}
