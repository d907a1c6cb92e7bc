//! Names on the pictures of a sheet, in letters of 5 × 7 dots.

use crate::pipeline::PreviewPicture;

/// Rows of a letter, five bits each, the left one first.
fn rows(letter: char) -> [u8; 7] {
    match letter {
        'A' => [0x0e, 0x11, 0x11, 0x1f, 0x11, 0x11, 0x11],
        'B' => [0x1e, 0x11, 0x11, 0x1e, 0x11, 0x11, 0x1e],
        'C' => [0x0e, 0x11, 0x10, 0x10, 0x10, 0x11, 0x0e],
        'E' => [0x1f, 0x10, 0x10, 0x1e, 0x10, 0x10, 0x1f],
        'F' => [0x1f, 0x10, 0x10, 0x1e, 0x10, 0x10, 0x10],
        'G' => [0x0e, 0x11, 0x10, 0x17, 0x11, 0x11, 0x0f],
        'H' => [0x11, 0x11, 0x11, 0x1f, 0x11, 0x11, 0x11],
        'I' => [0x0e, 0x04, 0x04, 0x04, 0x04, 0x04, 0x0e],
        'K' => [0x11, 0x12, 0x14, 0x18, 0x14, 0x12, 0x11],
        'L' => [0x10, 0x10, 0x10, 0x10, 0x10, 0x10, 0x1f],
        'M' => [0x11, 0x1b, 0x15, 0x15, 0x11, 0x11, 0x11],
        'N' => [0x11, 0x19, 0x15, 0x13, 0x11, 0x11, 0x11],
        'O' => [0x0e, 0x11, 0x11, 0x11, 0x11, 0x11, 0x0e],
        'P' => [0x1e, 0x11, 0x11, 0x1e, 0x10, 0x10, 0x10],
        'R' => [0x1e, 0x11, 0x11, 0x1e, 0x14, 0x12, 0x11],
        'S' => [0x0f, 0x10, 0x10, 0x0e, 0x01, 0x01, 0x1e],
        'T' => [0x1f, 0x04, 0x04, 0x04, 0x04, 0x04, 0x04],
        'U' => [0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x0e],
        'V' => [0x11, 0x11, 0x11, 0x11, 0x0a, 0x0a, 0x04],
        'W' => [0x11, 0x11, 0x11, 0x15, 0x15, 0x1b, 0x11],
        _ => [0; 7],
    }
}

/// A letter with the space behind it, dots.
const STEP: u32 = 6;

/// Writes a name of capital letters into the upper left corner of a picture: white on a dark field, so that it can be read
/// over anything.
pub(super) fn write(picture: &mut PreviewPicture, name: &str) {
    let dot = (picture.width / 256).max(1);
    let (across, down) = (STEP * name.len() as u32 + 3, 11);
    let letters: Vec<[u8; 7]> = name.chars().map(rows).collect();
    for y in 0..(down * dot).min(picture.height) {
        for x in 0..(across * dot).min(picture.width) {
            let (column, row) = ((x / dot).wrapping_sub(2), (y / dot).wrapping_sub(2));
            let letter = letters.get((column / STEP) as usize).filter(|_| row < 7 && column % STEP < 5);
            let is_on = letter.is_some_and(|rows| rows[row as usize] >> (4 - column % STEP) & 1 == 1);
            let shade = if is_on { 255 } else { 32 };
            picture.rgba[(y * picture.width + x) as usize] = [shade, shade, shade, 255];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_letter_stands_in_the_corner() {
        let mut picture = PreviewPicture { width: 20, height: 20, rgba: vec![[9; 4]; 400] };
        write(&mut picture, "L");
        let at = |x: usize, y: usize| picture.rgba[y * 20 + x];
        // seven dots down, five along its foot; a field of 9 × 11 around it
        assert!((2..9).all(|y| at(2, y) == [255; 4]) && (2..7).all(|x| at(x, 8) == [255; 4]));
        assert!(at(3, 7) == [32, 32, 32, 255] && at(8, 10) == [32, 32, 32, 255]);
        assert!(at(9, 5) == [9; 4] && at(5, 11) == [9; 4]);
    }
}
