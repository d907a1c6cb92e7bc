//! NeuS, IDR and DTU: `cameras_sphere.npz` or `cameras.npz`.
//!
//! `world_mat_I` is the projection K [R | t] of photograph I in name order, for an OpenCV camera; `scale_mat_I` takes
//! the unit sphere around the object into the same world, which stays as it is here: meshes come out where the
//! dataset's own do. NeuS sends its rays through whole numbers as the centers of pixels, so principal points move
//! by half a pixel (NeuS, `models/dataset.py`, `gen_rays_at`).

use super::folder::{CaptureFolder, FLIP, in_file, in_frame};
use super::frame::{CameraFrame, Intrinsics, Listing};
use super::masks::few;
use super::missing;
use super::near::names::{IMAGE_FOLDERS, without_ending};
use super::near::pairs::pair;
use crate::Result;
use crate::geom::Aabb;
use crate::io::{self, Npy, NpyValues};
use glam::{DMat3, DVec3};
use std::collections::BTreeMap;
use std::path::Path;

/// Files of this format, in this order.
pub(super) const FILES: [&str; 2] = ["cameras_sphere.npz", "cameras.npz"];

/// Skew beyond this share of the focal length is no pinhole's.
const SKEW: f64 = 1e-3;

/// Lists one frame for each photograph.
pub(super) fn list(folder: &CaptureFolder, file: &str, listing: &mut Listing) -> Result<()> {
    let arrays = io::read_npz(&folder.root.join(file), &folder.options.limits)?;
    let photos = folder.pictures(&["image", "images", "rgb"], &IMAGE_FOLDERS)?.unwrap_or_default();
    let masks = folder.pictures(&["mask", "masks"], &[])?.unwrap_or_default();
    let known = (0..).take_while(|i| arrays.contains_key(&format!("world_mat_{i}"))).count();
    let hint = "it must have `world_mat_0`, `world_mat_1` and so on, one for each photograph in `image/`";
    if known == 0 {
        return Err(in_file(file, "it has no array `world_mat_0`", hint));
    } else if known != photos.len() {
        // reduced photographs would not say what the cameras are for
        let there = if photos.is_empty() { missing::no_folder(folder, "image").0 } else { String::new() };
        let problem =
            format!("it has {known} cameras for the {} photographs in `image/`{there}", photos.len());
        return Err(in_file(file, problem, hint));
    }
    let masks = paired(&photos, masks, listing);
    for (i, (name, mask)) in photos.iter().zip(masks).enumerate() {
        let problem = |text: String| in_frame(file, name, text);
        let camera =
            matrix(&arrays, &format!("world_mat_{i}")).and_then(|m| decompose(&m)).map_err(problem)?;
        let (intrinsics, rotation, position) = camera;
        let photo = folder.photo(file, name)?;
        let mask = mask.and_then(|mask| folder.file(Path::new(&mask)));
        let frame = CameraFrame::new(file, name, photo, intrinsics, (rotation, position));
        listing.frames.push(CameraFrame { mask, ..frame });
    }
    if arrays.contains_key("scale_mat_0") {
        let problem = |text| in_file(file, text, "save it again with `numpy.savez`");
        let m = matrix(&arrays, "scale_mat_0").map_err(problem)?;
        let center = DVec3::new(m[3], m[7], m[11]);
        let radius = m[0].abs();
        if !(center.is_finite() && radius.is_finite() && radius > 0.0) {
            return Err(problem(format!("`scale_mat_0` has the center {center} and the radius {radius}")));
        }
        listing
            .reasons
            .push(format!("`scale_mat_0` puts the object within {radius:.4} units of {center:.4}"));
        let (center, radius) = (center.as_vec3(), radius as f32);
        listing.focus = Some(Aabb { min: center - radius, max: center + radius });
    }
    Ok(())
}

/// Returns the mask of each photograph: by name if each has one of its name, else in order, as NeuS
/// pairs them, if they are as many, else again by name if most have one.
fn paired(photos: &[String], masks: Vec<String>, listing: &mut Listing) -> Vec<Option<String>> {
    listing.masks_named = "`mask/`, in the order of the photographs";
    let Some((place, _)) = masks.first().and_then(|mask| mask.rsplit_once('/')) else {
        return vec![None; photos.len()];
    };
    let last = |path: &String| path.rsplit('/').next().unwrap_or_default().to_string();
    let names: Vec<String> = photos.iter().map(|photo| without_ending(&last(photo)).0.to_string()).collect();
    let files: Vec<String> = masks.iter().map(last).collect();
    let pairs = pair(&names, &files);
    let (n, is_same_count) = (pairs.count(), masks.len() == photos.len());
    let counts = format!("`{place}/` has {} masks for {} photographs", masks.len(), photos.len());
    if n < photos.len() && is_same_count {
        let is_other = |(i, file): (usize, &Option<usize>)| file.is_some_and(|file| file != i);
        if let Some(i) = pairs.files.iter().enumerate().position(is_other).filter(|_| 2 * n >= photos.len()) {
            listing.warnings.push(format!(
                "masks are paired in the order of the photographs, not by name: `{}` is that of `{}`",
                masks[i], photos[i]
            ));
        }
        return masks.into_iter().map(Some).collect();
    }
    if 2 * n < photos.len() {
        listing.warnings.push(format!(
            "{counts}, and only {n} have their names: none is used; leave one for each photograph, in name order"
        ));
        return vec![None; photos.len()];
    }
    if !is_same_count {
        let strangers = pairs.strangers(&files);
        let others = match strangers.is_empty() {
            true => String::new(),
            false => format!(", and no photograph is called {}", few(strangers)),
        };
        listing.warnings.push(format!("{counts}: they are paired by name{others}"));
    }
    listing.masks_named = "`mask/`, named as the photographs";
    pairs.files.into_iter().map(|file| file.map(|file| masks[file].clone())).collect()
}

