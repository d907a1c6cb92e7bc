//! LLFF poses, `poses_bounds*.npy`: alone, or to check the JSON beside them.
//!
//! A row is a 3×5 matrix in row-major order, columns down, right, backwards, position and (height,
//! width, focal), then near and far, which are not needed. OpenGL axes are (column 1, −column 0,
//! column 2). The published loader divides positions by 0.3; here the world stays as the dataset
//! has it.

use super::folder::{CaptureFolder, in_file, in_frame};
use super::frame::{self, Agreement, CameraFrame, Intrinsics, Listing};
use super::missing;
use super::near::names::IMAGE_FOLDERS;
use super::order;
use super::view::Split;
use glam::{DMat3, DVec3};
use tiface_base::io::{self, NpyValues};
use tiface_base::{Error, Result};

/// Relative to the spread of the cameras.
const POSITION_TOLERANCE: f64 = 1e-3;
/// Radians; 0.1°.
const ROTATION_TOLERANCE: f64 = 1.75e-3;
/// Relative.
const FOCAL_TOLERANCE: f64 = 1e-3;

#[derive(Clone, Copy, Debug)]
struct PoseRow {
    rotation: DMat3,
    position: DVec3,
    size: (u32, u32),
    focal: f64,
}

fn read(folder: &CaptureFolder, file: &str) -> Result<Vec<PoseRow>> {
    let limits = &folder.options.limits;
    let problem = |text: String| in_file(file, text, "an LLFF file has one row of 17 numbers per photograph");
    let npy = io::read_npy(&folder.root.join(file), limits)?;
    let (NpyValues::Number(values), [rows, 17]) = (&npy.values, &npy.shape[..]) else {
        return Err(problem(format!("its shape is {:?}, not (photographs, 17)", npy.shape)));
    };
    if *rows == 0 || *rows > limits.views {
        return Err(problem(format!("it has {rows} rows")));
    }
    let hint = "correct that row; columns are down, right, backwards, position, (height, width, focal)";
    let read = |(i, v)| row(v).map_err(|text| in_frame(file, &format!("row {i}"), text).with_hint(hint));
    values.as_chunks().0.iter().enumerate().map(read).collect()
}

fn row(v: &[f64; 17]) -> Result<PoseRow, String> {
    let column = |k: usize| [v[k], v[k + 5], v[k + 10]];
    let (down, right, back, position) = (column(0), column(1), column(2), column(3));
    let rows = [0, 1, 2].map(|r| [right[r], -down[r], back[r], position[r]]);
    let (rotation, position) = frame::pose(&rows)?;
    let [h, w, focal] = column(4);
    let whole = |x: f64| x.is_finite() && x.fract() == 0.0 && (1.0..=1e6).contains(&x);
    if !(whole(h) && whole(w) && focal.is_finite() && focal > 0.0) {
        return Err(format!("height {h}, width {w} and focal length {focal} are not those of a picture"));
    }
    Ok(PoseRow { rotation, position, size: (w as u32, h as u32), focal })
}

fn split_of(file: &str) -> Option<Split> {
    match file {
        "poses_bounds_train.npy" => Some(Split::Train),
        "poses_bounds_test.npy" => Some(Split::Test),
        _ => None,
    }
}

/// Compares each LLFF file with the frames of its split. Rows carry no names, so they are paired
/// with the frames in the JSON's order, in name order or by number, whichever fits best.
pub(super) fn check(folder: &CaptureFolder, files: &[&str], listing: &mut Listing) {
    for &file in files {
        let split = split_of(file);
        let frames: Vec<&CameraFrame> =
            listing.frames.iter().filter(|f| split.is_none() || f.split == split).collect();
        match read(folder, file).and_then(|rows| compare(file, &rows, &frames)) {
            Ok(a) => {
                listing.reasons.push(format!(
                    "`{file}` agrees with the JSON about {} cameras within {:.1e} units, {:.1e}°, {:.1e} of the \
                     focal length",
                    a.cameras,
                    a.position,
                    a.rotation.to_degrees(),
                    a.focal
                ));
                listing.agreements.push(a);
            }
            Err(problem) => listing.problems.push(problem),
        }
    }
}

