//! Zip archives made and taken apart for tests, without zip64 and without the reader under test.

/// One entry as it will stand in an archive, true or not.
#[derive(Clone)]
pub struct Entry {
    pub name: String,
    pub method: u16,
    pub flags: u16,
    pub crc: u32,
    pub size: u32,
    pub data: Vec<u8>,
}

impl Entry {
    pub fn stored(name: &str, content: &[u8]) -> Entry {
        let crc = crc32fast::hash(content);
        Entry {
            name: name.into(),
            method: 0,
            flags: 0,
            crc,
            size: content.len() as u32,
            data: content.into(),
        }
    }

    pub fn deflated(name: &str, content: &[u8]) -> Entry {
        let data = miniz_oxide::deflate::compress_to_vec(content, 9);
        Entry { method: 8, data, ..Entry::stored(name, content) }
    }

    fn header(&self) -> Vec<u8> {
        let mut out = Vec::new();
        [20, self.flags, self.method, 0, 0x21].iter().for_each(|w: &u16| out.extend(w.to_le_bytes()));
        for word in [self.crc, self.data.len() as u32, self.size] {
            out.extend(word.to_le_bytes());
        }
        out.extend((self.name.len() as u16).to_le_bytes());
        out.extend([0; 2]);
        out
    }
}

/// An archive of these entries; `offset(i, at)` is where its list says that entry i is, which is at
/// `at`.
pub fn archive(entries: &[Entry], offset: impl Fn(usize, u32) -> u32) -> Vec<u8> {
    let mut out = Vec::new();
    let mut list = Vec::new();
    for (i, entry) in entries.iter().enumerate() {
        list.extend(b"PK\x01\x02\x14\x00");
        list.extend(entry.header());
        list.extend([0; 10]);
        list.extend(offset(i, out.len() as u32).to_le_bytes());
        list.extend(entry.name.as_bytes());
        out.extend(b"PK\x03\x04");
        out.extend(entry.header());
        out.extend(entry.name.as_bytes());
        out.extend(&entry.data);
    }
    let (start, count) = (out.len() as u32, entries.len() as u16);
    out.extend(&list);
    out.extend(b"PK\x05\x06\0\0\0\0");
    [count, count].iter().for_each(|w| out.extend(w.to_le_bytes()));
    [list.len() as u32, start].iter().for_each(|w| out.extend(w.to_le_bytes()));
    out.extend([0; 2]);
    out
}
