//! COLMAP's sparse models, in the places of [`files`].
//!
//! A pose takes the world to a camera whose axes point right, down and ahead, as a quaternion (w,
//! x, y, z) and a translation; a pixel's center is at +0.5. The binary files are preferred to the
//! text. Poses are complete in the images file, of rigs as well: `rigs` and `frames` beside it
//! (COLMAP 3.12 to 4.2) are not read. Points are optional, and say where the head is if no masks
//! do.
//!
//! A model is written back as binary files: one camera for each lens that differs, no points.
//! [`SparseModel`] sums up what COLMAP itself has just written.

mod binary;
mod files;
mod text;

pub(super) use files::{ModelFiles, mixed_model, model_elsewhere};

use super::folder::{CaptureFolder, FLIP, in_file, in_frame, join};
use super::frame::{CameraFrame, Listing};
use super::lens_model::LensModel;
use super::masks::few;
use super::view::Split;
use glam::{DMat3, DQuat, DVec3};
use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use tiface_base::io::{self, ReadError};
use tiface_base::{Error, Result, geom};

impl ModelFiles {
    fn read(&self, folder: &CaptureFolder) -> Result<Model> {
        let limits = &folder.options.limits;
        let bytes = |kind: &str| -> Result<Option<(PathBuf, Vec<u8>)>> {
            let name = self.name(kind);
            match folder.file(Path::new(&name)) {
                Some(path) => {
                    // a list of nothing is a count in binary, and nothing in text
                    let read = if self.ending == "bin" { io::read_bytes } else { io::read_maybe_empty };
                    read(&path, limits).map(|bytes| Some((path, bytes))).map_err(Error::from)
                }
                None => Ok(None),
            }
        };
        let needed = |kind: &str| {
            let missing = || in_file(&self.name(kind), "it is missing", "export the model again");
            bytes(kind)?.ok_or_else(missing)
        };
        let (cameras, images) = (needed("cameras")?, needed("images")?);
        let points = bytes("points3D")?;
        if self.ending == "bin" {
            return binary::read(&cameras, &images, points.as_ref(), limits);
        }
        let as_text = |kind: &str, (path, bytes): (PathBuf, Vec<u8>)| -> Result<text::Source> {
            let text = String::from_utf8(bytes).map_err(|e| {
                let offset = e.utf8_error().valid_up_to() as u64;
                ReadError::damaged(&path, "COLMAP", offset, "it is not UTF-8 text")
            })?;
            Ok(text::Source::new(self.name(kind), text))
        };
        let points = points.map(|file| as_text("points3D", file)).transpose()?;
        text::read(&as_text("cameras", cameras)?, &as_text("images", images)?, points.as_ref(), limits)
    }
}

/// Lists the images of a model, in the order of their numbers.
pub(super) fn list(folder: &CaptureFolder, files: &ModelFiles, listing: &mut Listing) -> Result<()> {
    let Model { cameras, mut images, points, notes } = files.read(folder)?;
    listing.reasons.extend(notes);
    let name_of = files.name("images");
    if images.is_empty() {
        return Err(in_file(
            &name_of,
            "it has no images",
            "no photograph was registered: run the mapper again",
        ));
    }
    images.sort_by_key(|image| image.id);
    let mut seen = HashSet::new();
    for image in &images {
        if !seen.insert(image.id) {
            let problem = format!("its number {} appears twice", image.id);
            listing.problems.push(in_frame(&name_of, &image.name, problem));
        }
    }
    if let Some(points) = points {
        let n = points.len();
        listing.reasons.push(format!(
            "{n} points of COLMAP lie beside the cameras: they bound the head where no masks do"
        ));
        listing.points = points;
    }
    let others = other_models(folder.root, files);
    if !others.is_empty() {
        let text = "only the first of several models is read; COLMAP made pieces that it could not join";
        listing.warnings.push(format!("{text}: there are also {}", few(others)));
    }
    let held_out = held_out(folder, files)?;
    let base = files.image_folder(folder, images.iter().map(|image| image.name.as_str()));
    // pictures elsewhere have another lens
    let is_own = base.contains('/') || files.folder.starts_with("distorted");
    if is_own {
        listing.reasons.push(format!("photographs from `{base}/`, which this model is of"));
    }
    let photo = |name: &str| {
        let name = join(&base, name);
        if is_own { folder.exact_photo(&name_of, &name) } else { folder.photo(&name_of, &name) }
    };
    for image in &images {
        match frame(folder, &name_of, &photo, image, &cameras, held_out.as_ref()) {
            Ok(frame) => listing.frames.push(frame),
            Err(problem) => listing.problems.push(problem),
        }
    }
    if let Some(names) = held_out {
        let known: HashSet<&str> = images.iter().map(|i| i.name.as_str()).collect();
        let strangers: Vec<&String> = names.iter().filter(|n| !known.contains(n.as_str())).collect();
        if !strangers.is_empty() {
            let mut strangers: Vec<&str> = strangers.iter().map(|s| s.as_str()).collect();
            strangers.sort_unstable();
            listing
                .warnings
                .push(format!("`test.txt` names photographs without a camera: {}", few(strangers)));
        }
    }
    listing.masks_named = "`masks/`, named as COLMAP's images";
    Ok(())
}

