//! Import of published checkpoints in place of training.
//!
//! `tools/reference/th_to_safetensors.py` converts published checkpoints. A converted checkpoint
//! has our format ([`FORMAT`]), except that its positions are in scaled dataset coordinates, which
//! the metadata marks by `frame` = `world`. Its ray directions have depth 1
//! ([`Placement::depth_directions`]), as in the published loader.

use super::infer::TFace;
use super::record::{FORMAT, FieldRecord, Placement};
use crate::field::checkpoint::{self, Checkpoint};
use crate::field::training::TrainingSession;
use glam::DMat3;
use std::path::Path;
use tiface_base::Result;
use tiface_base::geom::Similarity;

/// Imports a converted checkpoint as the result of a stage: reads it, places it in the scene and
/// writes it into the session's folder. `scale` is the length of a dataset unit in the checkpoint's
/// world.
pub fn import(
    path: &Path,
    scale: f64,
    scene_from_world: &Similarity,
    session: &TrainingSession,
) -> Result<TFace> {
    let place = || -> Result<(Checkpoint, TFace)> {
        let mut file = Checkpoint::read(path, session.stage, FORMAT)?;
        if file.text("frame")? != "world" {
            return Err(file.mismatch("its `frame` is not `world`".into()));
        }
        if scene_from_world.rotation != DMat3::IDENTITY {
            return Err(file.mismatch(
                "it has the axes of the world, but the scene is turned to be upright: set `capture.box=ilsh`"
                    .into(),
            ));
        }
        // field = scale · world = scale · (scene − t) / s
        let k = scale / scene_from_world.scale;
        let offset = (scene_from_world.translation * -k).as_vec3().to_array();
        let placement = Some(Placement { scale: k as f32, offset, depth_directions: true });
        FieldRecord { placement, ..FieldRecord::restore(&file)? }.write(&mut file);
        file.set("frame", "scene");
        file.set("identity", session.identity);
        file.set("finished", 1);
        Ok((file.clone(), TFace::restore(file)?))
    };
    let hint = "convert a published `.th` file with `tools/reference/th_to_safetensors.py`, and name what that writes";
    let (file, face) = place().map_err(|e| e.with_hint(hint))?;
    file.save(session.dir)?;
    checkpoint::finish(session.dir)?;
    Ok(face)
}

#[cfg(test)]
#[path = "import_tests.rs"]
mod tests;
