//! How well the cameras of a capture fit each other, in words, and the refined poses that a run keeps.
//!
//! The measurement is [`crate::rig`]'s. It takes photographs of the training views and the hull of their masks; held-out
//! views take no part. The stage `mask` makes it and writes `poses.json`, later stages read refined poses there.

use crate::capture::scene::{Hull, Scene};
use crate::capture::{Capture, Split, View};
use crate::config::CameraPoses;
use crate::geom::{Camera, Mesh, Similarity};
use crate::image::{Gray, reduce_photo, resize_gray, working_size};
use crate::io::{self, Limits, ReadError};

use crate::mesh::{Volume, marching};
use crate::rig::{self, CameraState, LEAST_SIGHTINGS, RigView, Verdict};
use crate::{Error, Result};
use glam::{DMat3, DVec3, Vec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// File name of the measurement, in the folder of the stage `mask`.
pub(super) const POSES: &str = "poses.json";

/// Longest side of the photographs that are searched, pixels.
const SEARCHED_PX: u32 = 1024;

/// Maximum number of training views; the system of their poses is solved densely.
const MOST_VIEWS: usize = 256;

/// What to do about a camera that does not fit.
const HINT: &str = "was the camera moved, or are two photographs swapped? Correct its pose or photograph, or remove the frame; \
                    `--set capture.cameras=given` goes on with all poses as they are";

/// The measurement of a capture's cameras.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct CameraCheck {
    verdict: Verdict,
    /// Median distance of sightings from their points, pixels, with the poses given and the adjusted ones.
    given_px: f64,
    adjusted_px: f64,
    cameras: Vec<CheckedCamera>,
}

/// The measurement of one camera.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct CheckedCamera {
    view: String,
    state: CameraState,
    sightings: usize,
    /// How many points of other photographs were looked up in its own.
    expected: usize,
    /// Median distance of its sightings, pixels of its photograph.
    given_px: f64,
    adjusted_px: f64,
    /// How far the head moves in its picture by the adjustment, pixels.
    moved_px: f64,
    given: Pose,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    refined: Option<Pose>,
}

/// A camera's pose in the dataset's world.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct Pose {
    rotation: DMat3,
    position: DVec3,
}

impl From<&Camera> for Pose {
    fn from(camera: &Camera) -> Pose {
        Pose { rotation: camera.rotation, position: camera.position }
    }
}

/// Measures how well the cameras of the training views fit each other. `None` where that cannot be measured: without a
/// hull, with fewer than three masks, or with more views than can be solved at once.
pub(super) fn check_cameras(
    capture: &Capture,
    scene: &Scene,
    poses: CameraPoses,
    limits: &Limits,
) -> Result<Option<CameraCheck>> {
    let train: Vec<&View> = capture.split(Split::Train).collect();
    let Some(hull) = scene.hull.as_ref().filter(|_| train.len() <= MOST_VIEWS) else { return Ok(None) };
    let loaded = train.par_iter().map(|view| searched(view, limits)).collect::<Result<Vec<_>>>()?;
    let measured = train.iter().zip(loaded).filter_map(|(view, loaded)| Some((*view, loaded?)));
    let (train, loaded): (Vec<&View>, Vec<(RigView, Camera)>) = measured.unzip();
    if train.len() < 3 {
        return Ok(None);
    }
    let (views, cameras): (Vec<RigView>, Vec<Camera>) = loaded.into_iter().unzip();
    let given: Vec<Camera> = cameras.iter().map(|c| c.transformed(&scene.scene_from_world)).collect();
    let rig = rig::measure(&views, &given, &hull_surface(hull)?, poses == CameraPoses::Refine);
    let world_from_scene = scene.scene_from_world.inverse();
    let checked = |(view, (searched, fit)): (&&View, (&Camera, &rig::CameraFit))| {
        let pixels = f64::from(view.camera.width) / f64::from(searched.width);
        let refined = (fit.state == CameraState::Refined)
            .then(|| Pose::from(&fit.camera.transformed(&world_from_scene)));
        CheckedCamera {
            view: view.name.clone(),
            state: fit.state,
            sightings: fit.sightings,
            expected: fit.expected,
            given_px: pixels * fit.given_px,
            adjusted_px: pixels * fit.adjusted_px,
            moved_px: pixels * fit.moved_px,
            given: Pose::from(&view.camera),
            refined,
        }
    };
    let pixels = f64::from(train[0].camera.width) / f64::from(cameras[0].width);
    Ok(Some(CameraCheck {
        verdict: rig.verdict,
        given_px: pixels * rig.given_px,
        adjusted_px: pixels * rig.adjusted_px,
        cameras: train.iter().zip(cameras.iter().zip(&rig.cameras)).map(checked).collect(),
    }))
}

