//! A sensor: its lens, and where it is in a rig.

use super::super::folder::shortened;
use super::super::frame::{self, Intrinsics};
use super::{Pose, child, is_off, numbers};
use glam::{DMat3, DVec3};
use roxmltree::Node;
use tiface_base::geom::{Distortion, Projection};

/// Skew moves no pixel farther.
const SKEW_PX: f64 = 0.1;

/// Elements of a calibration that are read, and others that are no coefficients.
const KNOWN: &str = "resolution f cx cy b1 b2 k1 k2 k3 k4 p1 p2 covariance date";

const PLAIN: Pose = (DMat3::IDENTITY, DVec3::ZERO);

pub(super) struct Sensor {
    pub intrinsics: Result<Intrinsics, String>,
    /// Whether Metashape gave each row of a photograph a pose of its own.
    pub has_rolling_shutter: bool,
    id: String,
    master: Option<String>,
    /// From this sensor to its master, if the file says so.
    offset: Result<Option<Pose>, String>,
}

impl Sensor {
    pub fn from_node(sensor: Node) -> Sensor {
        let id = sensor.attribute("id").unwrap_or_default();
        Sensor {
            intrinsics: intrinsics(sensor),
            has_rolling_shutter: has_rolling_shutter(sensor),
            id: id.into(),
            master: sensor.attribute("master_id").filter(|master| *master != id).map(str::to_owned),
            offset: offset(sensor),
        }
    }

    /// Returns the transform from a slave's sensor to that of its master, if the file says it.
    ///
    /// The master of a camera may be another one than the sensor in which the rig was calibrated.
    pub fn master_from_slave(master: &Sensor, slave: &Sensor) -> Result<Option<Pose>, String> {
        let root = |sensor: &Sensor| sensor.master.as_ref().unwrap_or(&sensor.id).clone();
        let given = slave.offset.clone()?;
        let is_one_rig = root(master) == root(slave) || slave.master.is_none() && given.is_some();
        if !is_one_rig || master.id == slave.id {
            return Ok(None);
        }
        let is_root = slave.master.is_none() && given.is_none();
        let slave = if is_root { Some(PLAIN) } else { given };
        let master = if master.master.is_none() { Some(PLAIN) } else { master.offset.clone()? };
        let between = |((a, from), (b, to)): (Pose, Pose)| (a.transpose() * b, a.transpose() * (to - from));
        Ok(master.zip(slave).map(between))
    }
}

/// Returns rotation and location of a sensor of a rig. What is fixed at its default is an empty
/// element.
fn offset(sensor: Node) -> Result<Option<Pose>, String> {
    let part = |name: &str, count: usize| -> Result<Option<Vec<f64>>, String> {
        let values = numbers(child(sensor, name));
        let values = values.map_err(|text| format!("the `{name}` of its sensor: {text}"))?;
        match values.len() {
            0 => Ok(None),
            n if n == count && values.iter().all(|v| v.is_finite()) => Ok(Some(values)),
            _ => Err(format!("the `{name}` of its sensor is not {count} finite numbers")),
        }
    };
    let (rotation, location) = (part("rotation", 9)?, part("location", 3)?);
    if rotation.is_none() && location.is_none() {
        return Ok(None);
    }
    // rows in the file, columns here
    let rotation = rotation.map(|v| frame::orthonormal(DMat3::from_cols_slice(&v).transpose()));
    let rotation = rotation.transpose().map_err(|text| format!("the `rotation` of its sensor: {text}"))?;
    let location = location.map(|v| DVec3::from_slice(&v));
    Ok(Some((rotation.unwrap_or(DMat3::IDENTITY), location.unwrap_or(DVec3::ZERO))))
}

/// Returns whether a sensor or camera says that rolling shutter was compensated.
pub(super) fn has_rolling_shutter(node: Node) -> bool {
    let names =
        |n: &Node| n.has_tag_name("rolling_shutter") || n.attribute("name") == Some("rolling_shutter");
    let value = |n: Node| n.attribute("value").or(n.text()).unwrap_or_default().trim().to_lowercase();
    let is_on = |n: Node| !is_off(n) && !["", "0", "false", "disabled", "none"].contains(&value(n).as_str());
    node.children().filter(names).any(is_on)
}

fn intrinsics(sensor: Node) -> Result<Intrinsics, String> {
    let mut calibrations = sensor.children().filter(|c| c.has_tag_name("calibration"));
    let first = calibrations.clone().next();
    let adjusted = calibrations.find(|c| c.attribute("class") == Some("adjusted")).or(first);
    let kind = adjusted.and_then(|c| c.attribute("type")).or(sensor.attribute("type")).unwrap_or("frame");
    let projection = match kind {
        "frame" => Projection::Perspective,
        "fisheye" => Projection::Fisheye,
        other => return Err(format!("its type `{other}` is not supported (frame and fisheye are)")),
    };
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
        return Err(no_focal_length(calibration, f));
    }
    let k4 = value("k4")?;
    if projection == Projection::Perspective && k4 != 0.0 {
        return Err("it has `k4`, which is not supported: optimize the cameras without it".into());
    }
    if let Some(name) = unknown_coefficient(calibration) {
        return Err(format!("it has `{name}`, which is not supported: optimize the cameras without it"));
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

fn no_focal_length(calibration: Node, f: f64) -> String {
    if child(calibration, "f").is_some() {
        format!("its focal length `f` is {f}, it must be positive")
    } else if child(calibration, "fx").is_some() {
        "its focal length is `fx`, as PhotoScan before 1.3 wrote it: open the project in Metashape".into()
    } else {
        "it has no focal length `f`".into()
    }
}

/// Returns the name of a coefficient that is not zero and not read, such as `p3`.
fn unknown_coefficient(calibration: Node) -> Option<String> {
    let is_given = |n: &Node| numbers(Some(*n)).is_ok_and(|v| matches!(v[..], [v] if v != 0.0));
    let elements = calibration.children().filter(Node::is_element);
    let mut others = elements.filter(|n| !KNOWN.split(' ').any(|known| n.has_tag_name(known)));
    others.find(is_given).map(|n| n.tag_name().name().to_string())
}
