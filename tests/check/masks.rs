//! Masks from the clicks that come with the shared captures, against their true masks.
//!
//! They lie beside the repository, or where `TIFACE_SHARED` says; without them these tests skip,
//! aloud.

use crate::clicked::{self, Clicked, mean_worst, overlap};
use std::sync::OnceLock;
use tiface::image::Gray;
use tiface::mask::Click;
use tiface::mask::consistency::{Consistency, ConsistencyView, check_consistency};
use tiface::mask::grabcut::grabcut;
use tiface::mask::propagate::{HardMasks, PropagateView, propagate};

/// Returns a shared capture, if it is there. It is read once.
fn read(name: &str) -> Option<&'static Clicked> {
    static LPS: OnceLock<Option<Clicked>> = OnceLock::new();
    static NEFERTITI: OnceLock<Option<Clicked>> = OnceLock::new();
    let kept = if name == "lps" { &LPS } else { &NEFERTITI };
    kept.get_or_init(|| clicked::read(name)).as_ref()
}

fn clicked_views(c: &Clicked) -> Vec<f64> {
    let clicked = (0..c.views.len()).filter(|&i| !c.clicks[i].is_empty());
    clicked
        .map(|i| {
            let cut = grabcut(&c.views[i].name, &c.photos[i], &c.clicks[i]).unwrap();
            assert!(cut.warnings.is_empty(), "{:?}", cut.warnings);
            overlap(&cut.mask, &c.truth[i])
        })
        .collect()
}

fn all_views(c: &Clicked) -> HardMasks {
    let views: Vec<PropagateView> = (c.views.iter().zip(&c.clicks))
        .map(|(v, clicks)| PropagateView { name: &v.name, camera: &v.camera, clicks, votes: true })
        .collect();
    propagate(&views, |i| Ok(c.photos[i].clone())).unwrap()
}

fn compare(c: &Clicked, masks: &[Gray]) -> Consistency {
    let views: Vec<ConsistencyView> = (c.views.iter().zip(masks))
        .map(|(v, mask)| ConsistencyView { name: &v.name, camera: &v.camera, mask: Some(mask) })
        .collect();
    check_consistency(&views).unwrap()
}

fn names(found: &Consistency) -> Vec<usize> {
    found.conflicts.iter().map(|d| d.view).collect()
}

/// Returns every so-manyth view of a capture, and those with clicks.
fn thinned(c: &Clicked, every: usize) -> Clicked {
    fn some<T: Clone>(all: &[T], kept: &[usize]) -> Vec<T> {
        kept.iter().map(|&i| all[i].clone()).collect()
    }
    let is_kept = |&i: &usize| i % every == 0 || !c.clicks[i].is_empty();
    let kept: Vec<usize> = (0..c.views.len()).filter(is_kept).collect();
    Clicked {
        views: some(&c.views, &kept),
        photos: some(&c.photos, &kept),
        truth: some(&c.truth, &kept),
        clicks: some(&c.clicks, &kept),
    }
}

/// The bars stand a little below what was measured of all views: see `cargo bench --bench masks`.
fn masks_of(name: &str, every: usize, clicked: (f64, f64), all: (f64, f64)) {
    let Some(c) = read(name) else { return };
    let c = &thinned(c, every);
    let (mean, worst) = mean_worst(&clicked_views(c));
    assert!(mean > clicked.0 && worst > clicked.1, "clicked views: mean {mean:.4}, worst {worst:.4}");
    let masks = all_views(c);
    let overlaps: Vec<f64> = masks.masks.iter().zip(&c.truth).map(|(m, t)| overlap(m, t)).collect();
    let (mean, worst) = mean_worst(&overlaps);
    assert!(mean > all.0 && worst > all.1, "all views: mean {mean:.4}, worst {worst:.4}");
    assert!(masks.warnings.is_empty(), "{:?}", masks.warnings);
    // what was made agrees with itself
    assert_eq!(names(&compare(c, &masks.masks)), [0usize; 0]);
}

#[test]
fn three_clicked_views_of_lps_mask_every_third() {
    masks_of("lps", 3, (0.980, 0.975), (0.979, 0.970));
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; the same for all views"]
fn three_clicked_views_of_lps_mask_all_of_them() {
    masks_of("lps", 1, (0.980, 0.975), (0.979, 0.970));
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; half a minute for the same claim on a second capture"]
fn three_clicked_views_of_nefertiti_mask_all_of_them() {
    masks_of("nefertiti", 1, (0.989, 0.985), (0.991, 0.985));
}

fn shifted(mask: &Gray, by: usize) -> Gray {
    let w = mask.width as usize;
    let at = |i: usize| if i % w >= by { mask.values[i - by] } else { 0 };
    Gray { values: (0..mask.values.len()).map(at).collect(), ..mask.clone() }
}

/// The true masks of a capture, and each of these views wrong in every way, masks of another person
/// among them.
fn wrong_masks_are_named(c: &Clicked, other: &Clicked, views: &[usize]) {
    let found = compare(c, &c.truth);
    assert!(found.conflicts.is_empty() && found.left < 1e-4, "{found:?}");
    for &i in views {
        let own = &c.truth[i];
        let inverted = Gray { values: own.values.iter().map(|v| 255 - v).collect(), ..own.clone() };
        let empty = Gray { values: vec![0; own.values.len()], ..own.clone() };
        let wrong = [
            ("inverted", inverted),
            ("empty", empty),
            // 5 % of the width
            ("shifted", shifted(own, 19)),
            ("of another view", c.truth[(i + 1) % 24].clone()),
            ("of another person", other.truth[i].clone()),
        ];
        for (what, mask) in wrong {
            let mut masks = c.truth.clone();
            masks[i] = mask;
            let found = compare(c, &masks);
            assert_eq!(names(&found), [i], "view {i} {what}: {:?}", found.conflicts);
        }
    }
}

#[test]
fn the_true_masks_agree_and_one_wrong_mask_among_them_is_named() {
    let (Some(a), Some(b)) = (read("lps"), read("nefertiti")) else { return };
    wrong_masks_are_named(a, b, &[12]);
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; the same for three views of two captures"]
fn one_wrong_mask_is_named_whichever_it_is() {
    let (Some(a), Some(b)) = (read("lps"), read("nefertiti")) else { return };
    wrong_masks_are_named(a, b, &[2, 12, 23]);
    wrong_masks_are_named(b, a, &[2, 12, 23]);
}

#[test]
fn clicks_that_say_nothing_are_refused_before_anything_is_cut() {
    let Some(c) = read("lps") else { return };
    let refused = |clicks: &[Click]| grabcut("010", &c.photos[10], clicks).unwrap_err().to_string();
    let beside = Click { x: 30.0, y: 50.0, head: false };
    assert!(refused(&[beside]).contains("none is on the head"));
    assert!(refused(&[Click { x: 384.0, head: true, ..beside }]).contains("is outside the photograph"));
}
