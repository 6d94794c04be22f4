//! Rendered lines that the lens blurs, against waves with exact paths: a few of the lines of
//! `docs/lens.md`.

use lasertrace::math::Aperture;
use lasertrace::study::lens::{LensEffort, defocused_line, lens_row};
use lasertrace::wave::line_statistics::LineStatistics;

/// Standard errors allowed. Errors are of 21 frames or more, so by Student's distribution of 20 degrees of
/// freedom one number in 14 000 lies further off, and of the 29 compared here one in 500 draws. Seeds are
/// fixed.
const ERRORS: f64 = 5.0;

/// Noise by the field through the lens is that of waves, whose standard errors together are 1.5 % or so;
/// speckle is fully developed; light without speckle is within half a percent of its peak where waves have it;
/// grains are as long as those of waves, to what a logarithm that is linear between lags a pixel apart errs, 1 %.
/// Texture times blurred mean moves centroids too little: by 1.26 at b = 4σ, σ = 2h (physics of the
/// centroid of a defocused line), and not by more than a tenth up to b = 2σ.
#[test]
fn rendered_lines_out_of_focus_are_those_of_waves() {
    let effort = LensEffort {
        waves: 2600.0,
        rendered: 2600.0,
        seed: 7,
    };
    for (aperture, sigma, over) in [
        (Aperture::Circle, 1.0, 2.0),
        (Aperture::Circle, 2.0, 4.0),
        (Aperture::Square, 1.0, 4.0),
    ] {
        let line = defocused_line(aperture, sigma, sigma * over);
        let row = lens_row(&line, &effort).unwrap();
        let [coherent, texture] = row.noise_ratios();
        println!("{line:?}: {coherent:?} {texture:?} {:?}", row.contrasts());
        let off = (coherent.value - 1.0).abs();
        assert!(off < ERRORS * coherent.error, "{line:?}: {coherent:?}");
        assert!(coherent.error < 0.02, "{line:?}: {coherent:?}");
        if over == 4.0 && aperture == Aperture::Circle {
            let off = (texture.value - 1.0 / 1.26).abs();
            assert!(off < ERRORS * texture.error, "{line:?}: {texture:?}");
        }
        if over <= 2.0 {
            let off = (texture.value - 1.0).abs();
            assert!(off < 0.1 + ERRORS * texture.error, "{line:?}: {texture:?}");
        }
        for contrast in row.contrasts().into_iter().flatten() {
            let off = (contrast.value - 1.0).abs();
            assert!(off < ERRORS * contrast.error, "{line:?}: {contrast:?}");
        }
        for of in [
            |f: &LineStatistics| f.grain_along,
            |f: &LineStatistics| f.grain_across,
        ] {
            let ratio = of(&row.coherent).ratio_to(&of(&row.waves));
            let off = (ratio.value - 1.0).abs();
            assert!(off < 0.01 + ERRORS * ratio.error, "{line:?}: {ratio:?}");
        }
        let [mean, of_frames] = row.mean_off;
        assert!(mean < 5e-3, "{line:?}: {mean}");
        // Of all rows of the window; none is less sure, as a share of the peak, than the middle one.
        let light = row.coherent.light;
        let bound = 5e-3 + ERRORS * light.error / light.value;
        assert!(of_frames < bound, "{line:?}: {of_frames}");
    }
}
