//! The zip archive around a checkpoint, read whole or not at all.
//!
//! Layout (PKWARE APPNOTE): per entry a local header and its data, then the central directory, its
//! zip64 record, and the end record. `torch.save` stores without compression; archives that a zip tool
//! packed again are deflated. Our own reader, since a zip crate takes the last of two equal names and lets
//! entries share bytes, the two tricks that make small files unpack to large ones.

use super::super::{Limits, ReadError};
use super::FORMAT;
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::Path;

const LOCAL: &[u8] = b"PK\x03\x04";
const CENTRAL: &[u8] = b"PK\x01\x02";
const END: &[u8] = b"PK\x05\x06";
const END64: &[u8] = b"PK\x06\x06";
const LOCATOR64: &[u8] = b"PK\x06\x07";
/// The largest field has 30 tensors; optimizers of large networks reach thousands.
const MAX_ENTRIES: u64 = 65_536;
/// Weights hardly shrink; deflate itself ends at 1032.
const MAX_RATIO: u64 = 64;

/// Entries by their full name.
pub(super) struct Archive<'a> {
    entries: BTreeMap<String, Cow<'a, [u8]>>,
    /// What stands before `data.pkl`, with its slash.
    root: String,
}

/// One line of the central directory, sizes in bytes.
struct Listed {
    name: String,
    method: u16,
    crc: u32,
    packed: u64,
    size: u64,
    offset: u64,
}

impl<'a> Archive<'a> {
    /// Checks every entry: inside the file, apart from the others, named once, of the sum it was stored with.
    pub(super) fn open(path: &Path, bytes: &'a [u8], limits: &Limits) -> Result<Archive<'a>, ReadError> {
        let file = Reader { path, bytes };
        let (listed, directory) = file.directory()?;
        let total = listed.iter().fold(0u64, |sum, l| sum.saturating_add(l.size));
        let limit = limits.decoded_bytes.min((bytes.len() as u64).saturating_mul(MAX_RATIO));
        if total > limit {
            let what = "the unpacked size in bytes";
            return Err(ReadError::TooLarge { path: path.into(), what, found: total, limit });
        }
        let mut spans = Vec::with_capacity(listed.len());
        let mut entries = BTreeMap::new();
        for entry in listed {
            let (start, data) = file.data(&entry, directory)?;
            spans.push((entry.offset, start + data.len() as u64));
            let content = file.unpack(&entry, start, data)?;
            if entries.insert(entry.name.clone(), content).is_some() {
                return Err(file.bad(entry.offset, format!("`{}` is in it twice", shown(&entry.name))));
            }
        }
        spans.sort_unstable();
        if let Some(pair) = spans.windows(2).find(|p| p[1].0 < p[0].1) {
            return Err(file.bad(pair[1].0, "two entries of the archive share bytes".into()));
        }
        let mut roots = entries.keys().filter_map(|n| n.strip_suffix("data.pkl"));
        let mut roots = roots.by_ref().filter(|r| r.is_empty() || r.ends_with('/'));
        let root = match (roots.next(), roots.next()) {
            (Some(root), None) => root.to_string(),
            (None, _) => return Err(file.bad(None, "the archive holds no `data.pkl`".into())),
            _ => return Err(file.bad(None, "the archive holds more than one `data.pkl`".into())),
        };
        Ok(Archive { entries, root })
    }

    /// The content of `name` below the archive's own folder.
    pub(super) fn get(&self, name: &str) -> Option<&[u8]> {
        self.entries.get(&format!("{}{name}", self.root)).map(|c| &c[..])
    }

    /// Bytes of all entries together, unpacked.
    pub(super) fn unpacked(&self) -> u64 {
        self.entries.values().map(|c| c.len() as u64).sum()
    }
}

struct Reader<'a, 'p> {
    path: &'p Path,
    bytes: &'a [u8],
}

impl<'a> Reader<'a, '_> {
    fn bad(&self, offset: impl Into<Option<u64>>, problem: String) -> ReadError {
        ReadError::damaged(self.path, FORMAT, offset, problem)
    }

