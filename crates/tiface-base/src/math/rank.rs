//! Medians and other values by rank. Several definitions agree for most data and differ for even
//! counts; each is here once, under a name of its own.

use std::cmp::Ordering;

/// Returns the value nearest to a `share`, 0..=1, of the way from the least to the greatest of some
/// values; of two that are equally near, the greater. `None` without values, which are reordered.
pub fn quantile<T: Copy>(values: &mut [T], share: f64, order: impl FnMut(&T, &T) -> Ordering) -> Option<T> {
    let last = values.len().checked_sub(1)?;
    let place = (last as f64 * share).round() as usize;
    Some(*values.select_nth_unstable_by(place, order).1)
}

/// Returns the median: of an even count the greater of the two values in the middle. `None` without
/// values, which are reordered.
pub fn median<T: Copy>(values: &mut [T], order: impl FnMut(&T, &T) -> Ordering) -> Option<T> {
    quantile(values, 0.5, order)
}

/// Returns the least of some ascending values that a `share`, 0..=1, of them does not exceed (the
/// nearest rank); at one half, the lesser of the two in the middle of an even count. `None` without
/// values.
pub fn nearest_rank<T: Copy>(ascending: &[T], share: f64) -> Option<T> {
    let count = (share * ascending.len() as f64).ceil() as usize;
    ascending.get(count.max(1) - 1).copied()
}

/// Returns the least value that half of the counted ones do not exceed, where `counts[v]` of them
/// are `v`; 0 without any.
pub fn median_of_counts(counts: &[u64]) -> usize {
    let (total, mut sum) = (counts.iter().sum::<u64>(), 0);
    let reaches_half = |n: &u64| {
        sum += n;
        2 * sum >= total
    };
    counts.iter().position(reaches_half).unwrap_or(0)
}

/// Returns the mean of the two values in the middle, which of an odd count are one. `None` without
/// values, which are sorted.
pub fn mean_of_middle(values: &mut [f64]) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let last = values.len().checked_sub(1)?;
    Some((values[last / 2] + values[values.len() / 2]) / 2.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn medians_of_an_even_count_are_the_greater_the_lesser_or_the_mean_of_two() {
        let values = || [7.0, 1.0, 4.0, 2.0];
        assert_eq!(median(&mut values(), f64::total_cmp), Some(4.0));
        assert_eq!(nearest_rank(&[1.0, 2.0, 4.0, 7.0], 0.5), Some(2.0));
        assert_eq!(median_of_counts(&[0, 1, 1, 0, 1, 0, 0, 1]), 2);
        assert_eq!(mean_of_middle(&mut values()), Some(3.0));
    }

    #[test]
    fn all_medians_of_an_odd_count_are_the_value_in_the_middle() {
        let values = || [5.0, 1.0, 3.0];
        assert_eq!(median(&mut values(), f64::total_cmp), Some(3.0));
        assert_eq!(nearest_rank(&[1.0, 3.0, 5.0], 0.5), Some(3.0));
        assert_eq!(median_of_counts(&[0, 1, 0, 1, 0, 1]), 3);
        assert_eq!(mean_of_middle(&mut values()), Some(3.0));
    }

    #[test]
    fn ranks_are_those_worked_by_hand_and_nothing_has_none() {
        let mut ten: Vec<u32> = (0..10).collect();
        // 0.9 · 9 = 8.1 is nearest to place 8; nine of ten values do not exceed 8
        assert_eq!((quantile(&mut ten, 0.9, u32::cmp), nearest_rank(&ten, 0.9)), (Some(8), Some(8)));
        assert_eq!((quantile(&mut ten, 1.0, u32::cmp), nearest_rank(&[0, 1], 0.0)), (Some(9), Some(0)));
        let none: &mut [f64] = &mut [];
        assert!(median(none, f64::total_cmp).is_none() && mean_of_middle(none).is_none());
        assert!(nearest_rank(none, 0.5).is_none() && median_of_counts(&[0; 4]) == 0);
    }
}
