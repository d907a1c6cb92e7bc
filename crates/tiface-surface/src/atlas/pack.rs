//! Packing: charts turned, and placed one by one at the lowest free place, on the smallest square
//! they all fit.
//!
//! Shapes, not boxes, on a grid of cells; in each a chart is grown by the gutter before it takes
//! cells, so no two charts come closer than twice that. Each is turned to where its upper end is
//! lowest. Drawing the shapes is what costs, placing them takes a millisecond: so they are drawn
//! once, and many orders are tried, each a change to the best one so far, on squares that get
//! smaller cell by cell.

mod page;

use super::chart::Flat;
use glam::DVec2;
use page::{Mask, Page};
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
}
