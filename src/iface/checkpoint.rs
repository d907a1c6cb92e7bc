//! Everything training needs to go on, in one safetensors file.
//! How two of them take turns is [`crate::field::checkpoint`]'s.

use super::IfaceError;
use super::model::{Model, initial};
use super::occupancy::Occupancy;
use crate::config::iface::IfaceConfig;
use crate::field;
use crate::field::checkpoint as turns;
use crate::field::optimizer::Moments;
use crate::io::{Limits, TensorValues, read_tensors};
use crate::kernel::march::Bitmask;
use burn::tensor::{Device, Tensor};
use std::collections::BTreeMap;
use std::path::Path;

pub use turns::{finish, newest};

/// Version of the file's layout.
const FORMAT: &str = "tiface-iface-1";

/// Both moments of every parameter.
pub struct AllMoments {
    pub table: Moments<2>,
    pub v1: Moments<2>,
    pub g1: Moments<2>,
    pub b1: Moments<1>,
    pub v2: Moments<2>,
    pub g2: Moments<2>,
    pub b2: Moments<1>,
    pub c1: Moments<2>,
    pub c2: Moments<2>,
    pub c3: Moments<2>,
    pub variance: Moments<1>,
}

impl AllMoments {
    fn named(&self) -> Vec<(&'static str, Vec<usize>, Vec<f32>, Vec<f32>)> {
        fn read<const D: usize>(m: &Moments<D>) -> (Vec<usize>, Vec<f32>, Vec<f32>) {
            let shape = m.first.dims().to_vec();
            (shape, field::values(m.first.clone()), field::values(m.second.clone()))
        }
        let all = [
            ("table", read(&self.table)),
            ("v1", read(&self.v1)),
            ("g1", read(&self.g1)),
            ("b1", read(&self.b1)),
            ("v2", read(&self.v2)),
            ("g2", read(&self.g2)),
            ("b2", read(&self.b2)),
            ("c1", read(&self.c1)),
            ("c2", read(&self.c2)),
            ("c3", read(&self.c3)),
            ("variance", read(&self.variance)),
        ];
        all.into_iter().map(|(name, (shape, a, b))| (name, shape, a, b)).collect()
    }

    fn from_values(values: Vec<(Vec<usize>, Vec<f32>, Vec<f32>)>, device: &Device) -> AllMoments {
        let mut values = values.into_iter();
        let mut next = || values.next().expect("as many moments as parameters");
        fn moments<const D: usize>(
            (shape, a, b): (Vec<usize>, Vec<f32>, Vec<f32>),
            device: &Device,
        ) -> Moments<D> {
            let shape: [usize; D] = shape.try_into().expect("shapes were checked against the model");
            let tensor = |v| -> Tensor<D> { field::tensor(v, shape, device) };
            Moments { first: tensor(a), second: tensor(b) }
        }
        AllMoments {
            table: moments(next(), device),
            v1: moments(next(), device),
            g1: moments(next(), device),
            b1: moments(next(), device),
            v2: moments(next(), device),
            g2: moments(next(), device),
            b2: moments(next(), device),
            c1: moments(next(), device),
            c2: moments(next(), device),
            c3: moments(next(), device),
            variance: moments(next(), device),
        }
    }
}

/// Training between two steps.
pub struct State {
    /// Parameters.
    pub model: Model,
    /// Optimiser.
    pub moments: AllMoments,
    /// Cells to march through.
    pub occupancy: Occupancy,
    /// Optimiser steps done.
    pub step: u64,
    /// Rays of the next step.
    pub rays: usize,
    /// Running mean of the squared colour error, for the PSNR that is shown.
    pub mean_square: f64,
    /// Mixed into the seed: 1 after a restore from a diverged step, so that other rays are drawn.
    pub salt: u64,
}

impl State {
    /// The start, before any step.
    pub fn new(config: &IfaceConfig, seed: u64, hull: Option<&Bitmask>, device: &Device) -> State {
        let values = initial(config, seed);
        let zeros = values
            .iter()
            .map(|(_, shape, v)| (shape.clone(), vec![0.0; v.len()], vec![0.0; v.len()]))
            .collect();
        State {
            model: Model::from_values(values.into_iter().map(|(_, s, v)| (s, v)).collect(), device),
            moments: AllMoments::from_values(zeros, device),
            occupancy: Occupancy::new(config, hull),
            step: 0,
            rays: config.rays,
            mean_square: 0.0,
            salt: 0,
        }
    }
}

fn words(mask: &Bitmask) -> TensorValues {
    TensorValues::U64(mask.bits.clone())
}

