//! Selection and order of scan passes: a short path that sees enough samples of every group.

use crate::math::DVec3;

/// Candidate pass along a straight line.
#[derive(Debug, Clone)]
pub(crate) struct Candidate {
    /// Positions of the laser at the first and the last frame, mm.
    pub ends: [DVec3; 2],
    /// Samples that the pass measures, as a bit set.
    pub covers: Vec<u64>,
}

/// Samples of a feature or of the surface, of which a number must be measured.
#[derive(Debug, Clone)]
pub(crate) struct Group {
    /// Samples, as a bit set.
    pub members: Vec<u64>,
    /// Number of samples that the path must measure.
    pub required: usize,
}

/// A candidate of a path; `true` if it is travelled from its last to its first frame.
pub(crate) type Leg = (usize, bool);

/// Maximum number of rounds of improvement.
const MAX_ROUNDS: usize = 40;
/// Maximum number of candidates that the improvement adds: the candidates with the most samples.
const MAX_ADDED: usize = 200;

impl Candidate {
    /// Returns the length of the pass, mm.
    pub fn length(&self) -> f64 {
        self.ends[0].distance(self.ends[1])
    }
}

/// Returns the number of elements that two bit sets have in common.
pub(crate) fn common(a: &[u64], b: &[u64]) -> usize {
    let words = a.iter().zip(b);
    words.map(|(a, b)| (a & b).count_ones() as usize).sum()
}

/// Adds the elements of `other` to a bit set.
pub(crate) fn unite(set: &mut [u64], other: &[u64]) {
    for (word, other) in set.iter_mut().zip(other) {
        *word |= other;
    }
}

/// Returns the union of the samples that candidates measure.
pub(crate) fn union_of<'a>(covers: impl IntoIterator<Item = &'a [u64]>, words: usize) -> Vec<u64> {
    let mut all = vec![0; words];
    for of in covers {
        unite(&mut all, of);
    }
    all
}

/// Selects candidates that measure the required samples of all groups, and orders them. Returns an
/// empty path if nothing is required. The groups require at most the samples that all candidates
/// measure.
///
/// A greedy selection adds the candidate with the most required samples per millimetre of path. It
/// is improved by exchanges of one candidate for others while the path becomes shorter.
pub(crate) fn shortest_path(candidates: &[Candidate], groups: &[Group]) -> Vec<Leg> {
    let problem = Problem { candidates, groups };
    let mut chosen = problem.greedy();
    problem.drop_redundant(&mut chosen);
    let mut best = problem.order(&chosen);
    let mut least = problem.length(&best);
    let mut addable: Vec<usize> = (0..candidates.len()).collect();
    addable
        .sort_by_key(|&i| std::cmp::Reverse(common(&candidates[i].covers, &candidates[i].covers)));
    addable.truncate(MAX_ADDED);
    for _ in 0..MAX_ROUNDS {
        let before = least;
        for &added in &addable {
            if chosen.contains(&added) {
                continue;
            }
            for removed in std::iter::once(None).chain((0..chosen.len()).map(Some)) {
                let mut next = chosen.clone();
                if let Some(removed) = removed {
                    next.remove(removed);
                }
                next.push(added);
                if !problem.is_enough(&next) {
                    continue;
                }
                problem.drop_redundant(&mut next);
                // The passes without their links are a lower limit of the path.
                if next.iter().map(|&i| candidates[i].length()).sum::<f64>() >= least {
                    continue;
                }
                let path = problem.order(&next);
                let length = problem.length(&path);
                if length < least * (1.0 - 1e-9) {
                    (chosen, best, least) = (next, path, length);
                    break;
                }
            }
        }
        if least >= before {
            break;
        }
    }
    best
}

/// Returns the length of a path with the links between its passes, mm.
pub(crate) fn path_length(candidates: &[Candidate], path: &[Leg]) -> f64 {
    let groups = &[];
    Problem { candidates, groups }.length(path)
}

struct Problem<'a> {
    candidates: &'a [Candidate],
    groups: &'a [Group],
}

