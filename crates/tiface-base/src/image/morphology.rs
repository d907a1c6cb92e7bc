//! Sets of pixels grown and shrunk, by squares or by discs. A picture of `w × h` pixels is stored
//! row by row.

/// Returns the pixels with a set one at most `before` pixels before and `behind` pixels behind them
/// along both axes: the set dilated by a square. Two one-dimensional passes are equivalent.
pub fn dilated(mut set: Vec<bool>, w: usize, h: usize, before: usize, behind: usize) -> Vec<bool> {
    let mut marked = Vec::new();
    for (lines, step, n, stride) in [(h, w, w, 1), (w, 1, h, w)] {
        for first in (0..lines).map(|line| line * step) {
            marked.clear();
            marked.extend((0..n).filter(|i| set[first + i * stride]));
            // a pixel marks a span around it; starting at `done` avoids marking any twice
            let mut done = 0;
            for &i in &marked {
                let end = i.saturating_add(before).saturating_add(1).min(n);
                (i.saturating_sub(behind).max(done)..end).for_each(|k| set[first + k * stride] = true);
                done = end;
            }
        }
    }
    set
}

/// Returns the pixels whose whole square of half edge `margin` is set; none at the picture's border
/// is.
pub fn eroded(mut set: Vec<bool>, w: usize, h: usize, margin: usize) -> Vec<bool> {
    set.iter_mut().for_each(|s| *s = !*s);
    let mut set = dilated(set, w, h, margin, margin);
    let is_inner = |i: usize, n: usize| i >= margin && i.saturating_add(margin) < n;
    for (y, row) in set.chunks_mut(w.max(1)).enumerate() {
        let is_inner_row = is_inner(y, h);
        row.iter_mut().enumerate().for_each(|(x, s)| *s = !*s && is_inner_row && is_inner(x, w));
    }
    set
}

/// Returns the set pixels and those whose centers are within `radius` pixels of one of theirs.
pub fn grow(set: &[bool], w: usize, h: usize, radius: f32) -> Vec<bool> {
    assert_eq!(set.len(), w * h);
    // squared distances of pixels are whole numbers
    let square = (radius * radius) as usize;
    let reach = square.isqrt();
    let mut out = set.to_vec();
    for (i, _) in set.iter().enumerate().filter(|(_, s)| **s) {
        let (x, y) = (i % w, i / w);
        // inner pixels of the set add none that its border does not
        let is_border = (x > 0 && !set[i - 1])
            || (x + 1 < w && !set[i + 1])
            || (y > 0 && !set[i - w])
            || (y + 1 < h && !set[i + w]);
        if !is_border {
            continue;
        }
        for v in y.saturating_sub(reach)..(y + reach + 1).min(h) {
            let half = (square - v.abs_diff(y).pow(2)).isqrt();
            out[v * w + x.saturating_sub(half)..v * w + (x + half + 1).min(w)].fill(true);
        }
    }
    out
}

/// Returns the set pixels that are farther than `radius` pixels from every pixel that is not set.
/// Pixels beyond the picture's border are unknown, so the border does not shrink the set.
pub fn shrink(set: &[bool], w: usize, h: usize, radius: f32) -> Vec<bool> {
    let outside: Vec<bool> = set.iter().map(|s| !s).collect();
    grow(&outside, w, h, radius).into_iter().map(|s| !s).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rng::below;

    #[test]
    fn dilating_marks_the_square_around_a_pixel_which_need_not_be_in_its_middle() {
        // pixel (3, 1) of 7 × 4: with 1 before and 2 behind, columns 1 to 4 and rows 0 to 2
        let mut set = vec![false; 28];
        set[7 + 3] = true;
        let more = dilated(set, 7, 4, 1, 2);
        let expected = |i: usize| (1..=4).contains(&(i % 7)) && i / 7 <= 2;
        assert!((0..28).all(|i| more[i] == expected(i)), "{more:?}");
        assert!(dilated(vec![false; 6], 3, 2, 9, 9).iter().all(|set| !set));
    }

    #[test]
    fn eroding_leaves_pixels_whose_whole_square_is_set() {
        // 7 × 5, one hole at (1, 2): with a margin of 1 columns 3 to 5 of rows 1 to 3 are left
        let mut set = vec![true; 35];
        set[2 * 7 + 1] = false;
        let left = eroded(set, 7, 5, 1);
        let expected = |i: usize| (3..=5).contains(&(i % 7)) && (1..=3).contains(&(i / 7));
        assert!((0..35).all(|i| left[i] == expected(i)), "{left:?}");
        assert!(eroded(vec![true; 6], 3, 2, 2).iter().all(|set| !set));
    }

    #[test]
    fn growing_makes_discs_and_shrinking_takes_the_rim_but_not_at_the_border() {
        let mut one = vec![false; 49];
        one[24] = true; // (3, 3) of 7 × 7
        let disc = grow(&one, 7, 7, 2.0);
        // within 2 pixels of the center: 1 + 3 + 5 + 3 + 1 lattice points
        assert_eq!(disc.iter().filter(|&&m| m).count(), 13);
        assert!(disc[22] && disc[10] && !disc[9], "(1, 3) and (3, 1), not (2, 1)");
        // a radius between two lattice distances, √2 and 2: the 3 × 3 square
        assert_eq!(grow(&one, 7, 7, 1.9).iter().filter(|&&m| m).count(), 9);
        assert!(grow(&[true; 49], 7, 7, 2.0).iter().all(|d| *d));
        assert!(grow(&[false; 49], 7, 7, 2.0).iter().all(|d| !d));
        // the left half of 6 x 4 loses its right column only
        let half: Vec<bool> = (0..24).map(|i| i % 6 < 3).collect();
        let less = shrink(&half, 6, 4, 1.0);
        assert!((0..24).all(|i| less[i] == (i % 6 < 2)));
    }

    #[test]
    fn discs_hold_the_pixels_that_a_search_over_all_finds() {
        for (w, h, every) in [(17, 11, 9), (1, 13, 4), (23, 1, 6), (31, 29, 200), (12, 9, 2)] {
            let set: Vec<bool> = (0..w * h).map(|i| below(7, every, i as u64, every) == 0).collect();
            for radius in [0.5f32, 1.0, 2.3, 6.144] {
                let distance = |i: usize, j: usize| {
                    ((i % w).abs_diff(j % w).pow(2) + (i / w).abs_diff(j / w).pow(2)) as f32
                };
                let is_near = |i: usize| (0..w * h).any(|j| set[j] && distance(i, j) <= radius * radius);
                let expected: Vec<bool> = (0..w * h).map(is_near).collect();
                assert_eq!(grow(&set, w, h, radius), expected, "{w} × {h}, one in {every}, {radius}");
            }
        }
    }
}
