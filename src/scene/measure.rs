//! Validation of `[measure]`: line detection and profile filters.

use super::file::MeasureTable;
use super::resolve::Measure;
use super::resolver::Resolver;
use crate::camera::Camera;
use crate::error::Result;
use crate::profile::{Filters, Smooth};

/// Minimum spacing of resampled points, in column spacings at best focus. A finer spacing adds no
/// information.
const FINEST: f64 = 0.25;

impl Resolver<'_> {
    pub(super) fn measure(
        &self,
        table: &MeasureTable,
        camera: &Camera,
        frames: u32,
    ) -> Result<Measure> {
        let full = camera.sensor.full_scale() - camera.sensor.black_level_dn;
        self.check(
            table.threshold_dn.is_none_or(|dn| dn > 0.0 && dn < full),
            "measure.threshold_dn",
            &format!("a number of counts > 0 and below {full:.0}, full scale less the black level"),
        )?;
        self.check(
            table
                .row_steps_per_px
                .is_none_or(|n| (1..=65536).contains(&n)),
            "measure.row_steps_per_px",
            "a number of steps from 1 to 65536, such as 16 for rows in 1/16 px",
        )?;
        for step in table.point_steps_um.into_iter().flatten() {
            let expected = "steps of x and z from 1e-6 to 1e6 µm: [5, 1.5]";
            let holds = (1e-6..=1e6).contains(&step);
            self.check(holds, "measure.point_steps_um", expected)?;
        }
        Ok(Measure {
            row_steps_per_px: table.row_steps_per_px,
            point_steps: table.point_steps_um.map(|steps| steps.map(|um| um * 1e-3)),
            finder: table.peak_estimator,
            choice: table.peak_selection,
            threshold_dn: table.threshold_dn,
            align: table.best_fit_alignment,
            filters: self.filters(table, camera, frames)?,
        })
    }

    fn filters(&self, table: &MeasureTable, camera: &Camera, frames: u32) -> Result<Filters> {
        let length = |value: Option<f64>, key: &str, mm: f64| -> Result<Option<f64>> {
            let key = format!("measure.{key}");
            let length = value.map(|value| self.positive(value, &key));
            Ok(length.transpose()?.map(|length| length * mm))
        };
        let average_frames = table.average_frames;
        self.check(
            (1..=1000).contains(&average_frames) && average_frames <= frames,
            "measure.average_frames",
            &format!("from 1 to 1000, and no more than the scan's {frames} frames"),
        )?;
        let columns = |value: Option<u32>, key: &str| -> Result<Option<u32>> {
            match value {
                None => Ok(None),
                Some(columns) => {
                    let holds = (3..=101).contains(&columns) && columns % 2 == 1;
                    let expected = "an odd number of columns from 3 to 101";
                    self.check(holds, &format!("measure.{key}"), expected)?;
                    Ok(Some(columns))
                }
            }
        };
        let mean =
            columns(table.moving_average_columns, "moving_average_columns")?.map(Smooth::Mean);
        let median =
            columns(table.median_filter_columns, "median_filter_columns")?.map(Smooth::Median);
        self.check(
            mean.is_none() || median.is_none(),
            "measure.median_filter_columns",
            "one of moving_average_columns and median_filter_columns",
        )?;
        let gaussian = table.gaussian_filter_columns;
        self.check(
            gaussian.is_none_or(|sigma| (0.3..=25.0).contains(&sigma)),
            "measure.gaussian_filter_columns",
            "a standard deviation of 0.3 to 25 columns",
        )?;
        let smooth = mean.or(median);
        self.check(
            gaussian.is_none() || smooth.is_none(),
            "measure.gaussian_filter_columns",
            "one of moving_average_columns, median_filter_columns and gaussian_filter_columns",
        )?;
        let resample = length(table.resample_spacing_um, "resample_spacing_um", 1e-3)?;
        let column = camera.sensor.pixel_pitch / camera.lens.magnification();
        self.check(
            resample.is_none_or(|step| step >= FINEST * column),
            "measure.resample_spacing_um",
            &format!(
                "a quarter of the distance of two columns or more, {:.3} µm",
                FINEST * column * 1e3
            ),
        )?;
        Ok(Filters {
            outlier: length(table.outlier_threshold_um, "outlier_threshold_um", 1e-3)?,
            average_frames,
            fill: length(table.max_gap_mm, "max_gap_mm", 1.0)?,
            smooth: smooth.or(gaussian.map(Smooth::Gaussian)),
            resample,
        })
    }
}
