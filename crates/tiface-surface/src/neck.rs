//! Where a head is narrow, by the sizes of its slices from the lowest to the highest: widths or
//! areas of sections.

/// Returns the neck: the slice that is smallest beside larger ones below and above. `None` if no
/// slice has ones more than `prominence` times its size on both sides: the head ends above its
/// neck, or hair hides it.
pub(crate) fn find_neck(sizes: &[f32], prominence: f32) -> Option<usize> {
    let largest = |sizes: &[f32]| sizes.iter().copied().fold(0.0, f32::max);
    let of = |i: usize| largest(&sizes[..i]).min(largest(&sizes[i..])) / sizes[i].max(f32::MIN_POSITIVE);
    // both ends taper to nothing
    let inner = (1..sizes.len().saturating_sub(1)).filter(|&i| sizes[i] > 0.0);
    inner.max_by(|&a, &b| of(a).total_cmp(&of(b))).filter(|&i| of(i) > prominence)
}

/// Returns the highest slice below `from` that is larger than `size`: where shoulders begin.
pub(crate) fn find_shoulders(sizes: &[f32], from: usize, size: f32) -> Option<usize> {
    sizes[..from].iter().rposition(|found| *found > size)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_neck_is_small_beside_what_is_below_and_above() {
        // shoulders of 9, a neck of 3 and a head of 6; the crown is smaller than the neck
        let sizes = [7.0, 9.0, 8.0, 4.0, 3.0, 3.5, 6.0, 5.0, 1.0];
        assert_eq!(find_neck(&sizes, 1.9), Some(4));
        // the head is twice as large, not more
        assert_eq!(find_neck(&sizes, 2.0), None);
        assert_eq!([3.0, 4.0, 8.5].map(|size| find_shoulders(&sizes, 4, size)), [Some(3), Some(2), Some(1)]);
        assert_eq!(find_shoulders(&sizes, 4, 9.0), None);
        // an egg has none, nor has nothing
        assert_eq!(find_neck(&[1.0, 2.0, 3.0, 2.0, 1.0], 1.0), None);
        assert_eq!([&[][..], &[0.0; 5], &[2.0]].map(|sizes| find_neck(sizes, 0.5)), [None; 3]);
    }
}
