//! Shapes of charts on a grid of cells, and the page that they are placed on.
//!
//! A shape is every cell that a chart grown by its gutter touches, row by row; a page has a bit for
//! each of its cells.

use glam::DVec2;

/// A chart's shape: its width and height in cells and, row by row, which of them are taken.
#[derive(Clone, Debug, Default)]
pub(super) struct Mask {
    width: usize,
    pub(super) height: usize,
    /// Taken cells `[from, to)`, all rows one after the other.
    spans: Vec<[u32; 2]>,
    /// Start of each row's spans, and the end of the last.
    starts: Vec<u32>,
    /// The longest span of each row.
    longest: Vec<u32>,
    /// Rows in an order that finds a collision early: ends, middle, quarters.
    order: Vec<u32>,
}

impl Mask {
    fn row(&self, y: usize) -> &[[u32; 2]] {
        &self.spans[self.starts[y] as usize..self.starts[y + 1] as usize]
    }

    /// Returns the shape within an outline whose lowest coordinates are 0, grown by `reach`, so
    /// that the outline's lowest corner lies at (`reach`, `reach`). Cells are squares of one unit.
    pub(super) fn rasterize(outline: &[[DVec2; 2]], high: DVec2, reach: f64) -> Mask {
        let [width, height] = (high + 2.0 * reach).to_array().map(|v| (v.ceil() as usize).max(1));
        let words = width.div_ceil(64);
        let (mut near, mut within) = (vec![0u64; words * height], vec![0u64; words * height]);
        for &[a, b] in outline {
            let (a, b) = (a + reach, b + reach);
            grown_side(&mut near, a, b, reach, [width, height]);
            // even-odd filling at the cells' centers: a side turns over all that is right of it
            let (low, high) = if a.y < b.y { (a, b) } else { (b, a) };
            let (from, to) =
                ((low.y - 0.5).ceil().max(0.0) as usize, (high.y - 0.5).ceil().max(0.0) as usize);
            let slope = (high.x - low.x) / (high.y - low.y);
            for y in from..to.min(height) {
                let x = (low.x + slope * (y as f64 + 0.5 - low.y) - 0.5).ceil().max(0.0) as usize;
                let row = &mut within[y * words..(y + 1) * words];
                if x < width {
                    row[x / 64] ^= !0 << (x % 64);
                    row[x / 64 + 1..].iter_mut().for_each(|w| *w = !*w);
                }
            }
        }
        let mut mask = Mask { width, height, ..Mask::default() };
        mask.starts.push(0);
        for y in 0..height {
            let rows = y * words..(y + 1) * words;
            let row: &mut [u64] = &mut near[rows.clone()];
            row.iter_mut().zip(&within[rows]).for_each(|(n, w)| *n |= w);
            let (mut at, mut longest) = (0, 0);
            loop {
                let from = next(row, at, width, true);
                if from == width {
                    break;
                }
                at = next(row, from, width, false);
                longest = longest.max(at - from);
                mask.spans.push([from as u32, at as u32]);
            }
            mask.longest.push(longest as u32);
            mask.starts.push(mask.spans.len() as u32);
        }
        mask.order = coarse_to_fine(height);
        mask
    }
}

/// Takes the cells that come within `reach` of a side: per row of cells the interval of two discs
/// and the rectangle between them, which together are convex.
fn grown_side(bits: &mut [u64], a: DVec2, b: DVec2, reach: f64, [width, height]: [usize; 2]) {
    let words = width.div_ceil(64);
    let (low, high) = (a.y.min(b.y) - reach, a.y.max(b.y) + reach);
    let normal = (b - a).perp().normalize_or_zero() * reach;
    let quad = [a + normal, b + normal, b - normal, a - normal];
    let last = (high.floor().max(0.0) as usize).min(height - 1);
    for y in low.floor().max(0.0) as usize..=last {
        let (top, bottom) = (y as f64, y as f64 + 1.0);
        let (mut from, mut to) = (f64::INFINITY, f64::NEG_INFINITY);
        for center in [a, b] {
            let away = (top - center.y).max(center.y - bottom).max(0.0);
            if away <= reach {
                let half = (reach * reach - away * away).sqrt();
                (from, to) = (from.min(center.x - half), to.max(center.x + half));
            }
        }
        for k in 0..4 {
            let (p, q) = (quad[k], quad[(k + 1) % 4]);
            let (p, q) = if p.y <= q.y { (p, q) } else { (q, p) };
            let (begin, end) = (p.y.max(top), q.y.min(bottom));
            if begin <= end {
                let slope = if q.y > p.y { (q.x - p.x) / (q.y - p.y) } else { 0.0 };
                let (x, z) = (p.x + slope * (begin - p.y), p.x + slope * (end - p.y));
                (from, to) = (from.min(x).min(z), to.max(x).max(z));
                if p.y == q.y {
                    (from, to) = (from.min(q.x), to.max(q.x));
                }
            }
        }
        let (from, to) = (from.floor().max(0.0), to.ceil());
        if from < to && from < width as f64 {
            fill(&mut bits[y * words..(y + 1) * words], from as usize, (to as usize).min(width));
        }
    }
}

