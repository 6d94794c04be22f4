//! Selection and order of scan passes: a short path that sees enough samples of every group.

use crate::error::Result;
use crate::math::DVec3;
use crate::mesh::ProgressFn;
use std::cmp::Reverse;
use std::ops::Range;

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
    /// Indices of the samples.
    pub samples: Range<usize>,
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

/// Returns the number of elements of a bit set within a range.
pub(crate) fn count_within(set: &[u64], range: &Range<usize>) -> usize {
    let words = range.start / 64..range.end.div_ceil(64);
    let count = words.map(|i| {
        let from = range.start.saturating_sub(64 * i);
        let beyond = (64 * (i + 1)).saturating_sub(range.end);
        let mask = (u64::MAX << from) & (u64::MAX >> beyond);
        (set[i] & mask).count_ones() as usize
    });
    count.sum()
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
///
/// # Errors
/// Errors of `watch`, which is called with the fraction of the rounds.
pub(crate) fn shortest_path(
    candidates: &[Candidate],
    groups: &[Group],
    watch: &ProgressFn,
) -> Result<Vec<Leg>> {
    let problem = CoverProblem { candidates, groups };
    let mut chosen = problem.greedy();
    problem.drop_redundant(&mut chosen);
    let mut path = problem.order(&chosen);
    let mut addable: Vec<usize> = (0..candidates.len()).collect();
    let all = 0..64 * problem.words();
    addable.sort_by_cached_key(|&i| Reverse(count_within(&candidates[i].covers, &all)));
    addable.truncate(MAX_ADDED);
    for round in 0..MAX_ROUNDS {
        let before = problem.length(&path);
        for &added in &addable {
            watch(round as f64 / MAX_ROUNDS as f64)?;
            if path.iter().all(|leg| leg.0 != added)
                && let Some(shorter) = problem.exchange(&path, added)
            {
                path = shorter;
            }
        }
        if problem.length(&path) >= before {
            break;
        }
    }
    let chosen: Vec<usize> = path.iter().map(|leg| leg.0).collect();
    Ok(problem.shorter(path, problem.order(&chosen)))
}

/// Returns the length of a path with the links between its passes, mm.
pub(crate) fn path_length(candidates: &[Candidate], path: &[Leg]) -> f64 {
    let groups = &[];
    CoverProblem { candidates, groups }.length(path)
}

struct CoverProblem<'a> {
    candidates: &'a [Candidate],
    groups: &'a [Group],
}

