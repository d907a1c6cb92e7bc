//! Agisoft Metashape's exported cameras: an XML file with sensors, cameras and how the chunk sits
//! in the world.
//!
//! Camera axes point right, down and ahead; principal points are offsets from the middle of the
//! picture. Metashape's P1 and P2 are OpenCV's p2 and p1, B1 is added to the horizontal focal
//! length, and K4 multiplies r⁸ (Metashape manual, appendix D). Of a perspective lens that
//! coefficient is refused, as are P3 and P4, and skew that could be seen.
//!
//! The slaves of a rig have a master instead of a `transform`; their sensors have a rotation and a
//! location in it, in the unit of the chunk:
//! `chunk_from_slave = chunk_from_master · master_from_slave`.

use super::folder::{CaptureFolder, FLIP, in_file, in_frame, join, parse_xml, shortened};
use super::frame::{self, CameraFrame, Listing};
use super::masks::few;
use glam::{DMat3, DVec3};
use roxmltree::{Document, Node};
use sensor::Sensor;
use std::collections::{HashMap, HashSet};
use std::str::FromStr;
use tiface_base::Result;
use tiface_base::error::counted;
use tiface_base::io::{self, ReadError};

mod sensor;

/// Elements and attributes of one file; a project of ten thousand photographs has half as many.
const MAX_NODES: u32 = 2_000_000;
/// A longer translation is geocentric: single precision resolves half a meter at that distance.
const GEOCENTRIC: f64 = 1e5;

const EXPORT: &str = "export the cameras again: File, Export, Export Cameras, as Agisoft XML";

/// A rotation and a position.
type Pose = (DMat3, DVec3);

