//! The exact Euclidean distance to the nearest marked pixel of a binary picture (Felzenszwalb &
//! Huttenlocher 2012).

use rayon::prelude::*;
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
}
