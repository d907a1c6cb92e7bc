//! Edges in the order of their cost, to a sixteenth of an octave.
//!
//! A heap would order exactly, at a cache miss a level. Here an edge falls into a bucket by the upper
//! bits of its cost (positive floats are ordered as their bits), and a bucket is worked through first
//! in, first out, which also visits neighbours in memory one after another. Outdated entries stay
//! where they are: the caller recognises them by `stamp`.

/// Of the bits of a cost: sign and exponent, and four bits of its mantissa.
const SHIFT: u32 = 19;

/// An edge and what its ends were when it was entered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Entry {
    pub a: u32,
    pub b: u32,
    /// Sum of the ends' stamps.
    pub stamp: u32,
}

/// The buckets.
pub(super) struct EdgeQueue {
    buckets: Vec<Vec<Entry>>,
    /// No bucket below this one has entries.
    lowest: usize,
    /// Being worked through: entries, how many are done, their bucket.
    current: Vec<Entry>,
    done: usize,
    bucket: usize,
}

impl EdgeQueue {
    pub(super) fn new() -> EdgeQueue {
        let buckets = vec![Vec::new(); (f32::INFINITY.to_bits() >> SHIFT) as usize + 1];
        EdgeQueue { buckets, lowest: usize::MAX, current: Vec::new(), done: 0, bucket: 0 }
    }

    /// The bucket of a cost ≥ 0; whatever is not a number goes last.
    pub(super) fn bucket(cost: f32) -> usize {
        // + 0 makes −0 and 0 equal
        let cost = if cost.is_nan() { f32::INFINITY } else { cost.max(0.0) + 0.0 };
        (cost.to_bits() >> SHIFT) as usize
    }

    pub(super) fn push(&mut self, bucket: usize, entry: Entry) {
        self.buckets[bucket].push(entry);
        self.lowest = self.lowest.min(bucket);
    }

    /// The next entry and its bucket.
    pub(super) fn pop(&mut self) -> Option<(usize, Entry)> {
        while self.done == self.current.len() {
            self.current.clear();
            self.done = 0;
            let next = (self.lowest..self.buckets.len()).find(|&i| !self.buckets[i].is_empty());
            self.lowest = next.unwrap_or(usize::MAX);
            self.bucket = next?;
            std::mem::swap(&mut self.current, &mut self.buckets[self.bucket]);
        }
        self.done += 1;
        Some((self.bucket, self.current[self.done - 1]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cheap_edges_come_first_and_equal_ones_in_their_order() {
        let mut q = EdgeQueue::new();
        for (a, cost) in [(0, 2.0), (1, 1e-20), (2, 2.01), (3, 0.0), (4, f32::NAN), (5, 1e30)] {
            q.push(EdgeQueue::bucket(cost), Entry { a, b: 9, stamp: 0 });
        }
        let order: Vec<u32> = std::iter::from_fn(|| q.pop()).map(|(_, e)| e.a).collect();
        assert_eq!(order, [3, 1, 0, 2, 5, 4]);
        q.push(EdgeQueue::bucket(1.0), Entry { a: 7, b: 9, stamp: 0 });
        assert_eq!(q.pop().map(|(_, e)| e.a), Some(7));
        assert_eq!(q.pop(), None);
    }
}
