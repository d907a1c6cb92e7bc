//! LLFF poses, `poses_bounds*.npy`: alone, or to check the JSON beside them.
//!
//! A row is a 3×5 matrix in row-major order, columns down, right, backwards, position and
//! (height, width, focal), then near and far, which are not needed. OpenGL axes are
//! (column 1, −column 0, column 2). The published loader divides positions by 0.3; here the world stays
//! as the dataset has it.

use super::listing::{Frame, Lens, Listing};
use super::names::Place;
use super::pose;
use super::{CaptureError, CaptureOptions, Split};
use crate::io::{self, NpyValues};
use glam::{DMat3, DVec3};
use serde::Serialize;

/// Relative to the spread of the cameras.
const POSITION_TOLERANCE: f64 = 1e-3;
/// Radians; 0.1°.
const ROTATION_TOLERANCE: f64 = 1.75e-3;
/// Relative.
const FOCAL_TOLERANCE: f64 = 1e-3;

/// How well two camera files agree.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Agreement {
    /// The LLFF file.
    pub poses: String,
    /// How many cameras were compared.
    pub cameras: usize,
    /// Largest difference of positions, dataset units.
    pub position: f64,
    /// Largest angle between rotations, radians.
    pub rotation: f64,
    /// Largest relative difference of focal lengths.
    pub focal: f64,
}

#[derive(Clone, Copy, Debug)]
struct Row {
    rotation: DMat3,
    position: DVec3,
    size: (u32, u32),
    focal: f64,
}

fn read(place: &Place, file: &str, options: &CaptureOptions) -> Result<Vec<Row>, CaptureError> {
    let structure = |problem: String| CaptureError::Structure {
        file: file.into(),
        problem,
        hint: "an LLFF file has one row of 17 numbers per photograph".into(),
    };
    let Some(path) = place.file(file, file.as_ref())? else {
        return Err(CaptureError::Outside { file: file.into(), name: file.into() });
    };
    let npy = io::read_npy(&path, &options.limits)?;
    let (NpyValues::Number(values), [rows, 17]) = (&npy.values, &npy.shape[..]) else {
        return Err(structure(format!("its shape is {:?}, not (photographs, 17)", npy.shape)));
    };
    if *rows == 0 || *rows > options.limits.views {
        return Err(structure(format!("it has {rows} rows")));
    }
    values.as_chunks::<17>().0.iter().enumerate().map(|(i, v)| row(file, i, v)).collect()
}

fn row(file: &str, index: usize, v: &[f64; 17]) -> Result<Row, CaptureError> {
    let problem = |problem: String| CaptureError::Frame {
        file: file.into(),
        frame: format!("row {index}"),
        problem,
        hint: "correct that row; columns are down, right, backwards, position, (height, width, focal)".into(),
    };
    let column = |k: usize| [v[k], v[k + 5], v[k + 10]];
    let (down, right, back, position) = (column(0), column(1), column(2), column(3));
    let rows = [0, 1, 2].map(|r| [right[r], -down[r], back[r], position[r]]);
    let (rotation, position) = pose::pose(&rows).map_err(problem)?;
    let [h, w, focal] = column(4);
    let whole = |x: f64| x.is_finite() && x.fract() == 0.0 && (1.0..=1e6).contains(&x);
    if !(whole(h) && whole(w) && focal.is_finite() && focal > 0.0) {
        return Err(problem(format!(
            "height {h}, width {w} and focal length {focal} are not those of a picture"
        )));
    }
    Ok(Row { rotation, position, size: (w as u32, h as u32), focal })
}

fn split_of(file: &str) -> Option<Split> {
    match file {
        "poses_bounds_train.npy" => Some(Split::Train),
        "poses_bounds_test.npy" => Some(Split::Test),
        _ => None,
    }
}

/// Compares each LLFF file with the frames of its split. Rows carry no names, so they are paired with the
/// frames in the JSON's order or in name order, whichever fits better.
pub(super) fn check(
    place: &Place,
    files: &[&str],
    options: &CaptureOptions,
    listing: &mut Listing,
) -> Vec<Agreement> {
    let mut agreements = Vec::new();
    for &file in files {
        let split = split_of(file);
        let frames: Vec<&Frame> =
            listing.frames.iter().filter(|f| split.is_none() || f.split == split).collect();
        match read(place, file, options).and_then(|rows| compare(file, &rows, &frames)) {
            Ok(a) => {
                listing.reasons.push(format!(
                    "`{file}` agrees with the JSON about {} cameras within {:.1e} units, {:.1e}°, {:.1e} of the \
                     focal length",
                    a.cameras,
                    a.position,
                    a.rotation.to_degrees(),
                    a.focal
                ));
                agreements.push(a);
            }
            Err(problem) => listing.problems.push(problem),
        }
    }
    agreements
}

