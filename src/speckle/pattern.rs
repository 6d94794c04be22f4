//! One speckle pattern after Duncan & Kirkpatrick (2008): random unit phasors
//! inside a pupil, Fourier transformed.
//!
//! Patterns are not cached on disk: generating one is as fast as reading it, and a cached file
//! would have to be checked against its spec. `cargo bench --bench speckle` measures the generation
//! time.

use crate::error::{Error, Result};
use crate::math::rng::{Purpose, RngKey};
use crate::math::sinc;
use crate::math::{Aperture, DMat2, DVec2};
use rustfft::num_complex::Complex32;
use rustfft::{Fft, FftPlannerScalar};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

impl Aperture {
    /// True if the aperture is open at `p`, in pupil widths and heights from the centre.
    pub(crate) fn contains(&self, p: DVec2) -> bool {
        match self {
            Aperture::Circle | Aperture::Ellipse(_) => p.length_squared() <= 0.25,
            // Half-open: a square d texels wide contains d columns for every position of its
            // centre, not d + 1 when both edges fall on texels.
            Aperture::Square => (-0.5..0.5).contains(&p.x) && (-0.5..0.5).contains(&p.y),
        }
    }
}

/// Parameters of a set of speckle patterns. Equal parameters give byte-identical patterns.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PatternSpec {
    /// N, texels along each side; a power of two, except for the field of a frame. The pattern
    /// repeats after N texels.
    pub size: usize,
    /// N/d, texels per minimal speckle size; at least 2, the Nyquist rate of the intensity.
    pub texels_per_speckle: f64,
    /// Shape of the pupil that forms the speckle.
    pub aperture: Aperture,
    /// Correlation slices along the closed path; a power of two.
    pub slices: usize,
    /// Random seed of the phases.
    pub seed: u64,
}

impl Default for PatternSpec {
    fn default() -> Self {
        PatternSpec {
            size: 1024,
            texels_per_speckle: 4.0,
            aperture: Aperture::Circle,
            slices: 64,
            seed: 0,
        }
    }
}

impl PatternSpec {
    /// Width d of the pupil, texels.
    pub fn pupil_width(&self) -> f64 {
        self.size as f64 / self.texels_per_speckle
    }

    /// Checks the parameters. The error states the value found and the values expected.
    pub fn validate(&self) -> Result<()> {
        if !self.size.is_power_of_two() {
            let expected = "a power of two from 64 to 8192";
            return refuse("size", self.size.to_string(), expected);
        }
        if !self.slices.is_power_of_two() || !(8..=1024).contains(&self.slices) {
            let expected = "a power of two from 8 to 1024";
            return refuse("slices", self.slices.to_string(), expected);
        }
        self.validate_shape()
    }

    /// Checks the parameters of a single field, whose size may be any multiple of [`ROWS`].
    pub(super) fn validate_shape(&self) -> Result<()> {
        let height = self.pupil_width() * self.aperture.ratio();
        let ratio = self.aperture.ratio();
        if !self.size.is_multiple_of(ROWS) || !(64..=8192).contains(&self.size) {
            let expected = format!("a multiple of {ROWS} from 64 to 8192");
            return refuse("size", self.size.to_string(), &expected);
        }
        if !(ratio > 0.0 && ratio <= 1.0) {
            return refuse("aperture ratio", ratio.to_string(), "a number in (0, 1]");
        }
        // Fewer than 16 phasors across the pupil do not give fully developed speckle of the
        // aperture's shape.
        if !(self.texels_per_speckle >= 2.0 && height >= 16.0) {
            let most = self.size as f64 * ratio / 16.0;
            let expected = format!("a number from 2 to {most}");
            return refuse(
                "texels_per_speckle",
                self.texels_per_speckle.to_string(),
                &expected,
            );
        }
        Ok(())
    }
}

pub(super) fn refuse(key: &str, found: String, expected: &str) -> Result<()> {
    Err(Error::Usage(format!(
        "speckle {key}: found {found}, expected {expected}"
    )))
}

