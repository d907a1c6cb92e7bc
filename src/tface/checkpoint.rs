//! Everything training needs to go on, in one safetensors file; how two of them take turns is
//! [`crate::field::checkpoint`]'s.

use super::TfaceError;
use super::infer::{Placement, TFace};
use super::state::{State, decoder, grids, param, shading};
use crate::config::VmConfig;
use crate::field;
use crate::field::checkpoint as turns;
use crate::field::optimizer::Moments;
use crate::io::{Limits, TensorValues, read_tensors, write_tensors};
use crate::kernel::vm::mask::{BoxMask, Lattice};
use crate::kernel::vm::{DecoderShape, Grid, Shading, VmField, samples_across, step_size};
use burn::tensor::Device;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::path::Path;
use std::sync::Arc;

pub use turns::{finish, newest};

/// Version of the file's layout.
const FORMAT: &str = "tiface-vm-1";

const NAMES: [&str; 3] = ["density", "color", "network"];

/// What a field is besides its values: enough to render it without the settings it was made with.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FieldRecord {
    density_rank: [usize; 3],
    color_rank: [usize; 3],
    features: usize,
    hidden: usize,
    view_frequencies: usize,
    feature_frequencies: usize,
    softplus: bool,
    shift: f32,
    distance_scale: f32,
    weight_threshold: f32,
    stop: f32,
    /// March step as a share of the distance of vertices.
    pub step_ratio: f32,
    near: f32,
    far: f32,
    /// Threshold of the alpha mask.
    pub mask_threshold: f32,
    /// Where its coordinates are not the scene's.
    pub placement: Option<Placement>,
}

impl FieldRecord {
    /// Of a field in training.
    fn of(config: &VmConfig) -> FieldRecord {
        let (density, color) = grids(config, [2; 3]);
        FieldRecord::new(density.rank, color.rank, decoder(config), shading(config), config.step_ratio as f32)
            .with_mask_threshold(config.mask_threshold as f32)
    }

    /// In scene coordinates, with no limit to where rays enter.
    pub fn new(
        density_rank: [usize; 3],
        color_rank: [usize; 3],
        decoder: DecoderShape,
        shading: Shading,
        step_ratio: f32,
    ) -> FieldRecord {
        FieldRecord {
            density_rank,
            color_rank,
            features: decoder.features,
            hidden: decoder.hidden,
            view_frequencies: decoder.view_frequencies,
            feature_frequencies: decoder.feature_frequencies,
            softplus: shading.softplus,
            shift: shading.shift,
            distance_scale: shading.distance_scale,
            weight_threshold: shading.weight_threshold,
            stop: shading.stop,
            step_ratio,
            near: 0.0,
            far: 1e6,
            mask_threshold: 1e-4,
            placement: None,
        }
    }

    fn with_mask_threshold(self, mask_threshold: f32) -> FieldRecord {
        FieldRecord { mask_threshold, ..self }
    }

    /// Rays enter between these.
    pub fn between(self, near: f32, far: f32) -> FieldRecord {
        FieldRecord { near, far, ..self }
    }

    /// In other coordinates than the scene's.
    pub fn placed(self, placement: Placement) -> FieldRecord {
        FieldRecord { placement: Some(placement), ..self }
    }