/// Returns a view's photograph ready to be searched, with its camera at that size; `None` without a mask.
fn searched(view: &View, limits: &Limits) -> Result<Option<(RigView, Camera)>> {
    let loaded = view.load(limits)?;
    let Some(mut mask) = loaded.mask else { return Ok(None) };
    if let Some(valid) = &loaded.valid {
        mask.values.iter_mut().zip(&valid.values).for_each(|(m, v)| *m = (*m).min(*v));
    }
    let size = working_size(view.camera.width, view.camera.height, SEARCHED_PX);
    let head: Gray = resize_gray(&mask, size);
    let picture = RigView::new(&reduce_photo(&loaded.photo, size), &head);
    Ok(Some((picture, view.camera.resized(size.0, size.1))))
}

/// Returns the surface of a hull, smoothed and drawn in by about a cell, since a hull holds every cell that any mask may
/// touch.
fn hull_surface(hull: &Hull) -> Result<Mesh> {
    /// Share of the smoothed cells' value where the surface lies; one half would be the hull's own.
    const LEVEL: f32 = 0.8;
    let r = hull.resolution;
    // the hull's cells run along z first, the volume's nodes along x
    let inside = |i: usize| hull.get((i % r * r + i / r % r) * r + i / (r * r));
    let mut values: Vec<f32> = (0..r.pow(3)).map(|i| f32::from(u8::from(inside(i)))).collect();
    for stride in [1, r, r * r, 1, r, r * r] {
        let before = values.clone();
        let smooth = |(i, value): (usize, &mut f32)| {
            let place = i / stride % r;
            let low = if place > 0 { before[i - stride] } else { 0.0 };
            let high = if place + 1 < r { before[i + stride] } else { 0.0 };
            *value = 0.25 * (low + high) + 0.5 * before[i];
        };
        values.par_iter_mut().enumerate().for_each(smooth);
    }
    values.iter_mut().for_each(|v| *v = LEVEL - *v);
    let cell = 2.0 / r as f32;
    let (origin, spacing) = (Vec3::splat(0.5 * cell - 1.0), Vec3::splat(cell));
    let mut surface = marching(&Volume { dims: [r; 3], values: &values, origin, spacing }, true)?.mesh;
    surface.normals = surface.angle_weighted_normals();
    Ok(surface)
}

/// Returns `8,900` for 8900.
fn grouped(n: usize) -> String {
    if n < 1000 { n.to_string() } else { format!("{},{:03}", grouped(n / 1000), n % 1000) }
}

impl CameraCheck {
    /// Returns the finding in one sentence.
    pub(super) fn sentence(&self) -> String {
        let total: usize = self.cameras.iter().map(|c| c.sightings).sum();
        let sightings = format!("({} sightings)", grouped(total));
        let moved = |c: &&CheckedCamera| c.state == CameraState::Refined;
        let refined: Vec<&CheckedCamera> = self.cameras.iter().filter(moved).collect();
        match self.verdict {
            Verdict::Unchecked => format!(
                "poses are not checked: too little of the head was found again in other photographs {sightings}; they \
                 are used as given"
            ),
            Verdict::Fit => format!("poses fit within {:.1} px {sightings}", self.given_px),
            Verdict::Some => {
                let each = refined.iter().map(|c| format!("camera `{}` by {:.1} px", c.view, c.moved_px));
                format!(
                    "poses fit within {:.1} px {sightings}, except {}",
                    self.adjusted_px,
                    each.collect::<Vec<_>>().join(", ")
                )
            }
            Verdict::All => {
                let squares: f64 = refined.iter().map(|c| c.moved_px * c.moved_px).sum();
                let rms = (squares / refined.len().max(1) as f64).sqrt();
                let worst = refined.iter().max_by(|a, b| a.moved_px.total_cmp(&b.moved_px));
                let worst =
                    worst.map_or(String::new(), |c| format!(", `{}` most, by {:.1} px", c.view, c.moved_px));
                format!("poses are {rms:.1} px off against each other{worst} {sightings}")
            }
        }
    }

