//! Which boxes meet, for a bounded effort.
//!
//! A triangle of a sound mesh has a few dozen neighbors, but a file may put all of its triangles
//! into one place, and comparing all with all is quadratic. So every search counts its comparisons:
//! each item gets a share of an effort proportional to their number, unused effort is given to
//! items that need more, and items that are not done then are named. All of it is counted work,
//! never time: the answer is the same on every machine.

use glam::DVec3;
use rayon::prelude::*;

/// Average effort per item, in comparisons of boxes of two or three nanoseconds. A triangle of a
/// sound mesh takes half of it or less.
pub const DEFAULT_EFFORT: usize = 1024;

/// Minimum number of items that the total effort is computed for, so that small inputs are compared
/// completely.
const MIN_EFFORT_ITEMS: usize = 1 << 15;

/// The remaining effort of one item.
pub struct Effort {
    left: usize,
    short: bool,
}

impl Effort {
    /// Returns an effort of `left` steps.
    pub fn new(left: usize) -> Effort {
        Effort { left, short: false }
    }

    /// Returns whether the effort ran out.
    pub fn ran_short(&self) -> bool {
        self.short
    }

    /// Spends, or returns false from the first time that too little is left.
    #[inline]
    pub fn spend(&mut self, cost: usize) -> bool {
        self.short |= self.left < cost;
        self.left = if self.short { 0 } else { self.left - cost };
        !self.short
    }
}

/// The result of [`share_out`].
pub struct Shared<T> {
    /// One result for each item; partial for unfinished ones.
    pub found: Vec<T>,
    /// Items whose effort ran out, in order.
    pub unfinished: Vec<usize>,
}

/// Runs `work` for each item, with an effort of `each` per item on average; the total effort is
/// bounded.
pub fn share_out<T: Send>(
    items: usize,
    each: usize,
    work: impl Fn(usize, &mut Effort) -> T + Sync,
) -> Shared<T> {
    let total = each.saturating_mul(items.max(MIN_EFFORT_ITEMS));
    let mut found: Vec<Option<T>> = (0..items).map(|_| None).collect();
    let (mut unfinished, mut share, mut spent): (Vec<usize>, _, _) = ((0..items).collect(), each, 0);
    // a second time from the start, with what the others left over
    for _ in 0..2 {
        let run = |&i: &usize| {
            let mut effort = Effort::new(share);
            (work(i, &mut effort), share - effort.left, effort.short)
        };
        let runs: Vec<(T, usize, bool)> = unfinished.par_iter().map(run).collect();
        let mut short = Vec::new();
        for (i, (result, cost, ran_short)) in unfinished.into_iter().zip(runs) {
            found[i] = Some(result);
            spent += cost;
            if ran_short {
                short.push(i);
            }
        }
        unfinished = short;
        let left = total.saturating_sub(spent) / unfinished.len().max(1);
        if unfinished.is_empty() || left <= each {
            break;
        }
        share = left;
    }
    Shared { found: found.into_iter().flatten().collect(), unfinished }
}

/// A box along the axes.
#[derive(Clone, Copy)]
pub struct DBox {
    low: DVec3,
    high: DVec3,
}

impl DBox {
    const EMPTY: DBox = DBox { low: DVec3::INFINITY, high: DVec3::NEG_INFINITY };

    /// Returns the smallest box around points.
    pub fn around(points: impl IntoIterator<Item = DVec3>) -> DBox {
        points.into_iter().fold(DBox::EMPTY, |s, p| DBox { low: s.low.min(p), high: s.high.max(p) })
    }

    #[inline]
    /// Returns the box with `margin` more on each side.
    pub fn grown(self, margin: f64) -> DBox {
        DBox { low: self.low - margin, high: self.high + margin }
    }

    fn with(self, other: DBox) -> DBox {
        DBox { low: self.low.min(other.low), high: self.high.max(other.high) }
    }

    fn meets(&self, other: &DBox) -> bool {
        self.low.cmple(other.high).all() && other.low.cmple(self.high).all()
    }

    /// Returns twice its middle.
    fn middle(&self) -> DVec3 {
        self.low + self.high
    }
}

/// Most boxes in a leaf of the tree.
const LEAF: usize = 4;

/// Boxes in a balanced tree: each node holds half of its parent's, parted across the longest side.
/// Its depth does not depend on where they are.
pub struct Boxes {
    /// In the order of the tree, with their numbers.
    items: Vec<(DBox, u32)>,
    /// A node, then those below its first half, then those below its second.
    nodes: Vec<DBox>,
}

