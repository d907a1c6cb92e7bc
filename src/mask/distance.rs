//! Exact Euclidean distance to the nearest marked pixel (Felzenszwalb & Huttenlocher 2012), and what
//! follows from it: growing and shrinking by discs, nearest of two sets.

use crate::kernel::cpu::distance::LowerEnvelope;
use rayon::prelude::*;

/// Far away: no pixel is marked. Larger than any squared distance in a picture, finite in arithmetic.
const FAR: f32 = 1e12;

/// Squared distance in pixels from every pixel to the nearest one that `marked` names; `f32::INFINITY`
/// everywhere when none is. `marked`: `[height · width]`.
pub fn squared_distance(marked: &[bool], width: usize, height: usize) -> Vec<f32> {
    assert_eq!(marked.len(), width * height);
    if !marked.contains(&true) {
        return vec![f32::INFINITY; marked.len()];
    }
    // along columns first: a plain two-pass scan is exact there
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

/// Pixels within `radius` pixels of a marked one.
pub fn grow(marked: &[bool], width: usize, height: usize, radius: f32) -> Vec<bool> {
    squared_distance(marked, width, height).iter().map(|&d| d <= radius * radius).collect()
}

/// Marked pixels farther than `radius` pixels from every pixel that is not; beyond the border nothing is known,
/// so the border does not shrink them.
pub fn shrink(marked: &[bool], width: usize, height: usize, radius: f32) -> Vec<bool> {
    let outside: Vec<bool> = marked.iter().map(|m| !m).collect();
    squared_distance(&outside, width, height).iter().map(|&d| d > radius * radius).collect()
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

    #[test]
    fn growing_makes_discs_and_shrinking_takes_the_rim_but_not_at_the_border() {
        let mut one = vec![false; 49];
        one[24] = true;
        // within 2 pixels of the center: 13 lattice points
        assert_eq!(grow(&one, 7, 7, 2.0).iter().filter(|&&m| m).count(), 13);
        // the left half of 6 x 4 loses its right column only
        let half: Vec<bool> = (0..24).map(|i| i % 6 < 3).collect();
        let less = shrink(&half, 6, 4, 1.0);
        assert!((0..24).all(|i| less[i] == (i % 6 < 2)));
    }
}
