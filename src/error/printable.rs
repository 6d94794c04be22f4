//! File contents and file names in the form shown in messages. Characters that move the cursor,
//! break the line or change the writing direction are escaped, and the length is limited.

use serde::{Serialize, Serializer};
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Longest piece of a message that comes from outside, characters.
const LONGEST_PIECE: usize = 300;
/// Longest message, characters; exceeds the total of its pieces.
const LONGEST_LINE: usize = 2000;

/// Returns a piece of a message as one line, shortened at its center to 300 characters. The
/// function is idempotent.
pub fn short(text: &str) -> String {
    truncate(text, LONGEST_PIECE)
}

/// Returns a file name as one line of at most 300 characters.
pub fn path(path: &Path) -> String {
    short(&path.to_string_lossy())
}

/// Serializes a path as text: bytes that are not UTF-8, which JSON cannot hold, become U+FFFD.
pub fn in_json<S: Serializer>(path: &impl AsRef<Path>, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(&path.as_ref().to_string_lossy())
}

/// Serializes a path that may be missing, as [`in_json`] does.
pub fn some_in_json<S: Serializer>(
    path: &Option<PathBuf>,
    serializer: S,
) -> Result<S::Ok, S::Error> {
    let text = path.as_ref().map(|path| path.to_string_lossy());
    text.serialize(serializer)
}

/// Serializes a list of paths, as [`in_json`] does.
pub fn all_in_json<S: Serializer>(paths: &[PathBuf], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(paths.iter().map(|path| path.to_string_lossy()))
}

/// Returns a complete message as one line of at most 2000 characters.
pub fn line(text: &str) -> String {
    truncate(text, LONGEST_LINE)
}

/// Returns a result of several lines with unsafe characters escaped, at full length.
pub fn lines(text: &str) -> String {
    let keeps = |c| c == '\n' || !is_unsafe(c);
    escaped(text, keeps, |out, c| out.extend(c.escape_default()))
}

/// Returns JSON of equal value with unsafe characters escaped. Only strings can contain them.
pub fn json(text: &str) -> String {
    let keeps = |c| matches!(c, '\n' | '\r' | '\t') || !is_unsafe(c);
    escaped(text, keeps, |out, c| {
        for unit in c.encode_utf16(&mut [0; 2]) {
            // Writing to a string does not fail.
            let _ = write!(out, "\\u{unit:04x}");
        }
    })
}

/// True if a terminal may do more than display the character. Covers control characters (C0, DEL,
/// C1), line separators, direction marks and overrides, zero-width characters and tags.
fn is_unsafe(c: char) -> bool {
    c.is_control()
        || matches!(c,
            '\u{61c}' | '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}' |
            '\u{2060}'..='\u{206f}' | '\u{feff}' | '\u{fff9}'..='\u{fffb}' |
            '\u{e0000}'..='\u{e007f}')
}

fn escaped(text: &str, keeps: impl Fn(char) -> bool, escape: impl Fn(&mut String, char)) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match keeps(c) {
            true => out.push(c),
            false => escape(&mut out, c),
        }
    }
    out
}

/// Returns one line of at most `longest` characters; a longer text is reduced to its head and tail.
fn truncate(text: &str, longest: usize) -> String {
    let shorter = |text: &str| {
        let half = longest / 2;
        let nth = |n| text.char_indices().nth(n).map(|(at, _)| at);
        let from_end = |n| text.char_indices().rev().nth(n).map(|(at, _)| at);
        match (nth(longest), nth(half), from_end(half - 2)) {
            (Some(_), Some(head), Some(tail)) => format!("{}…{}", &text[..head], &text[tail..]),
            _ => text.to_owned(),
        }
    };
    // Shortened before escaping as well, because the text may have gigabytes.
    let escape = |out: &mut String, c: char| out.extend(c.escape_default());
    shorter(&escaped(&shorter(text), |c| !is_unsafe(c), escape))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_a_terminal_obeys_is_left() {
        let hostile = "a\u{1b}[2J\u{9b}31m\r\nlasertrace: ok\t\u{202e}x\u{7f}\u{2028}é漢";
        let safe = short(hostile);
        assert_eq!(
            safe,
            "a\\u{1b}[2J\\u{9b}31m\\r\\nlasertrace: ok\\t\\u{202e}x\\u{7f}\\u{2028}é漢"
        );
        assert_eq!(short(&safe), safe);
        assert_eq!(line(hostile), safe);
        assert_eq!(lines("a\n\u{1b}b\r\n"), "a\n\\u{1b}b\\r\n");
        for c in (0..=0x10ffff).filter_map(char::from_u32) {
            let text = c.to_string();
            let shown = [short(&text), line(&text), lines(&text), json(&text)].concat();
            assert!(
                !shown
                    .chars()
                    .any(|c| c != '\n' && c != '\r' && c != '\t' && is_unsafe(c))
            );
            if !shown.is_ascii() {
                assert_eq!(short(&text), text);
            }
        }
    }

    #[test]
    fn json_is_of_the_same_value() {
        let hostile = "\u{1b}[0m\n\u{9b}\u{7f}\u{202e}\u{e0041}\"\\é";
        let plain = serde_json::to_string_pretty(&[hostile]).unwrap();
        let safe = json(&plain);
        assert!(!safe.chars().any(|c| c != '\n' && is_unsafe(c)), "{safe}");
        let back: Vec<String> = serde_json::from_str(&safe).unwrap();
        assert_eq!(back, [hostile]);
    }

    #[test]
    fn long_text_is_cut_in_its_middle() {
        for (text, length) in [("x".repeat(300), 300), ("é".repeat(301), 300)] {
            assert_eq!(short(&text).chars().count(), length);
        }
        let long = format!("head{}tail", "\n".repeat(1 << 20));
        let cut = line(&long);
        assert!(cut.starts_with("head") && cut.ends_with("tail") && cut.contains('…'));
        assert!(cut.len() <= 2 * 2000 + 3, "{}", cut.len());
        assert_eq!(line(&cut), cut);
    }
}
