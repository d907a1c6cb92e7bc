//! NumPy's `.npy`: our own reader, since those at hand reserve what a header claims.
//!
//! Format: magic, version, header length (u16 in version 1, u32 in 2 and 3), a Python dictionary with
//! `descr`, `fortran_order` and `shape`, then exactly shape × size bytes (NumPy NEP 1).

use super::{Limits, ReadError, read_bytes};
use std::path::Path;

const MAGIC: &[u8] = b"\x93NUMPY";
/// A header of arrays without named fields is under 200 bytes; NumPy itself stops at 10 000.
const MAX_HEADER: usize = 64 << 10;

/// An array in row-major (C) order, whatever order the file had.
#[derive(Clone, Debug, PartialEq)]
pub struct Npy {
    /// Extents; empty for a single value.
    pub shape: Vec<usize>,
    /// The values.
    pub values: NpyValues,
}

/// The values of an [`Npy`].
#[derive(Clone, Debug, PartialEq)]
pub enum NpyValues {
    /// From `bool`.
    Bool(Vec<bool>),
    /// From any integer or float type; 64-bit integers beyond 2⁵³ are rounded. May hold NaN and Inf.
    Number(Vec<f64>),
}

impl NpyValues {
    /// How many values there are.
    pub fn len(&self) -> usize {
        match self {
            NpyValues::Bool(v) => v.len(),
            NpyValues::Number(v) => v.len(),
        }
    }

    /// Is there none?
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Is value `i` true, or a number other than 0?
    pub fn is_set(&self, i: usize) -> bool {
        match self {
            NpyValues::Bool(v) => v[i],
            NpyValues::Number(v) => v[i] != 0.0,
        }
    }
}

/// Reads a `.npy` file: bool, integers, float16/32/64 in either byte order and either array order.
/// Objects, complex numbers, strings and records are refused.
pub fn read_npy(path: &Path, limits: &Limits) -> Result<Npy, ReadError> {
    parse_npy(path, &read_bytes(path, limits)?, limits)
}

/// [`read_npy`] on bytes; `path` is only for messages.
pub fn parse_npy(path: &Path, bytes: &[u8], limits: &Limits) -> Result<Npy, ReadError> {
    let bad = |offset: usize, problem: String| ReadError::damaged(path, "npy", Some(offset as u64), problem);
    if !bytes.starts_with(MAGIC) {
        return Err(bad(0, "it does not begin with `\\x93NUMPY`".into()));
    }
    let cut = || bad(bytes.len(), "it ends inside its header".into());
    let major = *bytes.get(6).ok_or_else(cut)?;
    let (start, length) = match major {
        1 => {
            let l = bytes.get(8..10).ok_or_else(cut)?;
            (10, u16::from_le_bytes([l[0], l[1]]) as usize)
        }
        2 | 3 => {
            let l = bytes.get(8..12).ok_or_else(cut)?;
            (12, u32::from_le_bytes([l[0], l[1], l[2], l[3]]) as usize)
        }
        _ => return Err(bad(6, format!("format version {major} is unknown (1, 2 and 3 are read)"))),
    };
    if length > MAX_HEADER {
        return Err(ReadError::TooLarge {
            path: path.into(),
            what: "the npy header's length in bytes",
            found: length as u64,
            limit: MAX_HEADER as u64,
        });
    }
    let header = bytes.get(start..start + length).ok_or_else(cut)?;
    let data = &bytes[start + length..];
    let header =
        Header::parse(header).map_err(|(at, problem)| bad(start + at, format!("header: {problem}")))?;
    let kind = Kind::parse(&header.descr).ok_or_else(|| unsupported(path, &header.descr))?;

    let count = header.shape.iter().try_fold(1usize, |n, &s| n.checked_mul(s));
    let needed = count.and_then(|n| n.checked_mul(kind.size));
    let (Some(count), Some(needed)) = (count, needed) else {
        return Err(bad(start, format!("its shape {:?} has more values than can be counted", header.shape)));
    };
    if needed != data.len() {
        return Err(bad(
            start + length,
            format!(
                "shape {:?} of `{}` needs {needed} bytes, {} follow",
                header.shape,
                header.descr,
                data.len()
            ),
        ));
    }
    let decoded = (count as u64).saturating_mul(8);
    if decoded > limits.decoded_bytes {
        return Err(ReadError::TooLarge {
            path: path.into(),
            what: "the array's size in bytes",
            found: decoded,
            limit: limits.decoded_bytes,
        });
    }
    let values = if kind.letter == b'b' {
        NpyValues::Bool(row_major(data.iter().map(|&b| b != 0).collect(), &header))
    } else {
        let numbers = data.chunks_exact(kind.size).map(|c| kind.number(c)).collect();
        NpyValues::Number(row_major(numbers, &header))
    };
    Ok(Npy { shape: header.shape, values })
}

