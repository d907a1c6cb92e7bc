//! Folders of poses: `pose/NAME.txt` (or `poses/`) has the camera-to-world matrix of an OpenCV
//! camera for each photograph, one more file the intrinsics. NSVF and SRN call it `intrinsics.txt`,
//! beside `rgb/`; ScanNet's exports `intrinsic/intrinsic_color.txt`, beside `color/`.
//!
//! Intrinsics are a matrix, or begin with a line `f cx cy 0` (SRN, `util.parse_intrinsics`), which
//! a line `height width` may follow. Rays go through whole numbers as the centers of pixels (NSVF,
//! `data_utils.get_uv`), so that principal points move by half a pixel; one at exactly half the
//! size is the middle, as Blender's is. NSVF's names begin with 0 for training, 1 for validation
//! (testing, if there is no 2) and 2 for testing.

use super::folder::{
    CaptureFolder, FLIP, FolderEntries, PHOTOGRAPHS, has_ending, in_file, in_frame, shortened,
};
use super::frame::{self, CameraFrame, Intrinsics, Listing};
use super::masks::few;
use super::table;
use super::view::Split;
use glam::{DMat3, DVec3, Vec3};
use std::collections::HashSet;
use std::path::Path;
use tiface_base::geom::{Aabb, meeting_point};
use tiface_base::{Result, io};

/// Where the poses are, in this order.
const POSES: [&str; 2] = ["pose", "poses"];
/// Files of intrinsics, in this order.
const INTRINSICS: [&str; 4] =
    ["intrinsics.txt", "intrinsic.txt", "intrinsic/intrinsic_color.txt", "intrinsic_color.txt"];
/// Folders of photographs, in this order.
const PHOTOS: [&str; 5] = ["rgb", "images", "image", "color", "imgs"];
/// Skew beyond this share of the focal length is no pinhole's.
const SKEW: f64 = 1e-3;

/// The parts of such a capture.
pub(super) struct PoseFolder {
    /// The folder of the poses.
    pub folder: &'static str,
    pub intrinsics: &'static str,
    pub photos: &'static str,
}

impl PoseFolder {
    pub fn find(root: &Path) -> Option<PoseFolder> {
        let intrinsics = INTRINSICS.into_iter().find(|name| io::is_file(&root.join(name)))?;
        let photos = PHOTOS.into_iter().find(|name| io::is_folder(&root.join(name)))?;
        let has_poses = |name: &&str| FolderEntries::list(&root.join(name)).ending(&["txt"]).is_some();
        let folder = POSES.into_iter().find(has_poses)?;
        Some(PoseFolder { folder, intrinsics, photos })
    }

    /// Returns the name of its poses, for messages.
    pub fn poses(&self) -> String {
        format!("{}/*.txt", self.folder)
    }
}

/// Lists one frame for each pose.
pub(super) fn list(folder: &CaptureFolder, files: &PoseFolder, listing: &mut Listing) -> Result<()> {
    let mut poses = FolderEntries::list(&folder.root.join(files.folder)).files;
    poses.retain(|name| has_ending(name, &["txt"]));
    folder.options.limits.check_views(&folder.root.join(files.folder), poses.len())?;
    let stems: Vec<String> = poses.iter().map(|name| stem(name)).collect();
    let photo_of = |stem: &str| folder.photo(files.intrinsics, &format!("{}/{stem}", files.photos));
    let first = stems.iter().find_map(|stem| photo_of(stem).ok()?.1);
    let info = first.and_then(|path| io::picture_info(&path, &folder.options.limits).ok());
    let size = info.map_or((1, 1), |info| (info.width, info.height));
    let lens = read_intrinsics(folder, files.intrinsics, size)?;
    listing.warnings.extend(doubtful_center(files.intrinsics, &lens, size));
    let mut lost = Vec::new();
    for ((name, stem), split) in poses.iter().zip(&stems).zip(splits(&stems)) {
        let file = format!("{}/{name}", files.folder);
        match read_pose(folder, &file) {
            Ok(Some((rotation, position))) => {
                let photo = photo_of(stem)?;
                let shown = photo.0.to_string_lossy().into_owned();
                let pose = (rotation * FLIP, position);
                listing
                    .frames
                    .push(CameraFrame { split, ..CameraFrame::new(&file, &shown, photo, lens, pose) });
            }
            Ok(None) => lost.push(file),
            Err(problem) => listing.problems.push(problem),
        }
    }
    if !lost.is_empty() {
        let text = format!("{} poses are not finite, as where tracking was lost", lost.len());
        listing.warnings.push(format!("{text}; their photographs are left out: {}", few(&lost)));
    }
    let known: HashSet<&str> = stems.iter().map(String::as_str).collect();
    let photos = FolderEntries::list(&folder.root.join(files.photos)).files;
    let photos = photos.iter().filter(|f| has_ending(f, &PHOTOGRAPHS));
    let without: Vec<&String> = photos.filter(|photo| !known.contains(stem(photo).as_str())).collect();
    if !without.is_empty() {
        let text = format!("{} photographs have no pose in `{}/`", without.len(), files.folder);
        listing.warnings.push(format!("{text}; they are left out: {}", few(without)));
    }
    listing.warnings.push(format!(
        "`{}` does not say what it means: it is taken for NSVF's, from the camera to the world, with axes right, \
         down and ahead",
        files.poses()
    ));
    listing.focus = head_box(folder, listing);
    check_axes(files, size, listing)
}

