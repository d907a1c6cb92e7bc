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
//! script needs to make one: arrays are little-endian and row-major, `C` channels are [`VmCheckpoint::density_rank`]
//! or [`VmCheckpoint::color_rank`] of plane i, and `field` is the JSON text of that name in `__metadata__`.
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
use crate::{Error, Result};
use std::path::Path;

/// Width and height of plane i.
const PLANE_AXES: [[usize; 2]; 3] = [[0, 1], [0, 2], [1, 2]];
/// The axis of line i.
const LINE_AXIS: [usize; 3] = [2, 1, 0];
const LAYERS: [usize; 3] = [0, 2, 4];

/// A vector–matrix field as published checkpoints hold it; lengths are in the units of its box.
#[derive(Clone, Debug, PartialEq)]
pub struct VmCheckpoint {
    /// Lowest and highest corner of the box.
    pub aabb: [[f32; 3]; 2],
    /// Nodes along x, y, z; at least 2.
    pub grid_size: [usize; 3],
    /// Components of each density plane and its line.
    pub density_rank: [usize; 3],
    /// Components of each appearance plane and its line.
    pub color_rank: [usize; 3],
    /// Appearance features.
    pub app_dim: usize,
    /// Added before [`Activation::Softplus`].
    pub density_shift: f32,
    /// Alpha from which a node counts as occupied.
    pub alpha_mask_threshold: f32,
    /// Factor on the length of a step.
    pub distance_scale: f32,
    /// Weight above which a sample gets a color.
    pub weight_threshold: f32,
    /// From density feature to density.
    pub activation: Activation,
    /// Where rays begin and, for their beginning only, end.
    pub near_far: [f32; 2],
    /// Step over the mean distance of nodes.
    pub step_ratio: f32,
    /// Frequencies of positions; unused by the color network that is read.
    pub position_frequencies: usize,
    /// Frequencies of view directions.
    pub view_frequencies: usize,
    /// Frequencies of appearance features.
    pub feature_frequencies: usize,
    /// Width of the color network.
    pub hidden: usize,
    /// `[C, H, W]`: `[rank, nodes of the second axis, nodes of the first]`.
    pub density_planes: [Vec<f32>; 3],
    /// `[C, N]`: `[rank, nodes of the third axis]`.
    pub density_lines: [Vec<f32>; 3],
    /// As the planes of density.
    pub color_planes: [Vec<f32>; 3],
    /// As the lines of density.
    pub color_lines: [Vec<f32>; 3],
    /// `[app_dim, sum of color_rank]`.
    pub basis: Vec<f32>,
    /// Weight `[outputs, inputs]` and bias of each layer: [`VmCheckpoint::inputs`] → hidden → hidden → 3.
    pub mlp: [(Vec<f32>, Vec<f32>); 3],
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

/// From density feature f to density.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Activation {
    /// max(f, 0)
    Relu,
    /// ln(1 + exp(f + shift))
    Softplus,
}

impl VmCheckpoint {
    /// Width of the color network's input: features, direction, and sine and cosine of both.
    pub fn inputs(&self) -> usize {
        self.app_dim * (1 + 2 * self.feature_frequencies) + 3 * (1 + 2 * self.view_frequencies)
    }

    /// Shapes of the planes and lines of components `rank`, as they are in the file.
    fn factor_shapes(&self, rank: [usize; 3]) -> [([usize; 4], [usize; 4]); 3] {
        std::array::from_fn(|i| {
            let [width, height] = PLANE_AXES[i].map(|axis| self.grid_size[axis]);
            ([1, rank[i], height, width], [1, rank[i], self.grid_size[LINE_AXIS[i]], 1])
        })
    }

    fn layer_shapes(&self) -> [[usize; 2]; 3] {
        [[self.hidden, self.inputs()], [self.hidden, self.hidden], [3, self.hidden]]
    }
}

