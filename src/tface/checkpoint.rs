//! Everything training needs to go on, in one safetensors file; two files take turns, so that the newest
//! complete one is never replaced before its successor is on disk.

use super::TfaceError;
use super::state::{State, decoder, grids, param};
use crate::config::VmConfig;
use crate::field;
use crate::field::optimizer::Moments;
use crate::io::{Limits, TensorValues, is_file, read_tensors, remove, rename, write_tensors};
use crate::kernel::vm::mask::BoxMask;
use burn::tensor::Device;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Version of the file's layout.
const FORMAT: &str = "tiface-vm-1";

/// Where the newest checkpoint of a stage folder lies.
pub fn newest(dir: &Path) -> PathBuf {
    dir.join("checkpoint.safetensors")
}

fn previous(dir: &Path) -> PathBuf {
    dir.join("checkpoint.previous.safetensors")
}

const NAMES: [&str; 3] = ["density", "color", "network"];

/// Writes a checkpoint; `identity` names what shaped the training (settings, inputs, seed). The optimiser's
/// moments are left out of a finished one: nobody goes on from it.
pub fn save(dir: &Path, state: &State, identity: &str, finished: bool) -> Result<(), TfaceError> {
    let mut tensors: Vec<(String, Vec<usize>, TensorValues)> = Vec::new();
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
    let flat = |b: ([f32; 3], [f32; 3])| TensorValues::F32([b.0, b.1].concat());
    tensors.push(("bounds".into(), vec![2, 3], flat((state.bounds[0], state.bounds[1]))));
    let sizes = |s: [usize; 3]| TensorValues::U64(s.map(|n| n as u64).to_vec());
    tensors.push(("size".into(), vec![3], sizes(state.size)));
    if let Some(mask) = &state.mask {
        tensors.push(("mask.bounds".into(), vec![2, 3], flat(mask.bounds())));
        tensors.push(("mask.size".into(), vec![3], sizes(mask.size())));
        let bits = mask.bits().to_vec();
        tensors.push(("mask.bits".into(), vec![bits.len()], TensorValues::U64(bits)));
    }
    let metadata = BTreeMap::from([
        ("format".to_owned(), FORMAT.to_owned()),
        ("identity".to_owned(), identity.to_owned()),
        ("step".to_owned(), state.step.to_string()),
        ("reset".to_owned(), state.reset.to_string()),
        ("masked".to_owned(), u64::from(state.masked).to_string()),
        ("mean_square".to_owned(), state.mean_square.to_bits().to_string()),
        ("salt".to_owned(), state.salt.to_string()),
        ("finished".to_owned(), u64::from(finished).to_string()),
    ]);
    let path = newest(dir);
    let next = dir.join("checkpoint.next.safetensors");
    write_tensors(&next, &tensors, &metadata)?;
    if is_file(&path) {
        rename(&path, &previous(dir))?;
    }
    Ok(rename(&next, &path)?)
}

/// Removes the older checkpoint: training is complete, the newest is all anyone needs.
pub fn finish(dir: &Path) -> Result<(), TfaceError> {
    Ok(remove(&previous(dir))?)
}

/// The newest readable checkpoint of a stage folder, with what was wrong with a newer one; `None` where
/// there is none at all.
pub fn restore(
    dir: &Path,
    config: &VmConfig,
    identity: &str,
    device: &Device,
) -> Result<Option<(State, Vec<String>)>, TfaceError> {
    let mut warnings = Vec::new();
    let mut failure = None;
    for path in [newest(dir), previous(dir)] {
        if !is_file(&path) {
            continue;
        }
        match read(&path, config, Some(identity), device) {
            Ok(state) => return Ok(Some((state, warnings))),
            Err(e) => {
                warnings.push(format!("{e}; falling back to the checkpoint before it"));
                // it must not take the good one's place at the next save
                if matches!(e, TfaceError::Read(_)) && path == newest(dir) && is_file(&previous(dir)) {
                    remove(&path)?;
                }
                failure.get_or_insert(e);
            }
        }
    }
    match failure {
        Some(e) => Err(e),
        None => Ok(None),
    }
}

