//! In the place of `learn` in a build without the feature `cpu`: no field is learned or loaded.

use super::line::Line;
use super::surface::{Fields, Radiance, Surface};
use crate::capture::Capture;
use crate::capture::scene::Scene;
use crate::config::{Config, Stage};
use crate::geom::Camera;
use crate::render::RenderedView;
use crate::run::StageDir;
use crate::{Error, Result};
use serde_json::Value;
use std::path::Path;

/// The error of this build for whatever needs a field.
pub(super) fn no_fields<T>() -> Result<T> {
    Err(Error::cannot("this build cannot learn fields", "build with the feature `cpu`, which is the default"))
}

pub(super) fn learn(_: Stage, _: &Capture, _: &Scene, _: &Config, _: &StageDir) -> Result<Value> {
    no_fields()
}

struct NoFields;

pub(super) fn trained_fields(_: &Line) -> impl Fields {
    NoFields
}

/// What a camera in the scene sees of a field.
pub(super) type FieldLook = Box<dyn Fn(&Camera) -> RenderedView>;

pub(super) fn load_field(_: &Path, _: &Config, _: &Scene, _: Stage) -> Result<FieldLook> {
    no_fields()
}

impl Fields for NoFields {
    fn surface(&self) -> Result<&dyn Surface> {
        no_fields()
    }

    fn radiance(&self, _: Stage) -> Result<&dyn Radiance> {
        no_fields()
    }
}
