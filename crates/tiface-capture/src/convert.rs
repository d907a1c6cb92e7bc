//! Writes a copy of a capture with its cameras in another format. Nothing is resampled, and no
//! existing file is changed.
//!
//! Photographs are copied to `images/`, head masks to `masks/`, valid pixels to `valid/` and
//! regions to `face_masks/`; the camera files are written last, so that a folder with camera files
//! is complete. One that a killed process left without them is completed. Data that the format
//! cannot represent is an error if pictures would no longer match their cameras, and a warning
//! otherwise.

use super::folder::is_hidden;
use super::lens_model::LensModel;
use super::view::{Capture, Split, View, ViewMask};
use super::{colmap, every_eighth, up};
use rayon::prelude::*;
use serde::Serialize;
use serde_json::{Map, Value, json};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use tiface_base::geom::Camera;
use tiface_base::image::Photo;
use tiface_base::io::{self, Limits};
use tiface_base::{Error, Result};

/// A format that cameras can be written in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CameraFormat {
    /// `transforms.json`, as nerfstudio and instant-ngp read it.
    Transforms,
    /// `sparse/0`, binary.
    Colmap,
}

impl CameraFormat {
    /// Returns the format of this name: `transforms` or `colmap`.
    pub fn named(name: &str) -> Option<CameraFormat> {
        match name {
            "transforms" => Some(CameraFormat::Transforms),
            "colmap" => Some(CameraFormat::Colmap),
            _ => None,
        }
    }
}

/// The result of [`convert`].
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Conversion {
    /// The new folder.
    pub folder: PathBuf,
    /// Number of views.
    pub views: usize,
    /// Number of head masks, without those in alpha channels.
    pub masks: usize,
    /// Data that the format could not represent.
    pub warnings: Vec<String>,
}

/// Destination of a view's pictures, relative to the new capture.
struct ViewFiles<'v> {
    view: &'v View,
    camera: Camera,
    /// Name without ending, relative to the folder of photographs, separated by `/`.
    stem: String,
    /// Name with ending.
    name: String,
    photo: String,
    mask: Option<String>,
    valid: Option<String>,
    region: Option<String>,
}

/// Content of a file of the new capture.
enum Content<'v> {
    /// The bytes of another file.
    File(&'v Path),
    /// A mask that is not stored as a PNG, and the size of its photograph.
    Mask(&'v Path, (u32, u32)),
    Bytes(Vec<u8>),
}

impl Content<'_> {
    fn bytes(&self, target: &Path) -> Result<Vec<u8>> {
        Ok(match self {
            Content::File(from) => io::read_maybe_empty(from, &Limits::default())?,
            Content::Mask(from, size) => {
                let mask = io::read_mask(from, Some(*size), &Limits::default())?;
                let is_gray = mask.alpha.is_some() || mask.rgb.iter().all(|[r, g, b]| r == g && g == b);
                match is_gray {
                    true => io::png_gray_bytes(&mask.gray(), target)?,
                    // which of its colors are the head is said by whoever opens the new capture
                    false => {
                        let (width, height, rgb) = (mask.width, mask.height, mask.rgb);
                        io::png_bytes(&Photo { width, height, rgb, alpha: None }, target)?
                    }
                }
            }
            Content::Bytes(bytes) => bytes.clone(),
        })
    }

    fn write(&self, target: &Path) -> Result<()> {
        if let Some(folder) = target.parent() {
            io::create_folder(folder)?;
        }
        match self {
            Content::File(from) => io::copy(from, target)?,
            Content::Mask(..) => io::write_atomic(target, &self.bytes(target)?)?,
            Content::Bytes(bytes) => io::write_atomic(target, bytes)?,
        }
        Ok(())
    }
}

/// Files to write, by their paths.
type Contents<'v> = Vec<(PathBuf, Content<'v>)>;

