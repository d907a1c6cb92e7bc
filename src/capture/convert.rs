//! A capture written again with cameras of another format: nothing is resampled, nothing that is there is touched.
//!
//! Photographs go to `images/`, head masks to `masks/`, valid pixels to `valid/` and regions to `face_masks/`, as
//! they are; the camera files come last, so that a folder that has them is complete. A conversion that was interrupted
//! goes on where it stopped: what it wrote is there already. What a format cannot say is an error where pictures would
//! no longer fit their cameras, and a warning otherwise.

use super::colmap;
use super::gather::{every_eighth, up};
use super::lens::LensModel;
use super::llff;
use super::scene::{self, SceneOptions};
use super::view::{Capture, Split, View, ViewMask};
use crate::geom::Camera;
use crate::io::{self, Limits};
use crate::{Error, Result};
use rayon::prelude::*;
use serde::Serialize;
use serde_json::{Map, Value, json};
use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

/// A format that cameras can be written in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CameraFormat {
    /// `transforms.json`, as nerfstudio and instant-ngp read it.
    Transforms,
    /// `sparse/0`, binary.
    Colmap,
    /// `poses_bounds.npy`.
    Llff,
}

impl CameraFormat {
    /// The format of this name: `transforms`, `colmap` or `llff`.
    pub fn named(name: &str) -> Option<CameraFormat> {
        match name {
            "transforms" => Some(CameraFormat::Transforms),
            "colmap" => Some(CameraFormat::Colmap),
            "llff" => Some(CameraFormat::Llff),
            _ => None,
        }
    }
}

/// What [`convert`] wrote.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Conversion {
    /// Where.
    pub folder: PathBuf,
    /// How many views.
    pub views: usize,
    /// How many head masks, those in alpha channels left out.
    pub masks: usize,
    /// What the format could not say.
    pub warnings: Vec<String>,
}

/// Where a view's pictures go, relative to the new capture.
struct Place<'v> {
    view: &'v View,
    camera: Camera,
    /// Without its ending, `/` between, below the folder of photographs.
    stem: String,
    /// With its ending.
    name: String,
    photo: String,
    mask: Option<String>,
    valid: Option<String>,
    region: Option<String>,
}

/// What a file of the new capture holds.
enum Content<'v> {
    /// The bytes of another file.
    File(&'v Path),
    /// A mask that is no PNG yet, and the size of its photograph.
    Mask(&'v Path, (u32, u32)),
    Bytes(Vec<u8>),
}

impl Content<'_> {
    fn bytes(&self, target: &Path) -> Result<Vec<u8>> {
        let limits = Limits::default();
        Ok(match self {
            Content::File(from) => io::read_bytes(from, &limits)?,
            Content::Mask(from, size) => {
                io::png_gray_bytes(&io::read_gray(from, Some(*size), &limits)?, target)?
            }
            Content::Bytes(bytes) => bytes.clone(),
        })
    }

    fn write(&self, target: &Path, link: bool) -> Result<()> {
        if let Some(folder) = target.parent() {
            io::create_folder(folder)?;
        }
        match self {
            Content::File(from) if link => io::hard_link(from, target)?,
            Content::File(from) => io::copy(from, target)?,
            _ => io::write_atomic(target, &self.bytes(target)?)?,
        }
        Ok(())
    }

    /// Does the file hold just that?
    fn is_in(&self, target: &Path) -> Result<bool> {
        let sizes = match self {
            Content::File(from) => io::file_size(from) == io::file_size(target),
            _ => true,
        };
        Ok(sizes && io::read_bytes(target, &Limits::default()).unwrap_or_default() == self.bytes(target)?)
    }
}