fn compare(file: &str, rows: &[PoseRow], frames: &[&CameraFrame]) -> Result<Agreement> {
    let json = frames.first().map_or("the JSON".to_string(), |f| f.file.clone());
    let hint = format!("remove the file that is wrong; without `{file}` the JSON is used alone");
    if rows.len() != frames.len() || frames.is_empty() {
        let (rows, frames) = (rows.len(), frames.len());
        return Err(in_file(
            file,
            format!("it has {rows} rows, but `{json}` has {frames} frames for it"),
            hint,
        ));
    }
    let mean = frames.iter().map(|f| f.position).sum::<DVec3>() / frames.len() as f64;
    let spread = frames.iter().map(|f| f.position.distance(mean)).fold(0.0, f64::max).max(1e-12);
    let (mut by_name, mut by_number) = (frames.to_vec(), frames.to_vec());
    by_name.sort_by(|a, b| a.name.cmp(&b.name));
    by_number.sort_by(|a, b| order::compare(&a.name, &b.name));
    let worst = |order: &[&CameraFrame]| -> Vec<[f64; 3]> {
        rows.iter().zip(order).map(|(row, frame)| difference(row, frame)).collect()
    };
    // how far over its tolerance the worst of the three is
    let excess = |d: &[f64; 3]| {
        (d[0] / (POSITION_TOLERANCE * spread)).max(d[1] / ROTATION_TOLERANCE).max(d[2] / FOCAL_TOLERANCE)
    };
    let total = |ds: &[[f64; 3]]| ds.iter().map(excess).fold(0.0, f64::max);
    let mut orders = [frames, &by_name, &by_number].map(|order| (worst(order), order));
    orders.sort_by(|(a, _), (b, _)| total(a).total_cmp(&total(b)));
    let [(differences, order), ..] = orders;
    let most = (0..rows.len()).max_by(|&i, &j| excess(&differences[i]).total_cmp(&excess(&differences[j])));
    if let Some(i) = most
        && excess(&differences[i]) > 1.0
    {
        let [position, rotation, focal] = differences[i];
        let problem = if focal.is_infinite() {
            format!("row {i} is for {} × {} pixels", rows[i].size.0, rows[i].size.1)
        } else {
            format!(
                "row {i} is {position:.6} units and {:.4}° away, its focal length differs by {:.4} %",
                rotation.to_degrees(),
                100.0 * focal
            )
        };
        let frame = &order[i].name;
        let message = format!("`{file}` and `{json}` disagree about frame `{frame}`: {problem}");
        return Err(Error::cannot(message, hint));
    }
    let max = |k: usize| differences.iter().map(|d| d[k]).fold(0.0, f64::max);
    Ok(Agreement {
        poses: file.into(),
        cameras: rows.len(),
        position: max(0),
        rotation: max(1),
        focal: max(2),
    })
}

/// Distance, angle, and relative difference of focal length (infinite if the sizes differ).
fn difference(row: &PoseRow, frame: &CameraFrame) -> [f64; 3] {
    let turn = row.rotation.transpose() * frame.rotation;
    // ‖R − I‖ = 2√2 sin(θ/2) stays exact for small angles, where acos of the trace does not
    let e = turn - DMat3::IDENTITY;
    let norm = e.to_cols_array().iter().map(|v| v * v).sum::<f64>().sqrt();
    let angle = 2.0 * (norm / 8f64.sqrt()).min(1.0).asin();
    let size = frame.intrinsics.size.unwrap_or(row.size);
    let focal = match frame.intrinsics.camera(size, frame.rotation, frame.position) {
        Ok(camera) if (camera.width, camera.height) == row.size => (camera.fx / row.focal - 1.0).abs(),
        _ => f64::INFINITY,
    };
    [row.position.distance(frame.position), angle, focal]
}

