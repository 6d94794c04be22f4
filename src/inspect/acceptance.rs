//! Characteristics of an acceptance test over many seeds, their limits, and the decision.

use serde::Serialize;

/// What an acceptance test measures.
#[derive(Debug, Clone, Serialize)]
pub struct Characteristic {
    /// In words.
    pub name: &'static str,
    /// As standards write it.
    pub symbol: &'static str,
    /// Largest permissible value, µm; `None` if the scene does not state one.
    pub limit_um: Option<f64>,
    /// One for each place in the measuring volume.
    pub places: Vec<PlaceResult>,
    /// Of the largest magnitude over all places, which the limit is for; `None`: some place gave no
    /// value for some seed.
    pub largest: Option<Spread>,
    /// By the rule of [`Decision`].
    pub decision: Decision,
}

/// A characteristic at one place.
#[derive(Debug, Clone, Serialize)]
pub struct PlaceResult {
    /// Name of the place.
    pub place: String,
    /// Seeds that gave a value.
    pub seeds: usize,
    /// Signed; `None` without any.
    pub spread: Option<Spread>,
}

/// Values over seeds, µm.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Spread {
    /// Mean.
    pub mean_um: f64,
    /// Standard deviation; 0 of a single value.
    pub std_um: f64,
    /// 95 of 100 values lie above this and below `high_um`, or more.
    pub low_um: f64,
    /// See `low_um`.
    pub high_um: f64,
}

/// By ISO 14253-1, with the guard band U on either side of the limit: what 95 of 100 tests would find conforms if it and U stay
/// within the limit, and does not if it less U lies beyond.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Decision {
    /// All of the interval is in the acceptance zone.
    Conforms,
    /// All of it is beyond the limit and the guard band.
    DoesNotConform,
    /// Neither: tests would end either way.
    Undecided,
    /// The scene states no limit, and without one there is no verdict.
    NoLimit,
    /// Some place gave no value.
    NotMeasured,
}

impl Decision {
    /// In words.
    pub fn words(self) -> &'static str {
        match self {
            Decision::Conforms => "conforms",
            Decision::DoesNotConform => "does not conform",
            Decision::Undecided => "undecided",
            Decision::NoLimit => "no limit given",
            Decision::NotMeasured => "not measured",
        }
    }

    fn of(largest: Option<&Spread>, limit_um: Option<f64>, guard_um: f64) -> Decision {
        match (largest, limit_um) {
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

impl Spread {
    /// `None` without values; `values_mm` in any order.
    pub fn of(values_mm: &[f64]) -> Option<Spread> {
        let mut sorted: Vec<f64> = values_mm.iter().map(|v| v * 1e3).collect();
        sorted.sort_by(f64::total_cmp);
        let last = sorted.len().checked_sub(1)?;
        let n = sorted.len() as f64;
        let mean = sorted.iter().sum::<f64>() / n;
        let squares: f64 = sorted.iter().map(|v| (v - mean).powi(2)).sum();
        Some(Spread {
            mean_um: mean,
            std_um: (squares / (n - 1.0).max(1.0)).sqrt(),
            low_um: sorted[(0.025 * last as f64).floor() as usize],
            high_um: sorted[(0.975 * last as f64).ceil() as usize],
        })
    }
}

/// What a characteristic is called, and its limit.
#[derive(Debug, Clone, Copy)]
pub struct Named {
    /// See [`Characteristic::name`].
    pub name: &'static str,
    /// See [`Characteristic::symbol`].
    pub symbol: &'static str,
    /// See [`Characteristic::limit_um`].
    pub limit_um: Option<f64>,
    /// Guard band on either side of the limit.
    pub guard_um: f64,
}

impl Characteristic {
    /// From the values (mm) of each place, seed by seed.
    pub fn of(named: Named, places: Vec<(String, Vec<Option<f64>>)>) -> Characteristic {
        let seeds = places.first().map_or(0, |(_, values)| values.len());
        let largest = |seed: usize| {
            let mut of_seed = places.iter().map(|(_, values)| values[seed]);
            of_seed.try_fold(0.0, |most: f64, value| Some(most.max(value?.abs())))
        };
        let largest: Option<Vec<f64>> = (0..seeds).map(largest).collect();
        let largest = largest.and_then(|values| Spread::of(&values));
        Characteristic {
            name: named.name,
            symbol: named.symbol,
            limit_um: named.limit_um,
            decision: Decision::of(largest.as_ref(), named.limit_um, named.guard_um),
            largest,
            places: places
                .into_iter()
                .map(|(place, values)| {
                    let values: Vec<f64> = values.into_iter().flatten().collect();
                    PlaceResult {
                        place,
                        seeds: values.len(),
                        spread: Spread::of(&values),
                    }
                })
                .collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decided(values_um: &[f64], limit_um: f64, guard_um: f64) -> Decision {
        let named = Named {
            name: "n",
            symbol: "s",
            limit_um: Some(limit_um),
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
        let named = Named {
            name: "n",
            symbol: "s",
            limit_um: None,
            guard_um: 0.0,
        };
        let place = |values: &[Option<f64>]| ("p".to_owned(), values.to_vec());
        let both = [Some(0.001), Some(0.002)];
        let found = Characteristic::of(named, vec![place(&both), place(&[Some(-0.004); 2])]);
        assert_eq!(found.largest.unwrap().mean_um, 4.0);
        assert_eq!((found.limit_um, found.decision), (None, Decision::NoLimit));
        let found = Characteristic::of(named, vec![place(&both), place(&[None, Some(0.0)])]);
        assert_eq!(found.decision, Decision::NotMeasured);
        assert_eq!(found.places[1].seeds, 1);
        assert_eq!(
            Characteristic::of(named, vec![]).decision,
            Decision::NotMeasured
        );
    }

    /// Of 41 values the first and last lie outside: 0.025 · 40 = 1.
    #[test]
    fn a_spread_holds_95_of_100_values() {
        let values: Vec<f64> = (0..41).map(|i| f64::from(i) * 1e-3).collect();
        let spread = Spread::of(&values).unwrap();
        assert!((spread.low_um - 1.0).abs() < 1e-12 && (spread.high_um - 39.0).abs() < 1e-12);
        assert!((spread.mean_um - 20.0).abs() < 1e-12);
        // Variance of 0 … n − 1 with n − 1 below: n·(n + 1)/12.
        assert!((spread.std_um - (41.0f64 * 42.0 / 12.0).sqrt()).abs() < 1e-12);
        assert_eq!(Spread::of(&[]), None);
    }
}
