//! OBJ → mesh: `v` with optional colours, `vn`, `f` in all its spellings; the rest is passed over.
//!
//! Written here because the reader the ecosystem has splits vertices by object, takes index 0 for
//! "none", and multiplies unchecked indices.

use super::{ReadMeshError, Source};
use crate::geom::Mesh;
use glam::Vec3;

pub(super) fn read(bytes: &[u8], source: Source) -> Result<Mesh, ReadMeshError> {
    let mut mesh = Mesh::default();
    let mut normals: Vec<Vec3> = Vec::new();
    // which normal each vertex was used with; `u32::MAX` for none yet
    let mut normal_of: Vec<u32> = Vec::new();
    let mut normals_agree = true;
    let mut corners: Vec<u32> = Vec::new();
    for (number, line) in bytes.split(|&b| b == b'\n').enumerate() {
        let broken = |what: String| source.broken(format!("line {}", number + 1), what);
        let line = String::from_utf8_lossy(line.trim_ascii());
        let mut words = line.split_ascii_whitespace();
        let keyword = words.next().unwrap_or("");
        if ["v", "vn", "f"].contains(&keyword) && line.ends_with('\\') {
            return Err(source.unsupported(format!("line {}", number + 1), "a continued line"));
        }
        match keyword {
            "v" => {
                let numbers = floats(words, &broken)?;
                let [x, y, z, rest @ ..] = &numbers[..] else {
                    return Err(broken(format!("{} numbers, expected x y z", numbers.len())));
                };
                source.allow(mesh.positions.len() + 1, 0)?;
                mesh.positions.push(Vec3::new(*x, *y, *z));
                normal_of.push(u32::MAX);
                if let [r, g, b] = rest {
                    mesh.colors.push([*r, *g, *b].map(|c| c.clamp(0.0, 1.0)));
                }
            }
            "vn" => {
                let numbers = floats(words, &broken)?;
                let [x, y, z] = numbers[..] else {
                    return Err(broken(format!("{} numbers, expected x y z", numbers.len())));
                };
                normals.push(Vec3::new(x, y, z));
            }
            "f" => {
                corners.clear();
                for word in words {
                    let mut parts = word.split('/');
                    let vertex =
                        resolve(parts.next().unwrap_or(""), mesh.positions.len(), "vertices", &broken)?;
                    let normal = match parts.nth(1) {
                        Some(text) if !text.is_empty() => resolve(text, normals.len(), "normals", &broken)?,
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
                mesh.triangles.extend(corners.windows(2).skip(1).map(|w| [corners[0], w[0], w[1]]));
            }
            _ => {}
        }
    }
    if mesh.colors.len() != mesh.positions.len() {
        mesh.colors.clear();
    }
    if normals_agree && !normal_of.contains(&u32::MAX) {
        mesh.normals = normal_of.iter().map(|&n| normals[n as usize].normalize_or_zero()).collect();
    }
    Ok(mesh)
}

fn floats<'a>(
    words: impl Iterator<Item = &'a str>,
    broken: &impl Fn(String) -> ReadMeshError,
) -> Result<Vec<f32>, ReadMeshError> {
    words
        .take_while(|w| !w.starts_with('#'))
        .map(|w| match w.parse::<f32>() {
            Ok(v) if v.is_finite() => Ok(v),
            _ => Err(broken(format!("`{}` is not a finite number", w.chars().take(40).collect::<String>()))),
        })
        .collect()
}

/// One-based from the start, or negative from the end, to zero-based.
fn resolve(
    text: &str,
    count: usize,
    what: &str,
    broken: &impl Fn(String) -> ReadMeshError,
) -> Result<u32, ReadMeshError> {
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
