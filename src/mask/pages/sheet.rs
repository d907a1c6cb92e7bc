//! The contact sheet: all masks over their photographs, to see at a glance which went wrong.
//!
//! The mask's outline is cyan, the unknown band yellow; below each picture stand the view's name,
//! how much the mask covers and how much is unknown. Suspicious views have a red frame and list the
//! reasons. The sheet is HTML with the pictures inside: a page of its own, and a part of the
//! report.

use super::super::matting::{UNKNOWN, unknown_share};
use super::evenly;
use crate::report::base64;
use minijinja::{Environment, context};
use serde::Serialize;
use std::path::Path;
use tiface_base::image::{Gray, Photo, reduce_photo, resize_gray, resize_hard, working_size};
use tiface_base::{Error, ErrorKind, Result, io};
use tiface_capture::{coverage, findings};

const OUTLINE: [u8; 3] = [0, 230, 255];

const BAND: [u8; 3] = [255, 200, 0];

/// Longest side of a picture on the sheet, pixels: about 20 kB each.
const PICTURE_PX: u32 = 320;

/// Pictures on a sheet at most, about 10 MB of them.
const MAX_PICTURES: usize = 500;

/// Page around a sheet.
const SHEET_MARKERS: [&str; 2] = ["<!-- sheet -->", "<!-- end of the sheet -->"];

/// One view of a sheet.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SheetView {
    /// The view's name.
    pub name: String,
    /// The photograph, reduced, with outline and band: a `data:` address.
    pub picture: String,
    /// Shares of the picture that are head and, if known, unknown: in words.
    pub shares: String,
    /// Reasons for a manual check.
    pub suspicions: Vec<String>,
}

impl SheetView {
    /// Draws the mask of a view over its photograph and lists what makes the mask suspicious
    /// without comparison; the mask and the trimap may have other sizes than the photograph.
    pub fn new(name: &str, photo: &Photo, alpha: &Gray, trimap: Option<&Gray>) -> Result<SheetView> {
        let picture = io::jpeg_bytes(&overlaid(photo, alpha, trimap, PICTURE_PX), 85, Path::new(name))?;
        let unknown = trimap.map(|t| format!(", unknown {:.1} %", 100.0 * unknown_share(t)));
        Ok(SheetView {
            name: name.into(),
            picture: format!("data:image/jpeg;base64,{}", base64(&picture)),
            shares: format!("head {:.1} %{}", 100.0 * coverage(alpha), unknown.unwrap_or_default()),
            suspicions: findings(alpha).into_iter().map(String::from).collect(),
        })
    }
}

/// Returns the reduced photograph with the mask's outline and the unknown band drawn into it.
fn overlaid(photo: &Photo, alpha: &Gray, trimap: Option<&Gray>, side: u32) -> Photo {
    let size = working_size(photo.width, photo.height, side);
    let mut picture = reduce_photo(photo, size);
    if let Some(trimap) = trimap {
        let values = trimap.values.iter().map(|&v| if v == UNKNOWN { 255 } else { 0 }).collect();
        let unknown = Gray { values, ..*trimap };
        // a smaller one keeps its width
        let resize = if trimap.width < size.0 { resize_hard } else { resize_gray };
        let unknown = resize(&unknown, size);
        for (pixel, &u) in picture.rgb.iter_mut().zip(&unknown.values) {
            *pixel = mixed(*pixel, BAND, u as f32 / 255.0 * 0.4);
        }
    }
    outline(&mut picture, &resize_gray(alpha, size));
    picture
}

fn mixed(a: [u8; 3], b: [u8; 3], share: f32) -> [u8; 3] {
    [0, 1, 2].map(|k| (a[k] as f32 + share * (b[k] as f32 - a[k] as f32) + 0.5) as u8)
}

/// Draws the rim of the mask in color, and the pixels next to it outside darker, so that it shows
/// on any ground.
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

/// Returns the sheet of these views, in their order, as a page of its own. If not all fit,
/// suspicious ones and evenly spread others are shown, and a last line says so.
pub fn sheet(views: &[SheetView]) -> Result<String> {
    let shown = evenly(views.len(), MAX_PICTURES, |i| !views[i].suspicions.is_empty());
    let shown: Vec<&SheetView> = shown.into_iter().map(|i| &views[i]).collect();
    let mut pages = Environment::new();
    pages.set_trim_blocks(true);
    let page = pages.template_from_named_str("sheet.html", include_str!("sheet.html"));
    let page = page.and_then(|page| page.render(context! { views => shown, total => views.len() }));
    page.map_err(|e| Error::new(ErrorKind::Bug, e))
}

