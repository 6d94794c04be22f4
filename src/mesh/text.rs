//! Common parts of the text formats: lines, words and numbers.

/// Iterator over the lines of a text. A line ends with LF, CR LF, or only CR, as on old
/// Macintoshes.
#[derive(Clone)]
pub struct Lines<'a> {
    bytes: &'a [u8],
    /// Offset of the next line.
    pub offset: usize,
    /// Number of the line returned last, counted from 1.
    pub number: usize,
}

impl<'a> Lines<'a> {
    pub fn new(bytes: &'a [u8]) -> Lines<'a> {
        let bytes = without_end_mark(bytes);
        Lines {
            offset: if bytes.starts_with(BOM) { BOM.len() } else { 0 },
            bytes,
            number: 0,
        }
    }
}

impl<'a> Iterator for Lines<'a> {
    type Item = &'a [u8];

    fn next(&mut self) -> Option<&'a [u8]> {
        let rest = &self.bytes[self.offset..];
        if rest.is_empty() {
            return None;
        }
        let end = rest.iter().position(|b| matches!(b, b'\n' | b'\r'));
        let end = end.unwrap_or(rest.len());
        let eol = if rest[end..].starts_with(b"\r\n") {
            2
        } else {
            1
        };
        self.offset += (end + eol).min(rest.len());
        self.number += 1;
        Some(&rest[..end])
    }
}

/// Removes the ^Z (and blanks) at the end of a text, as written by programs of CP/M and DOS.
pub fn without_end_mark(bytes: &[u8]) -> &[u8] {
    bytes
        .trim_ascii_end()
        .strip_suffix(b"\x1a")
        .unwrap_or(bytes)
}

/// UTF-8 byte order mark.
const BOM: &[u8] = b"\xef\xbb\xbf";

/// Returns the words between blanks, up to a word that begins with `#`, which starts a comment.
pub fn words(line: &[u8]) -> impl Iterator<Item = &[u8]> {
    line.split(u8::is_ascii_whitespace)
        .filter(|word| !word.is_empty())
        .take_while(|word| word[0] != b'#')
}

/// Parses a decimal number in C or Fortran notation (`1.5E3`, `.5`, `1.5D+03`, `nan`, `inf`). The
/// error describes the word found.
pub fn number(word: &[u8]) -> Result<f64, String> {
    let parse = |w: &[u8]| std::str::from_utf8(w).ok()?.parse::<f64>().ok();
    if let Some(value) = parse(word) {
        return Ok(value);
    }
    if let Some(value) = fortran(word).and_then(|w| parse(w.as_bytes())) {
        return Ok(value);
    }
    Err(if word.contains(&b',') {
        // 1,234 means a thousand in one country and 1.234 in another.
        format!("{} with a comma", quote(word))
    } else {
        quote(word)
    })
}

/// Expected form of a number, for error messages.
pub const NUMBER: &str = "a number with a decimal point, like -12.5 or 1.5e-3";

/// Returns `1.5D+03`, double-precision output of Fortran programs, as `1.5e+03`. The `D` must
/// follow a digit or point and precede a digit or sign, so ordinary words are rejected.
pub fn fortran(word: &[u8]) -> Option<String> {
    let text = std::str::from_utf8(word).ok()?;
    let at = text.find(['d', 'D'])?;
    let before = text[..at].ends_with(|c: char| c.is_ascii_digit() || c == '.');
    let after = text[at + 1..].starts_with(|c: char| c.is_ascii_digit() || "+-".contains(c));
    (before && after).then(|| format!("{}e{}", &text[..at], &text[at + 1..]))
}

/// True if all bytes are NULs or blanks.
pub fn is_padding(bytes: &[u8]) -> bool {
    bytes.iter().all(|b| *b == 0 || b.is_ascii_whitespace())
}

/// Formats a count with its noun, such as "1 byte" and "2 bytes".
pub fn count(number: usize, thing: &str) -> String {
    let plural = if number == 1 { "" } else { "s" };
    format!("{number} {thing}{plural}")
}

/// Formats a piece of a file for an error message: short, one line, printable.
pub fn quote(bytes: &[u8]) -> String {
    const LONGEST: usize = 40;
    let shown = String::from_utf8_lossy(&bytes[..bytes.len().min(LONGEST)]);
    let dots = if bytes.len() > LONGEST { "…" } else { "" };
    format!("\"{}{dots}\"", shown.trim_end().escape_debug())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_read_or_refused_never_misread() {
        for (word, value) in [
            (".8e-001", 0.08),
            ("-.7e+02", -70.0),
            ("5.", 5.0),
            ("+3", 3.0),
            ("1.817624D+02", 181.7624),
            ("1d5", 1e5),
            ("1.D-1", 0.1),
        ] {
            assert_eq!(number(word.as_bytes()), Ok(value), "{word}");
        }
        for word in [
            "1,5",
            "1.5,",
            "1.#IND",
            "0x10",
            "D5",
            "1D",
            "1Dx",
            "1D2D3",
            "--1",
            "1e",
            "1_000",
            "ad5",
            "1.5\u{2212}",
            "٣",
        ] {
            assert!(number(word.as_bytes()).is_err(), "{word}");
        }
        assert!(number(b"1,5").unwrap_err().contains("comma"));
        assert!(number(b"\xff").is_err());
    }

    #[test]
    fn lines_end_in_three_ways() {
        let mut lines = Lines::new(b"\xef\xbb\xbfa\r\nb\rc\n\nd");
        let all: Vec<_> = lines.by_ref().collect();
        assert_eq!(all, [b"a".as_slice(), b"b", b"c", b"", b"d"]);
        assert_eq!(lines.number, 5);
        let dos: Vec<_> = Lines::new(b"a\r\nb\r\n\x1a\r\n").collect();
        assert_eq!(dos, [b"a".as_slice(), b"b"]);
        assert_eq!(Lines::new(b"a\x1ab\n").count(), 1, "not at the end");
    }

    #[test]
    fn quotes_are_short_and_printable() {
        assert_eq!(quote(b"a\x00\"b\xff "), "\"a\\0\\\"b\u{fffd}\"");
        assert!(quote(&[b'x'; 500]).chars().count() < 50);
    }
}
