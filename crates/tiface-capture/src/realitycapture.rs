//! RealityCapture (RealityScan): a CSV file of all cameras, or one XMP file beside each photograph.
//!
//! Focal lengths are those of a picture 36 wide, principal points offsets from the middle; both are
//! measured by the picture's longer side. CSV (`Internal/External camera parameters`): heading,
//! pitch and roll in degrees, Z up; XMP: the rotation of an OpenCV camera by rows, and its
//! position. Brown's model with k1, k2, k3 and, in that order, t1 and t2 as OpenCV's p1 and p2; k4
//! and the division model are refused. (Capturing Reality, "XMP camera math"; nerfstudio,
//! `realitycapture_utils.py`.)

use super::folder::{
    CaptureFolder, FLIP, FolderEntries, PHOTOGRAPHS, has_ending, in_file, in_frame, join, parse_xml,
    shortened,
};
use super::frame::{self, CameraFrame, Intrinsics, Listing};
use super::table::{self, Heading};
use glam::{DMat3, DVec3};
use roxmltree::Node;
use std::path::{Path, PathBuf};
use tiface_base::geom::Distortion;
use tiface_base::io;
use tiface_base::{Error, Result};

/// How a CSV file begins.
pub(super) const HEADER: &str = "#name,x,y,alt";
/// Its first columns.
const COLUMNS: [&str; 4] = ["name", "x", "y", "alt"];
const EXPORT: &str = "export the registration again, `Internal/External camera parameters`";
const POINTS: &str =
    "export it with a decimal point, or with `;` between the columns; names with commas need quotes";
/// Content of an XMP file.
pub(super) const NAMESPACE: &str = "capturingreality.com/ns/xcr";

/// Of 35 mm film.
const FRAME_WIDTH: f64 = 36.0;

/// A camera as both kinds of file say it.
struct Entry {
    name: String,
    rotation: DMat3,
    position: DVec3,
    /// For a picture 36 wide.
    focal: f64,
    /// Of the longer side.
    center: [f64; 2],
    /// k1, k2, k3, k4, t1, t2.
    coefficients: [f64; 6],
}

/// Returns whether a text begins as a table of RealityCapture's cameras does.
pub(super) fn is_table(text: &str) -> bool {
    Heading::find(text, &COLUMNS).is_some()
}

/// Lists the cameras of a CSV file.
pub(super) fn list_csv(folder: &CaptureFolder, file: &str, listing: &mut Listing) -> Result<()> {
    let bytes = io::read_bytes(&folder.root.join(file), &folder.options.limits)?;
    let text = table::decoded(&bytes);
    let no_heading = || in_file(file, format_args!("it does not begin with `{HEADER}`"), EXPORT);
    let heading = Heading::find(&text, &COLUMNS).ok_or_else(no_heading)?;
    let (mut entries, mut commas, mut points) = (Vec::new(), false, false);
    for (line, row) in heading.rows(&text) {
        let wrong = |(text, hint): (String, &str)| in_file(file, format_args!("line {line}: {text}"), hint);
        let values = heading.values(row).map_err(|text| wrong((text, POINTS)))?;
        for value in values.iter().skip(1).filter(|v| table::number(v).is_some()) {
            (commas, points) = (commas || value.contains(','), points || value.contains('.'));
        }
        entries.push(entry(&heading, &values).map_err(|text| wrong((text, EXPORT)))?);
        folder.options.limits.check_views(Path::new(file), entries.len())?;
    }
    if entries.is_empty() {
        return Err(in_file(file, "it lists no photographs", EXPORT));
    } else if commas && points {
        return Err(in_file(file, "some of its numbers have a comma, others a point", POINTS));
    }
    listing.reasons.extend(spelling(file, &bytes, &heading, commas));
    let base = folder.image_folder(entries.iter().map(|e| e.name.as_str()));
    for entry in entries {
        let name = join(base, &entry.name);
        frame(folder, file, &name, entry, listing);
    }
    listing.up = Some(DVec3::Z);
    Ok(())
}

