//! Zip archives that lie: each ends in a named error, and no memory is reserved for what they only
//! claim.

use crate::zips::{self, Entry};
use tiface::io::{self, Limits, ReadError};

fn read(bytes: &[u8]) -> Result<usize, ReadError> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("x.npz");
    std::fs::write(&path, bytes).unwrap();
    io::read_npz(&path, &Limits::default()).map(|arrays| arrays.len()).inspect_err(|e| {
        assert!(e.to_string().contains("x.npz") && !e.hint().is_empty(), "{e}");
    })
}

fn npy() -> Vec<u8> {
    let mut bytes =
        b"\x93NUMPY\x01\x00\x3f\x00{'descr': '<f8', 'fortran_order': False, 'shape': (3,), }     \n".to_vec();
    bytes.extend([0; 24]);
    bytes
}

#[test]
fn archives_that_lie_are_errors() {
    let good = [Entry::stored("a.npy", &npy()), Entry::stored("b.txt", &[0; 24])];
    let made = |change: &dyn Fn(&mut Vec<Entry>)| {
        let mut entries = good.to_vec();
        change(&mut entries);
        read(&zips::archive(&entries, |_, at| at))
    };
    assert_eq!(made(&|_| ()).unwrap(), 1, "what is no array is left out");
    assert_eq!(read(&zips::archive(&[Entry::deflated("a.npy", &npy())], |_, at| at)).unwrap(), 1);
    let message = |result: Result<usize, ReadError>| result.unwrap_err().to_string();
    assert!(message(made(&|e| e[1].name = "a.npy".into())).contains("duplicate"));
    assert!(message(made(&|e| e[1].crc ^= 1)).contains("cannot be unpacked"));
    assert!(message(made(&|e| e[1].size += 1)).contains("has 24 bytes, its entry says 25"));
    assert!(message(made(&|e| e[1].flags = 1)).contains("Password"));
    assert!(message(made(&|e| e[1].method = 12)).contains("not supported: 12"));
    assert!(message(made(&|e| e[1].method = 8)).contains("cannot be unpacked"));
    // two entries on the same bytes
    let twice = zips::archive(&[good[0].clone(), good[0].clone()], |_, _| 0);
    assert!(message(read(&twice)).contains("duplicate"));
    // an entry inside the data of another one
    let inner = zips::archive(&[Entry::stored("d.txt", &[0; 9])], |_, at| at);
    let outer = [good[0].clone(), Entry::stored("c.txt", &inner), Entry::stored("d.txt", &[0; 9])];
    let at = 30 + "a.npy".len() + npy().len() + 30 + "c.txt".len();
    let shared = zips::archive(&outer, |i, own| if i == 2 { at as u32 } else { own });
    assert!(message(read(&shared)).contains("overlapping"));
    for offset in [u32::MAX - 1, 1 << 20, 3] {
        assert!(read(&zips::archive(&good, |_, at| at + offset.min(u32::MAX - at))).is_err());
    }
    for bytes in [&b"\x89PNG\r\n"[..], b"P", b"PK\x03\x04", b"PK\x05\x06"] {
        assert!(matches!(read(bytes), Err(ReadError::Damaged { .. })));
    }
}

#[test]
fn small_archives_that_unpack_to_much_are_refused_before_they_are_unpacked() {
    let zeros = Entry::deflated("a.npy", &vec![0; 64 << 20]);
    assert!(zeros.data.len() < 100 << 10);
    let error = read(&zips::archive(std::slice::from_ref(&zeros), |_, at| at));
    assert!(matches!(error, Err(ReadError::TooLarge { found, .. }) if found >= 64 << 20), "{error:?}");
    // the size it claims is all it gets
    let liar = Entry { size: 100, ..zeros };
    let error = read(&zips::archive(&[liar], |_, at| at));
    assert!(error.unwrap_err().to_string().contains("cannot be unpacked"));
}