impl CoverProblem<'_> {
    /// Returns the number of words of a bit set of all samples.
    fn words(&self) -> usize {
        let ends = self.groups.iter().map(|group| group.samples.end);
        ends.max().unwrap_or(0).div_ceil(64)
    }

    fn measured(&self, chosen: impl IntoIterator<Item = usize>) -> Vec<u64> {
        let covers = chosen.into_iter().map(|i| &self.candidates[i].covers[..]);
        union_of(covers, self.words())
    }

    fn is_enough(&self, measured: &[u64]) -> bool {
        let mut groups = self.groups.iter();
        groups.all(|group| count_within(measured, &group.samples) >= group.required)
    }

    fn greedy(&self) -> Vec<usize> {
        let mut chosen: Vec<usize> = Vec::new();
        let mut measured = vec![0; self.words()];
        loop {
            let lacking = |group: &Group| {
                let count = count_within(&measured, &group.samples);
                group.required.saturating_sub(count)
            };
            let lacking: Vec<usize> = self.groups.iter().map(lacking).collect();
            let rate = |candidate: &Candidate| {
                let new = candidate.covers.iter().zip(&measured);
                let new: Vec<u64> = new.map(|(of, measured)| of & !measured).collect();
                let groups = self.groups.iter().zip(&lacking);
                let gains = groups
                    .filter(|(_, lacking)| **lacking > 0)
                    .map(|(group, &lacking)| {
                        count_within(&new, &group.samples).min(lacking) as f64
                            / group.required as f64
                    });
                let added = candidate.length() + self.link_to(candidate, &chosen);
                gains.sum::<f64>() / added.max(f64::MIN_POSITIVE)
            };
            let rated = self.candidates.iter().map(rate).enumerate();
            match rated.max_by(|a, b| a.1.total_cmp(&b.1)) {
                Some((i, rate)) if rate > 0.0 => {
                    unite(&mut measured, &self.candidates[i].covers);
                    chosen.push(i);
                }
                _ => return chosen,
            }
        }
    }

    /// Returns a shorter path with the candidate `added` and without the passes that it replaces.
    fn exchange(&self, path: &[Leg], added: usize) -> Option<Vec<Leg>> {
        let least = self.length(path) * (1.0 - 1e-9);
        let chosen = path.iter().map(|leg| leg.0);
        let mut removals = std::iter::once(None).chain(chosen.clone().map(Some));
        removals.find_map(|removed| {
            let rest = chosen.clone().filter(|&i| Some(i) != removed);
            let mut next: Vec<usize> = rest.chain([added]).collect();
            if !self.is_enough(&self.measured(next.iter().copied())) {
                return None;
            }
            self.drop_redundant(&mut next);
            // The passes without their links are a lower limit of the path.
            let lengths = next.iter().map(|&i| self.candidates[i].length());
            if lengths.sum::<f64>() >= least {
                return None;
            }
            let kept = path.iter().copied().filter(|leg| next.contains(&leg.0));
            let mut changed: Vec<Leg> = kept.collect();
            if next.contains(&added) {
                changed = self.insert(changed, added);
            }
            let changed = self.two_opt(changed);
            (self.length(&changed) < least).then_some(changed)
        })
    }

    /// Inserts a pass into a path at the position and in the direction of the shortest path.
    fn insert(&self, path: Vec<Leg>, added: usize) -> Vec<Leg> {
        let with = |at: usize, reversed: bool| {
            let mut path = path.clone();
            path.insert(at, (added, reversed));
            path
        };
        let paths = (0..=path.len()).flat_map(|at| [with(at, false), with(at, true)]);
        paths.reduce(|a, b| self.shorter(a, b)).unwrap_or_default()
    }

    /// Returns the shorter path, the first one if both have the same length.
    fn shorter(&self, first: Vec<Leg>, second: Vec<Leg>) -> Vec<Leg> {
        match self.length(&second) < self.length(&first) {
            true => second,
            false => first,
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
            let rest = chosen.iter().copied().filter(|&j| j != i);
            if self.is_enough(&self.measured(rest)) {
                chosen.retain(|&j| j != i);
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
        paths.reduce(|a, b| self.shorter(a, b)).unwrap_or_default()
    }

    fn two_opt(&self, mut path: Vec<Leg>) -> Vec<Leg> {
        let link = |from: Option<DVec3>, to: Option<DVec3>| match (from, to) {
            (Some(from), Some(to)) => from.distance(to),
            // A path has no link before its first and after its last pass.
            _ => 0.0,
        };
        let tolerance = 1e-9 * self.length(&path);
        let mut improves = true;
        while improves {
            improves = false;
            for i in 0..path.len() {
                for j in i..path.len() {
                    let before = i.checked_sub(1).map(|k| self.end(path[k], true));
                    let after = path.get(j + 1).map(|&leg| self.end(leg, false));
                    let first = Some(self.end(path[i], false));
                    let last = Some(self.end(path[j], true));
                    let links = link(before, first) + link(last, after);
                    if link(before, last) + link(first, after) < links - tolerance {
                        path[i..=j].reverse();
                        for leg in &mut path[i..=j] {
                            leg.1 = !leg.1;
                        }
                        improves = true;
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
    let problem = CoverProblem { candidates, groups };
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
                if problem.is_enough(&problem.measured(chosen)) {
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
            let groups = [0..32, 32..64].map(|samples| Group {
                required: (0.95 * count_within(&all, &samples) as f64).ceil() as usize,
                samples,
            });
            let path = shortest_path(&candidates, &groups, &|_| Ok(())).unwrap();
            let problem = CoverProblem {
                candidates: &candidates,
                groups: &groups,
            };
            let measured = problem.measured(path.iter().map(|leg| leg.0));
            assert!(problem.is_enough(&measured), "{seed}");
            let ratio = path_length(&candidates, &path) / exhaustive(&candidates, &groups);
            worst = worst.max(ratio);
            assert!((1.0 - 1e-9..=1.2).contains(&ratio), "{seed}: {ratio}");
        }
        println!("the longest path is {worst:.3} times the shortest");
    }
}