/// Returns the upper three rows of a 4×4 or 3×4 array, finite.
fn matrix(arrays: &BTreeMap<String, Npy>, name: &str) -> Result<[f64; 12], String> {
    let Some(Npy { shape, values: NpyValues::Number(values) }) = arrays.get(name) else {
        return Err(format!("`{name}` is missing or holds no numbers"));
    };
    if !matches!(shape[..], [4, 4] | [3, 4]) {
        return Err(format!("`{name}` is of shape {shape:?}, not 4 × 4"));
    }
    match values.first_chunk::<12>() {
        Some(rows) if rows.iter().all(|v| v.is_finite()) => Ok(*rows),
        _ => Err(format!("`{name}` holds a number that is not finite")),
    }
}

/// K, rotation and position of a projection: a QR decomposition from the last row up (Hartley and Zisserman, §6.2.4).
fn decompose(p: &[f64; 12]) -> Result<(Intrinsics, DMat3, DVec3), String> {
    let row = |k: usize| DVec3::new(p[4 * k], p[4 * k + 1], p[4 * k + 2]);
    let (m, last) = (DMat3::from_cols(row(0), row(1), row(2)).transpose(), DVec3::new(p[3], p[7], p[11]));
    let lengths = row(0).length() * row(1).length() * row(2).length();
    if m.determinant().abs() <= 1e-12 * lengths {
        return Err("its projection flattens space".into());
    }
    let sign = m.determinant().signum();
    let [a, b, c] = [0, 1, 2].map(|k| sign * row(k));
    let third = c.length();
    let ahead = c / third;
    let (cy, rest) = (b.dot(ahead), b - b.dot(ahead) * ahead);
    let fy = rest.length();
    let down = rest / fy;
    let (cx, skew) = (a.dot(ahead), a.dot(down));
    let rest = a - cx * ahead - skew * down;
    let fx = rest.length();
    let right = rest / fx;
    if skew.abs() > SKEW * fx {
        return Err(format!("its pixels are skewed by {:.5}, which no photograph's are", skew / fx));
    }
    let position = -(m.inverse() * last);
    let [fx, fy, cx, cy] = [fx, fy, cx, cy].map(|v| v / third);
    let intrinsics = Intrinsics {
        focal: [Some(fx), Some(fy)],
        center: [Some(cx + 0.5), Some(cy + 0.5)],
        ..Intrinsics::default()
    };
    Ok((intrinsics, DMat3::from_cols(right, down, ahead) * FLIP, position))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_projection_is_taken_apart_whatever_its_sign_and_scale() {
        let k = DMat3::from_cols_array(&[300.0, 0.0, 0.0, 0.0, 310.0, 0.0, 80.0, 60.0, 1.0]);
        let rotation = DMat3::from_rotation_x(0.4) * DMat3::from_rotation_z(-2.0);
        let position = DVec3::new(0.3, -1.0, 2.0);
        for scale in [1.0, -2.5, 1e-4] {
            let m = k * rotation.transpose() * scale;
            let t = -(m * position);
            let rows: Vec<f64> = (0..3).flat_map(|r| [m.row(r).x, m.row(r).y, m.row(r).z, t[r]]).collect();
            let (i, r, p) = decompose(rows.as_slice().try_into().unwrap()).unwrap();
            let close = |a: Option<f64>, b: f64| (a.unwrap() - b).abs() < 1e-9;
            assert!(close(i.focal[0], 300.0) && close(i.focal[1], 310.0), "{i:?}");
            assert!(close(i.center[0], 80.5) && close(i.center[1], 60.5), "{i:?}");
            assert!((r - rotation * FLIP).to_cols_array().iter().all(|v| v.abs() < 1e-9));
            assert!(p.distance(position) < 1e-9);
        }
        assert!(decompose(&[0.0; 12]).unwrap_err().contains("flattens"));
        let skewed = [1.0, 0.1, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
        assert!(decompose(&skewed).unwrap_err().contains("skewed"));
    }

    #[test]
    fn masks_are_paired_in_order_or_by_name_if_there_are_more_or_fewer() {
        let of =
            |folder: &str, names: &[&str]| names.iter().map(|n| format!("{folder}/{n}")).collect::<Vec<_>>();
        let photos = of("image", &["000.jpg", "001.jpg"]);
        let mask = |name: &str| Some(format!("mask/{name}"));
        let mut listing = Listing::default();
        let same = paired(&photos, of("mask", &["a.png", "b.png"]), &mut listing);
        assert!(same == [mask("a.png"), mask("b.png")] && listing.warnings.is_empty());
        let more = paired(&photos, of("mask", &["000.png", "001.png", "overview.png"]), &mut listing);
        assert_eq!(more, [mask("000.png"), mask("001.png")]);
        assert!(listing.warnings[0].contains("3 masks for 2 photographs"), "{:?}", listing.warnings);
        assert!(listing.warnings[0].contains("`overview.png`"), "{:?}", listing.warnings);
        let others = paired(&photos, of("mask", &["a.png", "b.png", "c.png"]), &mut listing);
        assert!(others == [None, None] && listing.warnings[1].contains("only 0"), "{:?}", listing.warnings);
        assert_eq!(paired(&photos, Vec::new(), &mut listing), [None, None]);
    }
}