/// Refuses cameras that do not see the point that they aim at, or their box: they are not NSVF's.
fn check_axes(files: &PoseFolder, size: (u32, u32), listing: &mut Listing) -> Result<()> {
    let ray = |frame: &CameraFrame| (frame.position, -frame.rotation.z_axis);
    let rays: Vec<(DVec3, DVec3)> = listing.frames.iter().map(ray).collect();
    let focus = listing.focus.map(|focus| focus.center().as_dvec3());
    let Some(center) = focus.or_else(|| meeting_point(&rays)) else { return Ok(()) };
    let sees = |frame: &&CameraFrame| {
        let at = frame.rotation.transpose() * (center - frame.position);
        let (width, height) = frame.intrinsics.size.unwrap_or(size);
        // with room for a principal point that is off the middle
        let reach = |k: usize, side: u32| {
            frame.intrinsics.focal[k].map_or(f64::INFINITY, |focal| 0.75 * f64::from(side) / focal)
        };
        at.z < 0.0 && at.x.abs() <= reach(0, width) * -at.z && at.y.abs() <= reach(1, height) * -at.z
    };
    let (seen, n) = (listing.frames.iter().filter(sees).count(), listing.frames.len());
    if seen >= n.min(3) {
        return Ok(());
    }
    listing.frames.clear();
    Err(in_file(
        &files.poses(),
        format_args!(
            "the point that the cameras aim at is inside the frame of only {seen} of {n}: they look away from it"
        ),
        "the matrices must take the camera to the world, with axes right, down and ahead (OpenCV): if their axes \
         are right, up and back (OpenGL, Blender), negate their second and third columns; if they take the world \
         to the camera, invert them (`numpy.linalg.inv`)",
    ))
}

fn stem(name: &str) -> String {
    name.rsplit_once('.').map_or(name, |(stem, _)| stem).to_string()
}

/// Returns what photographs are for by the first letters of their names, if all of them say it.
fn splits(stems: &[String]) -> Vec<Option<Split>> {
    let digit = |stem: &String| match stem.as_bytes() {
        [digit @ b'0'..=b'2', b'_', ..] => Some(digit - b'0'),
        _ => None,
    };
    let digits: Vec<Option<u8>> = stems.iter().map(digit).collect();
    let has = |digit: u8| digits.contains(&Some(digit));
    let is_said = !digits.contains(&None) && has(0) && (has(1) || has(2));
    let split = |digit: Option<u8>| match digit? {
        0 => Some(Split::Train),
        1 if has(2) => Some(Split::Val),
        _ => Some(Split::Test),
    };
    digits.iter().map(|digit| split(*digit).filter(|_| is_said)).collect()
}

/// Returns the numbers of a file by its lines.
fn numbers(folder: &CaptureFolder, file: &str) -> Result<Vec<Vec<f64>>> {
    let limits = io::Limits { file_bytes: 1 << 16, ..folder.options.limits.clone() };
    let text = table::decoded(&io::read_bytes(&folder.root.join(file), &limits)?);
    let number = |word: &str| {
        let problem = || format!("`{}` is no number", shortened(word));
        word.parse::<f64>().map_err(|_| in_file(file, problem(), "it must have numbers, separated by blanks"))
    };
    let lines = text.lines().map(|line| line.split_whitespace().map(number).collect::<Result<Vec<f64>>>());
    let lines: Vec<Vec<f64>> = lines.collect::<Result<_>>()?;
    Ok(lines.into_iter().filter(|line| !line.is_empty()).collect())
}

/// Returns rotation and position of an OpenCV camera in the world; `None` where the pose is not
/// finite.
fn read_pose(folder: &CaptureFolder, file: &str) -> Result<Option<(DMat3, DVec3)>> {
    let values = numbers(folder, file)?.concat();
    let wrong = |text: String| in_frame(file, &stem(file), text);
    if ![12, 16].contains(&values.len()) {
        return Err(wrong(format!("it has {} numbers, not the 16 of a matrix", values.len())));
    }
    if values.iter().any(|v| !v.is_finite()) {
        return Ok(None);
    }
    if values[12..].iter().zip([0.0, 0.0, 0.0, 1.0]).any(|(v, expected)| (v - expected).abs() > 1e-6) {
        let text =
            "its last row is not `0 0 0 1`: it must take the camera to the world, and is written by rows";
        return Err(wrong(text.into()));
    }
    let rows = [0, 1, 2].map(|r| [0, 1, 2, 3].map(|c| values[4 * r + c]));
    frame::pose(&rows).map(Some).map_err(wrong)
}

