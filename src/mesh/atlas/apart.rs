//! How far the charts of an atlas are apart.

use glam::DVec2;
use rayon::prelude::*;

/// A piece of a chart's outline, in texels.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Side {
    /// Which chart.
    pub chart: u32,
    /// Its ends.
    pub from: DVec2,
    /// Its ends.
    pub to: DVec2,
}

/// The smallest distance between sides of different charts, up to `farthest`, beyond which it is given as
/// that; none when there are no two charts.
pub(crate) fn nearest_charts(sides: &[Side], farthest: f64) -> Option<f64> {
    sides.iter().find(|s| s.chart != sides[0].chart)?;
    // Cells as wide as the reach: what lies within it is in the neighbouring cells. Most atlases have their
    // answer within a few texels, so the reach starts there.
    let mut reach = 2.0f64.min(farthest);
    loop {
        let found = within(sides, reach);
        if found <= reach {
            return Some(found);
        }
        if reach >= farthest {
            return Some(farthest);
        }
        reach = (4.0 * reach).min(farthest);
    }
}

/// The smallest distance, exact where it is at most `reach`.
fn within(sides: &[Side], reach: f64) -> f64 {
    let cell = |v: f64| (v / reach).floor().clamp(-1e9, 1e9) as i32;
    // (cell row, cell column, side), a side in every cell that its box touches
    let mut placed: Vec<(i32, i32, u32)> = Vec::with_capacity(2 * sides.len());
    for (i, s) in sides.iter().enumerate() {
        let (low, high) = (s.from.min(s.to), s.from.max(s.to));
        // Coordinates far out of the texture, or a texture of nothing but texture-wide triangles: no gutter
        // is asked of those.
        if (high - low).max_element() > 16384.0 * reach || placed.len() > 1 << 26 {
            continue;
        }
        for y in cell(low.y)..=cell(high.y) {
            // the stretch of the side in this row of cells
            let at = |y: f64| s.from + (s.to - s.from) * ((y - s.from.y) / (s.to.y - s.from.y));
            let (above, below) = (reach * f64::from(y), reach * f64::from(y + 1));
            let (x0, x1) = if low.y >= above && high.y <= below {
                (low.x, high.x)
            } else {
                let (p, q) = (at(above.max(low.y)).x, at(below.min(high.y)).x);
                (p.min(q), p.max(q))
            };
            for x in cell(x0)..=cell(x1) {
                placed.push((y, x, i as u32));
            }
        }
    }
    placed.par_sort_unstable();
    let row_of = |y: i32, x0: i32, x1: i32| {
        let from = placed.partition_point(|p| (p.0, p.1) < (y, x0));
        let to = placed.partition_point(|p| (p.0, p.1) <= (y, x1));
        &placed[from..to]
    };
    placed
        .chunk_by(|a, b| (a.0, a.1) == (b.0, b.1))
        .collect::<Vec<_>>()
        .par_iter()
        .map(|own| {
            let (y, x, _) = own[0];
            let mut least = f64::INFINITY;
            for row in y - 1..=y + 1 {
                for &(_, _, j) in row_of(row, x - 1, x + 1) {
                    let other = &sides[j as usize];
                    for &(_, _, i) in own.iter() {
                        let side = &sides[i as usize];
                        if side.chart < other.chart {
                            least = least.min(distance(side, other));
                        }
                    }
                }
            }
            least
        })
        .reduce(|| f64::INFINITY, f64::min)
}

fn point_distance(p: DVec2, s: &Side) -> f64 {
    let along = s.to - s.from;
    let t = (p - s.from).dot(along) / along.length_squared();
    p.distance(s.from + along * if t.is_nan() { 0.0 } else { t.clamp(0.0, 1.0) })
}

fn distance(a: &Side, b: &Side) -> f64 {
    let turn = |s: &Side, p: DVec2| (s.to - s.from).perp_dot(p - s.from);
    if turn(a, b.from) * turn(a, b.to) < 0.0 && turn(b, a.from) * turn(b, a.to) < 0.0 {
        return 0.0; // they cross
    }
    let ends = [point_distance(a.from, b), point_distance(a.to, b), point_distance(b.from, a)];
    ends.into_iter().fold(point_distance(b.to, a), f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn side(chart: u32, p: [f64; 4]) -> Side {
        Side { chart, from: DVec2::new(p[0], p[1]), to: DVec2::new(p[2], p[3]) }
    }

    #[test]
    fn distances_are_between_different_charts_only() {
        let a = side(0, [0.0, 0.0, 10.0, 0.0]);
        assert_eq!(nearest_charts(&[a, side(0, [0.0, 1.0, 10.0, 1.0])], 64.0), None);
        assert_eq!(nearest_charts(&[a, side(1, [3.0, 5.0, 3.0, 9.0])], 64.0), Some(5.0));
        assert_eq!(nearest_charts(&[a, side(1, [3.0, -5.0, 3.0, 9.0])], 64.0), Some(0.0)); // crossing
        assert_eq!(nearest_charts(&[a, side(1, [13.0, 4.0, 19.0, 4.0])], 64.0), Some(5.0)); // 3, 4, 5
        assert_eq!(nearest_charts(&[a, side(1, [0.0, 900.0, 1.0, 900.0])], 64.0), Some(64.0));
        assert_eq!(nearest_charts(&[], 64.0), None);
    }

    #[test]
    fn far_and_long_sides_agree_with_all_pairs() {
        // sides on two combs of slanted teeth
        let sides: Vec<Side> = (0..200)
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
        assert_eq!(nearest_charts(&sides, 64.0), Some(least));
    }
}
