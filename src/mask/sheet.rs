//! A contact sheet: all masks over their photographs, to see at a glance which went wrong.
//!
//! The mask's outline is cyan, the unsure band yellow; below each picture stand the view's name, how much the mask
//! covers and how much is unsure. Views that look suspicious have a red frame and say why.

use super::annotation::spread;
use super::font;
use super::matting::trimap::{UNSURE, unsure_share};
use super::scale::{reduce_gray, reduce_photo, working_size};
use crate::capture::{coverage, findings};
use crate::image::{Gray, Photo};

const STAGE: [u8; 3] = [24, 24, 24];
const TEXT: [u8; 3] = [225, 225, 225];
const OUTLINE: [u8; 3] = [0, 230, 255];
const BAND: [u8; 3] = [255, 200, 0];
const ALARM: [u8; 3] = [255, 70, 60];
/// Around a picture, with the frame in the middle.
const MARGIN: u32 = 8;
const FRAME: u32 = 4;
/// Between lines of text, in pixels of a letter.
const LINE_GAP: u32 = 3;

/// How large a sheet may become.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SheetOptions {
    /// Longest side of one picture, pixels.
    pub picture: u32,
    /// Columns of the whole sheet at most, pixels.
    pub width: u32,
    /// Rows of the whole sheet at most, pixels.
    pub height: u32,
}

impl Default for SheetOptions {
    fn default() -> SheetOptions {
        SheetOptions { picture: 320, width: 4096, height: 8192 }
    }
}

/// One view of a sheet.
#[derive(Clone, Debug, PartialEq)]
pub struct Tile {
    /// The view's name.
    pub name: String,
    /// The photograph, reduced, with outline and band.
    pub picture: Photo,
    /// Share of the picture that is head, 0..=1.
    pub coverage: f64,
    /// Share that is unsure, where that is known.
    pub unsure: Option<f64>,
    /// Why a person should look.
    pub suspicions: Vec<String>,
}

impl Tile {
    /// Draws the mask of a view over its photograph; the mask and the trimap may have other sizes than it. What makes
    /// the mask suspicious by itself is added to `suspicions`.
    pub fn new(
        name: &str,
        photo: &Photo,
        alpha: &Gray,
        trimap: Option<&Gray>,
        mut suspicions: Vec<String>,
        options: &SheetOptions,
    ) -> Tile {
        suspicions.extend(findings(alpha).into_iter().map(String::from));
        let size = working_size(photo.width, photo.height, options.picture.max(1));
        let mut picture = reduce_photo(photo, size);
        picture.alpha = None;
        if let Some(trimap) = trimap {
            let values = trimap.values.iter().map(|&v| if v == UNSURE { 255 } else { 0 }).collect();
            let unsure = brought_to(&Gray { values, ..*trimap }, size);
            for (pixel, &u) in picture.rgb.iter_mut().zip(&unsure.values) {
                *pixel = mixed(*pixel, BAND, u as f32 / 255.0 * 0.4);
            }
        }
        outline(&mut picture, &brought_to(alpha, size));
        let unsure = trimap.map(unsure_share);
        Tile { name: name.into(), picture, coverage: coverage(alpha), unsure, suspicions }
    }
}

/// A grey picture at another size: averaged where it is larger, else its nearest pixels.
fn brought_to(gray: &Gray, size: (u32, u32)) -> Gray {
    if gray.width >= size.0 && gray.height >= size.1 {
        return reduce_gray(gray, size);
    }
    let at = |i: u32, to: u32, from: u32| (i as u64 * from as u64 / to as u64) as usize;
    let pixel = |i: u32| {
        let (x, y) = (at(i % size.0, size.0, gray.width), at(i / size.0, size.1, gray.height));
        gray.values[y * gray.width as usize + x]
    };
    Gray { width: size.0, height: size.1, values: (0..size.0 * size.1).map(pixel).collect() }
}

fn mixed(a: [u8; 3], b: [u8; 3], share: f32) -> [u8; 3] {
    [0, 1, 2].map(|k| (a[k] as f32 + share * (b[k] as f32 - a[k] as f32) + 0.5) as u8)
}

/// The rim of the mask in colour, and the pixels next to it outside darker, so that it shows on any ground.
fn outline(picture: &mut Photo, mask: &Gray) {
    let (w, h) = (mask.width as i64, mask.height as i64);
    let head = |x: i64, y: i64| {
        let inside = (0..w).contains(&x) && (0..h).contains(&y);
        inside.then(|| mask.values[(y * w + x) as usize] >= 128)
    };
    for (i, pixel) in picture.rgb.iter_mut().enumerate() {
        let (x, y) = (i as i64 % w, i as i64 / w);
        let own = head(x, y);
        let around = [(x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)];
        // beyond the border nothing is known, so no line is drawn along it
        if around.into_iter().filter_map(|(x, y)| head(x, y)).any(|other| Some(other) != own) {
            *pixel = if own == Some(true) { OUTLINE } else { mixed(*pixel, [0; 3], 0.6) };
        }
    }
}

