//! What the tests of the pipeline share.

use super::{Fields, Radiance, Stage, Surface};
use crate::Result;
use crate::run::Run;
use std::path::Path;

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
