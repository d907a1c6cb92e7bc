//! Finds the masks of a capture.

use super::folder::CaptureFolder;
use super::frame::{CameraFrame, Listing};
use super::mask_names;
use super::options::{CaptureOptions, MaskMeaning, MaskSource};
use super::view::{Capture, Split, View, ViewMask};
use std::collections::HashSet;
use std::path::{Path, PathBuf};
use tiface_base::error::counted;
use tiface_base::io::{self, Limits, PictureInfo};
use tiface_base::{Error, Result};

/// Returns names for a message: at most six, then the number of others.
pub(super) fn few(names: impl IntoIterator<Item = impl AsRef<str>>) -> String {
    let names: Vec<String> = names.into_iter().map(|n| format!("`{}`", n.as_ref())).collect();
    let text = names[..names.len().min(6)].join(", ");
    if names.len() > 6 { format!("{text} and {} more", names.len() - 6) } else { text }
}

/// Selects the source of the masks, once for the whole capture, and finds valid masks and regions.
///
/// `common` is the common folder of all photographs; mask folders are next to it, or in the root.
pub(super) fn choose(
    folder: &CaptureFolder,
    common: &Path,
    views: &mut [View],
    kept: &[(CameraFrame, PictureInfo)],
    listing: &mut Listing,
) -> Result<()> {
    let files = FileSearch::new(folder, common, views);
    let masks = &folder.options.masks;
    let candidates = candidates(&files, views, kept, listing)?;
    let is_in_files = !matches!(masks, MaskSource::None | MaskSource::Clicks | MaskSource::Alpha);
    let mut found: Vec<_> = candidates.into_iter().filter(|(_, sources)| count(sources) > 0).collect();
    if found.is_empty() && is_in_files {
        (found, listing.stray_masks) = near_masks(folder, views)?;
    } else if is_in_files {
        complete(folder, views, &mut found[0], listing);
    }
    if found.is_empty() {
        say_none(folder, listing);
    } else {
        take(folder, views, found, listing);
    }
    valid_and_regions(&files, views, kept, listing);
    Ok(())
}

/// Looks for files that belong to photographs.
struct FileSearch<'a> {
    folder: &'a CaptureFolder<'a>,
    /// The photographs, which are no masks.
    photos: HashSet<PathBuf>,
    /// Folders that folders of masks may be in.
    beside: [&'a Path; 2],
}