/// Reads one file; sizes and types must be exactly the model's.
pub fn read(
    path: &Path,
    config: &VmConfig,
    identity: Option<&str>,
    device: &Device,
) -> Result<State, TfaceError> {
    let wrong = |reason: String| TfaceError::Checkpoint { path: path.to_owned(), reason };
    let (mut tensors, metadata) = read_tensors(path, &Limits::default())?;
    let meta =
        |key: &str| metadata.get(key).cloned().ok_or_else(|| wrong(format!("its metadata has no `{key}`")));
    let number = |key: &str| -> Result<u64, TfaceError> {
        let text = meta(key)?;
        text.parse().map_err(|_| wrong(format!("`{key}` is `{text}`, not a number")))
    };
    if meta("format")? != FORMAT {
        return Err(wrong(format!("format is `{}`, this build reads `{FORMAT}`", meta("format")?)));
    }
    if let Some(identity) = identity
        && meta("identity")? != identity
    {
        return Err(wrong("it was trained with other settings or inputs".into()));
    }
    let finished = number("finished")? == 1;
    let mut take = |name: String| {
        tensors.remove(&name).map(|(_, v)| v).ok_or_else(|| wrong(format!("tensor `{name}` is missing")))
    };
    let mut floats = |name: &str, len: usize| -> Result<Vec<f32>, TfaceError> {
        match take(name.to_owned())? {
            TensorValues::F32(v) if v.len() == len => Ok(v),
            TensorValues::F32(v) => Err(wrong(format!("tensor `{name}` has {} values, not {len}", v.len()))),
            _ => Err(wrong(format!("tensor `{name}` is not f32"))),
        }
    };
    let bounds = |v: Vec<f32>, name: &str| -> Result<[[f32; 3]; 2], TfaceError> {
        let b = [[v[0], v[1], v[2]], [v[3], v[4], v[5]]];
        let sound = (0..3).all(|a| b[0][a].is_finite() && b[1][a].is_finite() && b[0][a] < b[1][a]);
        if sound { Ok(b) } else { Err(wrong(format!("`{name}` is no box: {b:?}"))) }
    };
    let own = bounds(floats("bounds", 6)?, "bounds")?;
    let mask_bounds = match floats("mask.bounds", 6) {
        Ok(v) => Some(bounds(v, "mask.bounds")?),
        Err(_) => None,
    };
    let mut integers = |name: &str| -> Result<Vec<u64>, TfaceError> {
        match tensors.remove(name) {
            Some((_, TensorValues::U64(v))) => Ok(v),
            _ => Err(wrong(format!("tensor `{name}` is missing or of another type"))),
        }
    };
    let size_of = |v: Vec<u64>, name: &str, least: u64| -> Result<[usize; 3], TfaceError> {
        match v[..] {
            [x, y, z] if [x, y, z].iter().all(|n| (least..=1 << 16).contains(n)) => {
                Ok([x as usize, y as usize, z as usize])
            }
            _ => Err(wrong(format!("`{name}` is no grid size: {v:?}"))),
        }
    };
    let size = size_of(integers("size")?, "size", 2)?;
    let mask = match mask_bounds {
        None => None,
        Some([low, high]) => {
            let size = size_of(integers("mask.size")?, "mask.size", 1)?;
            let mask = BoxMask::from_bits(low, high, size, integers("mask.bits")?);
            Some(mask.ok_or_else(|| wrong("the alpha mask has another number of cells".into()))?)
        }
    };
    let (density, color) = grids(config, size);
    let lengths = [density.len(), color.len(), decoder(config).len()];
    let mut take = |name: String, len: usize| -> Result<Vec<f32>, TfaceError> {
        match tensors.remove(&name) {
            Some((_, TensorValues::F32(v))) if v.len() == len => Ok(v),
            Some((shape, _)) => {
                Err(wrong(format!("tensor `{name}` has shape {shape:?}, expected [{len}] of f32")))
            }
            None => Err(wrong(format!("tensor `{name}` is missing"))),
        }
    };
    let mut models = Vec::new();
    let mut moments = Vec::new();
    for (name, len) in NAMES.iter().zip(lengths) {
        models.push(param(take(format!("model.{name}"), len)?, device));
        moments.push(if finished {
            Moments::zeros([1], device)
        } else {
            let mut one = |part: &str| {
                Ok::<_, TfaceError>(field::tensor(take(format!("{part}.{name}"), len)?, [len], device))
            };
            Moments { first: one("first")?, second: one("second")? }
        });
    }
    let three = |_| wrong("it does not hold three parameters".into());
    let [density, color, network]: [_; 3] = models.try_into().map_err(|_| three(()))?;
    Ok(State {
        bounds: own,
        size,
        density,
        color,
        network,
        moments: moments.try_into().map_err(|_| three(()))?,
        mask,
        step: number("step")?,
        reset: number("reset")?,
        masked: number("masked")? == 1,
        mean_square: f64::from_bits(number("mean_square")?),
        salt: number("salt")?,
    })
}
