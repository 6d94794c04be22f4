//! Statistics of acceptance test characteristics over many seeds, their limits, and the decision.

use serde::Serialize;

/// Characteristic measured by an acceptance test.
#[derive(Debug, Clone, Serialize)]
pub struct Characteristic {
    /// Full name.
    pub name: &'static str,
    /// Symbol used in the standards.
    pub symbol: &'static str,
    /// Maximum permissible error, µm; `None` if the scene does not state one.
    pub mpe_um: Option<f64>,
    /// Results for each position in the measuring volume.
    pub places: Vec<PlaceResult>,
    /// Statistics of the largest absolute value over all positions, to which the limit applies.
    /// `None` if a value is missing for any position and seed.
    pub largest: Option<Statistics>,
    /// Decision by the rule of [`Decision`].
    pub decision: Decision,
}

/// Result of a characteristic at one position.
#[derive(Debug, Clone, Serialize)]
pub struct PlaceResult {
    /// Name of the position.
    pub place: String,
    /// Number of seeds with a value.
    pub seeds: usize,
    /// Statistics of the signed values; `None` without values.
    pub spread: Option<Statistics>,
}

/// Statistics of values over seeds, µm.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Statistics {
    /// Mean.
    pub mean_um: f64,
    /// Standard deviation; 0 for a single value.
    pub std_um: f64,
    /// Lower end of the interval that contains at least 95 % of the values.
    pub low_um: f64,
    /// Upper end of the interval.
    pub high_um: f64,
}

/// Decision by ISO 14253-1 with a guard band U on either side of the limit.
///
/// The decision refers to the interval that contains 95 % of the test results.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Decision {
    /// The interval plus U is within the limit.
    Conforms,
    /// The interval minus U is beyond the limit.
    DoesNotConform,
    /// The limit is within the guarded interval; tests may have either result.
    Undecided,
    /// The scene states no limit, so no decision is possible.
    NoLimit,
    /// A value is missing at a position.
    NotMeasured,
}

impl Decision {
    /// Returns the decision as text.
    pub fn words(self) -> &'static str {
        match self {
            Decision::Conforms => "conforms",
            Decision::DoesNotConform => "does not conform",
            Decision::Undecided => "undecided",
            Decision::NoLimit => "no limit given",
            Decision::NotMeasured => "not measured",
        }
    }

    fn of(largest: Option<&Statistics>, mpe_um: Option<f64>, guard_um: f64) -> Decision {
        match (largest, mpe_um) {
            (None, _) => Decision::NotMeasured,
            (_, None) => Decision::NoLimit,
            (Some(spread), Some(limit)) if spread.high_um + guard_um <= limit => Decision::Conforms,
            (Some(spread), Some(limit)) if spread.low_um - guard_um > limit => {
                Decision::DoesNotConform
            }
            _ => Decision::Undecided,
        }
    }
}

impl Statistics {
    /// Returns the statistics of `values_mm`, in any order. Returns `None` without values.
    pub fn of(values_mm: &[f64]) -> Option<Statistics> {
        let mut sorted: Vec<f64> = values_mm.iter().map(|v| v * 1e3).collect();
        sorted.sort_by(f64::total_cmp);
        let last = sorted.len().checked_sub(1)?;
        let n = sorted.len() as f64;
        let mean = sorted.iter().sum::<f64>() / n;
        let squares: f64 = sorted.iter().map(|v| (v - mean).powi(2)).sum();
        Some(Statistics {
            mean_um: mean,
            std_um: (squares / (n - 1.0).max(1.0)).sqrt(),
            low_um: sorted[(0.025 * last as f64).floor() as usize],
            high_um: sorted[(0.975 * last as f64).ceil() as usize],
        })
    }
}

/// Name and limit of a characteristic.
#[derive(Debug, Clone, Copy)]
pub struct CharacteristicSpec {
    /// See [`Characteristic::name`].
    pub name: &'static str,
    /// See [`Characteristic::symbol`].
    pub symbol: &'static str,
    /// See [`Characteristic::mpe_um`].
    pub mpe_um: Option<f64>,
    /// Guard band on either side of the limit, µm.
    pub guard_um: f64,
}

