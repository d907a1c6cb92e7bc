//! NeuS, IDR and DTU: `cameras_sphere.npz` or `cameras.npz`.
//!
//! `world_mat_I` is the projection K [R | t] of photograph I in name order, for an OpenCV camera;
//! `scale_mat_I` takes the unit sphere around the object into the same world, which stays as it is
//! here: meshes come out where the dataset's own do. NeuS sends its rays through whole numbers as
//! the centers of pixels, so principal points move by half a pixel (NeuS, `models/dataset.py`,
//! `gen_rays_at`).

use super::folder::{CaptureFolder, FLIP, in_file, in_frame};
use super::frame::{CameraFrame, Intrinsics, Listing};
use super::masks::few;
use super::missing;
use super::near::names::{IMAGE_FOLDERS, without_ending};
use super::near::pairs::pair;
use super::options::Reading;
use super::order;
use glam::{DMat3, DVec3};
use std::collections::BTreeMap;
use std::path::Path;
use tiface_base::Result;
use tiface_base::geom::Aabb;
use tiface_base::io::{self, Npy, NpyValues};

/// Files of this format, in this order.
pub(super) const FILES: [&str; 2] = ["cameras_sphere.npz", "cameras.npz"];

/// Skew beyond this share of the focal length is no pinhole's.
const SKEW: f64 = 1e-3;

/// Lists one frame for each photograph.
pub(super) fn list(folder: &CaptureFolder, file: &str, listing: &mut Listing) -> Result<()> {
    let arrays = io::read_npz(&folder.root.join(file), &folder.options.limits)?;
    let plain = folder.pictures(&["image", "images", "rgb"], &IMAGE_FOLDERS)?.unwrap_or_default();
    let numbered = order::by_number(&plain);
    let Reading { by_number, masks_by_number, .. } = folder.reading();
    let photos = if by_number { &numbered } else { &plain };
    listing.order_is_open = order::is_open(&plain);
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
    let mask_files = folder.pictures(&["mask", "masks"], &[])?.unwrap_or_default();
    let pairings = paired_masks(&plain, &numbered, &mask_files, listing);
    let masks = &pairings[usize::from(masks_by_number).min(pairings.len() - 1)];
    listing.mask_order_is_open = pairings.len() > 1;
    for (i, name) in photos.iter().enumerate() {
        let problem = |text: String| in_frame(file, name, text);
        let camera =
            matrix(&arrays, &format!("world_mat_{i}")).and_then(|m| decompose(&m)).map_err(problem)?;
        let (intrinsics, rotation, position) = camera;
        let photo = folder.photo(file, name)?;
        let mask = masks.get(name.as_str()).and_then(|mask| folder.file(Path::new(mask)));
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

/// Masks by the paths of their photographs.
type Masks<'m> = BTreeMap<&'m str, &'m str>;

/// Returns the mask of each photograph: by name if each has one of its name; else in order, as NeuS
/// pairs them, if they are as many; else again by name if most have one. Where the orders by name
/// and by number pair them otherwise, both pairings are returned, that by name first.
fn paired_masks<'m>(
    plain: &'m [String],
    numbered: &'m [String],
    masks: &'m [String],
    listing: &mut Listing,
) -> Vec<Masks<'m>> {
    let Some((place, _)) = masks.first().and_then(|mask| mask.rsplit_once('/')) else {
        return vec![Masks::new()];
    };
    let last = |path: &String| path.rsplit('/').next().unwrap_or_default().to_string();
    let names: Vec<String> = plain.iter().map(|photo| without_ending(&last(photo)).0.to_string()).collect();
    let files: Vec<String> = masks.iter().map(last).collect();
    let pairs = pair(&names, &files);
    let (n, all) = (pairs.count(), plain.len());
    if n < all && masks.len() == all {
        listing.masks_named = "`mask/`, in the order of the photographs";
        let is_other = |(i, file): (usize, &Option<usize>)| file.is_some_and(|file| file != i);
        if let Some(i) = pairs.files.iter().enumerate().position(is_other).filter(|_| 2 * n >= all) {
            listing.warnings.push(format!(
                "masks are paired in the order of the photographs, not by name: `{}` is that of `{}`",
                masks[i], plain[i]
            ));
        }
        return paired_in_order(plain, numbered, masks);
    }
    let counts = format!("`{place}/` has {} masks for {all} photographs", masks.len());
    if 2 * n < all || pairs.doubtful.is_empty() && !pairs.is_sure() {
        listing.warnings.push(format!(
            "{counts}, and only {n} have their names: none is used; leave one for each photograph, in name order"
        ));
        return vec![Masks::new()];
    }
    if masks.len() != all {
        let strangers = pairs.strangers(&files);
        let others = match strangers.is_empty() {
            true => String::new(),
            false => format!(", and no photograph is called {}", few(strangers)),
        };
        listing.warnings.push(format!("{counts}: they are paired by name{others}"));
    }
    listing.masks_named = "`mask/`, named as the photographs";
    let of_name =
        |(photo, file): (&'m String, &Option<usize>)| Some((photo.as_str(), masks[(*file)?].as_str()));
    vec![plain.iter().zip(&pairs.files).filter_map(of_name).collect()]
}

/// Returns the pairs of as many photographs and masks whose names differ: by number where all have
/// the same numbers, else by their places in order.
fn paired_in_order<'m>(plain: &'m [String], numbered: &'m [String], masks: &'m [String]) -> Vec<Masks<'m>> {
    let in_order: Masks = plain.iter().map(String::as_str).zip(masks.iter().map(String::as_str)).collect();
    if !order::is_open(plain) && !order::is_open(masks) {
        return vec![in_order];
    }
    let in_number = order::by_number(masks);
    let same = |(photo, mask): (&String, &String)| {
        order::last_number(photo).is_some_and(|number| order::last_number(mask) == Some(number))
    };
    let have_same_numbers = numbered.iter().zip(&in_number).all(same);
    let place: BTreeMap<&str, usize> = masks.iter().map(String::as_str).zip(0..).collect();
    let in_number = in_number.iter().map(|mask| masks[place[mask.as_str()]].as_str());
    let by_number: Masks = numbered.iter().map(String::as_str).zip(in_number).collect();
    if have_same_numbers {
        return vec![by_number];
    }
    let mut all = vec![in_order, by_number];
    all.dedup();
    all
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

