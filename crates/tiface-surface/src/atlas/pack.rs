//! Packing: charts turned, and placed one by one at the lowest free place, on the smallest square
//! they all fit.
//!
//! Shapes, not boxes, on a grid of cells; in each a chart is grown by the gutter before it takes
//! cells, so no two charts come closer than twice that. Each is turned to where its upper end is
//! lowest. Drawing the shapes is what costs, placing them takes a millisecond: so they are drawn
//! once, and many orders are tried, each a change to the best one so far, on squares that get
//! smaller cell by cell.
//!
//! Shapes of charts on a grid of cells: every cell that a chart grown by its gutter touches.

use super::chart::Flat;
use glam::DVec2;
use rayon::prelude::*;
use tiface_base::math::rng::mix;
use tiface_base::{Error, Monitor, Result};

/// Cells along the texture, about: between four and five texels each of 2048.
const GRID_CELLS: f64 = 448.0;

/// Maximum number of rotations tried for each chart; fewer are tried if the atlas has many charts.
const MAX_ROTATIONS: usize = 16;

/// Orders tried, times charts.
const PLACEMENT_BUDGET: usize = 2400;

/// The share of the texture that the first drawing is meant for.
pub(super) const INITIAL_FILL: f64 = 0.62;

/// Pose of a chart: turned by the angle with this cosine and sine, scaled, and moved.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct ChartPose {
    turn: DVec2,
    scale: f64,
    offset: DVec2,
}

impl ChartPose {
    /// Returns where a point of the chart lies, in texels, y up.
    pub fn place(&self, p: DVec2) -> DVec2 {
        self.turn.rotate(p) * self.scale + self.offset
    }
}

/// A chart as drawn in one direction.
struct TurnedMask {
    mask: Mask,
    turn: DVec2,
    /// Lowest coordinates of the turned chart.
    low: DVec2,
}

/// Cells of the charts: turn, column and row of each.
type CellPlaces = Vec<(usize, usize, usize)>;

/// Places charts in a square texture: twice the gutter between any two of them and to the border.
/// Where `stands` says where up is in a chart, it is turned to the texture's up and no other way. A
/// unit becomes at most `limit` texels.
pub(super) fn pack(
    charts: &[Flat],
    stands: &[Option<DVec2>],
    limit: f64,
    [size_px, gutter_px]: [f64; 2],
    monitor: &dyn Monitor,
) -> Result<Vec<ChartPose>> {
    let area: f64 = charts.iter().map(Flat::area).sum();
    let inner_px = size_px - 2.0 * gutter_px;
    if !(area > 0.0 && area.is_finite() && inner_px >= 1.0) {
        return Err(too_small());
    }
    let outlines: Vec<Vec<[DVec2; 2]>> = charts
        .par_iter()
        .map(|chart| {
            let at = |i: u32| chart.points[i as usize];
            chart.outline().into_iter().map(|(a, b)| [at(a), at(b)]).collect()
        })
        .collect();
    // charts from the one with the largest box to the smallest
    let size = |(low, high): (DVec2, DVec2)| (high - low).element_sum();
    let sizes: Vec<f64> = outlines.iter().map(|o| size(bounds(o, DVec2::X))).collect();
    let mut order: Vec<usize> = (0..charts.len()).collect();
    order.sort_by(|&a, &b| sizes[b].total_cmp(&sizes[a]));
    let turns = (16_000 / charts.len()).clamp(4, MAX_ROTATIONS) / 4 * 4;
    let cells = GRID_CELLS.min(inner_px);
    let first = INITIAL_FILL.min(limit * limit * area / (size_px * size_px));
    let mut used = first;
    while used > 1e-3 * first {
        // Cells a unit, so that the texture is `cells` wide when `used` is right; it may become a
        // fifth wider.
        let scale = cells * (used / area).sqrt() * size_px / inner_px;
        let mut max_side = (1.2 * cells) as usize;
        let least = (scale * inner_px / limit).ceil() as usize;
        let mut start = (cells as usize).max(least);
        let mut found = None;
        // The first time with the gutter that the widest needs, then with that of the size found.
        for _ in 0..2 {
            let reach = gutter_px * max_side as f64 / inner_px;
            let drawn = draw(&outlines, stands, scale, reach, turns);
            match smallest(&drawn, &mut order, [least, start, max_side], monitor)? {
                Some((side, layout)) => {
                    (max_side, start) = (side, side);
                    found = Some((drawn, layout, side, reach));
                }
                None => break,
            }
        }
        if let Some((drawn, layout, side, reach)) = found {
            let cell = inner_px / side as f64;
            let place = |(chart, &(turn, x, y)): (usize, &(usize, usize, usize))| {
                let TurnedMask { turn, low, .. } = drawn[chart][turn];
                // The page begins a gutter from the border, the chart its reach from its shape's
                // corner.
                let corner = (DVec2::new(x as f64, y as f64) + reach) * cell + gutter_px;
                ChartPose { turn, scale: scale * cell, offset: corner - low * (scale * cell) }
            };
            return Ok(layout.iter().enumerate().map(place).collect());
        }
        used *= 0.7;
    }
    Err(too_small())
}