/// Returns the lens of all photographs, of which one has this size.
fn read_intrinsics(folder: &CaptureFolder, file: &str, photo: (u32, u32)) -> Result<Intrinsics> {
    let lines = numbers(folder, file)?;
    let hint =
        "it must have the matrix K, of 3 × 3 or 4 × 4 numbers by rows, or begin with a line `f cx cy 0`";
    let wrong = |text: String| in_file(file, text, hint);
    let lengths: Vec<usize> = lines.iter().map(Vec::len).collect();
    let matrix = match lengths[..] {
        [4, 4, 4, 4] | [4, 4, 4] | [16] => Some(4),
        [3, 3, 3] | [9] => Some(3),
        _ => None,
    };
    let values = lines.concat();
    let [fx, skew, cx, fy, cy] = match matrix {
        Some(row) => [0, 1, 2, row + 1, row + 2].map(|i| values[i]),
        // four others may be fx, fy, cx and cy
        None => match lines.first().map(Vec::as_slice) {
            Some(&[f, cx, cy] | &[f, cx, cy, 0.0]) => [f, 0.0, cx, f, cy],
            _ => return Err(wrong(format!("it has {} numbers in {} lines", values.len(), lines.len()))),
        },
    };
    if ![fx, skew, cx, fy, cy].iter().all(|v| v.is_finite()) || skew.abs() > SKEW * fx.abs() {
        return Err(wrong(format!("its focal lengths are {fx} and {fy}, its skew {skew}")));
    }
    let side = |v: f64| (v.fract() == 0.0 && (1.0..=1e6).contains(&v)).then_some(v as u32);
    let declared = lines.iter().filter(|_| matrix.is_none()).find_map(|line| match line[..] {
        [height, width] => Some((side(width)?, side(height)?)),
        _ => None,
    });
    let size = declared.unwrap_or(photo);
    let center = |c: f64, side: u32| if c == 0.5 * f64::from(side) { c } else { c + 0.5 };
    Ok(Intrinsics {
        size: declared,
        focal: [Some(fx), Some(fy)],
        center: [Some(center(cx, size.0)), Some(center(cy, size.1))],
        ..Intrinsics::default()
    })
}

/// Returns a warning of a principal point that is far from the middle of a photograph: the
/// photographs may be reduced.
fn doubtful_center(file: &str, lens: &Intrinsics, (width, height): (u32, u32)) -> Option<String> {
    let [Some(x), Some(y)] = lens.center else { return None };
    let is_off = |c: f64, side: u32| (c / f64::from(side) - 0.5).abs() > 0.2;
    let is_doubtful = lens.size.is_none() && width > 1 && (is_off(x, width) || is_off(y, height));
    is_doubtful.then(|| {
        format!(
            "the principal point of `{file}` is ({x}, {y}), far from the middle of {width} × {height} pixels: \
             are the photographs of the size that it is of?"
        )
    })
}

/// Returns the box in `bbox.txt`, where NSVF puts what is photographed.
fn head_box(folder: &CaptureFolder, listing: &mut Listing) -> Option<Aabb> {
    let file = "bbox.txt";
    folder.file(Path::new(file))?;
    let values = numbers(folder, file).map(|lines| lines.concat()).unwrap_or_default();
    let corner = |i: usize| {
        Some(Vec3::from([values.get(i)?, values.get(i + 1)?, values.get(i + 2)?].map(|v| *v as f32)))
    };
    let found = corner(0).zip(corner(3)).map(|(min, max)| Aabb { min, max });
    let found = found.filter(|b| b.min.is_finite() && b.max.is_finite() && b.min.cmplt(b.max).all());
    if found.is_none() {
        listing.warnings.push(format!("`{file}` has not the six numbers of a box, and is not used"));
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_tell_what_photographs_are_for_only_where_all_of_them_do() {
        let of = |names: &[&str]| splits(&names.iter().map(|n| n.to_string()).collect::<Vec<_>>());
        let (train, val, test) = (Some(Split::Train), Some(Split::Val), Some(Split::Test));
        assert_eq!(of(&["0_a", "1_b", "2_c"]), [train, val, test]);
        assert_eq!(of(&["0_a", "1_b"]), [train, test]);
        for names in [&["0_a", "0_b"][..], &["0_a", "1_b", "c"], &["1_a", "2_b"], &["000", "001"]] {
            assert!(of(names).iter().all(Option::is_none), "{names:?}");
        }
    }
}