fn compare(file: &str, rows: &[Row], frames: &[&Frame]) -> Result<Agreement, CaptureError> {
    let json = frames.first().map_or("the JSON".to_string(), |f| f.file.clone());
    if rows.len() != frames.len() || frames.is_empty() {
        return Err(CaptureError::Structure {
            file: file.into(),
            problem: format!("it has {} rows, but `{json}` has {} frames for it", rows.len(), frames.len()),
            hint: format!("remove the file that is wrong; without `{file}` the JSON is used alone"),
        });
    }
    let mean = frames.iter().map(|f| f.position).sum::<DVec3>() / frames.len() as f64;
    let spread = frames.iter().map(|f| f.position.distance(mean)).fold(0.0, f64::max).max(1e-12);
    let mut by_name = frames.to_vec();
    by_name.sort_by(|a, b| a.name.cmp(&b.name));
    let worst = |order: &[&Frame]| -> Vec<[f64; 3]> {
        rows.iter().zip(order).map(|(row, frame)| difference(row, frame)).collect()
    };
    // how far over its tolerance the worst of the three is
    let excess = |d: &[f64; 3]| {
        (d[0] / (POSITION_TOLERANCE * spread)).max(d[1] / ROTATION_TOLERANCE).max(d[2] / FOCAL_TOLERANCE)
    };
    let total = |ds: &[[f64; 3]]| ds.iter().map(excess).fold(0.0, f64::max);
    let (a, b) = (worst(frames), worst(&by_name));
    let (differences, order) = if total(&b) < total(&a) { (b, &by_name[..]) } else { (a, frames) };
    let most = (0..rows.len()).max_by(|&i, &j| excess(&differences[i]).total_cmp(&excess(&differences[j])));
    if let Some(i) = most
        && excess(&differences[i]) > 1.0
    {
        let [position, rotation, focal] = differences[i];
        return Err(CaptureError::PosesDisagree {
            poses: file.into(),
            json,
            frame: order[i].name.clone(),
            problem: if focal.is_infinite() {
                format!("row {i} is for {} × {} pixels", rows[i].size.0, rows[i].size.1)
            } else {
                format!(
                    "row {i} is {position:.6} units and {:.4}° away, its focal length differs by {:.4} %",
                    rotation.to_degrees(),
                    100.0 * focal
                )
            },
        });
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
fn difference(row: &Row, frame: &Frame) -> [f64; 3] {
    let turn = row.rotation.transpose() * frame.rotation;
    // ‖R − I‖ = 2√2 sin(θ/2) stays exact for small angles, where acos of the trace does not
    let e = turn - DMat3::IDENTITY;
    let norm = e.to_cols_array().iter().map(|v| v * v).sum::<f64>().sqrt();
    let angle = 2.0 * (norm / 8f64.sqrt()).min(1.0).asin();
    let focal = match frame.lens.camera(frame.lens.size.unwrap_or(row.size), frame.rotation, frame.position) {
        Ok(camera) if (camera.width, camera.height) == row.size => (camera.fx / row.focal - 1.0).abs(),
        _ => f64::INFINITY,
    };
    [row.position.distance(frame.position), angle, focal]
}

/// Lists the frames of LLFF files alone, pairing rows with photographs in name order.
pub(super) fn list(place: &Place, files: &[&str], options: &CaptureOptions, listing: &mut Listing) {
    if let Err(problem) = list_all(place, files, options, listing) {
        listing.problems.push(problem);
    }
}

fn list_all(
    place: &Place,
    files: &[&str],
    options: &CaptureOptions,
    listing: &mut Listing,
) -> Result<(), CaptureError> {
    let mut sets = Vec::new();
    for &file in files {
        sets.push((file, split_of(file), read(place, file, options)?));
    }
    let d = options.downscale;
    let folder = |suffix: &str| {
        let mut names = vec![format!("images{suffix}")];
        if d > 1 {
            names.extend([format!("images{suffix}_{d}"), format!("images{suffix}_{d}x")]);
        }
        names.into_iter().find(|n| io::is_folder(&place.root().join(n)))
    };
    let photos = |folder: &str| -> Result<Vec<String>, CaptureError> {
        let mut names = io::list_files(&place.root().join(folder))?;
        names.retain(|n| {
            let ending = n.rsplit_once('.').map_or("", |(_, e)| e).to_ascii_lowercase();
            matches!(ending.as_str(), "png" | "jpg" | "jpeg")
        });
        Ok(names.into_iter().map(|n| format!("{folder}/{n}")).collect())
    };
    let structure = |file: &str, problem: String| CaptureError::Structure {
        file: file.into(),
        problem,
        hint: "put one photograph per row into `images/` (or `images_train/`, `images_test/`), in name order"
            .into(),
    };

    // folders per split first; else one folder whose count says which files it belongs to
    let mut pairs: Vec<(usize, Vec<String>)> = Vec::new();
    let shared = match folder("") {
        Some(f) => photos(&f)?,
        None => Vec::new(),
    };
    let total: usize = sets.iter().map(|(_, _, rows)| rows.len()).sum();
    let own = [Some(Split::Train), Some(Split::Test)].map(|s| match s {
        Some(Split::Train) => folder("_train"),
        _ => folder("_test"),
    });
    if sets.len() > 1 && own.iter().all(Option::is_some) {
        for (i, f) in own.iter().flatten().enumerate() {
            pairs.push((i, photos(f)?));
        }
    } else if shared.len() == total {
        let mut rest = shared.into_iter();
        for (i, (_, _, rows)) in sets.iter().enumerate() {
            pairs.push((i, rest.by_ref().take(rows.len()).collect()));
        }
        if sets.len() > 1 {
            listing.warnings.push(format!(
                "the rows of {} carry no names: the first {} photographs in name order are taken for training, \
                 the others for testing",
                files.join(" and "),
                sets[0].2.len()
            ));
        }
    } else if sets.len() > 1 && shared.len() == sets[0].2.len() {
        listing.warnings.push(format!(
            "`{}` describes {} views without photographs; they are left out",
            sets[1].0,
            sets[1].2.len()
        ));
        pairs.push((0, shared));
    } else {
        let problem = format!("its {total} rows do not fit the {} photographs in `images/`", shared.len());
        return Err(structure(sets[0].0, problem));
    }

    for (i, names) in pairs {
        let (file, split, rows) = &sets[i];
        if names.len() != rows.len() {
            return Err(structure(
                file,
                format!("it has {} rows for {} photographs", rows.len(), names.len()),
            ));
        }
        for (row, name) in rows.iter().zip(names) {
            let (relative, photo) = place.photo(file, &name, 1)?;
            listing.frames.push(Frame {
                file: file.to_string(),
                name,
                photo,
                relative,
                split: *split,
                lens: Lens { size: Some(row.size), focal: [Some(row.focal); 2], ..Lens::default() },
                rotation: row.rotation,
                position: row.position,
                mask: None,
                region: None,
            });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(name: &str, x: f64) -> Frame {
        Frame {
            file: "transforms.json".into(),
            name: name.into(),
            photo: None,
            relative: Default::default(),
            split: None,
            lens: Lens { size: Some((4, 2)), focal: [Some(3.0); 2], ..Lens::default() },
            rotation: DMat3::from_rotation_y(x),
            position: DVec3::new(x, 0.0, 0.0),
            mask: None,
            region: None,
        }
    }

    /// The row of a frame, with columns down, right, backwards.
    fn llff(f: &Frame) -> [f64; 17] {
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
        let rows: Vec<Row> = frames.iter().map(|f| row("p.npy", 0, &llff(f)).unwrap()).collect();
        let refs: Vec<&Frame> = frames.iter().collect();
        let a = compare("p.npy", &rows, &refs).unwrap();
        assert!(a.position < 1e-12 && a.rotation < 1e-12 && a.focal < 1e-12, "{a:?}");
        let turned: Vec<Row> = rows.iter().rev().copied().collect(); // name order
        assert!(compare("p.npy", &turned, &refs).is_ok());
        assert!(compare("p.npy", &rows[..1], &refs).unwrap_err().to_string().contains("1 rows"));
    }

    #[test]
    fn a_camera_that_moved_is_named_with_its_distance() {
        let mut frames = [frame("a", 0.1), frame("b", 0.7)];
        let rows: Vec<Row> = frames.iter().map(|f| row("p.npy", 0, &llff(f)).unwrap()).collect();
        frames[1].position.y += 0.25;
        let refs: Vec<&Frame> = frames.iter().collect();
        let error = compare("p.npy", &rows, &refs).unwrap_err().to_string();
        assert!(error.contains("frame `b`") && error.contains("0.250000 units"), "{error}");
    }
}
