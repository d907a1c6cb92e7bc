//! Checkpoints: everything needed to resume the training of a field, in one safetensors file.
//!
//! A file holds named tensors (`model.` for values, `first.` and `second.` for the optimizer's
//! moments, and others by field) and a header of strings: `format`, `identity` (settings, inputs
//! and seed of the training), `finished`, `step` and others by field. Two files alternate, so that
//! the newest complete checkpoint is never replaced before its successor is written, and a
//! checkpoint that fails validation falls back to the previous one.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use tiface_base::io::{
    Limits, ReadError, TensorValues, Tensors, WriteError, is_file, read_tensors, remove, rename,
    tensor_bytes, write_tensors,
};
use tiface_base::{Error, ErrorKind, Result};

/// The checkpoint of one training, in memory.
#[derive(Clone, Debug)]
pub struct Checkpoint {
    path: PathBuf,
    stage: &'static str,
    tensors: BTreeMap<String, (Vec<usize>, TensorValues)>,
    header: BTreeMap<String, String>,
}

/// Returns the path of a stage folder's newest checkpoint.
pub fn newest(dir: &Path) -> PathBuf {
    dir.join("checkpoint.safetensors")
}

fn previous(dir: &Path) -> PathBuf {
    dir.join("checkpoint.previous.safetensors")
}

fn next(dir: &Path) -> PathBuf {
    dir.join("checkpoint.next.safetensors")
}

/// Removes the previous checkpoint, which a completed training no longer needs.
pub fn finish(dir: &Path) -> Result<()> {
    Ok(remove(&previous(dir))?)
}

/// Returns whether this is the name of a checkpoint that a completed training no longer needs.
pub fn is_old(name: &str) -> bool {
    [previous, next].iter().any(|path| path(Path::new("")) == Path::new(name))
}

/// Returns the bytes of a finished checkpoint of a stage without the optimizer's moments, which
/// only a training that goes on reads; `None` if it is not finished, has no moments, or is of
/// another format than these.
pub fn without_moments(path: &Path, stage: &'static str, formats: &[&str]) -> Result<Option<Vec<u8>>> {
    let (tensors, header) = read_tensors(path, &Limits::default()).map_err(|e| unreadable(e, stage))?;
    let says = |key: &str, words: &[&str]| header.get(key).is_some_and(|word| words.contains(&word.as_str()));
    let (moments, kept): (Vec<_>, Vec<_>) = tensors
        .into_iter()
        .map(|(name, (shape, v))| (name, shape, v))
        .partition(|(name, ..)| is_moment(name));
    if moments.is_empty() || !says("finished", &["1"]) || !says("format", formats) {
        return Ok(None);
    }
    let bytes = tensor_bytes(&kept, &header).map_err(|problem| WriteError::content(path, problem))?;
    Ok(Some(bytes))
}

fn is_moment(name: &str) -> bool {
    ["first.", "second."].iter().any(|prefix| name.starts_with(prefix))
}

/// Returns the hint for errors that no checkpoint of a stage can recover from.
fn restart_hint(stage: &str) -> String {
    format!("start the stage again with `--fresh {stage}`")
}

fn unreadable(e: ReadError, stage: &str) -> Error {
    let hint = if matches!(e, ReadError::Io { .. }) { e.hint() } else { restart_hint(stage) };
    Error::cannot(e, hint)
}

impl Checkpoint {
    /// Returns a checkpoint without tensors. `stage` is the settings table that messages name;
    /// `identity` identifies settings, inputs and seed of the training.
    pub fn new(stage: &'static str, format: &str, identity: &str) -> Checkpoint {
        let mut empty =
            Checkpoint { path: PathBuf::new(), stage, tensors: BTreeMap::new(), header: BTreeMap::new() };
        empty.set("format", format);
        empty.set("identity", identity);
        empty
    }

    /// Reads a checkpoint file of the given format.
    pub fn read(path: &Path, stage: &'static str, format: &str) -> Result<Checkpoint> {
        let content = read_tensors(path, &Limits::default()).map_err(|e| unreadable(e, stage))?;
        Checkpoint::parse(path, stage, format, content)
    }

