//! Welding: corners with equal keys become one vertex.
//!
//! Uses open-addressing hash tables of vertex indices with linear probing. On large meshes the cost
//! is cache misses. Runs of triangles are therefore welded separately, which leaves a fifth of the
//! corners. The remaining keys are then welded in shards by hash. Both kinds of table fit a core's
//! cache, and both steps run in parallel.

use std::hash::{BuildHasher, Hasher, RandomState};
use std::ops::Range;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use rayon::prelude::*;

use crate::math::DVec3;

/// Bit pattern of a position. Equal keys are equal positions.
pub trait Key: Copy + Eq + Send + Sync {
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

/// Returns the exclusive or of both halves of the 128-bit product, as in wyhash (Wang Yi, 2019).
fn fold(a: u64, b: u64) -> u64 {
    let product = u128::from(a) * u128::from(b);
    product as u64 ^ (product >> 64) as u64
}

/// Returns the expected number of vertices: half the number of triangles for a closed mesh.
fn usual_vertices(triangles: usize) -> usize {
    triangles / 2 + 2
}

/// Returns the bit pattern of a position, with −0 converted to +0.
pub fn bits(position: DVec3) -> [u64; 3] {
    position.to_array().map(|c| (c + 0.0).to_bits())
}

pub struct Welded<K> {
    /// Key of each vertex, in order of first appearance.
    pub keys: Vec<K>,
    pub triangles: Vec<[u32; 3]>,
}

const EMPTY: u32 = u32::MAX;
/// Number of triangles per first-stage chunk; its table fits in a core's cache.
const CHUNK: usize = 1 << 16;
/// Number of shards of the keys by hash, each with a separate table.
const SHARDS: usize = 256;

struct WeldTable<K> {
    /// Slots, a power of two in number, at most half full.
    slots: Vec<u32>,
    keys: Vec<K>,
}

impl<K: Key> WeldTable<K> {
    fn with_room(keys: usize) -> WeldTable<K> {
        WeldTable {
            slots: vec![EMPTY; (2 * keys).next_power_of_two()],
            keys: Vec::with_capacity(keys),
        }
    }

    fn slot(&self, hash: u64) -> usize {
        hash as usize & (self.slots.len() - 1)
    }

    /// Returns the index of the key, inserting it if it is new.
    fn number(&mut self, key: K, seed: u64) -> u32 {
        let mut slot = self.slot(key.hash(seed));
        loop {
            let number = self.slots[slot];
            if number == EMPTY {
                break;
            }
            if self.keys[number as usize] == key {
                return number;
            }
            slot = (slot + 1) & (self.slots.len() - 1);
        }
        let new = self.keys.len() as u32;
        self.slots[slot] = new;
        self.keys.push(key);
        if 2 * self.keys.len() > self.slots.len() {
            self.grow(seed);
        }
        new
    }

    fn grow(&mut self, seed: u64) {
        self.slots = vec![EMPTY; 2 * self.slots.len()];
        for (number, key) in self.keys.iter().enumerate() {
            let mut slot = self.slot(key.hash(seed));
            while self.slots[slot] != EMPTY {
                slot = (slot + 1) & (self.slots.len() - 1);
            }
            self.slots[slot] = number as u32;
        }
    }
}

/// Run of triangles that is welded separately.
struct Chunk<K> {
    /// Keys, grouped by shard.
    keys: Vec<K>,
    /// Start of each shard in `keys`, and the end.
    starts: [u32; SHARDS + 1],
    /// Index in `keys` of each key, in order of first appearance in the chunk.
    places: Vec<u32>,
    /// Number of keys in all chunks before this one.
    before: usize,
}

fn shard<K: Key>(key: K, seed: u64) -> usize {
    // The high bits, since the tables use the low bits.
    (key.hash(seed) >> (u64::BITS - SHARDS.trailing_zeros())) as usize
}

impl<K: Key> Chunk<K> {
    /// Creates a chunk from `keys` in order of first appearance.
    fn new(keys: Vec<K>, seed: u64) -> Chunk<K> {
        let mut starts = [0; SHARDS + 1];
        for &key in &keys {
            starts[shard(key, seed) + 1] += 1;
        }
        for i in 0..SHARDS {
            starts[i + 1] += starts[i];
        }
        let mut next = starts;
        let mut sharded = keys.clone();
        let place = |&key: &K| {
            let place = &mut next[shard(key, seed)];
            sharded[*place as usize] = key;
            *place += 1;
            *place - 1
        };
        let places = keys.iter().map(place).collect();
        Chunk {
            keys: sharded,
            starts,
            places,
            before: 0,
        }
    }