/// Returns in what a table differs from those that RealityCapture writes with its own settings.
fn spelling(file: &str, bytes: &[u8], heading: &Heading, commas: bool) -> Option<String> {
    let separated = match heading.separator {
        ',' => None,
        '\t' => Some("columns separated by tabs"),
        ' ' => Some("columns separated by blanks"),
        _ => Some("columns separated by `;`"),
    };
    let encoded = table::utf16(bytes).map(|_| "text in UTF-16");
    let all: Vec<&str> =
        [encoded, separated, commas.then_some("decimal commas")].into_iter().flatten().collect();
    (!all.is_empty()).then(|| format!("`{file}` is read with {}", all.join(", ")))
}

/// Returns the camera of a row.
fn entry(heading: &Heading, values: &[String]) -> Result<Entry, String> {
    let value = |name: &str, needed: bool| match heading.value(values, name) {
        None | Some("") if !needed => Ok(0.0),
        Some(text) => table::number(text).ok_or_else(|| format!("`{name}` is `{}`", shortened(text))),
        None => Err(format!("it has no `{name}`")),
    };
    let angle = |name| value(name, true).map(f64::to_radians);
    let (heading_angle, pitch, roll) = (angle("heading")?, angle("pitch")?, angle("roll")?);
    let mut coefficients = [0.0; 6];
    for (coefficient, name) in coefficients.iter_mut().zip(["k1", "k2", "k3", "k4", "t1", "t2"]) {
        *coefficient = value(name, false)?;
    }
    let turned = DMat3::from_rotation_z(-heading_angle) * DMat3::from_rotation_x(pitch);
    Ok(Entry {
        name: heading.value(values, "name").unwrap_or_default().into(),
        rotation: turned * DMat3::from_rotation_y(roll),
        position: DVec3::new(value("x", true)?, value("y", true)?, value("alt", true)?),
        focal: value("f", true)?,
        center: [value("px", false)?, value("py", false)?],
        coefficients,
    })
}

/// Returns the folder below the capture whose photographs have XMP files of RealityCapture beside
/// them.
pub(super) fn xmp_folder(root: &Path) -> Option<PathBuf> {
    let inside = FolderEntries::list(root).photographs().into_iter();
    let mut folders = [root.to_path_buf()].into_iter().chain(inside);
    let found = folders.find(|f| FolderEntries::list(f).holding("xmp", NAMESPACE).is_some())?;
    found.strip_prefix(root).ok().map(Path::to_path_buf)
}

/// Lists the cameras of XMP files, each beside its photograph.
pub(super) fn list_xmp(folder: &CaptureFolder, inside: &Path, listing: &mut Listing) -> Result<()> {
    let entries = FolderEntries::list(&folder.root.join(inside));
    let mut without = 0;
    for photo in entries.files.iter().filter(|f| has_ending(f, &PHOTOGRAPHS)) {
        let stem = Path::new(photo).with_extension("").to_string_lossy().into_owned();
        let Some(xmp) = entries.files.iter().find(|f| has_ending(f, &["xmp"]) && f[..f.len() - 4] == stem)
        else {
            without += 1;
            continue;
        };
        let shown = |name: &str| inside.join(name).to_string_lossy().into_owned();
        let (file, name) = (shown(xmp), shown(photo));
        match read_xmp(folder, &file, &name) {
            Ok(Some(entry)) => frame(folder, &file, &name, entry, listing),
            Ok(None) => without += 1,
            Err(problem) => listing.problems.push(problem),
        }
    }
    if without > 0 {
        listing
            .warnings
            .push(format!("{without} photographs have no camera in an XMP file; they are left out"));
    }
    Ok(())
}

