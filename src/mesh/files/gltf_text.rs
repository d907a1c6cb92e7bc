//! A `.gltf` with its buffer, made the GLB that it would be in one file.

use super::beside;
use super::source::without_byte_order_mark;
use super::uri::{data_of_uri, name_of_uri};
use crate::io::{self, Limits, parse_json};
use crate::{Error, Result};
use serde_json::Value;
use std::path::Path;

/// Returns a GLB of a `.gltf` whose numbers lie in a data URI or in a `.bin` in its folder; `None` if these bytes are no
/// `.gltf`.
///
/// # Errors
///
/// Fails if the JSON is damaged, if it has several buffers, or if the buffer cannot be read.
pub(super) fn as_glb(bytes: &[u8], path: &Path) -> Result<Option<Vec<u8>>> {
    if !without_byte_order_mark(bytes).trim_ascii_start().starts_with(b"{") {
        return Ok(None);
    }
    let mut document = parse_json(path, bytes, &Limits::default())?;
    if document.get("asset").and_then(|asset| asset.get("version")).is_none() {
        return Ok(None);
    }
    let cannot = |what: &str| {
        let hint = "export it as .glb, which holds all in one";
        Error::cannot(format!("`{}`, `buffers`: {what}", path.display()), hint)
    };
    let bin = match document.get_mut("buffers").and_then(Value::as_array_mut).map(Vec::as_mut_slice) {
        None | Some([]) => Vec::new(),
        Some([buffer]) => {
            let uri = buffer.as_object_mut().and_then(|buffer| buffer.remove("uri"));
            let uri = uri.as_ref().and_then(Value::as_str).ok_or_else(|| cannot("there is no `uri`"))?;
            match data_of_uri(uri) {
                Some(data) => data.ok_or_else(|| cannot("its data URI is not Base64"))?,
                None => {
                    let folder = path.parent().unwrap_or(Path::new(""));
                    io::read_bytes(
                        &beside::find(&[folder], path, &name_of_uri(uri))?.file,
                        &Limits::default(),
                    )?
                }
            }
        }
        Some(_) => return Err(cannot("several buffers are not supported")),
    };
    let mut json = document.to_string().into_bytes();
    json.resize(json.len().next_multiple_of(4), b' ');
    let mut bin = bin;
    bin.resize(bin.len().next_multiple_of(4), 0);
    let chunks = [(&json, b"JSON"), (&bin, b"BIN\0")];
    let chunks = chunks.iter().filter(|(chunk, _)| !chunk.is_empty());
    let total: usize = 12 + chunks.clone().map(|(chunk, _)| 8 + chunk.len()).sum::<usize>();
    let total = u32::try_from(total).map_err(|_| cannot("more than 4 GiB"))?;
    let mut out = Vec::with_capacity(total as usize);
    out.extend_from_slice(b"glTF");
    out.extend([2, total].iter().flat_map(|word| word.to_le_bytes()));
    for (chunk, kind) in chunks {
        out.extend((chunk.len() as u32).to_le_bytes());
        out.extend_from_slice(*kind);
        out.extend_from_slice(chunk);
    }
    Ok(Some(out))
}
