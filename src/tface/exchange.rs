//! From the published checkpoints (`.th`).
//!
//! Their world is the dataset's, scaled: `field = k · world`, k = 1 / 0.3 for the published loader, which also
//! scales ray directions to depth 1 ([`Placement::depth_directions`]). Ours is the scene's box.

use super::TfaceError;
use super::checkpoint::{self, FieldRecord};
use super::infer::{Placement, TFace};
use super::th::{self, Activation, VmCheckpoint};
use crate::geom::Similarity;
use crate::io::Limits;
use crate::kernel::vm::mask::BoxMask;
use crate::kernel::vm::{DecoderShape, Factor, Grid, Shading};
use std::path::Path;
use std::sync::Arc;

/// `[c, h, w]` to `[h, w, c]`.
fn channel_last(f: &Factor, values: &[f32]) -> Vec<f32> {
    let n = f.height * f.width;
    (0..f.len()).map(|i| values[i % f.channels * n + i / f.channels]).collect()
}

fn flat(grid: &Grid, planes: &[Vec<f32>; 3], lines: &[Vec<f32>; 3]) -> Vec<f32> {
    let planes = planes.iter().enumerate().map(|(i, p)| channel_last(&grid.plane(i), p));
    let lines = lines.iter().enumerate().map(|(i, l)| channel_last(&grid.line(i), l));
    planes.chain(lines).flatten().collect()
}

fn record_of(c: &VmCheckpoint, placement: Option<Placement>) -> FieldRecord {
    let decoder = DecoderShape {
        channels: c.color_rank.iter().sum(),
        features: c.app_dim,
        hidden: c.hidden,
        view_frequencies: c.view_frequencies,
        feature_frequencies: c.feature_frequencies,
    };
    let shading = Shading {
        softplus: c.activation == Activation::Softplus,
        shift: c.density_shift,
        distance_scale: c.distance_scale,
        weight_threshold: c.weight_threshold,
        stop: 0.0,
    };
    let mut record = FieldRecord::new(c.density_rank, c.color_rank, decoder, shading, c.step_ratio)
        .between(c.near_far[0], c.near_far[1]);
    record.mask_threshold = c.alpha_mask_threshold;
    match placement {
        Some(placement) => record.placed(placement),
        None => record,
    }
}

/// A published checkpoint as a field; without a placement its coordinates are taken as the scene's.
fn field_of(c: &VmCheckpoint, placement: Option<Placement>) -> (TFace, FieldRecord) {
    let record = record_of(c, placement);
    let mask = c.mask.as_ref().map(|m| {
        let [nz, ny, nx] = m.shape;
        let vertices: Vec<bool> =
            (0..nx * ny * nz).map(|i| m.occupied[(i % nz * ny + i / nz % ny) * nx + i / (nz * ny)]).collect();
        BoxMask::from_vertices(m.aabb[0], m.aabb[1], [nx, ny, nz], &vertices)
    });
    let field = record.field(c.aabb, c.grid_size, mask);
    let density = flat(&field.density, &c.density_planes, &c.density_lines);
    let color = flat(&field.color, &c.color_planes, &c.color_lines);
    let [(w1, b1), (w2, b2), (w3, b3)] = &c.mlp;
    let network = [&c.basis, w1, b1, w2, b2, w3, b3].map(|m| m.as_slice()).concat();
    (TFace::from_parts(Arc::new(field), density, color, network, placement), record)
}

/// Takes a published checkpoint as the result of a stage: reads it, places it in the scene and writes it into
/// the stage folder `dir`. `scale` is the length of a dataset unit in the checkpoint's world.
pub fn import_th(
    path: &Path,
    scale: f64,
    scene_from_world: &Similarity,
    dir: &Path,
    identity: &str,
) -> Result<TFace, TfaceError> {
    let c = th::read_th(path, &Limits::default())?;
    // field = scale · world = scale · (scene − t) / s
    let s = scene_from_world;
    let k = scale / s.scale;
    let placement = Placement {
        scale: k as f32,
        offset: (s.translation * -k).as_vec3().to_array(),
        depth_directions: true,
    };
    if c.grid_size.iter().any(|&n| n > 1 << 16) {
        return Err(TfaceError::Exchange("its grid has more than 65536 nodes along an axis"));
    }
    let (record, placed) = (record_of(&c, Some(placement)), Some(placement));
    record.sound().map_err(TfaceError::Exchange)?;
    let (face, record) = field_of(&c, placed);
    checkpoint::save_field(dir, &face, record, identity)?;
    Ok(face)
}

#[cfg(test)]
#[path = "exchange_tests.rs"]
mod tests;
