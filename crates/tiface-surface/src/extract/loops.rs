//! Short loops of a closed surface that do not separate it: around handles, and around the holes
//! beside them.
//!
//! - A tree of triangles, grown breadth first, and a tree of vertices over the edges it does not
//!   cross leave `2 · genus` edges (Eppstein 2003). Each closes a loop of triangles; of all such
//!   choices the one with the shortest loops is taken (Erickson, Whittlesey 2005).
//! - Every such loop has a random word, and an edge the exclusive or of the words of the loops that
//!   cross it. Along a closed walk these add up to 0 if the walk separates the surface, and to the
//!   same word, its class, for all walks that differ by separating ones.
//! - So a loop that does not separate starts at some crossed edge. Shortest paths from that edge,
//!   as far as half the length allowed, and the edges that join two of them with a class other than
//!   0 are all short loops.
//!
//! The words have 64 bits: two classes are taken for one by an accident of 1 in 10¹⁹, and then a
//! handle stays.

use glam::Vec3;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};
use tiface_base::geom::{Sets, side_ends, sorted_sides};
use tiface_base::math::rng::mix;
use tiface_base::{Monitor, Result};

const NONE: u32 = u32::MAX;

/// Maximum number of classes per round; the next round processes the others.
const MAX_CLASSES: usize = 256;

/// Number of vertices of a loop from which a shorter loop of its class is searched, and number of
/// such searches.
const SHORTENING_STARTS: usize = 8;
const SHORTENING_ROUNDS: usize = 3;

/// A simple closed walk along edges.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Loop {
    /// Different vertices, each joined to the next and the last to the first.
    pub vertices: Vec<u32>,
    /// Length along the edges.
    pub length: f32,
    /// The handles that it goes around: independent words belong to loops that together do not
    /// separate.
    pub class: u64,
}

/// A closed manifold with a word for each side, which distinguishes its loops. Corner `3 t + k`
/// stands for the side from vertex k to k + 1 of triangle t.
pub(super) struct LoopFinder<'a> {
    positions: &'a [Vec3],
    triangles: &'a [[u32; 3]],
    /// Index of the same side in the other triangle.
    twin: Vec<u32>,
    /// A side that starts at each vertex.
    first: Vec<u32>,
    /// The word of each side.
    word: Vec<u64>,
    /// Edges left over by both trees: two per handle.
    seeds: Vec<u32>,
}

