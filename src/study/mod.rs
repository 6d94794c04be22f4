//! Studies with the simulator: acceptance tests, accuracy versus speed, peak finders,
//! uncertainties, calibration, and speckle compared with wave optics.

mod accept;
#[cfg(feature = "race")]
mod bench_bvh;
mod calibrate;
mod chart;
mod compare;
mod configurations;
mod emva;
mod external_render;
mod feature_uncertainty;
mod fit;
mod image_file;
mod least_squares;
pub mod lens;
mod line_image;
mod patches;
mod peak_image;
mod peaks;
mod plan_validation;
mod recording;
mod round;
mod sampled;
mod sensor_characterisation;
mod sensor_scene;
mod speckle;
mod step_edge;
mod synthetic;
mod uncertainty;
mod wave;

pub use accept::{
    AcceptSummary, Acceptance, Artefact, Artefacts, Placing, RELATIVE_CHORD as SPHERE_CHORD, Volume,
};
#[cfg(feature = "race")]
pub use bench_bvh::{BvhBench, bench_bvh};
pub use calibrate::{CalibrationSummary, ParameterResult, VIEWS as CALIBRATION_VIEWS, calibrate};
pub use chart::{Chart, ChartEffort, ChartFigures, ChartRow, chart, chart_steps};
pub use compare::{ComparedStatistic, Comparison, MapSummary, compare};
pub use emva::{EmvaSummary, emva, emva_images};
pub use external_render::{BesideFrame, ExternalRender};
pub use feature_uncertainty::{FeatureMonteCarlo, ValueScatter, feature_monte_carlo};
pub use fit::{FitSummary, FittedUnit, FittedValue, HalfStatistic, fit};
pub use image_file::Channel;
pub use patches::{STATISTICS as PATCH_STATISTICS, patch_statistics};
pub use peak_image::{
    FoundLine, GreyImage, ImageSummary, LineAlong, parse_image, peaks_of_image, read_image,
};
pub use peaks::{ChartAxis, FinderError, PeakChart, chart_conditions, peak_chart};
pub use plan_validation::{PlanValidation, validate_plan};
pub use recording::{RecordedImages, RecordedMap, RecordedPart, Recording};
pub use sampled::{SampledStatistics, Statistic};
pub use sensor_characterisation::{
    MEAN_OF, MeasuredAndPredicted, SHEET_STEPS, SheetPlace, SheetSummary, sheet,
};
pub use speckle::{GrainMeasurement, SpeckleSummary, speckle};
pub use uncertainty::{MonteCarlo, monte_carlo, repeatability};
pub use wave::{
    ComparedMotion, MOST_TERMS, PATCH_STEPS, WaveEffort, WavePatch, WaveSummary, reference_motions,
    wave_patch, wave_reference,
};
