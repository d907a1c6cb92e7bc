//! The smallest cut of a picture's pixels into two sets (Boykov & Kolmogorov 2004).
//!
//! Pixels are nodes joined to their 8 neighbors and to two terminals, *head* and *background*. A
//! labeling costs
//!
//! ```text
//! E = Σ_p cost of p's label + Σ_pq w_pq · [p and q have different labels]
//! ```
//!
//! and the smallest cut is the labeling that costs least. Two search trees grow from the terminals
//! until they touch; the path is saturated; what that tears off is adopted by another parent or set
//! free, and the trees are reused for the next path. Capacities are whole numbers: sums are exact
//! and the result is the same everywhere.

use std::collections::VecDeque;

/// Steps to the 8 neighbors; `d ^ 1` is the way back.
const STEPS: [(isize, isize); 8] = [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (-1, 1), (1, -1)];

/// A parent that is no neighbor: the tree's own terminal.
const TERMINAL: u8 = 8;
/// Torn off, waiting for adoption.
const ORPHAN: u8 = 9;
/// In no tree.
const FREE: u8 = 10;

const HEAD: u8 = 1;
const BACKGROUND: u8 = 2;

/// A picture's graph: capacities in, labels out.
///
/// Nodes lie in a frame one pixel wider on each side, whose edges carry nothing; so no step needs a
/// border test.
pub struct PixelGraph {
    width: usize,
    height: usize,
    steps: [isize; 8],
    /// Residual capacity from a node to each neighbor.
    residual: Vec<[i32; 8]>,
    /// Residual capacity to the terminals: positive from the head terminal, negative to the
    /// background terminal.
    terminal: Vec<i32>,
    tree: Vec<u8>,
    parent: Vec<u8>,
    /// When the distance was last known to be right.
    stamp: Vec<u32>,
    /// Steps to the terminal, as far as known.
    depth: Vec<u32>,
    queued: Vec<bool>,
    active: VecDeque<u32>,
    orphans: VecDeque<u32>,
    time: u32,
    flow: i64,
}

impl PixelGraph {
    /// Returns a graph without any capacity.
    pub fn new(width: usize, height: usize) -> PixelGraph {
        let row = width + 2;
        let n = row * (height + 2);
        assert!(n < u32::MAX as usize, "a picture of {width} × {height} pixels is no graph of 32-bit nodes");
        PixelGraph {
            width,
            height,
            steps: STEPS.map(|(x, y)| y * row as isize + x),
            residual: vec![[0; 8]; n],
            terminal: vec![0; n],
            tree: vec![0; n],
            parent: vec![FREE; n],
            stamp: vec![0; n],
            depth: vec![0; n],
            queued: vec![false; n],
            active: VecDeque::new(),
            orphans: VecDeque::new(),
            time: 0,
            flow: 0,
        }
    }

    fn node(&self, x: usize, y: usize) -> usize {
        (y + 1) * (self.width + 2) + x + 1
    }

    fn step(&self, node: usize, direction: usize) -> usize {
        node.wrapping_add_signed(self.steps[direction])
    }

    /// Adds the costs of both labels of a pixel to its earlier costs. Costs are not negative.
    pub fn add_costs(&mut self, x: usize, y: usize, as_head: i32, as_background: i32) {
        let i = self.node(x, y);
        // a cost that both labels share does not change the cut; the difference is the capacity to
        // one terminal
        self.flow += as_head.min(as_background) as i64;
        let before = self.terminal[i];
        let give = as_background as i64 + before.max(0) as i64;
        let take = as_head as i64 + (-before).max(0) as i64;
        self.flow += give.min(take) - as_head.min(as_background) as i64;
        self.terminal[i] = (give - take).clamp(-(i32::MAX as i64), i32::MAX as i64) as i32;
    }

    /// Sets the cost of different labels of a pixel and its neighbor; `direction` 0 right, 2 below,
    /// 4 below right, 6 below left. The neighbor must be in the picture.
    pub fn join(&mut self, x: usize, y: usize, direction: usize, weight: i32) {
        let (dx, dy) = STEPS[direction];
        let (u, v) = (x.wrapping_add_signed(dx), y.wrapping_add_signed(dy));
        assert!(direction < 8 && u < self.width && v < self.height, "no neighbor {direction} of ({x}, {y})");
        let i = self.node(x, y);
        let j = self.step(i, direction);
        self.residual[i][direction] += weight;
        self.residual[j][direction ^ 1] += weight;
    }

