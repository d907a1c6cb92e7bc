//! OBJ → mesh: `v` with optional colours, `vt`, `vn`, `f` in all its spellings; the rest is passed over.
//! And `map_Kd` of the `.mtl` beside it.
//!
//! Written here because the reader the ecosystem has splits vertices by object, takes index 0 for
//! "none", and multiplies unchecked indices.

use super::source::{ParsedMesh, PictureSource, ReadOptions, Source};
use crate::geom::{Atlas, Mesh};
use crate::{Error, Result};
use glam::{DVec3, Vec2, Vec3};
use std::borrow::Cow;
use std::path::Path;

pub(super) fn read(bytes: &[u8], source: Source) -> Result<ParsedMesh> {
    let mut positions: Vec<DVec3> = Vec::new();
    let mut mesh = Mesh::default();
    let mut atlas = Atlas::default();
    let mut all_mapped = source.options.texture;
    // the coordinates of the face at hand
    let mut mapped: Vec<u32> = Vec::new();
    let (mut library, mut material) = (None, None);
    let mut normals: Vec<Vec3> = Vec::new();
    // which normal each vertex was used with; `u32::MAX` for none yet
    let mut normal_of: Vec<u32> = Vec::new();
    let mut normals_agree = true;
    let mut corners: Vec<u32> = Vec::new();
    for (number, line) in lines(bytes) {
        let broken = |what: String| source.broken(format!("line {number}"), what);
        let mut words = line.split_ascii_whitespace();
        match words.next().unwrap_or("") {
            "v" => {
                let numbers = floats(words, &broken)?;
                let [x, y, z, rest @ ..] = &numbers[..] else {
                    return Err(broken(format!("{} numbers, expected x y z", numbers.len())));
                };
                source.allow(positions.len() + 1, 0)?;
                positions.push(DVec3::new(*x, *y, *z));
                normal_of.push(u32::MAX);
                if let [r, g, b] = rest {
                    mesh.colors.push([*r, *g, *b].map(|c| c.clamp(0.0, 1.0) as f32));
                }
            }
            "vn" => {
                let numbers = floats(words, &broken)?;
                let [x, y, z] = numbers[..] else {
                    return Err(broken(format!("{} numbers, expected x y z", numbers.len())));
                };
                normals.push(DVec3::new(x, y, z).as_vec3());
            }
            "vt" if source.options.texture => {
                let numbers = floats(words, &broken)?;
                let [u, v, ..] = numbers[..] else {
                    return Err(broken(format!("{} numbers, expected u v", numbers.len())));
                };
                source.allow(atlas.uvs.len() + 1, 0)?;
                atlas.uvs.push(Vec2::new(u as f32, 1.0 - v as f32));
            }
            "mtllib" if source.options.texture && library.is_none() => {
                let at = format!("line {number}");
                library = Some(source.bare_name(at, line.strip_prefix("mtllib").unwrap_or(""))?);
            }
            "usemtl" if source.options.texture => {
                let name = words.collect::<Vec<_>>().join(" ");
                if !mesh.triangles.is_empty() && material.as_ref() != Some(&name) {
                    return Err(source.unsupported(format!("line {number}"), "a mesh with several materials"));
                }
                material = Some(name);
            }
            "f" => {
                corners.clear();
                mapped.clear();
                for word in words.take_while(|w| !w.starts_with('#')) {
                    let mut parts = word.split('/');
                    let vertex = resolve(parts.next().unwrap_or(""), positions.len(), "vertices", &broken)?;
                    let uv = parts.next().unwrap_or("");
                    if source.options.texture && !uv.is_empty() {
                        mapped.push(resolve(uv, atlas.uvs.len(), "texture coordinates", &broken)?);
                    }
                    let normal = match parts.next() {
                        // some programs name normals that they do not write
                        Some(text) if !text.is_empty() && !normals.is_empty() => {
                            resolve(text, normals.len(), "normals", &broken)?
                        }
                        _ => u32::MAX,
                    };
                    let known = &mut normal_of[vertex as usize];
                    // a crease: one vertex, several normals
                    normals_agree &= normal != u32::MAX
                        && (*known == u32::MAX || normals[*known as usize] == normals[normal as usize]);
                    *known = normal;
                    corners.push(vertex);
                }
                if corners.len() < 3 {
                    return Err(broken(format!(
                        "a face with {} corners, expected at least 3",
                        corners.len()
                    )));
                }
                source.allow(0, mesh.triangles.len() + corners.len() - 2)?;
                let fan = |c: &[u32], out: &mut Vec<[u32; 3]>| {
                    out.extend(c.windows(2).skip(1).map(|w| [c[0], w[0], w[1]]));
                };
                fan(&corners, &mut mesh.triangles);
                all_mapped &= mapped.len() == corners.len();
                if all_mapped {
                    fan(&mapped, &mut atlas.triangles);
                }
            }
            _ => {}
        }
    }
    if mesh.colors.len() != positions.len() {
        mesh.colors.clear();
    }
    if normals_agree && !normal_of.contains(&u32::MAX) {
        mesh.normals = normal_of.iter().map(|&n| normals[n as usize].normalize_or_zero()).collect();
    }
    let picture = library.map(PictureSource::Material);
    Ok(ParsedMesh { positions, mesh, atlas: all_mapped.then_some(atlas), picture })
}

