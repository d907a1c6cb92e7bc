//! Checkpoints of the published T-Face and TensoRF code (`.th`), read.
//!
//! A dictionary of `kwargs` (what the Python constructor takes), `state_dict` (planes, lines, basis and the
//! color network) and, once an alpha mask was made, `alphaMask.shape`, `.mask` (packed bits, the highest
//! first) and `.aabb`. Plane i spans the axes `(0,1)`, `(0,2)`, `(1,2)` as width and height, line i the one
//! that is left: `TensorVMSplit` of TensoRF (Chen et al. 2022). Optimizer and schedule are not in the file.
//!
//! # Where our own files hold the same
//!
//! No `.th` is written. `checkpoint.safetensors` of a stage folder, one per field, holds one field with all that a
//! script needs to make one: arrays are little-endian and row-major, `C` channels are
//! `density_rank` or `color_rank` of plane i, and `field` is the JSON text of that name in `__metadata__`.
//!
//! | ours | published |
//! |---|---|
//! | `model.density`: planes 0, 1, 2 as `[H, W, C]`, then lines 0, 1, 2 as `[N, C]` | `state_dict`: `density_plane.i` `[1, C, H, W]`, `density_line.i` `[1, C, N, 1]` |
//! | `model.color`, likewise | `app_plane.i`, `app_line.i` |
//! | `model.network`: seven matrices, one after the other | `basis_mat.weight`, then weight and bias of `renderModule.mlp.0`, `.2`, `.4` |
//! | `bounds` `[2, 3]`, `size` `[3]` | `kwargs`: `aabb`, `gridSize` |
//! | `field`: `density_rank`, `color_rank`, `features`, `hidden` | `density_n_comp`, `appearance_n_comp`, `app_dim`, `featureC` |
//! | `view_frequencies`, `feature_frequencies` | `view_pe`, `fea_pe`; `pos_pe` is 0 and `shadingMode` is `MLP_Fea` |
//! | `softplus`, `shift` | `fea2denseAct` (`softplus` or `relu`), `density_shift` |
//! | `distance_scale`, `weight_threshold`, `step_ratio` | `distance_scale`, `rayMarch_weight_thres`, `step_ratio` |
//! | `near`, `far`, `mask_threshold` | `near_far`, `alphaMask_thres` |
//! | `mask.bits` over `mask.size` cells, x slowest, bit `i % 64` of word `i / 64` | `alphaMask.mask` over vertices, z slowest |
//!
//! Where `field.placement` is null, positions are the scene's. A published world is the dataset's times s (1 / 0.3
//! in the published loader, `tface.import_scale` here): with `scene_from_world` of `cameras.json` and k = s over
//! its scale, `aabb` is k · (`bounds` − its translation) and `distance_scale` is ours / k. Cells of our mask go one
//! further than the vertices: a vertex is one whose eight cells are all set, and the mask's box is as much smaller.

mod table;

use self::table::{MAX_COUNT, Table, about, about_tensor, integer};
use crate::io::{self, Limits, TorchNumbers, TorchValue};
use crate::kernel::cpu::vm::{DecoderShape, Grid, Shading};
use crate::{Error, Result};
use std::path::Path;

/// Entries of the color network, in the order of [`DecoderShape::shapes`].
const NETWORK: [&str; 7] = [
    "basis_mat.weight",
    "renderModule.mlp.0.weight",
    "renderModule.mlp.0.bias",
    "renderModule.mlp.2.weight",
    "renderModule.mlp.2.bias",
    "renderModule.mlp.4.weight",
    "renderModule.mlp.4.bias",
];

/// A vector–matrix field as published checkpoints hold it; lengths are in the units of its box.
#[derive(Clone, Debug, PartialEq)]
pub struct VmCheckpoint {
    /// Lowest and highest corner of the box.
    pub aabb: [[f32; 3]; 2],
    /// Nodes and components of the density's planes and lines.
    pub density_grid: Grid,
    /// The same of the appearance.
    pub color_grid: Grid,
    /// Sizes of the color network.
    pub decoder: DecoderShape,
    /// From features to weights.
    pub shading: Shading,
    /// Alpha from which a node counts as occupied.
    pub alpha_mask_threshold: f32,
    /// Where rays begin and, for their beginning only, end.
    pub near_far: [f32; 2],
    /// Step over the mean distance of nodes.
    pub step_ratio: f32,
    /// Three planes `[C, H, W]`, `[rank, nodes of the second axis, nodes of the first]`, then three lines `[C, N]`.
    pub density: [Vec<f32>; 6],
    /// As those of the density.
    pub color: [Vec<f32>; 6],
    /// Matrices of the color network one after the other, as [`DecoderShape::shapes`] lists them.
    pub network: Vec<f32>,
    /// Where anything may be, if that was ever found out.
    pub mask: Option<VmMask>,
}

/// Nodes at or near which the field is not empty.
#[derive(Clone, Debug, PartialEq)]
pub struct VmMask {
    /// Nodes along z, y, x.
    pub shape: [usize; 3],
    /// `[nz, ny, nx]`.
    pub occupied: Vec<bool>,
    /// The mask's own box.
    pub aabb: [[f32; 3]; 2],
}

/// Reads a published checkpoint; nothing in it is executed ([`io::parse_torch`]). Every shape is compared
/// with the sizes in `kwargs`, every number must be finite, and an entry without a meaning is an error.
pub fn read_th(path: &Path, limits: &Limits) -> Result<VmCheckpoint> {
    parse(path, &io::read_torch(path, limits)?)
}

/// [`read_th`] on bytes; `path` is only for messages.
pub fn from_bytes(bytes: &[u8], path: &Path, limits: &Limits) -> Result<VmCheckpoint> {
    parse(path, &io::parse_torch(path, bytes, limits)?)
}