/// K, rotation and position of a projection: a QR decomposition from the last row up (Hartley and
/// Zisserman, §6.2.4).
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
    fn masks_follow_their_photographs_by_name_by_number_or_by_order() {
        let names = |text: &str| -> Vec<String> { text.split(' ').map(|n| format!("m/{n}.png")).collect() };
        let pairings = |photos: &str, masks: &str| -> Vec<Vec<String>> {
            let (plain, masks) = (names(photos), names(masks));
            let numbered = order::by_number(&plain);
            let found = paired_masks(&plain, &numbered, &masks, &mut Listing::default());
            let masks = |pairs: &BTreeMap<&str, &str>| -> Vec<String> {
                plain
                    .iter()
                    .filter_map(|p| pairs.get(p.as_str()).map(|m| order::stem(m).to_string()))
                    .collect()
            };
            found.iter().map(masks).collect()
        };
        let text = |text: &str| -> Vec<String> { text.split(' ').map(str::to_string).collect() };
        // one more mask than photographs
        assert_eq!(pairings("0 1 10 2", "0 1 10 2 all"), [text("0 1 10 2")]);
        // names differ, numbers do not
        assert_eq!(pairings("0 1 10 2", "000 001 002 010"), [text("000 001 010 002")]);
        assert_eq!(pairings("000 001 002 010", "0 1 10 2"), [text("0 1 2 10")]);
        // numbers differ, orders do not
        assert_eq!(pairings("0 1 2", "1 2 3"), [text("1 2 3")]);
        // both differ
        assert_eq!(pairings("008 009 010", "10 11 9"), [text("10 11 9"), text("9 10 11")]);
        // fewer masks
        assert_eq!(pairings("0 1 2", "1 2"), [text("1 2")]);
        assert_eq!(pairings("0 1 2", "7 8"), [Vec::<String>::new()]);
    }

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
        let mut listing = Listing::default();
        let mut paired = |masks: &[&str]| -> (Vec<String>, Vec<String>) {
            let masks = of("mask", masks);
            let pairings = paired_masks(&photos, &photos, &masks, &mut listing);
            (
                pairings[0].values().map(|mask| mask.to_string()).collect(),
                std::mem::take(&mut listing.warnings),
            )
        };
        assert_eq!(paired(&["a.png", "b.png"]), (of("mask", &["a.png", "b.png"]), vec![]));
        let (more, warnings) = paired(&["000.png", "001.png", "overview.png"]);
        assert_eq!(more, of("mask", &["000.png", "001.png"]));
        assert!(warnings[0].contains("3 masks for 2 photographs"), "{warnings:?}");
        assert!(warnings[0].contains("`overview.png`"), "{warnings:?}");
        let (others, warnings) = paired(&["a.png", "b.png", "c.png"]);
        assert!(others.is_empty() && warnings[0].contains("only 0"), "{warnings:?}");
        assert_eq!(paired(&[]), (vec![], vec![]));
    }
}