/// Returns whether a folder contains nothing but files of an unfinished conversion: `contents` but
/// for the last one.
fn is_unfinished(folder: &Path, contents: &Contents) -> Result<bool> {
    let Some((_, written)) = contents.split_last() else { return Ok(false) };
    let targets: BTreeSet<&Path> = written.iter().map(|(target, _)| target.as_path()).collect();
    // the first other file is enough: a large folder is not read to its end
    if io::any_file(folder, &|path| targets.contains(path) || is_hidden(path))?.is_some() {
        return Ok(false);
    }
    for (target, content) in written.iter().filter(|(target, _)| io::exists(target)) {
        let is_same = || -> Result<bool> {
            Ok(io::read_maybe_empty(target, &Limits::default())? == content.bytes(target)?)
        };
        if !io::is_file(target) || !is_same()? {
            return Ok(false);
        }
    }
    Ok(true)
}

/// Writes `capture` into `folder`, which must be new, empty, or left by a killed process that wrote
/// the same. Photographs and masks are copied.
///
/// # Errors
///
/// Fails if the capture was opened at reduced size, the folder is not empty, or the format has no
/// such lens model.
pub fn convert(capture: &Capture, to: CameraFormat, folder: &Path) -> Result<Conversion> {
    if let Some(view) = capture.views.iter().find(|v| v.photo_size != (v.camera.width, v.camera.height)) {
        let message = format!("the photograph of `{}` would be converted at reduced size", view.name);
        return Err(Error::cannot(
            message,
            "convert with `--set capture.downscale=1`, which copies photographs unchanged",
        ));
    }
    let exists = || {
        let message = format!("`{}` already exists", folder.display());
        Error::cannot(message, "name a new folder: nothing is overwritten")
    };
    if io::exists(folder) && !io::is_folder(folder) {
        return Err(exists());
    }
    let mut out = Conversion { folder: folder.into(), views: capture.views.len(), ..Conversion::default() };
    let files_of_views = files_of_views(capture, to)?;
    // readers hold out every 8th in the order of the new names, with their endings or without
    let splits: Vec<Split> = capture.views.iter().map(|v| v.split).collect();
    let named_splits = every_eighth(files_of_views.iter().map(|p| p.name.as_str())) != splits
        || every_eighth(files_of_views.iter().map(|p| p.stem.as_str())) != splits;
    let can_name = |p: &ViewFiles| match to {
        CameraFormat::Transforms => true,
        CameraFormat::Colmap => colmap::can_name(&p.name, named_splits && p.view.split != Split::Train),
    };
    if let Some(files) = files_of_views.iter().find(|p| !can_name(p)) {
        let message = format!("the photograph `{}` has a name that this format cannot represent", files.name);
        return Err(Error::cannot(message, "rename it, or choose `--to transforms`"));
    }
    // data that the format cannot represent is found before anything is written
    let files = match to {
        CameraFormat::Transforms => transforms(capture, &files_of_views, named_splits)?,
        CameraFormat::Colmap => sparse(capture, &files_of_views, named_splits, &mut out.warnings)?,
    };
    // the camera files come last, so that a folder with camera files is complete
    let mut contents = pictures(capture, &files_of_views, folder)?;
    out.masks = contents.1;
    contents.0.extend(files.into_iter().map(|(name, bytes)| (folder.join(name), Content::Bytes(bytes))));
    let contents = contents.0;
    if io::is_folder(folder) {
        if !is_unfinished(folder, &contents)? {
            return Err(exists());
        }
        let folders: BTreeSet<&Path> = contents.iter().filter_map(|(target, _)| target.parent()).collect();
        for inner in folders.into_iter().filter(|inner| io::is_folder(inner)) {
            io::remove_leftovers(inner, |_, pid| io::has_ended(pid))?;
        }
    }
    for (target, content) in contents.iter().filter(|(target, _)| !io::is_file(target)) {
        content.write(target)?;
    }
    Ok(out)
}