impl Boxes {
    /// Returns the tree over boxes, which keep their order as numbers.
    pub fn new(spans: impl Iterator<Item = DBox>) -> Boxes {
        let mut items: Vec<(DBox, u32)> = spans.zip(0..).collect();
        let leaves = items.len().div_ceil(LEAF).next_power_of_two();
        let mut nodes = vec![DBox::EMPTY; 2 * leaves - 1];
        part(&mut items, &mut nodes);
        Boxes { items, nodes }
    }

    /// Returns the numbers of the boxes, neighbors mostly beside each other.
    pub fn order(&self) -> impl Iterator<Item = u32> {
        self.items.iter().map(|&(_, i)| i)
    }

    /// Calls `visit` with every box that meets `query`, until it returns false or the effort is
    /// spent.
    pub fn meeting(
        &self,
        query: &DBox,
        effort: &mut Effort,
        mut visit: impl FnMut(u32, &mut Effort) -> bool,
    ) {
        // node, nodes from it on, its items
        let mut stack = vec![(0, self.nodes.len(), 0, self.items.len())];
        while let Some((node, count, from, to)) = stack.pop() {
            if !effort.spend(1) {
                return;
            }
            if !self.nodes[node].meets(query) {
                continue;
            }
            if count > 1 {
                let (below, half) = (count / 2, from + (to - from) / 2);
                stack.push((node + 1 + below, below, half, to));
                stack.push((node + 1, below, from, half));
                continue;
            }
            for (span, i) in &self.items[from..to] {
                if !effort.spend(1) || span.meets(query) && !visit(*i, effort) {
                    return;
                }
            }
        }
    }
}

fn part(items: &mut [(DBox, u32)], nodes: &mut [DBox]) {
    let Some((node, below)) = nodes.split_first_mut() else { return };
    *node = items.iter().fold(DBox::EMPTY, |s, i| s.with(i.0));
    if below.is_empty() || items.is_empty() {
        return;
    }
    let middles = DBox::around(items.iter().map(|i| i.0.middle()));
    let axis = (middles.high - middles.low).max_position();
    let at = |i: &(DBox, u32)| i.0.middle()[axis];
    let half = items.len() / 2;
    items.select_nth_unstable_by(half, |a, b| at(a).total_cmp(&at(b)).then(a.1.cmp(&b.1)));
    let (a, b) = items.split_at_mut(half);
    let (below_a, below_b) = below.split_at_mut(below.len() / 2);
    if b.len() > 4096 {
        rayon::join(|| part(a, below_a), || part(b, below_b));
    } else {
        part(a, below_a);
        part(b, below_b);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_tree_finds_what_all_pairs_find() {
        // boxes 0 to 0.2 wide in the unit cube, from a counter; one of them far out, as strays of
        // scans are
        let mut state = 7u64;
        let mut next = move || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 40) as f64 / (1u64 << 24) as f64
        };
        let mut spans: Vec<DBox> = (0..501)
            .map(|_| {
                let low = DVec3::new(next(), next(), next());
                DBox { low, high: low + 0.2 * DVec3::new(next(), next(), next()) }
            })
            .collect();
        spans[17] = DBox::around([DVec3::splat(1e30)]);
        let boxes = Boxes::new(spans.iter().copied());
        for query in &spans {
            let mut found = Vec::new();
            let mut effort = Effort { left: usize::MAX, short: false };
            boxes.meeting(query, &mut effort, |i, _| {
                found.push(i);
                true
            });
            found.sort_unstable();
            let all = (0..501).filter(|&i| spans[i as usize].meets(query)).collect::<Vec<u32>>();
            assert_eq!(found, all);
            // most of the tree is not looked at
            assert!(usize::MAX - effort.left < 400);
        }
        assert_eq!(Boxes::new(std::iter::empty()).nodes.len(), 1);
    }

    #[test]
    fn what_some_leave_over_goes_to_those_that_need_more() {
        // item 3 asks for a hundred thousand, which all of them together may spend; none else asks
        // for any
        let need = |i: usize| if i == 3 { 100_000 } else { 0 };
        let work = |i: usize, effort: &mut Effort| (0..need(i)).take_while(|_| effort.spend(1)).count();
        let shared = share_out(10, 10, work);
        assert_eq!((shared.found[3], shared.unfinished.len()), (100_000, 0));
        // Three of them exceed the total: each receives its own limit.
        let work = |_: usize, effort: &mut Effort| (0..200_000).take_while(|_| effort.spend(1)).count();
        let shared = share_out(3, 10, work);
        assert_eq!(shared.unfinished, [0, 1, 2]);
        assert!(
            shared.found.iter().sum::<usize>() <= 10 * MIN_EFFORT_ITEMS
                && shared.found.iter().all(|&n| n > 100_000)
        );
    }
}