/// Writes `capture` into `folder`, which must be new, empty, or hold what the same conversion wrote. Photographs and
/// masks are copied, or hard-linked with `link`: then they cost no space, and who changes one changes the other.
///
/// # Errors
///
/// If the capture was opened reduced in size, the folder holds anything else, or the format has no such lens.
pub fn convert(capture: &Capture, to: CameraFormat, folder: &Path, link: bool) -> Result<Conversion> {
    if let Some(view) = capture.views.iter().find(|v| v.photo_size != (v.camera.width, v.camera.height)) {
        let message = format!("the photograph of `{}` would be converted reduced in size", view.name);
        return Err(Error::cannot(
            message,
            "convert with `--set capture.downscale=1`: photographs are kept as they are",
        ));
    }
    if io::exists(folder) && !io::is_folder(folder) {
        return Err(occupied(folder, "it is no folder"));
    }
    let mut out = Conversion { folder: folder.into(), views: capture.views.len(), ..Conversion::default() };
    let places: Vec<Place> = capture.views.iter().map(|v| place(v, to)).collect();
    let mut names: Vec<&str> = places.iter().map(|p| p.photo.as_str()).collect();
    names.sort_unstable();
    if let Some(twice) = names.windows(2).find(|n| n[0] == n[1]) {
        let message = format!("two photographs would both be called `{}`", twice[0]);
        return Err(Error::cannot(message, "rename one of them, or convert to another format"));
    }
    // readers hold out every 8th in the order of the new names, with their endings or without
    let splits: Vec<Split> = capture.views.iter().map(|v| v.split).collect();
    let named_splits = every_eighth(places.iter().map(|p| p.name.as_str())) != splits
        || every_eighth(places.iter().map(|p| p.stem.as_str())) != splits;
    let can_name = |p: &Place| match to {
        CameraFormat::Transforms => true,
        CameraFormat::Colmap => colmap::can_name(&p.name, named_splits && p.view.split != Split::Train),
        CameraFormat::Llff => llff::is_photograph(&p.name),
    };
    if let Some(place) = places.iter().find(|p| !can_name(p)) {
        let message = format!("the photograph `{}` has a name that this format cannot carry", place.name);
        return Err(Error::cannot(message, "rename it, or choose `--to transforms`"));
    }
    // what cannot be said is found before anything is written
    let files = match to {
        CameraFormat::Transforms => transforms(capture, &places, named_splits)?,
        CameraFormat::Colmap => sparse(capture, &places, named_splits, &mut out.warnings)?,
        CameraFormat::Llff => poses(capture, &places, named_splits, &mut out.warnings)?,
    };
    let mut contents: Vec<(PathBuf, Content)> = Vec::new();
    // a link may name anything: only what is a picture is copied
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
    for place in &places {
        let mut put = |name: &str, content| contents.push((folder.join(name), content));
        put(&place.photo, Content::File(&place.view.photo));
        if let (ViewMask::File(from), Some(name)) = (&place.view.mask, &place.mask) {
            let is_png = from.extension().is_some_and(|e| e.eq_ignore_ascii_case("png"));
            put(name, if is_png { Content::File(from) } else { Content::Mask(from, place.view.photo_size) });
            out.masks += 1;
        }
        for (from, name) in [(&place.view.valid, &place.valid), (&place.view.region, &place.region)] {
            if let (Some(from), Some(name)) = (from, name) {
                put(name, Content::File(from));
            }
        }
    }
    contents.extend(files.into_iter().map(|(name, bytes)| (folder.join(name), Content::Bytes(bytes))));
    let there = written(folder, &contents)?;
    // all that is there is ours, and so is what was half written
    let inside: HashSet<&Path> = contents.iter().filter_map(|(target, _)| target.parent()).collect();
    for inner in inside.into_iter().filter(|inner| io::is_folder(inner)) {
        io::remove_leftovers(inner, |_, _| true)?;
    }
    for (target, content) in contents.iter().filter(|(target, _)| !there.contains(target)) {
        content.write(target, link)?;
    }
    Ok(out)
}

fn occupied(folder: &Path, why: &str) -> Error {
    let message = format!("`{}` cannot be written into: {why}", folder.display());
    Error::cannot(message, "name a new folder: nothing that is there is overwritten")
}

