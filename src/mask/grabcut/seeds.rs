//! What clicks make certain: seeds of head and background, and the Voronoi start between them.

use super::super::clicks::Click;
use super::super::distance::squared_distance;

/// Radius of the definite disc around a click, as a share of the picture's height.
const SEED_RADIUS: f32 = 0.012;

/// … and at least this many working pixels.
const MIN_SEED_RADIUS_PX: f32 = 4.0;

/// Width of the border margins along top and sides that are certainly background, share of the
/// height.
pub(in crate::mask) const BORDER_MARGIN: f32 = 0.012;

/// Height of the border margins at the sides, as a share of the picture's height; shoulders may
/// touch the rest.
const BORDER_SIDES: f32 = 0.6;

/// Radius of the discs around head clicks in the start, share of the height.
const START_RADIUS: f32 = 0.06;

/// Width of the line that joins head clicks in the start, share of the height.
const START_LINE: f32 = 0.02;

/// The background's first colors come from pixels this many times nearer to definite background
/// than to the head's clicks; what lies between would teach it the colors of hair.
const START_DISTANCE_RATIO: f32 = 2.0;

/// A definite label of a pixel, or none.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::mask) enum Seed {
    Unknown,
    Head,
    Background,
}

/// Marks the pixels whose center is within `radius` of the segment from `a` to `b`.
fn draw(marked: &mut [bool], width: usize, height: usize, a: (f32, f32), b: (f32, f32), radius: f32) {
    let range = |u: f32, v: f32, size: usize| {
        let first = (u.min(v) - radius).floor().clamp(0.0, size as f32) as usize;
        let end = ((u.max(v) + radius).ceil() + 1.0).clamp(0.0, size as f32) as usize;
        first..end
    };
    let (dx, dy) = (b.0 - a.0, b.1 - a.1);
    let length = dx * dx + dy * dy;
    for y in range(a.1, b.1, height) {
        for x in range(a.0, b.0, width) {
            let (px, py) = (x as f32 - a.0, y as f32 - a.1);
            let t = if length > 0.0 { ((px * dx + py * dy) / length).clamp(0.0, 1.0) } else { 0.0 };
            let (ex, ey) = (px - t * dx, py - t * dy);
            if ex * ex + ey * ey <= radius * radius {
                marked[y * width + x] = true;
            }
        }
    }
}

/// Returns what is certain from the clicks, with a border margin of this share of the height:
/// `[height · width]`, and warnings about clicks in each other's way.
pub(super) fn from_clicks(
    view: &str,
    clicks: &[Click],
    width: usize,
    height: usize,
    margin: f32,
) -> (Vec<Seed>, Vec<String>) {
    let mut seeds = border(width, height, margin);
    let radius = (SEED_RADIUS * height as f32).max(MIN_SEED_RADIUS_PX);
    let mut warnings = Vec::new();
    // where discs of both kinds overlap the nearer click is believed
    let mut nearest = vec![f32::INFINITY; width * height];
    let mut near = vec![false; width * height];
    for c in clicks {
        near.fill(false);
        draw(&mut near, width, height, (c.x, c.y), (c.x, c.y), radius);
        // a click is worth its own pixel at least
        let own = |v: f32, size: usize| (v.round().max(0.0) as usize).min(size - 1);
        near[own(c.y, height) * width + own(c.x, width)] = true;
        for i in (0..near.len()).filter(|&i| near[i]) {
            let (dx, dy) = ((i % width) as f32 - c.x, (i / width) as f32 - c.y);
            let d = dx * dx + dy * dy;
            if d < nearest[i] {
                nearest[i] = d;
                seeds[i] = if c.head { Seed::Head } else { Seed::Background };
            }
        }
    }
    let mut close = Vec::new();
    for (i, a) in clicks.iter().enumerate() {
        for (j, b) in clicks.iter().enumerate().skip(i + 1) {
            let (dx, dy) = (a.x - b.x, a.y - b.y);
            if a.head != b.head && dx * dx + dy * dy < 4.0 * radius * radius {
                close.push((i + 1, j + 1, (dx * dx + dy * dy).sqrt()));
            }
        }
    }
    // one sentence a view for any number of pairs
    if let Some((i, j, apart)) = close.first() {
        let more = match close.len() {
            1 => String::new(),
            n => format!(", and so do {} more pairs", n - 1),
        };
        warnings.push(format!(
            "view `{view}`: clicks {i} and {j} call places {apart:.0} pixels apart head and background{more}; are both right?"
        ));
    }
    (seeds, warnings)
}

