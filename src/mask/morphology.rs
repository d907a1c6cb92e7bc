//! Binary pictures: the exact Euclidean distance to the nearest marked pixel (Felzenszwalb &
//! Huttenlocher 2012), and connected pieces: keeping some, filling holes, smoothing with a 3 × 3
//! square.

use crate::capture::carve::{self, Pieces};
use rayon::prelude::*;
use tiface_base::image::{Gray, dilated};
use tiface_base::math::distance::LowerEnvelope;

/// Far away: no pixel is marked. Larger than any squared distance in a picture, finite in
/// arithmetic.
const FAR: f32 = 1e12;

/// Returns the squared distance in pixels from every pixel to the nearest one that `marked` names;
/// `f32::INFINITY` everywhere when none is. `marked`: `[height · width]`.
pub fn squared_distance(marked: &[bool], width: usize, height: usize) -> Vec<f32> {
    assert_eq!(marked.len(), width * height);
    if !marked.contains(&true) {
        return vec![f32::INFINITY; marked.len()];
    }
    // along columns first, where a plain two-pass scan is exact
    let mut field: Vec<f32> = marked.iter().map(|&m| if m { 0.0 } else { FAR }).collect();
    let mut steps = vec![u32::MAX; width];
    for y in 0..height {
        for x in 0..width {
            let i = y * width + x;
            steps[x] = if marked[i] { 0 } else { steps[x].saturating_add(1) };
            field[i] = squared(steps[x]);
        }
    }
    steps.fill(u32::MAX);
    for y in (0..height).rev() {
        for x in 0..width {
            let i = y * width + x;
            steps[x] = if marked[i] { 0 } else { steps[x].saturating_add(1) };
            field[i] = field[i].min(squared(steps[x]));
        }
    }
    field
        .par_chunks_mut(width)
        .for_each_init(|| LowerEnvelope::new(width), |lower, row| lower.transform(row));
    field
}

fn squared(steps: u32) -> f32 {
    if steps == u32::MAX { FAR } else { (steps as f32) * (steps as f32) }
}

/// Connected pieces, over edges only (`corners` false) or over corners too.
fn pieces(marked: &[bool], width: usize, height: usize, corners: bool) -> Pieces {
    carve::pieces(marked, |i| {
        let (x, y) = (i % width, i / width);
        let rows = y.saturating_sub(1)..(y + 2).min(height);
        let columns = x.saturating_sub(1)..(x + 2).min(width);
        rows.flat_map(move |v| columns.clone().map(move |u| (u, v)))
            .filter(move |&(u, v)| corners || u == x || v == y)
            .map(move |(u, v)| v * width + u)
    })
}

/// Takes away every piece of less than `min_size` pixels without one of `seeds`.
pub(super) fn keep_pieces(marked: &mut [bool], seeds: &[bool], min_size: f64, width: usize, height: usize) {
    let found = pieces(marked, width, height, true);
    let mut wanted: Vec<bool> = found.size.iter().map(|&s| s as f64 >= min_size).collect();
    for (i, &seed) in seeds.iter().enumerate() {
        wanted[found.label[i] as usize] |= seed;
    }
    wanted[0] = false;
    marked.iter_mut().zip(&found.label).for_each(|(m, &l)| *m = wanted[l as usize]);
}

/// Labels as a picture: 255 where marked.
pub(super) fn gray(marked: &[bool], width: usize, height: usize) -> Gray {
    let values = marked.iter().map(|&m| if m { 255 } else { 0 }).collect();
    Gray { width: width as u32, height: height as u32, values }
}

/// Fills enclosed regions that do not touch the border, have at most `largest` pixels and none of
/// `never`.
pub(super) fn fill_holes(marked: &mut [bool], never: &[bool], width: usize, height: usize, largest: usize) {
    let outside: Vec<bool> = marked.iter().map(|m| !m).collect();
    let found = pieces(&outside, width, height, false);
    let mut fill: Vec<bool> = found.size.iter().map(|&s| s <= largest).collect();
    fill[0] = false;
    for (i, &l) in found.label.iter().enumerate() {
        let (x, y) = (i % width, i / width);
        if never[i] || x == 0 || y == 0 || x + 1 == width || y + 1 == height {
            fill[l as usize] = false;
        }
    }
    marked.iter_mut().zip(&found.label).for_each(|(m, &l)| *m |= l != 0 && fill[l as usize]);
}

