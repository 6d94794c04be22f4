use super::*;
use crate::wave::correlation::PairCorrelation;

fn estimate(value: f64) -> MeanEstimate {
    MeanEstimate {
        value,
        low: value - 0.02,
        high: value + 0.02,
    }
}

/// Every element is closed, and no number is NaN or infinite.
fn assert_drawn(svg: &str) {
    for broken in ["NaN", "inf"] {
        assert!(!svg.contains(broken), "{broken} in the drawing");
    }
    let opened = svg.matches('<').count() - svg.matches("</").count();
    assert_eq!(
        opened,
        svg.matches("/>").count() + svg.matches("</").count()
    );
    assert!(svg.starts_with("<svg") && svg.ends_with("</svg>\n"));
}

#[test]
fn the_motion_plot_shows_every_row_and_escapes_its_name() {
    let row = |name: &str, displacement| MotionRow {
        name: name.into(),
        delta: 0.2,
        seed_sum: 0.3,
        defocus_phase: 0.8,
        gamma_overlap: 0.558,
        gamma_defocused: 0.5,
        displacement_um: [10.0, 0.0],
        waves: PairCorrelation {
            gamma: estimate(0.5),
            displacement,
        },
    };
    let moved = Some([estimate(0.01), estimate(0.0)]);
    let svg = motion_plot(
        &[row("tilt <1°> & shift", moved), row("lost", None)],
        &[0.49, 0.51],
    );
    assert_drawn(&svg);
    assert!(svg.contains("1: tilt &lt;1°> &amp; shift") && svg.contains("2: lost"));
    // Two values of γ, drawn twice; two of the texture; two components of the displacement; five
    // legend entries.
    assert_eq!(svg.matches("<circle").count(), 13);
    assert_drawn(&motion_plot(&[], &[]));
}

#[test]
fn the_centroid_plot_puts_a_value_where_the_axes_say() {
    let svg = centroid_plot(&[CentroidRow {
        width: 2.0,
        law: 0.39,
        law_of_image: 0.4,
        waves: estimate(0.5),
        waves_bright: estimate(0.45),
        bright_share: 0.9,
    }]);
    assert_drawn(&svg);
    // x: 80 + 520·2/(2·1.08); y: 50 + 360·(1 − 0.5/(0.52·1.1)).
    assert!(
        svg.contains(r#"<circle cx="561.48" cy="95.31" r="3""#),
        "{svg}"
    );
}