impl Problem<'_> {
    fn words(&self) -> usize {
        self.candidates.first().map_or(0, |c| c.covers.len())
    }

    fn measured(&self, chosen: &[usize]) -> Vec<u64> {
        let covers = chosen.iter().map(|&i| &self.candidates[i].covers[..]);
        union_of(covers, self.words())
    }

    fn is_enough(&self, chosen: &[usize]) -> bool {
        let measured = self.measured(chosen);
        let mut groups = self.groups.iter();
        groups.all(|group| common(&group.members, &measured) >= group.required)
    }

    fn greedy(&self) -> Vec<usize> {
        let mut chosen: Vec<usize> = Vec::new();
        let mut measured = vec![0; self.words()];
        loop {
            let lacking: Vec<usize> = self
                .groups
                .iter()
                .map(|group| (group.required).saturating_sub(common(&group.members, &measured)))
                .collect();
            let gain = |candidate: &Candidate| {
                let new = candidate.covers.iter().zip(&measured);
                let new: Vec<u64> = new.map(|(of, measured)| of & !measured).collect();
                let groups = self.groups.iter().zip(&lacking);
                let gains = groups.filter(|(_, lacking)| **lacking > 0);
                gains
                    .map(|(group, &lacking)| {
                        common(&group.members, &new).min(lacking) as f64 / group.required as f64
                    })
                    .sum::<f64>()
            };
            let rated = self.candidates.iter().enumerate().map(|(i, candidate)| {
                let gain = gain(candidate);
                let added = candidate.length() + self.link_to(candidate, &chosen);
                (
                    i,
                    if gain > 0.0 {
                        gain / added.max(f64::MIN_POSITIVE)
                    } else {
                        0.0
                    },
                )
            });
            match rated.max_by(|a, b| a.1.total_cmp(&b.1)) {
                Some((i, rate)) if rate > 0.0 => {
                    unite(&mut measured, &self.candidates[i].covers);
                    chosen.push(i);
                }
                _ => return chosen,
            }
        }
    }

    /// Returns the distance of a candidate from the nearest end of the chosen passes; 0 without any.
    fn link_to(&self, candidate: &Candidate, chosen: &[usize]) -> f64 {
        let ends = chosen.iter().flat_map(|&i| self.candidates[i].ends);
        let links = ends.flat_map(|end| candidate.ends.map(|other| other.distance(end)));
        links.reduce(f64::min).unwrap_or(0.0)
    }

    /// Removes passes that the others make redundant, the longest first.
    fn drop_redundant(&self, chosen: &mut Vec<usize>) {
        let mut by_length = chosen.clone();
        by_length.sort_by(|&a, &b| {
            let [a, b] = [a, b].map(|i| self.candidates[i].length());
            b.total_cmp(&a)
        });
        for i in by_length {
            let rest: Vec<usize> = chosen.iter().copied().filter(|&j| j != i).collect();
            if self.is_enough(&rest) {
                *chosen = rest;
            }
        }
    }

    /// Orders passes by the nearest next end, from every start, and improves the order by reversing
    /// sections (2-opt).
    fn order(&self, chosen: &[usize]) -> Vec<Leg> {
        let starts = chosen.iter().flat_map(|&i| [(i, false), (i, true)]);
        let paths = starts.map(|start| {
            let mut path = vec![start];
            while path.len() < chosen.len() {
                let at = self.end(path[path.len() - 1], true);
                let left = chosen
                    .iter()
                    .filter(|&&i| path.iter().all(|leg| leg.0 != i));
                let legs = left.flat_map(|&i| [(i, false), (i, true)]);
                let distance = |leg: &Leg| self.end(*leg, false).distance(at);
                let next = legs.min_by(|a, b| distance(a).total_cmp(&distance(b)));
                path.extend(next);
            }
            self.two_opt(path)
        });
        let shorter = |a: &Vec<Leg>, b: &Vec<Leg>| self.length(a).total_cmp(&self.length(b));
        paths.min_by(shorter).unwrap_or_default()
    }

    fn two_opt(&self, mut path: Vec<Leg>) -> Vec<Leg> {
        let mut length = self.length(&path);
        let mut improves = true;
        while improves {
            improves = false;
            for i in 0..path.len() {
                for j in i..path.len() {
                    let mut next = path.clone();
                    next[i..=j].reverse();
                    for leg in &mut next[i..=j] {
                        leg.1 = !leg.1;
                    }
                    let of_next = self.length(&next);
                    if of_next < length * (1.0 - 1e-9) {
                        (path, length, improves) = (next, of_next, true);
                    }
                }
            }
        }
        path
    }

    /// Returns the first or the last position of a leg.
    fn end(&self, (i, reversed): Leg, last: bool) -> DVec3 {
        self.candidates[i].ends[usize::from(reversed != last)]
    }

    fn length(&self, path: &[Leg]) -> f64 {
        let passes = path.iter().map(|leg| self.candidates[leg.0].length());
        let links = path.windows(2).map(|pair| {
            let [from, to] = [pair[0], pair[1]];
            self.end(from, true).distance(self.end(to, false))
        });
        passes.sum::<f64>() + links.sum::<f64>()
    }
}

