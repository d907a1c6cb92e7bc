//! The demo capture: an analytic head photographed among the lamps of a small light stage, with
//! exact truth.
//!
//! Written in the layout of a real capture (`images/`, `masks/`, `transforms.json`), so that the
//! whole pipeline runs on it unchanged; and its surface is a formula ([`SyntheticHead`]), so that
//! what comes out can be measured against the truth instead of against another reconstruction.
//!
//! Same options, same bytes.

mod photograph;
mod reflectance;
mod shape;

pub use shape::SyntheticHead;

use glam::{DMat3, DVec3};
use photograph::Studio;
use serde::Deserialize;
use serde_json::{Value, json};
use std::path::Path;
use tiface_base::geom::{Camera, Distortion, Similarity};
use tiface_base::io::{self, Limits};
use tiface_base::{Error, Result};

/// What [`write_capture`] makes.
#[derive(Clone, Debug, PartialEq)]
pub struct SyntheticOptions {
    /// Picture width, pixels.
    pub width: u32,
    /// Picture height, pixels.
    pub height: u32,
    /// Training views.
    pub train: usize,
    /// Held-out views, numbered after the training views.
    pub test: usize,
    /// Moves cameras within their cells and makes the grain; the head stays the same.
    pub seed: u64,
}

impl Default for SyntheticOptions {
    fn default() -> Self {
        SyntheticOptions { width: 256, height: 320, train: 24, test: 8, seed: 42 }
    }
}

/// Returns the cameras of a capture, training views first: `(camera, is it for training)`.
///
/// They stand on a dome about 1.1 m from the head, azimuth ±110° around the face, elevation −18°
/// to +50°, one in each cell of an even lattice, so that the whole bust is in every frame. The back
/// of the head is seen, but only from the sides and from above, as on a real stage.
pub fn cameras(options: &SyntheticOptions) -> Vec<(Camera, bool)> {
    let dome = |count: usize, salt: u64| -> Vec<Camera> {
        // rows × columns close to the 70° × 220° of the dome
        let rows = ((count as f64 * 70.0 / 220.0).sqrt().round() as usize).max(1);
        (0..count)
            .map(|i| {
                let row = i * rows / count;
                let (first, end) = ((row * count).div_ceil(rows), ((row + 1) * count).div_ceil(rows));
                let draw = |k| shape::unit(options.seed ^ salt, i as u32, k) as f64 - 0.5;
                let across = (i - first) as f64 + 0.5 + 0.4 * draw(0);
                let azimuth = -110.0 + 220.0 * across / (end - first) as f64;
                let elevation = -20.0 + 70.0 * (row as f64 + 0.5 + 0.55 * draw(1)) / rows as f64;
                let distance = 1.10 + 0.06 * draw(2);
                aim(options, azimuth.to_radians(), elevation.to_radians(), distance, 0.06 * draw(3))
            })
            .collect()
    };
    let train = dome(options.train, 0x7261).into_iter().map(|c| (c, true));
    train.chain(dome(options.test, 0x6865).into_iter().map(|c| (c, false))).collect()
}

/// Returns a camera on the dome, looking at the middle of the bust, rolled by `roll` radians.
fn aim(options: &SyntheticOptions, azimuth: f64, elevation: f64, distance: f64, roll: f64) -> Camera {
    let center = SyntheticHead.bounds().center().as_dvec3();
    let (sin, cos) = elevation.sin_cos();
    let backwards = DVec3::new(azimuth.sin() * cos, -azimuth.cos() * cos, sin);
    let right = DVec3::Z.cross(backwards).normalize();
    let up = backwards.cross(right);
    let level = DMat3::from_cols(right, up, backwards);
    let (w, h) = (options.width as f64, options.height as f64);
    // the bust is about as wide as 4/5 of its height: the narrower side decides
    let focal = 2.6 * h.min(1.25 * w);
    Camera {
        width: options.width,
        height: options.height,
        fx: focal,
        fy: focal,
        cx: 0.5 * w,
        cy: 0.5 * h,
        distortion: Distortion::default(),
        rotation: level * DMat3::from_rotation_z(roll),
        position: center + distance * backwards,
    }
}

/// Refuses what no capture can be made of: sides and numbers of views beyond bounds.
///
/// # Errors
///
/// It is so.
pub fn check(options: &SyntheticOptions) -> Result<()> {
    let &SyntheticOptions { width, height, train, test, .. } = options;
    let sides = 16..=4096;
    let views = train.saturating_add(test);
    if !sides.contains(&width) || !sides.contains(&height) || train == 0 || views > 999 {
        return Err(Error::cannot(
            format_args!(
                "a synthetic capture of {train} + {test} views at {width} × {height} pixels: expected 1..=999 views \
                 in all and sides of 16..=4096"
            ),
            "ask for a size and number of views within these bounds",
        ));
    }
    Ok(())
}

