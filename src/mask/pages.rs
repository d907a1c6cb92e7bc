//! Pages of masks, one HTML file each: the annotation page to click on, and the contact sheet.

mod annotation;
mod sheet;

pub use annotation::{PageView, page, page_of};
pub use sheet::{SheetView, part, sheet};

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
