//! A `.gltf` with its buffers, made the GLB that it would be in one file.

use super::beside;
use super::source::without_byte_order_mark;
use super::uri::{data_of_uri, name_of_uri};
use serde_json::{Value, json};
use std::path::Path;
use tiface_base::io::{self, Limits, parse_json};
use tiface_base::{Error, Result};

/// Buffers of one document; more are an attack.
const MAX_BUFFERS: usize = 256;

/// Returns a GLB of a `.gltf` whose numbers lie in data URIs or in `.bin` files in its folder;
/// `None` if these bytes are no `.gltf`.
///
/// # Errors
///
/// Fails if the JSON is damaged, or if a buffer cannot be read.
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
    let buffers = match document.get_mut("buffers").map(Value::take) {
        Some(Value::Array(buffers)) => buffers,
        _ => Vec::new(),
    };
    if buffers.len() > MAX_BUFFERS {
        return Err(cannot(&format!("there are {}, more than {MAX_BUFFERS}", buffers.len())));
    }
    let (mut bin, mut parts) = (Vec::new(), Vec::new());
    for (k, buffer) in buffers.iter().enumerate() {
        let unread = || cannot(&format!("buffer {k} has no `uri` that can be read"));
        let data = data_of(buffer, path)?.ok_or_else(unread)?;
        let length = buffer.get("byteLength").and_then(Value::as_u64).unwrap_or(0);
        if length > data.len() as u64 {
            return Err(cannot(&format!("buffer {k} has {length} bytes, but its data has {}", data.len())));
        }
        if bin.len() as u64 + length > Limits::default().file_bytes {
            return Err(cannot("more than 4 GiB"));
        }
        bin.resize(bin.len().next_multiple_of(8), 0);
        parts.push((bin.len() as u64, length));
        bin.extend_from_slice(&data[..length as usize]);
    }
    if !buffers.is_empty() {
        document["buffers"] = json!([{"byteLength": bin.len()}]);
    }
    if parts.len() > 1 {
        let views = document.get_mut("bufferViews").and_then(Value::as_array_mut);
        for (k, view) in views.into_iter().flatten().enumerate() {
            if !moved(view, &parts) {
                return Err(cannot(&format!("view {k} does not lie in one of them")));
            }
        }
    }
    let mut json = document.to_string().into_bytes();
    json.resize(json.len().next_multiple_of(4), b' ');
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

/// Returns the bytes of a buffer; `None` if it names none, or damaged ones.
fn data_of(buffer: &Value, path: &Path) -> Result<Option<Vec<u8>>> {
    let Some(uri) = buffer.get("uri").and_then(Value::as_str) else { return Ok(None) };
    if let Some(data) = data_of_uri(uri) {
        return Ok(data);
    }
    let folder = path.parent().unwrap_or(Path::new(""));
    let file = beside::find(&[folder], path, &name_of_uri(uri))?.file;
    Ok(Some(io::read_bytes(&file, &Limits::default())?))
}

/// Makes a view one of the only buffer, where the buffers begin at these places and have these
/// lengths; returns whether it lies in one of them.
fn moved(view: &mut Value, parts: &[(u64, u64)]) -> bool {
    let number = |key: &str| view.get(key).and_then(Value::as_u64);
    let (at, bytes) = (number("byteOffset").unwrap_or(0), number("byteLength").unwrap_or(0));
    let part = number("buffer").and_then(|index| parts.get(usize::try_from(index).ok()?));
    let Some((start, length)) = part else { return false };
    if at.checked_add(bytes).is_none_or(|end| end > *length) {
        return false;
    }
    view["buffer"] = json!(0);
    view["byteOffset"] = json!(start + at);
    true
}