    /// Finds the minimum cut. Returns labels `[height · width]`, true for head, and the cost of the
    /// cut.
    ///
    /// Of several minimum cuts it is the one with the smallest head.
    pub fn cut(mut self) -> (Vec<bool>, i64) {
        for y in 0..self.height {
            for x in 0..self.width {
                let i = self.node(x, y);
                if self.terminal[i] != 0 {
                    self.tree[i] = if self.terminal[i] > 0 { HEAD } else { BACKGROUND };
                    self.parent[i] = TERMINAL;
                    self.depth[i] = 1;
                    self.activate(i);
                }
            }
        }
        while let Some(&p) = self.active.front() {
            let p = p as usize;
            // a torn-off pixel may wait here still; a front pixel stays until it finds no more
            // paths
            match self.grow(p) {
                Some((from, direction)) => {
                    self.augment(from, direction);
                    self.adopt();
                }
                None => {
                    self.active.pop_front();
                    self.queued[p] = false;
                }
            }
        }
        let labels = (0..self.height)
            .flat_map(|y| (0..self.width).map(move |x| (x, y)))
            .map(|(x, y)| self.tree[self.node(x, y)] == HEAD)
            .collect();
        (labels, self.flow)
    }

    fn activate(&mut self, i: usize) {
        if !self.queued[i] {
            self.queued[i] = true;
            self.active.push_back(i as u32);
        }
    }

    /// Returns whether flow can run between `p` and its neighbor in the sense of `p`'s tree, away
    /// from the root.
    fn open(&self, p: usize, direction: usize, q: usize) -> bool {
        if self.tree[p] == HEAD {
            self.residual[p][direction] > 0
        } else {
            self.residual[q][direction ^ 1] > 0
        }
    }

    /// Takes free neighbors into `p`'s tree; ends with the first edge from the head's tree to the
    /// background's.
    fn grow(&mut self, p: usize) -> Option<(usize, usize)> {
        if self.parent[p] == FREE {
            return None;
        }
        for direction in 0..8 {
            let q = self.step(p, direction);
            if !self.open(p, direction, q) {
                continue;
            }
            if self.parent[q] == FREE {
                self.tree[q] = self.tree[p];
                self.parent[q] = (direction ^ 1) as u8;
                self.stamp[q] = self.stamp[p];
                self.depth[q] = self.depth[p] + 1;
                self.activate(q);
            } else if self.tree[q] != self.tree[p] {
                return Some(if self.tree[p] == HEAD { (p, direction) } else { (q, direction ^ 1) });
            } else if self.stamp[q] <= self.stamp[p] && self.depth[q] > self.depth[p] + 1 {
                // a shorter way to the root keeps later paths short
                self.parent[q] = (direction ^ 1) as u8;
                self.stamp[q] = self.stamp[p];
                self.depth[q] = self.depth[p] + 1;
            }
        }
        None
    }

    /// Returns the edge that carries flow between a node and its parent: the node it leaves, and in
    /// which direction.
    fn edge_to_parent(&self, p: usize) -> (usize, usize) {
        let up = self.parent[p] as usize;
        if self.tree[p] == HEAD { (self.step(p, up), up ^ 1) } else { (p, up) }
    }

    fn push(&mut self, from: usize, direction: usize, flow: i32) {
        let to = self.step(from, direction);
        self.residual[from][direction] -= flow;
        self.residual[to][direction ^ 1] += flow;
    }

    /// Saturates the path through the edge from `head_end`, in the head's tree, to its neighbor in
    /// the background's.
    fn augment(&mut self, head_end: usize, direction: usize) {
        let ends = [head_end, self.step(head_end, direction)];
        let mut bottleneck = self.residual[head_end][direction];
        for mut p in ends {
            while self.parent[p] != TERMINAL {
                let (from, direction) = self.edge_to_parent(p);
                bottleneck = bottleneck.min(self.residual[from][direction]);
                p = self.step(p, self.parent[p] as usize);
            }
            bottleneck = bottleneck.min(self.terminal[p].abs());
        }
        self.push(head_end, direction, bottleneck);
        for mut p in ends {
            while self.parent[p] != TERMINAL {
                let (from, direction) = self.edge_to_parent(p);
                self.push(from, direction, bottleneck);
                if self.residual[from][direction] == 0 {
                    self.tear(p);
                }
                p = self.step(p, self.parent[p] as usize);
            }
            self.terminal[p] -= bottleneck * self.terminal[p].signum();
            if self.terminal[p] == 0 {
                self.tear(p);
            }
        }
        self.flow += bottleneck as i64;
    }