/// Copies photographs and masks as COLMAP names them.
pub(super) fn copy_for_colmap(capture: &Capture, folder: &Path) -> Result<()> {
    let (contents, _) = pictures(capture, &files_of_views(capture, CameraFormat::Colmap)?, folder)?;
    contents.iter().try_for_each(|(target, content)| content.write(target))
}

/// Returns the photographs' names below `images/` as COLMAP has them, in the order of the views,
/// and all files that [`copy_for_colmap`] writes.
pub(super) fn names_for_colmap(capture: &Capture) -> Result<(Vec<String>, Vec<String>)> {
    let files_of_views = files_of_views(capture, CameraFormat::Colmap)?;
    let files = files_of_views.iter().flat_map(|files| {
        let beside = [&files.mask, &files.valid, &files.region].into_iter().flatten();
        [&files.photo].into_iter().chain(beside).cloned()
    });
    let files = files.collect();
    Ok((files_of_views.into_iter().map(|files| files.name).collect(), files))
}

/// Returns the files that the pictures of each view are copied to.
fn files_of_views(capture: &Capture, to: CameraFormat) -> Result<Vec<ViewFiles<'_>>> {
    let files_of_views: Vec<ViewFiles> = capture.views.iter().map(|v| view_files(v, to)).collect();
    let mut names: Vec<&str> = files_of_views.iter().map(|p| p.photo.as_str()).collect();
    names.sort_unstable();
    if let Some(twice) = names.windows(2).find(|n| n[0] == n[1]) {
        let message = format!("two photographs would both be called `{}`", twice[0]);
        return Err(Error::cannot(message, "rename one of them, or convert to another format"));
    }
    Ok(files_of_views)
}

/// Returns photographs, masks and regions as they are copied to a folder, and the number of head
/// masks.
fn pictures<'v>(
    capture: &Capture,
    files_of_views: &[ViewFiles<'v>],
    folder: &Path,
) -> Result<(Contents<'v>, usize)> {
    let mut masks = 0;
    let mut contents: Contents = Vec::new();
    // a link may point to anything: only pictures are copied
    capture.views.par_iter().try_for_each(|view| {
        if view.valid.is_some() || matches!(view.mask, ViewMask::File(_)) {
            view.load(&Limits::default())?;
        }
        match &view.region {
            Some(region) => io::read_gray(region, Some(view.photo_size), &Limits::default()).map(drop),
            None => Ok(()),
        }
        .map_err(Error::from)
    })?;
    for files in files_of_views {
        let view: &'v View = files.view;
        let mut put = |name: &str, content| contents.push((folder.join(name), content));
        put(&files.photo, Content::File(&view.photo));
        if let (ViewMask::File(from), Some(name)) = (&view.mask, &files.mask) {
            let is_png = from.extension().is_some_and(|e| e.eq_ignore_ascii_case("png"));
            put(name, if is_png { Content::File(from) } else { Content::Mask(from, view.photo_size) });
            masks += 1;
        }
        for (from, name) in [(&view.valid, &files.valid), (&view.region, &files.region)] {
            if let (Some(from), Some(name)) = (from, name) {
                put(name, Content::File(from));
            }
        }
    }
    Ok((contents, masks))
}

fn view_files(view: &View, to: CameraFormat) -> ViewFiles<'_> {
    let ending =
        |path: &Path| path.extension().map_or(String::new(), |e| format!(".{}", e.to_string_lossy()));
    let stem = view.name.clone();
    let name = stem.clone() + &ending(&view.photo);
    let mask = matches!(view.mask, ViewMask::File(_)).then(|| match to {
        CameraFormat::Colmap => format!("masks/{name}.png"),
        CameraFormat::Transforms => format!("masks/{stem}.png"),
    });
    let beside =
        |folder: &str, file: &Option<PathBuf>| file.as_ref().map(|f| format!("{folder}/{stem}{}", ending(f)));
    ViewFiles {
        view,
        // at the size of the stored photograph, as checked above
        camera: view.camera.clone(),
        photo: format!("images/{name}"),
        mask,
        valid: beside("valid", &view.valid),
        region: beside("face_masks", &view.region),
        stem,
        name,
    }
}