    /// Can this be rendered at all? What is impossible, else.
    pub fn sound(&self) -> Result<(), &'static str> {
        let shading =
            [self.shift, self.distance_scale, self.weight_threshold, self.stop, self.mask_threshold];
        let ranks = [self.density_rank, self.color_rank];
        if ranks.iter().any(|r| r.iter().all(|n| *n == 0) || r.iter().any(|n| *n > 4096)) {
            return Err("its planes have no channels, or more than 4096");
        }
        if !(1e-2..=100.0).contains(&self.step_ratio) {
            return Err("its step ratio is not within 0.01 and 100");
        }
        if self.view_frequencies > 16 || self.feature_frequencies > 16 {
            return Err("its encodings have more than 16 frequencies");
        }
        if self.hidden == 0 || !self.hidden.is_multiple_of(8) || self.hidden > 4096 || self.features > 4096 {
            return Err("its decoder is wider than 4096, or its hidden layers are no multiple of 8 wide");
        }
        let finite = |v: &f32| v.is_finite();
        if !shading.iter().chain([&self.near, &self.far]).all(finite) || self.near > self.far {
            return Err("its numbers are not finite, or near lies behind far");
        }
        if let Some(p) = &self.placement
            && !(p.scale.is_normal() && p.scale > 0.0 && p.offset.iter().all(finite))
        {
            return Err("it is placed by a scale that is not positive, or by numbers that are not finite");
        }
        Ok(())
    }

    /// The field over a box.
    pub fn field(&self, bounds: [[f32; 3]; 2], size: [usize; 3], mask: Option<BoxMask>) -> VmField {
        let extent: [f32; 3] = std::array::from_fn(|a| bounds[1][a] - bounds[0][a]);
        let step = step_size(extent, size, self.step_ratio);
        VmField {
            density: Grid { size, rank: self.density_rank },
            color: Grid { size, rank: self.color_rank },
            decoder: DecoderShape {
                channels: self.color_rank.iter().sum(),
                features: self.features,
                hidden: self.hidden,
                view_frequencies: self.view_frequencies,
                feature_frequencies: self.feature_frequencies,
            },
            lattice: Lattice {
                min: bounds[0],
                max: bounds[1],
                step,
                samples: samples_across(extent, step),
                near: self.near,
                far: self.far,
            },
            shading: Shading {
                softplus: self.softplus,
                shift: self.shift,
                distance_scale: self.distance_scale,
                weight_threshold: self.weight_threshold,
                stop: self.stop,
            },
            mask,
        }
    }
}

/// The parts of a checkpoint that are tensors.
struct Stored<'a> {
    bounds: [[f32; 3]; 2],
    size: [usize; 3],
    mask: Option<&'a BoxMask>,
    record: FieldRecord,
}

impl Stored<'_> {
    fn tensors(&self) -> Vec<(String, Vec<usize>, TensorValues)> {
        let flat = |b: ([f32; 3], [f32; 3])| TensorValues::F32([b.0, b.1].concat());
        let sizes = |s: [usize; 3]| TensorValues::U64(s.map(|n| n as u64).to_vec());
        let mut tensors = vec![
            ("bounds".to_owned(), vec![2, 3], flat((self.bounds[0], self.bounds[1]))),
            ("size".to_owned(), vec![3], sizes(self.size)),
        ];
        if let Some(mask) = self.mask {
            tensors.push(("mask.bounds".into(), vec![2, 3], flat(mask.bounds())));
            tensors.push(("mask.size".into(), vec![3], sizes(mask.size())));
            let bits = mask.bits().to_vec();
            tensors.push(("mask.bits".into(), vec![bits.len()], TensorValues::U64(bits)));
        }
        tensors
    }

    fn metadata(&self, identity: &str) -> BTreeMap<String, String> {
        let record = serde_json::to_string(&self.record).expect("plain numbers become JSON");
        BTreeMap::from([
            ("format".to_owned(), FORMAT.to_owned()),
            ("identity".to_owned(), identity.to_owned()),
            ("field".to_owned(), record),
            ("finished".to_owned(), "1".to_owned()),
        ])
    }
}

/// Writes a field that came from elsewhere, as finished.
pub fn save_field(dir: &Path, face: &TFace, record: FieldRecord, identity: &str) -> Result<(), TfaceError> {
    let l = &face.field.lattice;
    let stored = Stored {
        bounds: [l.min, l.max],
        size: face.field.density.size,
        mask: face.field.mask.as_ref(),
        record,
    };
    let mut tensors = stored.tensors();
    for (name, values) in NAMES.iter().zip([&face.density, &face.color, &face.network]) {
        tensors.push((format!("model.{name}"), vec![values.len()], TensorValues::F32(values.clone())));
    }
    Ok(write_tensors(&newest(dir), &tensors, &stored.metadata(identity))?)
}