impl<'a> LoopFinder<'a> {
    /// `None` for a surface that is not closed or wound inconsistently; every vertex must have one
    /// fan.
    pub(super) fn new(positions: &'a [Vec3], triangles: &'a [[u32; 3]]) -> Option<LoopFinder<'a>> {
        let mut twin = vec![NONE; 3 * triangles.len()];
        let start = |c: u32| side_ends(triangles, c).0;
        for run in sorted_sides(triangles).chunk_by(|a, b| a.0 == b.0) {
            let [(_, a), (_, b)] = *run else { return None };
            if start(a) == start(b) {
                return None;
            }
            (twin[a as usize], twin[b as usize]) = (b, a);
        }
        let mut first = vec![NONE; positions.len()];
        for c in (0..twin.len() as u32).rev() {
            first[start(c) as usize] = c;
        }
        let word = vec![0; twin.len()];
        let mut loops = LoopFinder { positions, triangles, twin, first, word, seeds: Vec::new() };
        loops.tell_apart();
        Some(loops)
    }

    fn start(&self, side: u32) -> u32 {
        side_ends(self.triangles, side).0
    }

    pub(super) fn end(&self, side: u32) -> u32 {
        side_ends(self.triangles, side).1
    }

    /// Returns the sides that start at a vertex, counter-clockwise from a given one.
    pub(super) fn around(&self, from: u32) -> impl Iterator<Item = u32> + '_ {
        let next = move |&c: &u32| {
            let before = c / 3 * 3 + (c % 3 + 2) % 3;
            Some(self.twin[before as usize]).filter(|&c| c != from)
        };
        std::iter::successors(Some(from), next)
    }

    /// Returns the sides that start at a vertex.
    pub(super) fn at(&self, vertex: u32) -> impl Iterator<Item = u32> + '_ {
        self.around(self.first[vertex as usize])
    }

    /// Returns the position of a vertex.
    pub(super) fn position(&self, vertex: u32) -> Vec3 {
        self.positions[vertex as usize]
    }

    fn length(&self, side: u32) -> f32 {
        self.position(self.start(side)).distance(self.position(self.end(side)))
    }

    /// Gives every side its word.
    fn tell_apart(&mut self) {
        // the tree of triangles: through which side each was reached, and after how many steps
        let count = self.triangles.len();
        let (mut up, mut depth) = (vec![NONE; count], vec![NONE; count]);
        let mut of_tree = vec![false; 3 * count];
        let mut order = Vec::with_capacity(count);
        for root in 0..count {
            if depth[root] != NONE {
                continue;
            }
            depth[root] = 0;
            let mut head = order.len();
            order.push(root as u32);
            while let Some(&t) = order.get(head) {
                head += 1;
                for c in 3 * t..3 * t + 3 {
                    let back = self.twin[c as usize];
                    let next = back as usize / 3;
                    if depth[next] == NONE {
                        depth[next] = depth[t as usize] + 1;
                        up[next] = back;
                        of_tree[c as usize] = true;
                        of_tree[back as usize] = true;
                        order.push(next as u32);
                    }
                }
            }
        }
        // the tree of vertices takes the edges that would close the longest loops
        let twin = |c: u32| self.twin[c as usize];
        let steps = |c: u32| depth[c as usize / 3] + depth[twin(c) as usize / 3];
        let mut others: Vec<u32> =
            (0..3 * count as u32).filter(|&c| c < twin(c) && !of_tree[c as usize]).collect();
        others.sort_by_key(|&c| Reverse(steps(c)));
        let mut sets = Sets::new(self.positions.len());
        for c in others {
            let (a, b) = (self.start(c), self.end(c));
            if sets.find(a) != sets.find(b) {
                sets.join(a, b);
            } else {
                self.seeds.push(c);
            }
        }
        for (i, &seed) in self.seeds.iter().enumerate() {
            let word = mix((i as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15));
            let mut cross = |c: u32| {
                self.word[c as usize] ^= word;
                self.word[self.twin[c as usize] as usize] ^= word;
            };
            cross(seed);
            // where both ways to the root run together they cancel
            for mut t in [seed / 3, self.twin[seed as usize] / 3] {
                while up[t as usize] != NONE {
                    cross(up[t as usize]);
                    t = self.twin[up[t as usize] as usize] / 3;
                }
            }
        }
    }

    /// Loops up to a length that do not separate the surface, some for every class found, in no
    /// useful order.
    pub(super) fn short(&self, longest: f32, monitor: &dyn Monitor) -> Result<Vec<Loop>> {
        // from places a quarter of the length apart, as far as any short loop through that quarter
        // goes
        let apart = 0.25 * longest;
        let mut ball = Ball::new(self);
        let mut covered = vec![false; self.positions.len()];
        let mut best: BTreeMap<u64, Loop> = BTreeMap::new();
        for side in 0..self.word.len() as u32 {
            let from = self.start(side);
            if self.word[side as usize] == 0 || covered[from as usize] {
                continue;
            }
            monitor.check_stop()?;
            ball.grow(from, 0.5 * longest + apart);
            for &v in &ball.reached {
                covered[v as usize] |= ball.distance[v as usize] <= apart;
            }
            for (class, (_, side)) in ball.closing() {
                let found = ball.closed(side);
                if best.get(&class).is_none_or(|b| found.length < b.length) {
                    best.insert(class, found);
                }
            }
        }
        let mut classes: Vec<Loop> = best.into_values().filter(|l| l.length <= 2.0 * longest).collect();
        classes.sort_by(|a, b| a.length.total_cmp(&b.length));
        classes.truncate(MAX_CLASSES);
        let mut out = Vec::new();
        for mut tight in classes {
            let mut found = Vec::new();
            for _ in 0..SHORTENING_ROUNDS {
                monitor.check_stop()?;
                let reach = 0.51 * tight.length.min(longest * 1.5);
                let step = tight.vertices.len().div_ceil(SHORTENING_STARTS);
                found.clear();
                for &v in tight.vertices.iter().step_by(step) {
                    ball.grow(v, reach);
                    if let Some(&(_, side)) = ball.closing().get(&tight.class) {
                        found.push(ball.closed(side));
                    }
                }
                match found.iter().min_by(|a, b| a.length.total_cmp(&b.length)) {
                    Some(shorter) if shorter.length < 0.999 * tight.length => tight = shorter.clone(),
                    _ => break,
                }
            }
            found.push(tight);
            out.extend(found.into_iter().filter(|l| l.length <= longest));
        }
        Ok(out)
    }

    /// Returns the length of a loop that does not separate the surface: no longer one than the
    /// shortest through a few places of its handles. `None` without handles.
    pub(super) fn some_length(&self) -> Option<f32> {
        let mut ball = Ball::new(self);
        let lengths = self.seeds.iter().take(SHORTENING_STARTS).filter_map(|&seed| {
            ball.grow(self.start(seed), f32::INFINITY);
            let closing = ball.closing();
            let side = closing.values().min_by(|a, b| a.0.total_cmp(&b.0))?.1;
            Some(ball.closed(side).length)
        });
        lengths.min_by(f32::total_cmp)
    }
}