/// The sheet of these views, in their order, as square as they allow. When there are more than fit, suspicious ones
/// and evenly spread others are shown, and a last line says so. No views give a single dark pixel.
pub fn sheet(tiles: &[Tile], options: &SheetOptions) -> Photo {
    let side = |f: fn(&Photo) -> u32| tiles.iter().map(|t| f(&t.picture)).max().unwrap_or(1);
    let (widest, tallest) = (side(|p| p.width), side(|p| p.height));
    let cell_width = widest.max(60) + 2 * MARGIN;
    let scale = if cell_width >= 200 { 2 } else { 1 };
    let line = (font::HEIGHT + LINE_GAP) * scale;
    let letters = ((cell_width - 2 * MARGIN) / (font::ADVANCE * scale)) as usize;
    let captions: Vec<Vec<(String, [u8; 3])>> = tiles.iter().map(|t| caption(t, letters)).collect();
    let lines = captions.iter().map(Vec::len).max().unwrap_or(0) as u32;
    let cell_height = tallest + 2 * MARGIN + lines * line;

    let most_columns = (options.width / cell_width).max(1) as usize;
    let most_rows = (options.height.saturating_sub(line + MARGIN) / cell_height).max(1) as usize;
    let shown = spread(tiles.len(), most_columns * most_rows, |i| !tiles[i].suspicions.is_empty());
    let square = (shown.len() as f64 * cell_height as f64 / cell_width as f64).sqrt().ceil() as usize;
    let columns = square.clamp(shown.len().div_ceil(most_rows).max(1), most_columns);
    let rows = shown.len().div_ceil(columns) as u32;
    let note = shown.len() < tiles.len();
    let width = (columns as u32 * cell_width).min(options.width.max(1));
    let height = (rows * cell_height + if note { line + MARGIN } else { 0 }).clamp(1, options.height.max(1));
    let mut out = Photo { width, height, rgb: vec![STAGE; width as usize * height as usize], alpha: None };

    for (k, &i) in shown.iter().enumerate() {
        let tile = &tiles[i];
        let (left, top) = ((k % columns) as u32 * cell_width, (k / columns) as u32 * cell_height);
        let picture = &tile.picture;
        let x0 = left + (cell_width - picture.width) / 2;
        let y0 = top + MARGIN + (tallest - picture.height);
        if !tile.suspicions.is_empty() {
            let (w, h) = (picture.width + 2 * FRAME, picture.height + 2 * FRAME);
            fill(&mut out, x0 - FRAME, y0 - FRAME, w, h, ALARM);
        }
        for (i, &color) in (0u32..).zip(&picture.rgb) {
            set(&mut out, x0 + i % picture.width, y0 + i / picture.width, color);
        }
        let mut y = top + 2 * MARGIN + tallest;
        for (text, color) in &captions[i] {
            font::ink(text, scale, |dx, dy| set(&mut out, left + MARGIN + dx, y + dy, *color));
            y += line;
        }
    }
    if note {
        let text = format!("{} of {} views", shown.len(), tiles.len());
        font::ink(&text, scale, |dx, dy| set(&mut out, MARGIN + dx, rows * cell_height + dy, TEXT));
    }
    out
}

fn set(out: &mut Photo, x: u32, y: u32, color: [u8; 3]) {
    if x < out.width && y < out.height {
        out.rgb[y as usize * out.width as usize + x as usize] = color;
    }
}

fn fill(out: &mut Photo, x: u32, y: u32, w: u32, h: u32, color: [u8; 3]) {
    (0..w * h).for_each(|i| set(out, x + i % w, y + i / w, color));
}

/// What stands below a picture, in lines of at most so many letters.
fn caption(tile: &Tile, letters: usize) -> Vec<(String, [u8; 3])> {
    let name: Vec<char> = tile.name.chars().collect();
    // names differ at their ends
    let name = match name.len().checked_sub(letters) {
        Some(1..) => ["..".into(), name[name.len() + 2 - letters..].iter().collect::<String>()].concat(),
        _ => tile.name.clone(),
    };
    let mut lines = vec![(name, TEXT)];
    lines.push((format!("head {:.1} %", 100.0 * tile.coverage), TEXT));
    lines.extend(tile.unsure.map(|u| (format!("unsure {:.1} %", 100.0 * u), TEXT)));
    for suspicion in &tile.suspicions {
        lines.extend(wrapped(suspicion, letters, 3).into_iter().map(|l| (l, ALARM)));
    }
    lines.truncate(8);
    lines
}

