//! Pages of masks, one HTML file each: the annotation page to click on, and the contact sheet.
//!
//! **Annotation page**: photographs in, `prompts.json` out. The pages load and send no data:
//! photographs lie inside as JPEG, reduced, while clicks are counted in pixels of the originals.
//! The page's own text is `annotation.html`; names of files reach it only as JSON in which no
//! character can end the element that holds it.
//!
//! **Contact sheet**: all masks over their photographs, to see at a glance which went wrong. The
//! mask's outline is cyan, the unknown band yellow; below each picture stand the view's name, how
//! much the mask covers and how much is unknown. Suspicious views have a red frame and list the
//! reasons. The sheet is HTML with the pictures inside: a page of its own, and a part of the
//! report.

use super::matting::{UNKNOWN, unknown_share};
use super::prompts::{Prompts, file_path};
use crate::report::{base64, escape};
use minijinja::{Environment, context};
use rayon::prelude::*;
use serde::Serialize;
use serde_json::{Value, json};
use std::path::Path;
use tiface_base::image::{Gray, Photo, reduce_photo, resize_gray, resize_hard, working_size};
use tiface_base::io::{self, Limits};
use tiface_base::{Error, ErrorKind, Result};
use tiface_capture::{Capture, View, coverage, findings};

const TEMPLATE: &str = include_str!("annotation.html");

/// Longest side of a photograph in the page, pixels.
const SIDE_PX: u32 = 1024;
/// JPEG quality of the photographs, 1 to 100.
const QUALITY: u8 = 85;
/// Photographs at most; of more, those with clicks and evenly spread ones are shown.
const MAX_VIEWS: usize = 200;

/// A photograph in the page.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PageView {
    /// As `prompts.json` names it.
    pub file_path: String,
    /// The size that clicks are counted in.
    pub size: (u32, u32),
    /// The reduced photograph as a JPEG file.
    pub jpeg: Vec<u8>,
}

impl PageView {
    /// Codes a photograph, reduced to at most `side` pixels; `size` is what clicks on it are
    /// counted in.
    fn new(file_path: String, size: (u32, u32), photo: &Photo, side: u32) -> Result<PageView> {
        let small = reduce_photo(photo, working_size(photo.width, photo.height, side));
        let jpeg = io::jpeg_bytes(&small, QUALITY, Path::new(&file_path))?;
        Ok(PageView { file_path, size, jpeg })
    }
}

/// Returns the page of a capture, with existing clicks.
///
/// # Errors
/// When a photograph cannot be read.
pub fn page_of(capture: &Capture, prompts: &Prompts, limits: &Limits) -> Result<String> {
    let clicked = prompts.clicks("prompts.json", capture).unwrap_or_default();
    let clicked = |i: usize| clicked.get(i).is_some_and(|points| !points.is_empty());
    let chosen = evenly(capture.views.len(), MAX_VIEWS, clicked);
    let read = |view: &View| {
        let photo = view.whole_photo(limits)?;
        PageView::new(file_path(capture, view), view.declared, &photo, SIDE_PX)
    };
    let mut views = Vec::with_capacity(chosen.len());
    // a few at a time: photographs are large
    for few in chosen.chunks(rayon::current_num_threads().max(1)) {
        let coded: Vec<Result<PageView>> = few.par_iter().map(|&i| read(&capture.views[i])).collect();
        for view in coded {
            views.push(view?);
        }
    }
    Ok(page(&capture.name, &views, prompts))
}

/// At most `max_count` of `count` indices in order: those that `wanted` names first, the others
/// evenly.
fn evenly(count: usize, max_count: usize, wanted: impl Fn(usize) -> bool) -> Vec<usize> {
    let named: Vec<usize> = (0..count).filter(|&i| wanted(i)).take(max_count).collect();
    let rest: Vec<usize> = (0..count).filter(|i| named.binary_search(i).is_err()).collect();
    let remaining = (max_count - named.len()).min(rest.len());
    let mut chosen: Vec<usize> =
        (0..remaining).map(|k| rest[k * rest.len() / remaining]).chain(named).collect();
    chosen.sort_unstable();
    chosen
}

