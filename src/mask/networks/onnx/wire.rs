//! The Protocol Buffers wire format: fields of a message, read from a slice without copying.
//!
//! A field is a number and one of four kinds of value: a varint, 4 bytes, 8 bytes, or a length and that
//! many bytes. Nothing is reserved for what a length claims; a slice that is too short is an error.

/// What does not make sense, and where.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Broken {
    /// Byte of the file.
    pub at: usize,
    /// What is wrong.
    pub problem: String,
}

impl Broken {
    pub(super) fn new(at: usize, problem: impl Into<String>) -> Broken {
        Broken { at, problem: problem.into() }
    }
}

/// A message inside the file: its bytes, and where they begin.
#[derive(Clone, Copy, Debug)]
pub(super) struct Message<'a> {
    /// Its bytes.
    pub bytes: &'a [u8],
    /// Byte of the file at which they begin.
    pub at: usize,
}

/// The value of one field.
#[derive(Clone, Copy, Debug)]
pub(super) enum Value<'a> {
    /// A varint.
    Number(u64),
    /// Eight bytes: a double or a fixed integer.
    Eight([u8; 8]),
    /// Four bytes: a float or a fixed integer.
    Four([u8; 4]),
    /// A string, bytes, a message or packed numbers.
    Bytes(Message<'a>),
}

/// One field of a message.
#[derive(Clone, Copy, Debug)]
pub(super) struct Field<'a> {
    /// Its number.
    pub number: u32,
    /// Byte of the file at which it begins.
    pub at: usize,
    /// Its value.
    pub value: Value<'a>,
}

impl<'a> Field<'a> {
    /// Its value as a message, bytes or packed numbers.
    pub(super) fn message(&self) -> Result<Message<'a>, Broken> {
        match self.value {
            Value::Bytes(m) => Ok(m),
            _ => Err(self.unfit("a length and bytes")),
        }
    }

    /// Its value as text.
    pub(super) fn text(&self) -> Result<&'a str, Broken> {
        let m = self.message()?;
        std::str::from_utf8(m.bytes).map_err(|e| Broken::new(m.at + e.valid_up_to(), "a name is not UTF-8"))
    }

    /// Its value as an integer; negative ones come as their two's complement.
    pub(super) fn integer(&self) -> Result<i64, Broken> {
        match self.value {
            Value::Number(v) => Ok(v as i64),
            _ => Err(self.unfit("an integer")),
        }
    }

    fn unfit(&self, wanted: &str) -> Broken {
        Broken::new(self.at, format!("field {} is not {wanted}", self.number))
    }
}

impl<'a> Message<'a> {
    /// Its fields in order; stops at the first that is broken.
    pub(super) fn fields(self) -> Fields<'a> {
        Fields { message: self, next: 0 }
    }

    /// A varint at `at` (relative), and where it ends.
    pub(super) fn varint(&self, mut at: usize) -> Result<(u64, usize), Broken> {
        let begin = at;
        let mut value = 0u64;
        for shift in (0..64).step_by(7) {
            let Some(&byte) = self.bytes.get(at) else {
                return Err(Broken::new(self.at + begin, "the file ends inside a number"));
            };
            at += 1;
            let part = u64::from(byte & 0x7f);
            if shift == 63 && part > 1 {
                break;
            }
            value |= part << shift;
            if byte & 0x80 == 0 {
                return Ok((value, at));
            }
        }
        Err(Broken::new(self.at + begin, "a number has more than 64 bits"))
    }
}

/// Iterator over the fields of a message.
pub(super) struct Fields<'a> {
    message: Message<'a>,
    next: usize,
}

impl<'a> Fields<'a> {
    fn read(&mut self) -> Result<Field<'a>, Broken> {
        let m = self.message;
        let at = m.at + self.next;
        let (key, after) = m.varint(self.next)?;
        let number = u32::try_from(key >> 3).unwrap_or(0);
        if number == 0 || number > 0x1fff_ffff {
            return Err(Broken::new(at, format!("{} is no field number", key >> 3)));
        }
        let take = |begin: usize, length: u64| -> Result<&'a [u8], Broken> {
            let left = m.bytes.len() - begin;
            if length > left as u64 {
                let problem = format!("field {number} announces {length} bytes, but {left} are left");
                return Err(Broken::new(at, problem));
            }
            Ok(&m.bytes[begin..begin + length as usize])
        };
        let (value, end) = match key & 7 {
            0 => {
                let (v, end) = m.varint(after)?;
                (Value::Number(v), end)
            }
            1 => {
                let mut eight = [0; 8];
                eight.copy_from_slice(take(after, 8)?);
                (Value::Eight(eight), after + 8)
            }
            2 => {
                let (length, begin) = m.varint(after)?;
                let bytes = take(begin, length)?;
                (Value::Bytes(Message { bytes, at: m.at + begin }), begin + bytes.len())
            }
            5 => {
                let mut four = [0; 4];
                four.copy_from_slice(take(after, 4)?);
                (Value::Four(four), after + 4)
            }
            kind => return Err(Broken::new(at, format!("field {number} is of the unknown kind {kind}"))),
        };
        self.next = end;
        Ok(Field { number, at, value })
    }
}

impl<'a> Iterator for Fields<'a> {
    type Item = Result<Field<'a>, Broken>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.next >= self.message.bytes.len() {
            return None;
        }
        let field = self.read();
        if field.is_err() {
            self.next = self.message.bytes.len();
        }
        Some(field)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fields(bytes: &[u8]) -> Result<Vec<Field<'_>>, Broken> {
        Message { bytes, at: 0 }.fields().collect()
    }

    #[test]
    fn the_example_of_the_format_description_reads_as_150() {
        // field 1, varint: 08, then 96 01 = 0x16 + 1 · 128 = 150
        let found = fields(&[0x08, 0x96, 0x01]).unwrap();
        assert!(matches!(found[..], [Field { number: 1, value: Value::Number(150), .. }]));
    }

    #[test]
    fn a_length_beyond_the_end_is_an_error_and_reserves_nothing() {
        // field 1, length 2⁶⁴ − 1
        let mut bytes = vec![0x0a];
        bytes.extend([0xff; 9]);
        bytes.push(0x01);
        assert!(fields(&bytes).unwrap_err().problem.contains("announces 18446744073709551615"));
    }

    #[test]
    fn an_endless_number_and_an_unknown_kind_are_errors() {
        assert!(fields(&[0x08, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0x7f]).is_err());
        assert!(fields(&[0x08, 0x80]).is_err());
        assert!(fields(&[0x0b]).is_err());
    }
}