fn unsupported(path: &Path, descr: &str) -> ReadError {
    if descr.contains('O') {
        return ReadError::Unsupported {
            path: path.into(),
            what: format!("an npy array of Python objects (`{descr}`, a pickle)"),
            hint: "save plain numbers: `numpy.save(file, array.astype(float))`; pickles can run code".into(),
        };
    }
    ReadError::Unsupported {
        path: path.into(),
        what: format!("an npy array of type `{descr}`"),
        hint: "save it as bool, an integer or a float type".into(),
    }
}

/// Column-major values brought into row-major order.
fn row_major<T: Copy>(values: Vec<T>, header: &Header) -> Vec<T> {
    let shape = &header.shape;
    if !header.fortran_order || shape.len() < 2 || values.is_empty() {
        return values;
    }
    // strides of the file's order: the first index runs fastest
    let mut strides = vec![1; shape.len()];
    for k in 1..shape.len() {
        strides[k] = strides[k - 1] * shape[k - 1];
    }
    let mut index = vec![0; shape.len()];
    let mut out = Vec::with_capacity(values.len());
    let mut at = 0;
    loop {
        out.push(values[at]);
        let mut axis = shape.len() - 1;
        loop {
            index[axis] += 1;
            at += strides[axis];
            if index[axis] < shape[axis] {
                break;
            }
            at -= strides[axis] * shape[axis];
            index[axis] = 0;
            if axis == 0 {
                return out;
            }
            axis -= 1;
        }
    }
}

struct Kind {
    letter: u8,
    size: usize,
    big: bool,
}

impl Kind {
    fn parse(descr: &str) -> Option<Kind> {
        let (order, rest) = match descr.as_bytes() {
            [order @ (b'<' | b'>' | b'|' | b'='), rest @ ..] => (*order, rest),
            rest => (b'=', rest),
        };
        let (letter, size) = match rest {
            b"?" | b"b1" => (b'b', 1),
            [l @ (b'i' | b'u'), s @ (b'1' | b'2' | b'4' | b'8')] => (*l, (s - b'0') as usize),
            [b'f', s @ (b'2' | b'4' | b'8')] => (b'f', (s - b'0') as usize),
            _ => return None,
        };
        let big = order == b'>' || (order == b'=' && cfg!(target_endian = "big"));
        Some(Kind { letter, size, big })
    }

    fn number(&self, chunk: &[u8]) -> f64 {
        let mut word = 0u64;
        for i in 0..self.size {
            let byte = if self.big { chunk[i] } else { chunk[self.size - 1 - i] };
            word = word << 8 | byte as u64;
        }
        let spare = 64 - 8 * self.size as u32;
        match (self.letter, self.size) {
            (b'u', _) => word as f64,
            (b'i', _) => (((word << spare) as i64) >> spare) as f64,
            (_, 2) => from_half(word as u16),
            (_, 4) => f32::from_bits(word as u32) as f64,
            _ => f64::from_bits(word),
        }
    }
}

/// IEEE 754 binary16.
pub(super) fn from_half(h: u16) -> f64 {
    let sign = if h >> 15 == 1 { -1.0 } else { 1.0 };
    let (exponent, fraction) = ((h >> 10) & 31, (h & 1023) as f64);
    sign * match exponent {
        0 => fraction * 2f64.powi(-24),
        31 if fraction == 0.0 => f64::INFINITY,
        31 => f64::NAN,
        e => (1.0 + fraction / 1024.0) * 2f64.powi(e as i32 - 15),
    }
}

struct Header {
    descr: String,
    fortran_order: bool,
    shape: Vec<usize>,
}

