//! Fit of height maps.

use super::model::{Filter, FittedModel, MapSampling, ModelFit, Parameter, mean_and_error};
use super::moments::{Area, Block, Moments, blocks, flat_areas, in_half, index};
use super::{Findings, FittedUnit, FittedValue, HalfStatistic, interval_of_jackknife};
use crate::error::{InputError, Place, Result};
use crate::inspect::HeightMap;
use crate::math::median_of_sorted;
use crate::study::line_image::without_parabola;
use crate::study::patches::{SIDE, STATISTICS};
use crate::study::recording::RecordedMap;
use std::path::Path;

/// Fewest blocks of a half: the scatter of the blocks is the source of all intervals.
const MIN_BLOCKS: usize = 4;
/// Largest deviation of a height from a multiple of the rounding step, as a fraction of it.
const OFF_STEP: f64 = 0.01;
/// Smallest autocorrelation length of a topography that is distinct from noise, points.
const MIN_LENGTH_POINTS: f64 = 3.0;
/// Largest number of heights from which the step is determined.
const STEP_HEIGHTS: usize = 100_000;
/// Smallest step, relative to the largest height. Numbers of 32 bits have steps of 6e-8.
const LEAST_STEP: f64 = 1e-6;

/// Fits one model to all maps.
///
/// # Errors
/// Returns `Error::Input` for maps with different steps or too few flat areas.
pub(super) fn fit_maps(maps: &[&RecordedMap]) -> Result<Findings> {
    let RecordedMap {
        path: first_path,
        map: first,
        ..
    } = maps[0];
    for RecordedMap { path, map, .. } in maps {
        if [map.x_step, map.y_step] != [first.x_step, first.y_step] {
            let found = format!("steps of {} and {} mm", map.x_step, map.y_step);
            let expected = format!("the steps of {}", first_path.display());
            return Err(InputError::new(path, Place::File, found, expected).into());
        }
    }
    let areas: Vec<Vec<Area>> = maps
        .iter()
        .map(|recorded| flat_areas(&recorded.map))
        .collect();
    let halves = [0, 1].map(|half| {
        let of_map = areas.iter().flat_map(|areas| blocks(areas, half));
        of_map.collect::<Vec<Block>>()
    });
    if let Some(few) = halves.iter().map(Vec::len).find(|&n| n < MIN_BLOCKS) {
        return Err(too_small(first_path, first, few));
    }
    let sampling = MapSampling {
        steps: [first.x_step, first.y_step],
        rounding_um: rounding_step(maps).unwrap_or(0.0),
    };
    let fit = ModelFit::new(sampling, [&halves[0], &halves[1]]);
    let model = fit.selected();
    // Heights that vary more slowly than an area: vibration, form and the plane's parabolas.
    let slow: Vec<f64> = halves[0].iter().map(|block| block.slow).collect();
    let unresolved = model.variance - model.expected[0];
    let slow = (mean_and_error(&slow).0 - unresolved).max(0.0);
    let statistics = statistics(&areas, &model.expected, model.variance + slow);
    Ok(Findings {
        values: values(&model, sampling.rounding_um, first_path),
        statistics,
        misfits: fit.misfit(&model).into_iter().collect(),
        inseparable: inseparable(&model, sampling.steps),
    })
}

/// Returns the values of a model.
fn values(model: &FittedModel, rounding_um: f64, source: &Path) -> Vec<FittedValue> {
    let mut values = Vec::new();
    let mut add = |name, key, unit, value| {
        values.push(FittedValue::new(name, key, unit, value, source));
    };
    for (parameter, value) in model.parameters() {
        let (name, key, unit) = match parameter {
            Parameter::Noise => ("noise of a height before filters", None, FittedUnit::Um),
            Parameter::Columns => (
                "correlation of noise between columns",
                None,
                FittedUnit::One,
            ),
            Parameter::Profiles => (
                "correlation of noise between profiles",
                None,
                FittedUnit::One,
            ),
            Parameter::Sq => (
                "topography, Sq",
                Some("part.surface.topography.sq_um"),
                FittedUnit::Um,
            ),
            Parameter::Length => (
                "topography, autocorrelation length",
                Some("part.surface.topography.length_mm"),
                FittedUnit::Mm,
            ),
            Parameter::Filter => (
                "Gaussian filter, standard deviation",
                Some("measure.gaussian_filter_columns"),
                FittedUnit::One,
            ),
        };
        add(name, key, unit, value);
    }
    if let Filter::Mean(columns) = model.terms.filter {
        let width = columns as f64;
        add(
            "moving average",
            Some("measure.moving_average_columns"),
            FittedUnit::Columns,
            [width; 3],
        );
    }
    if rounding_um > 0.0 {
        let step = [rounding_um; 3];
        add(
            "step of heights",
            Some("measure.point_steps_um"),
            FittedUnit::Um,
            step,
        );
    }
    values
}

