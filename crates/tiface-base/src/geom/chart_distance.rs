//! How far the charts of an atlas are apart.

use super::boxes::{Boxes, DBox, DEFAULT_EFFORT, share_out};
use glam::DVec2;

/// A piece of a chart's outline, in texels.
#[derive(Clone, Copy, Debug)]
pub struct OutlineSide {
    /// Which chart.
    pub chart: u32,
    /// Its ends.
    pub from: DVec2,
    /// Its ends.
    pub to: DVec2,
}

/// Distance between charts.
pub struct ChartDistance {
    /// The smallest distance between sides of different charts, up to the given limit; `None` with
    /// fewer than two charts.
    pub distance: Option<f64>,
    /// Number of sides that were not compared with all neighbors: then the distance is an upper
    /// bound.
    pub left: usize,
}

/// Returns the smallest distance between sides of different charts, up to `farthest`, beyond which
/// it is given as that.
pub fn nearest_charts(sides: &[OutlineSide], farthest: f64) -> ChartDistance {
    if sides.iter().all(|s| s.chart == sides[0].chart) {
        return ChartDistance { distance: None, left: 0 };
    }
    let span = |s: &OutlineSide| DBox::around([s.from, s.to].map(|p| p.extend(0.0)));
    let boxes = Boxes::new(sides.iter().map(span));
    // Neighbors in the tree are mostly neighbors in the plane: a first bound, so that the search
    // has a short way to go.
    let order: Vec<u32> = boxes.order().collect();
    let mut bound = farthest;
    for near in order.windows(LEAF_NEIGHBORS) {
        let side = &sides[near[0] as usize];
        let others = near[1..].iter().map(|&i| &sides[i as usize]).filter(|s| s.chart != side.chart);
        bound = others.fold(bound, |nearest, other| nearest.min(distance(side, other)));
    }
    let shared = share_out(sides.len(), DEFAULT_EFFORT / 2, |i, effort| {
        let (side, mut nearest) = (&sides[i], bound);
        if nearest > 0.0 {
            boxes.meeting(&span(side).grown(bound), effort, |j, effort| {
                let other = &sides[j as usize];
                if side.chart < other.chart {
                    if !effort.spend(SIDE_DISTANCE_COST) {
                        return false;
                    }
                    nearest = nearest.min(distance(side, other));
                }
                nearest > 0.0
            });
        }
        nearest
    });
    let nearest = shared.found.into_iter().fold(bound, f64::min);
    // nothing is nearer than touching
    ChartDistance { distance: Some(nearest), left: if nearest > 0.0 { shared.unfinished.len() } else { 0 } }
}

/// Number of successive sides in the order of the tree that are compared first.
const LEAF_NEIGHBORS: usize = 8;

/// Cost of a distance of two sides, in comparisons of boxes.
const SIDE_DISTANCE_COST: usize = 8;

fn point_distance(p: DVec2, s: &OutlineSide) -> f64 {
    let along = s.to - s.from;
    let t = (p - s.from).dot(along) / along.length_squared();
    p.distance(s.from + along * if t.is_nan() { 0.0 } else { t.clamp(0.0, 1.0) })
}

fn distance(a: &OutlineSide, b: &OutlineSide) -> f64 {
    let turn = |s: &OutlineSide, p: DVec2| (s.to - s.from).perp_dot(p - s.from);
    if turn(a, b.from) * turn(a, b.to) < 0.0 && turn(b, a.from) * turn(b, a.to) < 0.0 {
        return 0.0; // they cross
    }
    let ends = [point_distance(a.from, b), point_distance(a.to, b), point_distance(b.from, a)];
    ends.into_iter().fold(point_distance(b.to, a), f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn side(chart: u32, p: [f64; 4]) -> OutlineSide {
        OutlineSide { chart, from: DVec2::new(p[0], p[1]), to: DVec2::new(p[2], p[3]) }
    }

    fn nearest(sides: &[OutlineSide], farthest: f64) -> Option<f64> {
        let ChartDistance { distance, left } = nearest_charts(sides, farthest);
        assert_eq!(left, 0);
        distance
    }

    #[test]
    fn distances_are_between_different_charts_only() {
        let a = side(0, [0.0, 0.0, 10.0, 0.0]);
        assert_eq!(nearest(&[a, side(0, [0.0, 1.0, 10.0, 1.0])], 64.0), None);
        assert_eq!(nearest(&[a, side(1, [3.0, 5.0, 3.0, 9.0])], 64.0), Some(5.0));
        assert_eq!(nearest(&[a, side(1, [3.0, -5.0, 3.0, 9.0])], 64.0), Some(0.0)); // crossing
        assert_eq!(nearest(&[a, side(1, [13.0, 4.0, 19.0, 4.0])], 64.0), Some(5.0)); // 3, 4, 5
        assert_eq!(nearest(&[a, side(1, [0.0, 900.0, 1.0, 900.0])], 64.0), Some(64.0));
        assert_eq!(nearest(&[], 64.0), None);
    }

    #[test]
    fn far_and_long_sides_agree_with_all_pairs() {
        // sides on two combs of slanted teeth
        let sides: Vec<OutlineSide> = (0..200)
            .map(|i| {
                let x = 3.0 * f64::from(i) + f64::from(i % 7);
                let chart = (i / 2) as u32;
                side(chart, [x, f64::from(i % 5), x + 900.0, 500.0 + 20.0 * f64::from(i)])
            })
            .collect();
        let mut least = f64::INFINITY;
        for a in &sides {
            for b in &sides {
                if a.chart != b.chart {
                    least = least.min(distance(a, b));
                }
            }
        }
        assert_eq!(nearest(&sides, 64.0), Some(least));
    }
}
