//! Zip archives made and taken apart for tests, without zip64 and without the reader under test.
#![allow(dead_code)]

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

/// An archive of these entries; `offset(i, at)` is where its list says that entry i is, which is at `at`.
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

pub fn stored(entries: &[(String, Vec<u8>)]) -> Vec<u8> {
    let entries: Vec<_> = entries.iter().map(|(name, content)| Entry::stored(name, content)).collect();
    archive(&entries, |_, at| at)
}

pub fn deflated(entries: &[(String, Vec<u8>)]) -> Vec<u8> {
    let entries: Vec<_> = entries.iter().map(|(name, content)| Entry::deflated(name, content)).collect();
    archive(&entries, |_, at| at)
}

/// Names and contents of an archive that torch stored, by walking its list.
pub fn entries(bytes: &[u8]) -> Vec<(String, Vec<u8>)> {
    let u16_at = |at: usize| u16::from_le_bytes([bytes[at], bytes[at + 1]]) as usize;
    let u32_at = |at: usize| u16_at(at) | u16_at(at + 2) << 16;
    let end = bytes.len() - 22;
    let mut at = u32_at(end + 16);
    let mut out = Vec::new();
    for _ in 0..u16_at(end + 10) {
        let (size, offset) = (u32_at(at + 20), u32_at(at + 42));
        let name = String::from_utf8(bytes[at + 46..at + 46 + u16_at(at + 28)].to_vec()).unwrap();
        let start = offset + 30 + u16_at(offset + 26) + u16_at(offset + 28);
        out.push((name, bytes[start..start + size].to_vec()));
        at += 46 + u16_at(at + 28) + u16_at(at + 30) + u16_at(at + 32);
    }
    out
}
