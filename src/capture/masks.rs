//! Which masks lie beside the photographs, and whether they look like masks of a head.

use super::listing::{Frame, Listing};
use super::names::Place;
use super::{Capture, CaptureError, CaptureOptions, MaskChoice, MaskMeaning, MaskSource, Split, View};
use crate::image::Gray;
use crate::io::{self, PictureInfo};
use std::path::{Path, PathBuf};

/// Names for a message: at most six, then how many more.
pub(super) fn few<'a>(names: impl Iterator<Item = &'a str>) -> String {
    let names: Vec<&str> = names.collect();
    let mut text = names.iter().take(6).map(|n| format!("`{n}`")).collect::<Vec<_>>().join(", ");
    if names.len() > 6 {
        text += &format!(" and {} more", names.len() - 6);
    }
    text
}

/// Decides where masks come from, once for the whole capture, and finds valid masks and regions.
///
/// `folder` is the one common to all photographs; mask folders lie beside it, or in the root.
pub(super) fn choose(
    place: &Place,
    folder: &Path,
    views: &mut [View],
    kept: &[(Frame, PictureInfo)],
    options: &CaptureOptions,
    listing: &mut Listing,
) {
    if let Err(problem) = choose_checked(place, folder, views, kept, options, listing) {
        listing.problems.push(problem);
    }
}

fn choose_checked(
    place: &Place,
    folder: &Path,
    views: &mut [View],
    kept: &[(Frame, PictureInfo)],
    options: &CaptureOptions,
    listing: &mut Listing,
) -> Result<(), CaptureError> {
    let beside = Beside { place, base: folder.parent().unwrap_or(Path::new("")).into() };
    let mut candidates: Vec<(String, Vec<MaskSource>)> = Vec::new();
    let alpha = |listing: &mut Listing| -> Result<Vec<MaskSource>, CaptureError> {
        if !kept.iter().any(|(_, info)| info.alpha) || all_opaque(views, kept, options, listing)? {
            return Ok(Vec::new());
        }
        let source = |info: &PictureInfo| if info.alpha { MaskSource::Alpha } else { MaskSource::None };
        Ok(kept.iter().map(|(_, info)| source(info)).collect())
    };
    let files = |pattern: &dyn Fn(&View) -> Vec<PathBuf>| -> Result<Vec<MaskSource>, CaptureError> {
        views
            .iter()
            .map(|v| Ok(beside.first(&pattern(v))?.map_or(MaskSource::None, MaskSource::File)))
            .collect()
    };
    match &options.masks {
        MaskChoice::None => {}
        MaskChoice::Alpha => {
            candidates.push(("the alpha channel of the photographs".into(), alpha(listing)?));
        }
        MaskChoice::Folder(name) => {
            let inside = place.relative("mask folder", name)?;
            let found = views
                .iter()
                .map(|v| {
                    let names = in_folder(&inside, v);
                    Ok(first_of(place, &names)?.map_or(MaskSource::None, MaskSource::File))
                })
                .collect::<Result<Vec<_>, CaptureError>>()?;
            candidates.push((format!("`{name}/`"), found));
        }
        MaskChoice::Auto => {
            candidates.push(("the alpha channel of the photographs".into(), alpha(listing)?));
            let named = kept.iter().map(|(f, _)| f.mask.clone().map_or(MaskSource::None, MaskSource::File));
            candidates.push(("`mask_path` of each frame".into(), named.collect()));
            candidates.push((
                "`vit_mask/NAME.png`".into(),
                files(&|v| vec![Path::new("vit_mask").join(format!("{}.png", v.name))])?,
            ));
            candidates.push((
                "`masks/NAME.png`".into(),
                files(&|v| vec![Path::new("masks").join(format!("{}.png", v.name))])?,
            ));
            candidates.push((
                "`masks/NAME.jpg.png`".into(),
                files(&|v| vec![Path::new("masks").join(full_name(v) + ".png")])?,
            ));
        }
    }
    let has = |s: &[MaskSource]| s.iter().filter(|m| **m != MaskSource::None).count();
    match candidates.into_iter().find(|(_, sources)| has(sources) > 0) {
        Some((text, sources)) => {
            let n = has(&sources);
            listing.reasons.push(format!("head masks from {text}, for {n} of {} views", views.len()));
            for (view, source) in views.iter_mut().zip(sources) {
                view.mask = source;
            }
            if n < views.len() {
                let without = views.iter().filter(|v| v.mask == MaskSource::None).map(|v| v.name.as_str());
                let mut text = format!("{} views have no mask: {}", views.len() - n, few(without));
                if options.mask_meaning == MaskMeaning::Empty {
                    text += "; what is learned with masks learns nothing from them";
                }
                listing.warnings.push(text);
            }
        }
        None => match &options.masks {
            MaskChoice::None => listing.reasons.push("masks are not used, as asked".into()),
            MaskChoice::Auto => listing.reasons.push("no masks are beside the photographs".into()),
            MaskChoice::Alpha => {
                listing.warnings.push("no photograph has a mask in its alpha channel".into())
            }
            MaskChoice::Folder(name) => {
                listing.warnings.push(format!("the mask folder `{name}` holds no mask for any view"));
            }
        },
    }

    let (mut valid, mut region) = (0, 0);
    for (view, (frame, _)) in views.iter_mut().zip(kept) {
        let names = ["masks", "valid"].map(|f| Path::new(f).join(format!("{}.npy", view.name)));
        view.valid = beside.first(&names)?;
        view.region = match &frame.region {
            Some(path) => Some(path.clone()),
            None => beside.first(&[Path::new("face_masks").join(format!("{}.png", view.name))])?,
        };
        valid += view.valid.is_some() as usize;
        region += view.region.is_some() as usize;
    }
    if valid > 0 {
        listing.reasons.push(format!("valid pixels from `.npy` files, for {valid} of {} views", views.len()));
    }
    if region > 0 {
        listing.reasons.push(format!("face regions for the metrics, for {region} of {} views", views.len()));
    }
    Ok(())
}

