//! A zip of stored files, as a USDZ is one (Pixar, *Usdz File Format Specification*): nothing is
//! compressed, and the data of every file begins at a multiple of 64 bytes, so that programs read
//! them where they lie.
//!
//! The bytes depend on names and data alone: every file is of 1 January 1980, where the calendar of
//! a zip begins.

use tiface_base::{Error, Result};

/// Multiple of bytes at which the data of each file begins.
const ALIGNMENT: usize = 64;

/// Identifier of the extra field that fills the gap before a file's data; readers skip those that
/// they do not know.
const PADDING: u16 = 0x1986;

/// Bytes of an extra field without data: its identifier and its length.
const EMPTY_EXTRA: usize = 4;

/// Returns a zip of these files, given by name and data. Names must be ASCII and short.
///
/// # Errors
///
/// Fails if the zip would be larger than its 32-bit offsets reach.
pub(super) fn stored_zip(files: &[(&str, &[u8])]) -> Result<Vec<u8>> {
    // headers take less than 46 + 30 bytes and two names, padding less than 68
    let most = |(name, data): &(&str, &[u8])| data.len() as u64 + 2 * name.len() as u64 + 144;
    let bytes = files.iter().map(most).sum::<u64>() + 22;
    require_offsets(bytes)?;
    let (mut out, mut directory) = (Vec::with_capacity(bytes as usize), Vec::new());
    for (name, data) in files {
        let start = out.len();
        let entry = entry(name, data);
        let unpadded = start + 4 + entry.len() + 2 + name.len();
        let padding = padding(unpadded);
        out.extend(b"PK\x03\x04");
        out.extend(&entry);
        out.extend(u16_of(padding));
        out.extend(name.as_bytes());
        if padding > 0 {
            out.extend(PADDING.to_le_bytes());
            out.extend(u16_of(padding - EMPTY_EXTRA));
            out.resize(unpadded + padding, 0);
        }
        out.extend(*data);
        directory.extend(b"PK\x01\x02\x0a\x00"); // made by version 1.0
        directory.extend(&entry);
        directory.extend([0; 12]); // neither extra field, comment, disk nor attributes
        directory.extend(u32_of(start));
        directory.extend(name.as_bytes());
    }
    let (count, start) = (u16_of(files.len()), out.len());
    out.extend(&directory);
    out.extend(b"PK\x05\x06\0\0\0\0");
    out.extend(count);
    out.extend(count);
    out.extend(u32_of(directory.len()));
    out.extend(u32_of(start));
    out.extend([0; 2]); // no comment
    Ok(out)
}

/// Returns what the header before a file and its entry in the directory have in common.
fn entry(name: &str, data: &[u8]) -> Vec<u8> {
    // version 1.0, no flags, stored, midnight of 1 January 1980
    let mut out = vec![10, 0, 0, 0, 0, 0, 0, 0, 0x21, 0];
    out.extend(crc32(data).to_le_bytes());
    out.extend(u32_of(data.len()));
    out.extend(u32_of(data.len()));
    out.extend(u16_of(name.len()));
    out
}

/// Returns the bytes of an extra field that brings what follows it to a multiple of [`ALIGNMENT`];
/// a gap too short for such a field is filled by one that is 64 bytes longer.
fn padding(position: usize) -> usize {
    match position.next_multiple_of(ALIGNMENT) - position {
        gap @ 1..EMPTY_EXTRA => gap + ALIGNMENT,
        gap => gap,
    }
}

/// Returns an error for a zip of more bytes than its offsets reach.
fn require_offsets(bytes: u64) -> Result<()> {
    if bytes > u64::from(u32::MAX) {
        let what = format!("the file would have {bytes} bytes, but a USDZ holds at most {}", u32::MAX);
        return Err(Error::cannot(what, "ask for fewer triangles, or write a .ply"));
    }
    Ok(())
}

// `stored_zip` has checked the sum of all sizes, and names and numbers of files are our own
fn u32_of(number: usize) -> [u8; 4] {
    (number as u32).to_le_bytes()
}

fn u16_of(number: usize) -> [u8; 2] {
    (number as u16).to_le_bytes()
}

