//! Reading of STL, text and binary: triangles without a shared corner and without color.
//!
//! A binary file is known by its length, 84 bytes and 50 for each triangle, since its header may
//! begin with `solid`, too. Each triangle keeps three vertices of its own; normals of facets follow
//! from them and are passed over.

use super::source::{ReadMesh, Source, line_end};
use glam::DVec3;
use tiface_base::Result;

const HEADER: usize = 84;
const FACET: usize = 50;

/// Returns whether these bytes are STL.
pub(super) fn is_stl(bytes: &[u8]) -> bool {
    is_binary(bytes) || is_text(bytes)
}

fn is_binary(bytes: &[u8]) -> bool {
    let count = bytes.get(80..HEADER).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as usize);
    count.is_some_and(|n| n > 0 && n.checked_mul(FACET).is_some_and(|n| n + HEADER == bytes.len()))
}

fn is_text(bytes: &[u8]) -> bool {
    let start = &bytes[..bytes.len().min(1 << 12)];
    let start = String::from_utf8_lossy(start).to_ascii_lowercase();
    start.trim_start().starts_with("solid") && (start.contains("facet") || start.contains("endsolid"))
}

pub(super) fn read(bytes: &[u8], source: Source) -> Result<ReadMesh> {
    let mut out = ReadMesh::default();
    if is_binary(bytes) {
        read_binary(bytes, source, &mut out)?;
    } else {
        read_text(bytes, source, &mut out)?;
    }
    let triangles = out.places.len() as u32 / 3;
    out.mesh.triangles = (0..triangles).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
    Ok(out)
}

fn read_binary(bytes: &[u8], source: Source, out: &mut ReadMesh) -> Result<()> {
    let facets = bytes[HEADER..].chunks_exact(FACET);
    source.allow(0, facets.len())?;
    let mut is_colored = false;
    for (i, facet) in facets.enumerate() {
        for corner in facet[12..48].chunks_exact(12) {
            let value =
                |k: usize| f32::from_le_bytes([corner[k], corner[k + 1], corner[k + 2], corner[k + 3]]);
            let place = DVec3::new(value(0).into(), value(4).into(), value(8).into());
            if !place.is_finite() {
                return Err(source.broken(format!("triangle {i}"), format!("{place} is not finite")));
            }
            out.places.push(place);
        }
        is_colored |= facet[48..] != [0, 0];
    }
    if is_colored {
        out.note("the two bytes behind each triangle, which some programs use for colors, are not looked at");
    }
    Ok(())
}

fn read_text(bytes: &[u8], source: Source, out: &mut ReadMesh) -> Result<()> {
    let mut corners = 0;
    let end = line_end(bytes);
    for (number, line) in (1..).zip(bytes.split(|&b| b == end)) {
        let line = String::from_utf8_lossy(line.trim_ascii());
        let mut words = line.split_ascii_whitespace();
        let at = format!("line {number}");
        match words.next().unwrap_or("").to_ascii_lowercase().as_str() {
            "vertex" => {
                let number = |word: &str| {
                    let word: String = word.chars().take(40).collect();
                    let what = || format!("`{word}` is not a number");
                    word.parse::<f64>().map_err(|_| source.no_number(&at, what(), &word))
                };
                let numbers = words.map(number).collect::<Result<Vec<f64>>>()?;
                let [x, y, z] = numbers[..] else {
                    return Err(source.broken(at, format!("{} numbers, expected x y z", numbers.len())));
                };
                let place = DVec3::new(x, y, z);
                if !place.as_vec3().is_finite() {
                    return Err(source.broken(at, format!("{place} is not finite")));
                }
                source.allow(0, out.places.len() / 3 + 1)?;
                out.places.push(place);
                corners += 1;
            }
            "endfacet" | "endloop" if corners != 0 => {
                if corners != 3 {
                    return Err(source.broken(at, format!("a facet of {corners} corners, expected 3")));
                }
                corners = 0;
            }
            _ => {}
        }
    }
    if corners != 0 {
        return Err(source.broken("its end", "the file ends inside a facet"));
    }
    Ok(())
}