    /// Queues a pixel as an orphan. It is marked only later, because the path is still being walked
    /// by its parents.
    fn tear(&mut self, p: usize) {
        self.orphans.push_front(p as u32);
    }

    /// Finds a new parent for every orphan, preferably near the root; orphans without one become
    /// free.
    fn adopt(&mut self) {
        self.time += 1;
        for &p in &self.orphans {
            self.parent[p as usize] = ORPHAN;
        }
        while let Some(p) = self.orphans.pop_front() {
            self.adopt_one(p as usize);
        }
    }

    fn adopt_one(&mut self, p: usize) {
        let mut best: Option<(u32, usize)> = None;
        for direction in 0..8 {
            let q = self.step(p, direction);
            if self.tree[q] != self.tree[p] || self.parent[q] == FREE {
                continue;
            }
            if !self.feeds(q, p, direction) {
                continue;
            }
            if let Some(depth) = self.depth_below_root(q)
                && best.is_none_or(|(nearest, _)| depth < nearest)
            {
                best = Some((depth, direction));
            }
        }
        if let Some((depth, direction)) = best {
            self.parent[p] = direction as u8;
            self.stamp[p] = self.time;
            self.depth[p] = depth + 1;
            return;
        }
        for direction in 0..8 {
            let q = self.step(p, direction);
            if self.tree[q] != self.tree[p] || self.parent[q] == FREE {
                continue;
            }
            if self.feeds(q, p, direction) {
                self.activate(q);
            }
            if self.parent[q] == (direction ^ 1) as u8 {
                self.parent[q] = ORPHAN;
                self.orphans.push_back(q as u32);
            }
        }
        self.parent[p] = FREE;
        self.tree[p] = 0;
    }

    /// Returns whether flow may run between the root and `p` through its neighbor `q` in this
    /// direction.
    fn feeds(&self, q: usize, p: usize, direction: usize) -> bool {
        if self.tree[p] == HEAD {
            self.residual[q][direction ^ 1] > 0
        } else {
            self.residual[p][direction] > 0
        }
    }