    fn slice(&self, start: u64, length: u64) -> Result<&'a [u8], ReadError> {
        let end = start.checked_add(length).filter(|&e| e <= self.bytes.len() as u64);
        // both fit in usize: they are not past the end of a slice
        end.map(|e| &self.bytes[start as usize..e as usize])
            .ok_or_else(|| self.bad(start, format!("it ends before the {length} bytes that belong here")))
    }

    fn record(&self, start: u64, length: u64, magic: &[u8], what: &str) -> Result<&'a [u8], ReadError> {
        let record = self.slice(start, length)?;
        if record.starts_with(magic) {
            return Ok(record);
        }
        Err(self.bad(start, format!("{what} of the zip archive does not stand where it should")))
    }

    /// The entries, and where their list begins.
    fn directory(&self) -> Result<(Vec<Listed>, u64), ReadError> {
        let last = self.bytes.len().checked_sub(22);
        let first = last.map_or(0, |l| l.saturating_sub(0xFFFF));
        let end = last
            .and_then(|last| {
                (first..=last).rev().find(|&at| {
                    self.bytes[at..].starts_with(END)
                        && at + 22 + u16_at(self.bytes, at + 20) as usize == self.bytes.len()
                })
            })
            .ok_or_else(|| {
                let at = self.bytes.len() as u64;
                self.bad(at, "the zip archive has no end record, so the file was cut off".into())
            })?;
        let record = &self.bytes[end..];
        let mut count = u16_at(record, 10) as u64;
        let mut length = u32_at(record, 12) as u64;
        let mut start = u32_at(record, 16) as u64;
        if count == 0xFFFF || length == 0xFFFF_FFFF || start == 0xFFFF_FFFF {
            let cut = || self.bad(end as u64, "its zip64 record is missing".into());
            let locator = (end as u64).checked_sub(20).ok_or_else(cut)?;
            let locator = self.record(locator, 20, LOCATOR64, "the zip64 locator")?;
            let record = self.record(u64_at(locator, 8), 56, END64, "the zip64 record")?;
            (count, length, start) = (u64_at(record, 32), u64_at(record, 40), u64_at(record, 48));
        }
        if count > MAX_ENTRIES {
            let what = "the number of entries in the archive";
            return Err(ReadError::TooLarge {
                path: self.path.into(),
                what,
                found: count,
                limit: MAX_ENTRIES,
            });
        }
        self.slice(start, length)?;
        let mut at = start;
        let mut listed = Vec::new();
        for _ in 0..count {
            let (entry, next) = self.listed(at)?;
            if next > start + length {
                return Err(self.bad(at, "the list of entries is longer than the archive says".into()));
            }
            listed.push(entry);
            at = next;
        }
        if at != start + length {
            return Err(self.bad(at, format!("the archive lists more than its {count} entries")));
        }
        Ok((listed, start))
    }

    /// The entry listed at `at`, and where the next one is.
    fn listed(&self, at: u64) -> Result<(Listed, u64), ReadError> {
        let fixed = self.record(at, 46, CENTRAL, "an entry of the list")?;
        let [name, extra, comment] = [28, 30, 32].map(|o| u16_at(fixed, o) as u64);
        let text = self.slice(at + 46, name)?;
        let Ok(text) = std::str::from_utf8(text) else {
            return Err(self.bad(at + 46, "the name of an entry is not UTF-8".into()));
        };
        let mut entry = Listed {
            name: text.into(),
            method: u16_at(fixed, 10),
            crc: u32_at(fixed, 16),
            packed: u32_at(fixed, 20) as u64,
            size: u32_at(fixed, 24) as u64,
            offset: u32_at(fixed, 42) as u64,
        };
        if u16_at(fixed, 8) & 1 != 0 {
            return Err(ReadError::Unsupported {
                path: self.path.into(),
                what: format!("an encrypted entry, `{}`,", shown(text)),
                hint: "unpack it and save it again without a password".into(),
            });
        }
        self.widen(&mut entry, self.slice(at + 46 + name, extra)?, at)?;
        let next = at + 46 + name + extra + comment;
        Ok((entry, next))
    }

    /// Takes the sizes that do not fit 32 bits from the zip64 field.
    fn widen(&self, entry: &mut Listed, mut extra: &[u8], at: u64) -> Result<(), ReadError> {
        let mut wide: &[u8] = &[];
        while extra.len() >= 4 {
            let length = u16_at(extra, 2) as usize;
            let Some(field) = extra.get(4..4 + length) else { break };
            if u16_at(extra, 0) == 1 {
                wide = field;
            }
            extra = &extra[4 + length..];
        }
        for value in [&mut entry.size, &mut entry.packed, &mut entry.offset] {
            if *value == 0xFFFF_FFFF {
                let Some((number, rest)) = wide.split_first_chunk::<8>() else {
                    return Err(self.bad(at, format!("the sizes of `{}` are missing", shown(&entry.name))));
                };
                *value = u64::from_le_bytes(*number);
                wide = rest;
            }
        }
        Ok(())
    }

    /// Where the entry's data begins, and the data as they are in the file.
    fn data(&self, entry: &Listed, directory: u64) -> Result<(u64, &'a [u8]), ReadError> {
        let fixed = self.record(entry.offset, 30, LOCAL, "an entry")?;
        let [name, extra] = [26, 28].map(|o| u16_at(fixed, o) as u64);
        let name_at = entry.offset + 30;
        if self.slice(name_at, name)? != entry.name.as_bytes() || u16_at(fixed, 8) != entry.method {
            let problem = format!("`{}` is called or packed otherwise in the list", shown(&entry.name));
            return Err(self.bad(entry.offset, problem));
        }
        let start = name_at + name + extra;
        let data = self.slice(start, entry.packed)?;
        if start + entry.packed > directory {
            return Err(self.bad(start, format!("`{}` reaches into the list of entries", shown(&entry.name))));
        }
        Ok((start, data))
    }

    fn unpack(&self, entry: &Listed, start: u64, data: &'a [u8]) -> Result<Cow<'a, [u8]>, ReadError> {
        let name = shown(&entry.name);
        let content = match entry.method {
            0 => Cow::Borrowed(data),
            // the declared sizes were counted against the limit, and no more than that is unpacked
            8 => miniz_oxide::inflate::decompress_to_vec_with_limit(data, entry.size as usize)
                .map(Cow::Owned)
                .map_err(|e| self.bad(start, format!("`{name}` cannot be unpacked: {e}")))?,
            method => {
                return Err(ReadError::Unsupported {
                    path: self.path.into(),
                    what: format!("`{name}`, packed by zip method {method},"),
                    hint: "pack it with `zip -0`, or save it again with torch".into(),
                });
            }
        };
        if content.len() as u64 != entry.size {
            let problem = format!("`{name}` has {} bytes, its entry says {}", content.len(), entry.size);
            return Err(self.bad(start, problem));
        }
        let sum = crc32fast::hash(&content);
        if sum != entry.crc {
            let problem = format!("`{name}` has check sum {sum:08x}, its entry says {:08x}", entry.crc);
            return Err(self.bad(start, problem));
        }
        Ok(content)
    }
}

fn shown(name: &str) -> String {
    super::shown(name.as_bytes())
}

// Only for offsets inside slices whose length was checked.

fn u16_at(b: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([b[at], b[at + 1]])
}

fn u32_at(b: &[u8], at: usize) -> u32 {
    u16_at(b, at) as u32 | (u16_at(b, at + 2) as u32) << 16
}

fn u64_at(b: &[u8], at: usize) -> u64 {
    u32_at(b, at) as u64 | (u32_at(b, at + 4) as u64) << 32
}
