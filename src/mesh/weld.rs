//! Welding: corners with the same key become one vertex.
//!
//! An open-addressing table of vertex numbers with linear probing. On large
//! meshes its cost is cache misses, so corners are taken in batches: the slots
//! of a whole batch are read before any is decided, and those independent
//! reads overlap in the memory system. (Prefetch instructions do the same but
//! need `unsafe`.)

use std::hash::{BuildHasher, Hasher, RandomState};
use std::hint::black_box;

use crate::math::DVec3;

/// Bit pattern of a position. Equal keys are the same position.
pub trait Key: Copy + Eq {
    fn hash(self, seed: u64) -> u64;
}

/// Single-precision coordinates: the key of a binary STL corner.
impl Key for [u32; 3] {
    fn hash(self, seed: u64) -> u64 {
        let xy = u64::from(self[0]) | u64::from(self[1]) << 32;
        fold(xy ^ seed, u64::from(self[2]) ^ seed.rotate_left(32))
    }
}

/// Double-precision coordinates.
impl Key for [u64; 3] {
    fn hash(self, seed: u64) -> u64 {
        let xy = fold(self[0] ^ seed, self[1] ^ seed.rotate_left(32));
        fold(xy ^ self[2], seed ^ 0x9e37_79b9_7f4a_7c15)
    }
}

/// Both halves of the 128-bit product, as in wyhash (Wang Yi, 2019).
fn fold(a: u64, b: u64) -> u64 {
    let product = u128::from(a) * u128::from(b);
    product as u64 ^ (product >> 64) as u64
}

/// Vertices to expect of so many triangles: half, when the mesh is closed.
pub fn usual_vertices(triangles: usize) -> usize {
    triangles / 2 + 2
}

/// The bits of a position, −0 taken as +0.
pub fn bits(position: DVec3) -> [u64; 3] {
    position.to_array().map(|c| (c + 0.0).to_bits())
}

pub struct Welded<K> {
    /// One per vertex, in order of first appearance.
    pub keys: Vec<K>,
    pub triangles: Vec<[u32; 3]>,
}

const EMPTY: u32 = u32::MAX;
const BATCH: usize = 32;

struct Table<K> {
    /// A power of two long, at most half full.
    slots: Vec<u32>,
    keys: Vec<K>,
    seed: u64,
}

impl<K: Key> Table<K> {
    fn slot(&self, hash: u64) -> usize {
        hash as usize & (self.slots.len() - 1)
    }

    /// Makes room for `more` keys.
    fn reserve(&mut self, more: usize) {
        let needed = 2 * (self.keys.len() + more);
        if needed <= self.slots.len() {
            return;
        }
        self.slots = vec![EMPTY; needed.next_power_of_two()];
        for i in 0..self.keys.len() {
            let mut slot = self.slot(self.keys[i].hash(self.seed));
            while self.slots[slot] != EMPTY {
                slot = (slot + 1) & (self.slots.len() - 1);
            }
            self.slots[slot] = i as u32;
        }
    }

    /// Number of the vertex with this key, new or known.
    fn vertex(&mut self, key: K, hash: u64) -> u32 {
        let mut slot = self.slot(hash);
        loop {
            let vertex = self.slots[slot];
            if vertex == EMPTY {
                let new = self.keys.len() as u32;
                self.slots[slot] = new;
                self.keys.push(key);
                return new;
            }
            if self.keys[vertex as usize] == key {
                return vertex;
            }
            slot = (slot + 1) & (self.slots.len() - 1);
        }
    }

    /// Brings what `vertex` will look at into the cache.
    fn warm(&self, hashes: &[[u64; 3]]) {
        let mut first = [[EMPTY; 3]; BATCH];
        for (found, hash) in first.iter_mut().zip(hashes) {
            *found = hash.map(|h| self.slots[self.slot(h)]);
        }
        for vertex in first.as_flattened() {
            black_box(self.keys.get(*vertex as usize));
            if let Some(key) = self.keys.get(*vertex as usize) {
                black_box(*key);
            }
        }
    }
}

/// Welds `count` triangles, `corners(t)` being the keys of the `t`-th. Room for
/// `vertices` is taken at once; more will do, but cost time.
///
/// # Panics
/// At 2³² − 1 vertices, which only files beyond 70 GB can hold.
pub fn triangles<K: Key>(
    count: usize,
    vertices: usize,
    corners: impl Fn(usize) -> [K; 3],
) -> Welded<K> {
    // The seed only defends against files made to collide; vertex numbers
    // follow first appearance and do not depend on it.
    let mut table = Table {
        slots: Vec::new(),
        keys: Vec::new(),
        seed: RandomState::new().build_hasher().finish() | 1 << 40,
    };
    table.keys.reserve(vertices);
    table.reserve(vertices);
    let mut triangles = Vec::with_capacity(count);
    let mut keys = Vec::with_capacity(BATCH);
    let mut hashes = Vec::with_capacity(BATCH);
    for start in (0..count).step_by(BATCH) {
        keys.clear();
        keys.extend((start..count.min(start + BATCH)).map(&corners));
        hashes.clear();
        hashes.extend(keys.iter().map(|k| k.map(|key| key.hash(table.seed))));
        table.reserve(3 * BATCH);
        table.warm(&hashes);
        for (k, h) in keys.iter().zip(&hashes) {
            triangles.push(std::array::from_fn(|i| table.vertex(k[i], h[i])));
        }
        assert!(table.keys.len() < EMPTY as usize - 3 * BATCH);
    }
    Welded {
        keys: table.keys,
        triangles,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::HashMap;

    #[test]
    fn minus_zero_is_zero() {
        assert_eq!(bits(DVec3::new(-0.0, 0.0, -0.0)), [0; 3]);
    }

    proptest! {
        /// Against the standard map, with few distinct keys (many repeats) and
        /// with many (the table grows).
        #[test]
        fn agrees_with_a_hash_map(spread in 1u32..5000, seeds in prop::collection::vec(any::<[u32; 3]>(), 0..2000)) {
            let corners: Vec<[[u32; 3]; 3]> =
                seeds.iter().map(|s| s.map(|v| [v % spread, 0, v % 3])).collect();
            let mut known = HashMap::new();
            let mut order = Vec::new();
            let expected: Vec<[u32; 3]> = corners.iter().map(|triangle| triangle.map(|key| {
                *known.entry(key).or_insert_with(|| {
                    order.push(key);
                    order.len() as u32 - 1
                })
            })).collect();
            let welded = triangles(corners.len(), 5, |t| corners[t]);
            prop_assert_eq!(welded.triangles, expected);
            prop_assert_eq!(welded.keys, order);
        }
    }
}