/// Returns the margins along the borders where no head is expected.
fn border(width: usize, height: usize, margin: f32) -> Vec<Seed> {
    let margin = (margin * height as f32).ceil() as usize;
    let sides = (BORDER_SIDES * height as f32) as usize;
    (0..width * height)
        .map(|i| {
            let (x, y) = (i % width, i / width);
            if y < margin || (y < sides && (x < margin || x + margin >= width)) {
                Seed::Background
            } else {
                Seed::Unknown
            }
        })
        .collect()
}

/// Returns the head's clicks as discs, joined by a line in their order: what the start measures
/// distances from.
pub(super) fn skeleton(seeds: &[Seed], clicks: &[Click], width: usize, height: usize) -> Vec<bool> {
    let h = height as f32;
    let mut skeleton: Vec<bool> = seeds.iter().map(|k| *k == Seed::Head).collect();
    let head: Vec<(f32, f32)> = clicks.iter().filter(|c| c.head).map(|c| (c.x, c.y)).collect();
    for &p in &head {
        draw(&mut skeleton, width, height, p, p, START_RADIUS * h);
    }
    for pair in head.windows(2) {
        draw(&mut skeleton, width, height, pair[0], pair[1], 0.5 * START_LINE * h);
    }
    skeleton
}

/// Returns the Voronoi start, twice `[height · width]`: whether a pixel is nearer to the skeleton
/// than to definite background, and false where it is so much nearer to definite background that
/// its color is taken for the background's.
pub(super) fn start(seeds: &[Seed], skeleton: &[bool], width: usize, height: usize) -> [Vec<bool>; 2] {
    let background: Vec<bool> = seeds.iter().map(|k| *k == Seed::Background).collect();
    let to_head = squared_distance(skeleton, width, height);
    let to_background = squared_distance(&background, width, height);
    [1.0, START_DISTANCE_RATIO].map(|times: f32| {
        let nearer = |i: usize| match seeds[i] {
            Seed::Head => true,
            Seed::Background => false,
            Seed::Unknown => to_head[i] < times * times * to_background[i],
        };
        (0..seeds.len()).map(nearer).collect()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn click(x: f32, y: f32, head: bool) -> Click {
        Click { x, y, head }
    }

    #[test]
    fn clicks_close_together_share_their_discs_and_are_warned_about() {
        let clicks = [click(10.0, 10.0, true), click(15.0, 10.0, false)];
        let (seeds, warnings) = from_clicks("a", &clicks, 40, 30, 0.0);
        // discs of 4 pixels, 5 apart: 12 is nearer to the head, 13 to the background
        assert_eq!((seeds[10 * 40 + 12], seeds[10 * 40 + 13]), (Seed::Head, Seed::Background));
        assert_eq!((seeds[10 * 40 + 6], seeds[10 * 40 + 5]), (Seed::Head, Seed::Unknown));
        assert_eq!(warnings.len(), 1);
        assert!(warnings[0].contains("clicks 1 and 2") && warnings[0].contains("5 pixels"));
    }

    #[test]
    fn the_start_reaches_half_way_to_the_background() {
        let clicks = [click(10.0, 15.0, true), click(30.0, 15.0, false)];
        let (seeds, _) = from_clicks("a", &clicks, 41, 31, 0.0);
        let discs: Vec<bool> = seeds.iter().map(|k| *k == Seed::Head).collect();
        let [head, not_far] = start(&seeds, &discs, 41, 31);
        assert!(head[15 * 41 + 19] && !head[15 * 41 + 20] && head[0] && !head[40]);
        // between the discs of 4 pixels 12 are free; twice as far from one as from the other at two
        // thirds
        assert!(not_far[15 * 41 + 21] && !not_far[15 * 41 + 23]);
    }

    #[test]
    fn border_margins_leave_the_lower_sides_open() {
        let seeds = border(50, 100, 0.05);
        let at = |x: usize, y: usize| seeds[y * 50 + x] == Seed::Background;
        assert!(
            at(25, 4) && !at(25, 5) && at(4, 59) && at(45, 59) && !at(5, 59) && !at(0, 60) && !at(25, 99)
        );
    }
}
