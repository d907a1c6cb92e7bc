//! NumPy's `.npy`, parsed by `npyz` once the sizes that a file claims are known to be true, and
//! `.npz`, a zip archive with one `.npy` file for each array, read whole or not at all.
//!
//! Format: magic, version, header length (u16 in version 1, u32 in 2 and 3), a Python dictionary
//! with `descr`, `fortran_order` and `shape`, then exactly shape × size bytes (NumPy NEP 1). `npyz`
//! reserves what the length says, multiplies the extents unchecked, and takes twice to three times
//! as long for each bracket inside another, so all three are bounded here first.
//!
//! `numpy.savez` stores without compression; archives that a zip tool packed again are deflated.
//! Names that stand twice and bytes that entries share, the two tricks that make small files unpack
//! to large ones, are refused before anything is unpacked.

use super::limits::Limits;
use super::read::read_bytes;
use super::read_error::ReadError;
use npyz::{DType, Deserialize, NpyFile, NpyHeader, Order, TypeChar, TypeStr};
use std::path::Path;

const MAGIC: &[u8] = b"\x93NUMPY";
/// A header of arrays without named fields is under 200 bytes; NumPy itself stops at 10 000.
const MAX_HEADER: usize = 64 << 10;
/// As in NumPy 1.
const MAX_RANK: usize = 32;
/// The dictionary's own bracket and the shape's; only records have more.
const MAX_BRACKETS: usize = 2;

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
    /// From any integer or float type; 64-bit integers beyond 2⁵³ are rounded. May hold NaN and
    /// Inf.
    Number(Vec<f64>),
}

/// Reads a `.npy` file: bool, integers, float16/32/64 in either byte order and either array order.
/// Objects, complex numbers, strings and records are refused.
pub fn read_npy(path: &Path, limits: &Limits) -> Result<Npy, ReadError> {
    parse_npy(path, &read_bytes(path, limits)?, limits)
}

/// [`read_npy`] on bytes; `path` is only for messages.
///
/// ```
/// use tiface_base::io::{Limits, NpyValues, parse_npy};
///
/// let header = "{'descr': '<f4', 'fortran_order': False, 'shape': (2, 1), }";
/// let mut file = b"\x93NUMPY\x01\x00".to_vec();
/// file.extend((header.len() as u16).to_le_bytes());
/// file.extend(header.as_bytes());
/// file.extend([0.5f32, -2.0].map(f32::to_le_bytes).as_flattened());
///
/// let array = parse_npy("a.npy".as_ref(), &file, &Limits::default())?;
/// assert_eq!(array.shape, [2, 1]);
/// assert_eq!(array.values, NpyValues::Number(vec![0.5, -2.0]));
///
/// file.pop(); // cut short
/// let error = parse_npy("a.npy".as_ref(), &file, &Limits::default()).unwrap_err();
/// assert!(error.to_string().contains("shape [2, 1] of `<f4` needs 8 bytes, 7 follow"));
/// # Ok::<(), tiface_base::io::ReadError>(())
/// ```
pub fn parse_npy(path: &Path, bytes: &[u8], limits: &Limits) -> Result<Npy, ReadError> {
    let bad = |offset: usize, problem: String| ReadError::damaged(path, "npy", Some(offset as u64), problem);
    if !bytes.starts_with(MAGIC) {
        return Err(bad(0, "it does not begin with `\\x93NUMPY`".into()));
    }
    let cut = || bad(bytes.len(), "it ends inside its header".into());
    let (start, length) = match *bytes.get(6).ok_or_else(cut)? {
        1 => {
            let l = bytes.get(8..10).ok_or_else(cut)?;
            (10, u16::from_le_bytes([l[0], l[1]]) as usize)
        }
        2 | 3 => {
            let l = bytes.get(8..12).ok_or_else(cut)?;
            (12, u32::from_le_bytes([l[0], l[1], l[2], l[3]]) as usize)
        }
        major => return Err(bad(6, format!("format version {major} is unknown (1, 2 and 3 are read)"))),
    };
    if length > MAX_HEADER {
        let what = "the npy header's length in bytes";
        return Err(ReadError::too_large(path, what, length as u64, MAX_HEADER as u64));
    }
    let text = bytes.get(start..start + length).ok_or_else(cut)?;
    let data = &bytes[start + length..];
    if text.iter().filter(|b| b"[({".contains(b)).count() > MAX_BRACKETS {
        return Err(unsupported(path, &DType::Record(Vec::new())));
    }
    if !countable(text) {
        return Err(bad(start, "its shape is not of whole numbers with a product that can be held".into()));
    }
    let header = NpyHeader::from_reader(&bytes[..start + length]).map_err(|e| {
        // the first line says what and where, those below repeat the header
        let problem: String = e.to_string().lines().take(1).flat_map(|l| l.chars().take(120)).collect();
        bad(start, format!("header: {problem}"))
    })?;
    let dtype = header.dtype();
    let kind = match &dtype {
        DType::Plain(kind) if is_read(kind) => kind,
        other => return Err(unsupported(path, other)),
    };
    let shape: Vec<usize> = header.shape().iter().map(|&n| n as usize).collect();
    if shape.len() > MAX_RANK {
        return Err(bad(start, format!("it has {} dimensions, {MAX_RANK} are read", shape.len())));
    }
    let count: usize = shape.iter().product();
    let needed = kind.num_bytes().and_then(|size| size.checked_mul(count));
    if needed != Some(data.len()) {
        let needed = needed.map_or("more".into(), |n| n.to_string());
        let found = data.len();
        return Err(bad(
            start + length,
            format!("shape {shape:?} of `{kind}` needs {needed} bytes, {found} follow"),
        ));
    }
    let decoded = (count as u64).saturating_mul(8);
    if decoded > limits.decoded_bytes {
        return Err(ReadError::too_large(path, "the array's size in bytes", decoded, limits.decoded_bytes));
    }
    let values = if kind.type_char() == TypeChar::Bool {
        NpyValues::Bool(row_major(data.iter().map(|&b| b != 0).collect(), &header))
    } else {
        let numbers = numbers(kind, NpyFile::with_header(header.clone(), data));
        let numbers = numbers.ok_or_else(|| unsupported(path, &dtype))?;
        NpyValues::Number(row_major(numbers.map_err(|e| bad(start + length, e.to_string()))?, &header))
    };
    Ok(Npy { shape, values })
}