    fn parse(
        path: &Path,
        stage: &'static str,
        format: &str,
        (tensors, header): Tensors,
    ) -> Result<Checkpoint> {
        let file = Checkpoint { path: path.into(), stage, tensors, header };
        match file.text("format")? {
            found if found == format => Ok(file),
            found => Err(file.mismatch(format!("format is `{found}`, this build reads `{format}`"))),
        }
    }

    /// Sets an entry of the header.
    pub fn set(&mut self, key: &str, value: impl ToString) {
        self.header.insert(key.into(), value.to_string());
    }

    /// Adds a tensor.
    pub fn put(&mut self, name: &str, shape: &[usize], values: TensorValues) {
        self.tensors.insert(name.into(), (shape.to_vec(), values));
    }

    /// Adds a tensor of floats.
    pub fn put_floats(&mut self, name: &str, shape: &[usize], values: Vec<f32>) {
        self.put(name, shape, TensorValues::F32(values));
    }

    /// Adds a vector of unsigned integers.
    pub fn put_words(&mut self, name: &str, values: Vec<u64>) {
        self.put(name, &[values.len()], TensorValues::U64(values));
    }

    /// Writes the checkpoint as the newest of a stage folder; the newest so far becomes the
    /// previous one.
    pub fn save(self, dir: &Path) -> Result<()> {
        let path = newest(dir);
        let next = next(dir);
        let tensors: Vec<_> = self.tensors.into_iter().map(|(name, (shape, v))| (name, shape, v)).collect();
        write_tensors(&next, &tensors, &self.header)?;
        if is_file(&path) {
            rename(&path, &previous(dir))?;
        }
        Ok(rename(&next, &path)?)
    }

    /// Returns the error for a checkpoint that does not match the model reading it.
    pub fn mismatch(&self, reason: String) -> Error {
        Error::cannot(format!("`{}`: {reason}", self.path.display()), restart_hint(self.stage))
    }

    /// Returns an entry of the header.
    pub fn text(&self, key: &str) -> Result<&str> {
        let text = self.header.get(key).map(|text| text.as_str());
        text.ok_or_else(|| self.mismatch(format!("its metadata has no `{key}`")))
    }

    /// Returns an integer from the header; a value outside `range` is an error, because no training
    /// writes one.
    pub fn number(&self, key: &str, range: RangeInclusive<u64>) -> Result<u64> {
        let found = self.header.get(key);
        found.and_then(|text| text.parse().ok()).filter(|n| range.contains(n)).ok_or_else(|| {
            let found = found.map_or("missing".into(), |text| format!("`{text}`"));
            let expected = format!("a whole number from {} to {}", range.start(), range.end());
            self.unexpected(key, found, expected)
        })
    }

    /// [`Checkpoint::number`] of an entry that early versions of a format lack.
    pub fn number_or(&self, key: &str, missing: u64, range: RangeInclusive<u64>) -> Result<u64> {
        if self.header.contains_key(key) { self.number(key, range) } else { Ok(missing) }
    }

    fn unexpected(&self, key: &str, found: impl ToString, expected: impl Into<String>) -> Error {
        Error::cannot(ReadError::value(&self.path, key, found, expected), restart_hint(self.stage))
    }

    /// Returns whether the checkpoint holds a tensor.
    pub fn has(&self, name: &str) -> bool {
        self.tensors.contains_key(name)
    }

    /// Returns whether the checkpoint holds the optimizer's moments, which a finished one may lack.
    pub fn has_moments(&self) -> bool {
        self.tensors.keys().any(|name| is_moment(name))
    }