/// Are the head masks there that `options` ask for? Without, everything the cameras see would be learned as the head:
/// whoever wants that says so with [`MaskChoice::None`]. Held-out views need none, and of the others at least half must
/// have one.
pub fn require_masks(capture: &Capture, options: &CaptureOptions) -> Result<(), CaptureError> {
    if options.masks == MaskChoice::None {
        return Ok(());
    }
    let train: Vec<&View> = capture.split(Split::Train).collect();
    let without: Vec<&str> =
        train.iter().filter(|v| v.mask == MaskSource::None).map(|v| v.name.as_str()).collect();
    let (total, missing) = (train.len(), without.len());
    let problem = if missing == total {
        "no photograph that is learned from has a head mask: nothing says which pixels are background, and there is \
         no visual hull to start from"
            .into()
    } else if options.mask_meaning == MaskMeaning::Empty && 2 * missing > total {
        let named = few(without.into_iter());
        format!("{missing} of {total} photographs that are learned from have no head mask: {named}")
    } else {
        return Ok(());
    };
    let root = &capture.root;
    let shown = root.display();
    let prompts = root.join("prompts.json");
    let clicks = if io::is_file(&prompts) {
        format!("make them from the clicks that lie there: `--prompts {}`", prompts.display())
    } else {
        format!("click on three photographs: `tiface mask {shown} --page`, then `--prompts prompts.json`")
    };
    let photographs = train.first().and_then(|v| v.photo.parent()).unwrap_or(root).display();
    let hint = format!(
        "{clicks}; or put masks there, white on the head, found by themselves as alpha, `mask_path`, `vit_mask/NAME.png` \
         or `masks/NAME.png` (a background remover writes them: `rembg p -om {photographs} {shown}/masks`), or in a \
         folder named with `--set capture.mask_dir=FOLDER`; or go on without any, and learn whatever the cameras see: \
         `--set mask.source=none`"
    );
    Err(CaptureError::NoMasks { root: root.clone(), problem, hint })
}

/// Folders beside the photographs' own, else in the capture's root.
struct Beside<'a> {
    place: &'a Place,
    base: PathBuf,
}