fn too_small(path: &Path, map: &HeightMap, few: usize) -> crate::error::Error {
    let found = format!(
        "a map of {} by {} points with {few} blocks of flat areas in one half of the profiles",
        map.columns, map.rows
    );
    let expected = format!(
        "{MIN_BLOCKS} or more blocks of {SIDE} by {SIDE} points with 98 % of the heights in each half, such as a plane of \
         {} by {} points",
        2 * SIDE,
        4 * SIDE
    );
    InputError::new(path, Place::File, found, expected).into()
}

/// Returns the combinations of quantities that maps with these steps (mm) do not separate.
fn inseparable(model: &FittedModel, steps: [f64; 2]) -> Vec<String> {
    let terms = model.terms;
    let mut names = vec![
        "Noise of a height: laser power, exposure, gain, speckle contrast and read noise together. Images of the line \
         separate them."
            .to_owned(),
    ];
    let parameters = model.parameters();
    let length = parameters
        .iter()
        .find(|(name, _)| *name == Parameter::Length);
    if length.is_some_and(|(_, value)| value[0] < MIN_LENGTH_POINTS * steps[0].max(steps[1])) {
        names.push(
            "Topography with a length of less than three points and noise that is correlated in both directions: \
             their values may be wrong by more than their intervals. Record with smaller steps."
                .to_owned(),
        );
    } else if terms.topography {
        names.push(
            "Topography and errors of the sensor that are correlated over the same length in both directions."
                .to_owned(),
        );
    }
    if !terms.topography {
        names
            .push("Noise and topography that is finer than the distance of the points.".to_owned());
    }
    if terms.filter == Filter::Gaussian {
        names.push(
            "Gaussian filter and correlation of the noise between columns (grain of the speckle): a wider filter has nearly \
             equal covariances, and the noise before it is larger."
                .to_owned(),
        );
    }
    if terms.columns && terms.filter != Filter::None {
        names.push(
            "Grain of the speckle and the weights of the filter: only their product is certain."
                .to_owned(),
        );
    }
    names
}

/// Returns the step of which all heights are multiples, µm; `None` for heights that are not rounded.
fn rounding_step(maps: &[&RecordedMap]) -> Option<f64> {
    let heights = maps
        .iter()
        .flat_map(|recorded| recorded.map.heights.iter().copied());
    let valid = heights
        .filter(|height| height.is_finite())
        .take(STEP_HEIGHTS);
    let mut sorted: Vec<f64> = valid.map(|height| 1e3 * height).collect();
    sorted.sort_by(f64::total_cmp);
    let least = LEAST_STEP * sorted.last()?.abs().max(sorted.first()?.abs());
    let differences = sorted.windows(2).map(|pair| pair[1] - pair[0]);
    let step = differences
        .filter(|&d| d > least)
        .fold(f64::INFINITY, f64::min);
    if !step.is_finite() {
        return None;
    }
    let first = sorted[0];
    let off = |height: &f64| {
        let steps = (height - first) / step;
        (steps - steps.round()).abs() > OFF_STEP
    };
    (!sorted.iter().any(off)).then_some(step)
}