/// Complex speckle field over one period, N × N, row t, column s.
///
/// ```
/// use lasertrace::math::DVec2;
/// use lasertrace::speckle::pattern::{PatternSpec, PhasorPlane};
///
/// let spec = PatternSpec { size: 256, ..PatternSpec::default() };
/// let pattern = PhasorPlane::new(&spec).pattern(DVec2::ZERO);
/// let intensity: Vec<f64> = pattern.intensity().map(f64::from).collect();
/// let mean = |of: &dyn Fn(f64) -> f64| {
///     intensity.iter().map(|&i| of(i)).sum::<f64>() / intensity.len() as f64
/// };
/// // Fully developed speckle: ⟨I²⟩ = 2⟨I⟩². For n independent speckles the ratio has a
/// // standard deviation of about √(4/n) (linearised). The limit is five of these.
/// let ratio = mean(&|i| i * i) / mean(&|i| i).powi(2);
/// assert!((ratio - 2.0).abs() < 5.0 * (4.0 / pattern.phasors as f64).sqrt());
/// ```
#[derive(Debug, Clone)]
pub struct Pattern {
    /// N, texels along each side.
    pub size: usize,
    /// Amplitudes A(s,t); |A|² has mean 1.
    pub field: Vec<Complex32>,
    /// Texel of the random plane used as zero frequency, so that the passband of the field is
    /// centred at zero.
    pub carrier: [i64; 2],
    /// Phasors inside the pupil; also the number of independent speckles.
    pub phasors: usize,
}

impl Pattern {
    /// Returns |field|² row by row; its mean over the period is about 1.
    pub fn intensity(&self) -> impl Iterator<Item = f32> + '_ {
        self.field.iter().map(Complex32::norm_sqr)
    }
}

/// Infinite plane of unit phasors exp(iφ) behind a pupil at any position. The phases φ are uniform
/// and independent for every texel.
pub struct PhasorPlane {
    spec: PatternSpec,
    /// Transform from texels to pupil widths and heights.
    to_pupil: DMat2,
    key: RngKey,
    /// Possible values of a phasor: phases in equal steps around the circle. The steps are fine
    /// enough that a sum of a few phasors is as random as with continuous phases, and few enough
    /// for the first-level cache.
    phases: Vec<Complex32>,
    fft: Arc<dyn Fft<f32>>,
}

/// Bits of a phasor's phase.
const PHASE_BITS: u32 = 12;

/// Pupil transformed along y only, one line per column x of phasors. Each row of the pattern is
/// then computed independently.
pub(super) struct PupilColumns {
    lines: Vec<Complex32>,
    /// Scale factor that makes the mean of |A|² equal to 1.
    scale: f32,
    phasors: usize,
}

/// Rows computed together: one cache line of each column holds the values of all of them.
pub(super) const ROWS: usize = 8;

impl PhasorPlane {
    /// Creates a plane; `spec` must have passed [`PatternSpec::validate`].
    pub fn new(spec: &PatternSpec) -> PhasorPlane {
        PhasorPlane::turned(spec, DVec2::X)
    }

    /// Creates a plane on which the width of the pupil lies along `turn` (unit vector).
    pub(super) fn turned(spec: &PatternSpec, turn: DVec2) -> PhasorPlane {
        let width = spec.pupil_width();
        let size = DVec2::new(width, width * spec.aperture.ratio());
        PhasorPlane {
            spec: *spec,
            to_pupil: DMat2::from_diagonal(size.recip())
                * DMat2::from_cols(turn, turn.perp()).transpose(),
            key: RngKey::new(spec.seed, Purpose::SpecklePattern),
            phases: (0..1 << PHASE_BITS)
                .map(|k| std::f64::consts::TAU * k as f64 / (1 << PHASE_BITS) as f64)
                .map(|phase| Complex32::new(phase.cos() as f32, phase.sin() as f32))
                .collect(),
            fft: FftPlannerScalar::new().plan_fft_inverse(spec.size),
        }
    }