/// Returns what a [`sheet`] shows, without the page around it: for a page with more, in about
/// `max_bytes` bytes. Where not all views fit, suspicious ones and evenly spread others stay.
pub fn part(sheet: &str, max_bytes: usize) -> Option<String> {
    let inside = sheet.split_once(SHEET_MARKERS[0])?.1.split_once(SHEET_MARKERS[1])?.0;
    let (head, rest) = inside.split_once("<figure")?;
    let (figures, tail) = rest.rsplit_once("</figure>")?;
    let figures: Vec<&str> =
        figures.split("<figure").map(|f| f.trim_end().trim_end_matches("</figure>")).collect();
    let remaining = max_bytes.saturating_mul(figures.len()) / inside.len();
    let shown = evenly(figures.len(), remaining, |i| figures[i].starts_with(" class=\"odd\""));
    let shown: Vec<String> = shown.into_iter().map(|i| format!("<figure{}</figure>\n", figures[i])).collect();
    Some(format!("{head}{}{}", shown.concat(), tail.trim_start()))
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

    fn bust() -> Gray {
        gray(60, 80, |x, y| if (20..40).contains(&x) && y >= 40 { 255 } else { 0 })
    }

    fn count(picture: &Photo, color: [u8; 3]) -> usize {
        picture.rgb.iter().filter(|&&c| c == color).count()
    }

    #[test]
    fn the_rim_is_drawn_inside_the_mask_and_the_ground_beside_it_darkened() {
        let picture = overlaid(&photo(60, 80), &bust(), None, 320);
        // 20 wide, 40 high, open at the lower border: 40 + 40 + 20 less two shared corners
        assert_eq!(count(&picture, OUTLINE), 98);
        assert_eq!(count(&picture, [40; 3]), 40 + 40 + 20);
        let view = SheetView::new("a", &photo(60, 80), &bust(), None).unwrap();
        // 800 of 4800 pixels
        assert_eq!((view.shares.as_str(), view.suspicions.len()), ("head 16.7 %", 0));
    }

    #[test]
    fn the_band_is_tinted_also_when_its_trimap_has_another_size() {
        let alpha = gray(60, 80, |x, _| if x >= 30 { 255 } else { 0 });
        for scale in [1, 2, 10] {
            let trimap = gray(60 / scale, 80 / scale, |x, _| match x * scale {
                0..20 => 0,
                20..40 => UNKNOWN,
                _ => 255,
            });
            let picture = overlaid(&photo(60, 80), &alpha, Some(&trimap), 320);
            // columns 20 to 39 but the rim at 30 and the dark one at 29: 100 + 0.4 (255 − 100) =
            // 162
            assert_eq!(count(&picture, [162, 140, 60]), 18 * 80, "{scale}");
            let view = SheetView::new("a", &photo(60, 80), &alpha, Some(&trimap)).unwrap();
            assert_eq!(view.shares, "head 50.0 %, unknown 33.3 %");
        }
    }

    #[test]
    fn suspicious_views_are_framed_and_say_why_and_names_cannot_end_the_page() {
        let fine = SheetView::new("a", &photo(60, 80), &bust(), None).unwrap();
        let mut odd = SheetView::new("<b>\"&", &photo(60, 80), &gray(60, 80, |_, _| 255), None).unwrap();
        odd.suspicions.push("disagrees".into());
        assert_eq!(odd.suspicions, ["is white everywhere", "disagrees"]);
        let page = sheet(&[fine.clone(), odd]).unwrap();
        assert_eq!(page.matches("<figure").count(), 2);
        assert_eq!(page.matches("<figure class=\"odd\">").count(), 1);
        assert!(page.contains("<b>&lt;b&gt;&quot;&amp;</b>") && !page.contains("<b><b>"), "{page}");
        assert!(
            page.contains("is white everywhere") && page.contains("head 16.7 %") && !page.contains("://")
        );
        assert_eq!(sheet(&[fine]).unwrap().matches("class=\"odd\"").count(), 0);
    }

    #[test]
    fn a_sheet_of_very_many_views_says_what_it_leaves_out_and_keeps_the_suspicious() {
        let mut views = vec![SheetView::new("a", &photo(6, 8), &bust(), None).unwrap(); MAX_PICTURES + 100];
        views.iter_mut().for_each(|t| t.suspicions.clear());
        views[MAX_PICTURES + 99].suspicions.push("odd".into());
        let page = sheet(&views).unwrap();
        assert_eq!(page.matches("<figure").count(), MAX_PICTURES);
        assert!(page.contains("class=\"odd\"") && page.contains("<p>500 of 600 views.</p>"));
        assert!(!sheet(&[]).unwrap().contains("<figure"));
    }

    #[test]
    fn a_part_of_a_sheet_has_its_pictures_and_no_page_around_them() {
        let page = sheet(&[SheetView::new("a", &photo(60, 80), &bust(), None).unwrap()]).unwrap();
        let part = part(&page, usize::MAX).unwrap();
        assert!(part.contains("<figure>") && !part.contains("<html") && !part.contains("</body>"));
        assert_eq!(super::part("another page", usize::MAX), None);
    }

    #[test]
    fn a_part_with_little_room_keeps_what_is_suspicious() {
        let mut views = vec![SheetView::new("a", &photo(60, 80), &bust(), None).unwrap(); 8];
        views.iter_mut().for_each(|v| v.suspicions.clear());
        views[5].suspicions.push("odd".into());
        let page = sheet(&views).unwrap();
        let whole = part(&page, usize::MAX).unwrap();
        for (room, figures) in [(usize::MAX, 8), (whole.len() / 2, 3), (0, 0)] {
            let part = part(&page, room).unwrap();
            let found = (part.matches("<figure").count(), part.matches("</figure>").count());
            assert!(found.0 == found.1 && found.0.abs_diff(figures) <= 1, "{found:?} of {figures}");
            assert_eq!(part.contains("class=\"odd\""), figures > 0);
            assert!(part.trim_end().ends_with("</div>"));
        }
    }
}
