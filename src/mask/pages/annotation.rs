//! The annotation page: photographs in, `prompts.json` out.
//!
//! The page loads and sends no data: photographs lie inside as JPEG, reduced, while clicks are
//! counted in pixels of the originals. Its own text is `annotation.html`; names of files reach it
//! only as JSON in which no character can end the element that holds it.

use super::super::prompts::{Prompts, file_path};
use super::evenly;
use crate::report::{base64, escape};
use rayon::prelude::*;
use serde_json::{Value, json};
use std::path::Path;
use tiface_base::Result;
use tiface_base::image::{Photo, reduce_photo, working_size};
use tiface_base::io::{self, Limits};
use tiface_capture::{Capture, View};

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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mask::Click;
    use crate::mask::prompts::PhotoPrompts;

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
}
