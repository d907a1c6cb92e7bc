//! The border of a chart, which may neither cross nor touch itself.

use glam::DVec2;
use std::collections::HashSet;

/// Distance that sides of a border keep, over the chart's extent: a hundred times what its points
/// move when they are rounded to f32. Sides that touch would share area then.
const APART: f64 = 1e-5;

/// The border of a chart, which may neither cross nor touch itself.
pub(super) struct Border {
    /// Ends of its sides; empty where it crosses itself from the start.
    sides: Vec<(u32, u32)>,
    /// Distance that they keep.
    apart: f64,
    /// Pairs of sides that are nearer from the start: these may only not cross.
    near: HashSet<(u32, u32)>,
}

impl Border {
    pub(super) fn new(sides: Vec<(u32, u32)>, points: &[DVec2]) -> Border {
        let mut border = Border { sides, apart: 0.0, near: HashSet::new() };
        if !border.meeting(points).is_empty() {
            border.sides.clear();
        }
        let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        points.iter().for_each(|p| (low, high) = (low.min(*p), high.max(*p)));
        border.apart = APART * (high - low).max_element();
        border.near = border.meeting(points).into_iter().collect();
        border
    }

    /// Returns the ends of all sides that meet another one.
    pub(super) fn crossing(&self, points: &[DVec2]) -> Vec<u32> {
        let ends = |side: u32| <[u32; 2]>::from(self.sides[side as usize]);
        self.meeting(points).into_iter().flat_map(|(a, b)| [ends(a), ends(b)]).flatten().collect()
    }

    /// Returns the pairs of sides that cross or come too near, the first side of each first.
    fn meeting(&self, points: &[DVec2]) -> Vec<(u32, u32)> {
        let at = |(a, b): (u32, u32)| [points[a as usize], points[b as usize]];
        let mut sides: Vec<([DVec2; 2], u32)> = self.sides.iter().map(|&s| at(s)).zip(0..).collect();
        let range = |s: &[DVec2; 2], axis: usize| [s[0][axis].min(s[1][axis]), s[0][axis].max(s[1][axis])];
        sides.sort_by(|a, b| range(&a.0, 0)[0].total_cmp(&range(&b.0, 0)[0]));
        let mut found = Vec::new();
        for (k, (p, i)) in sides.iter().enumerate() {
            let (last, [low, high]) = (range(p, 0)[1] + self.apart, range(p, 1));
            let beside = sides[k + 1..].iter().take_while(|(q, _)| range(q, 0)[0] <= last);
            for (q, j) in beside {
                let [least, most] = range(q, 1);
                if least > high + self.apart || most < low - self.apart {
                    continue;
                }
                let pair = (*i.min(j), *i.max(j));
                if crosses(*p, *q) || (touches(*p, *q, self.apart) && !self.near.contains(&pair)) {
                    found.push(pair);
                }
            }
        }
        found
    }
}

/// Returns whether two segments meet in a point within both.
fn crosses([a, b]: [DVec2; 2], [c, d]: [DVec2; 2]) -> bool {
    let side = |p: DVec2, q: DVec2, r: DVec2| (q - p).perp_dot(r - p);
    side(a, b, c) * side(a, b, d) < 0.0 && side(c, d, a) * side(c, d, b) < 0.0
}

/// Returns whether an end of one of two segments is less than a distance from the other one; an end
/// that both have does not count.
fn touches([a, b]: [DVec2; 2], [c, d]: [DVec2; 2], apart: f64) -> bool {
    let near = |p: DVec2, q: DVec2, r: DVec2| {
        let (along, from) = (r - q, p - q);
        let share = (from.dot(along) / along.length_squared()).clamp(0.0, 1.0);
        p != q && p != r && from.distance_squared(share * along) < apart * apart
    };
    near(a, c, d) || near(b, c, d) || near(c, a, b) || near(d, a, b)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_border_may_touch_nothing_but_its_neighbors() {
        let p = |x: f64, y: f64| DVec2::new(x, y);
        let mut points = [p(0., 0.), p(4., 0.), p(4., 4.), p(2., 1.), p(0., 4.)];
        let border = Border::new((0..5).map(|i| (i, (i + 1) % 5)).collect(), &points);
        assert!(border.crossing(&points).is_empty());
        // the dent through the lower side: both of its sides cross that one
        points[3] = p(2., -0.1);
        let mut found = border.crossing(&points);
        found.sort_unstable();
        found.dedup();
        assert_eq!(found, [0, 1, 2, 3, 4]);
        // what crosses itself from the start may go on
        assert!(Border::new(border.sides, &points).crossing(&points).is_empty());
    }

    #[test]
    fn sides_of_a_border_keep_a_distance_unless_they_begin_nearer() {
        // a dent that ends just above the lower side, whose length is 4: sides keep 4e-5
        let p = |x: f64, y: f64| DVec2::new(x, y);
        let dented = |y: f64| [p(0., 0.), p(4., 0.), p(4., 4.), p(2., y), p(0., 4.)];
        let border = |points: &[DVec2]| Border::new((0..5).map(|i| (i, (i + 1) % 5)).collect(), points);
        let far = border(&dented(1.0));
        assert!(far.crossing(&dented(5e-5)).is_empty());
        let mut found = far.crossing(&dented(3e-5));
        found.sort_unstable();
        found.dedup();
        assert_eq!(found, [0, 1, 2, 3, 4]);
        let near = border(&dented(1e-5));
        assert!(near.crossing(&dented(2e-6)).is_empty() && !near.crossing(&dented(-1e-6)).is_empty());
        // two sides that have an end in common must not close like scissors
        let scissors = |y: f64| [p(0., 0.), p(4., 0.), p(1., y), p(4., 4.), p(0., 4.)];
        let open = border(&scissors(1.0));
        assert!(open.crossing(&scissors(0.1)).is_empty() && !open.crossing(&scissors(2e-5)).is_empty());
    }
}
