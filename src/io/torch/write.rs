//! A checkpoint as `torch.save` would write it: pickle protocol 2 and CPU storages in a stored zip.

use super::{TorchNumbers, TorchTensor, TorchValue};

/// The archive's folder; torch takes the name of the file without its ending, any will do.
const ROOT: &str = "archive";
/// torch aligns storages so, and can then map them.
const ALIGNMENT: usize = 64;

/// The bytes of a checkpoint that `torch.load` reads: dictionaries stay what they were, tensors come back
/// as CPU tensors, arrays as numpy arrays. The same content gives the same bytes.
pub fn torch_bytes(value: &TorchValue) -> Vec<u8> {
    let mut pickle = Pickle { out: vec![0x80, 2], storages: Vec::new() };
    pickle.value(value);
    pickle.out.push(b'.');
    let mut zip = Zip { out: Vec::new(), entries: Vec::new() };
    zip.entry("data.pkl", &pickle.out);
    zip.entry("byteorder", b"little");
    for (i, numbers) in pickle.storages.iter().enumerate() {
        zip.entry(&format!("data/{i}"), &raw(numbers));
    }
    zip.entry("version", b"3\n");
    zip.finish()
}

fn raw(numbers: &TorchNumbers) -> Vec<u8> {
    match numbers {
        TorchNumbers::F32(v) => v.iter().flat_map(|x| x.to_le_bytes()).collect(),
        TorchNumbers::I64(v) => v.iter().flat_map(|x| x.to_le_bytes()).collect(),
        TorchNumbers::U8(v) => v.clone(),
        TorchNumbers::Bool(v) => v.iter().map(|&b| b as u8).collect(),
    }
}

struct Pickle<'a> {
    out: Vec<u8>,
    storages: Vec<&'a TorchNumbers>,
}

impl<'a> Pickle<'a> {
    fn value(&mut self, value: &'a TorchValue) {
        match value {
            TorchValue::None => self.out.push(b'N'),
            TorchValue::Bool(b) => self.bool(*b),
            TorchValue::Int(i) => self.int(*i),
            TorchValue::Float(x) => {
                self.out.push(b'G');
                self.out.extend(x.to_be_bytes());
            }
            TorchValue::Str(text) => self.text(text),
            TorchValue::Bytes(bytes) => self.bytes(bytes),
            TorchValue::List(items) => {
                self.out.extend(b"](");
                items.iter().for_each(|item| self.value(item));
                self.out.push(b'e');
            }
            TorchValue::Tuple(items) => {
                self.out.push(b'(');
                items.iter().for_each(|item| self.value(item));
                self.out.push(b't');
            }
            TorchValue::Dict(pairs) => {
                self.out.push(b'}');
                self.pairs(pairs);
            }
            TorchValue::OrderedDict(pairs) => {
                self.global("collections", "OrderedDict");
                self.out.extend(b")R");
                self.pairs(pairs);
            }
            TorchValue::Tensor(tensor) => self.tensor(tensor),
            TorchValue::Array(array) => self.array(array),
        }
    }

    fn pairs(&mut self, pairs: &'a [(std::sync::Arc<str>, TorchValue)]) {
        self.out.push(b'(');
        for (key, value) in pairs {
            self.text(key);
            self.value(value);
        }
        self.out.push(b'u');
    }

    fn bool(&mut self, value: bool) {
        self.out.push(if value { 0x88 } else { 0x89 });
    }

    fn int(&mut self, value: i64) {
        match i32::try_from(value) {
            Ok(small) => {
                self.out.push(b'J');
                self.out.extend(small.to_le_bytes());
            }
            Err(_) => {
                self.out.extend([0x8a, 8]);
                self.out.extend(value.to_le_bytes());
            }
        }
    }

    fn text(&mut self, text: &str) {
        self.out.push(b'X');
        self.out.extend((text.len() as u32).to_le_bytes());
        self.out.extend(text.as_bytes());
    }

    /// Protocol 2 has no bytes: they travel as text of code points 0 to 255.
    fn bytes(&mut self, bytes: &[u8]) {
        self.global("_codecs", "encode");
        self.out.push(b'(');
        self.text(&bytes.iter().map(|&b| b as char).collect::<String>());
        self.text("latin1");
        self.out.extend(b"tR");
    }

    fn global(&mut self, module: &str, name: &str) {
        self.out.extend(format!("c{module}\n{name}\n").as_bytes());
    }

    fn sizes(&mut self, sizes: &[usize]) {
        self.out.push(b'(');
        sizes.iter().for_each(|&size| self.int(size as i64));
        self.out.push(b't');
    }