/// Returns the bytes of a `.npy` file of values that are in row-major order and of this type
/// (`<f8`, `|b1`).
pub fn npy_bytes(kind: &str, shape: &[usize], values: &[u8]) -> Vec<u8> {
    let extents: String = shape.iter().map(|n| format!("{n}, ")).collect();
    let header =
        format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': ({}), }}", extents.trim_end());
    // NumPy's own headers end with a newline on a multiple of 64
    let padded = (MAGIC.len() + 4 + header.len() + 1).next_multiple_of(64) - MAGIC.len() - 5;
    let mut file = [MAGIC, &[1, 0], &(padded as u16 + 1).to_le_bytes()].concat();
    file.extend(format!("{header:padded$}\n").into_bytes());
    file.extend(values);
    file
}

/// Returns whether the header's numbers are plain decimals whose product, with 1 for an extent of
/// 0, fits into 64 bits. The parser also accepts sums, signs, hexadecimals and `1_000`, which no
/// array needs.
fn countable(header: &[u8]) -> bool {
    let words = header.split(|b| !(b.is_ascii_alphanumeric() || b"_+-".contains(b)));
    let mut numbers = words.filter(|w| w.first().is_some_and(|b| !(b.is_ascii_alphabetic() || *b == b'_')));
    let product = numbers.try_fold(1u64, |product, word| {
        let digits = word.iter().all(u8::is_ascii_digit).then(|| std::str::from_utf8(word).ok())??;
        product.checked_mul(digits.parse::<u64>().ok()?.max(1))
    });
    product.is_some()
}

/// Returns whether the type is bool, an integer or a float of up to 64 bits.
fn is_read(kind: &TypeStr) -> bool {
    match kind.type_char() {
        TypeChar::Bool | TypeChar::Int | TypeChar::Uint => true,
        TypeChar::Float => kind.size_field() <= 8,
        _ => false,
    }
}

