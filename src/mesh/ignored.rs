//! Content of a mesh file that the reader does not use.

use crate::error::printable;
use serde::Serialize;
use std::collections::HashMap;
use std::fmt;

/// Unused content of a mesh file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Ignored {
    /// Name, such as the name of an extension.
    pub name: String,
    /// Number of occurrences.
    pub count: usize,
    /// True if the shape of the mesh may therefore differ from the shape in the file.
    pub changes_shape: bool,
}

impl fmt::Display for Ignored {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(&self.name)?;
        match self.count {
            1 => Ok(()),
            count => write!(f, " ({count} times)"),
        }
    }
}

/// Largest number of listed names; a hostile file may have millions.
const MOST: usize = 100;

/// Collector of content that a reader does not use.
#[derive(Default)]
pub struct Collector {
    found: Vec<Ignored>,
    /// Index of each key in `found`.
    known: HashMap<String, usize>,
    /// Occurrences of names beyond [`MOST`]: harmless names, and names that change the shape.
    more: [usize; 2],
}

impl Collector {
    /// Adds content whose omission may change the shape.
    pub fn shape(&mut self, name: impl Into<String>) {
        self.add(&name.into(), true, |key| key.to_owned());
    }

    /// Adds content that does not affect the shape.
    pub fn harmless(&mut self, name: impl Into<String>) {
        self.add(&name.into(), false, |key| key.to_owned());
    }

    /// Adds content that is counted by `key`; `name` creates its name at the first occurrence.
    pub fn add(&mut self, key: &str, changes_shape: bool, name: impl FnOnce(&str) -> String) {
        if let Some(&at) = self.known.get(key) {
            self.found[at].count += 1;
            self.found[at].changes_shape |= changes_shape;
            return;
        }
        if self.found.len() >= MOST {
            self.more[usize::from(changes_shape)] += 1;
            return;
        }
        self.known.insert(key.to_owned(), self.found.len());
        self.found.push(Ignored {
            name: printable::short(&name(key)),
            count: 1,
            changes_shape,
        });
    }

    /// Returns the content that changes the shape.
    pub fn shapes(&self) -> impl Iterator<Item = &Ignored> {
        self.found.iter().filter(|ignored| ignored.changes_shape)
    }

    /// Returns all content found, with content that changes the shape first.
    pub fn finish(mut self) -> Vec<Ignored> {
        for (changes_shape, count) in [(false, self.more[0]), (true, self.more[1])] {
            if count > 0 {
                self.found.push(Ignored {
                    name: "other names that are not listed".to_owned(),
                    count,
                    changes_shape,
                });
            }
        }
        self.found.sort_by_key(|ignored| !ignored.changes_shape);
        self.found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_counted_bounded_and_sorted() {
        let mut collector = Collector::default();
        collector.harmless("a");
        collector.harmless("a");
        for i in 0..200 {
            collector.shape(format!("b{i}"));
        }
        collector.shape("c".repeat(1000));
        let found = collector.finish();
        assert_eq!(found.len(), MOST + 1);
        assert_eq!(found[0].to_string(), "b0");
        assert_eq!(found[MOST].to_string(), "a (2 times)");
        // 200 and one more; 99 of these are listed.
        assert_eq!(found[MOST - 1].count, 102);
    }
}
