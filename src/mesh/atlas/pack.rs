//! Packing: charts turned, and placed one by one at the lowest free place, as large as all of them fit.
//!
//! Shapes, not boxes, on a grid of cells; in each a chart is grown by the gutter before it takes cells, so no two
//! charts come closer than twice that. Largest first, each turned to where its upper end is lowest.

use super::Refusal;
use super::flat::Flat;
use super::raster::{Mask, Page};
use glam::DVec2;
use rayon::prelude::*;

/// Cells along the texture: four texels each of 2048.
const CELLS: usize = 512;

/// Turns tried for each chart; fewer where there are many charts.
const TURNS: usize = 16;

/// Where a chart goes: turned by the angle whose sine and cosine these are, scaled, and moved.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Place {
    turn: DVec2,
    scale: f64,
    offset: DVec2,
}

impl Place {
    /// In texels, y up.
    pub fn of(&self, p: DVec2) -> DVec2 {
        self.turn.rotate(p) * self.scale + self.offset
    }
}

struct Shape {
    outline: Vec<[DVec2; 2]>,
    /// Half the outline's length: larger ones are placed earlier.
    rank: f64,
}

/// Places charts in a square texture: twice the gutter between any two of them and to the border.
pub(super) fn pack(
    charts: &[Flat],
    size_px: f64,
    gutter_px: f64,
    stop: &(dyn Fn() -> bool + Sync),
) -> Result<Vec<Place>, Refusal> {
    let area: f64 = charts.iter().map(Flat::area).sum();
    let room = size_px - 2.0 * gutter_px;
    if !(area > 0.0 && area.is_finite() && room >= 1.0) {
        return Err(Refusal::TooSmall);
    }
    let shapes: Vec<Shape> = charts
        .par_iter()
        .map(|chart| {
            let at = |i: u32| chart.points[i as usize];
            let outline: Vec<_> = chart.outline().into_iter().map(|(a, b)| [at(a), at(b)]).collect();
            let (low, high) = bounds(&outline, DVec2::X);
            Shape { outline, rank: (high - low).element_sum() }
        })
        .collect();
    let cells = CELLS.min(room as usize).max(1);
    let sheet = Sheet { cells, cell: room / cells as f64, gutter_px };
    let turns = (8000 / charts.len().max(1)).clamp(4, TURNS) / 4 * 4;

    // Shares of the texture covered: grow until it fails, then halve the bracket.
    let scale_of = |used: f64| (used * size_px * size_px / area).sqrt();
    let (mut low, mut high, mut used) = (0.0, 1.0, 0.6);
    let mut best = None;
    while high - low > 0.004 * high {
        if stop() {
            return Err(Refusal::Stopped);
        }
        match sheet.place(&shapes, scale_of(used), turns) {
            Some(places) => {
                (low, best) = (used, Some(places));
                used = if high < 1.0 { 0.5 * (low + high) } else { (used * 1.06).min(0.99) };
            }
            None => {
                high = used;
                used = if low > 0.0 { 0.5 * (low + high) } else { used * 0.85 };
            }
        }
        if high < 1e-3 {
            return Err(Refusal::TooSmall);
        }
    }
    best.ok_or(Refusal::TooSmall)
}

fn bounds(outline: &[[DVec2; 2]], turn: DVec2) -> (DVec2, DVec2) {
    let ends = outline.iter().map(|s| turn.rotate(s[0]));
    ends.fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(low, high), p| (low.min(p), high.max(p)))
}

struct Sheet {
    cells: usize,
    /// Texels along a cell.
    cell: f64,
    gutter_px: f64,
}

impl Sheet {
    fn place(&self, shapes: &[Shape], scale: f64, turns: usize) -> Option<Vec<Place>> {
        let reach = self.gutter_px / self.cell;
        let masks: Vec<Vec<(Mask, DVec2, DVec2)>> = shapes
            .par_iter()
            .map(|shape| {
                (0..turns)
                    .map(|k| {
                        let turn = DVec2::from_angle(std::f64::consts::TAU * k as f64 / turns as f64);
                        let (low, high) = bounds(&shape.outline, turn);
                        let to_cells = |p: DVec2| (turn.rotate(p) - low) * (scale / self.cell);
                        let outline: Vec<_> = shape.outline.iter().map(|s| s.map(to_cells)).collect();
                        (Mask::of(&outline, (high - low) * (scale / self.cell), reach), turn, low)
                    })
                    .collect()
            })
            .collect();
        let mut order: Vec<usize> = (0..shapes.len()).collect();
        order.sort_by(|&a, &b| shapes[b].rank.total_cmp(&shapes[a].rank));
        let mut page = Page::new(self.cells);
        let mut places = vec![Place::default(); shapes.len()];
        for i in order {
            let mut best = None;
            let mut limit = usize::MAX;
            for (k, (mask, ..)) in masks[i].iter().enumerate() {
                if let Some((x, y)) = page.find(mask, limit) {
                    limit = y + mask.height;
                    best = Some((k, x, y));
                }
            }
            let (k, x, y) = best?;
            let (mask, turn, low) = &masks[i][k];
            page.take(mask, x, y);
            // the grown shape may begin where the texture's border leaves one gutter
            let corner = DVec2::new(x as f64, y as f64) * self.cell + 2.0 * self.gutter_px;
            places[i] = Place { turn: *turn, scale, offset: corner - *low * scale };
        }
        Some(places)
    }
}