/// The field of a stage folder, for rendering; and what it says of itself.
pub fn load(path: &Path) -> Result<(TFace, FieldRecord), TfaceError> {
    let mut file = Opened::read(path)?;
    let record: FieldRecord = serde_json::from_str(&file.meta("field")?)
        .map_err(|e| file.wrong(format!("its `field` cannot be understood: {e}")))?;
    record.sound().map_err(|why| file.wrong(why.into()))?;
    let (bounds, size, mask) = file.geometry()?;
    let field = record.field(bounds, size, mask);
    let lengths = [field.density.len(), field.color.len(), field.decoder.len()];
    let [density, color, network] = file.models(lengths)?;
    Ok((TFace::from_parts(Arc::new(field), density, color, network, record.placement), record))
}

/// Writes a checkpoint; `identity` names what shaped the training (settings, inputs, seed). The optimiser's
/// moments are left out of a finished one: nobody goes on from it.
pub fn save(
    dir: &Path,
    state: &State,
    config: &VmConfig,
    identity: &str,
    finished: bool,
) -> Result<(), TfaceError> {
    let stored = Stored {
        bounds: state.bounds,
        size: state.size,
        mask: state.mask.as_ref(),
        record: FieldRecord::of(config),
    };
    let mut tensors = stored.tensors();
    for ((name, p), m) in NAMES.iter().zip([&state.density, &state.color, &state.network]).zip(&state.moments)
    {
        let values = super::state::read(p);
        let shape = vec![values.len()];
        tensors.push((format!("model.{name}"), shape.clone(), TensorValues::F32(values)));
        if !finished {
            let first = TensorValues::F32(field::values(m.first.clone()));
            let second = TensorValues::F32(field::values(m.second.clone()));
            tensors.push((format!("first.{name}"), shape.clone(), first));
            tensors.push((format!("second.{name}"), shape, second));
        }
    }
    let mut metadata = stored.metadata(identity);
    metadata.extend([
        ("step".to_owned(), state.step.to_string()),
        ("reset".to_owned(), state.reset.to_string()),
        ("moments_from".to_owned(), state.moments_from.to_string()),
        ("masked".to_owned(), u64::from(state.masked).to_string()),
        ("mean_square".to_owned(), state.mean_square.to_bits().to_string()),
        ("salt".to_owned(), state.salt.to_string()),
        ("finished".to_owned(), u64::from(finished).to_string()),
    ]);
    Ok(turns::save(dir, &tensors, &metadata)?)
}

/// The newest readable checkpoint of a stage folder, with what was wrong with a newer one; `None` where
/// there is none at all.
pub fn restore(
    dir: &Path,
    config: &VmConfig,
    identity: &str,
    device: &Device,
) -> Result<Option<(State, Vec<String>)>, TfaceError> {
    turns::restore(
        dir,
        |path| read(path, config, identity, device),
        |e| match e {
            TfaceError::Read(e) => Some(e),
            _ => None,
        },
    )
}

/// An open checkpoint.
struct Opened<'a> {
    path: &'a Path,
    tensors: BTreeMap<String, (Vec<usize>, TensorValues)>,
    metadata: BTreeMap<String, String>,
}

