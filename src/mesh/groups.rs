//! Names that a mesh file assigns to its triangles: groups, objects and materials of OBJ, material
//! numbers of PLY, materials of glTF.

use std::collections::{BTreeMap, BTreeSet, HashMap};

/// Lists of names of one triangle, such as the group, object and material of OBJ; [`NONE`] for a
/// missing list.
pub type Lists = [u32; 3];

/// Index of a missing list of names.
pub const NONE: u32 = u32::MAX;

/// Names of each triangle; empty if the file has no names.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Groups {
    /// Lists of names; one statement may assign several names.
    lists: Vec<Vec<String>>,
    /// First triangle and names of each run of triangles with equal names. Triangles before the
    /// first run have no names.
    runs: Vec<(u32, Lists)>,
}

impl Groups {
    fn lists_of(&self, lists: Lists) -> impl Iterator<Item = usize> {
        let named = lists.into_iter().filter(|&list| list != NONE);
        named.map(|list| list as usize)
    }

    /// Returns all names, sorted.
    pub fn names(&self) -> BTreeSet<&str> {
        let used: BTreeSet<_> = (self.runs.iter())
            .flat_map(|&(_, lists)| self.lists_of(lists))
            .collect();
        let names = used.into_iter().flat_map(|list| &self.lists[list]);
        names.map(String::as_str).collect()
    }

    /// Returns the number assigned to each of the first `triangles` triangles by its names, 0 if
    /// none of its names has a number.
    ///
    /// # Errors
    /// Returns two names of one triangle that have different numbers.
    pub fn numbers(
        &self,
        triangles: usize,
        numbers: &BTreeMap<&str, u8>,
    ) -> Result<Vec<u8>, [String; 2]> {
        type Known<'a> = Option<(&'a str, u8)>;
        let both = |one: Known, other: Known| match (one, other) {
            (Some((a, first)), Some((b, second))) if first != second => {
                Err([a.to_owned(), b.to_owned()])
            }
            _ => Ok(()),
        };
        let mut of_lists: Vec<Known> = Vec::with_capacity(self.lists.len());
        for list in &self.lists {
            let mut known = None;
            for name in list {
                let number = numbers.get(name.as_str());
                let this = number.map(|&number| (name.as_str(), number));
                both(known, this)?;
                known = known.or(this);
            }
            of_lists.push(known);
        }
        let mut all = vec![0; triangles];
        let ends = self.runs.iter().skip(1).map(|&(first, _)| first as usize);
        for (&(first, lists), end) in self.runs.iter().zip(ends.chain([triangles])) {
            let mut known: Known = None;
            for list in self.lists_of(lists) {
                both(known, of_lists[list])?;
                known = known.or(of_lists[list]);
            }
            if let Some((_, number)) = known {
                all[first as usize..end].fill(number);
            }
        }
        Ok(all)
    }
}

/// Collects names in the order of the triangles.
#[derive(Default)]
pub struct Namer {
    groups: Groups,
    known: HashMap<Vec<String>, u32>,
}

impl Namer {
    /// Returns the index of a list of names, [`NONE`] for an empty list.
    pub fn list(&mut self, names: Vec<String>) -> u32 {
        if names.is_empty() {
            return NONE;
        }
        let lists = &mut self.groups.lists;
        *self.known.entry(names).or_insert_with_key(|names| {
            lists.push(names.clone());
            lists.len() as u32 - 1
        })
    }

    /// Assigns these lists to all triangles from index `first` on. `first` must not decrease
    /// between calls.
    pub fn begin(&mut self, first: usize, lists: Lists) {
        let runs = &mut self.groups.runs;
        // No triangle followed the previous names.
        let _ = runs.pop_if(|&mut (start, _)| start as usize == first);
        let last = runs.last().map_or([NONE; 3], |&(_, lists)| lists);
        if lists != last {
            runs.push((first as u32, lists));
        }
    }

    /// Returns the groups of a file with the given number of triangles.
    pub fn finish(mut self, triangles: usize) -> Groups {
        let runs = &mut self.groups.runs;
        let _ = runs.pop_if(|&mut (start, _)| start as usize >= triangles);
        self.groups
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn triangles_are_numbered_by_their_names() {
        let mut namer = Namer::default();
        let mut list = |names: &[&str]| namer.list(names.iter().map(|n| n.to_string()).collect());
        let (unused, both, steel) = (list(&["unused"]), list(&["a", "b"]), list(&["steel"]));
        assert_eq!((list(&["a", "b"]), list(&[])), (both, NONE));
        namer.begin(0, [NONE; 3]);
        namer.begin(2, [unused, NONE, NONE]);
        namer.begin(2, [both, NONE, NONE]);
        namer.begin(3, [both, NONE, NONE]);
        namer.begin(4, [NONE; 3]);
        namer.begin(5, [both, NONE, steel]);
        namer.begin(7, [unused, NONE, NONE]);
        let groups = namer.finish(7);
        let names: Vec<_> = groups.names().into_iter().collect();
        assert_eq!(names, ["a", "b", "steel"]);
        let numbers = |names: &[(&str, u8)]| groups.numbers(7, &names.iter().copied().collect());
        assert_eq!(numbers(&[("b", 1)]), Ok(vec![0, 0, 1, 1, 0, 1, 1]));
        assert_eq!(numbers(&[("steel", 2)]), Ok(vec![0, 0, 0, 0, 0, 2, 2]));
        assert_eq!(
            numbers(&[("a", 1), ("b", 1)]),
            Ok(vec![0, 0, 1, 1, 0, 1, 1])
        );
        let two = Err(["a".to_owned(), "steel".to_owned()]);
        assert_eq!(numbers(&[("a", 1), ("steel", 2)]), two);
        let two = Err(["a".to_owned(), "b".to_owned()]);
        assert_eq!(numbers(&[("a", 1), ("b", 2)]), two);
        let none = Groups::default();
        assert_eq!(none.numbers(2, &BTreeMap::new()), Ok(vec![0, 0]));
    }
}
