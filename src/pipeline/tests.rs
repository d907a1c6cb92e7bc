//! What the tests of the pipeline share.

use super::{Fields, Radiance, Session, Stage, Surface, complete};
use crate::Result;
use crate::capture::synthetic::SyntheticOptions;
use crate::capture::synthetic::shared::{Files, write_capture};
use crate::config::{CameraPoses, Config, Exposures, Preset};
use crate::run::{Done, Run};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Mutex, OnceLock};

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
    stages.iter().map(|s| s.word()).collect::<Vec<_>>().join(" ")
}

/// Writes the demo head, photographed at a size by so many training and held-out views, into a folder. A size of its own costs
/// seconds, one that other tests have nothing.
pub(super) fn demo_head(root: &Path, (width, height): (u32, u32), (train, test): (usize, usize)) {
    write_capture(root, &SyntheticOptions { width, height, train, test, seed: 1 });
}

/// The configuration of a draft of the capture in a folder. Cameras and exposures are used as given: their measurement takes
/// longer than all else of the stage `mask`, and has tests of its own.
pub(super) fn draft(root: &Path) -> Config {
    let mut config = Config::preset(Preset::Draft);
    config.capture.path = root.to_str().unwrap().into();
    (config.capture.cameras, config.capture.exposure) = (CameraPoses::Given, Exposures::Given);
    config
}

/// Completes the stage `mask` as [`complete`] does, for tests of what follows. It is made once a test program for each plan; later
/// its files are copied into the run, where they are found done.
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
