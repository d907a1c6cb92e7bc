//! Checks of masks: whether they look like masks of a head.

use super::mask_values::MAX_BLACK;
use tiface_base::image::{Gray, OPAQUE_ALPHA, Photo};
use tiface_base::{Error, Result};

/// Returns the share of the picture that a soft mask covers, 0..=1.
pub fn coverage(mask: &Gray) -> f64 {
    let sum: u64 = mask.values.iter().map(|&v| v as u64).sum();
    sum as f64 / (255.0 * mask.values.len().max(1) as f64)
}

/// Hint for a mask that cannot be right.
pub const MASK_HINT: &str = "correct masks, photograph or camera, or remove the frame; a run that had begun then goes on with \
                             `--fresh mask`. `--set mask.trust=true` goes on with the masks as they are";

/// The finding for an inverted mask.
const INVERTED: &str = "looks inverted: white must keep the head";

/// Refuses a view whose mask cannot be right by itself: it is inverted, or the photograph is black
/// inside it.
pub fn refuse(view: &str, photo: &Photo, mask: &Gray) -> Result<()> {
    let head = || photo.rgb.iter().zip(&mask.values).filter(|(_, m)| **m > 127).map(|(rgb, _)| rgb);
    let (all, lit) = (head().count(), head().filter(|rgb| rgb.iter().any(|&v| v > MAX_BLACK)).count());
    let problem = if findings(mask).contains(&INVERTED) {
        format!("the mask of view `{view}` {INVERTED}")
    } else if 100 * lit < all {
        format!("the photograph of view `{view}` is black where its mask shows the head")
    } else {
        return Ok(());
    };
    Err(Error::cannot(problem, MASK_HINT))
}

/// Returns why a mask is suspicious as the mask of a head: empty, all white, probably inverted,
/// touching three borders or more. These are warnings for a user to check; [`refuse`] has the
/// errors.
pub fn findings(mask: &Gray) -> Vec<&'static str> {
    let (w, h) = (mask.width as usize, mask.height as usize);
    let brightest = mask.values.iter().copied().max().unwrap_or(0);
    let darkest = mask.values.iter().copied().min().unwrap_or(0);
    if w == 0 || h == 0 || brightest == 0 {
        return vec!["is empty"];
    }
    if brightest == 1 {
        return vec!["holds only 0 and 1; white must be 255"];
    }
    if brightest < 128 {
        return vec!["is empty but for faint traces"];
    }
    if darkest >= OPAQUE_ALPHA {
        return vec!["is white everywhere"];
    }
    // mean over columns x0..x1 of rows y0..y1, 0..=1
    let mean = |x0: usize, x1: usize, y0: usize, y1: usize| {
        let rows = mask.values.chunks_exact(w).take(y1).skip(y0);
        let sum: u64 = rows.flat_map(|row| &row[x0..x1]).map(|&v| v as u64).sum();
        sum as f64 / (255 * ((x1 - x0) * (y1 - y0)).max(1)) as f64
    };
    let (top, bottom) = (mean(0, w, 0, 1), mean(0, w, h - 1, h));
    // shoulders may leave through the lower part of the sides
    let upper = 3 * h / 5;
    let (high_left, high_right) = (mean(0, 1, 0, upper), mean(w - 1, w, 0, upper));
    let middle = mean(w / 3, w - w / 3, h / 3, h - h / 3);
    let mut found = Vec::new();
    if brightest < OPAQUE_ALPHA {
        found.push("is nowhere white");
    }
    // shoulders may fill the bottom in either case
    if (top + high_left + high_right) / 3.0 > 0.75 && middle < 0.5 {
        found.push(INVERTED);
    } else if [top, bottom, high_left, high_right].iter().filter(|&&b| b > 0.02).count() >= 3 {
        found.push("touches three borders or more");
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    fn disc(inside: u8, outside: u8, center: (f64, f64)) -> Gray {
        let (width, height) = (40u32, 30u32);
        let values = (0..width * height)
            .map(|i| {
                let (x, y) = ((i % width) as f64 - center.0, (i / width) as f64 - center.1);
                if x * x + y * y < 100.0 { inside } else { outside }
            })
            .collect();
        Gray { width, height, values }
    }

    #[test]
    fn a_disc_is_a_fine_mask_and_its_negative_is_not() {
        assert!(findings(&disc(255, 0, (20.0, 15.0))).is_empty());
        assert!(findings(&disc(0, 255, (20.0, 15.0)))[0].contains("inverted"));
        // area π·10² of 1200 pixels
        assert!((coverage(&disc(255, 0, (20.0, 15.0))) - 0.2618).abs() < 0.01);
    }

    #[test]
    fn inverted_masks_of_busts_and_black_photographs_are_refused() {
        // a head on shoulders that fill the lower third from side to side
        let bust = |inside: u8, outside: u8| {
            let head = disc(inside, outside, (20.0, 12.0));
            let values = head.values.iter().enumerate().map(|(i, &v)| if i / 40 >= 20 { inside } else { v });
            Gray { values: values.collect(), ..head }
        };
        let photo = |v: u8| Photo { width: 40, height: 30, rgb: vec![[v; 3]; 1200], alpha: None };
        assert!(refuse("a", &photo(99), &bust(255, 0)).is_ok());
        let message = |photo: &Photo, mask: &Gray| refuse("a", photo, mask).unwrap_err().to_string();
        assert!(message(&photo(99), &bust(0, 255)).contains("`a` looks inverted"));
        assert_eq!(
            message(&photo(9), &bust(255, 0)),
            "the photograph of view `a` is black where its mask shows the head"
        );
        // a black background is none of it, nor is a mask without a head
        let mut lit = photo(0);
        lit.rgb[12 * 40 + 20..][..8].fill([60; 3]);
        assert!(refuse("a", &lit, &disc(255, 0, (20.0, 15.0))).is_ok());
        assert!(refuse("a", &photo(0), &disc(0, 0, (20.0, 15.0))).is_ok());
    }

    #[test]
    fn empty_white_and_binary_masks_are_named() {
        assert_eq!(findings(&disc(0, 0, (0.0, 0.0))), ["is empty"]);
        assert_eq!(findings(&disc(255, 255, (0.0, 0.0))), ["is white everywhere"]);
        assert!(findings(&disc(1, 0, (20.0, 15.0)))[0].contains("0 and 1"));
        assert_eq!(findings(&disc(200, 0, (20.0, 15.0))), ["is nowhere white"]);
    }

    #[test]
    fn shoulders_may_touch_the_lower_sides_but_heads_no_three_borders() {
        let bust = |from: u32| {
            let values = (0..1200).map(|i| if i / 40 >= from { 255 } else { 0 }).collect();
            Gray { width: 40, height: 30, values }
        };
        assert!(findings(&bust(22)).is_empty());
        assert_eq!(findings(&bust(8)), ["touches three borders or more"]);
    }

    #[test]
    fn a_mask_cut_by_one_border_is_fine() {
        assert!(findings(&disc(255, 0, (20.0, 28.0))).is_empty());
    }
}