/// Writes a checkpoint; `identity` names what shaped the training (settings, inputs, seed).
pub fn save(dir: &Path, state: &State, identity: &str) -> Result<(), IfaceError> {
    let mut tensors: Vec<(String, Vec<usize>, TensorValues)> = Vec::new();
    for (name, shape, values) in state.model.values() {
        tensors.push((format!("model.{name}"), shape, TensorValues::F32(values)));
    }
    for (name, shape, first, second) in state.moments.named() {
        tensors.push((format!("first.{name}"), shape.clone(), TensorValues::F32(first)));
        tensors.push((format!("second.{name}"), shape, TensorValues::F32(second)));
    }
    let o = &state.occupancy;
    tensors.push(("occupancy.occupied".into(), vec![o.occupied.bits.len()], words(&o.occupied)));
    tensors.push(("occupancy.solid".into(), vec![o.solid.bits.len()], words(&o.solid)));
    if !o.history.is_empty() {
        let history = TensorValues::F32(o.history.clone());
        tensors.push(("occupancy.history".into(), vec![o.history.len()], history));
    }
    let metadata = BTreeMap::from([
        ("format".to_owned(), FORMAT.to_owned()),
        ("identity".to_owned(), identity.to_owned()),
        ("step".to_owned(), state.step.to_string()),
        ("rays".to_owned(), state.rays.to_string()),
        ("mean_square".to_owned(), state.mean_square.to_bits().to_string()),
        ("salt".to_owned(), state.salt.to_string()),
    ]);
    Ok(turns::save(dir, &tensors, &metadata)?)
}

/// The newest readable checkpoint of a stage folder, with what was wrong with a newer one; `None` where
/// there is none at all.
pub fn restore(
    dir: &Path,
    config: &IfaceConfig,
    hull: Option<&Bitmask>,
    identity: &str,
    device: &Device,
) -> Result<Option<(State, Vec<String>)>, IfaceError> {
    turns::restore(
        dir,
        |path| read(path, config, hull, Some(identity), device),
        |e| match e {
            IfaceError::Read(e) => Some(e),
            _ => None,
        },
    )
}

/// Reads one file; names, shapes and types must be exactly the model's.
pub fn read(
    path: &Path,
    config: &IfaceConfig,
    hull: Option<&Bitmask>,
    identity: Option<&str>,
    device: &Device,
) -> Result<State, IfaceError> {
    let wrong = |reason: String| IfaceError::Checkpoint { path: path.to_owned(), reason };
    let (mut tensors, metadata) = read_tensors(path, &Limits::default())?;
    let meta =
        |key: &str| metadata.get(key).cloned().ok_or_else(|| wrong(format!("its metadata has no `{key}`")));
    let number = |key: &str, range| turns::number(path, &metadata, key, range);
    if meta("format")? != FORMAT {
        return Err(wrong(format!("format is `{}`, this build reads `{FORMAT}`", meta("format")?)));
    }
    if let Some(identity) = identity
        && meta("identity")? != identity
    {
        return Err(wrong("it was trained with other settings or inputs".into()));
    }
    let mut floats = |name: String, shape: &[usize]| -> Result<Vec<f32>, IfaceError> {
        match tensors.remove(&name) {
            None => Err(wrong(format!("tensor `{name}` is missing"))),
            Some((found, _)) if found != shape => {
                Err(wrong(format!("tensor `{name}` has shape {found:?}, expected {shape:?}")))
            }
            Some((_, TensorValues::F32(v))) => Ok(v),
            Some(_) => Err(wrong(format!("tensor `{name}` is not f32"))),
        }
    };
    let mut model = Vec::new();
    let mut moments = Vec::new();
    for (name, shape, _) in initial(config, 0) {
        model.push((shape.clone(), floats(format!("model.{name}"), &shape)?));
        let first = floats(format!("first.{name}"), &shape)?;
        let second = format!("second.{name}");
        let values = turns::second_moments(path, &second, floats(second.clone(), &shape)?)?;
        moments.push((shape.clone(), first, values));
    }
    let mut occupancy = Occupancy::new(config, hull);
    if !occupancy.history.is_empty() {
        occupancy.history = floats("occupancy.history".into(), &[occupancy.history.len()])?;
    }
    for (name, mask) in
        [("occupancy.occupied", &mut occupancy.occupied), ("occupancy.solid", &mut occupancy.solid)]
    {
        match tensors.remove(name) {
            Some((_, TensorValues::U64(bits))) if bits.len() == mask.bits.len() => mask.bits = bits,
            _ => return Err(wrong(format!("tensor `{name}` is missing or has another size"))),
        }
    }
    Ok(State {
        model: Model::from_values(model, device),
        moments: AllMoments::from_values(moments, device),
        occupancy,
        step: number("step", 0..=config.steps)?,
        rays: number("rays", 1..=config.rays.max(config.max_rays) as u64)? as usize,
        mean_square: turns::mean_square(path, &metadata)?,
        salt: number("salt", 0..=1)?,
    })
}