impl Characteristic {
    /// Evaluates the values (mm) of each position, listed seed by seed.
    pub fn of(
        named: CharacteristicSpec,
        places: Vec<(String, Vec<Option<f64>>)>,
    ) -> Characteristic {
        let seeds = places.first().map_or(0, |(_, values)| values.len());
        let largest = |seed: usize| {
            let mut of_seed = places.iter().map(|(_, values)| values[seed]);
            of_seed.try_fold(0.0, |most: f64, value| Some(most.max(value?.abs())))
        };
        let largest: Option<Vec<f64>> = (0..seeds).map(largest).collect();
        let largest = largest.and_then(|values| Statistics::of(&values));
        Characteristic {
            name: named.name,
            symbol: named.symbol,
            mpe_um: named.mpe_um,
            decision: Decision::of(largest.as_ref(), named.mpe_um, named.guard_um),
            largest,
            places: places
                .into_iter()
                .map(|(place, values)| {
                    let values: Vec<f64> = values.into_iter().flatten().collect();
                    PlaceResult {
                        place,
                        seeds: values.len(),
                        spread: Statistics::of(&values),
                    }
                })
                .collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decided(values_um: &[f64], mpe_um: f64, guard_um: f64) -> Decision {
        let named = CharacteristicSpec {
            name: "n",
            symbol: "s",
            mpe_um: Some(mpe_um),
            guard_um,
        };
        let values = values_um.iter().map(|v| Some(v * 1e-3)).collect();
        Characteristic::of(named, vec![("a".to_owned(), values)]).decision
    }

    #[test]
    fn the_guard_band_is_on_both_sides_of_the_limit() {
        use Decision::{Conforms, DoesNotConform, Undecided};
        assert_eq!(decided(&[-8.0, 7.0], 10.0, 1.0), Conforms);
        assert_eq!(decided(&[-9.5, 7.0], 10.0, 1.0), Undecided);
        assert_eq!(decided(&[-9.5, 7.0], 10.0, 0.0), Conforms);
        assert_eq!(decided(&[-10.5, 12.0], 10.0, 1.0), Undecided);
        assert_eq!(decided(&[-11.5, 12.0], 10.0, 1.0), DoesNotConform);
    }

    #[test]
    fn the_largest_place_decides_and_a_place_without_a_value_leaves_it_open() {
        let named = CharacteristicSpec {
            name: "n",
            symbol: "s",
            mpe_um: None,
            guard_um: 0.0,
        };
        let place = |values: &[Option<f64>]| ("p".to_owned(), values.to_vec());
        let both = [Some(0.001), Some(0.002)];
        let found = Characteristic::of(named, vec![place(&both), place(&[Some(-0.004); 2])]);
        assert_eq!(found.largest.unwrap().mean_um, 4.0);
        assert_eq!((found.mpe_um, found.decision), (None, Decision::NoLimit));
        let found = Characteristic::of(named, vec![place(&both), place(&[None, Some(0.0)])]);
        assert_eq!(found.decision, Decision::NotMeasured);
        assert_eq!(found.places[1].seeds, 1);
        assert_eq!(
            Characteristic::of(named, vec![]).decision,
            Decision::NotMeasured
        );
    }

    /// With 41 values, the first and the last value are outside the interval: 0.025 · 40 = 1.
    #[test]
    fn a_spread_holds_95_of_100_values() {
        let values: Vec<f64> = (0..41).map(|i| f64::from(i) * 1e-3).collect();
        let spread = Statistics::of(&values).unwrap();
        assert!((spread.low_um - 1.0).abs() < 1e-12 && (spread.high_um - 39.0).abs() < 1e-12);
        assert!((spread.mean_um - 20.0).abs() < 1e-12);
        // Sample variance of 0 … n − 1 (divisor n − 1): n·(n + 1)/12.
        assert!((spread.std_um - (41.0f64 * 42.0 / 12.0).sqrt()).abs() < 1e-12);
        assert_eq!(Statistics::of(&[]), None);
    }
}
