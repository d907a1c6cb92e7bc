//! From the published checkpoints (`.th`).
//!
//! Their world is the dataset's, scaled: `field = k · world`, k = 1 / 0.3 for the published loader, which also
//! scales ray directions to depth 1 ([`Placement::depth_directions`]). Ours is the scene's box.

use super::infer::TFace;
use super::record::{FORMAT, FieldRecord, NAMES, Placement};
use super::th::{self, VmCheckpoint};
use crate::field::checkpoint::{self, Checkpoint};
use crate::field::training::TrainingSession;
use crate::geom::Similarity;
use crate::io::Limits;
use crate::kernel::cpu::vm::mask::BoxMask;
use crate::kernel::cpu::vm::{Factor, Grid};
use crate::{Error, Result};
use std::path::Path;

/// `[c, h, w]` to `[h, w, c]`.
fn channel_last(f: &Factor, values: &[f32]) -> Vec<f32> {
    let n = f.height * f.width;
    (0..f.len()).map(|i| values[i % f.channels * n + i / f.channels]).collect()
}

fn flat(grid: &Grid, factors: &[Vec<f32>; 6]) -> Vec<f32> {
    grid.factors().iter().zip(factors).flat_map(|(f, values)| channel_last(f, values)).collect()
}

/// What a published checkpoint is, rendered where `placement` says; without one its coordinates are the scene's.
fn record_of(c: &VmCheckpoint, placement: Option<Placement>) -> FieldRecord {
    FieldRecord {
        density_rank: c.density_grid.rank,
        color_rank: c.color_grid.rank,
        decoder: c.decoder,
        shading: c.shading,
        step_ratio: c.step_ratio,
        near: c.near_far[0],
        far: c.near_far[1],
        mask_threshold: c.alpha_mask_threshold,
        placement,
    }
}

/// A published checkpoint as a field.
fn field_of(c: &VmCheckpoint, record: &FieldRecord) -> TFace {
    let mask = c.mask.as_ref().map(|m| {
        let [nz, ny, nx] = m.shape;
        let vertices: Vec<bool> =
            (0..nx * ny * nz).map(|i| m.occupied[(i % nz * ny + i / nz % ny) * nx + i / (nz * ny)]).collect();
        BoxMask::from_vertices(m.aabb[0], m.aabb[1], [nx, ny, nz], &vertices)
    });
    let field = record.field(c.aabb, c.density_grid.size, mask);
    let values = [flat(&field.density, &c.density), flat(&field.color, &c.color), c.network.clone()];
    TFace::from_parts(field, values, record.placement)
}

/// Takes a published checkpoint as the result of a stage: reads it, places it in the scene and writes it into
/// the session's folder. `scale` is the length of a dataset unit in the checkpoint's world.
pub fn import_th(
    path: &Path,
    scale: f64,
    scene_from_world: &Similarity,
    session: &TrainingSession,
) -> Result<TFace> {
    let c = th::read_th(path, &Limits::default())?;
    // field = scale · world = scale · (scene − t) / s
    let s = scene_from_world;
    let k = scale / s.scale;
    let placement = Placement {
        scale: k as f32,
        offset: (s.translation * -k).as_vec3().to_array(),
        depth_directions: true,
    };
    let unsound = |why: &str| Error::cannot(format!("the field cannot be exchanged: {why}"), "");
    if c.density_grid.size.iter().any(|&n| n > 1 << 16) {
        return Err(unsound("its grid has more than 65536 nodes along an axis"));
    }
    let record = record_of(&c, Some(placement));
    record.validate().map_err(unsound)?;
    let face = field_of(&c, &record);
    let mut file = Checkpoint::new(session.stage, FORMAT, session.identity);
    file.set("finished", 1);
    let l = &face.field.lattice;
    record.save([l.min, l.max], face.field.density.size, face.field.mask.as_ref(), &mut file);
    for (name, values) in NAMES.iter().zip(&face.values) {
        file.put_floats(&format!("model.{name}"), &[values.len()], values.clone());
    }
    file.save(session.dir)?;
    checkpoint::finish(session.dir)?;
    Ok(face)
}

#[cfg(test)]
#[path = "exchange_tests.rs"]
mod tests;