/// Shortest paths from one vertex, as far as some distance (Dijkstra 1959).
struct Ball<'a> {
    loops: &'a LoopFinder<'a>,
    distance: Vec<f32>,
    /// The word of the path to each vertex.
    word: Vec<u64>,
    /// The last side of that path.
    back: Vec<u32>,
    reached: Vec<u32>,
}

impl<'a> Ball<'a> {
    fn new(loops: &'a LoopFinder<'a>) -> Ball<'a> {
        let n = loops.positions.len();
        Ball {
            loops,
            distance: vec![f32::INFINITY; n],
            word: vec![0; n],
            back: vec![NONE; n],
            reached: Vec::new(),
        }
    }

    fn grow(&mut self, from: u32, radius: f32) {
        for v in self.reached.drain(..) {
            self.distance[v as usize] = f32::INFINITY;
        }
        let mut queue = BinaryHeap::new();
        self.reached.push(from);
        (self.distance[from as usize], self.word[from as usize], self.back[from as usize]) = (0.0, 0, NONE);
        // the bits of floats that are not negative are in their order
        queue.push(Reverse((0, from)));
        while let Some(Reverse((bits, v))) = queue.pop() {
            let here = self.distance[v as usize];
            if bits != here.to_bits() {
                continue;
            }
            for side in self.loops.at(v) {
                let w = self.loops.end(side) as usize;
                let farther = here + self.loops.length(side);
                if farther <= radius && farther < self.distance[w] {
                    if self.distance[w] == f32::INFINITY {
                        self.reached.push(w as u32);
                    }
                    self.distance[w] = farther;
                    self.word[w] = self.word[v as usize] ^ self.loops.word[side as usize];
                    self.back[w] = side;
                    queue.push(Reverse((farther.to_bits(), w as u32)));
                }
            }
        }
    }

    /// Returns for every class the side that closes the shortest closed walk, and the walk's
    /// length.
    fn closing(&self) -> BTreeMap<u64, (f32, u32)> {
        let mut best: BTreeMap<u64, (f32, u32)> = BTreeMap::new();
        for &v in &self.reached {
            for side in self.loops.at(v) {
                let w = self.loops.end(side) as usize;
                let class = self.word[v as usize] ^ self.word[w] ^ self.loops.word[side as usize];
                if v as usize > w || self.distance[w] == f32::INFINITY || class == 0 {
                    continue;
                }
                let length = self.distance[v as usize] + self.distance[w] + self.loops.length(side);
                let slot = best.entry(class).or_insert((length, side));
                if (length, side) < *slot {
                    *slot = (length, side);
                }
            }
        }
        best
    }

    /// Returns the loop that a side closes, without the path to it and back.
    fn closed(&self, side: u32) -> Loop {
        let loops = self.loops;
        let (v, w) = (loops.start(side), loops.end(side));
        let path = |mut v: u32| {
            let mut path = vec![v];
            while self.back[v as usize] != NONE {
                v = loops.start(self.back[v as usize]);
                path.push(v);
            }
            path
        };
        let (mut to_v, mut to_w) = (path(v), path(w));
        let mut common = None;
        while let (Some(a), Some(b)) = (to_v.last(), to_w.last())
            && a == b
        {
            common = to_v.pop();
            to_w.pop();
        }
        let class = self.word[v as usize] ^ self.word[w as usize] ^ loops.word[side as usize];
        let vertices: Vec<u32> = to_v.into_iter().chain(common).chain(to_w.into_iter().rev()).collect();
        let place = |i: usize| loops.position(vertices[i % vertices.len()]);
        let length = (0..vertices.len()).map(|i| place(i).distance(place(i + 1))).sum();
        Loop { vertices, length, class }
    }
}