/// Lists the frames of LLFF files alone, pairing rows with photographs in the order that is read.
pub(super) fn list(folder: &CaptureFolder, files: &[&str], listing: &mut Listing) -> Result<()> {
    let mut sets = Vec::new();
    for &file in files {
        sets.push((file, read(folder, file)?));
    }
    let problem = |file: &str, text: String| {
        let hint =
            "put one photograph per row into `images/` (or `images_train/`, `images_test/`), in name order";
        in_file(file, text, hint)
    };
    let mut named = |suffix| photographs(folder, suffix, listing);

    // folders per split first; else one folder whose count says which files it belongs to
    let (shared, train, test) = (named("")?.unwrap_or_default(), named("_train")?, named("_test")?);
    let total: usize = sets.iter().map(|(_, rows)| rows.len()).sum();
    let photos: Vec<Vec<String>> = if let (Some(train), Some(test), [_, _]) = (train, test, &sets[..]) {
        vec![train, test]
    } else if shared.len() == total {
        if let [(_, first), _] = &sets[..] {
            listing.warnings.push(format!(
                "the rows of {} carry no names: the first {} photographs {} are taken for training, the others for \
                 testing",
                files.join(" and "),
                first.len(),
                if folder.reading().by_number { "by number" } else { "in name order" }
            ));
        }
        let mut rest = shared.into_iter();
        sets.iter().map(|(_, rows)| rest.by_ref().take(rows.len()).collect()).collect()
    } else if let [(_, first), (file, second)] = &sets[..]
        && shared.len() == first.len()
    {
        let n = second.len();
        listing.warnings.push(format!("`{file}` describes {n} views without photographs; they are left out"));
        vec![shared]
    } else {
        let text = format!("its {total} rows do not fit the {} photographs in `images/`", shared.len());
        let (there, hint) = match shared.is_empty() {
            true => missing::no_folder(folder, "images"),
            false => Default::default(),
        };
        let problem = problem(sets[0].0, text + &there);
        return Err(match hint {
            Some(hint) => problem.with_hint(hint),
            None => problem,
        });
    };

    for ((file, rows), names) in sets.into_iter().zip(photos) {
        if names.len() != rows.len() {
            return Err(problem(file, format!("it has {} rows for {} photographs", rows.len(), names.len())));
        }
        for (row, name) in rows.iter().zip(names) {
            let photo = folder.photo(file, &name)?;
            let PoseRow { rotation, position, size, focal } = *row;
            let intrinsics =
                Intrinsics { size: Some(size), focal: [Some(focal); 2], ..Intrinsics::default() };
            let frame = CameraFrame::new(file, &name, photo, intrinsics, (rotation, position));
            listing.frames.push(CameraFrame { split: split_of(file), ..frame });
        }
    }
    Ok(())
}

/// Returns the photographs in `images` + `suffix`, or in that folder of pictures already reduced,
/// in the order that is read; `None` without such a folder.
fn photographs(folder: &CaptureFolder, suffix: &str, listing: &mut Listing) -> Result<Option<Vec<String>>> {
    let downscale = folder.options.downscale;
    let mut names = vec![format!("images{suffix}")];
    if downscale > 1 {
        names.extend([format!("images{suffix}_{downscale}"), format!("images{suffix}_{downscale}x")]);
    }
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let Some(plain) = folder.pictures(&names, if suffix.is_empty() { &IMAGE_FOLDERS } else { &[] })? else {
        return Ok(None);
    };
    listing.order_is_open |= order::is_open(&plain);
    Ok(Some(if folder.reading().by_number { order::by_number(&plain) } else { plain }))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(name: &str, x: f64) -> CameraFrame {
        CameraFrame {
            file: "transforms.json".into(),
            name: name.into(),
            photo: None,
            relative: Default::default(),
            split: None,
            intrinsics: Intrinsics { size: Some((4, 2)), focal: [Some(3.0); 2], ..Intrinsics::default() },
            rotation: DMat3::from_rotation_y(x),
            position: DVec3::new(x, 0.0, 0.0),
            mask: None,
            region: None,
        }
    }

    /// Returns the row of a frame, with columns down, right, backwards.
    fn llff(f: &CameraFrame) -> [f64; 17] {
        let r = f.rotation;
        let mut v = [0.0; 17];
        let hwf = [2.0, 4.0, 3.0];
        for k in 0..3 {
            let line = [-r.y_axis[k], r.x_axis[k], r.z_axis[k], f.position[k], hwf[k]];
            v[5 * k..5 * k + 5].copy_from_slice(&line);
        }
        v
    }

    #[test]
    fn rows_agree_with_their_frames_in_either_order() {
        let frames = [frame("b", 0.1), frame("a", 0.7)];
        let rows: Vec<PoseRow> = frames.iter().map(|f| row(&llff(f)).unwrap()).collect();
        let refs: Vec<&CameraFrame> = frames.iter().collect();
        let a = compare("p.npy", &rows, &refs).unwrap();
        assert!(a.position < 1e-12 && a.rotation < 1e-12 && a.focal < 1e-12, "{a:?}");
        let turned: Vec<PoseRow> = rows.iter().rev().copied().collect(); // name order
        assert!(compare("p.npy", &turned, &refs).is_ok());
        assert!(compare("p.npy", &rows[..1], &refs).unwrap_err().to_string().contains("1 rows"));
    }

    #[test]
    fn a_camera_that_moved_is_named_with_its_distance() {
        let mut frames = [frame("a", 0.1), frame("b", 0.7)];
        let rows: Vec<PoseRow> = frames.iter().map(|f| row(&llff(f)).unwrap()).collect();
        frames[1].position.y += 0.25;
        let refs: Vec<&CameraFrame> = frames.iter().collect();
        let error = compare("p.npy", &rows, &refs).unwrap_err().to_string();
        assert!(error.contains("frame `b`") && error.contains("0.250000 units"), "{error}");
    }
}