    /// Returns the number of steps from a node to its terminal, or `None` if an orphan lies on the
    /// path; marks the path as known.
    fn depth_below_root(&mut self, start: usize) -> Option<u32> {
        let (mut q, mut steps) = (start, 0);
        let depth = loop {
            if self.stamp[q] == self.time {
                break steps + self.depth[q];
            }
            match self.parent[q] {
                TERMINAL => {
                    self.stamp[q] = self.time;
                    self.depth[q] = 1;
                    break steps + 1;
                }
                ORPHAN | FREE => return None,
                up => q = self.step(q, up as usize),
            }
            steps += 1;
        };
        let (mut q, mut below) = (start, depth);
        while self.stamp[q] != self.time {
            self.stamp[q] = self.time;
            self.depth[q] = below;
            below -= 1;
            q = self.step(q, self.parent[q] as usize);
        }
        Some(depth)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tiface_base::math::rng;

    struct Random(u64, u64);

    impl Random {
        fn below(&mut self, n: u64) -> i32 {
            self.1 += 1;
            rng::below(self.0, 0, self.1, n) as i32
        }
    }

    /// A graph as plain lists: `(head cost, stage cost)` a pixel, `(i, j, weight)` an edge.
    struct Plain {
        w: usize,
        h: usize,
        costs: Vec<(i32, i32)>,
        edges: Vec<(usize, usize, i32)>,
    }

    fn random(w: usize, h: usize, seed: u64) -> (PixelGraph, Plain) {
        let mut r = Random(seed, 0);
        let mut graph = PixelGraph::new(w, h);
        let mut plain = Plain { w, h, costs: Vec::new(), edges: Vec::new() };
        for y in 0..h {
            for x in 0..w {
                let (head, stage) = (r.below(30), r.below(30));
                graph.add_costs(x, y, head, stage);
                plain.costs.push((head, stage));
                for direction in [0, 2, 4, 6] {
                    let (u, v) = (x as isize + STEPS[direction].0, y as isize + STEPS[direction].1);
                    if u >= 0 && u < w as isize && v < h as isize {
                        let weight = r.below(16);
                        graph.join(x, y, direction, weight);
                        plain.edges.push((y * w + x, v as usize * w + u as usize, weight));
                    }
                }
            }
        }
        (graph, plain)
    }

    impl Plain {
        fn cost(&self, head: &[bool]) -> i64 {
            let own =
                self.costs.iter().zip(head).map(|(c, &h)| if h { c.0 } else { c.1 } as i64).sum::<i64>();
            let cut = self.edges.iter().filter(|(i, j, _)| head[*i] != head[*j]).map(|e| e.2 as i64);
            own + cut.sum::<i64>()
        }

        /// Edmonds & Karp 1972: shortest paths by breadth, on a matrix of capacities.
        fn largest_flow(&self) -> i64 {
            let n = self.w * self.h;
            let (s, t) = (n, n + 1);
            let mut capacity = vec![vec![0i64; n + 2]; n + 2];
            for (i, &(head, stage)) in self.costs.iter().enumerate() {
                capacity[s][i] += stage as i64;
                capacity[i][t] += head as i64;
            }
            for &(i, j, weight) in &self.edges {
                capacity[i][j] += weight as i64;
                capacity[j][i] += weight as i64;
            }
            let mut flow = 0;
            loop {
                let mut from = vec![usize::MAX; n + 2];
                let mut queue = VecDeque::from([s]);
                while let Some(p) = queue.pop_front() {
                    for q in 0..n + 2 {
                        if q != s && from[q] == usize::MAX && capacity[p][q] > 0 {
                            from[q] = p;
                            queue.push_back(q);
                        }
                    }
                }
                if from[t] == usize::MAX {
                    return flow;
                }
                let (mut bottleneck, mut q) = (i64::MAX, t);
                while q != s {
                    bottleneck = bottleneck.min(capacity[from[q]][q]);
                    q = from[q];
                }
                q = t;
                while q != s {
                    capacity[from[q]][q] -= bottleneck;
                    capacity[q][from[q]] += bottleneck;
                    q = from[q];
                }
                flow += bottleneck;
            }
        }
    }

    #[test]
    fn two_pixels_part_where_parting_is_cheapest() {
        // left wants head (9 as stage), right wants stage (7 as head); telling them apart costs 5
        let graph = |weight| {
            let mut g = PixelGraph::new(2, 1);
            g.add_costs(0, 0, 0, 9);
            g.add_costs(1, 0, 7, 0);
            g.join(0, 0, 0, weight);
            g.cut()
        };
        assert_eq!(graph(5), (vec![true, false], 5));
        // at 8 it is cheaper to give in: right becomes head for 7
        assert_eq!(graph(8), (vec![true, true], 7));
    }

    #[test]
    fn every_small_grid_is_cut_as_cheaply_as_trying_all_labelings() {
        for (k, (w, h)) in [(1, 1), (4, 1), (1, 5), (3, 3), (4, 3), (3, 4), (2, 6)].into_iter().enumerate() {
            for seed in 0..12 {
                let (graph, plain) = random(w, h, 100 * k as u64 + seed);
                let (labels, cost) = graph.cut();
                let all = (0..1u32 << (w * h)).map(|bits| {
                    let head: Vec<bool> = (0..w * h).map(|i| bits >> i & 1 == 1).collect();
                    plain.cost(&head)
                });
                assert_eq!(cost, all.min().unwrap(), "{w} x {h}, seed {seed}");
                assert_eq!(plain.cost(&labels), cost, "{w} x {h}, seed {seed}");
            }
        }
    }

    #[test]
    fn larger_grids_carry_the_flow_that_edmonds_and_karp_find() {
        for seed in 0..20 {
            let (graph, plain) = random(12, 12, 1000 + seed);
            let (labels, cost) = graph.cut();
            assert_eq!(cost, plain.largest_flow(), "seed {seed}");
            assert_eq!(plain.cost(&labels), cost, "seed {seed}");
        }
    }

    #[test]
    fn the_same_graph_is_cut_the_same_way_twice() {
        let cut = || random(40, 30, 5).0.cut();
        assert_eq!(cut(), cut());
    }

    #[test]
    fn costs_said_twice_add_up() {
        let mut g = PixelGraph::new(1, 1);
        g.add_costs(0, 0, 3, 10);
        g.add_costs(0, 0, 12, 2);
        // head 15, stage 12
        assert_eq!(g.cut(), (vec![false], 12));
    }
}