/// Sets the bits `from..to` of a row.
fn fill(row: &mut [u64], from: usize, to: usize) {
    for w in from / 64..to.div_ceil(64) {
        let (first, last) = (from.max(w * 64), to.min(w * 64 + 64));
        row[w] |= !0u64 >> (64 - (last - first)) << (first - w * 64);
    }
}

/// Returns the first bit of a row from x on that is set (or clear); `end` if none is set before it.
fn next(row: &[u64], x: usize, end: usize, set: bool) -> usize {
    if x >= end {
        return end;
    }
    let flip = if set { 0 } else { !0 };
    let mut w = x / 64;
    let mut word = (row[w] ^ flip) & (!0 << (x % 64));
    while word == 0 {
        w += 1;
        if w == row.len() {
            return end;
        }
        word = row[w] ^ flip;
    }
    (w * 64 + word.trailing_zeros() as usize).min(end)
}

/// Returns the first row whose longest run of free cells is shorter than the longest of the mask.
fn narrow_row(free: &[u32], longest: &[u32]) -> Option<usize> {
    let mut r = 0;
    while r < longest.len() && free[r] >= longest[r] {
        r += 1;
    }
    (r < longest.len()).then_some(r)
}

/// `0..n` by halving: 0, n − 1, the middle, the quarters, ...
fn coarse_to_fine(n: usize) -> Vec<u32> {
    let mut order: Vec<u32> = (0..n as u32).collect();
    // more trailing zeros come first; the sort is stable
    order.sort_by_key(|&i| if i == 0 || i as usize + 1 == n { 0 } else { 32 - i.trailing_zeros() });
    order
}

/// The texture as a grid of cells, taken or free.
pub(super) struct Page {
    side: usize,
    words: usize,
    bits: Vec<u64>,
    /// Longest run of free cells in each row.
    free: Vec<u32>,
}

impl Page {
    pub(super) fn new(side: usize) -> Page {
        let words = side.div_ceil(64);
        Page { side, words, bits: vec![0; words * side], free: vec![side as u32; side] }
    }

    /// Returns the first cell of a row from x on that is taken (or free); `side` if none is.
    fn next(&self, y: usize, x: usize, taken: bool) -> usize {
        next(&self.bits[y * self.words..(y + 1) * self.words], x, self.side, taken)
    }

    /// Returns the lowest and then leftmost place for a mask whose upper end stays below `limit`.
    pub(super) fn find(&self, mask: &Mask, limit: usize) -> Option<(usize, usize)> {
        if mask.width > self.side || mask.height > self.side {
            return None;
        }
        let (mut stuck, mut narrow) = (0, 0);
        for y in 0..=self.side - mask.height {
            if y + mask.height >= limit {
                return None;
            }
            // the row that was in the way before most likely is again, here and below
            if self.free[y + narrow] < mask.longest[narrow] {
                continue;
            }
            if let Some(r) = narrow_row(&self.free[y..], &mask.longest) {
                narrow = r;
                continue;
            }
            let mut x = 0;
            while x + mask.width <= self.side {
                match self.collision(mask, x, y, &mut stuck) {
                    Some(past) => x = past,
                    None => return Some((x, y)),
                }
            }
        }
        None
    }

    /// Returns where to try next if a mask at (x, y) covers a taken cell: past the cells that are
    /// in the way of one of its rows, which becomes `stuck`.
    fn collision(&self, mask: &Mask, x: usize, y: usize, stuck: &mut usize) -> Option<usize> {
        if let Some(past) = self.past(mask, *stuck, x, y) {
            return Some(past);
        }
        for &r in &mask.order {
            if let Some(past) = self.past(mask, r as usize, x, y) {
                *stuck = r as usize;
                return Some(past);
            }
        }
        None
    }