impl<'a> FileSearch<'a> {
    fn new(folder: &'a CaptureFolder<'a>, common: &'a Path, views: &[View]) -> FileSearch<'a> {
        let root = Path::new("");
        FileSearch {
            folder,
            photos: views.iter().map(|view| view.photo.clone()).collect(),
            beside: [common.parent().unwrap_or(root), root],
        }
    }

    /// Returns the first of these files that exists and is no photograph, below the first base with
    /// any.
    fn first_of(&self, bases: &[&Path], names: &[String]) -> Option<PathBuf> {
        let mut paths = bases.iter().flat_map(|base| names.iter().map(move |name| base.join(name)));
        paths.find_map(|path| self.folder.file(&path).filter(|path| !self.photos.contains(path)))
    }

    /// Returns the mask of each view, by the names that its file may have.
    fn masks(&self, views: &[View], bases: &[&Path], names: impl Fn(&View) -> Vec<String>) -> Vec<ViewMask> {
        views.iter().map(|v| self.first_of(bases, &names(v)).into()).collect()
    }
}

/// Returns the sources that may have masks, by the setting, in the order of preference.
fn candidates(
    files: &FileSearch,
    views: &[View],
    kept: &[(CameraFrame, PictureInfo)],
    listing: &mut Listing,
) -> Result<Vec<Source>> {
    let folder = files.folder;
    let CaptureOptions { masks, mask_dir, .. } = folder.options;
    Ok(match masks {
        MaskSource::None | MaskSource::Clicks => Vec::new(),
        MaskSource::Alpha => vec![alpha(folder, views, kept, listing)?],
        _ if *masks == MaskSource::Folder || !mask_dir.is_empty() => {
            let inside: PathBuf = match mask_names::folder_named(folder, mask_dir) {
                Some(place) => place.into(),
                None => folder.relative("mask folder", mask_dir)?,
            };
            let names = |v: &View| {
                let stem = &v.name;
                [format!("{stem}.png"), full_name(v) + ".png", format!("{stem}.jpg"), format!("{stem}.jpeg")]
                    .into()
            };
            let place =
                if inside.as_os_str().is_empty() { mask_dir.into() } else { inside.to_string_lossy() };
            vec![(format!("`{place}/`"), files.masks(views, &[&inside], names))]
        }
        _ => {
            let named = kept.iter().map(|(f, _)| f.mask.clone().into()).collect();
            let in_folder = |text: &str, name: &dyn Fn(&View) -> String| {
                (format!("`{text}`"), files.masks(views, &files.beside, |v| vec![name(v)]))
            };
            vec![
                alpha(folder, views, kept, listing)?,
                (listing.masks_named.into(), named),
                in_folder("vit_mask/NAME.png", &|v| format!("vit_mask/{}.png", v.name)),
                in_folder("masks/NAME.png", &|v| format!("masks/{}.png", v.name)),
                in_folder("masks/NAME.jpg.png", &|v| format!("masks/{}.png", full_name(v))),
            ]
        }
    })
}

/// Returns the alpha channels of the photographs, unless all of them are opaque.
fn alpha(
    folder: &CaptureFolder,
    views: &[View],
    kept: &[(CameraFrame, PictureInfo)],
    listing: &mut Listing,
) -> Result<Source> {
    let is_mask =
        kept.iter().any(|(_, info)| info.alpha) && !all_opaque(views, kept, &folder.options.limits, listing)?;
    let source = |info: &PictureInfo| if is_mask && info.alpha { ViewMask::Alpha } else { ViewMask::None };
    let sources = kept.iter().map(|(_, info)| source(info)).collect();
    Ok(("the alpha channel of the photographs".into(), sources))
}

/// Gives the views the files of their valid pixels and of the face region.
fn valid_and_regions(
    files: &FileSearch,
    views: &mut [View],
    kept: &[(CameraFrame, PictureInfo)],
    listing: &mut Listing,
) {
    let (mut valid, mut region, mut from) = (0, 0, "`.npy` files".to_string());
    for (view, (frame, _)) in views.iter_mut().zip(kept) {
        let name = &view.name;
        view.valid =
            files.first_of(&files.beside, &[format!("masks/{name}.npy"), format!("valid/{name}.npy")]);
        view.region = match &frame.region {
            Some(path) => Some(path.clone()),
            None => files.first_of(&files.beside, &[format!("face_masks/{name}.png")]),
        };
        valid += view.valid.is_some() as usize;
        region += view.region.is_some() as usize;
    }
    if valid == 0
        && let Some((place, masks)) = mask_names::valid(files.folder, &files.beside, views)
    {
        from = format!("`{place}/`, under near names");
        for (view, mask) in views.iter_mut().zip(masks) {
            valid += mask.is_some() as usize;
            view.valid = mask;
        }
    }
    if valid > 0 {
        listing.reasons.push(format!("valid pixels from {from}, for {valid} of {} views", views.len()));
    }
    if region > 0 {
        listing.reasons.push(format!("face regions for the metrics, for {region} of {} views", views.len()));
    }
}

/// A source of masks in words, and the mask of each view.
type Source = (String, Vec<ViewMask>);

/// Returns how many views have a mask.
fn count(sources: &[ViewMask]) -> usize {
    sources.iter().filter(|m| **m != ViewMask::None).count()
}

/// Gives the views the masks of the first source, and names the others that there are.
fn take(folder: &CaptureFolder, views: &mut [View], found: Vec<Source>, listing: &mut Listing) {
    let mut found = found.into_iter();
    let Some((text, sources)) = found.next() else { return };
    let n = count(&sources);
    listing.reasons.push(format!("head masks from {text}, for {n} of {} views", views.len()));
    // one file may be found in several ways
    let is_other = |(_, others): &Source| {
        others.iter().zip(&sources).any(|(a, b)| *a != ViewMask::None && *b != ViewMask::None && a != b)
    };
    let others: Vec<String> = found.filter(is_other).map(|(text, _)| text).collect();
    if !others.is_empty() {
        listing.reasons.push(format!("other masks are not used: {}", others.join("; ")));
    }
    for (view, source) in views.iter_mut().zip(sources) {
        view.mask = source;
    }
    if n < views.len() {
        let without = views.iter().filter(|v| v.mask == ViewMask::None).map(|v| v.name.as_str());
        let mut text = format!("{} without a mask: {}", counted(views.len() - n, "view"), few(without));
        if folder.options.mask_meaning == MaskMeaning::Empty {
            text += "; stages that use masks ignore these views";
        }
        listing.warnings.push(text);
    }
}

/// Says that no masks are used, and why.
fn say_none(folder: &CaptureFolder, listing: &mut Listing) {
    let CaptureOptions { masks, mask_dir, .. } = folder.options;
    let stray = listing.stray_masks.as_ref().map_or(String::new(), |text| format!("; {text}"));
    match masks {
        MaskSource::None | MaskSource::Clicks => {
            listing.reasons.push("masks are not used, by `mask.source`".into());
        }
        MaskSource::Alpha => {
            listing.warnings.push("no photograph has a mask in its alpha channel".into());
        }
        _ if mask_dir.is_empty() => listing.reasons.push(format!("the capture has no masks{stray}")),
        _ => listing.warnings.push(format!("the mask folder `{mask_dir}` has no mask of any view{stray}")),
    }
}

/// Returns masks by near names where none has the name that is looked for, else what may be masks
/// and is not used.
fn near_masks(folder: &CaptureFolder, views: &[View]) -> Result<(Vec<Source>, Option<String>)> {
    let mask_dir = &folder.options.mask_dir;
    let groups = if mask_dir.is_empty() {
        mask_names::groups(folder, views)
    } else if let Some(place) = mask_names::folder_named(folder, mask_dir) {
        let group = mask_names::within(folder, &place, views);
        if !group.is_usable() && mask_names::holds_photographs(folder, &place, views) {
            return Err(Error::cannot(
                format!("`capture.mask_dir`: `{place}/` holds the photographs, and no masks of them"),
                "name masks there `NAME_mask.png`, or put them into a folder of their own; those in the photographs' \
                 alpha channels are read with `--set mask.source=alpha`",
            ));
        }
        vec![group]
    } else {
        let others = mask_names::groups(folder, views);
        let others: Vec<String> =
            others.into_iter().map(|g| g.place + "/").filter(|place| place != "/").collect();
        let text = match others.is_empty() {
            true => format!("there is no folder `{mask_dir}`"),
            false => format!("there is no folder `{mask_dir}`; there is {}", few(others)),
        };
        return Ok((Vec::new(), Some(text)));
    };
    if !groups.iter().any(mask_names::Group::is_usable) {
        let groups: Vec<_> = groups.into_iter().filter(|group| !group.is_empty()).collect();
        return Ok((Vec::new(), mask_names::stray(folder, &groups, views)));
    }
    let source = |group: &mask_names::Group| -> Source {
        let place = if group.place.is_empty() {
            "beside the photographs".into()
        } else {
            format!("`{}/`", group.place)
        };
        let example = group.example().map_or(String::new(), |(mask, view)| {
            format!(", where `{mask}` is that of `{}`", views[view].name)
        });
        (place + &example, group.masks(folder.root).into_iter().map(ViewMask::from).collect())
    };
    Ok((groups.iter().filter(|group| group.is_usable()).map(source).collect(), None))
}

/// Adds masks in the folder of the others that have the view's name in other letters or another
/// format.
fn complete(folder: &CaptureFolder, views: &[View], source: &mut Source, listing: &mut Listing) {
    let files = source.1.iter().filter_map(|mask| match mask {
        ViewMask::File(path) => Some(path.clone()),
        _ => None,
    });
    let files: Vec<PathBuf> = files.collect();
    if files.is_empty() || count(&source.1) == views.len() {
        return;
    }
    let mut added = Vec::new();
    for (mask, other) in source.1.iter_mut().zip(mask_names::others_there(folder, views, &files)) {
        if let Some(path) = other.filter(|_| *mask == ViewMask::None) {
            added.push(folder.shown(&path));
            *mask = ViewMask::File(path);
        }
    }
    if !added.is_empty() {
        listing.reasons.push(format!("masks of other letters or formats are read as well: {}", few(added)));
    }
}

/// Checks that the head masks exist that `options` require. Without masks, everything in view would
/// be reconstructed as part of the head, which [`MaskSource::None`] must allow explicitly. Held-out
/// views need no mask; at least half of the others must have one.
pub fn require_masks(capture: &Capture, options: &CaptureOptions) -> Result<()> {
    if matches!(options.masks, MaskSource::None | MaskSource::Clicks) {
        return Ok(());
    }
    let train: Vec<&View> = capture.split(Split::Train).collect();
    let without: Vec<&str> =
        train.iter().filter(|v| v.mask == ViewMask::None).map(|v| v.name.as_str()).collect();
    let (total, missing) = (train.len(), without.len());
    let stray = capture.stray_masks.as_ref().map_or(String::new(), |text| format!("; {text}"));
    let problem = if missing == total {
        format!(
            "no photograph that is learned from has a head mask: nothing says which pixels are background, and there is \
             no visual hull to start from{stray}"
        )
    } else if options.mask_meaning == MaskMeaning::Empty && 2 * missing > total {
        let named = few(without);
        format!("{missing} of {total} photographs that are learned from have no head mask: {named}")
    } else {
        return Ok(());
    };
    let root = &capture.root;
    let shown = root.display();
    let prompts = root.join("prompts.json");
    let clicks = if io::is_file(&prompts) {
        format!("make them from the clicks in the capture: `--prompts {}`", prompts.display())
    } else {
        format!("click on three photographs: `tiface mask {shown} --page`, then `--prompts prompts.json`")
    };
    let photographs = train.first().and_then(|v| v.photo.parent()).unwrap_or(root).display();
    let hint = format!(
        "{clicks}; or add masks, white on the head, which are found as alpha, `mask_path`, `vit_mask/NAME.png` \
         or `masks/NAME.png` (a background remover writes them: `rembg p -om {photographs} {shown}/masks`), or in a \
         folder named with `--set capture.mask_dir=FOLDER`; or go on without any, and learn whatever the cameras see: \
         `--set mask.source=none`"
    );
    Err(Error::cannot(format_args!("`{shown}`: {problem}"), hint))
}

/// Returns a view's name with its photograph's ending.
fn full_name(view: &View) -> String {
    let ending = view.photo.extension().unwrap_or_default().to_string_lossy();
    format!("{}.{ending}", view.name)
}

/// Returns whether the alpha channels are opaque, by three photographs: an exporter that adds an
/// opaque channel adds it to all.
fn all_opaque(
    views: &[View],
    kept: &[(CameraFrame, PictureInfo)],
    limits: &Limits,
    listing: &mut Listing,
) -> Result<bool> {
    for (view, _) in views.iter().zip(kept).filter(|(_, (_, info))| info.alpha).take(3) {
        let photo = io::read_photo(&view.photo, Some(view.photo_size), limits)?;
        if photo.alpha.is_some_and(|a| a.iter().any(|&v| v != 255)) {
            return Ok(false);
        }
    }
    listing.warnings.push("the photographs' alpha channel is opaque everywhere, so it is no mask".into());
    Ok(true)
}
