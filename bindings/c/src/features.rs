//! Values and verdicts of the features of a scene.

use crate::buffers::set;
use crate::handles::{self, Handle};
use crate::simulate::lasertrace_simulation;
use crate::status::{Failure, enter, lasertrace_status};
use lasertrace_core::inspect::features::{Conformance, FeatureResult, Quantity};
use lasertrace_core::run::RunControl;
use std::ffi::{CString, c_char};
use std::sync::atomic::AtomicBool;

/// Values of the features of a scene, in the order of `features.csv`. Owns its data; its simulation
/// may be freed.
pub struct lasertrace_features {
    _opaque: (),
}

impl Handle for lasertrace_features {
    type Object = Vec<Row>;
    const NAME: &'static str = "lasertrace_features";
}

/// Row of `features.csv`.
pub struct Row {
    feature: CString,
    kind: CString,
    quantity: Option<CString>,
    problem: Option<CString>,
    numbers: ValueFields,
}

/// Numbers of a row.
#[derive(Clone, Copy, Default)]
struct ValueFields {
    nominal: f64,
    measured: f64,
    deviation: f64,
    standard_uncertainty: f64,
    expanded_uncertainty: f64,
    limits: [f64; 2],
    u_over_t: f64,
    smallest_tolerance: f64,
    points: u64,
    conformance: u32,
    lower_bound: bool,
}

/// Value of `conformance`: the quantity has no tolerance.
pub const LASERTRACE_CONFORMANCE_NONE: u32 = 0;
/// Value of `conformance`: the deviation is inside the limits by at least the expanded uncertainty.
pub const LASERTRACE_CONFORMANCE_CONFORMS: u32 = 1;
/// Value of `conformance`: the deviation is outside the limits by more than the expanded
/// uncertainty.
pub const LASERTRACE_CONFORMANCE_DOES_NOT_CONFORM: u32 = 2;
/// Value of `conformance`: the deviation is closer to a limit than the expanded uncertainty.
pub const LASERTRACE_CONFORMANCE_UNDECIDED: u32 = 3;

/// Value of a quantity of a feature, or the reason why a feature has no value. Numbers are in the
/// unit at the end of the quantity's name (mm or degrees), and 0 where they do not apply. The
/// strings are UTF-8 and valid until the lasertrace_features is freed.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct lasertrace_feature_value {
    /// Name of the feature.
    pub feature: *const c_char,
    /// Kind of the feature, as in the scene file.
    pub kind: *const c_char,
    /// Name of the quantity, for example "diameter_mm"; NULL for a feature without values.
    pub quantity: *const c_char,
    /// Reason why the feature has no values; NULL for a value.
    pub problem: *const c_char,
    /// Value of the CAD.
    pub nominal: f64,
    /// Measured value.
    pub measured: f64,
    /// Measured minus nominal value.
    pub deviation: f64,
    /// Standard uncertainty of the measured value.
    pub standard_uncertainty: f64,
    /// Expanded uncertainty U: k = 2, and 2 to 2.9 for a displacement or tilt.
    pub expanded_uncertainty: f64,
    /// Lower limit of the deviation; 0 without a tolerance.
    pub lower: f64,
    /// Upper limit of the deviation; 0 without a tolerance.
    pub upper: f64,
    /// Ratio of U and the width of the tolerance; 0 without a tolerance.
    pub u_over_t: f64,
    /// Width of the smallest tolerance whose conformance can be proven.
    pub smallest_tolerance: f64,
    /// Number of points that the value uses.
    pub points: u64,
    /// Conformance with the tolerance by ISO 14253-1: LASERTRACE_CONFORMANCE_...
    pub conformance: u32,
    /// 1 if the uncertainties are lower bounds, because the scene has no systematic errors of sensor
    /// and stage; otherwise 0.
    pub lower_bound: u32,
}

/// Simulates all frames of the scan, with the profile filters and the alignment of the scene, and
/// evaluates its features. The numbers are those of `features.csv` of `lasertrace scan`. A scene
/// without features has 0 values.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lasertrace_simulation_features(
    simulation: *const lasertrace_simulation,
    out: *mut *mut lasertrace_features,
) -> lasertrace_status {
    enter("lasertrace_simulation_features", || {
        // SAFETY: guaranteed by the caller.
        unsafe { set("out", out, std::ptr::null_mut())? };
        let simulator = handles::find(simulation)?;
        let never = AtomicBool::new(false);
        let control = RunControl {
            progress: &|_| {},
            setup_progress: None,
            notice: None,
            stop: &never,
        };
        let features =
            (simulator.pool).install(|| simulator.simulation.scanned_features(&control))?;
        let rows: Vec<Row> = features.iter().flat_map(Row::of).collect();
        // SAFETY: guaranteed by the caller.
        unsafe { set("out", out, handles::give(rows)) }
    })
}