    /// Returns the column from which row `r` of a mask in row `y` is past the first taken cells
    /// that it covers at `x`; `None` if it covers none.
    fn past(&self, mask: &Mask, r: usize, x: usize, y: usize) -> Option<usize> {
        for &[from, to] in mask.row(r) {
            let (from, to) = (from as usize, to as usize);
            let hit = self.next(y + r, x + from, true);
            if hit < x + to {
                return Some(self.next(y + r, hit, false) - from);
            }
        }
        None
    }

    pub(super) fn take(&mut self, mask: &Mask, x: usize, y: usize) {
        for r in 0..mask.height {
            let row = y + r;
            for &[from, to] in mask.row(r) {
                let cells = &mut self.bits[row * self.words..(row + 1) * self.words];
                fill(cells, x + from as usize, x + to as usize);
            }
            let (mut at, mut longest) = (0, 0);
            while at < self.side {
                let from = self.next(row, at, false);
                at = self.next(row, from, true);
                longest = longest.max(at - from);
            }
            self.free[row] = longest as u32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(side: f64) -> Vec<[DVec2; 2]> {
        let p = [DVec2::ZERO, side * DVec2::X, DVec2::splat(side), side * DVec2::Y];
        (0..4).map(|k| [p[k], p[(k + 1) % 4]]).collect()
    }

    #[test]
    fn a_square_grown_by_two_loses_its_corners() {
        let mask = Mask::rasterize(&square(6.0), DVec2::splat(6.0), 2.0);
        // rows 0..10; the corner cell (0, 0) is √2 away from the point (2, 2) at its nearest: taken
        assert_eq!((mask.width, mask.height), (10, 10));
        assert!((2..8).all(|y| mask.row(y) == [[0, 10]]));
        assert_eq!(mask.row(0), [[0, 10]]);
        let mask = Mask::rasterize(&square(6.0), DVec2::splat(6.0), 4.0);
        // grown by 4, cell (0, 0) reaches to (1, 1), 3 √2 = 4.24 away from (4, 4): free; (1, 0) is
        // √13 = 3.6
        assert_eq!(mask.row(0), [[1, 13]]);
        assert_eq!(mask.row(7), [[0, 14]]);
    }

    #[test]
    fn an_outline_with_a_hole_keeps_it_free() {
        let mut outline = square(20.0);
        outline.extend(square(10.0).iter().map(|s| s.map(|p| p + 5.0)));
        let mask = Mask::rasterize(&outline, DVec2::splat(20.0), 1.0);
        // the hole is 6..16, less one on each side
        assert_eq!(mask.row(11), [[0, 7], [15, 22]]);
        let mut page = Page::new(70);
        page.take(&mask, 0, 0);
        let small = Mask::rasterize(&square(6.0), DVec2::splat(6.0), 1.0);
        assert_eq!(page.find(&small, usize::MAX), Some((22, 0)));
        let tall = Mask::rasterize(&square(68.0), DVec2::splat(68.0), 1.0);
        assert_eq!(page.find(&tall, usize::MAX), None);
        page.take(&small, 22, 0);
        page.take(&small, 30, 0);
        assert_eq!(page.find(&small, usize::MAX), Some((38, 0)));
        assert_eq!(page.find(&small, 8), None);
    }

    #[test]
    fn what_a_page_finds_free_is_free_and_the_first_such_place() {
        let l_shape = |s: f64| -> Vec<[DVec2; 2]> {
            let p = [(0., 0.), (3., 0.), (3., 1.), (1., 1.), (1., 4.), (0., 4.)]
                .map(|(x, y)| s * DVec2::new(x, y));
            (0..6).map(|k| [p[k], p[(k + 1) % 6]]).collect()
        };
        let mut page = Page::new(100);
        let mut taken = vec![[false; 100]; 100];
        for i in 0..14 {
            let s = 3.0 + f64::from(i * 5 % 7);
            let mask = Mask::rasterize(&l_shape(s), s * DVec2::new(3.0, 4.0), 1.5);
            let fits = |x: usize, y: usize| {
                (0..mask.height)
                    .all(|r| mask.row(r).iter().all(|s| (s[0]..s[1]).all(|c| !taken[y + r][x + c as usize])))
            };
            let mut places =
                (0..=100 - mask.height).flat_map(|y| (0..=100 - mask.width).map(move |x| (x, y)));
            let first = places.find(|&(x, y)| fits(x, y));
            assert_eq!(page.find(&mask, usize::MAX), first, "{i}");
            if let Some((x, y)) = first {
                page.take(&mask, x, y);
                for r in 0..mask.height {
                    mask.row(r)
                        .iter()
                        .for_each(|s| (s[0]..s[1]).for_each(|c| taken[y + r][x + c as usize] = true));
                }
            }
        }
    }
}