/// Returns the median statistics of the flat areas of both halves, and the predicted statistics.
fn statistics(areas: &[Vec<Area>], expected: &Moments, variance: f64) -> Vec<HalfStatistic> {
    let median = |half: usize, statistic: usize| {
        let of_map = areas.iter().flat_map(|areas| in_half(areas, half));
        let mut values: Vec<f64> = of_map.map(|area| area.values[statistic]).collect();
        values.sort_by(f64::total_cmp);
        (!values.is_empty()).then(|| median_of_sorted(values.into_iter()))
    };
    let correlation = |columns, profiles| expected[index(columns, profiles)] / expected[0];
    let predicted = [
        variance.sqrt(),
        expected[0].sqrt(),
        correlation(1, 0),
        correlation(2, 0),
        correlation(0, 1),
    ];
    let rows = STATISTICS
        .iter()
        .enumerate()
        .map(|(i, statistic)| HalfStatistic {
            name: statistic.name,
            fitted_half: median(0, i),
            other_half: median(1, i),
            predicted: predicted[i],
        });
    rows.collect()
}

/// Segments of a profile whose scatter determines intervals.
const SEGMENTS: usize = 12;

/// Heights of a plane that are equal in all profiles, minus a parabola, from both halves, mm.
struct CommonProfile<'a> {
    path: &'a Path,
    halves: [Vec<f64>; 2],
    x_step: f64,
    /// Mean height of the plane, mm.
    height: f64,
}

impl CommonProfile<'_> {
    /// Returns `None` if the map is small, or if the heights of one half do not predict the other.
    fn of(recorded: &RecordedMap) -> Option<CommonProfile<'_>> {
        let map = &recorded.map;
        let profiles: Vec<Vec<f64>> = (0..map.rows / SIDE)
            .map(|block| mean_profile(map, block))
            .collect();
        let pairs: Vec<&[Vec<f64>]> = profiles.chunks_exact(2).collect();
        if pairs.len() < 2 || map.columns < SEGMENTS * SIDE / 4 {
            return None;
        }
        let mean_of = |half: usize, x: usize| {
            pairs.iter().map(|pair| pair[half][x]).sum::<f64>() / pairs.len() as f64
        };
        let halves = [0, 1].map(|half| (0..map.columns).map(|x| mean_of(half, x)).collect());
        let valid: Vec<f64> = map
            .heights
            .iter()
            .copied()
            .filter(|z| z.is_finite())
            .collect();
        let profile = CommonProfile {
            path: &recorded.path,
            halves,
            x_step: map.x_step,
            height: valid.iter().sum::<f64>() / valid.len() as f64,
        };
        profile.predicts().then_some(profile)
    }

    fn columns(&self) -> usize {
        self.halves[0].len()
    }

    fn segment(&self, x: usize) -> usize {
        x * SEGMENTS / self.columns()
    }

    /// Returns whether the fitted half predicts the other half better than a plane.
    fn predicts(&self) -> bool {
        let [fitted, other] = &self.halves;
        let improvement = (0..SEGMENTS).map(|segment| {
            let columns = (0..self.columns()).filter(|&x| self.segment(x) == segment);
            let gains = columns.map(|x| other[x].powi(2) - (other[x] - fitted[x]).powi(2));
            let gains: Vec<f64> = gains.filter(|gain| gain.is_finite()).collect();
            gains.iter().sum::<f64>() / gains.len().max(1) as f64
        });
        let (gain, error) = mean_and_error(&improvement.collect::<Vec<f64>>());
        gain > 2.0 * error
    }

    /// Returns the covariance with a plane at a lag in columns. Noise of the halves is independent,
    /// so the product of different halves contains only the common heights.
    fn covariance(&self, plane: &CommonProfile, lag: usize, left_out: Option<usize>) -> f64 {
        let count = self.columns().min(plane.columns()).saturating_sub(lag);
        let used = (0..count).filter(|&x| Some(self.segment(x)) != left_out);
        let product = |x: usize| {
            let of = |first: usize| self.halves[first][x] * plane.halves[1 - first][x + lag];
            (of(0) + of(1)) / 2.0
        };
        let products: Vec<f64> = used.map(product).filter(|p| p.is_finite()).collect();
        products.iter().sum::<f64>() / products.len().max(1) as f64
    }

    /// Returns the standard deviation, µm.
    fn deviation(&self, left_out: Option<usize>) -> f64 {
        1e3 * self.covariance(self, 0, left_out).max(0.0).sqrt()
    }

    /// Returns the lag at which the correlation is 1/e, mm.
    fn length(&self, left_out: Option<usize>) -> f64 {
        let at_zero = self.covariance(self, 0, left_out);
        let at = |lag: usize| self.covariance(self, lag, left_out) / at_zero;
        let limit = 1.0 / std::f64::consts::E;
        let below = (1..self.columns() / 2).find(|&lag| at(lag) < limit);
        below.map_or(f64::NAN, |lag| {
            let [before, after] = [lag - 1, lag].map(at);
            self.x_step * ((lag - 1) as f64 + (before - limit) / (before - after))
        })
    }
}