/// Reads a published checkpoint; nothing in it is executed ([`io::parse_torch`]). Every shape is compared
/// with the sizes in `kwargs`, every number must be finite, and an entry without a meaning is an error.
pub fn read_th(path: &Path, limits: &Limits) -> Result<VmCheckpoint> {
    understand(path, &io::read_torch(path, limits)?)
}

/// [`read_th`] on bytes; `path` is only for messages.
pub fn from_bytes(bytes: &[u8], path: &Path, limits: &Limits) -> Result<VmCheckpoint> {
    understand(path, &io::parse_torch(path, bytes, limits)?)
}

fn understand(path: &Path, root: &TorchValue) -> Result<VmCheckpoint> {
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
    let activation = match kwargs.text("fea2denseAct")? {
        "relu" => Activation::Relu,
        "softplus" => Activation::Softplus,
        other => {
            let other = format!("`{}`", other.escape_debug().take(80).collect::<String>());
            return Err(kwargs.wrong("fea2denseAct", other, "`relu` or `softplus`"));
        }
    };
    let mut vm = VmCheckpoint {
        aabb: kwargs.aabb("aabb")?,
        grid_size: kwargs.counts("gridSize", 2)?,
        density_rank: kwargs.counts("density_n_comp", 1)?,
        color_rank: kwargs.counts("appearance_n_comp", 1)?,
        app_dim: kwargs.count("app_dim", 1)?,
        density_shift: kwargs.number("density_shift", f32::MIN)?,
        alpha_mask_threshold: kwargs.number("alphaMask_thres", 0.0)?,
        distance_scale: kwargs.number("distance_scale", f32::MIN_POSITIVE)?,
        weight_threshold: kwargs.number("rayMarch_weight_thres", 0.0)?,
        activation,
        near_far: kwargs.near_far("near_far")?,
        step_ratio: kwargs.number("step_ratio", f32::MIN_POSITIVE)?,
        position_frequencies: kwargs.count("pos_pe", 0)?,
        view_frequencies: kwargs.count("view_pe", 0)?,
        feature_frequencies: kwargs.count("fea_pe", 0)?,
        hidden: kwargs.count("featureC", 1)?,
        density_planes: Default::default(),
        density_lines: Default::default(),
        color_planes: Default::default(),
        color_lines: Default::default(),
        basis: Vec::new(),
        mlp: Default::default(),
        mask: None,
    };
    let mut known = vec!["basis_mat.weight".to_string()];
    let mut take = |key: String, shape: &[usize]| {
        let values = state.floats(&key, shape);
        known.push(key);
        values
    };
    let (density, color) = (vm.factor_shapes(vm.density_rank), vm.factor_shapes(vm.color_rank));
    for i in 0..3 {
        vm.density_planes[i] = take(format!("density_plane.{i}"), &density[i].0)?;
        vm.density_lines[i] = take(format!("density_line.{i}"), &density[i].1)?;
        vm.color_planes[i] = take(format!("app_plane.{i}"), &color[i].0)?;
        vm.color_lines[i] = take(format!("app_line.{i}"), &color[i].1)?;
    }
    for (layer, shape) in vm.layer_shapes().iter().enumerate() {
        let name = LAYERS[layer];
        let weight = take(format!("renderModule.mlp.{name}.weight"), shape)?;
        vm.mlp[layer] = (weight, take(format!("renderModule.mlp.{name}.bias"), &shape[..1])?);
    }
    vm.basis = state.floats("basis_mat.weight", &[vm.app_dim, vm.color_rank.iter().sum()])?;
    if let Some(key) = state.keys().find(|key| !known.iter().any(|k| k == key)) {
        let key: String = key.escape_debug().take(80).collect();
        return Err(state.wrong(&key, "there".into(), "only planes, lines, basis and three layers"));
    }
    if root.keys().any(|key| key.starts_with("alphaMask.")) {
        vm.mask = Some(mask(&root)?);
    }
    Ok(vm)
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
