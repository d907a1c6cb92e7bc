//! Data on stdout.

use super::plain::plain;
use crate::{Error, Result};
use std::io::{self, Write};

/// Prints data to stdout, as [`plain`] text. A reader that has gone away (`| head`) is not an error.
pub(super) fn print(text: &str) -> Result<()> {
    let mut out = std::io::stdout().lock();
    let written = out.write_all(plain(text).as_bytes()).and_then(|()| out.flush());
    match written {
        Err(e) if e.kind() != io::ErrorKind::BrokenPipe => {
            Err(Error::cannot(format!("stdout cannot be written: {e}"), "check where it leads"))
        }
        _ => Ok(()),
    }
}