/// Returns the camera in an XMP file; `None` where it has no pose.
fn read_xmp(folder: &CaptureFolder, file: &str, name: &str) -> Result<Option<Entry>> {
    let Some(path) = folder.file(Path::new(file)) else { return Ok(None) };
    let bytes = io::read_bytes(&path, &folder.options.limits)?;
    let text = String::from_utf8_lossy(&bytes);
    let document = parse_xml(&path, "XMP", &text, 10_000)?;
    let nodes: Vec<Node> = document.descendants().filter(Node::is_element).collect();
    let value = |name: &str| {
        let attribute = |n: &Node| n.attributes().find(|a| a.name() == name).map(|a| a.value().to_string());
        let element =
            |n: &Node| (n.tag_name().name() == name).then(|| n.text().unwrap_or_default().to_string());
        nodes.iter().find_map(|n| attribute(n).or_else(|| element(n)))
    };
    let wrong = |text: String| in_frame(file, name, text);
    let numbers = |name: &str, count: usize| -> Result<Option<Vec<f64>>> {
        let Some(text) = value(name) else { return Ok(None) };
        let numbers: Option<Vec<f64>> = text
            .split_whitespace()
            .take(10)
            .map(|w| w.parse().ok().filter(|v: &f64| v.is_finite()))
            .collect();
        match numbers {
            Some(n) if n.len() == count => Ok(Some(n)),
            _ => Err(wrong(format!("`{name}` is not {count} finite numbers"))),
        }
    };
    let (Some(r), Some(p)) = (numbers("Rotation", 9)?, numbers("Position", 3)?) else { return Ok(None) };
    let one = |name: &str, absent: f64| Ok::<_, Error>(numbers(name, 1)?.map_or(absent, |v| v[0]));
    let model = value("DistortionModel").unwrap_or_else(|| "perspective".into());
    let coefficients = numbers("DistortionCoeficients", 6)?.unwrap_or_else(|| vec![0.0; 6]);
    let coefficients: [f64; 6] = coefficients.try_into().unwrap_or_default();
    if !(model == "perspective" || model.starts_with("brown")) && coefficients.iter().any(|&c| c != 0.0) {
        return Err(wrong(format!(
            "its distortion model `{}` is not supported; align with Brown3 (Alignment settings, Distortion model)",
            shortened(&model)
        )));
    }
    let (skew, aspect) = (one("Skew", 0.0)?, one("AspectRatio", 1.0)?);
    if skew.abs() > 1e-4 || (aspect - 1.0).abs() > 1e-4 {
        return Err(wrong(format!(
            "its pixels are skewed by {skew} or not square ({aspect}); that is not supported"
        )));
    }
    let camera_from_world = DMat3::from_cols_slice(&r).transpose(); // rows in the file
    let rotation = frame::orthonormal(camera_from_world).map_err(wrong)?.transpose() * FLIP;
    let focal = numbers("FocalLength35mm", 1)?.ok_or_else(|| wrong("it has no `FocalLength35mm`".into()))?[0];
    Ok(Some(Entry {
        name: name.into(),
        rotation,
        position: DVec3::from_slice(&p),
        focal,
        center: [one("PrincipalPointU", 0.0)?, one("PrincipalPointV", 0.0)?],
        coefficients,
    }))
}

/// Lists one camera; its numbers mean pixels only together with the photograph's size.
fn frame(folder: &CaptureFolder, file: &str, name: &str, entry: Entry, listing: &mut Listing) {
    let framed = || -> Result<CameraFrame> {
        let photo = folder.photo(file, name)?;
        let size = match &photo.1 {
            Some(path) => {
                let info = io::picture_info(path, &folder.options.limits)?;
                (info.width, info.height)
            }
            None => (1, 1), // it will be counted as missing
        };
        let Entry { name, rotation, position, focal, center, coefficients } = entry;
        let [k1, k2, k3, k4, p1, p2] = coefficients;
        if k4 != 0.0 {
            let problem = "its lens has `k4`, which is not supported; align with Brown3 (Alignment settings)";
            return Err(in_frame(file, &name, problem));
        }
        let longer = size.0.max(size.1) as f64;
        let middle = [0.5 * size.0 as f64, 0.5 * size.1 as f64];
        let intrinsics = Intrinsics {
            size: photo.1.is_some().then_some(size),
            focal: [Some(focal * longer / FRAME_WIDTH); 2],
            center: [0, 1].map(|k| Some(middle[k] + center[k] * longer)),
            distortion: Distortion { k1, k2, k3, p1, p2, ..Distortion::default() },
            ..Intrinsics::default()
        };
        let mask = folder.mask_of(file, &name)?;
        Ok(CameraFrame { mask, ..CameraFrame::new(file, &name, photo, intrinsics, (rotation, position)) })
    };
    match framed() {
        Ok(frame) => listing.frames.push(frame),
        Err(problem) => listing.problems.push(problem),
    }
}
