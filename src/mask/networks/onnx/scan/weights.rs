//! One tensor: its data must be there, all of it and no more, and its weights must be numbers.

use super::numbers::{Check, INT64, SMALL, STRING, bits, integers};
use super::{
    Broken, Fault, HINT_DAMAGED, HINT_EXPORT, HINT_EXTERNAL, MAX_RANK, Message, Tensor, Walk, once, refused,
    shown,
};

impl<'a> Walk<'a> {
    /// Looks through one tensor; its data must be there, all of it and no more.
    pub(super) fn tensor(&mut self, message: Message<'a>) -> Result<Tensor<'a>, Fault> {
        self.part()?;
        let mut name = "";
        let (mut kind, mut raw, mut place) = (None, None, None);
        let mut dims: Vec<i64> = Vec::new();
        let mut counted = 0u64;
        let mut check = Check::default();
        let mut lists = Vec::new();
        for field in message.fields() {
            let field = field?;
            match field.number {
                1 => integers(&field, |v| {
                    if dims.len() <= MAX_RANK {
                        dims.push(v);
                    }
                })?,
                2 => once(&mut kind, field.integer()?, &field)?,
                4 | 5 | 7 | 10 | 11 => lists.push(field),
                6 => {
                    self.part()?;
                    counted += 1;
                }
                8 => name = field.text()?,
                9 => once(&mut raw, field.message()?, &field)?,
                13 => return refused(elsewhere(field.message()?)?, HINT_EXTERNAL),
                14 => once(&mut place, field.integer()?, &field)?,
                16 => self.aside(&field)?,
                _ => {}
            }
        }
        if place.unwrap_or(0) != 0 {
            return refused("its weights lie in another file, which it does not name", HINT_EXTERNAL);
        }
        let kind = kind.unwrap_or(0);
        let Some(bits) = bits(kind) else {
            let problem = format!("`{}` holds numbers of the unusable ONNX type {kind}", shown(name));
            return refused(problem, HINT_EXPORT);
        };
        let count = dims
            .iter()
            .try_fold(1u64, |n, &d| u64::try_from(d).ok().and_then(|d| n.checked_mul(d)))
            .filter(|n| dims.len() <= MAX_RANK && n.checked_mul(bits).is_some());
        let Some(count) = count else {
            let problem = format!("`{}` has the impossible extents {dims:?}", shown(name));
            return refused(problem, HINT_DAMAGED);
        };
        for field in &lists {
            counted += check.list(field, kind)?;
        }
        let (promised, there, unit) = match raw {
            Some(raw) if !raw.bytes.is_empty() => {
                check.raw(raw.bytes, kind);
                (bits.saturating_mul(count).div_ceil(8), raw.bytes.len() as u64, "bytes")
            }
            _ => (count, counted, "numbers"),
        };
        if promised != there || (unit == "bytes" && counted > 0) {
            let name = shown(name);
            let problem =
                format!("`{name}` promises {promised} {unit} by its extents {dims:?}, but holds {there}");
            return refused(problem, HINT_DAMAGED);
        }
        if check.nan || (check.infinite && count > 1) {
            let what = if check.nan { "NaN" } else { "infinite" };
            return refused(format!("`{}` holds weights that are {what}", shown(name)), HINT_DAMAGED);
        }
        let class = if bits >= 32 { 0 } else { 2 - usize::from(bits == 16) };
        // sizes and indices are int64 in every file, whatever the weights are
        if kind != INT64 && kind != STRING {
            self.weights[class] += count;
        }
        Ok(Tensor { name, small: (count <= SMALL as u64).then_some(check.small) })
    }
}

/// The sentence for weights in another file, with the file's name.
fn elsewhere(entry: Message<'_>) -> Result<String, Broken> {
    let (mut key, mut value) = ("", "");
    for field in entry.fields() {
        let field = field?;
        match field.number {
            1 => key = field.text()?,
            2 => value = field.text()?,
            _ => {}
        }
    }
    Ok(match key {
        "location" => format!("its weights lie in another file, `{}`", shown(value)),
        _ => "its weights lie in another file".into(),
    })
}
