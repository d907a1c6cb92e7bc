//! What is not to be touched: vertices where the mesh is no surface.
//!
//! On an edge with more than two triangles, or with two that run the same way, and at a vertex whose
//! triangles form more than one fan, the link condition says nothing. Such vertices stay as they are,
//! so that a mesh with a flaw keeps the flaw and gets no others.

/// Has an edge with one triangle.
pub(super) const BORDER: u8 = 1;
/// Takes part in no collapse and does not move.
pub(super) const HELD: u8 = 2;

/// What a vertex is, [`BORDER`] or [`HELD`] or neither, by the sides opposite to it, each from one neighbour to the
/// next: one closed walk through all of them is the inside of a surface, one open walk its border.
pub(super) fn kind(sides: &mut [(u32, u32)]) -> u8 {
    sides.sort_unstable();
    let after = |w: u32| sides.binary_search_by_key(&w, |side| side.0).ok();
    if sides.is_empty() {
        return 0;
    }
    if sides.windows(2).any(|pair| pair[0].0 == pair[1].0) {
        return HELD;
    }
    // A walk from anywhere either comes back, or ends at a border.
    let walk = |start: usize| {
        let (mut at, mut steps) = (start, 1);
        loop {
            match after(sides[at].1) {
                None => return (steps, true),
                Some(next) if next == start => return (steps, false),
                Some(_) if steps == sides.len() => return (usize::MAX, false),
                Some(next) => (at, steps) = (next, steps + 1),
            }
        }
    };
    match walk(0) {
        (steps, false) if steps == sides.len() => return 0,
        (_, false) => return HELD,
        (_, true) => {}
    }
    // The border begins at the one side whose first neighbour ends none.
    let mut ends: Vec<u32> = sides.iter().map(|side| side.1).collect();
    ends.sort_unstable();
    let begin = (0..sides.len()).find(|&i| ends.binary_search(&sides[i].0).is_err());
    match begin.map(walk) {
        Some((steps, true)) if steps == sides.len() => BORDER,
        _ => HELD,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_closed_walk_is_inside_an_open_one_a_border_and_two_are_held() {
        assert_eq!(kind(&mut [(1, 2), (3, 1), (2, 3)]), 0);
        assert_eq!(kind(&mut [(3, 4), (1, 2), (2, 3)]), BORDER);
        assert_eq!(kind(&mut [(1, 2)]), BORDER);
        assert_eq!(kind(&mut [(1, 2), (2, 3), (3, 1), (4, 5), (5, 6), (6, 4)]), HELD);
        assert_eq!(kind(&mut [(1, 2), (3, 4)]), HELD);
        assert_eq!(kind(&mut []), 0);
    }

    #[test]
    fn a_third_triangle_on_an_edge_holds_it_whichever_way_it_runs() {
        assert_eq!(kind(&mut [(1, 2), (2, 3), (3, 1), (1, 4)]), HELD);
        assert_eq!(kind(&mut [(1, 2), (2, 3), (3, 1), (4, 1)]), HELD);
        // into a loop that does not hold the start
        assert_eq!(kind(&mut [(0, 1), (1, 2), (2, 1)]), HELD);
    }

    #[test]
    fn many_sides_are_told_apart_the_same_way() {
        let mut sides: Vec<(u32, u32)> = (0..40).map(|i| ((i * 7) % 40, (i * 7 + 1) % 40)).collect();
        assert_eq!(kind(&mut sides), 0);
        sides.pop();
        assert_eq!(kind(&mut sides), BORDER);
        sides.push((7, 99));
        assert_eq!(kind(&mut sides), HELD);
    }
}