/// Words in at most `most` lines; what does not fit ends in dots.
fn wrapped(text: &str, letters: usize, most: usize) -> Vec<String> {
    let mut lines: Vec<String> = vec![String::new()];
    for word in text.split_whitespace() {
        let last = lines.len() - 1;
        let used = lines[last].chars().count();
        if used > 0 && used + 1 + word.chars().count() > letters {
            lines.push(word.into());
        } else {
            let gap = if used > 0 { " " } else { "" };
            lines[last] += &format!("{gap}{word}");
        }
    }
    let cut = lines.len() > most;
    lines.truncate(most);
    for (i, line) in lines.iter_mut().enumerate() {
        let dots = line.chars().count() > letters || (cut && i + 1 == most);
        if dots {
            *line = line.chars().take(letters.saturating_sub(2)).collect::<String>() + "..";
        }
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gray(w: u32, h: u32, value: impl Fn(u32, u32) -> u8) -> Gray {
        Gray { width: w, height: h, values: (0..w * h).map(|i| value(i % w, i / w)).collect() }
    }

    fn photo(w: u32, h: u32) -> Photo {
        Photo { width: w, height: h, rgb: vec![[100; 3]; (w * h) as usize], alpha: None }
    }

    fn good(name: &str) -> Tile {
        let alpha = gray(60, 80, |x, y| if (20..40).contains(&x) && y >= 40 { 255 } else { 0 });
        Tile::new(name, &photo(60, 80), &alpha, None, vec![], &SheetOptions::default())
    }

    fn count(picture: &Photo, color: [u8; 3]) -> usize {
        picture.rgb.iter().filter(|&&c| c == color).count()
    }

    #[test]
    fn the_rim_is_drawn_inside_the_mask_and_the_ground_beside_it_darkened() {
        let tile = good("a");
        // 20 wide, 40 high, open at the lower border: 40 + 40 + 20 less two shared corners
        assert_eq!(count(&tile.picture, OUTLINE), 98);
        assert_eq!(count(&tile.picture, [40; 3]), 40 + 40 + 20);
        // 800 of 4800 pixels
        assert!(
            (tile.coverage - 1.0 / 6.0).abs() < 1e-12 && tile.suspicions.is_empty() && tile.unsure.is_none()
        );
    }

    #[test]
    fn the_band_is_tinted_also_when_its_trimap_has_another_size() {
        let alpha = gray(60, 80, |x, _| if x >= 30 { 255 } else { 0 });
        for scale in [1, 2, 10] {
            let trimap = gray(60 / scale, 80 / scale, |x, _| match x * scale {
                0..20 => 0,
                20..40 => UNSURE,
                _ => 255,
            });
            let tile =
                Tile::new("a", &photo(60, 80), &alpha, Some(&trimap), vec![], &SheetOptions::default());
            // columns 20 to 39 but the rim at 30 and the dark one at 29: 100 + 0.4 (255 − 100) = 162
            assert_eq!(count(&tile.picture, [162, 140, 60]), 18 * 80, "{scale}");
            assert!((tile.unsure.unwrap() - 1.0 / 3.0).abs() < 1e-9);
        }
    }

    #[test]
    fn suspicious_views_are_framed_and_say_why() {
        let white = gray(60, 80, |_, _| 255);
        let tile =
            Tile::new("b", &photo(60, 80), &white, None, vec!["disagrees".into()], &SheetOptions::default());
        assert_eq!(tile.suspicions, ["disagrees", "is white everywhere"]);
        let fine = sheet(&[good("a")], &SheetOptions::default());
        let odd = sheet(&[good("a"), tile], &SheetOptions::default());
        assert_eq!(count(&fine, ALARM), 0);
        // the frame alone is 4 wide around 60 × 80: 68 · 88 − 60 · 80
        assert!(count(&odd, ALARM) > 68 * 88 - 60 * 80 + 50, "{}", count(&odd, ALARM));
    }

    #[test]
    fn a_sheet_stays_within_its_bounds_and_says_what_it_leaves_out() {
        let mut tiles: Vec<Tile> = (0..300).map(|i| good(&format!("view {i}"))).collect();
        tiles[299].suspicions.push("odd".into());
        let options = SheetOptions { picture: 320, width: 500, height: 600 };
        let out = sheet(&tiles, &options);
        assert!(out.width <= 500 && out.height <= 600, "{} × {}", out.width, out.height);
        assert!(count(&out, ALARM) > 0, "the suspicious view is among those shown");
        // never wider or higher, even if not one picture fits
        let tiny = sheet(&tiles, &SheetOptions { picture: 320, width: 30, height: 20 });
        assert!(
            tiny.width <= 30 && tiny.height <= 20 && tiny.rgb.len() == (tiny.width * tiny.height) as usize
        );
        let none = sheet(&[], &SheetOptions::default());
        assert_eq!(none.rgb.len(), (none.width * none.height) as usize);
    }

    #[test]
    fn twenty_four_upright_photographs_make_a_nearly_square_sheet() {
        let out = sheet(&vec![good("a"); 24], &SheetOptions::default());
        let ratio = out.width as f64 / out.height as f64;
        assert!((0.7..1.5).contains(&ratio), "{} × {}", out.width, out.height);
    }

    #[test]
    fn long_names_keep_their_ends_and_long_sentences_are_wrapped() {
        let mut tile = good("a/very/long/folder/with/camera_07");
        tile.suspicions.push("touches three borders or more".into());
        let lines: Vec<String> = caption(&tile, 12).into_iter().map(|l| l.0).collect();
        assert_eq!(lines, ["../camera_07", "head 16.7 %", "touches", "three", "borders or.."]);
        assert!(lines.iter().all(|l| l.chars().count() <= 12));
        assert_eq!(wrapped("one unbreakableword", 6, 3), ["one", "unbr.."]);
    }
}
