//! Names of keys and values in version 0.2.0 that have other names now.

/// Old and new names. A name in a file is matched only where the new name is permitted.
pub(super) const RENAMED: &[(&str, &str)] = &[
    ("accel", "ray_backend"),
    ("align", "best_fit_alignment"),
    ("aperture", "aperture_shape"),
    ("artefact_um", "artefact_expanded_uncertainty_um"),
    ("band_mm", "tolerance_mm"),
    ("binning_of", "binning_mode"),
    ("blur", "defocus_model"),
    ("box_mm", "bounds_mm"),
    ("cap_deg", "cap_half_angle_deg"),
    ("choose", "peak_selection"),
    ("chord_um", "chordal_deviation_um"),
    ("coat", "coated_diffuse"),
    ("columns", "column_axis"),
    ("copies", "instances"),
    ("counts", "digital"),
    ("cutoff_radii", "beam_cutoff_radii"),
    ("draw", "sample"),
    ("draws", "samples"),
    ("exposure_poses", "motion_samples"),
    ("exposure_share", "auto_exposure_target"),
    ("exposures_ms", "hdr_exposures_ms"),
    ("fill_gaps_mm", "max_gap_mm"),
    ("full_frame_rate_hz", "max_full_frame_rate_hz"),
    ("height_um", "max_height_error_um"),
    ("heights", "height_steps"),
    ("housing_mm", "housing_bounds_mm"),
    ("independent_patterns", "incoherent_modes"),
    ("left_out_percent", "excluded_percent"),
    ("limits_um", "mpe_um"),
    ("list", "cases"),
    ("matt", "diffuse"),
    ("mean", "incoherent"),
    ("mean_columns", "moving_average_columns"),
    ("median_columns", "median_filter_columns"),
    ("moves", "moving_body"),
    ("one_of", "choice"),
    ("outlier_um", "outlier_threshold_um"),
    ("peak", "peak_estimator"),
    ("plan", "model"),
    ("planes", "planar"),
    ("plate_mm", "plate_side_mm"),
    ("rays", "per-sample"),
    ("read_rows", "roi_rows"),
    ("reflections", "max_bounces"),
    ("resample_um", "resample_spacing_um"),
    ("roughness_across", "roughness_v"),
    ("sampling", "pixel_sampling"),
    ("share", "weight"),
    ("spacing_mm", "ball_bar_length_mm"),
    ("speckle_slips", "local_speckle_motion"),
    ("sphere_mm", "sphere_diameter_mm"),
    ("write_frames", "save_images"),
];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::keys;

    #[test]
    fn old_names_are_not_keys_of_a_table_with_the_new_name() {
        let known: Vec<&str> = keys::all().collect();
        for (old, new) in RENAMED {
            for key in known
                .iter()
                .filter(|key| key.rsplit('.').next() == Some(new))
            {
                let before = format!("{}{old}", key.strip_suffix(new).unwrap());
                assert!(!known.contains(&before.as_str()), "{before}");
            }
        }
    }
}