/// What of `contents` is in the folder already; anything else in it is an error.
fn written(folder: &Path, contents: &[(PathBuf, Content)]) -> Result<HashSet<PathBuf>> {
    let contents: HashMap<&PathBuf, &Content> =
        contents.iter().map(|(target, content)| (target, content)).collect();
    let mut there = HashSet::new();
    let mut folders = if io::exists(folder) { vec![folder.to_path_buf()] } else { Vec::new() };
    while let Some(inner) = folders.pop() {
        folders.extend(io::list_folders(&inner)?);
        for target in io::list_files(&inner)?.iter().map(|name| inner.join(name)) {
            match contents.get(&target) {
                Some(content) if content.is_in(&target)? => there.insert(target),
                _ => {
                    let name = target.strip_prefix(folder).unwrap_or(&target);
                    return Err(occupied(folder, &format!("`{}` is there and another file", name.display())));
                }
            };
        }
    }
    Ok(there)
}

fn place(view: &View, to: CameraFormat) -> Place<'_> {
    let ending =
        |path: &Path| path.extension().map_or(String::new(), |e| format!(".{}", e.to_string_lossy()));
    let stem = match to {
        CameraFormat::Llff => view.name.replace('/', "_"), // rows are paired with what lies directly in the folder
        _ => view.name.clone(),
    };
    let name = stem.clone() + &ending(&view.photo);
    let mask = matches!(view.mask, ViewMask::File(_)).then(|| match to {
        CameraFormat::Colmap => format!("masks/{name}.png"),
        _ => format!("masks/{stem}.png"),
    });
    let beside =
        |folder: &str, file: &Option<PathBuf>| file.as_ref().map(|f| format!("{folder}/{stem}{}", ending(f)));
    Place {
        view,
        // of the photograph as it lies there: the check above has seen to that
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

/// What COLMAP's names call the lens, and all its numbers.
fn lens(place: &Place) -> Result<Map<String, Value>> {
    let camera = &place.camera;
    let unknown = || {
        let message = format!("no camera model has the lens of `{}`", place.view.name);
        Error::cannot(message, "undistort the photographs first")
    };
    let (model, values) = LensModel::of(camera).ok_or_else(unknown)?;
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

fn transforms(capture: &Capture, places: &[Place], named_splits: bool) -> Result<Files> {
    let lenses: Vec<Map<String, Value>> = places.iter().map(lens).collect::<Result<_>>()?;
    // readers that know one lens for all look for it at the top
    let shared = lenses.iter().all(|l| *l == lenses[0]);
    let frame = |(place, lens): (&Place, &Map<String, Value>)| {
        let (r, p) = (place.camera.rotation, place.camera.position);
        let row = |k: usize| json!([r.x_axis[k], r.y_axis[k], r.z_axis[k], p[k]]);
        let mut frame = Map::new();
        frame.insert("file_path".into(), place.photo.clone().into());
        let pictures = [("mask_path", &place.mask), ("face_mask_path", &place.region)];
        for (key, path) in pictures.into_iter().filter_map(|(key, path)| Some((key, path.clone()?))) {
            frame.insert(key.into(), path.into());
        }
        if named_splits {
            frame.insert("split".into(), json!(place.view.split));
        }
        if !shared {
            frame.extend(lens.clone());
        }
        frame.insert("transform_matrix".into(), json!([row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]));
        Value::Object(frame)
    };
    let mut top = if shared { lenses[0].clone() } else { Map::new() };
    // as the reader will find it, unless the dataset had named another
    if up(&capture.views, None) != capture.up {
        top.insert("up".into(), json!(capture.up.as_dvec3()));
    }
    top.insert("frames".into(), places.iter().zip(&lenses).map(frame).collect());
    Ok(vec![("transforms.json".into(), format!("{:#}\n", Value::Object(top)).into_bytes())])
}

fn warn_up(capture: &Capture, format: &str, warnings: &mut Vec<String>) {
    let guessed = up(&capture.views, None);
    if guessed != capture.up {
        warnings.push(format!(
            "{format} does not say where up is: {} will be taken instead of {}",
            guessed, capture.up
        ));
    }
}

fn sparse(
    capture: &Capture,
    places: &[Place],
    named_splits: bool,
    warnings: &mut Vec<String>,
) -> Result<Files> {
    warn_up(capture, "COLMAP", warnings);
    let images: Vec<(String, &Camera)> = places.iter().map(|p| (p.name.clone(), &p.camera)).collect();
    let hint = "undistort the photographs first";
    let model = colmap::files(&images).map_err(|problem| Error::cannot(problem, hint))?;
    let mut files: Files = Vec::new();
    if named_splits {
        let held_out = places.iter().filter(|p| p.view.split != Split::Train);
        let names: String = held_out.map(|p| format!("{}\n", p.name)).collect();
        if capture.split(Split::Val).next().is_some() {
            warnings.push("COLMAP has no validation views: they are held out with those for testing".into());
        }
        files.push(("sparse/0/test.txt".into(), names.into()));
    }
    files.extend(model.into_iter().map(|(name, bytes)| (format!("sparse/0/{name}"), bytes)));
    Ok(files)
}

fn poses(
    capture: &Capture,
    places: &[Place],
    named_splits: bool,
    warnings: &mut Vec<String>,
) -> Result<Files> {
    warn_up(capture, "LLFF", warnings);
    for place in places {
        let c = &place.camera;
        let (w, h) = (c.width as f64, c.height as f64);
        let middle = (c.cx - 0.5 * w).abs().max((c.cy - 0.5 * h).abs());
        let lost = if !c.distortion.is_none() {
            "lens distortion".into()
        } else if (c.fy / c.fx - 1.0).abs() > llff::FOCAL_TOLERANCE {
            format!("two focal lengths, {} and {} pixels", c.fx, c.fy)
        } else if middle > 0.5 {
            format!("a principal point that is {middle:.2} pixels from the middle")
        } else {
            continue;
        };
        let message = format!("the camera of `{}` has {lost}, which LLFF cannot say", place.view.name);
        let hint = "choose `--to colmap` or `--to transforms`, or undistort the photographs first";
        return Err(Error::cannot(message, hint));
    }
    // rows carry no names: they are paired with the photographs in name order, training first
    let sorted = |train: Option<bool>| {
        let mut some: Vec<&Place> =
            places.iter().filter(|p| train.is_none_or(|t| t == (p.view.split == Split::Train))).collect();
        some.sort_by(|a, b| a.name.cmp(&b.name));
        some
    };
    let bounds = bounds(places);
    let rows = |places: &[&Place]| llff::write(places.iter().map(|p| (&p.camera, bounds(&p.camera))));
    if !named_splits {
        return Ok(vec![("poses_bounds.npy".into(), rows(&sorted(None)))]);
    }
    let (train, test) = (sorted(Some(true)), sorted(Some(false)));
    if train.last().zip(test.first()).is_none_or(|(last, first)| last.name >= first.name) {
        let message =
            "LLFF can only hold out the last photographs in name order, and others are held out here";
        return Err(Error::cannot(message, "choose `--to colmap` or `--to transforms`"));
    }
    if capture.split(Split::Val).next().is_some() {
        warnings.push("LLFF has no validation views: they are held out with those for testing".into());
    }
    Ok(vec![("poses_bounds_test.npy".into(), rows(&test)), ("poses_bounds_train.npy".into(), rows(&train))])
}

/// Near and far of a camera: the box that most cameras see; LLFF's other readers sample between them.
fn bounds(places: &[Place]) -> impl Fn(&Camera) -> [f64; 2] {
    let cameras: Vec<Camera> = places.iter().map(|p| p.camera.clone()).collect();
    let seen = scene::fit(&cameras, &vec![None; cameras.len()], &SceneOptions::default());
    let seen = seen.ok().map(|(scene, _)| scene::world_box(&scene));
    move |camera| {
        let Some(b) = seen else { return [0.1, 10.0] };
        let depth = |i: usize| {
            let pick = |k: usize| if i >> k & 1 == 0 { b.min[k] } else { b.max[k] };
            let corner = glam::Vec3::new(pick(0), pick(1), pick(2)).as_dvec3();
            -camera.rotation.z_axis.dot(corner - camera.position)
        };
        let depths = (0..8).map(depth);
        let (near, far) = depths.fold((f64::MAX, 0.0f64), |(near, far), d| (near.min(d), far.max(d)));
        let near = near.max(1e-3 * far);
        if far > 0.0 { [near, far] } else { [0.1, 10.0] }
    }
}
