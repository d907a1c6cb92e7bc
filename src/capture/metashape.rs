//! Agisoft Metashape's exported cameras: an XML file with sensors, cameras and how the chunk sits in the world.
//!
//! Camera axes point right, down and ahead; principal points are offsets from the middle of the picture. Metashape's
//! P1 and P2 are OpenCV's p2 and p1, B1 is added to the horizontal focal length, and K4 multiplies r⁸ (Metashape
//! manual, appendix D). Of a perspective lens that coefficient is refused, as is skew that could be seen.

use super::folder::{CaptureFolder, FLIP, in_file, in_frame, join, parse_xml, shortened};
use super::frame::{self, CameraFrame, Intrinsics, Listing};
use super::masks::few;
use crate::Result;
use crate::geom::{Distortion, Projection};
use crate::io::{self, ReadError};
use glam::{DMat3, DVec3};
use roxmltree::Node;
use std::collections::HashMap;
use std::str::FromStr;

/// Elements and attributes of one file; a project of ten thousand photographs has half as many.
const MAX_NODES: u32 = 2_000_000;
/// A longer translation is geocentric: single precision resolves half a metre at that distance.
const GEOCENTRIC: f64 = 1e5;
/// Skew moves no pixel farther.
const SKEW_PX: f64 = 0.1;

/// Lists the cameras that were aligned.
pub(super) fn list(folder: &CaptureFolder, file: &str, listing: &mut Listing) -> Result<()> {
    let path = folder.root.join(file);
    let bytes = io::read_bytes(&path, &folder.options.limits)?;
    let text = String::from_utf8(bytes).map_err(|e| {
        ReadError::damaged(&path, "XML", e.utf8_error().valid_up_to() as u64, "it is not UTF-8")
    })?;
    let document = parse_xml(&path, "XML", &text, MAX_NODES)?;
    let hint = "export the cameras again: File, Export, Export Cameras, as Agisoft XML";
    let chunks: Vec<Node> = document.descendants().filter(|n| n.has_tag_name("chunk")).collect();
    let chunk = chunks.iter().find(|c| child(**c, "cameras").is_some());
    let chunk = *chunk.ok_or_else(|| in_file(file, "it has no `cameras`", hint))?;
    if chunks.len() > 1 {
        listing
            .warnings
            .push(format!("`{file}` has {} chunks; only the first with cameras is read", chunks.len()));
    }
    let mut sensors = HashMap::new();
    for sensor in within(chunk, "sensors", "sensor") {
        sensors.insert(sensor.attribute("id").unwrap_or_default(), sensor_intrinsics(sensor));
    }
    let problem = |text: String| in_file(file, text, hint);
    let mut components = HashMap::new();
    for component in within(chunk, "components", "component") {
        let id = component.attribute("id").unwrap_or_default();
        components.insert(id, Frame::of(component).map_err(problem)?);
    }
    let whole = Frame::of(chunk).map_err(problem)?;
    let cameras: Vec<Node> = within(chunk, "cameras", "camera").collect();
    folder.options.limits.check_views(&path, cameras.len())?;
    let label = |camera: &Node| camera.attribute("label").unwrap_or_default().to_string();
    let (aligned, others): (Vec<Node>, Vec<Node>) = cameras.into_iter().partition(|camera| {
        let off = matches!(camera.attribute("enabled"), Some("0" | "false"));
        !off && child(*camera, "transform").is_some()
    });
    if !others.is_empty() {
        let names = few(others.iter().map(label));
        listing.warnings.push(format!("{} cameras were not aligned, or are disabled: {names}", others.len()));
    }
    let labels: Vec<String> = aligned.iter().map(label).collect();
    let base = folder.image_folder(labels.iter().map(String::as_str));
    let mut far = false;
    for (camera, name) in aligned.iter().zip(&labels) {
        let problem = |text: String| in_frame(file, name, text);
        let sensor = camera.attribute("sensor_id").unwrap_or_default();
        let intrinsics = match sensors.get(sensor) {
            Some(Ok(intrinsics)) => *intrinsics,
            Some(Err(text)) => return Err(problem(format!("sensor {sensor}: {text}"))),
            None => return Err(problem(format!("its sensor `{sensor}` is not in the file"))),
        };
        let values = numbers(child(*camera, "transform"));
        let m: [f64; 16] = values
            .ok()
            .and_then(|v| v.try_into().ok())
            .ok_or_else(|| problem("its `transform` is not 16 numbers".into()))?;
        let rows = [0, 1, 2].map(|r| [m[4 * r], m[4 * r + 1], m[4 * r + 2], m[4 * r + 3]]);
        let (rotation, position) = frame::pose(&rows).map_err(problem)?;
        let component = camera.attribute("component_id").and_then(|id| components.get(id)).copied().flatten();
        let frame = component.or(whole).unwrap_or(Frame::IDENTITY);
        let origin = if frame.translation.length() > GEOCENTRIC { DVec3::ZERO } else { frame.translation };
        far |= origin != frame.translation;
        let position = frame.scale * (frame.rotation * position) + origin;
        let rotation = frame.rotation * rotation * FLIP;
        let photo = folder.photo(file, &join(base, name))?;
        let mask = folder.mask_of(file, name)?;
        let frame = CameraFrame::new(file, name, photo, intrinsics, (rotation, position));
        listing.frames.push(CameraFrame { mask, ..frame });
    }
    if far {
        listing.warnings.push(format!(
            "`{file}` places the cameras on the earth (geocentric coordinates): its translation is left out, size and \
             direction are kept; export in local coordinates to have them as they are"
        ));
    }
    listing.masks_named = "`masks/`, named as Metashape's cameras";
    Ok(())
}

