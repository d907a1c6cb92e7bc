//! Connected components of binary pictures: keeping some, filling holes, smoothing with a 3 × 3
//! square.

use tiface_base::image::{Gray, dilated};
use tiface_base::math::{Components, components};

/// Connected components, over edges only (`corners` false) or over corners too.
fn pieces(marked: &[bool], width: usize, height: usize, corners: bool) -> Components {
    components(marked, |i| {
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