/// The lines with their numbers. One that ends with a backslash goes on in the next, under its own number; what is
/// in a comment does not.
fn lines(bytes: &[u8]) -> impl Iterator<Item = (usize, Cow<'_, str>)> {
    let mut lines = bytes.split(|&b| b == b'\n').map(|line| line.trim_ascii()).zip(1..);
    std::iter::from_fn(move || {
        let (line, number) = lines.next()?;
        let open = |line: &[u8]| line.ends_with(b"\\") && !line.contains(&b'#');
        if !open(line) {
            return Some((number, String::from_utf8_lossy(line)));
        }
        let (mut whole, mut line) = (Vec::new(), line);
        while open(line) {
            whole.extend(&line[..line.len() - 1]);
            whole.push(b' ');
            line = lines.next().map_or(&[], |(next, _)| next);
        }
        whole.extend(line);
        Some((number, String::from_utf8_lossy(&whole).into_owned().into()))
    })
}

/// The bare name of the picture that a `.mtl` file gives as its base colour (`map_Kd`), if any.
///
/// # Errors
///
/// It lies in another folder or behind an address, comes
/// with options, or there are several.
pub fn picture_of_mtl(bytes: &[u8], path: &Path) -> Result<Option<String>> {
    let source = Source { path, format: "MTL", options: &ReadOptions::default() };
    let mut found: Option<String> = None;
    for (number, line) in bytes.split(|&b| b == b'\n').enumerate() {
        let line = String::from_utf8_lossy(line.trim_ascii());
        let Some(name) = line.strip_prefix("map_Kd").filter(|n| n.starts_with(char::is_whitespace)) else {
            continue;
        };
        let at = format!("line {}", number + 1);
        if name.trim_start().starts_with('-') {
            return Err(source.unsupported(at, "a texture with options"));
        }
        let name = source.bare_name(at.as_str(), name)?;
        if found.as_ref().is_some_and(|f| *f != name) {
            return Err(source.unsupported(at, "a mesh with several base colours"));
        }
        found = Some(name);
    }
    Ok(found)
}

fn floats<'a>(words: impl Iterator<Item = &'a str>, broken: &impl Fn(String) -> Error) -> Result<Vec<f64>> {
    words
        .take_while(|w| !w.starts_with('#'))
        .map(|w| match w.parse::<f64>() {
            Ok(v) if (v as f32).is_finite() => Ok(v),
            _ => Err(broken(format!("`{}` is not a finite number", w.chars().take(40).collect::<String>()))),
        })
        .collect()
}

/// One-based from the start, or negative from the end, to zero-based.
fn resolve(text: &str, count: usize, what: &str, broken: &impl Fn(String) -> Error) -> Result<u32> {
    let index = match text.parse::<i64>() {
        Ok(i) if i > 0 => Some(i - 1),
        Ok(i) if i < 0 => (count as i64).checked_add(i),
        _ => None,
    };
    index.filter(|&i| (0..count as i64).contains(&i)).map(|i| i as u32).ok_or_else(|| {
        let text: String = text.chars().take(40).collect();
        broken(format!("index `{text}`, but there are {count} {what} so far"))
    })
}