/// Photographs the head and writes the capture folder `dir`: `images/`, `masks/` (soft),
/// `face_masks/` (binary), `transforms.json` with every view and its split,
/// `transforms_train.json`, `transforms_test.json` and `README.md`. `transforms.json` comes last: a
/// capture that has one is complete.
pub fn write_capture(dir: &Path, options: &SyntheticOptions) -> Result<()> {
    check(options)?;
    write_photographs(dir, &cameras(options), &Similarity::IDENTITY, options.seed, &readme(options))
}

/// Photographs the head with these cameras (all of the intrinsics of the first) and writes the
/// capture folder `dir`, as [`write_capture`] does, in another world than the head's.
pub fn write_photographs(
    dir: &Path,
    cameras: &[(Camera, bool)],
    world_from_head: &Similarity,
    seed: u64,
    readme: &str,
) -> Result<()> {
    let studio = Studio::shared();
    for folder in ["images", "masks", "face_masks"] {
        io::create_folder(&dir.join(folder))?;
    }
    for (i, (camera, _)) in cameras.iter().enumerate() {
        let (width, height) = (camera.width, camera.height);
        let picture = studio.photograph(camera, seed.wrapping_add(i as u64));
        let path = |folder: &str| dir.join(format!("{folder}/{i:03}.png"));
        io::write_png_rgb(&path("images"), width, height, &picture.photo.rgb)?;
        io::write_png_gray(&path("masks"), &picture.mask)?;
        io::write_png_gray(&path("face_masks"), &picture.region)?;
    }
    let moved = |(camera, train): &(Camera, bool)| (camera.transformed(world_from_head), *train);
    let cameras: Vec<(Camera, bool)> = cameras.iter().map(moved).collect();
    let text = |value: Value| format!("{value:#}\n").into_bytes();
    io::write_atomic(&dir.join("README.md"), readme.as_bytes())?;
    for split in [Some(true), Some(false)] {
        let name = if split == Some(true) { "transforms_train.json" } else { "transforms_test.json" };
        io::write_atomic(&dir.join(name), &text(transforms(&cameras, split)))?;
    }
    io::write_atomic(&dir.join("transforms.json"), &text(transforms(&cameras, None)))?;
    Ok(())
}

/// Writes `valid/NAME.npy` for every view of a capture: a border of this width is not usable, as in
/// the ILSH dataset, whose photographs are undistorted. To be written before the capture, whose
/// cameras say that it is complete.
pub fn write_borders(dir: &Path, options: &SyntheticOptions, border: u32) -> Result<()> {
    let bytes = border_bytes(options.width, options.height, border);
    io::create_folder(&dir.join("valid"))?;
    for i in 0..options.train + options.test {
        io::write_atomic(&dir.join(format!("valid/{i:03}.npy")), &bytes)?;
    }
    Ok(())
}

fn border_bytes(width: u32, height: u32, border: u32) -> Vec<u8> {
    let inside = |v: u32, side: u32| v >= border && v < side.saturating_sub(border);
    let usable =
        (0..height).flat_map(|y| (0..width).map(move |x| (inside(x, width) && inside(y, height)) as u8));
    io::npy_bytes("|b1", &[height as usize, width as usize], &usable.collect::<Vec<u8>>())
}

/// What a finished capture of [`write_capture`] was made with.
#[derive(Clone, Debug, PartialEq)]
pub struct MadeCapture {
    /// Picture width, pixels.
    pub width: u32,
    /// Picture height, pixels.
    pub height: u32,
    /// Views in all.
    pub views: usize,
    /// The border mask of the first view.
    border: Option<Vec<u8>>,
}

impl MadeCapture {
    /// Reads the capture in a folder; `None` if it was not finished.
    pub fn read(dir: &Path) -> Result<Option<MadeCapture>> {
        #[derive(Deserialize)]
        struct Transforms {
            w: u32,
            h: u32,
            frames: Vec<Value>,
        }
        let (cameras, border) = (dir.join("transforms.json"), dir.join("valid/000.npy"));
        if !io::is_file(&cameras) {
            return Ok(None);
        }
        let Transforms { w: width, h: height, frames } = io::read_typed(&cameras, &Limits::default())?;
        let border = io::is_file(&border).then(|| io::read_bytes(&border, &Limits::default())).transpose()?;
        Ok(Some(MadeCapture { width, height, views: frames.len(), border }))
    }

    /// Returns whether [`write_borders`] marked a border of this width.
    pub fn has_border(&self, border: u32) -> bool {
        self.border.as_ref().is_some_and(|found| *found == border_bytes(self.width, self.height, border))
    }
}