fn bounds(outline: &[[DVec2; 2]], turn: DVec2) -> (DVec2, DVec2) {
    let ends = outline.iter().map(|s| turn.rotate(s[0]));
    ends.fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(low, high), p| (low.min(p), high.max(p)))
}

/// Returns each chart in each direction, `scale` cells a unit.
fn draw(
    outlines: &[Vec<[DVec2; 2]>],
    stands: &[Option<DVec2>],
    scale: f64,
    reach: f64,
    turns: usize,
) -> Vec<Vec<TurnedMask>> {
    let drawn = |outline: &[[DVec2; 2]], turn: DVec2| {
        let (low, high) = bounds(outline, turn);
        let sides: Vec<_> = outline.iter().map(|s| s.map(|p| (turn.rotate(p) - low) * scale)).collect();
        TurnedMask { mask: Mask::rasterize(&sides, (high - low) * scale, reach), turn, low }
    };
    let every = |k: usize| DVec2::from_angle(std::f64::consts::TAU * k as f64 / turns as f64);
    let one = |(outline, stands): (&Vec<[DVec2; 2]>, &Option<DVec2>)| match stands {
        // as complex numbers, the turn that brings `up` to i
        Some(up) => vec![drawn(outline, DVec2::new(up.y, up.x))],
        None => (0..turns).map(|k| drawn(outline, every(k))).collect(),
    };
    outlines.par_iter().zip(stands).map(one).collect()
}

/// Returns the smallest side found at which everything fits, of `least` at least, from `start` on,
/// of `max_side` at most; `order` becomes the one that did it.
fn smallest(
    drawn: &[Vec<TurnedMask>],
    order: &mut Vec<usize>,
    [least, start, max_side]: [usize; 3],
    monitor: &dyn Monitor,
) -> Result<Option<(usize, CellPlaces)>> {
    let mut side = start;
    let mut best = loop {
        if let Some(layout) = lay_out(drawn, order, side) {
            break layout;
        }
        side += side / 40 + 1;
        if side > max_side {
            return Ok(None);
        }
    };
    let count = order.len();
    // numbers without a pattern, the same every time (SplitMix64)
    let mut state = count as u64;
    let mut below = |n: usize| {
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        (mix(state) % n as u64) as usize
    };
    let tries = if count > 1 { (PLACEMENT_BUDGET / count).clamp(8, 160) } else { 8 };
    let mut step = (side / 40).max(1);
    for _ in 0..tries {
        monitor.check_stop()?;
        step = step.min(side - least);
        if step == 0 {
            break;
        }
        let mut trial = order.clone();
        if step == 1 && count > 1 {
            let i = below(count);
            let j = (i + 1 + below(count.div_ceil(3))) % count;
            trial.swap(i, j);
        }
        match lay_out(drawn, &trial, side.saturating_sub(step)) {
            Some(layout) => (side, best, *order) = (side - step, layout, trial),
            None => step = (step / 2).max(1),
        }
    }
    Ok(Some((side, best)))
}

/// Places charts one after the other on a square of `side` cells.
fn lay_out(drawn: &[Vec<TurnedMask>], order: &[usize], side: usize) -> Option<CellPlaces> {
    let mut page = Page::new(side);
    let mut layout = vec![(0, 0, 0); drawn.len()];
    for &chart in order {
        let mut limit = usize::MAX;
        let mut place = None;
        for (turn, TurnedMask { mask, .. }) in drawn[chart].iter().enumerate() {
            if let Some((x, y)) = page.find(mask, limit) {
                limit = y + mask.height;
                place = Some((turn, x, y));
            }
        }
        let (turn, x, y) = place?;
        page.take(&drawn[chart][turn].mask, x, y);
        layout[chart] = (turn, x, y);
    }
    Some(layout)
}

fn too_small() -> Error {
    Error::cannot("the charts do not fit into the texture", "")
}

