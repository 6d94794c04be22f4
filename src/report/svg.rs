//! Generation of SVG text: elements, number formatting and escaping.

use super::picture::data_url;
use std::fmt::Write;

/// Values of `style` for text that is right-aligned or centred at its position.
pub const END: &str = "text-anchor='end'";
pub const MIDDLE: &str = "text-anchor='middle'";

/// SVG document under construction. Coordinates are (right, down). `style` is inserted unchanged
/// into the element, for example `stroke='#333' stroke-width='2'`.
pub struct Svg(String);

impl Svg {
    /// Creates a separate file with a white background.
    pub fn file([width, height]: [f64; 2], font_size: f64) -> Svg {
        let mut svg = Svg(format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {} {}\" \
             font-family=\"sans-serif\" font-size=\"{}\" fill=\"#222\">",
            number(width),
            number(height),
            number(font_size)
        ));
        svg.rect([0.0, 0.0, width, height], "fill='white'");
        svg
    }

    /// Creates an inline image that shows `view` (left, top, width, height). `label` is the text
    /// for screen readers.
    pub fn part(view: [f64; 4], style: &str, label: &str) -> Svg {
        let [left, top, width, height] = view.map(number);
        let label = escape(label);
        Svg(format!(
            "<svg viewBox=\"{left} {top} {width} {height}\" {style} role=\"img\" aria-label=\"{label}\">"
        ))
    }

    pub fn finish(self) -> String {
        self.0 + "</svg>\n"
    }

    fn element(&mut self, name: &str, numbers: &[(&str, f64)], style: &str, content: &str) {
        let _ = write!(self.0, "<{name}");
        for (key, value) in numbers {
            let _ = write!(self.0, " {key}=\"{}\"", number(*value));
        }
        let space = if style.is_empty() { "" } else { " " };
        let _ = match content {
            "" => write!(self.0, "{space}{style}/>"),
            _ => write!(self.0, "{space}{style}>{}</{name}>", escape(content)),
        };
    }

    pub fn line(&mut self, [x1, y1]: [f64; 2], [x2, y2]: [f64; 2], style: &str) {
        let ends = [("x1", x1), ("y1", y1), ("x2", x2), ("y2", y2)];
        self.element("line", &ends, style, "");
    }

    pub fn rect(&mut self, [x, y, width, height]: [f64; 4], style: &str) {
        let sides = [("x", x), ("y", y), ("width", width), ("height", height)];
        self.element("rect", &sides, style, "");
    }

    pub fn circle(&mut self, [x, y]: [f64; 2], radius: f64, style: &str) {
        self.element("circle", &[("cx", x), ("cy", y), ("r", radius)], style, "");
    }

    pub fn text(&mut self, [x, y]: [f64; 2], style: &str, content: &str) {
        if !content.is_empty() {
            self.element("text", &[("x", x), ("y", y)], style, content);
        }
    }

    /// Adds vertical text, read upwards and centred at its position.
    pub fn text_upwards(&mut self, [x, y]: [f64; 2], content: &str) {
        let style = format!(
            "{MIDDLE} transform='rotate(-90 {} {})'",
            number(x),
            number(y)
        );
        self.text([x, y], &style, content);
    }

    pub fn polyline(&mut self, points: impl IntoIterator<Item = [f64; 2]>, style: &str) {
        let style = format!("fill='none' {style} points='{}'", places(points));
        self.element("polyline", &[], &style, "");
    }

    pub fn polygon(&mut self, points: impl IntoIterator<Item = [f64; 2]>, style: &str) {
        let style = format!("{style} points='{}'", places(points));
        self.element("polygon", &[], &style, "");
    }

    pub fn image(&mut self, [x, y, width, height]: [f64; 4], png: &[u8]) {
        let sides = [("x", x), ("y", y), ("width", width), ("height", height)];
        self.element("image", &sides, &format!("href='{}'", data_url(png)), "");
    }

    /// Adds a group with `style` and a tooltip `title`. `draw` adds its elements.
    pub fn group(&mut self, style: &str, title: &str, draw: impl FnOnce(&mut Svg)) {
        let _ = write!(self.0, "<g {style}>");
        if !title.is_empty() {
            self.element("title", &[], "", title);
        }
        draw(self);
        self.0.push_str("</g>");
    }
}

/// Formats a coordinate in hundredths, without trailing zeros.
fn number(value: f64) -> String {
    // Adding 0 turns −0 into 0.
    format!("{}", (value * 100.0).round() / 100.0 + 0.0)
}

fn places(points: impl IntoIterator<Item = [f64; 2]>) -> String {
    let place = |[x, y]: [f64; 2]| format!("{},{}", number(x), number(y));
    let places: Vec<String> = points.into_iter().map(place).collect();
    places.join(" ")
}

/// Escapes text for an element or a double-quoted attribute.
fn escape(text: &str) -> String {
    let text = text.replace('&', "&amp;").replace('<', "&lt;");
    text.replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_are_escaped_and_numbers_short() {
        let mut svg = Svg::part([0.0, -0.001, 10.0, 5.125], "", "a \"b\" & c");
        svg.text([1.0 / 3.0, 20.0], MIDDLE, "1 < 2 & so on");
        svg.group("", "<name>", |svg| svg.circle([1.0, 2.0], 3.0, ""));
        assert_eq!(
            svg.finish(),
            "<svg viewBox=\"0 0 10 5.13\"  role=\"img\" aria-label=\"a &quot;b&quot; &amp; c\">\
             <text x=\"0.33\" y=\"20\" text-anchor='middle'>1 &lt; 2 &amp; so on</text>\
             <g ><title>&lt;name></title><circle cx=\"1\" cy=\"2\" r=\"3\"/></g></svg>\n"
        );
    }
}