    fn of_shard(&self, shard: usize) -> Range<usize> {
        self.starts[shard] as usize..self.starts[shard + 1] as usize
    }
}

/// Welds `count` triangles in parallel on the rayon pool; `corners(t)` returns the keys of triangle
/// `t`. The result does not depend on the number of threads.
///
/// # Panics
/// Panics at 2³² − 1 vertices, each counted once per chunk of 65536 triangles that uses it. Only
/// files beyond 70 GB can contain that number.
pub fn triangles<K: Key>(count: usize, corners: impl Fn(usize) -> [K; 3] + Sync) -> Welded<K> {
    // The seed only defends against files designed to cause collisions. Vertex indices follow first
    // appearance and do not depend on the seed.
    let seed = RandomState::new().build_hasher().finish() | 1 << 40;
    let mut triangles = vec![[0; 3]; count];
    let weld = |(chunk, triangles): (usize, &mut [[u32; 3]])| {
        let mut table = WeldTable::with_room(usual_vertices(triangles.len()));
        for (i, triangle) in triangles.iter_mut().enumerate() {
            *triangle = corners(CHUNK * chunk + i).map(|key| table.number(key, seed));
        }
        table.keys
    };
    if count <= CHUNK {
        let keys = weld((0, &mut triangles));
        return Welded { keys, triangles };
    }
    let mut chunks: Vec<Chunk<K>> = (triangles.par_chunks_mut(CHUNK).enumerate())
        .map(|chunk| Chunk::new(weld(chunk), seed))
        .collect();
    let mut entries = 0;
    for chunk in &mut chunks {
        chunk.before = entries;
        entries += chunk.keys.len();
    }
    assert!(entries < EMPTY as usize, "too many vertices");
    let first = first_entries(&chunks, entries, seed);
    let (keys, numbers) = number(&chunks, &first);
    (triangles.par_chunks_mut(CHUNK).zip(&chunks)).for_each(|(triangles, chunk)| {
        for vertex in triangles.as_flattened_mut() {
            let first = &first[chunk.before + chunk.places[*vertex as usize] as usize];
            *vertex = numbers[first.load(Relaxed) as usize];
        }
    });
    Welded { keys, triangles }
}

/// Returns, for each key of each chunk, the index of its first appearance among all keys.
fn first_entries<K: Key>(chunks: &[Chunk<K>], entries: usize, seed: u64) -> Vec<AtomicU32> {
    // Each element is written once. Atomics are needed because elements of different shards
    // interleave.
    let first: Vec<AtomicU32> = (0..entries).into_par_iter().map(|_| 0.into()).collect();
    (0..SHARDS).into_par_iter().for_each(|shard| {
        let mut table = WeldTable::with_room(entries / SHARDS);
        let mut places = Vec::with_capacity(entries / SHARDS);
        for chunk in chunks {
            for i in chunk.of_shard(shard) {
                let place = chunk.before + i;
                let number = table.number(chunk.keys[i], seed) as usize;
                if number == places.len() {
                    places.push(place as u32);
                }
                first[place].store(places[number], Relaxed);
            }
        }
    });
    first
}

/// Returns the keys in order of first appearance. Also returns the vertex index of each key, stored
/// at the index of its first appearance.
fn number<K: Key>(chunks: &[Chunk<K>], first: &[AtomicU32]) -> (Vec<K>, Vec<u32>) {
    let mut keys = Vec::with_capacity(first.len());
    let mut numbers = vec![0; first.len()];
    for chunk in chunks {
        for &i in &chunk.places {
            let place = chunk.before + i as usize;
            if first[place].load(Relaxed) as usize == place {
                numbers[place] = keys.len() as u32;
                keys.push(chunk.keys[i as usize]);
            }
        }
    }
    (keys, numbers)
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
        /// Tests against the standard hash map, with few distinct keys (many repeats) and with many
        /// (the table grows).
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
            let welded = triangles(corners.len(), |t| corners[t]);
            prop_assert_eq!(welded.triangles, expected);
            prop_assert_eq!(welded.keys, order);
        }
    }

    /// Tests four chunks and a remainder against the standard hash map, with one and with three
    /// threads. Covers neighbours that share vertices, and random triangles whose vertices occur in
    /// all chunks.
    #[test]
    fn chunks_agree_with_a_hash_map() {
        const COUNT: usize = 4 * CHUNK + 777;
        let stray = |t: usize, c: usize| fold(t as u64 + 1, 0x9e37_79b9_7f4a_7c15 + c as u64);
        for in_order in [true, false] {
            let corners = |t: usize| {
                [0, 1, 2].map(|c| match in_order {
                    true => [((t + c) / 2) as u32, c as u32 / 2, 7],
                    false => [(stray(t, c) % 150_000) as u32, 5, 7],
                })
            };
            let mut known = HashMap::new();
            let mut order = Vec::new();
            let mut number = |key| {
                *known.entry(key).or_insert_with(|| {
                    order.push(key);
                    order.len() as u32 - 1
                })
            };
            let expected: Vec<_> = (0..COUNT).map(|t| corners(t).map(&mut number)).collect();
            for threads in [1, 3] {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
                let welded = pool.build().unwrap().install(|| triangles(COUNT, corners));
                assert!(welded.triangles == expected && welded.keys == order);
            }
        }
    }
}