    /// Removes and returns a tensor of floats, which must have exactly this shape.
    pub fn floats(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>> {
        match self.tensors.remove(name) {
            None => Err(self.mismatch(format!("tensor `{name}` is missing"))),
            Some((found, _)) if found != shape => {
                Err(self.mismatch(format!("tensor `{name}` has shape {found:?}, expected {shape:?}")))
            }
            Some((_, TensorValues::F32(values))) => Ok(values),
            Some(_) => Err(self.mismatch(format!("tensor `{name}` is not f32"))),
        }
    }

    /// Removes and returns a tensor of non-negative floats, such as mean squares, whose roots will
    /// be taken.
    pub fn squares(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>> {
        let values = self.floats(name, shape)?;
        match values.iter().position(|v| *v < 0.0) {
            None => Ok(values),
            Some(i) => {
                let found = format!("{} at index {i}", values[i]);
                Err(self.unexpected(&format!("tensor {name}"), found, "numbers, 0 or more"))
            }
        }
    }

    /// Removes and returns a vector of unsigned integers.
    pub fn words(&mut self, name: &str) -> Result<Vec<u64>> {
        match self.tensors.remove(name) {
            Some((_, TensorValues::U64(values))) => Ok(values),
            _ => Err(self.mismatch(format!("tensor `{name}` is missing or of another type"))),
        }
    }
}

/// Progress of a training.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TrainingProgress {
    /// Optimizer steps done.
    pub step: u64,
    /// Running mean of the squared color error, for the displayed PSNR.
    pub mean_square: f64,
    /// Value mixed into the seed: 1 after a step diverged, so that other rays are drawn.
    pub salt: u64,
}

impl TrainingProgress {
    /// Returns the PSNR of the last batches in dB.
    pub fn psnr(&self) -> f64 {
        -10.0 * self.mean_square.max(1e-12).log10()
    }

    /// Writes the progress into a checkpoint, with the exact bits of the running mean.
    pub fn save(&self, into: &mut Checkpoint, finished: bool) {
        into.set("step", self.step);
        into.set("mean_square", self.mean_square.to_bits());
        into.set("salt", self.salt);
        into.set("finished", u64::from(finished));
    }

    /// Reads the progress from a checkpoint of a training of `steps` steps, and whether the
    /// training had finished.
    pub fn restore(from: &Checkpoint, steps: u64) -> Result<(TrainingProgress, bool)> {
        // Early versions of the format have no `finished` entry.
        let finished = from.number_or("finished", 0, 0..=1)? == 1;
        // A finished checkpoint may lack moments, so it cannot be continued to more steps.
        let step = from.number("step", if finished { steps } else { 0 }..=steps)?;
        let key = "mean_square";
        let mean_square = f64::from_bits(from.number(key, 0..=u64::MAX)?);
        if !mean_square.is_finite() || mean_square < 0.0 {
            let expected = "the bits of a finite number, 0 or more";
            return Err(from.unexpected(key, mean_square, expected));
        }
        Ok((TrainingProgress { step, mean_square, salt: from.number("salt", 0..=1)? }, finished))
    }
}

/// Restores the newest checkpoint of a stage folder that `read` accepts, and returns it with
/// warnings about a newer one that it refused. Returns `None` if the folder has no checkpoint. A
/// checkpoint of another identity is refused.
pub fn restore<T>(
    dir: &Path,
    stage: &'static str,
    format: &str,
    identity: &str,
    mut read: impl FnMut(&mut Checkpoint) -> Result<T>,
) -> Result<Option<(T, Vec<String>)>> {
    let mut warnings = Vec::new();
    let mut failure = None;
    for path in [newest(dir), previous(dir)] {
        if !is_file(&path) {
            continue;
        }
        let content = match read_tensors(&path, &Limits::default()) {
            // A read failure of the disk does not mean a damaged file, so no checkpoint may be
            // discarded for it.
            Err(e @ (ReadError::Io { .. } | ReadError::TooLarge { .. })) => return Err(unreadable(e, stage)),
            content => content.map_err(|e| unreadable(e, stage)),
        };
        let readable = content.is_ok();
        let opened = content.and_then(|content| {
            let file = Checkpoint::parse(&path, stage, format, content)?;
            match file.text("identity")? {
                found if found == identity => Ok(file),
                _ => Err(file.mismatch("it was trained with other settings or inputs".into())),
            }
        });
        // A checkpoint of another training or release is intact, so it is not deleted.
        let damaged = !readable || opened.is_ok();
        match opened.and_then(|mut file| read(&mut file)) {
            Ok(state) => {
                // A damaged newest checkpoint must not replace this one at the next save.
                if matches!(failure, Some((_, true))) {
                    remove(&newest(dir))?;
                }
                return Ok(Some((state, warnings)));
            }
            // A failure of the compute device does not mean a damaged file either.
            Err(e) if e.kind() == ErrorKind::NotNow => return Err(e),
            Err(e) => {
                warnings.push(format!("{e}; falling back to the checkpoint before it"));
                failure.get_or_insert((e, damaged));
            }
        }
    }
    failure.map_or(Ok(None), |(e, _)| Err(e))
}
