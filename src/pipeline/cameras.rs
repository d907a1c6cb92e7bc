//! How well the cameras of a capture fit each other, in words, and the refined poses that a run
//! keeps.
//!
//! The measurement is [`tiface_capture::rig`]'s. It takes photographs of the training views and the
//! hull of their masks; held-out views take no part. The stage `mask` makes it and writes
//! `poses.json`, later stages read refined poses there. Where poses are refined, each held-out view
//! is then fitted alone: the evaluation shows it from both poses.

use super::rig_photos::RigPhotos;
use crate::config::CameraPoses;
use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};
use std::path::Path;
use tiface_base::geom::{Camera, Similarity};
use tiface_base::image::{Gray, Photo};
use tiface_base::io::{self, Limits, ReadError};
use tiface_base::{Error, Result};
use tiface_capture::path::NamedCamera;
use tiface_capture::rig::{self, CameraState, LEAST_SIGHTINGS, PoseDecision, RigView};
use tiface_capture::{Capture, Split, View};

/// File name of the measurement, in the folder of the stage `mask`.
pub(super) const POSES: &str = "poses.json";

/// Advice for a camera that does not fit.
const HINT: &str = "was the camera moved, or are two photographs swapped? Correct its pose or photograph, or remove the frame; \
                    `--set capture.cameras=given` goes on with all poses as they are";

/// Advice for cameras that fit in no pose.
const APART_HINT: &str = "are the photographs those of this capture, in the order of its cameras, and is none turned or mirrored? \
                          Did the head or the rig move between them, or does the shutter roll? Correct photographs or poses; \
                          `--set capture.cameras=given` goes on with all poses as they are";

/// Views that are named as the worst ones.
const WORST: usize = 3;

/// The measurement of a capture's cameras.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct CameraCheck {
    verdict: PoseDecision,
    /// Median distance of sightings from their points, pixels, with the poses given and the
    /// adjusted ones.
    given_px: f64,
    adjusted_px: f64,
    cameras: Vec<CheckedCamera>,
    /// Held-out views, if poses are refined.
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    held_out: Vec<FittedView>,
}

/// A held-out view, fitted alone to the points of the training views.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct FittedView {
    view: String,
    sightings: usize,
    /// Median distance of its sightings, pixels of its photograph.
    given_px: f64,
    fitted_px: f64,
    /// How far the head moves in its picture from the pose given to the fitted one, pixels.
    moved_px: f64,
    given: Pose,
    /// Missing where too few points were found, or fit no pose.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    fitted: Option<Pose>,
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

/// Measures how well the cameras of the training views fit each other. If any is refined, the
/// held-out views are then fitted one by one.
pub(super) fn check_cameras(photos: &RigPhotos, poses: CameraPoses) -> CameraCheck {
    check_by(rig::POINTS, photos, poses)
}

/// Does what [`check_cameras`] does, by this many points.
pub(super) fn check_by(points: usize, photos: &RigPhotos, poses: CameraPoses) -> CameraCheck {
    let RigPhotos { views: captured, train, cameras: given, scene_from_world, .. } = photos;
    let ((captured, held_out), (given, given_held_out)) = (captured.split_at(*train), given.split_at(*train));
    let (views, rig) = photos.measure(points, poses == CameraPoses::Refine);
    let world_from_scene = scene_from_world.inverse();
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
    let fitted = |((view, searched), (photo, head)): ((&&View, &Camera), &(Photo, Gray))| {
        let fit = rig.fit_held_out(&views, &RigView::new(photo, head), searched);
        let pixels = f64::from(view.camera.width) / f64::from(searched.width);
        FittedView {
            view: view.name.clone(),
            sightings: fit.sightings,
            given_px: pixels * fit.given_px,
            fitted_px: pixels * fit.fitted_px,
            moved_px: pixels * fit.moved_px,
            given: Pose::from(&view.camera),
            fitted: fit.camera.map(|camera| Pose::from(&camera.transformed(&world_from_scene))),
        }
    };
    let refines = rig.cameras.iter().any(|c| c.state == CameraState::Refined);
    let held_out = held_out.iter().zip(given_held_out).zip(&photos.pictures[*train..]).filter(|_| refines);
    let pixels = f64::from(captured[0].camera.width) / f64::from(given[0].width);
    CameraCheck {
        verdict: rig.verdict,
        given_px: pixels * rig.given_px,
        adjusted_px: pixels * rig.adjusted_px,
        cameras: captured.iter().zip(given.iter().zip(&rig.cameras)).map(checked).collect(),
        held_out: held_out.map(fitted).collect(),
    }
}

fn root_mean_square(values: &[f64]) -> f64 {
    (values.iter().map(|v| v * v).sum::<f64>() / values.len().max(1) as f64).sqrt()
}

