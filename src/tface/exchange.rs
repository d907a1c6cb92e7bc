//! To and from the published checkpoints (`.th`).
//!
//! Their world is the dataset's, scaled: `field = k · world`, k = 1 / 0.3 for the published loader, which also
//! scales ray directions to depth 1 ([`Placement::depth_directions`]). Ours is the scene's box.

use super::TfaceError;
use super::checkpoint::{self, FieldRecord};
use super::infer::{Placement, TFace};
use super::th::{self, Activation, VmCheckpoint, VmMask};
use crate::geom::Similarity;
use crate::io::Limits;
use crate::kernel::vm::mask::BoxMask;
use crate::kernel::vm::{DecoderShape, Factor, Grid, Shading};
use glam::DMat3;
use std::path::Path;
use std::sync::Arc;

/// `[c, h, w]` to `[h, w, c]`.
fn channel_last(f: &Factor, values: &[f32]) -> Vec<f32> {
    let n = f.height * f.width;
    (0..f.len()).map(|i| values[i % f.channels * n + i / f.channels]).collect()
}

/// `[h, w, c]` to `[c, h, w]`.
fn channel_first(f: &Factor, values: &[f32]) -> Vec<f32> {
    let n = f.height * f.width;
    (0..f.len()).map(|i| values[i % n * f.channels + i / n]).collect()
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

/// The field of a stage folder as the bytes of a published checkpoint, in the dataset's world times `scale`.
///
/// Directions of rays are no part of a checkpoint: ours were of unit length in training, and the published
/// loader's are somewhat longer off the axis, which its decoder sees.
pub fn export_th(dir: &Path, scale: f64, scene_from_world: &Similarity) -> Result<Vec<u8>, TfaceError> {
    if scene_from_world.rotation != DMat3::IDENTITY {
        return Err(TfaceError::Exchange("the scene is turned against the dataset's world"));
    }
    let (face, record) = checkpoint::load(&checkpoint::newest(dir))?;
    let f = &face.field;
    // out = k · field + o; a field that was imported goes back to where it came from
    let (k, o) = match record.placement {
        Some(_) => (1.0, glam::DVec3::ZERO),
        None => {
            let k = scale / scene_from_world.scale;
            (k, scene_from_world.translation * -k)
        }
    };
    let place = |p: [f32; 3]| -> [f32; 3] { std::array::from_fn(|a| (k * p[a] as f64 + o[a]) as f32) };
    let planes = |grid: &Grid, values: &[f32]| -> [Vec<f32>; 3] {
        std::array::from_fn(|i| channel_first(&grid.plane(i), &values[grid.plane(i).range()]))
    };
    let lines = |grid: &Grid, values: &[f32]| -> [Vec<f32>; 3] {
        std::array::from_fn(|i| channel_first(&grid.line(i), &values[grid.line(i).range()]))
    };
    let mut rest = face.network.as_slice();
    let [basis, w1, b1, w2, b2, w3, b3] = f.decoder.shapes().map(|(rows, columns)| {
        let (own, tail) = rest.split_at(rows * columns);
        rest = tail;
        own.to_vec()
    });
    let (near, far) = match record.placement {
        Some(_) => (f.lattice.near, f.lattice.far),
        None => (1e-3 * k as f32, 1e3 * k as f32),
    };
    Ok(th::th_bytes(&VmCheckpoint {
        aabb: [place(f.lattice.min), place(f.lattice.max)],
        grid_size: f.density.size,
        density_rank: f.density.rank,
        color_rank: f.color.rank,
        app_dim: f.decoder.features,
        density_shift: f.shading.shift,
        alpha_mask_threshold: record.mask_threshold,
        distance_scale: (f.shading.distance_scale as f64 / k) as f32,
        weight_threshold: f.shading.weight_threshold,
        activation: if f.shading.softplus { Activation::Softplus } else { Activation::Relu },
        near_far: [near, far],
        step_ratio: record.step_ratio,
        position_frequencies: 0,
        view_frequencies: f.decoder.view_frequencies,
        feature_frequencies: f.decoder.feature_frequencies,
        hidden: f.decoder.hidden,
        density_planes: planes(&f.density, &face.density),
        density_lines: lines(&f.density, &face.density),
        color_planes: planes(&f.color, &face.color),
        color_lines: lines(&f.color, &face.color),
        basis,
        mlp: [(w1, b1), (w2, b2), (w3, b3)],
        mask: f.mask.as_ref().and_then(|m| vertices(m, place)),
    }))
}

/// The mask as vertices, z slowest as published; its corners go through `place`.
fn vertices(mask: &BoxMask, place: impl Fn([f32; 3]) -> [f32; 3]) -> Option<VmMask> {
    let ([low, high], [nx, ny, nz], vertices) = mask.vertices()?;
    let occupied =
        (0..nx * ny * nz).map(|i| vertices[(i % nx * ny + i / nx % ny) * nz + i / (nx * ny)]).collect();
    Some(VmMask { shape: [nz, ny, nx], occupied, aabb: [place(low), place(high)] })
}

#[cfg(test)]
#[path = "exchange_tests.rs"]
mod tests;