/// Returns the length of the shortest path by exhaustive search: dynamic programming over all
/// subsets of candidates, their last pass and its direction (Held & Karp 1962).
#[cfg(test)]
pub(crate) fn exhaustive(candidates: &[Candidate], groups: &[Group]) -> f64 {
    let problem = Problem { candidates, groups };
    let n = candidates.len();
    let mut shortest = vec![f64::INFINITY; (1 << n) * 2 * n];
    let at = |set: usize, (i, reversed): Leg| (set * n + i) * 2 + usize::from(reversed);
    let legs: Vec<Leg> = (0..n).flat_map(|i| [(i, false), (i, true)]).collect();
    let mut best = f64::INFINITY;
    for set in 1..1_usize << n {
        for &leg in legs.iter().filter(|leg| set >> leg.0 & 1 == 1) {
            let before = set & !(1 << leg.0);
            let length = candidates[leg.0].length();
            let of_set = match before {
                0 => length,
                _ => legs
                    .iter()
                    .filter(|from| before >> from.0 & 1 == 1)
                    .map(|&from| {
                        let link = problem.end(from, true).distance(problem.end(leg, false));
                        shortest[at(before, from)] + link + length
                    })
                    .fold(f64::INFINITY, f64::min),
            };
            shortest[at(set, leg)] = of_set;
            if of_set < best {
                let chosen: Vec<usize> = (0..n).filter(|i| set >> i & 1 == 1).collect();
                if problem.is_enough(&chosen) {
                    best = of_set;
                }
            }
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::{Purpose, RngKey};

    /// On random problems, the path is at most 20 % longer than the shortest path by exhaustive
    /// search, and measures the required samples.
    #[test]
    fn paths_are_nearly_the_shortest() {
        let mut worst = 1.0_f64;
        for seed in 0..40 {
            let key = RngKey::new(seed, Purpose::Bootstrap);
            let at = |i: u64| {
                DVec3::new(
                    key.uniform(3 * i),
                    key.uniform(3 * i + 1),
                    key.uniform(3 * i + 2),
                )
            };
            let candidates: Vec<Candidate> = (0..9)
                .map(|i| {
                    let bits = (0..64).filter(|&b| key.uniform(1000 + 64 * i + b) < 0.35);
                    let covers = vec![bits.fold(0, |set, b| set | 1 << b)];
                    let ends = [at(2 * i) * 100.0, at(2 * i + 1) * 100.0];
                    Candidate { ends, covers }
                })
                .collect();
            let all = union_of(candidates.iter().map(|c| &c.covers[..]), 1);
            let groups: Vec<Group> = [0xffff_ffff, 0xffff_ffff_0000_0000_u64]
                .map(|members| {
                    let coverable = common(&all, &[members]);
                    Group {
                        members: vec![members],
                        required: (0.95 * coverable as f64).ceil() as usize,
                    }
                })
                .to_vec();
            let path = shortest_path(&candidates, &groups);
            let chosen: Vec<usize> = path.iter().map(|leg| leg.0).collect();
            let problem = Problem {
                candidates: &candidates,
                groups: &groups,
            };
            assert!(problem.is_enough(&chosen), "{seed}");
            let ratio = path_length(&candidates, &path) / exhaustive(&candidates, &groups);
            worst = worst.max(ratio);
            assert!((1.0 - 1e-9..=1.2).contains(&ratio), "{seed}: {ratio}");
        }
        println!("the longest path is {worst:.3} times the shortest");
    }
}
