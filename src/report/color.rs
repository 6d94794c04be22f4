//! Colour maps that are readable with red-green colour blindness and in greyscale.

/// Red, green and blue in sRGB.
pub type Rgb = [u8; 3];

fn between(stops: &[[f64; 3]], share: f64) -> Rgb {
    let at = share.clamp(0.0, 1.0) * (stops.len() - 1) as f64;
    let i = (at as usize).min(stops.len() - 2);
    std::array::from_fn(|c| {
        let (a, b) = (stops[i][c], stops[i + 1][c]);
        (a + (b - a) * (at - i as f64)).round() as u8
    })
}

/// Returns a colour from −limit (blue) over 0 (pale yellow) to +limit (red).
pub fn diverging(value: f64, limit: f64) -> Rgb {
    const STOPS: [[f64; 3]; 5] = [
        [49.0, 54.0, 149.0],
        [116.0, 173.0, 209.0],
        [255.0, 255.0, 191.0],
        [244.0, 109.0, 67.0],
        [165.0, 0.0, 38.0],
    ];
    between(&STOPS, value / limit / 2.0 + 0.5)
}

/// Returns a colour from 0 (pale yellow) to `limit` (dark blue).
pub fn sequential(value: f64, limit: f64) -> Rgb {
    const STOPS: [[f64; 3]; 4] = [
        [255.0, 255.0, 204.0],
        [127.0, 205.0, 187.0],
        [34.0, 94.0, 168.0],
        [8.0, 20.0, 70.0],
    ];
    between(&STOPS, value / limit)
}

/// Formats a colour for CSS and SVG.
pub fn css([r, g, b]: Rgb) -> String {
    format!("rgb({r},{g},{b})")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scales_end_where_they_say_and_go_on_beyond() {
        assert_eq!(diverging(0.0, 2.0), [255, 255, 191]);
        assert_eq!(diverging(-9.0, 2.0), diverging(-2.0, 2.0));
        assert_eq!(sequential(9.0, 2.0), [8, 20, 70]);
    }
}
