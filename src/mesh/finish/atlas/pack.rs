//! Packing: charts turned, and placed one by one at the lowest free place, on the smallest square they all fit.
//!
//! Shapes, not boxes, on a grid of cells; in each a chart is grown by the gutter before it takes cells, so no two
//! charts come closer than twice that. Each is turned to where its upper end is lowest. Drawing the shapes is what
//! costs, placing them takes a millisecond: so they are drawn once, and many orders are tried, each a change to the
//! best one so far, on squares that get smaller cell by cell.

use super::flat::Flat;
use super::raster::{Mask, Page};
use crate::kernel::cpu::rng::mix;
use crate::{Error, Monitor, Result};
use glam::DVec2;
use rayon::prelude::*;

/// Cells along the texture, about: between four and five texels each of 2048.
const CELLS: f64 = 448.0;

/// Turns tried for each chart; fewer where there are many charts.
const TURNS: usize = 16;

/// Orders tried, times charts.
const PLACED: usize = 2400;

/// The share of the texture that the first drawing is meant for.
const USED: f64 = 0.62;

/// Where a chart goes: turned by the angle whose cosine and sine these are, scaled, and moved.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct ChartPose {
    turn: DVec2,
    scale: f64,
    offset: DVec2,
}

impl ChartPose {
    /// In texels, y up.
    pub fn of(&self, p: DVec2) -> DVec2 {
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

/// Which chart goes where: turn, column and row of each.
type CellPlaces = Vec<(usize, usize, usize)>;

/// Places charts in a square texture: twice the gutter between any two of them and to the border. Where `stands` says
/// where up is in a chart, it is turned to the texture's up and no other way.
pub(super) fn pack(
    charts: &[Flat],
    stands: &[Option<DVec2>],
    size_px: f64,
    gutter_px: f64,
    monitor: &dyn Monitor,
) -> Result<Vec<ChartPose>> {
    let area: f64 = charts.iter().map(Flat::area).sum();
    let room = size_px - 2.0 * gutter_px;
    if !(area > 0.0 && area.is_finite() && room >= 1.0) {
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
    let turns = (16_000 / charts.len()).clamp(4, TURNS) / 4 * 4;
    let cells = CELLS.min(room);
    let mut used = USED;
    while used > 1e-3 {
        // Cells a unit, so that the texture is `cells` wide when `used` is right; it may become a fifth wider.
        let scale = cells * (used / area).sqrt() * size_px / room;
        let mut most = (1.2 * cells) as usize;
        let mut start = cells as usize;
        let mut found = None;
        // The first time with the gutter that the widest needs, then with that of the size found.
        for _ in 0..2 {
            let reach = gutter_px * most as f64 / room;
            let drawn = draw(&outlines, stands, scale, reach, turns);
            match smallest(&drawn, &mut order, start, most, monitor)? {
                Some((side, layout)) => {
                    (most, start) = (side, side);
                    found = Some((drawn, layout, side, reach));
                }
                None => break,
            }
        }
        if let Some((drawn, layout, side, reach)) = found {
            let cell = room / side as f64;
            let place = |(chart, &(turn, x, y)): (usize, &(usize, usize, usize))| {
                let TurnedMask { turn, low, .. } = drawn[chart][turn];
                // The page begins a gutter from the border, the chart its reach from its shape's corner.
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

/// Each chart in each direction, `scale` cells a unit.
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
        TurnedMask { mask: Mask::of(&sides, (high - low) * scale, reach), turn, low }
    };
    let every = |k: usize| DVec2::from_angle(std::f64::consts::TAU * k as f64 / turns as f64);
    let one = |(outline, stands): (&Vec<[DVec2; 2]>, &Option<DVec2>)| match stands {
        // as complex numbers, the turn that brings `up` to i
        Some(up) => vec![drawn(outline, DVec2::new(up.y, up.x))],
        None => (0..turns).map(|k| drawn(outline, every(k))).collect(),
    };
    outlines.par_iter().zip(stands).map(one).collect()
}

/// The smallest side found at which everything fits, from `start` on, at most `most`; `order` becomes the one that
/// did it.
fn smallest(
    drawn: &[Vec<TurnedMask>],
    order: &mut Vec<usize>,
    start: usize,
    most: usize,
    monitor: &dyn Monitor,
) -> Result<Option<(usize, CellPlaces)>> {
    let mut side = start;
    let mut best = loop {
        if let Some(layout) = lay_out(drawn, order, side) {
            break layout;
        }
        side += side / 40 + 1;
        if side > most {
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
    let tries = if count > 1 { (PLACED / count).clamp(8, 160) } else { 8 };
    let mut step = (side / 40).max(1);
    for _ in 0..tries {
        monitor.check_stop()?;
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
    use crate::monitor::{Quiet, Stopping};

    /// A rectangle of two triangles.
    fn rectangle(width: f64, height: f64) -> Flat {
        let p = |x: f64, y: f64| DVec2::new(x, y);
        Flat {
            triangles: vec![0, 1],
            corners: vec![[0, 1, 2], [0, 2, 3]],
            points: vec![p(0., 0.), p(width, 0.), p(width, height), p(0., height)],
        }
    }

    fn corners(chart: &Flat, place: &ChartPose) -> Vec<DVec2> {
        chart.points.iter().map(|&p| place.of(p)).collect()
    }

    #[test]
    fn a_square_fills_the_texture_but_for_two_gutters() {
        let chart = rectangle(3.0, 3.0);
        let places = pack(std::slice::from_ref(&chart), &[None], 256.0, 8.0, &Quiet).unwrap();
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
        let places = pack(&charts, &[None; 4], 512.0, 4.0, &Quiet).unwrap();
        let scale = places[0].scale;
        assert!(places.iter().all(|p| p.scale == scale));
        // (512 − 16) / 4 = 124 if side by side along their length; across (512 − 16 − 3 · 8) / 4 = 118
        assert!((112.0..118.1).contains(&scale), "{scale}");
        assert!(pack(&charts, &[None; 4], 512.0, 4.0, &Stopping).unwrap_err().kind().is_stop());
        assert!(pack(&charts, &[None; 4], 16.0, 8.0, &Quiet).unwrap_err().to_string().contains("do not fit"));
    }
}