/// Lists the cameras that were aligned.
pub(super) fn list(folder: &CaptureFolder, file: &str, listing: &mut Listing) -> Result<()> {
    let path = folder.root.join(file);
    let bytes = io::read_bytes(&path, &folder.options.limits)?;
    let text = String::from_utf8(bytes).map_err(|e| {
        ReadError::damaged(&path, "XML", e.utf8_error().valid_up_to() as u64, "it is not UTF-8")
    })?;
    let document = parse_xml(&path, "XML", &text, MAX_NODES)?;
    let chunk = choose_chunk(&document, file, listing)?;
    let problem = |text: String| in_file(file, text, EXPORT);
    let mut components = HashMap::new();
    for component in within(chunk, "components", "component") {
        components.insert(id(component), Frame::from_node(component).map_err(problem)?);
    }
    let whole = Frame::from_node(chunk).map_err(problem)?;
    let cameras: Vec<Node> = within(chunk, "cameras", "camera").collect();
    folder.options.limits.check_views(&path, cameras.len())?;
    let rig = Rig {
        sensors: within(chunk, "sensors", "sensor").map(|s| (id(s), Sensor::from_node(s))).collect(),
        cameras: cameras.iter().map(|camera| (id(*camera), *camera)).collect(),
    };
    let placed = rig.place(file, &cameras, listing)?;
    let placed = of_one_world(placed, chunk, &components, listing);
    let labels = labels(&placed);
    let base = folder.image_folder(labels.iter().map(String::as_str));
    let mut far = false;
    for (Placed { camera, pose, component, .. }, name) in placed.iter().zip(&labels) {
        let problem = |text: String| in_frame(file, name, text);
        let sensor = camera.attribute("sensor_id").unwrap_or_default();
        let intrinsics = match rig.sensors.get(sensor).map(|sensor| &sensor.intrinsics) {
            Some(Ok(intrinsics)) => *intrinsics,
            Some(Err(text)) => return Err(problem(format!("sensor {sensor}: {text}"))),
            None => return Err(problem(format!("its sensor `{sensor}` is not in the file"))),
        };
        let component = component.and_then(|id| components.get(id)).copied().flatten();
        let frame = component.or(whole).unwrap_or(Frame::IDENTITY);
        let origin = if frame.translation.length() > GEOCENTRIC { DVec3::ZERO } else { frame.translation };
        far |= origin != frame.translation;
        let position = frame.scale * (frame.rotation * pose.1) + origin;
        let rotation = frame.rotation * pose.0 * FLIP;
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

/// Returns the chunk that is read: the enabled one; of several, the active one, else the first that
/// was aligned.
fn choose_chunk<'a, 'i>(
    document: &'a Document<'i>,
    file: &str,
    listing: &mut Listing,
) -> Result<Node<'a, 'i>> {
    let all = document.descendants().filter(|n| n.has_tag_name("chunk"));
    let chunks: Vec<Node> = all.filter(|c| child(*c, "cameras").is_some()).collect();
    let enabled: Vec<Node> = chunks.iter().copied().filter(|c| !is_off(*c)).collect();
    let is_active = |c: &&Node| {
        let active = c.parent().and_then(|above| above.attribute("active_id"));
        active.is_some() && active == c.attribute("id")
    };
    let is_aligned = |c: &&Node| {
        let mut cameras = within(**c, "cameras", "camera");
        cameras.any(|camera| child(camera, "transform").is_some())
    };
    let chunk = match (&enabled[..], &chunks[..]) {
        (_, []) => return Err(in_file(file, "it has no `cameras`", EXPORT)),
        ([one], _) => one,
        ([], [one]) => {
            let text = format!("the only chunk of `{file}` is disabled, and read all the same");
            listing.warnings.push(text);
            one
        }
        ([], several) => several.iter().find(is_active).ok_or_else(|| {
            let problem =
                format!("all its {} chunks are disabled: {}", several.len(), few(several.iter().map(label)));
            in_file(file, problem, "enable the chunk that is meant, and export its cameras again")
        })?,
        (several, _) => {
            let found = several.iter().find(is_active).or(several.iter().find(is_aligned));
            found.unwrap_or(&several[0])
        }
    };
    let others = chunks.iter().filter(|c| *c != chunk);
    let others = others.map(|c| label(c) + if is_off(*c) { " (disabled)" } else { "" });
    if chunks.len() > 1 {
        listing.warnings.push(format!(
            "of the {} chunks of `{file}`, only `{}` is read, not {}: to have another one, export that alone",
            chunks.len(),
            label(chunk),
            few(others)
        ));
    }
    Ok(*chunk)
}

/// Returns the cameras of one component, where several were aligned apart and have no place in a
/// common world: of the active one, else of the largest.
fn of_one_world<'a, 'i>(
    placed: Vec<Placed<'a, 'i>>,
    chunk: Node<'a, 'i>,
    components: &HashMap<&str, Option<Frame>>,
    listing: &mut Listing,
) -> Vec<Placed<'a, 'i>> {
    let mut ids: Vec<&str> = placed.iter().filter_map(|placed| placed.component).collect();
    ids.sort_unstable();
    ids.dedup();
    let has_place = |id: &&str| components.get(*id).is_some_and(|frame| frame.is_some());
    if ids.len() < 2 || ids.iter().all(has_place) {
        return placed;
    }
    let count = |id: &&str| placed.iter().filter(|placed| placed.component == Some(*id)).count();
    let active = child(chunk, "components").and_then(|components| components.attribute("active_id"));
    let largest = ids.iter().copied().max_by_key(count);
    let read = active.filter(|id| ids.contains(id)).or(largest);
    let is_read = |placed: &Placed| placed.component.is_none() || placed.component == read;
    let (kept, others): (Vec<Placed>, Vec<Placed>) = placed.into_iter().partition(is_read);
    let (cameras, names) = (counted(others.len(), "camera"), few(others.iter().map(|o| label(&o.camera))));
    listing.warnings.push(format!(
        "{cameras} left out, because Metashape aligned the chunk in {} components apart, of which one is read: \
         {names}; align the photographs again until they are in one",
        ids.len()
    ));
    kept
}

fn id<'a>(node: Node<'a, '_>) -> &'a str {
    node.attribute("id").unwrap_or_default()
}

fn label(node: &Node) -> String {
    node.attribute("label").unwrap_or_default().to_string()
}

/// Returns whether a chunk or camera is disabled.
fn is_off(node: Node) -> bool {
    matches!(node.attribute("enabled"), Some("0" | "false"))
}

/// Returns the photographs' names: labels, which have no folders. Of equal ones, the group is the
/// folder.
fn labels(placed: &[Placed]) -> Vec<String> {
    let (mut seen, mut twice) = (HashSet::new(), HashSet::new());
    for placed in placed {
        let label = label(&placed.camera);
        if !seen.insert(label.clone()) {
            twice.insert(label);
        }
    }
    let name = |placed: &Placed| {
        let name = label(&placed.camera);
        let group = placed.camera.parent().filter(|parent| parent.has_tag_name("group"));
        match group.map(|group| label(&group)).filter(|group| !group.is_empty()) {
            Some(group) if twice.contains(&name) => format!("{group}/{name}"),
            _ => name,
        }
    };
    placed.iter().map(name).collect()
}

/// A camera whose pose is known.
struct Placed<'a, 'i> {
    camera: Node<'a, 'i>,
    /// From the camera to its chunk.
    pose: Pose,
    component: Option<&'a str>,
    /// Whether the pose is that of a slave.
    is_slave: bool,
}

/// Sensors and cameras of a chunk by their numbers.
struct Rig<'a, 'i> {
    sensors: HashMap<&'a str, Sensor>,
    cameras: HashMap<&'a str, Node<'a, 'i>>,
}

impl<'a, 'i> Rig<'a, 'i> {
    /// Returns the cameras that have a pose, and says which have none.
    fn place(
        &self,
        file: &str,
        cameras: &[Node<'a, 'i>],
        listing: &mut Listing,
    ) -> Result<Vec<Placed<'a, 'i>>> {
        let (mut placed, mut others, mut lost) = (Vec::new(), Vec::new(), Vec::new());
        for &camera in cameras {
            let label = label(&camera);
            let master = self.master(camera);
            let pose = self.pose(camera, master).map_err(|text| in_frame(file, &label, text))?;
            match (pose, master) {
                (Some(pose), _) => {
                    let own = camera.attribute("component_id");
                    let component = own.or(master.and_then(|master| master.attribute("component_id")));
                    placed.push(Placed { camera, pose, component, is_slave: master.is_some() });
                }
                (None, Some(_)) if !is_off(camera) => lost.push(label),
                _ => others.push(label),
            }
        }
        if !others.is_empty() {
            let (n, names) = (others.len(), few(others));
            listing.warnings.push(format!("{n} cameras were not aligned, or are disabled: {names}"));
        }
        if !lost.is_empty() {
            let (slaves, names) = (counted(lost.len(), "slave camera"), few(lost));
            listing.warnings.push(format!(
                "{slaves} of a rig left out, because no `rotation` and `location` of a sensor says where \
                 they are in their masters: {names}; in Metashape, give the slave offset in Tools, Camera \
                 Calibration, optimize the cameras, and export them again"
            ));
        }
        let slaves = placed.iter().filter(|placed| placed.is_slave).count();
        if slaves > 0 {
            let slaves = counted(slaves, "slave camera");
            let text = "of a rig placed by the master's pose and the sensor's rotation and location";
            listing.reasons.push(format!("{slaves} {text}"));
        }
        let has_rows = |placed: &&Placed| {
            let of_sensor = || self.sensor(placed.camera).is_some_and(|sensor| sensor.has_rolling_shutter);
            sensor::has_rolling_shutter(placed.camera) || of_sensor()
        };
        let rolling = placed.iter().filter(has_rows).count();
        if rolling > 0 {
            let cameras = counted(rolling, "camera");
            listing.warnings.push(format!(
                "rolling shutter of {cameras} was compensated in Metashape, and is not here: each photograph \
                 has one pose; a head that was photographed in motion is blurred"
            ));
        }
        Ok(placed)
    }

    fn sensor(&self, camera: Node) -> Option<&Sensor> {
        self.sensors.get(camera.attribute("sensor_id")?)
    }

    /// Returns the master of a slave without a pose of its own, if it has one.
    fn master(&self, camera: Node) -> Option<Node<'a, 'i>> {
        let master = *self.cameras.get(camera.attribute("master_id")?)?;
        let is_needed = child(camera, "transform").is_none() && child(master, "transform").is_some();
        is_needed.then_some(master)
    }

    /// Returns the pose of a camera in its chunk.
    fn pose(&self, camera: Node, master: Option<Node>) -> Result<Option<Pose>, String> {
        if is_off(camera) {
            return Ok(None);
        }
        let Some(master) = master else { return child(camera, "transform").map(pose).transpose() };
        let (Some(of_master), Some(of_slave)) = (self.sensor(master), self.sensor(camera)) else {
            return Ok(None);
        };
        let Some((rotation, position)) = Sensor::master_from_slave(of_master, of_slave)? else {
            return Ok(None);
        };
        let (turned, origin) = child(master, "transform").map_or(Ok((DMat3::IDENTITY, DVec3::ZERO)), pose)?;
        Ok(Some((turned * rotation, turned * position + origin)))
    }
}

/// Returns the pose in a `transform` of a camera.
fn pose(transform: Node) -> Result<Pose, String> {
    let values = numbers(Some(transform)).ok();
    let m: Option<[f64; 16]> = values.and_then(|v| v.try_into().ok());
    let m = m.ok_or("its `transform` is not 16 numbers")?;
    frame::pose(&[0, 1, 2].map(|r| [m[4 * r], m[4 * r + 1], m[4 * r + 2], m[4 * r + 3]]))
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
    fn from_node(node: Node) -> Result<Option<Frame>, String> {
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