    /// Returns the finding with what a run does about it.
    pub(super) fn announcement(&self) -> String {
        let will = if self.refines() { "; a run refines what does not fit" } else { "" };
        format!("{}{will}", self.sentence())
    }

    /// Returns cameras that can be neither used nor refined.
    pub(super) fn problems(&self) -> Vec<Error> {
        let problem = |c: &CheckedCamera| match c.state {
            CameraState::Lost if c.sightings >= LEAST_SIGHTINGS => Some(format!(
                "the photograph of view `{}` does not show what its camera should see: the points found in it stay \
                 {:.1} px off in every pose, where the others fit within {:.1} px",
                c.view, c.adjusted_px, self.adjusted_px
            )),
            CameraState::Lost => Some(format!(
                "the photograph of view `{}` does not show what its camera should see: only {} of {} points \
                 that other photographs share were found in it",
                c.view, c.sightings, c.expected
            )),
            CameraState::Far => Some(format!(
                "the camera of view `{}` is {:.0} px off where the others fit within {:.1} px",
                c.view, c.moved_px, self.adjusted_px
            )),
            _ => None,
        };
        self.cameras.iter().filter_map(problem).map(|text| Error::cannot(text, HINT)).collect()
    }

    /// Returns whether any pose is refined.
    pub(super) fn refines(&self) -> bool {
        self.cameras.iter().any(|c| c.refined.is_some())
    }

    /// Returns how many poses are refined, and how the cameras fit, for the stage's record.
    pub(super) fn summary(&self) -> serde_json::Value {
        let refined = self.cameras.iter().filter(|c| c.refined.is_some()).count();
        serde_json::json!({
            "verdict": self.verdict,
            "refined": refined,
            "sightings": self.cameras.iter().map(|c| c.sightings).sum::<usize>(),
            "given_px": self.given_px,
            "adjusted_px": self.adjusted_px,
        })
    }

    /// Writes the measurement into the folder of the stage `mask`.
    pub(super) fn write(&self, folder: &Path) -> Result<()> {
        let text = serde_json::to_string_pretty(self).unwrap_or_default();
        Ok(io::write_atomic(&folder.join(POSES), format!("{text}\n").as_bytes())?)
    }

    /// Reads the file of [`CameraCheck::write`], if there is one; poses that it cannot have written are refused.
    pub(super) fn read(folder: &Path) -> Result<Option<CameraCheck>, ReadError> {
        let path = folder.join(POSES);
        if !io::is_file(&path) {
            return Ok(None);
        }
        let check: CameraCheck = io::read_typed(&path, &Limits::default())?;
        for (k, camera) in check.cameras.iter().enumerate() {
            let Some(Pose { rotation, position }) = camera.refined else { continue };
            let pose = Similarity { scale: 1.0, rotation, translation: position };
            if let Some((part, found, expected)) = pose.problem() {
                let part = if part == "translation" { "position" } else { part };
                return Err(ReadError::value(&path, format!("cameras[{k}].refined.{part}"), found, expected));
            }
        }
        Ok(Some(check))
    }

    /// Gives the training views of a capture their refined poses.
    pub(super) fn apply(&self, capture: &mut Capture) {
        for view in capture.views.iter_mut().filter(|v| v.split == Split::Train) {
            let found = self.cameras.iter().find(|c| c.view == view.name);
            if let Some(Pose { rotation, position }) = found.and_then(|c| c.refined) {
                (view.camera.rotation, view.camera.position) = (rotation, position);
            }
        }
    }
}