impl Header {
    /// Parses the Python dictionary; an error carries its offset within the header.
    fn parse(text: &[u8]) -> Result<Header, (usize, String)> {
        let mut r = Reader { text, at: 0 };
        let (mut descr, mut order, mut shape) = (None, None, None);
        r.expect(b'{')?;
        while !r.take(b'}') {
            let key = r.string()?;
            r.expect(b':')?;
            let twice = match key.as_str() {
                "descr" => descr.replace(r.type_name()?).is_some(),
                "fortran_order" => order.replace(r.boolean()?).is_some(),
                "shape" => shape.replace(r.tuple()?).is_some(),
                _ => return Err((r.at, format!("unknown key `{key}`"))),
            };
            if twice {
                return Err((r.at, format!("the key `{key}` appears twice")));
            }
            if !r.take(b',') {
                r.expect(b'}')?;
                break;
            }
        }
        r.skip();
        if r.at != text.len() {
            return Err((r.at, "text after the dictionary".into()));
        }
        let missing = |key: &str| (r.at, format!("the key `{key}` is missing"));
        Ok(Header {
            descr: descr.ok_or_else(|| missing("descr"))?,
            fortran_order: order.ok_or_else(|| missing("fortran_order"))?,
            shape: shape.ok_or_else(|| missing("shape"))?,
        })
    }
}

struct Reader<'a> {
    text: &'a [u8],
    at: usize,
}