fn other_models(root: &Path, files: &ModelFiles) -> Vec<String> {
    let is_number = |name: &str| name.bytes().all(|b| b.is_ascii_digit());
    let Some((parent, own)) = files.folder.rsplit_once('/').filter(|(_, own)| is_number(own)) else {
        return Vec::new();
    };
    let numbered = |path: &PathBuf| {
        let name = path.file_name()?.to_str()?;
        (name != own && is_number(name)).then(|| format!("{parent}/{name}"))
    };
    io::list_folders(&root.join(parent)).unwrap_or_default().iter().filter_map(numbered).collect()
}

/// Returns the names in `test.txt` beside the model, as 3D Gaussian splatting has them.
fn held_out(folder: &CaptureFolder, files: &ModelFiles) -> Result<Option<HashSet<String>>> {
    let name = ModelFiles { ending: "txt", ..files.clone() }.name("test");
    let Some(path) = folder.file(Path::new(&name)) else { return Ok(None) };
    let bytes = io::read_maybe_empty(&path, &folder.options.limits)?;
    Ok(Some(names_in(&String::from_utf8_lossy(&bytes)).map(str::to_owned).collect()))
}

fn names_in(text: &str) -> impl Iterator<Item = &str> {
    text.lines().map(str::trim).filter(|line| !line.is_empty() && !line.starts_with('#'))
}

/// Returns whether a photograph's name can be read back from a model, and from `test.txt` if it is
/// held out.
pub(super) fn can_name(name: &str, in_test: bool) -> bool {
    let is_relative = join("images", name).len() > name.len();
    is_relative && (!in_test || !name.contains(char::is_control) && names_in(name).eq([name]))
}

fn frame(
    folder: &CaptureFolder,
    file: &str,
    photo: &dyn Fn(&str) -> Result<(PathBuf, Option<PathBuf>)>,
    image: &Image,
    cameras: &HashMap<u32, Camera>,
    held_out: Option<&HashSet<String>>,
) -> Result<CameraFrame> {
    let problem = |text: String| in_frame(file, &image.name, text);
    let camera = cameras.get(&image.camera);
    let camera =
        camera.ok_or_else(|| problem(format!("its camera {} is not in the cameras file", image.camera)))?;
    let size = [camera.width, camera.height]
        .map(|side| u32::try_from(side).ok().filter(|s| (1..=1_000_000).contains(s)));
    let [Some(width), Some(height)] = size else {
        return Err(problem(format!(
            "its camera {} is of {} × {} pixels",
            image.camera, camera.width, camera.height
        )));
    };
    let intrinsics = camera.model.intrinsics((width, height), &camera.values);
    let intrinsics = intrinsics.map_err(|text| problem(format!("camera {}: {text}", image.camera)))?;
    let pose = image.pose.camera_in_world().map_err(|text| problem(text.into()))?;
    let photo = photo(&image.name)?;
    let split = held_out.map(|names| if names.contains(&image.name) { Split::Test } else { Split::Train });
    let mask = folder.mask_of(file, &image.name)?;
    Ok(CameraFrame { split, mask, ..CameraFrame::new(file, &image.name, photo, intrinsics, pose) })
}

