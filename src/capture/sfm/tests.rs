use super::*;

fn photo(width: u32, height: u32, value: impl Fn(u32, u32) -> u8) -> Photo {
    let rgb = (0..width * height).map(|i| [value(i % width, i / width); 3]).collect();
    Photo { width, height, rgb, alpha: None }
}

#[test]
fn sharpness_is_the_mean_squared_step_along_rows_and_columns() {
    // two steps of 10 along rows, one of 0; columns: 10, 10 of 0 -> see the picture
    // 0 10
    // 0  0        along: 10² + 0², down: 0² + 10², of four pixels
    assert_eq!(sharpness(&photo(2, 2, |x, y| if (x, y) == (1, 0) { 10 } else { 0 })), 50.0);
    assert_eq!(sharpness(&photo(3, 1, |_, _| 7)), 0.0);
}
