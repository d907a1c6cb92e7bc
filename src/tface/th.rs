//! Checkpoints of the published T-Face and TensoRF code (`.th`), in and out.
//!
//! A dictionary of `kwargs` (what the Python constructor takes), `state_dict` (planes, lines, basis and the
//! colour network) and, once an alpha mask was made, `alphaMask.shape`, `.mask` (packed bits, the highest
//! first) and `.aabb`. Plane i spans the axes `(0,1)`, `(0,2)`, `(1,2)` as width and height, line i the one
//! that is left: `TensorVMSplit` of TensoRF (Chen et al. 2022). Optimiser and schedule are not in the file.

mod table;

use self::table::{MAX_COUNT, Table, about, about_tensor, integer};
use crate::io::{self, Limits, ReadError, TorchNumbers, TorchTensor, TorchValue};
use std::path::{Path, PathBuf};
use std::sync::Arc;

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
    /// Weight above which a sample gets a colour.
    pub weight_threshold: f32,
    /// From density feature to density.
    pub activation: Activation,
    /// Where rays begin and, for their beginning only, end.
    pub near_far: [f32; 2],
    /// Step over the mean distance of nodes.
    pub step_ratio: f32,
    /// Frequencies of positions; unused by the colour network that is read.
    pub position_frequencies: usize,
    /// Frequencies of view directions.
    pub view_frequencies: usize,
    /// Frequencies of appearance features.
    pub feature_frequencies: usize,
    /// Width of the colour network.
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
    /// Width of the colour network's input: features, direction, and sine and cosine of both.
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

/// Why a checkpoint could not be taken.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ThError {
    /// The file itself.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// An entry that is missing, of another type, or does not fit the others.
    #[error("`{}`: `{key}` is {found}, expected {expected}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// The entry, with the dictionary it stands in.
        key: String,
        /// What is there.
        found: String,
        /// What must be there.
        expected: String,
    },
    /// A decomposition into lines alone.
    #[error("`{}` holds a CP field (lines without planes), only the vector–matrix field is read", path.display())]
    Cp {
        /// The file.
        path: PathBuf,
    },
    /// Another colour network.
    #[error("`{}` finds colors by shadingMode `{found}`, only `MLP_Fea` is read", path.display())]
    Shading {
        /// The file.
        path: PathBuf,
        /// The mode.
        found: String,
    },
}

impl ThError {
    /// The way out.
    pub fn hint(&self) -> String {
        match self {
            ThError::Read(error) => error.hint(),
            ThError::Content { .. } => {
                "give a `.th` file as `TensorVMSplit.save` writes it; other checkpoints have other entries"
                    .into()
            }
            ThError::Cp { .. } => "train again with `--model_name TensorVMSplit`".into(),
            ThError::Shading { .. } => "train again with `--shadingMode MLP_Fea`, as T-Face does".into(),
        }
    }
}

/// Reads a published checkpoint; nothing in it is executed ([`io::parse_torch`]). Every shape is compared
/// with the sizes in `kwargs`, every number must be finite, and an entry without a meaning is an error.
pub fn read_th(path: &Path, limits: &Limits) -> Result<VmCheckpoint, ThError> {
    understand(path, &io::read_torch(path, limits)?)
}

/// [`read_th`] on bytes; `path` is only for messages.
pub fn from_bytes(bytes: &[u8], path: &Path, limits: &Limits) -> Result<VmCheckpoint, ThError> {
    understand(path, &io::parse_torch(path, bytes, limits)?)
}