impl Rigid {
    /// Returns the rotation and position of the camera, in our axes.
    fn camera_in_world(&self) -> Result<(DMat3, DVec3), &'static str> {
        let rotation = self.matrix()?;
        let world_from_camera = rotation.transpose();
        Ok((world_from_camera * FLIP, -(world_from_camera * self.translation)))
    }

    /// Returns the rotation; quaternions of other lengths are brought to 1.
    fn matrix(&self) -> Result<DMat3, &'static str> {
        let [w, x, y, z] = self.quaternion;
        let q = DQuat::from_xyzw(x, y, z, w);
        let length = q.length();
        if !(length.is_finite() && self.translation.is_finite()) {
            return Err("its pose holds a number that is not finite");
        }
        if length < 1e-6 {
            return Err("its quaternion is zero, which is no rotation");
        }
        // dividing a unit quaternion again would cost its last digit
        let q = if (length - 1.0).abs() < 1e-15 { q } else { q / length };
        Ok(DMat3::from_quat(q))
    }
}

/// Returns a rotation and position of ours as COLMAP's quaternion (w, x, y, z) and translation.
fn pose_of(rotation: DMat3, position: DVec3) -> ([f64; 4], DVec3) {
    let camera_from_world = (rotation * FLIP).transpose();
    let q = DQuat::from_mat3(&camera_from_world).normalize();
    let q = if q.w < 0.0 { -q } else { q };
    ([q.w, q.x, q.y, q.z], -(camera_from_world * position))
}

/// Every file of a model.
#[derive(Debug, Default)]
struct Model {
    pub cameras: HashMap<u32, Camera>,
    pub images: Vec<Image>,
    /// Those that were found, where they are given.
    pub points: Option<Vec<DVec3>>,
    /// Warnings about the files.
    pub notes: Vec<String>,
}

/// One lens, shared by images.
#[derive(Clone, Debug, PartialEq)]
struct Camera {
    pub model: &'static LensModel,
    pub width: u64,
    pub height: u64,
    pub values: Vec<f64>,
}

/// One registered photograph.
#[derive(Clone, Debug)]
struct Image {
    pub id: u32,
    /// Camera from world.
    pub pose: Rigid,
    pub camera: u32,
    pub name: String,
}

/// A rotation (w, x, y, z) and a translation.
#[derive(Clone, Copy, Debug)]
struct Rigid {
    pub quaternion: [f64; 4],
    pub translation: DVec3,
}

impl From<[f64; 7]> for Rigid {
    fn from([w, qx, qy, qz, x, y, z]: [f64; 7]) -> Rigid {
        Rigid { quaternion: [w, qx, qy, qz], translation: DVec3::new(x, y, z) }
    }
}

/// A model that COLMAP has found: binary files in a folder.
#[derive(Clone, Debug)]
pub(super) struct SparseModel {
    /// Registered photographs.
    pub names: HashSet<String>,
    /// Mean reprojection error of the points, pixels.
    pub error_px: f64,
    /// How many points a photograph shows, on average.
    pub sightings: usize,
    cameras: HashMap<u32, Camera>,
}

impl SparseModel {
    /// Reads the model in a folder.
    pub fn read(folder: &Path, limits: &io::Limits) -> Result<SparseModel> {
        let file = |kind: &str| -> Result<(PathBuf, Vec<u8>)> {
            let path = folder.join(format!("{kind}.bin"));
            let bytes = io::read_bytes(&path, limits)?;
            Ok((path, bytes))
        };
        let (cameras, images) = (file("cameras")?, file("images")?);
        let images = binary::read_images(&images, limits)?;
        let points = binary::read_points(&file("points3D")?)?;
        Ok(SparseModel {
            sightings: points.sightings / images.len().max(1),
            names: images.into_iter().map(|image| image.name).collect(),
            error_px: points.error_px / points.positions.len().max(1) as f64,
            cameras: binary::read_cameras(&cameras)?,
        })
    }