/// Returns `8,900` for 8900.
pub(super) fn grouped(n: usize) -> String {
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
            PoseDecision::Unchecked => format!(
                "poses are not checked: too little of the head was found again in other photographs {sightings}; they \
                 are used as given"
            ),
            PoseDecision::Apart => format!(
                "poses are {:.1} px off against each other, and stay {:.1} px off when they are refined {sightings}",
                self.given_px, self.adjusted_px
            ),
            PoseDecision::Fit => format!("poses fit within {:.1} px {sightings}", self.given_px),
            PoseDecision::Some => {
                let each = refined.iter().map(|c| format!("camera `{}` by {:.1} px", c.view, c.moved_px));
                format!(
                    "poses fit within {:.1} px {sightings}, except {}",
                    self.adjusted_px,
                    each.collect::<Vec<_>>().join(", ")
                )
            }
            PoseDecision::All => {
                let rms = root_mean_square(&refined.iter().map(|c| c.moved_px).collect::<Vec<f64>>());
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
        if self.verdict == PoseDecision::Apart {
            return vec![Error::cannot(self.apart(), APART_HINT)];
        }
        self.cameras.iter().filter_map(problem).map(|text| Error::cannot(text, HINT)).collect()
    }

    /// Returns how cameras that fit in no pose show it.
    fn apart(&self) -> String {
        let total = |count: fn(&CheckedCamera) -> usize| grouped(self.cameras.iter().map(count).sum());
        let mut worst: Vec<&CheckedCamera> = self.cameras.iter().collect();
        worst.sort_by(|a, b| b.adjusted_px.total_cmp(&a.adjusted_px));
        let named = |c: &&CheckedCamera| {
            format!("`{}` ({:.1} px, {} of {})", c.view, c.adjusted_px, c.sightings, c.expected)
        };
        let worst: Vec<String> = worst.iter().take(WORST).map(named).collect();
        format!(
            "the photographs do not show what their cameras should see: {} of {} points that other photographs share are \
             found again, and stay {:.1} px off in every pose; worst are {}",
            total(|c| c.sightings),
            total(|c| c.expected),
            self.adjusted_px,
            worst.join(", ")
        )
    }

    /// Returns what is said of held-out views that could not be fitted, if there are any.
    pub(super) fn not_fitted(&self) -> Option<String> {
        let left = self.held_out.iter().filter(|v| v.fitted.is_none());
        let left: Vec<String> = left.map(|v| format!("`{}` ({} sightings)", v.view, v.sightings)).collect();
        (!left.is_empty()).then(|| {
            let named = left.join(", ");
            format!(
                "too little was found again in held-out views to fit their poses: {named}; they are shown from the given \
                 ones alone"
            )
        })
    }

    /// Returns what is said of training views whose poses were not refined although all were to be,
    /// if there are any.
    pub(super) fn not_refined(&self) -> Option<String> {
        if !self.refines() {
            return Some(format!("`capture.cameras=refine` refines nothing: {}", self.sentence()));
        }
        let left = self.cameras.iter().filter(|c| c.state == CameraState::Stays);
        let left: Vec<String> = left.map(|c| format!("`{}` ({} sightings)", c.view, c.sightings)).collect();
        (!left.is_empty()).then(|| {
            let named = left.join(", ");
            format!(
                "too little was found again in training views to refine their poses: {named}; they are used as given"
            )
        })
    }

    /// Returns the cameras among these whose own poses were fitted, with these poses.
    pub(super) fn fitted(&self, cameras: &[NamedCamera]) -> Vec<NamedCamera> {
        let fitted = |NamedCamera { name, camera }: &NamedCamera| {
            let Pose { rotation, position } = self.held_out.iter().find(|v| v.view == *name)?.fitted?;
            Some(NamedCamera { name: name.clone(), camera: Camera { rotation, position, ..camera.clone() } })
        };
        cameras.iter().filter_map(fitted).collect()
    }

    /// Returns whether any pose is refined.
    pub(super) fn refines(&self) -> bool {
        self.cameras.iter().any(|c| c.refined.is_some())
    }

    /// Returns how many poses are refined, and how the cameras fit, for the stage's record.
    pub(super) fn summary(&self) -> serde_json::Value {
        let refined = self.cameras.iter().filter(|c| c.refined.is_some()).count();
        let mut summary = serde_json::json!({
            "verdict": self.verdict,
            "refined": refined,
            "sightings": self.cameras.iter().map(|c| c.sightings).sum::<usize>(),
            "given_px": self.given_px,
            "adjusted_px": self.adjusted_px,
        });
        if !self.held_out.is_empty() {
            let fitted = self.held_out.iter().filter(|v| v.fitted.is_some());
            let moved: Vec<f64> = fitted.map(|v| v.moved_px).collect();
            summary["held_out"] =
                serde_json::json!({"fitted": moved.len(), "moved_px": root_mean_square(&moved)});
        }
        summary
    }

    /// Writes the measurement into the folder of the stage `mask`.
    pub(super) fn write(&self, folder: &Path) -> Result<()> {
        let text = serde_json::to_string_pretty(self).unwrap_or_default();
        Ok(io::write_atomic(&folder.join(POSES), format!("{text}\n").as_bytes())?)
    }

    /// Reads the file of [`CameraCheck::write`], if there is one; poses that it cannot have written
    /// are refused.
    pub(super) fn read(folder: &Path) -> Result<Option<CameraCheck>, ReadError> {
        let path = folder.join(POSES);
        if !io::is_file(&path) {
            return Ok(None);
        }
        let check: CameraCheck = io::read_typed(&path, &Limits::default())?;
        let refined =
            check.cameras.iter().enumerate().map(|(k, c)| (format!("cameras[{k}].refined"), c.refined));
        let fitted =
            check.held_out.iter().enumerate().map(|(k, v)| (format!("held_out[{k}].fitted"), v.fitted));
        for (key, pose) in refined.chain(fitted) {
            let Some(Pose { rotation, position }) = pose else { continue };
            let pose = Similarity { scale: 1.0, rotation, translation: position };
            if let Some((part, found, expected)) = pose.problem() {
                let part = if part == "translation" { "position" } else { part };
                return Err(ReadError::value(&path, format!("{key}.{part}"), found, expected));
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