impl Reader<'_> {
    fn skip(&mut self) {
        while self.text.get(self.at).is_some_and(|b| b.is_ascii_whitespace()) {
            self.at += 1;
        }
    }

    fn take(&mut self, byte: u8) -> bool {
        self.skip();
        let found = self.text.get(self.at) == Some(&byte);
        self.at += found as usize;
        found
    }

    fn expect(&mut self, byte: u8) -> Result<(), (usize, String)> {
        if self.take(byte) { Ok(()) } else { Err((self.at, format!("expected `{}`", byte as char))) }
    }

    fn string(&mut self) -> Result<String, (usize, String)> {
        self.skip();
        let quote = match self.text.get(self.at) {
            Some(&q @ (b'\'' | b'"')) => q,
            _ => return Err((self.at, "expected a quoted word".into())),
        };
        let rest = &self.text[self.at + 1..];
        let end = rest.iter().position(|&b| b == quote).ok_or((self.at, "a quote is not closed".into()))?;
        self.at += end + 2;
        Ok(String::from_utf8_lossy(&rest[..end]).into_owned())
    }

    /// A quoted type, or the whole list of a record type, which then is refused by its name.
    fn type_name(&mut self) -> Result<String, (usize, String)> {
        self.skip();
        if self.text.get(self.at) != Some(&b'[') {
            return self.string();
        }
        let rest = &self.text[self.at..];
        let end = rest.iter().rposition(|&b| b == b']').ok_or((self.at, "a `[` is not closed".into()))?;
        // fields of records may have any name; only objects deserve their own message
        let objects = rest[..end].windows(2).any(|w| w == b"|O");
        self.at += end + 1;
        Ok(if objects { "record with |O".into() } else { "record".into() })
    }

    fn boolean(&mut self) -> Result<bool, (usize, String)> {
        self.skip();
        for (word, value) in [(&b"True"[..], true), (&b"False"[..], false)] {
            if self.text[self.at..].starts_with(word) {
                self.at += word.len();
                return Ok(value);
            }
        }
        Err((self.at, "expected `True` or `False`".into()))
    }

    fn tuple(&mut self) -> Result<Vec<usize>, (usize, String)> {
        self.expect(b'(')?;
        let mut shape = Vec::new();
        while !self.take(b')') {
            self.skip();
            let digits = self.text[self.at..].iter().take_while(|b| b.is_ascii_digit()).count();
            let number = std::str::from_utf8(&self.text[self.at..self.at + digits]).unwrap_or("");
            let n = number
                .parse()
                .map_err(|_| (self.at, "expected an extent, a whole number of at least 0".to_string()))?;
            if shape.len() == 32 {
                return Err((self.at, "more than 32 dimensions".into()));
            }
            shape.push(n);
            self.at += digits;
            let _ = self.text.get(self.at) == Some(&b'L') && {
                self.at += 1;
                true
            }; // Python 2 wrote 24L
            if !self.take(b',') {
                self.expect(b')')?;
                break;
            }
        }
        Ok(shape)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn npy(header: &str, data: &[u8]) -> Vec<u8> {
        let mut b = MAGIC.to_vec();
        b.extend([1, 0]);
        b.extend((header.len() as u16).to_le_bytes());
        b.extend(header.as_bytes());
        b.extend(data);
        b
    }

    fn parse(bytes: &[u8]) -> Result<Npy, ReadError> {
        parse_npy(Path::new("a.npy"), bytes, &Limits::default())
    }

    fn numbers(header: &str, data: &[u8]) -> Vec<f64> {
        match parse(&npy(header, data)).unwrap().values {
            NpyValues::Number(v) => v,
            NpyValues::Bool(_) => panic!("bool"),
        }
    }

    #[test]
    fn every_number_type_and_byte_order_reads_the_same() {
        let h = |t: &str| format!("{{'descr': '{t}', 'fortran_order': False, 'shape': (2,), }}");
        assert_eq!(numbers(&h("|u1"), &[1, 254]), [1.0, 254.0]);
        assert_eq!(numbers(&h("|i1"), &[1, 254]), [1.0, -2.0]);
        assert_eq!(numbers(&h("<i2"), &[1, 0, 0xFE, 0xFF]), [1.0, -2.0]);
        assert_eq!(numbers(&h(">i2"), &[0, 1, 0xFF, 0xFE]), [1.0, -2.0]);
        // float16: 0x3C00 = 1, 0xC000 = −2; smallest subnormal 2⁻²⁴
        assert_eq!(numbers(&h("<f2"), &[0x00, 0x3C, 0x00, 0xC0]), [1.0, -2.0]);
        assert_eq!(numbers(&h(">f2"), &[0x00, 0x01, 0x7C, 0x00]), [2f64.powi(-24), f64::INFINITY]);
        let le: Vec<u8> = [1f32, -2.0].iter().flat_map(|v| v.to_le_bytes()).collect();
        assert_eq!(numbers(&h("<f4"), &le), [1.0, -2.0]);
        let be: Vec<u8> = [1f64, -2.0].iter().flat_map(|v| v.to_be_bytes()).collect();
        assert_eq!(numbers(&h(">f8"), &be), [1.0, -2.0]);
    }

    #[test]
    fn column_major_becomes_row_major() {
        // [[1, 2, 3], [4, 5, 6]] lies in columns as 1 4 2 5 3 6
        let data = [1, 4, 2, 5, 3, 6];
        let v = numbers("{'descr': '|u1', 'fortran_order': True, 'shape': (2, 3), }", &data);
        assert_eq!(v, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
    }

    #[test]
    fn a_single_value_and_an_empty_array_have_one_and_no_value() {
        assert_eq!(numbers("{'descr': '|u1', 'fortran_order': False, 'shape': (), }", &[7]), [7.0]);
        let h = "{'descr': '|u1', 'fortran_order': True, 'shape': (0, 3), }";
        assert!(numbers(h, &[]).is_empty());
    }

    #[test]
    fn bytes_that_are_missing_or_left_over_are_an_error_with_the_place() {
        let h = "{'descr': '|b1', 'fortran_order': False, 'shape': (2,), }";
        assert_eq!(parse(&npy(h, &[1, 0])).unwrap().values, NpyValues::Bool(vec![true, false]));
        for data in [&[1][..], &[1, 0, 1]] {
            let error = parse(&npy(h, data)).unwrap_err();
            assert!(
                matches!(&error, ReadError::Damaged { offset: Some(o), .. } if *o == 10 + h.len() as u64)
            );
            assert!(error.to_string().contains("needs 2 bytes"), "{error}");
        }
    }

    #[test]
    fn a_shape_that_overflows_is_an_error_not_an_allocation() {
        for shape in
            ["(9223372036854775807, 9223372036854775807)", "(1000000000000,)", "(18446744073709551616,)"]
        {
            let h = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}");
            assert!(matches!(parse(&npy(&h, &[0; 8])), Err(ReadError::Damaged { .. })), "{shape}");
        }
    }

    #[test]
    fn objects_and_records_are_refused_by_name() {
        for (descr, word) in [
            ("'|O'", "Python objects"),
            ("[('a', '|O')]", "Python objects"),
            ("'<c16'", "<c16"),
            ("[('a', '<f4')]", "record"),
        ] {
            let h = format!("{{'descr': {descr}, 'fortran_order': False, 'shape': (1,), }}");
            let error = parse(&npy(&h, &[0; 8])).unwrap_err();
            assert!(matches!(error, ReadError::Unsupported { .. }), "{descr} {error}");
            assert!(error.to_string().contains(word), "{error}");
        }
    }
}