fn unsupported(path: &Path, dtype: &DType) -> ReadError {
    if dtype.uses_pickled_array() {
        let hint = "save plain numbers: `numpy.save(file, array.astype(float))`; pickles can run code";
        return ReadError::unsupported(path, "an npy array of Python objects (a pickle)", hint);
    }
    let what = match dtype {
        DType::Plain(kind) => format!("an npy array of type `{kind}`"),
        _ => "an npy array of records".into(),
    };
    ReadError::unsupported(path, what, "save it as bool, an integer or a float type")
}

/// Returns every number in the order of the file; `None` for a type that is none.
fn numbers(kind: &TypeStr, file: NpyFile<&[u8]>) -> Option<std::io::Result<Vec<f64>>> {
    fn each<T: Deserialize>(file: NpyFile<&[u8]>, to: fn(T) -> f64) -> Option<std::io::Result<Vec<f64>>> {
        Some(file.data::<T>().ok()?.map(|value| value.map(to)).collect())
    }
    match (kind.type_char(), kind.size_field()) {
        (TypeChar::Int, 1) => each(file, |v: i8| v.into()),
        (TypeChar::Int, 2) => each(file, |v: i16| v.into()),
        (TypeChar::Int, 4) => each(file, |v: i32| v.into()),
        (TypeChar::Int, 8) => each(file, |v: i64| v as f64),
        (TypeChar::Uint, 1) => each(file, |v: u8| v.into()),
        (TypeChar::Uint, 2) => each(file, |v: u16| v.into()),
        (TypeChar::Uint, 4) => each(file, |v: u32| v.into()),
        (TypeChar::Uint, 8) => each(file, |v: u64| v as f64),
        (TypeChar::Float, 2) => each(file, |v: half::f16| v.into()),
        (TypeChar::Float, 4) => each(file, |v: f32| v.into()),
        (TypeChar::Float, 8) => each(file, |v: f64| v),
        _ => None,
    }
}

/// Returns the values in the order of the file brought into row-major order.
fn row_major<T: Copy>(values: Vec<T>, header: &NpyHeader) -> Vec<T> {
    if header.order() == Order::C {
        return values;
    }
    let place = |mut i: usize| {
        header.shape().iter().zip(header.strides()).rev().fold(0, |at, (&size, &stride)| {
            let index = i % size as usize;
            i /= size as usize;
            at + index * stride as usize
        })
    };
    (0..values.len()).map(|i| values[place(i)]).collect()
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
    fn what_is_written_is_read_again() {
        for shape in [&[2, 3][..], &[6], &[1, 2, 3]] {
            let bytes = npy_bytes("|u1", shape, &[1, 2, 3, 4, 5, 6]);
            let array = parse(&bytes).unwrap();
            assert_eq!((&array.shape[..], bytes.len()), (shape, 128 + 6));
            assert_eq!(array.values, NpyValues::Number(vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0]));
        }
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
    fn extents_written_to_overflow_the_parser_are_an_error_not_a_panic() {
        let sums = format!("({})", "1+1+1+1,".repeat(32));
        for shape in [
            "(0, 9223372036854775807, 9223372036854775807)",
            "(0xFFFFFFFFFFFF, 0xFFFFFFFFFFFF)",
            "(1_000_000_000_000, 1_000_000_000_000)",
            "(1 +1, 1 + 1)",
            "(1e5,)",
            &sums,
        ] {
            let h = format!("{{'descr': '|u1', 'fortran_order': False, 'shape': {shape}, }}");
            assert!(matches!(parse(&npy(&h, &[])), Err(ReadError::Damaged { .. })), "{shape}");
        }
        let unclosed = "{'descr': (".to_string() + &"1,".repeat(30_000);
        let error = parse(&npy(&unclosed, &[])).unwrap_err().to_string();
        assert!(error.contains("header: ") && error.len() < 300, "{error}");
    }

    #[test]
    fn brackets_inside_brackets_are_an_error_not_a_hang() {
        for header in
            ["[".repeat(54), "{'descr': ".to_string() + &"(".repeat(60_000), "{'a': [']', [']', [".into()]
        {
            let error = parse(&npy(&header, &[])).unwrap_err();
            assert!(matches!(error, ReadError::Unsupported { .. }), "{error}");
            assert!(error.to_string().contains("records") && error.to_string().len() < 300, "{error}");
        }
    }

    #[test]
    fn objects_and_records_are_refused_by_name() {
        for (descr, word) in [
            ("'|O'", "Python objects"),
            ("[('a', '|O')]", "record"),
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
