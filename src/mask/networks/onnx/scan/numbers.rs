//! The numbers of a tensor in each way ONNX stores them: raw, or as a list of the message.

use super::super::wire::{Broken, Field, Value};

/// As many numbers are remembered of a tensor: sizes are made of these.
pub(super) const SMALL: usize = 16;
pub(super) const FLOAT: i64 = 1;
const INT32: i64 = 6;
pub(super) const INT64: i64 = 7;
pub(super) const STRING: i64 = 8;
pub(super) const FLOAT16: i64 = 10;
const DOUBLE: i64 = 11;
const BFLOAT16: i64 = 16;

/// Bits of one number of an ONNX type; `None` for those that no weight has.
pub(super) fn bits(kind: i64) -> Option<u64> {
    Some(match kind {
        INT64 | DOUBLE | 13 => 64,
        FLOAT | INT32 | 12 => 32,
        4 | 5 | FLOAT16 | BFLOAT16 => 16,
        2 | 3 | STRING | 9 | 17..=20 => 8,
        21 | 22 => 4,
        _ => return None,
    })
}

/// What the numbers of one tensor are like.
#[derive(Default)]
pub(super) struct Check {
    pub nan: bool,
    pub infinite: bool,
    pub small: Vec<f64>,
}

impl Check {
    fn number(&mut self, v: f64) {
        self.nan |= v.is_nan();
        self.infinite |= v.is_infinite();
        if self.small.len() < SMALL {
            self.small.push(v);
        }
    }

    /// Numbers as they lie in memory, little-endian.
    pub fn raw(&mut self, bytes: &[u8], kind: i64) {
        match kind {
            FLOAT => bytes.as_chunks().0.iter().for_each(|b| self.number(f64::from(f32::from_le_bytes(*b)))),
            DOUBLE => bytes.as_chunks().0.iter().for_each(|b| self.number(f64::from_le_bytes(*b))),
            FLOAT16 | BFLOAT16 => {
                bytes.as_chunks().0.iter().for_each(|b| self.number(half(u16::from_le_bytes(*b), kind)));
            }
            INT64 => bytes.as_chunks().0.iter().for_each(|b| self.number(i64::from_le_bytes(*b) as f64)),
            INT32 => bytes.as_chunks().0.iter().for_each(|b| self.number(f64::from(i32::from_le_bytes(*b)))),
            _ => {}
        }
    }

    /// Numbers as a list of the message; how many there were.
    pub fn list(&mut self, field: &Field<'_>, kind: i64) -> Result<u64, Broken> {
        let mut n = 0;
        match field.number {
            4 => floats(field, |v| {
                n += 1;
                self.number(f64::from(v));
                true
            })?,
            10 => match field.value {
                Value::Eight(b) => {
                    n += 1;
                    self.number(f64::from_le_bytes(b));
                }
                Value::Bytes(m) if m.bytes.len() % 8 == 0 => {
                    for b in m.bytes.as_chunks().0 {
                        n += 1;
                        self.number(f64::from_le_bytes(*b));
                    }
                }
                _ => return Err(Broken::new(field.at, "a list of doubles is cut short")),
            },
            _ => integers(field, |v| {
                n += 1;
                let halves = field.number == 5 && (kind == FLOAT16 || kind == BFLOAT16);
                self.number(if halves { half(v as u16, kind) } else { v as f64 });
            })?,
        }
        Ok(n)
    }
}

/// A 16-bit float of either kind, exactly enough to know its size and whether it is a number.
fn half(word: u16, kind: i64) -> f64 {
    if kind == BFLOAT16 {
        return f64::from(f32::from_bits(u32::from(word) << 16));
    }
    let (exponent, fraction) = (i32::from(word >> 10 & 31), f64::from(word & 1023));
    let size = match (exponent, word & 1023) {
        (31, 0) => f64::INFINITY,
        (31, _) => f64::NAN,
        (0, _) => fraction * 2f64.powi(-24),
        _ => (1.0 + fraction / 1024.0) * 2f64.powi(exponent - 15),
    };
    if word >> 15 == 1 { -size } else { size }
}

/// Calls `each` with the integers of a field, packed or one by one.
pub(super) fn integers(field: &Field<'_>, mut each: impl FnMut(i64)) -> Result<(), Broken> {
    match field.value {
        Value::Number(v) => each(v as i64),
        Value::Bytes(m) => {
            let mut at = 0;
            while at < m.bytes.len() {
                let (v, next) = m.varint(at)?;
                each(v as i64);
                at = next;
            }
        }
        _ => return Err(Broken::new(field.at, "a list of integers holds something else")),
    }
    Ok(())
}

/// Calls `sound` with the floats of a field, packed or one by one; false is an error.
pub(super) fn floats(field: &Field<'_>, mut sound: impl FnMut(f32) -> bool) -> Result<(), Broken> {
    let all = match field.value {
        Value::Four(b) => sound(f32::from_le_bytes(b)),
        Value::Bytes(m) if m.bytes.len() % 4 == 0 => {
            m.bytes.as_chunks().0.iter().all(|b| sound(f32::from_le_bytes(*b)))
        }
        _ => return Err(Broken::new(field.at, "a list of floats is cut short")),
    };
    if all { Ok(()) } else { Err(Broken::new(field.at, "a setting is NaN")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sixteen_bit_floats_are_read_as_their_tables_say() {
        // sign 0, exponent 15, fraction 512: 1.5; largest 65504; smallest 2⁻²⁴
        for (word, value) in [(0x3e00, 1.5), (0xbe00, -1.5), (0x7bff, 65504.0), (1, 2f64.powi(-24))] {
            assert_eq!(half(word, FLOAT16), value);
        }
        assert!(half(0x7c01, FLOAT16).is_nan() && half(0x7fc0, BFLOAT16).is_nan());
        assert_eq!(half(0xfc00, FLOAT16), f64::NEG_INFINITY);
        assert_eq!(half(0x3fc0, BFLOAT16), 1.5);
    }
}