/// Returns the correlation length of the residual along z from planes at several heights: the mean
/// of d/√(−ln c) over all pairs, for a correlation c at a distance d.
fn length_along_z(planes: &[CommonProfile], left_out: Option<usize>) -> f64 {
    let own = |plane: &CommonProfile| plane.covariance(plane, 0, left_out);
    let mut lengths = Vec::new();
    for (i, a) in planes.iter().enumerate() {
        for b in &planes[i + 1..] {
            let correlation = a.covariance(b, 0, left_out) / (own(a) * own(b)).sqrt();
            lengths.push((a.height - b.height).abs() / (-correlation.ln()).sqrt());
        }
    }
    lengths.iter().sum::<f64>() / lengths.len() as f64
}

/// Fits the residual calibration error from planes: heights that are equal in all profiles after a
/// parabola is removed. Returns the standard deviation and the correlation length along x of each
/// plane, and the correlation length along z of several planes. The keys of the sensor need all
/// three.
pub(super) fn residual_errors(planes: &[&RecordedMap]) -> Findings {
    const DEVIATION: &str = "systematic.residual_um.standard_deviation";
    const ALONG_X: &str = "systematic.residual_um.correlation_x_mm";
    const ALONG_Z: &str = "systematic.residual_um.correlation_z_mm";
    let planes = planes.iter().filter_map(|plane| CommonProfile::of(plane));
    let planes: Vec<CommonProfile> = planes.collect();
    let along_z = interval_of_jackknife(SEGMENTS, |left_out| length_along_z(&planes, left_out));
    let is_finite = |value: &[f64; 3]| value.iter().all(|v| v.is_finite());
    let has_x = |plane: &CommonProfile| plane.length(None).is_finite();
    let has_z = is_finite(&along_z) && along_z[0] > 0.0 && planes.first().is_some_and(has_x);
    let mut findings = Findings::default();
    for (i, plane) in planes.iter().enumerate() {
        let key = |name: &'static str| (has_z && i == 0).then_some(name);
        let deviation = interval_of_jackknife(SEGMENTS, |left_out| plane.deviation(left_out));
        let length = interval_of_jackknife(SEGMENTS, |left_out| plane.length(left_out));
        let named = [
            (
                "residual calibration error",
                DEVIATION,
                FittedUnit::Um,
                deviation,
            ),
            (
                "correlation length of the residual calibration error along x",
                ALONG_X,
                FittedUnit::Mm,
                length,
            ),
        ];
        for (name, of_sensor, unit, value) in named {
            if is_finite(&value) {
                let value = FittedValue::new(name, key(of_sensor), unit, value, plane.path);
                findings.values.push(value);
            }
        }
    }
    if has_z {
        let name = "correlation length of the residual calibration error along z";
        let value = FittedValue::new(name, Some(ALONG_Z), FittedUnit::Mm, along_z, planes[0].path);
        findings.values.push(value);
    } else if !planes.is_empty() {
        findings.inseparable.push(
            "Residual calibration error, form of the plane and topography along the motion: they are equal in all profiles. \
             Planes at several distances are required for the keys of systematic.residual_um."
                .to_owned(),
        );
    }
    findings
}

/// Returns the mean profile of a block of [`SIDE`] profiles minus its parabola, mm.
fn mean_profile(map: &HeightMap, block: usize) -> Vec<f64> {
    let mean = |x: usize| {
        let rows = block * SIDE..(block + 1) * SIDE;
        let heights = rows.map(|row| map.heights[row * map.columns + x]);
        let valid: Vec<f64> = heights.filter(|height| height.is_finite()).collect();
        match valid.len() * 10 >= SIDE * 9 {
            true => valid.iter().sum::<f64>() / valid.len() as f64,
            false => f64::NAN,
        }
    };
    let profile: Vec<f64> = (0..map.columns).map(mean).collect();
    without_parabola(&profile)
}