/// Returns the page.
pub fn page(title: &str, views: &[PageView], prompts: &Prompts) -> String {
    let view = |v: &PageView| {
        let src = format!("data:image/jpeg;base64,{}", base64(&v.jpeg));
        json!({"file_path": v.file_path, "width": v.size.0, "height": v.size.1, "src": src})
    };
    let views: Vec<Value> = views.iter().map(view).collect();
    let data = inside_script(&json!({"views": views, "prompts": prompts.to_json()}));
    let (before, after) = TEMPLATE.split_once("__DATA__").unwrap_or((TEMPLATE, ""));
    // the title goes into the part before the data, so one that says `__DATA__` stays as it is
    let before = before.replace("__TITLE__", &escape(title));
    [&before, data.as_str(), after].concat()
}

/// JSON that may stand inside a `<script>`: `<`, `>` and `&` occur only within strings, where they
/// can be written as escapes.
fn inside_script(value: &Value) -> String {
    value.to_string().replace('<', "\\u003c").replace('>', "\\u003e").replace('&', "\\u0026")
}

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
    use super::super::Click;
    use super::super::prompts::PhotoPrompts;
    use super::*;

    const HOSTILE: &str = "images/</script><script>alert(1)</script>&\u{2028}\"__DATA__.png";

    fn view(name: &str) -> PageView {
        PageView { file_path: name.into(), size: (3000, 4096), jpeg: vec![0xFF, 0xD8, 1] }
    }

    /// Returns what the page's script will find.
    fn data(page: &str) -> Value {
        let text = page.split_once("id=\"data\">").unwrap().1.split_once("</script>").unwrap().0;
        serde_json::from_str(text).unwrap()
    }

    #[test]
    fn names_cannot_leave_the_element_they_are_in() {
        let points = vec![Click { x: 3.0, y: 4.0, head: true }];
        let prompts = Prompts { frames: vec![PhotoPrompts { file_path: HOSTILE.into(), points }] };
        let page = page("<b>__DATA__</b>", &[view(HOSTILE), view("b.jpg")], &prompts);
        // the two scripts of the template and nothing else
        assert_eq!(page.matches("<script").count(), 2);
        assert_eq!(page.matches("</script").count(), 2);
        assert!(page.contains("<h1>&lt;b&gt;__DATA__&lt;/b&gt;</h1>"));
        let data = data(&page);
        assert_eq!(data["views"][0]["file_path"], HOSTILE);
        assert_eq!(data["views"][1]["height"], 4096);
        assert_eq!(data["views"][1]["src"], "data:image/jpeg;base64,/9gB");
        assert_eq!(data["prompts"]["frames"][0]["points"][0], json!({"x": 3, "y": 4, "label": 1}));
    }

    #[test]
    fn nothing_is_loaded_from_elsewhere() {
        let page = page("t", &[view("a")], &Prompts::default());
        // the one address is the name of SVG's vocabulary, which is never fetched
        let addresses: Vec<_> = page.match_indices("http").map(|(i, _)| &page[i..i + 26]).collect();
        assert!(
            addresses
                .iter()
                .all(|a| a.starts_with("http://www.w3.org/2000/svg") || a.starts_with("http-equiv"))
        );
        assert!(!page.contains("src=\"") && page.contains("default-src 'none'"));
    }

    #[test]
    fn too_many_views_are_thinned_evenly_but_clicked_ones_stay() {
        assert_eq!(evenly(4, 10, |_| false), [0, 1, 2, 3]);
        assert_eq!(evenly(10, 5, |_| false), [0, 2, 4, 6, 8]);
        // 7 stays; two of the nine others, the first of each half: 0 and the fifth, 4
        assert_eq!(evenly(10, 3, |i| i == 7), [0, 4, 7]);
        assert_eq!(evenly(10, 2, |i| i > 3), [4, 5]);
        assert!(evenly(0, 5, |_| true).is_empty() && evenly(5, 0, |_| true).is_empty());
    }

    #[test]
    fn photographs_are_reduced_and_coded() {
        let photo = Photo { width: 64, height: 32, rgb: vec![[200, 100, 50]; 2048], alpha: None };
        let view = PageView::new("a.png".into(), (640, 320), &photo, 16).unwrap();
        let small = io::parse_photo(&view.jpeg, Path::new("a"), &Limits::default()).unwrap();
        assert_eq!((small.width, small.height, view.size), (16, 8, (640, 320)));
        assert!(
            small.rgb[40].iter().zip([200u8, 100, 50]).all(|(a, b)| a.abs_diff(b) < 4),
            "{:?}",
            small.rgb[40]
        );
        let none = Photo { width: 0, height: 0, rgb: vec![], alpha: None };
        assert!(PageView::new("a".into(), (1, 1), &none, 16).is_err());
    }

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