fn parse(path: &Path, root: &TorchValue) -> Result<VmCheckpoint> {
    let root = Table { path, name: "", values: root };
    let kwargs = root.table("kwargs")?;
    let state = root.table("state_dict")?;
    if state.values.get("density_plane.0").is_none() && state.values.get("density_line.0").is_some() {
        let what = "a CP field (lines without planes), only the vector–matrix field is read";
        let message = format!("`{}` holds {what}", path.display());
        return Err(Error::cannot(message, "train again with `--model_name TensorVMSplit`"));
    }
    let shading = kwargs.text("shadingMode")?;
    if shading != "MLP_Fea" {
        let found: String = shading.escape_debug().take(80).collect();
        return Err(Error::cannot(
            format!("`{}` finds colors by shadingMode `{found}`, only `MLP_Fea` is read", path.display()),
            "train again with `--shadingMode MLP_Fea`, as T-Face does",
        ));
    }
    let softplus = match kwargs.text("fea2denseAct")? {
        "relu" => false,
        "softplus" => true,
        other => {
            let other = format!("`{}`", other.escape_debug().take(80).collect::<String>());
            return Err(kwargs.wrong("fea2denseAct", other, "`relu` or `softplus`"));
        }
    };
    let size = kwargs.counts("gridSize", 2)?;
    let density_grid = Grid { size, rank: kwargs.counts("density_n_comp", 1)? };
    let color_grid = Grid { size, rank: kwargs.counts("appearance_n_comp", 1)? };
    let decoder = DecoderShape {
        channels: color_grid.channels(),
        features: kwargs.count("app_dim", 1)?,
        hidden: kwargs.count("featureC", 1)?,
        view_frequencies: kwargs.count("view_pe", 0)?,
        feature_frequencies: kwargs.count("fea_pe", 0)?,
    };
    // positions are no input of this color network
    kwargs.count("pos_pe", 0)?;
    let shading = Shading {
        softplus,
        shift: kwargs.number("density_shift", f32::MIN)?,
        distance_scale: kwargs.number("distance_scale", f32::MIN_POSITIVE)?,
        weight_threshold: kwargs.number("rayMarch_weight_thres", 0.0)?,
        stop: 0.0,
    };
    let mut known = Vec::new();
    let mut take = |key: String, shape: &[usize]| {
        let values = state.floats(&key, shape);
        known.push(key);
        values
    };
    let mut factors = |name: &str, grid: &Grid| -> Result<[Vec<f32>; 6]> {
        let mut all = [const { Vec::new() }; 6];
        for (k, (f, values)) in grid.factors().iter().zip(&mut all).enumerate() {
            let (kind, shape) = match k < 3 {
                true => ("plane", [1, f.channels, f.height, f.width]),
                false => ("line", [1, f.channels, f.width, 1]),
            };
            *values = take(format!("{name}_{kind}.{}", k % 3), &shape)?;
        }
        Ok(all)
    };
    let (density, color) = (factors("density", &density_grid)?, factors("app", &color_grid)?);
    let mut network = Vec::new();
    for (name, (rows, columns)) in NETWORK.into_iter().zip(decoder.shapes()) {
        let dimensions = if name.ends_with("bias") { 1 } else { 2 };
        network.extend(take(name.into(), &[rows, columns][..dimensions])?);
    }
    if let Some(key) = state.keys().find(|key| !known.iter().any(|k| k == key)) {
        let key: String = key.escape_debug().take(80).collect();
        return Err(state.wrong(&key, "there".into(), "only planes, lines, basis and three layers"));
    }
    let has_mask = root.keys().any(|key| key.starts_with("alphaMask."));
    Ok(VmCheckpoint {
        aabb: kwargs.aabb("aabb")?,
        density_grid,
        color_grid,
        decoder,
        shading,
        alpha_mask_threshold: kwargs.number("alphaMask_thres", 0.0)?,
        near_far: kwargs.near_far("near_far")?,
        step_ratio: kwargs.number("step_ratio", f32::MIN_POSITIVE)?,
        density,
        color,
        network,
        mask: if has_mask { Some(mask(&root)?) } else { None },
    })
}

fn mask(root: &Table) -> Result<VmMask> {
    let expected = "(1, 1, nz, ny, nx), each 2 or more";
    let shape: Option<Vec<usize>> =
        root.items("alphaMask.shape")?.iter().map(|v| integer(v).filter(|&n| n <= MAX_COUNT)).collect();
    let shape = match shape.as_deref() {
        Some(&[1, 1, z, y, x]) if z.min(y).min(x) >= 2 => [z, y, x],
        other => return Err(root.wrong("alphaMask.shape", format!("{other:?}"), expected)),
    };
    // 2⁴⁸ at most
    let count = shape.iter().product::<usize>();
    let packed = match root.get("alphaMask.mask")? {
        TorchValue::Array(tensor) | TorchValue::Tensor(tensor) => match &tensor.values {
            TorchNumbers::U8(packed) if packed.len() == count.div_ceil(8) => packed,
            _ => {
                let expected = format!("{} bytes, the bits of {shape:?} nodes", count.div_ceil(8));
                return Err(root.wrong("alphaMask.mask", about_tensor(tensor), &expected));
            }
        },
        other => return Err(root.wrong("alphaMask.mask", about(other), "an array of bytes")),
    };
    let occupied = (0..count).map(|i| packed[i / 8] >> (7 - i % 8) & 1 == 1).collect();
    Ok(VmMask { shape, occupied, aabb: root.aabb("alphaMask.aabb")? })
}