fn understand(path: &Path, root: &TorchValue) -> Result<VmCheckpoint, ThError> {
    let root = Table { path, name: "", values: root };
    let kwargs = root.table("kwargs")?;
    let state = root.table("state_dict")?;
    if state.values.get("density_plane.0").is_none() && state.values.get("density_line.0").is_some() {
        return Err(ThError::Cp { path: path.into() });
    }
    let shading = kwargs.text("shadingMode")?;
    if shading != "MLP_Fea" {
        return Err(ThError::Shading { path: path.into(), found: shading.escape_debug().take(80).collect() });
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

fn mask(root: &Table) -> Result<VmMask, ThError> {
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

/// The bytes of a file that the published code loads (`torch.load`, then `TensorVMSplit(**kwargs).load`).
/// Expects what [`VmCheckpoint`] says about lengths; numbers of `kwargs` are written by their shortest
/// decimals, so 1e-4 is 1e-4 in Python too.
pub fn th_bytes(checkpoint: &VmCheckpoint) -> Vec<u8> {
    let vm = checkpoint;
    let counts = |v: [usize; 3]| TorchValue::List(v.map(int).into());
    let kwargs = vec![
        entry("aabb", tensor(&[2, 3], vm.aabb.as_flattened())),
        entry("gridSize", counts(vm.grid_size)),
        entry("density_n_comp", counts(vm.density_rank)),
        entry("appearance_n_comp", counts(vm.color_rank)),
        entry("app_dim", int(vm.app_dim)),
        entry("density_shift", decimal(vm.density_shift)),
        entry("alphaMask_thres", decimal(vm.alpha_mask_threshold)),
        entry("distance_scale", decimal(vm.distance_scale)),
        entry("rayMarch_weight_thres", decimal(vm.weight_threshold)),
        entry(
            "fea2denseAct",
            text(match vm.activation {
                Activation::Relu => "relu",
                Activation::Softplus => "softplus",
            }),
        ),
        entry("near_far", TorchValue::List(vm.near_far.map(decimal).into())),
        entry("step_ratio", decimal(vm.step_ratio)),
        entry("shadingMode", text("MLP_Fea")),
        entry("pos_pe", int(vm.position_frequencies)),
        entry("view_pe", int(vm.view_frequencies)),
        entry("fea_pe", int(vm.feature_frequencies)),
        entry("featureC", int(vm.hidden)),
    ];
    let mut state = Vec::new();
    let (density, color) = (vm.factor_shapes(vm.density_rank), vm.factor_shapes(vm.color_rank));
    let mut add =
        |key: String, shape: &[usize], values: &[f32]| state.push(entry(&key, tensor(shape, values)));
    for (name, values) in [("density", &vm.density_planes), ("app", &vm.color_planes)] {
        let (shapes, lines) =
            if name == "app" { (&color, &vm.color_lines) } else { (&density, &vm.density_lines) };
        (0..3).for_each(|i| add(format!("{name}_plane.{i}"), &shapes[i].0, &values[i]));
        (0..3).for_each(|i| add(format!("{name}_line.{i}"), &shapes[i].1, &lines[i]));
    }
    add("basis_mat.weight".into(), &[vm.app_dim, vm.color_rank.iter().sum()], &vm.basis);
    for (layer, shape) in vm.layer_shapes().iter().enumerate() {
        let (weight, bias) = &vm.mlp[layer];
        add(format!("renderModule.mlp.{}.weight", LAYERS[layer]), shape, weight);
        add(format!("renderModule.mlp.{}.bias", LAYERS[layer]), &shape[..1], bias);
    }
    let mut root =
        vec![entry("kwargs", TorchValue::Dict(kwargs)), entry("state_dict", TorchValue::OrderedDict(state))];
    if let Some(mask) = &vm.mask {
        let [z, y, x] = mask.shape;
        let mut packed = vec![0u8; mask.occupied.len().div_ceil(8)];
        for i in (0..mask.occupied.len()).filter(|&i| mask.occupied[i]) {
            packed[i / 8] |= 0x80 >> (i % 8);
        }
        let packed = TorchTensor { shape: vec![packed.len()], values: TorchNumbers::U8(packed) };
        root.push(entry("alphaMask.shape", TorchValue::Tuple([1, 1, z, y, x].map(int).into())));
        root.push(entry("alphaMask.mask", TorchValue::Array(Arc::new(packed))));
        root.push(entry("alphaMask.aabb", tensor(&[2, 3], mask.aabb.as_flattened())));
    }
    io::torch_bytes(&TorchValue::Dict(root))
}

fn entry(key: &str, value: TorchValue) -> (Arc<str>, TorchValue) {
    (key.into(), value)
}

fn text(value: &str) -> TorchValue {
    TorchValue::Str(value.into())
}

fn int(value: usize) -> TorchValue {
    TorchValue::Int(value as i64)
}

fn decimal(value: f32) -> TorchValue {
    TorchValue::Float(value.to_string().parse().unwrap_or(value as f64))
}

fn tensor(shape: &[usize], values: &[f32]) -> TorchValue {
    TorchValue::Tensor(Arc::new(TorchTensor {
        shape: shape.into(),
        values: TorchNumbers::F32(values.into()),
    }))
}