/// A chart's shape: its width and height in cells and, row by row, which of them are taken.
#[derive(Clone, Debug, Default)]
struct Mask {
    width: usize,
    height: usize,
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
    fn rasterize(outline: &[[DVec2; 2]], high: DVec2, reach: f64) -> Mask {
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

/// `0..n` by halving: 0, n − 1, the middle, the quarters, ...
fn coarse_to_fine(n: usize) -> Vec<u32> {
    let mut order: Vec<u32> = (0..n as u32).collect();
    // more trailing zeros come first; the sort is stable
    order.sort_by_key(|&i| if i == 0 || i as usize + 1 == n { 0 } else { 32 - i.trailing_zeros() });
    order
}

/// The texture as a grid of cells, taken or free.
struct Page {
    side: usize,
    words: usize,
    bits: Vec<u64>,
    /// Longest run of free cells in each row.
    free: Vec<u32>,
}

impl Page {
    fn new(side: usize) -> Page {
        let words = side.div_ceil(64);
        Page { side, words, bits: vec![0; words * side], free: vec![side as u32; side] }
    }

    /// Returns the first cell of a row from x on that is taken (or free); `side` if none is.
    fn next(&self, y: usize, x: usize, taken: bool) -> usize {
        next(&self.bits[y * self.words..(y + 1) * self.words], x, self.side, taken)
    }

    /// Returns the lowest and then leftmost place for a mask whose upper end stays below `limit`.
    fn find(&self, mask: &Mask, limit: usize) -> Option<(usize, usize)> {
        if mask.width > self.side || mask.height > self.side {
            return None;
        }
        let (mut stuck, mut narrow) = (0, 0);
        for y in 0..=self.side - mask.height {
            if y + mask.height >= limit {
                return None;
            }
            let too_narrow = |r: usize| self.free[y + r] < mask.longest[r];
            if too_narrow(narrow) {
                continue;
            }
            if let Some(r) = (0..mask.height).find(|&r| too_narrow(r)) {
                narrow = r;
                continue;
            }
            let mut x = 0;
            'x: while x + mask.width <= self.side {
                // the row that was in the way before most likely is again
                let rows = std::iter::once(stuck).chain(mask.order.iter().map(|&r| r as usize));
                for r in rows {
                    for &[from, to] in mask.row(r) {
                        let (from, to) = (from as usize, to as usize);
                        let hit = self.next(y + r, x + from, true);
                        if hit < x + to {
                            stuck = r;
                            x = self.next(y + r, hit, false) - from;
                            continue 'x;
                        }
                    }
                }
                return Some((x, y));
            }
        }
        None
    }

    fn take(&mut self, mask: &Mask, x: usize, y: usize) {
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
    use crate::fixtures::Stopping;
    use tiface_base::Quiet;

    /// Returns a rectangle of two triangles.
    fn rectangle(width: f64, height: f64) -> Flat {
        let p = |x: f64, y: f64| DVec2::new(x, y);
        Flat {
            triangles: vec![0, 1],
            corners: vec![[0, 1, 2], [0, 2, 3]],
            points: vec![p(0., 0.), p(width, 0.), p(width, height), p(0., height)],
        }
    }

    fn corners(chart: &Flat, place: &ChartPose) -> Vec<DVec2> {
        chart.points.iter().map(|&p| place.place(p)).collect()
    }

    #[test]
    fn a_square_fills_the_texture_but_for_two_gutters() {
        let chart = rectangle(3.0, 3.0);
        let places =
            pack(std::slice::from_ref(&chart), &[None], f64::INFINITY, [256.0, 8.0], &Quiet).unwrap();
        let p = corners(&chart, &places[0]);
        let low = p.iter().fold(DVec2::INFINITY, |m, p| m.min(*p));
        let high = p.iter().fold(DVec2::NEG_INFINITY, |m, p| m.max(*p));
        // 16..240, less the cell (one texel here) it is rounded to
        assert!(low.min_element() > 16.0 - 1e-9 && high.max_element() < 240.0 + 1e-9, "{low} {high}");
        assert!((high - low).min_element() > 220.0, "{low} {high}");
    }

    #[test]
    fn four_strips_lie_side_by_side_at_one_scale() {
        // 4 × 1 each: together a square
        let charts = vec![rectangle(4.0, 1.0); 4];
        let places = pack(&charts, &[None; 4], f64::INFINITY, [512.0, 4.0], &Quiet).unwrap();
        let scale = places[0].scale;
        assert!(places.iter().all(|p| p.scale == scale));
        // (512 − 16) / 4 = 124 if side by side along their length; across (512 − 16 − 3 · 8) / 4 =
        // 118
        assert!((112.0..118.1).contains(&scale), "{scale}");
        assert!(
            pack(&charts, &[None; 4], f64::INFINITY, [512.0, 4.0], &Stopping).unwrap_err().kind().is_stop()
        );
        assert!(
            pack(&charts, &[None; 4], f64::INFINITY, [16.0, 8.0], &Quiet)
                .unwrap_err()
                .to_string()
                .contains("do not fit")
        );
    }

    #[test]
    fn charts_grow_up_to_the_limit() {
        let charts = vec![rectangle(4.0, 1.0); 4];
        for limit in [3.0, 40.0, 100.0] {
            let places = pack(&charts, &[None; 4], limit, [512.0, 4.0], &Quiet).unwrap();
            assert!(places.iter().all(|p| p.scale <= limit && p.scale > 0.9 * limit), "{limit}");
            let all: Vec<DVec2> = charts.iter().zip(&places).flat_map(|(c, p)| corners(c, p)).collect();
            assert!(all.iter().all(|p| p.min_element() > 8.0 - 1e-9 && p.max_element() < 504.0 + 1e-9));
        }
    }

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
