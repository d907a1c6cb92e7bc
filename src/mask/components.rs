//! Connected pieces of a binary picture: keeping some, filling holes, smoothing with a 3 × 3 square.

use crate::image::Gray;

/// Pieces that hang together, numbered from 1 in the order of their first pixel; 0 where `marked` is not.
struct Pieces {
    /// `[height · width]`.
    label: Vec<u32>,
    /// Pixels of each piece; entry 0 counts the rest.
    size: Vec<usize>,
}

/// Finds pieces, over edges only (`corners` false) or over corners too.
fn pieces(marked: &[bool], width: usize, height: usize, corners: bool) -> Pieces {
    let mut label = vec![0u32; marked.len()];
    let mut size = vec![marked.iter().filter(|m| !**m).count()];
    let mut stack = Vec::new();
    for start in 0..marked.len() {
        if !marked[start] || label[start] != 0 {
            continue;
        }
        let id = size.len() as u32;
        size.push(0);
        label[start] = id;
        stack.push(start);
        while let Some(i) = stack.pop() {
            size[id as usize] += 1;
            let (x, y) = (i % width, i / width);
            for v in y.saturating_sub(1)..(y + 2).min(height) {
                for u in x.saturating_sub(1)..(x + 2).min(width) {
                    let j = v * width + u;
                    if marked[j] && label[j] == 0 && (corners || u == x || v == y) {
                        label[j] = id;
                        stack.push(j);
                    }
                }
            }
        }
    }
    Pieces { label, size }
}

/// Takes away every piece of less than `least` pixels without one of `seeds`.
pub(super) fn keep_pieces(marked: &mut [bool], seeds: &[bool], least: f64, width: usize, height: usize) {
    let found = pieces(marked, width, height, true);
    let mut wanted: Vec<bool> = found.size.iter().map(|&s| s as f64 >= least).collect();
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

/// Fills what is enclosed, does not touch the border, has at most `largest` pixels and none of `never`.
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

/// Takes away what no 3 × 3 square of marked pixels covers; pixels outside the picture are ignored.
pub(super) fn open(marked: &[bool], width: usize, height: usize) -> Vec<bool> {
    let inner = square(marked, width, height, true);
    square(&inner, width, height, false)
}

/// Over each 3 × 3 square: are all marked (`all`), or is any?
fn square(marked: &[bool], width: usize, height: usize, all: bool) -> Vec<bool> {
    (0..marked.len())
        .map(|i| {
            let (x, y) = (i % width, i / width);
            let hit = (y.saturating_sub(1)..(y + 2).min(height)).any(|v| {
                let row = &marked[v * width + x.saturating_sub(1)..v * width + (x + 2).min(width)];
                row.iter().any(|&m| m != all)
            });
            hit != all
        })
        .collect()
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
        assert_eq!(pieces(&m, w, h, true).size, [6, 3]);
        assert_eq!(pieces(&m, w, h, false).size, [6, 1, 1, 1]);
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