    /// Returns the unit phasor of texel (x, y) of the plane.
    pub(super) fn phasor(&self, x: i64, y: i64) -> Complex32 {
        let counter = (y as u32 as u64) << 32 | x as u32 as u64;
        self.phases[(self.key.bits(counter) >> (u64::BITS - PHASE_BITS)) as usize]
    }

    /// True if the pupil centred at `centre` (texels) is open at texel (x, y).
    pub(super) fn open(&self, centre: DVec2, x: i64, y: i64) -> bool {
        let offset = DVec2::new(x as f64, y as f64) - centre;
        self.spec.aperture.contains(self.to_pupil * offset)
    }

    /// Returns the largest offset from the carrier inside a pupil, texels, including the rounding
    /// of the carrier.
    pub(super) fn reach(&self) -> i64 {
        (self.spec.pupil_width() * self.spec.aperture.extent() / 2.0) as i64 + 1
    }

    /// Counts the phasors that two positions of the pupil have in common. About a common carrier,
    /// the sum Σ A₁·conj(A₂) over one period is proportional to this number without sampling error
    /// (Parseval, unit phasors). Divided by the number of phasors in the pupil, it is the field
    /// correlation of the two patterns.
    pub fn shared(&self, a: DVec2, b: DVec2) -> usize {
        let [x0, y0] = carrier(a);
        let reach = self.reach();
        (y0 - reach..=y0 + reach)
            .flat_map(|y| (x0 - reach..=x0 + reach).map(move |x| (x, y)))
            .filter(|&(x, y)| self.open(a, x, y) && self.open(b, x, y))
            .count()
    }

    /// Returns the pattern of the pupil centred at `centre` (texels of the plane).
    ///
    /// A(s,t) = n^(−½)·Σ φ(x,y)·exp(2πi((x−x₀)s + (y−y₀)t)/N) over the n phasors of the pupil. Here
    /// (x₀,y₀) is the centre rounded to a texel (Duncan & Kirkpatrick 2008).
    ///
    /// The scale factor is the ensemble value; the pattern is not normalised by its sample mean.
    /// With unit phasors, the mean of |A|² over a full period is 1 by Parseval's theorem. Over part
    /// of the period it fluctuates, like real speckle on a finite detector.
    pub fn pattern(&self, centre: DVec2) -> Pattern {
        self.transform(centre, |_| 1.0)
    }

    /// Returns the pattern with every phasor divided by the response sinc²(x/N)·sinc²(y/N) of
    /// linear interpolation. The interpolated field then belongs to a pupil of uniform
    /// transmission. Without this correction, grains of 4 texels have 0.6 % too much contrast after
    /// integration over a pixel of equal size. The mean intensity is 1.
    pub fn sharpened(&self, centre: DVec2) -> Pattern {
        self.transform(centre, |offset| self.sharpening(offset))
    }

    pub(super) fn sharpening(&self, offset: i64) -> f64 {
        sinc(offset as f64 / self.spec.size as f64).powi(-2)
    }

    /// Returns the correlations of sharpened fields at a lag of one column and of one row.
    pub fn sharpened_correlations(&self) -> [f64; 2] {
        let turn = std::f64::consts::TAU / self.spec.size as f64;
        let mut sums = [0.0; 3];
        for y in -self.reach()..=self.reach() {
            for x in -self.reach()..=self.reach() {
                if self.open(DVec2::ZERO, x, y) {
                    let power = (self.sharpening(x) * self.sharpening(y)).powi(2);
                    sums[0] += power * (turn * x as f64).cos();
                    sums[1] += power * (turn * y as f64).cos();
                    sums[2] += power;
                }
            }
        }
        [sums[0] / sums[2], sums[1] / sums[2]]
    }