/// Remainders of all bytes for [`crc32`].
const REMAINDERS: [u32; 256] = {
    let mut table = [0; 256];
    let mut byte = 0;
    while byte < 256 {
        let mut value = byte as u32;
        let mut bit = 0;
        while bit < 8 {
            value = if value & 1 == 1 { value >> 1 ^ 0xedb8_8320 } else { value >> 1 };
            bit += 1;
        }
        table[byte] = value;
        byte += 1;
    }
    table
};

/// Returns the checksum of zip and PNG: CRC-32 of ISO 3309, lowest bit first.
fn crc32(data: &[u8]) -> u32 {
    let step = |crc: u32, byte: &u8| REMAINDERS[(crc as u8 ^ byte) as usize] ^ crc >> 8;
    !data.iter().fold(!0, step)
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    fn number(bytes: &[u8], at: usize, length: usize) -> usize {
        bytes[at..at + length].iter().rev().fold(0, |sum, &b| sum << 8 | usize::from(b))
    }

    /// Returns name, data and offset of the data of the files of a zip, read from its directory as
    /// readers do.
    pub fn files_of(zip: &[u8]) -> Vec<(String, Vec<u8>, usize)> {
        let end = zip.len() - 22;
        assert_eq!(&zip[end..end + 4], b"PK\x05\x06");
        let mut at = number(zip, end + 16, 4);
        assert_eq!(at + number(zip, end + 12, 4), end, "the directory ends where its end begins");
        let mut found = Vec::new();
        for _ in 0..number(zip, end + 10, 2) {
            assert_eq!(&zip[at..at + 4], b"PK\x01\x02");
            let (name_length, start) = (number(zip, at + 28, 2), number(zip, at + 42, 4));
            let name = String::from_utf8(zip[at + 46..at + 46 + name_length].to_vec()).unwrap();
            // the header before the data says the same
            assert_eq!(&zip[start..start + 4], b"PK\x03\x04");
            assert_eq!(zip[start + 4..start + 28], zip[at + 6..at + 30], "{name}");
            assert_eq!(&zip[start + 30..start + 30 + name_length], name.as_bytes());
            let extra = number(zip, start + 28, 2);
            let (field, data) = (start + 30 + name_length, start + 30 + name_length + extra);
            assert!(extra == 0 || extra == 4 + number(zip, field + 2, 2), "{name}");
            assert_eq!(number(zip, start + 8, 2), 0, "{name} is compressed");
            let size = number(zip, start + 22, 4);
            assert_eq!(number(zip, start + 18, 4), size);
            assert_eq!(number(zip, start + 14, 4) as u32, crc32(&zip[data..data + size]), "{name}");
            found.push((name, zip[data..data + size].to_vec(), data));
            at += 46 + name_length;
        }
        assert_eq!(at, end);
        found
    }

    #[test]
    fn checksums_are_those_of_the_standard() {
        // the check value of the catalog of CRCs, and of RFC 3720's neighbors in zip
        assert_eq!(crc32(b"123456789"), 0xcbf4_3926);
        assert_eq!((crc32(b""), crc32(&[0])), (0, 0xd202_ef8d));
    }

    #[test]
    fn data_of_every_file_begins_at_a_multiple_of_64() {
        let data: Vec<u8> = (0..=255).collect();
        // every length of a name, and so every gap; with data before it of every length
        for length in 1..=80 {
            let names = ["a".repeat(length), "b".repeat(81 - length)];
            let files = [(names[0].as_str(), &data[..length]), (&names[1], &data[..]), ("c", &[])];
            let zip = stored_zip(&files).unwrap();
            let found = files_of(&zip);
            assert_eq!(found.len(), 3);
            for ((name, bytes), (read_name, read, at)) in files.iter().zip(&found) {
                assert_eq!((read_name.as_str(), &read[..], at % 64), (*name, *bytes, 0), "{length}");
            }
            assert_eq!(zip, stored_zip(&files).unwrap());
        }
    }

    #[test]
    fn gaps_have_room_for_an_extra_field() {
        // 60 leaves 4, which an empty field fills; 61 leaves 3, so 64 more
        assert_eq!([0, 60, 61, 63, 64, 65].map(padding), [0, 4, 67, 65, 0, 63]);
    }

    #[test]
    fn a_file_beyond_32_bits_is_refused() {
        assert!(require_offsets(u64::from(u32::MAX)).is_ok());
        let e = require_offsets(1 << 32).unwrap_err();
        assert!(e.to_string().contains("4294967296 bytes, but a USDZ holds"), "{e}");
    }
}
