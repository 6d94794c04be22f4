//! Ambient light in the passband of the camera's filter.

/// Maximum luminous efficacy, lm/W.
const LUMENS_PER_WATT: f64 = 683.0;

/// hc/k in nm·K (CODATA 2018).
const SECOND_RADIATION_CONSTANT: f64 = 1.438_776_877e7;

/// Visible range, nm, and step of the integral over it.
const VISIBLE_NM: [f64; 2] = [360.0, 830.0];
const STEP_NM: f64 = 1.0;
/// Number of steps of the integral over the passband.
const STEPS: u32 = 64;

/// Returns the irradiance in a rectangular passband per illuminance, mW/mm² per lx, of light with
/// the spectrum of a black body at `temperature_k`. The passband has the width `width_nm` and the
/// centre `center_nm`.
///
/// E = ∫_band P(λ) dλ / (683 lm/W · ∫ P(λ)·V(λ) dλ), with Planck's spectrum P and the luminous
/// efficiency V.
pub fn irradiance_per_lux(temperature_k: f64, center_nm: f64, width_nm: f64) -> f64 {
    let low = (center_nm - width_nm / 2.0).max(1.0);
    let step = (center_nm + width_nm / 2.0 - low) / f64::from(STEPS);
    let at = |i: u32| low + step * (f64::from(i) + 0.5);
    let band: f64 = (0..STEPS).map(|i| planck(at(i), temperature_k)).sum();
    let [start, end] = VISIBLE_NM;
    let samples = ((end - start) / STEP_NM) as u32;
    let luminous: f64 = (0..samples)
        .map(|i| start + STEP_NM * (f64::from(i) + 0.5))
        .map(|nm| planck(nm, temperature_k) * luminous_efficiency(nm))
        .sum();
    // 1 W/m² = 1e-3 mW/mm².
    1e-3 * band * step / (LUMENS_PER_WATT * luminous * STEP_NM)
}

/// Returns Planck's spectral radiance without its constant factor.
fn planck(nm: f64, temperature_k: f64) -> f64 {
    (nm / 555.0).powi(-5) / (SECOND_RADIATION_CONSTANT / (nm * temperature_k)).exp_m1()
}

/// Returns the luminous efficiency V(λ) of photopic vision, by the fit of Wyman, Sloan and Shirley
/// (2013, eq. 4) to the colour matching function ȳ of CIE 1931.
fn luminous_efficiency(nm: f64) -> f64 {
    let lobe = |height: f64, center: f64, left: f64, right: f64| {
        let sigma = if nm < center { left } else { right };
        height * (-0.5 * ((nm - center) / sigma).powi(2)).exp()
    };
    lobe(0.821, 568.8, 46.9, 40.5) + lobe(0.286, 530.9, 16.3, 31.1)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The luminous efficacy of a black body at 2856 K (CIE illuminant A) is 15.4 lm/W, and at
    /// 5800 K 93 lm/W (Murphy 2012, J. Appl. Phys. 111, 104909: 2800 K 15.2, 5800 K 93.1). The
    /// total radiation is the integral over all wavelengths, π⁴/15·(T/c₂)⁴ in the unit of
    /// [`planck`].
    #[test]
    fn luminous_efficacy_of_a_black_body() {
        for (temperature, efficacy) in [(2800.0, 15.2), (5800.0, 93.1)] {
            // The width includes all radiation from 0 to 60 µm but less than 0.1 %.
            let mut total = 0.0;
            let mut low: f64 = 100.0;
            while low < 1e5 {
                let high = low * 1.02;
                total += irradiance_per_lux(temperature, (low + high) / 2.0, high - low);
                low = high;
            }
            let found = 1e-3 / total;
            assert!(
                (found / efficacy - 1.0).abs() < 0.02,
                "{temperature}: {found}"
            );
        }
    }
}