/// Writes the number of values to `out`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lasertrace_features_count(
    features: *const lasertrace_features,
    out: *mut u64,
) -> lasertrace_status {
    enter("lasertrace_features_count", || {
        let rows = handles::find(features)?;
        // SAFETY: guaranteed by the caller.
        unsafe { set("out", out, rows.len() as u64) }
    })
}

/// Writes the value of an index, 0 to count - 1, to `out`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn lasertrace_features_value(
    features: *const lasertrace_features,
    index: u64,
    out: *mut lasertrace_feature_value,
) -> lasertrace_status {
    enter("lasertrace_features_value", || {
        let rows = handles::find(features)?;
        let row = usize::try_from(index).ok().and_then(|i| rows.get(i));
        let row = row.ok_or_else(|| {
            let count = rows.len();
            Failure::argument(format!("index: found {index}, expected less than {count}"))
        })?;
        // SAFETY: guaranteed by the caller.
        unsafe { set("out", out, row.value()) }
    })
}

/// Frees the values. NULL is ignored and returns LASERTRACE_STATUS_OK.
#[unsafe(no_mangle)]
pub extern "C" fn lasertrace_features_free(
    features: *mut lasertrace_features,
) -> lasertrace_status {
    enter("lasertrace_features_free", || handles::free(features))
}

impl Row {
    /// Returns the rows of a feature: its values, or the reason why it has none.
    fn of(feature: &FeatureResult) -> Vec<Row> {
        let row = |quantity: Option<&Quantity>| Row {
            feature: string(&feature.name),
            kind: string(feature.kind),
            quantity: quantity.map(|q| string(q.name)),
            problem: match quantity {
                Some(_) => None,
                None => feature.problem.as_deref().map(string),
            },
            numbers: ValueFields {
                points: feature.points as u64,
                lower_bound: feature.lower_bound,
                ..quantity.map_or_else(ValueFields::default, ValueFields::of)
            },
        };
        let problem = feature.problem.as_ref().map(|_| row(None));
        let values = feature.quantities.iter().map(|q| row(Some(q)));
        problem.into_iter().chain(values).collect()
    }

    fn value(&self) -> lasertrace_feature_value {
        let optional =
            |text: &Option<CString>| text.as_ref().map_or(std::ptr::null(), |t| t.as_ptr());
        let v = &self.numbers;
        lasertrace_feature_value {
            feature: self.feature.as_ptr(),
            kind: self.kind.as_ptr(),
            quantity: optional(&self.quantity),
            problem: optional(&self.problem),
            nominal: v.nominal,
            measured: v.measured,
            deviation: v.deviation,
            standard_uncertainty: v.standard_uncertainty,
            expanded_uncertainty: v.expanded_uncertainty,
            lower: v.limits[0],
            upper: v.limits[1],
            u_over_t: v.u_over_t,
            smallest_tolerance: v.smallest_tolerance,
            points: v.points,
            conformance: v.conformance,
            lower_bound: v.lower_bound.into(),
        }
    }
}

impl ValueFields {
    fn of(q: &Quantity) -> ValueFields {
        ValueFields {
            nominal: q.nominal,
            measured: q.measured,
            deviation: q.deviation,
            standard_uncertainty: q.standard_uncertainty,
            expanded_uncertainty: q.expanded_uncertainty,
            limits: q.tolerance.unwrap_or_default(),
            u_over_t: q.u_over_t.unwrap_or_default(),
            smallest_tolerance: q.smallest_tolerance,
            conformance: match q.conformance {
                None => LASERTRACE_CONFORMANCE_NONE,
                Some(Conformance::Conforms) => LASERTRACE_CONFORMANCE_CONFORMS,
                Some(Conformance::DoesNotConform) => LASERTRACE_CONFORMANCE_DOES_NOT_CONFORM,
                Some(Conformance::Undecided) => LASERTRACE_CONFORMANCE_UNDECIDED,
            },
            ..ValueFields::default()
        }
    }
}

/// Returns a C string. NUL characters are replaced.
fn string(text: &str) -> CString {
    CString::new(text.replace('\0', "\u{fffd}")).unwrap_or_default()
}
