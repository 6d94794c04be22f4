//! Names that a mesh file gives to its triangles: OBJ's groups, objects and materials, PLY's material numbers,
//! glTF's materials.

use std::collections::{BTreeMap, BTreeSet, HashMap};

/// Lists of names that a triangle has at once, as OBJ's groups, object and material; [`NONE`] for no list.
pub type Lists = [u32; 3];

/// No list of names.
pub const NONE: u32 = u32::MAX;

/// The names of each triangle; none where the file has none.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Groups {
    /// A statement may give several names.
    lists: Vec<Vec<String>>,
    /// First triangle and names of each run of triangles with the same; those before the first run have none.
    runs: Vec<(u32, Lists)>,
}

impl Groups {
    fn lists_of(&self, lists: Lists) -> impl Iterator<Item = usize> {
        let named = lists.into_iter().filter(|&list| list != NONE);
        named.map(|list| list as usize)
    }

    /// All names, sorted.
    pub fn names(&self) -> BTreeSet<&str> {
        let used: BTreeSet<_> = (self.runs.iter())
            .flat_map(|&(_, lists)| self.lists_of(lists))
            .collect();
        let names = used.into_iter().flat_map(|list| &self.lists[list]);
        names.map(String::as_str).collect()
    }

    /// Of each of so many triangles the number of its name, 0 if none of its names has one.
    ///
    /// # Errors
    /// Two names of one triangle that have different numbers.
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

/// Takes names in the order of the triangles.
#[derive(Default)]
pub struct Namer {
    groups: Groups,
    known: HashMap<Vec<String>, u32>,
}

impl Namer {
    /// The number of a list of names, [`NONE`] of an empty one.
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

    /// From triangle number `first` on, which is none before those of the last call, all have these lists.
    pub fn begin(&mut self, first: usize, lists: Lists) {
        let runs = &mut self.groups.runs;
        // Nothing came under the last names.
        let _ = runs.pop_if(|&mut (start, _)| start as usize == first);
        let last = runs.last().map_or([NONE; 3], |&(_, lists)| lists);
        if lists != last {
            runs.push((first as u32, lists));
        }
    }

    /// Of a file with so many triangles.
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