    /// Computes the pattern with phasors of amplitude weight(x − x₀)·weight(y − y₀).
    fn transform(&self, centre: DVec2, weight: impl Fn(i64) -> f64) -> Pattern {
        let size = self.spec.size;
        let weights: Vec<Complex32> = (-self.reach()..=self.reach())
            .map(|offset| Complex32::new(weight(offset) as f32, 0.0))
            .collect();
        let columns = self.columns(centre, [&weights, &weights], |_, _| true);
        let mut field = vec![Complex32::ZERO; size * size];
        let mut scratch = self.scratch();
        for (block, rows) in field.chunks_exact_mut(ROWS * size).enumerate() {
            self.rows(&columns, block, rows_of(rows, size), &mut scratch);
        }
        Pattern {
            size,
            field,
            carrier: carrier(centre),
            phasors: columns.phasors,
        }
    }

    /// Computes the first half of a pattern: the phasors inside the pupil at `centre`, multiplied
    /// by `factors`. The factors are indexed by the offset in x and in y, starting at
    /// −[`reach`](Self::reach). Phasors rejected by `keep` (texels of the plane) are omitted from
    /// the field but counted in the scale.
    pub(super) fn columns(
        &self,
        centre: DVec2,
        factors: [&[Complex32]; 2],
        keep: impl Fn(i64, i64) -> bool,
    ) -> PupilColumns {
        let size = self.spec.size;
        let origin = carrier(centre);
        let reach = self.reach();
        // Columns without an open texel remain zero.
        let mut lines = vec![Complex32::ZERO; factors[0].len() * size];
        let (mut phasors, mut power) = (0, 0f32);
        let columns = lines.chunks_exact_mut(size).zip(factors[0]);
        for ((line, fx), dx) in columns.zip(-reach..) {
            let x = origin[0] + dx;
            let open = |dy: &i64| self.open(centre, x, origin[1] + dy);
            // Apertures are convex: every texel between the two ends is open.
            let Some(first) = (-reach..=reach).find(open) else {
                continue;
            };
            let last = (first..=reach).rfind(open).unwrap_or(first);
            let rows = (first + reach) as usize..=(last + reach) as usize;
            for (fy, dy) in factors[1][rows].iter().zip(first..) {
                let y = origin[1] + dy;
                let factor = fx * fy;
                power += factor.norm_sqr();
                phasors += 1;
                if keep(x, y) {
                    line[dy.rem_euclid(size as i64) as usize] = self.phasor(x, y) * factor;
                }
            }
        }
        self.fft
            .process_with_scratch(&mut lines, &mut self.scratch());
        PupilColumns {
            lines,
            scale: 1.0 / power.sqrt(),
            phasors,
        }
    }

    /// Computes rows 8·`block` … 8·`block` + 7 of the pattern into `rows`, which must be zero.
    pub(super) fn rows(
        &self,
        columns: &PupilColumns,
        block: usize,
        mut rows: [&mut [Complex32]; ROWS],
        scratch: &mut [Complex32],
    ) {
        let size = self.spec.size;
        for (line, dx) in columns.lines.chunks_exact(size).zip(-self.reach()..) {
            let column = dx.rem_euclid(size as i64) as usize;
            let values = &line[ROWS * block..][..ROWS];
            for (row, value) in rows.iter_mut().zip(values) {
                row[column] = value * columns.scale;
            }
        }
        for row in rows {
            self.fft.process_with_scratch(row, scratch);
        }
    }

    pub(super) fn scratch(&self) -> Vec<Complex32> {
        vec![Complex32::ZERO; self.fft.get_inplace_scratch_len()]
    }
}

/// Splits a block into its [`ROWS`] rows of `stride` values each.
pub(super) fn rows_of<T>(block: &mut [T], stride: usize) -> [&mut [T]; ROWS] {
    let mut rows = block.chunks_exact_mut(stride);
    std::array::from_fn(|_| rows.next().expect("a block has as many rows"))
}

/// Returns the texel of the plane used as zero frequency.
pub(super) fn carrier(centre: DVec2) -> [i64; 2] {
    [centre.x.round() as i64, centre.y.round() as i64]
}