/// Returns the frames of one split (`Some(train)`), or all with their split named.
fn transforms(cameras: &[(Camera, bool)], split: Option<bool>) -> Value {
    let frames: Vec<Value> = cameras
        .iter()
        .enumerate()
        .filter(|(_, (_, train))| split.is_none_or(|s| s == *train))
        .map(|(i, (camera, train))| {
            let (r, p) = (camera.rotation, camera.position);
            let row = |k: usize| json!([r.x_axis[k], r.y_axis[k], r.z_axis[k], p[k]]);
            json!({
                "file_path": format!("images/{i:03}.png"),
                "mask_path": format!("masks/{i:03}.png"),
                "face_mask_path": format!("face_masks/{i:03}.png"),
                "split": if *train { "train" } else { "test" },
                "transform_matrix": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
            })
        })
        .collect();
    let first = &cameras[0].0;
    json!({
        "camera_model": "OPENCV",
        "fl_x": first.fx, "fl_y": first.fy, "cx": first.cx, "cy": first.cy,
        "w": first.width, "h": first.height,
        "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0,
        "units": "metres",
        "up": [0, 0, 1],
        "frames": frames,
    })
}

fn readme(options: &SyntheticOptions) -> String {
    let &SyntheticOptions { width, height, train, test, seed } = options;
    let text = include_str!("synthetic/README.md");
    let values = [("{width}", width as u64), ("{height}", height.into()), ("{train}", train as u64)];
    let values = values.into_iter().chain([("{test}", test as u64), ("{seed}", seed)]);
    values.fold(text.to_string(), |text, (key, value)| text.replace(key, &value.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SMALL: SyntheticOptions = SyntheticOptions { width: 64, height: 80, train: 5, test: 2, seed: 42 };

    #[test]
    fn the_whole_bust_is_in_every_frame() {
        let points = SyntheticHead.surface_points(1500, 9);
        for (camera, _) in cameras(&SyntheticOptions::default()) {
            for p in &points {
                let (pixel, _) = camera.project(*p).unwrap();
                let inside = pixel.x > 3.0 && pixel.x < 253.0 && pixel.y > 3.0 && pixel.y < 317.0;
                assert!(inside, "{p} lands on {pixel} of a camera at {}", camera.position);
            }
        }
    }

    #[test]
    fn the_mask_agrees_with_the_surface_and_pictures_repeat_byte_for_byte() {
        let camera = &cameras(&SMALL)[0].0;
        let studio = Studio::shared();
        let (a, b) = (studio.photograph(camera, 1), studio.photograph(camera, 1));
        assert_eq!((&a.photo, &a.mask), (&b.photo, &b.mask));
        assert_ne!(a.photo, studio.photograph(camera, 2).photo); // other grain
        // every surface point projects onto a covered pixel, or beside one at the outline
        for p in SyntheticHead.surface_points(400, 3) {
            let (pixel, _) = camera.project(p).unwrap();
            let (x, y) = (pixel.x as usize, pixel.y as usize);
            let near = (y - 1..y + 2).flat_map(|y| (x - 1..x + 2).map(move |x| y * 64 + x));
            let most = near.map(|i| a.mask.values[i]).max().unwrap();
            assert!(most > 0, "{p} lands on an empty pixel {pixel}");
        }
        // the border is background, the middle is head
        assert_eq!(a.mask.values[0], 0);
        assert_eq!(a.mask.values[40 * 64 + 32], 255);
        // both kinds of soft values occur: the outline is not a staircase
        let soft = a.mask.values.iter().filter(|&&v| v > 0 && v < 255).count();
        assert!(soft > 60, "{soft}");
    }

    #[test]
    fn a_capture_has_all_its_files_and_says_who_is_held_out() {
        let dir = tempfile::tempdir().unwrap();
        write_capture(dir.path(), &SMALL).unwrap();
        let text = std::fs::read_to_string(dir.path().join("transforms.json")).unwrap();
        let all: Value = serde_json::from_str(&text).unwrap();
        let frames = all["frames"].as_array().unwrap();
        assert_eq!(frames.len(), 7);
        for (i, frame) in frames.iter().enumerate() {
            assert_eq!(frame["split"], if i < 5 { "train" } else { "test" });
            for key in ["file_path", "mask_path", "face_mask_path"] {
                assert!(dir.path().join(frame[key].as_str().unwrap()).is_file());
            }
        }
        write_borders(dir.path(), &SMALL, 5).unwrap();
        let c = crate::open(dir.path(), &Default::default()).unwrap();
        let valid = c.views[6].load(&Default::default()).unwrap().valid.unwrap();
        let usable = valid.values.iter().filter(|&&v| v == 255).count();
        assert_eq!((usable, valid.values[5 * 64 + 5], valid.values[5 * 64 + 4]), (54 * 70, 255, 0));
        let none = SyntheticOptions { train: 0, ..SMALL };
        assert!(write_capture(dir.path(), &none).unwrap_err().to_string().contains("0 + 2 views"));
    }
}
