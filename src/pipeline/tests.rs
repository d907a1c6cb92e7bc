//! What the tests of the pipeline share.

use super::{Fields, Radiance, Session, Stage, Surface, complete};
use crate::config::{CameraPoses, Config, Exposures, Glares, Preset};
use crate::run::{Done, Run};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Mutex, OnceLock};
use tempfile::TempDir;
use tiface_base::Result;
use tiface_base::geom::Camera;
use tiface_base::image::Gray;
use tiface_base::io::Limits;
use tiface_capture::scene::{self, Scene, SceneOptions};
use tiface_capture::synthetic::SyntheticOptions;
use tiface_capture::testing::{Files, write_capture};
use tiface_capture::{self as capture, Capture, CaptureOptions, Split};

/// Fields that no stage may load.
pub(super) struct NoFields;

impl Fields for NoFields {
    fn surface(&self) -> Result<&dyn Surface> {
        panic!("loaded for nothing")
    }

    fn radiance(&self, _: Stage) -> Result<&dyn Radiance> {
        panic!("loaded for nothing")
    }
}

/// A run in `dir/run` that reports nothing.
pub(super) fn quiet(dir: &Path) -> Run {
    Run::quiet(&dir.join("run"))
}

/// The words of stages, with spaces.
pub(super) fn words(stages: &[Stage]) -> String {
    stages.iter().map(|s| s.as_str()).collect::<Vec<_>>().join(" ")
}

/// Writes the demo head, photographed at a size by this many training and held-out views, into a
/// folder. A size of its own costs seconds, one that other tests have nothing.
pub(super) fn demo_head(root: &Path, (width, height): (u32, u32), (train, test): (usize, usize)) {
    write_capture(root, &SyntheticOptions { width, height, train, test, seed: 1 });
}

/// The configuration of a draft of the capture in a folder. Cameras, exposures and glare are used
/// as given: their measurement takes longer than all else of the stage `mask`, and has tests of its
/// own.
pub(super) fn draft(root: &Path) -> Config {
    let mut config = Config::preset(Preset::Draft);
    config.capture.path = root.into();
    (config.capture.cameras, config.capture.exposure) = (CameraPoses::Given, Exposures::Given);
    config.capture.glare = Glares::Given;
    config
}

/// A folder with the demo head, photographed at a size by so many training and held-out views; the
/// configuration of a draft of it, and a run that reports nothing.
pub(super) fn head_run(size: (u32, u32), views: (usize, usize)) -> (TempDir, Config, Run) {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("head");
    demo_head(&root, size, views);
    let (config, run) = (draft(&root), quiet(dir.path()));
    (dir, config, run)
}

/// The least of these that most questions can be asked about.
pub(super) fn tiny_run() -> (TempDir, Config, Run) {
    head_run((32, 40), (8, 2))
}

/// The demo head on which cameras and exposures are measured: 14 training views, and a held-out
/// one, the last. From the places of this seed exposures are measured well although photographs are
/// small.
pub(super) fn measured_head() -> (TempDir, Capture) {
    let dir = tempfile::tempdir().unwrap();
    let options = SyntheticOptions { width: 144, height: 180, train: 14, test: 1, seed: 3 };
    write_capture(dir.path(), &options);
    let capture = capture::open(dir.path(), &CaptureOptions::default()).unwrap();
    (dir, capture)
}

/// The scene of the training views of a capture; that of the same cameras and masks is found once a
/// test program.
pub(super) fn scene_of(capture: &Capture) -> Scene {
    type Views = (Vec<Camera>, Vec<Option<Gray>>);
    static FOUND: Mutex<Vec<(Views, Scene)>> = Mutex::new(Vec::new());
    let train: Vec<_> = capture.split(Split::Train).collect();
    let masks = train.iter().map(|v| v.load_mask(&Limits::default()).unwrap()).collect();
    let views: Views = (train.iter().map(|v| v.camera.clone()).collect(), masks);
    let mut found = FOUND.lock().unwrap();
    if let Some((_, scene)) = found.iter().find(|(of, _)| *of == views) {
        return scene.clone();
    }
    let (scene, _) = scene::fit(&views.0, &views.1, &SceneOptions::default()).unwrap();
    found.push((views, scene.clone()));
    scene
}

/// Completes the stage `mask` as [`complete`] does, for tests of what follows. It is made once a
/// test program for each plan; later its files are copied into the run, where they are found done.
pub(super) fn masked(session: &Session) -> Done {
    static MADE: Mutex<BTreeMap<String, Arc<OnceLock<Files>>>> = Mutex::new(BTreeMap::new());
    let (folder, plan) = (session.run.path(Stage::Mask), session.plan(Stage::Mask));
    let made = MADE.lock().unwrap().entry(plan.fingerprint.digest()).or_default().clone();
    let make = || {
        complete(session, Stage::Mask, &NoFields).unwrap();
        Files::read(&folder)
    };
    let files = made.get_or_init(make);
    if !session.run.is_done(&plan) {
        files.write(&folder);
    }
    complete(session, Stage::Mask, &NoFields).unwrap()
}