/// From a chunk or component to the world.
#[derive(Clone, Copy)]
struct Frame {
    scale: f64,
    rotation: DMat3,
    translation: DVec3,
}

impl Frame {
    const IDENTITY: Frame = Frame { scale: 1.0, rotation: DMat3::IDENTITY, translation: DVec3::ZERO };

    /// Returns the `transform` of a node; `None` without one.
    fn of(node: Node) -> Result<Option<Frame>, String> {
        let Some(transform) = child(node, "transform") else { return Ok(None) };
        let part = |name: &str, count: usize| match child(transform, name) {
            None => Ok(None),
            part => {
                let values = numbers(part)?;
                let fits = values.len() == count && values.iter().all(|v| v.is_finite());
                if fits {
                    Ok(Some(values))
                } else {
                    Err(format!("`{name}` of its transform is not {count} numbers"))
                }
            }
        };
        let rotation = match part("rotation", 9)? {
            // rows in the file, columns here
            Some(v) => frame::orthonormal(DMat3::from_cols_slice(&v).transpose())?,
            None => DMat3::IDENTITY,
        };
        let translation = part("translation", 3)?.map_or(DVec3::ZERO, |v| DVec3::from_slice(&v));
        let scale = part("scale", 1)?.map_or(1.0, |v| v[0]);
        if !(1e-12..=1e12).contains(&scale) {
            return Err(format!("the scale of its transform is {scale}"));
        }
        Ok(Some(Frame { scale, rotation, translation }))
    }
}

fn child<'a, 'i>(node: Node<'a, 'i>, name: &str) -> Option<Node<'a, 'i>> {
    node.children().find(|c| c.has_tag_name(name))
}

/// Elements `name` inside the element `list` of a chunk, in groups as well.
fn within<'a, 'i: 'a>(
    chunk: Node<'a, 'i>,
    list: &str,
    name: &'static str,
) -> impl Iterator<Item = Node<'a, 'i>> {
    child(chunk, list).into_iter().flat_map(|l| l.descendants()).filter(move |n| n.has_tag_name(name))
}

/// Numbers separated by spaces.
fn numbers(node: Option<Node>) -> Result<Vec<f64>, String> {
    let text = node.and_then(|n| n.text()).unwrap_or_default();
    text.split_whitespace()
        .take(17)
        .map(|w| f64::from_str(w).map_err(|_| format!("`{}` is no number", shortened(w))))
        .collect()
}

fn sensor_intrinsics(sensor: Node) -> Result<Intrinsics, String> {
    let mut calibrations = sensor.children().filter(|c| c.has_tag_name("calibration"));
    let first = calibrations.clone().next();
    let adjusted = calibrations.find(|c| c.attribute("class") == Some("adjusted")).or(first);
    let calibration = adjusted.ok_or("it is not calibrated")?;
    let resolution = child(calibration, "resolution").or(child(sensor, "resolution"));
    let side = |name: &str| -> Result<u32, String> {
        let text = resolution.and_then(|r| r.attribute(name)).ok_or("it has no `resolution`")?;
        let side = text.parse().ok().filter(|s| (1..=1_000_000).contains(s));
        side.ok_or_else(|| format!("its {name} is `{}`", shortened(text)))
    };
    let (width, height) = (side("width")?, side("height")?);
    let value = |name: &str| -> Result<f64, String> {
        match child(calibration, name) {
            None => Ok(0.0),
            node => match numbers(node)?[..] {
                [v] if v.is_finite() => Ok(v),
                _ => Err(format!("its `{name}` is not a finite number")),
            },
        }
    };
    let f = value("f")?;
    if f <= 0.0 {
        return Err(format!("its focal length `f` is {f}, it must be positive"));
    }
    let kind = calibration.attribute("type").or(sensor.attribute("type")).unwrap_or("frame");
    let projection = match kind {
        "frame" => Projection::Perspective,
        "fisheye" => Projection::Fisheye,
        other => return Err(format!("its type `{other}` is not supported (frame and fisheye are)")),
    };
    let k4 = value("k4")?;
    if projection == Projection::Perspective && k4 != 0.0 {
        return Err("it has `k4`, which is not supported: optimize the cameras without it".into());
    }
    let skew = value("b2")? * 0.5 * height as f64 / f;
    if skew.abs() > SKEW_PX {
        return Err(format!("its skew `b2` moves pixels by {skew:.2}: optimize the cameras without it"));
    }
    let distortion = Distortion {
        k1: value("k1")?,
        k2: value("k2")?,
        k3: value("k3")?,
        k4,
        p1: value("p2")?,
        p2: value("p1")?,
        projection,
        ..Distortion::default()
    };
    Ok(Intrinsics {
        size: Some((width, height)),
        focal: [Some(f + value("b1")?), Some(f)],
        center: [Some(0.5 * width as f64 + value("cx")?), Some(0.5 * height as f64 + value("cy")?)],
        distortion,
        ..Intrinsics::default()
    })
}