type Files = Vec<(String, Vec<u8>)>;

/// Returns COLMAP's name of the lens model, and its parameters.
fn lens(files: &ViewFiles) -> Result<Map<String, Value>> {
    let camera = &files.camera;
    let unknown = || {
        let message = format!("no camera model has the lens of `{}`", files.view.name);
        Error::cannot(message, "undistort the photographs first")
    };
    let (model, values) = LensModel::for_camera(camera).ok_or_else(unknown)?;
    let mut keys = Map::new();
    keys.insert("camera_model".into(), model.name.into());
    keys.insert("w".into(), camera.width.into());
    keys.insert("h".into(), camera.height.into());
    for (key, value) in model.parameters.split(' ').zip(values) {
        let key = key.replace("fx", "fl_x").replace("fy", "fl_y");
        keys.insert(key, value.into());
    }
    Ok(keys)
}

fn transforms(capture: &Capture, files_of_views: &[ViewFiles], named_splits: bool) -> Result<Files> {
    let lenses: Vec<Map<String, Value>> = files_of_views.iter().map(lens).collect::<Result<_>>()?;
    // readers that support only one lens read it from the top level
    let shared = lenses.iter().all(|l| *l == lenses[0]);
    let frame = |(files, lens): (&ViewFiles, &Map<String, Value>)| {
        let (r, p) = (files.camera.rotation, files.camera.position);
        let row = |k: usize| json!([r.x_axis[k], r.y_axis[k], r.z_axis[k], p[k]]);
        let mut frame = Map::new();
        frame.insert("file_path".into(), files.photo.clone().into());
        let pictures = [("mask_path", &files.mask), ("face_mask_path", &files.region)];
        for (key, path) in pictures.into_iter().filter_map(|(key, path)| Some((key, path.clone()?))) {
            frame.insert(key.into(), path.into());
        }
        if named_splits {
            frame.insert("split".into(), json!(files.view.split));
        }
        if !shared {
            frame.extend(lens.clone());
        }
        frame.insert("transform_matrix".into(), json!([row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]));
        Value::Object(frame)
    };
    let mut top = if shared { lenses[0].clone() } else { Map::new() };
    // the reader derives it from the cameras, unless the dataset names another
    if up(&capture.views, None).0 != capture.up {
        top.insert("up".into(), json!(capture.up.as_dvec3()));
    }
    top.insert("frames".into(), files_of_views.iter().zip(&lenses).map(frame).collect());
    Ok(vec![("transforms.json".into(), format!("{:#}\n", Value::Object(top)).into_bytes())])
}

fn sparse(
    capture: &Capture,
    files_of_views: &[ViewFiles],
    named_splits: bool,
    warnings: &mut Vec<String>,
) -> Result<Files> {
    let (guessed, _) = up(&capture.views, None);
    if guessed != capture.up {
        let taken = format!("readers will use {guessed} instead of {}", capture.up);
        warnings.push(format!("COLMAP has no up direction: {taken}"));
    }
    let images: Vec<(String, &Camera)> = files_of_views.iter().map(|p| (p.name.clone(), &p.camera)).collect();
    let hint = "undistort the photographs first";
    let model = colmap::files(&images).map_err(|problem| Error::cannot(problem, hint))?;
    let mut files: Files = Vec::new();
    if named_splits {
        let held_out = files_of_views.iter().filter(|p| p.view.split != Split::Train);
        let names: String = held_out.map(|p| format!("{}\n", p.name)).collect();
        if capture.split(Split::Val).next().is_some() {
            warnings.push("COLMAP has no validation views: they become test views".into());
        }
        files.push(("sparse/0/test.txt".into(), names.into()));
    }
    files.extend(model.into_iter().map(|(name, bytes)| (format!("sparse/0/{name}"), bytes)));
    Ok(files)
}