impl<'a> Opened<'a> {
    fn read(path: &'a Path) -> Result<Opened<'a>, TfaceError> {
        let (tensors, metadata) = read_tensors(path, &Limits::default())?;
        let file = Opened { path, tensors: tensors.into_iter().collect(), metadata };
        match file.meta("format")? {
            format if format == FORMAT => Ok(file),
            format => Err(file.wrong(format!("format is `{format}`, this build reads `{FORMAT}`"))),
        }
    }

    fn wrong(&self, reason: String) -> TfaceError {
        TfaceError::Checkpoint { path: self.path.to_owned(), reason }
    }

    fn meta(&self, key: &str) -> Result<String, TfaceError> {
        self.metadata.get(key).cloned().ok_or_else(|| self.wrong(format!("its metadata has no `{key}`")))
    }

    fn number(&self, key: &str, range: RangeInclusive<u64>) -> Result<u64, TfaceError> {
        Ok(turns::number(self.path, &self.metadata, key, range)?)
    }

    fn floats(&mut self, name: &str, len: usize) -> Result<Vec<f32>, TfaceError> {
        match self.tensors.remove(name) {
            Some((_, TensorValues::F32(v))) if v.len() == len => Ok(v),
            Some((shape, _)) => {
                Err(self.wrong(format!("tensor `{name}` has shape {shape:?}, expected {len} values of f32")))
            }
            None => Err(self.wrong(format!("tensor `{name}` is missing"))),
        }
    }

    fn integers(&mut self, name: &str) -> Result<Vec<u64>, TfaceError> {
        match self.tensors.remove(name) {
            Some((_, TensorValues::U64(v))) => Ok(v),
            _ => Err(self.wrong(format!("tensor `{name}` is missing or of another type"))),
        }
    }

    fn bounds(&mut self, name: &str) -> Result<[[f32; 3]; 2], TfaceError> {
        let v = self.floats(name, 6)?;
        let b = [[v[0], v[1], v[2]], [v[3], v[4], v[5]]];
        let sound = (0..3).all(|a| b[0][a].is_finite() && b[1][a].is_finite() && b[0][a] < b[1][a]);
        if sound { Ok(b) } else { Err(self.wrong(format!("`{name}` is no box: {b:?}"))) }
    }

    fn size(&mut self, name: &str, least: u64) -> Result<[usize; 3], TfaceError> {
        let v = self.integers(name)?;
        match v[..] {
            [x, y, z] if [x, y, z].iter().all(|n| (least..=1 << 16).contains(n)) => {
                Ok([x as usize, y as usize, z as usize])
            }
            _ => Err(self.wrong(format!("`{name}` is no grid size: {v:?}"))),
        }
    }

    /// Box, vertices and mask.
    fn geometry(&mut self) -> Result<([[f32; 3]; 2], [usize; 3], Option<BoxMask>), TfaceError> {
        let bounds = self.bounds("bounds")?;
        let size = self.size("size", 2)?;
        if !self.tensors.contains_key("mask.bounds") {
            return Ok((bounds, size, None));
        }
        let [low, high] = self.bounds("mask.bounds")?;
        let cells = self.size("mask.size", 1)?;
        let mask = BoxMask::from_bits(low, high, cells, self.integers("mask.bits")?)
            .ok_or_else(|| self.wrong("the alpha mask has another number of cells".into()))?;
        Ok((bounds, size, Some(mask)))
    }

    fn models(&mut self, lengths: [usize; 3]) -> Result<[Vec<f32>; 3], TfaceError> {
        let mut models = [const { Vec::new() }; 3];
        for ((name, len), model) in NAMES.iter().zip(lengths).zip(&mut models) {
            *model = self.floats(&format!("model.{name}"), len)?;
        }
        Ok(models)
    }
}

/// Reads one file; sizes and types must be exactly the configured model's.
fn read(path: &Path, config: &VmConfig, identity: &str, device: &Device) -> Result<State, TfaceError> {
    let mut file = Opened::read(path)?;
    if file.meta("identity")? != identity {
        return Err(file.wrong("it was trained with other settings or inputs".into()));
    }
    let finished = file.number("finished", 0..=1)? == 1;
    // a finished one has no moments to go on with
    let step = file.number("step", if finished { config.steps } else { 0 }..=config.steps)?;
    let (reset, moments_from) = (file.number("reset", 0..=step)?, file.number("moments_from", 0..=step)?);
    let (bounds, size, mask) = file.geometry()?;
    let (density, color) = grids(config, size);
    let lengths = [density.len(), color.len(), decoder(config).len()];
    let [density, color, network] = file.models(lengths)?.map(|v| param(v, device));
    let mut moments = super::state::no_moments([1; 3], device);
    if !finished {
        for ((name, len), m) in NAMES.iter().zip(lengths).zip(&mut moments) {
            let first = field::tensor(file.floats(&format!("first.{name}"), len)?, [len], device);
            let second = format!("second.{name}");
            let values = turns::second_moments(path, &second, file.floats(&second, len)?)?;
            *m = Moments { first, second: field::tensor(values, [len], device) };
        }
    }
    Ok(State {
        bounds,
        size,
        density,
        color,
        network,
        moments,
        mask,
        step,
        reset,
        moments_from,
        masked: file.number("masked", 0..=1)? == 1,
        mean_square: turns::mean_square(path, &file.metadata)?,
        salt: file.number("salt", 0..=1)?,
    })
}