    /// Returns the camera that all photographs share, if they do: its longest side and its focal
    /// length, x and y of its principal point relative to the center, in pixels.
    pub fn shared_lens(&self) -> Option<(f64, [f64; 3])> {
        let mut cameras = self.cameras.values();
        let (camera, None) = (cameras.next()?, cameras.next()) else { return None };
        let size = (u32::try_from(camera.width).ok()?, u32::try_from(camera.height).ok()?);
        let lens = camera.model.intrinsics(size, &camera.values).ok()?;
        let ([f, _], [cx, cy]) = (lens.focal, lens.center);
        let [w, h] = [size.0, size.1].map(f64::from);
        Some((w.max(h), [f?, cx? - 0.5 * w, cy? - 0.5 * h]))
    }

    /// Returns the cameras file with the lens as OPENCV's model, which has two focal lengths and
    /// tangential distortion.
    pub fn as_opencv(&self) -> Option<Vec<u8>> {
        let model = LensModel::named("OPENCV").ok()?;
        let widened = |(&id, camera): (&u32, &Camera)| -> Option<(u32, Camera)> {
            let [f, cx, cy, k1] = camera.values[..] else { return None };
            Some((id, Camera { model, values: vec![f, f, cx, cy, k1, 0.0, 0.0, 0.0], ..camera.clone() }))
        };
        Some(camera_bytes(&self.cameras.iter().map(widened).collect::<Option<Vec<_>>>()?))
    }
}

/// Returns a binary cameras file of numbered cameras.
fn camera_bytes(cameras: &[(u32, Camera)]) -> Vec<u8> {
    let mut bytes = (cameras.len() as u64).to_le_bytes().to_vec();
    for (id, Camera { model, width, height, values }) in cameras {
        bytes.extend(id.to_le_bytes());
        bytes.extend(model.id.to_le_bytes());
        bytes.extend([*width, *height].iter().flat_map(|side| side.to_le_bytes()));
        bytes.extend(values.iter().flat_map(|v| v.to_le_bytes()));
    }
    bytes
}

/// Returns the files of a model as (name, bytes), or which lens COLMAP has no model for.
pub(super) fn files(images: &[(String, &geom::Camera)]) -> Result<[(&'static str, Vec<u8>); 3], String> {
    let mut lenses: Vec<(u32, Camera)> = Vec::new();
    let mut listed = (images.len() as u64).to_le_bytes().to_vec();
    for (i, (name, camera)) in images.iter().enumerate() {
        let (model, values) = LensModel::for_camera(camera)
            .ok_or_else(|| format!("no model of COLMAP's has the lens of `{name}`"))?;
        let lens = Camera { model, width: camera.width.into(), height: camera.height.into(), values };
        let known = lenses.iter().find(|(_, known)| *known == lens).map(|(id, _)| *id);
        let number = known.unwrap_or(lenses.len() as u32 + 1);
        if known.is_none() {
            lenses.push((number, lens));
        }
        let (quaternion, t) = pose_of(camera.rotation, camera.position);
        listed.extend((i as u32 + 1).to_le_bytes());
        quaternion.iter().chain(&t.to_array()).for_each(|v| listed.extend(v.to_le_bytes()));
        listed.extend(number.to_le_bytes());
        listed.extend(name.as_bytes());
        listed.push(0);
        listed.extend(0u64.to_le_bytes()); // no points are seen
    }
    let cameras = camera_bytes(&lenses);
    let none = 0u64.to_le_bytes().to_vec();
    Ok([("points3D.bin", none), ("images.bin", listed), ("cameras.bin", cameras)])
}