    fn tensor(&mut self, tensor: &'a TorchTensor) {
        self.global("torch._utils", "_rebuild_tensor_v2");
        self.out.extend(b"((");
        self.text("storage");
        self.global(
            "torch",
            match tensor.values {
                TorchNumbers::F32(_) => "FloatStorage",
                TorchNumbers::I64(_) => "LongStorage",
                TorchNumbers::U8(_) => "ByteStorage",
                TorchNumbers::Bool(_) => "BoolStorage",
            },
        );
        self.text(&self.storages.len().to_string());
        self.text("cpu");
        self.int(tensor.values.len() as i64);
        self.out.extend(b"tQ");
        self.storages.push(&tensor.values);
        self.int(0);
        self.sizes(&tensor.shape);
        let mut strides = vec![1; tensor.shape.len()];
        for k in (1..strides.len()).rev() {
            strides[k - 1] = strides[k] * tensor.shape[k].max(1);
        }
        self.sizes(&strides);
        self.bool(false);
        self.global("collections", "OrderedDict");
        self.out.extend(b")RtR");
    }

    fn array(&mut self, array: &'a TorchTensor) {
        self.global("numpy.core.multiarray", "_reconstruct");
        self.out.push(b'(');
        self.global("numpy", "ndarray");
        self.sizes(&[0]);
        self.bytes(b"b");
        self.out.extend(b"tR(");
        self.int(1);
        self.sizes(&array.shape);
        let (code, order) = match array.values {
            TorchNumbers::F32(_) => ("f4", "<"),
            TorchNumbers::I64(_) => ("i8", "<"),
            TorchNumbers::U8(_) => ("u1", "|"),
            TorchNumbers::Bool(_) => ("b1", "|"),
        };
        self.global("numpy", "dtype");
        self.out.push(b'(');
        self.text(code);
        self.bool(false);
        self.bool(true);
        self.out.extend(b"tR(");
        self.int(3);
        self.text(order);
        self.out.extend(b"NNN");
        self.int(-1);
        self.int(-1);
        self.int(0);
        self.out.extend(b"tb");
        self.bool(false);
        self.bytes(&raw(&array.values));
        self.out.extend(b"tb");
    }
}

struct Zip {
    out: Vec<u8>,
    entries: Vec<Entry>,
}

struct Entry {
    name: String,
    crc: u32,
    size: u64,
    offset: u64,
}

impl Zip {
    /// A stored entry; sizes stand in the zip64 field always, as torch writes them, so that a field of any
    /// size takes the same way.
    fn entry(&mut self, name: &str, content: &[u8]) {
        let entry = Entry {
            name: format!("{ROOT}/{name}"),
            crc: crc32fast::hash(content),
            size: content.len() as u64,
            offset: self.out.len() as u64,
        };
        // the padding is a field of its own, with 4 bytes of head
        let unpadded = self.out.len() + 30 + entry.name.len() + 20 + 4;
        let padding = unpadded.next_multiple_of(ALIGNMENT) - unpadded;
        self.out.extend(b"PK\x03\x04");
        self.fixed(&entry);
        self.out.extend((24 + padding as u16).to_le_bytes());
        self.out.extend(entry.name.as_bytes());
        self.wide(&[entry.size, entry.size]);
        self.out.extend(b"FB");
        self.out.extend((padding as u16).to_le_bytes());
        self.out.resize(self.out.len() + padding, b'Z');
        self.out.extend(content);
        self.entries.push(entry);
    }

    /// What both headers of an entry share: version, flags, method, time, sum, sizes, length of the name.
    fn fixed(&mut self, entry: &Entry) {
        // version 4.5 knows zip64; names are UTF-8; stored; 1980-01-01, so that equal content gives equal bytes
        for word in [45u16, 0x800, 0, 0, 0x21] {
            self.out.extend(word.to_le_bytes());
        }
        self.out.extend(entry.crc.to_le_bytes());
        self.out.extend([0xFF; 8]);
        self.out.extend((entry.name.len() as u16).to_le_bytes());
    }

    fn wide(&mut self, values: &[u64]) {
        self.out.extend(1u16.to_le_bytes());
        self.out.extend((values.len() as u16 * 8).to_le_bytes());
        values.iter().for_each(|v| self.out.extend(v.to_le_bytes()));
    }

    fn finish(mut self) -> Vec<u8> {
        let start = self.out.len() as u64;
        for entry in std::mem::take(&mut self.entries) {
            self.out.extend(b"PK\x01\x02\x2d\x00");
            self.fixed(&entry);
            self.out.extend(28u16.to_le_bytes());
            self.out.extend([0; 10]); // comment, disk, attributes
            self.out.extend([0xFF; 4]);
            self.out.extend(entry.name.as_bytes());
            self.wide(&[entry.size, entry.size, entry.offset]);
            self.entries.push(entry);
        }
        let end = self.out.len() as u64;
        let count = self.entries.len() as u64;
        self.out.extend(b"PK\x06\x06");
        self.out.extend(44u64.to_le_bytes());
        self.out.extend([45, 0, 45, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
        for value in [count, count, end - start, start] {
            self.out.extend(value.to_le_bytes());
        }
        self.out.extend(b"PK\x06\x07\0\0\0\0");
        self.out.extend(end.to_le_bytes());
        self.out.extend(1u32.to_le_bytes());
        self.out.extend(b"PK\x05\x06\0\0\0\0");
        self.out.extend([0xFF; 12]);
        self.out.extend([0; 2]);
        self.out
    }
}