impl Beside<'_> {
    fn first(&self, names: &[PathBuf]) -> Result<Option<PathBuf>, CaptureError> {
        let near: Vec<PathBuf> = names.iter().map(|n| self.base.join(n)).collect();
        match first_of(self.place, &near)? {
            None if !self.base.as_os_str().is_empty() => first_of(self.place, names),
            found => Ok(found),
        }
    }
}

fn first_of(place: &Place, names: &[PathBuf]) -> Result<Option<PathBuf>, CaptureError> {
    for name in names {
        if let Some(path) = place.file("masks", name)? {
            return Ok(Some(path));
        }
    }
    Ok(None)
}

/// A view's name with its photograph's ending.
fn full_name(view: &View) -> String {
    let ending = view.photo.extension().unwrap_or_default().to_string_lossy();
    format!("{}.{ending}", view.name)
}

fn in_folder(folder: &Path, view: &View) -> Vec<PathBuf> {
    let stem = &view.name;
    [format!("{stem}.png"), full_name(view) + ".png", format!("{stem}.jpg"), format!("{stem}.jpeg")]
        .iter()
        .map(|n| folder.join(n))
        .collect()
}

/// Is the alpha channel only a formality? Three photographs decide: an exporter that adds an opaque
/// alpha adds it to all.
fn all_opaque(
    views: &[View],
    kept: &[(Frame, PictureInfo)],
    options: &CaptureOptions,
    listing: &mut Listing,
) -> Result<bool, CaptureError> {
    for (view, _) in views.iter().zip(kept).filter(|(_, (_, info))| info.alpha).take(3) {
        let photo = io::read_photo(&view.photo, Some(view.photo_size), &options.limits)?.photo;
        if photo.alpha.is_some_and(|a| a.iter().any(|&v| v != 255)) {
            return Ok(false);
        }
    }
    listing.warnings.push("the photographs' alpha channel is opaque everywhere, so it is no mask".into());
    Ok(true)
}

/// Share of the picture a soft mask covers, 0..=1.
pub fn coverage(mask: &Gray) -> f64 {
    let sum: u64 = mask.values.iter().map(|&v| v as u64).sum();
    sum as f64 / (255.0 * mask.values.len().max(1) as f64)
}

/// What makes a mask suspicious as the mask of a head: empty, all white, probably inverted, touching
/// three borders or more. A person should look; nothing is refused.
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
    if darkest >= 250 {
        return vec!["is white everywhere"];
    }
    let mean = |indices: &mut dyn Iterator<Item = usize>| {
        let (mut sum, mut n) = (0u64, 0u64);
        for i in indices {
            sum += mask.values[i] as u64;
            n += 1;
        }
        sum as f64 / (255 * n.max(1)) as f64
    };
    let top = mean(&mut (0..w));
    let bottom = mean(&mut (0..w).map(|x| (h - 1) * w + x));
    let left = mean(&mut (0..h).map(|y| y * w));
    let right = mean(&mut (0..h).map(|y| y * w + w - 1));
    // shoulders may leave through the lower part of the sides
    let upper = 3 * h / 5;
    let high_left = mean(&mut (0..upper).map(|y| y * w));
    let high_right = mean(&mut (0..upper).map(|y| y * w + w - 1));
    let rows = h / 3..h - h / 3;
    let columns = w / 3..w - w / 3;
    let middle = mean(&mut rows.flat_map(|y| columns.clone().map(move |x| y * w + x)));
    let mut found = Vec::new();
    if (top + bottom + left + right) / 4.0 > 0.75 && middle < 0.5 {
        found.push("looks inverted: white must keep the head");
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
    fn empty_white_and_binary_masks_are_named() {
        assert_eq!(findings(&disc(0, 0, (0.0, 0.0))), ["is empty"]);
        assert_eq!(findings(&disc(255, 255, (0.0, 0.0))), ["is white everywhere"]);
        assert!(findings(&disc(1, 0, (20.0, 15.0)))[0].contains("0 and 1"));
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
