//! What readers refuse for its size.

use super::read_error::ReadError;
use std::path::Path;

/// Limits of readers, independent of what a file claims.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Longest side of a picture, pixels.
    pub side_px: u32,
    /// Bytes of one decoded picture or array.
    pub decoded_bytes: u64,
    /// Bytes of any file.
    pub file_bytes: u64,
    /// Bytes of a JSON file.
    pub json_bytes: u64,
    /// Nesting of arrays and objects in JSON.
    pub json_depth: usize,
    /// Numbers, strings, arrays and objects in one JSON file; bounds the memory of the parsed tree.
    pub json_values: usize,
    /// Views of one capture; votes of views are counted in 16 bits.
    pub views: usize,
}

impl Default for Limits {
    fn default() -> Limits {
        Limits {
            side_px: 16_384,
            decoded_bytes: 4 << 30,
            file_bytes: 4 << 30,
            json_bytes: 64 << 20,
            json_depth: 64,
            json_values: 8 << 20,
            views: u16::MAX as usize,
        }
    }
}

impl Limits {
    /// Fails if a capture has more views than allowed.
    pub fn check_views(&self, path: &Path, views: usize) -> Result<(), ReadError> {
        let too_large = || ReadError::too_large(path, "the number of views", views as u64, self.views as u64);
        if views > self.views { Err(too_large()) } else { Ok(()) }
    }

    pub(super) fn check_side(&self, path: &Path, side: u64) -> Result<(), ReadError> {
        let (what, limit) = ("the picture's longest side in pixels", self.side_px.into());
        if side > limit { Err(ReadError::too_large(path, what, side, limit)) } else { Ok(()) }
    }

    pub(super) fn check_decoded(&self, path: &Path, bytes: u64) -> Result<(), ReadError> {
        let (what, limit) = ("the decoded picture's size in bytes", self.decoded_bytes);
        if bytes > limit { Err(ReadError::too_large(path, what, bytes, limit)) } else { Ok(()) }
    }
}