/// Unmarks pixels that no 3 × 3 square of marked pixels covers; pixels outside the picture are
/// ignored.
pub(super) fn open(marked: &[bool], width: usize, height: usize) -> Vec<bool> {
    let outside: Vec<bool> = marked.iter().map(|m| !m).collect();
    let inner = dilated(outside, width, height, 1, 1).into_iter().map(|m| !m).collect();
    dilated(inner, width, height, 1, 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn brute(marked: &[bool], w: usize, h: usize) -> Vec<f32> {
        (0..w * h)
            .map(|i| {
                (0..w * h)
                    .filter(|&j| marked[j])
                    .map(|j| {
                        let (dx, dy) = ((i % w).abs_diff(j % w), (i / w).abs_diff(j / w));
                        (dx * dx + dy * dy) as f32
                    })
                    .fold(f32::INFINITY, f32::min)
            })
            .collect()
    }

    #[test]
    fn distances_equal_those_of_a_search_over_all_pixels() {
        let mut state = 7u64;
        for (w, h, every) in [(17, 11, 9), (1, 13, 4), (23, 1, 6), (31, 29, 200), (8, 8, 1)] {
            let marked: Vec<bool> = (0..w * h)
                .map(|_| {
                    state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                    (state >> 33).is_multiple_of(every)
                })
                .collect();
            assert_eq!(squared_distance(&marked, w, h), brute(&marked, w, h), "{w} x {h}, one in {every}");
        }
    }

    #[test]
    fn nothing_marked_is_infinitely_far() {
        assert!(squared_distance(&[false; 6], 3, 2).iter().all(|d| d.is_infinite()));
    }

    fn picture(rows: &[&str]) -> (Vec<bool>, usize, usize) {
        let marked = rows.iter().flat_map(|r| r.bytes().map(|b| b == b'#')).collect();
        (marked, rows[0].len(), rows.len())
    }

    #[test]
    fn corners_join_pieces_only_when_asked() {
        let (m, w, h) = picture(&["#..", ".#.", "..#"]);
        assert_eq!(pieces(&m, w, h, true).size, [0, 3]);
        assert_eq!(pieces(&m, w, h, false).size, [0, 1, 1, 1]);
    }

    #[test]
    fn only_pieces_with_a_seed_stay() {
        let (mut m, w, h) = picture(&["##..#", "##..#", "....."]);
        let (seeds, ..) = picture(&["#....", ".....", "..#.."]);
        keep_pieces(&mut m, &seeds, f64::INFINITY, w, h);
        assert_eq!(m, picture(&["##...", "##...", "....."]).0);
    }

    #[test]
    fn small_enclosed_holes_are_filled_but_not_large_open_or_forbidden_ones() {
        let rows = ["#######", "#.#..##", "####.#.", "#.#####", "#######"];
        let (m, w, h) = picture(&rows);
        let none = vec![false; m.len()];
        let (mut two, mut forbidden) = (m.clone(), m.clone());
        fill_holes(&mut two, &none, w, h, 2);
        // the hole of three and the notch in the border stay
        assert_eq!(two, picture(&["#######", "###..##", "####.#.", "#######", "#######"]).0);
        let mut never = none;
        never[8] = true;
        fill_holes(&mut forbidden, &never, w, h, 9);
        assert_eq!(forbidden, picture(&["#######", "#.#####", "######.", "#######", "#######"]).0);
    }

    #[test]
    fn opening_takes_threads_and_keeps_blocks_at_the_border() {
        let (m, w, h) = picture(&["###....", "###.#..", "######.", "....#..", "....#.."]);
        assert_eq!(open(&m, w, h), picture(&["###....", "###....", "###....", ".......", "......."]).0);
    }
}
