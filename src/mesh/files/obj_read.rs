//! OBJ → mesh: `v` with optional colors, `vt`, `vn`, `f` in all its spellings; the rest is passed over.
//! And `map_Kd` of the `.mtl` beside it.
//!
//! Written here because `tobj` 4 names no line in its errors, refuses lines that go on in the next and comments
//! after a face, takes NaN for a number, passes over faces of two corners and splits vertices by object.

use super::source::{ParsedMesh, PictureSource, ReadOptions, Source};
use crate::Result;
use crate::geom::{Atlas, Mesh};
use glam::{DVec3, Vec2, Vec3};
use std::borrow::Cow;
use std::fmt::Display;
use std::path::Path;

/// The mesh as it grows.
#[derive(Default)]
struct Obj {
    positions: Vec<DVec3>,
    /// Colors and triangles.
    mesh: Mesh,
    normals: Vec<Vec3>,
    /// Which normal each vertex was used with, if any.
    normal_of: Vec<Option<u32>>,
    /// Did a vertex get two normals, as on a crease, or none?
    creased: bool,
    atlas: Atlas,
    /// Does a face lack texture coordinates?
    bare: bool,
    library: Option<String>,
    material: Option<String>,
}

pub(super) fn read(bytes: &[u8], source: Source) -> Result<ParsedMesh> {
    let mut obj = Obj::default();
    for (number, line) in lines(bytes) {
        obj.line(&line, &source, &format_args!("line {number}"))?;
    }
    let Obj { positions, mut mesh, normals, normal_of, atlas, .. } = obj;
    if mesh.colors.len() != positions.len() {
        mesh.colors.clear();
    }
    if !obj.creased {
        let normals = normal_of.iter().map(|n| n.map(|n| normals[n as usize].normalize_or_zero()));
        mesh.normals = normals.collect::<Option<_>>().unwrap_or_default();
    }
    let atlas = (source.options.texture && !obj.bare).then_some(atlas);
    let picture = obj.library.map(PictureSource::Material);
    Ok(ParsedMesh { positions, mesh, atlas, picture, tint: None })
}

impl Obj {
    fn line(&mut self, line: &str, source: &Source, at: &dyn Display) -> Result<()> {
        let mut words = line.split_ascii_whitespace().take_while(|w| !w.starts_with('#'));
        let few = |numbers: &[f64], expected: &str| {
            source.broken(at, format!("{} numbers, expected {expected}", numbers.len()))
        };
        match words.next().unwrap_or("") {
            "v" => {
                let numbers = floats(words, source, at)?;
                let [x, y, z, rest @ ..] = &numbers[..] else { return Err(few(&numbers, "x y z")) };
                source.allow(self.positions.len() + 1, 0)?;
                self.positions.push(DVec3::new(*x, *y, *z));
                self.normal_of.push(None);
                if let [r, g, b] = rest {
                    self.mesh.colors.push([*r, *g, *b].map(|c| c.clamp(0.0, 1.0) as f32));
                }
            }
            "vn" => {
                let numbers = floats(words, source, at)?;
                let [x, y, z] = numbers[..] else { return Err(few(&numbers, "x y z")) };
                self.normals.push(DVec3::new(x, y, z).as_vec3());
            }
            "vt" if source.options.texture => {
                let numbers = floats(words, source, at)?;
                let [u, v, ..] = numbers[..] else { return Err(few(&numbers, "u v")) };
                source.allow(self.atlas.uvs.len() + 1, 0)?;
                self.atlas.uvs.push(Vec2::new(u as f32, 1.0 - v as f32));
            }
            "mtllib" if source.options.texture && self.library.is_none() => {
                let name = line.strip_prefix("mtllib").unwrap_or("");
                self.library = Some(source.bare_name(at, name)?);
            }
            "usemtl" if source.options.texture => {
                let name = words.collect::<Vec<_>>().join(" ");
                if !self.mesh.triangles.is_empty() && self.material.as_ref() != Some(&name) {
                    return Err(source.unsupported(at, "a mesh with several materials"));
                }
                self.material = Some(name);
            }
            "f" => self.face(words, source, at)?,
            _ => {}
        }
        Ok(())
    }

    fn face<'w>(
        &mut self,
        words: impl Iterator<Item = &'w str>,
        source: &Source,
        at: &dyn Display,
    ) -> Result<()> {
        let (mut corners, mut mapped) = (Vec::new(), Vec::new());
        for word in words {
            let mut parts = word.split('/');
            let mut part = || parts.next().unwrap_or("");
            let vertex = resolve(part(), self.positions.len(), "vertices", source, at)?;
            let (uv, normal) = (part(), part());
            if source.options.texture && !uv.is_empty() {
                mapped.push(resolve(uv, self.atlas.uvs.len(), "texture coordinates", source, at)?);
            }
            let known = &mut self.normal_of[vertex as usize];
            // some programs name normals that they do not write
            if normal.is_empty() || self.normals.is_empty() {
                (self.creased, *known) = (true, None);
            } else {
                let normal = resolve(normal, self.normals.len(), "normals", source, at)?;
                let value = self.normals[normal as usize];
                self.creased |= known.is_some_and(|known| self.normals[known as usize] != value);
                *known = Some(normal);
            }
            corners.push(vertex);
        }
        if corners.len() < 3 {
            return Err(
                source.broken(at, format!("a face with {} corners, expected at least 3", corners.len()))
            );
        }
        source.allow(0, self.mesh.triangles.len() + corners.len() - 2)?;
        let fan = |c: &[u32], out: &mut Vec<[u32; 3]>| {
            out.extend(c.windows(2).skip(1).map(|w| [c[0], w[0], w[1]]));
        };
        fan(&corners, &mut self.mesh.triangles);
        self.bare |= mapped.len() != corners.len();
        if !self.bare {
            fan(&mapped, &mut self.atlas.triangles);
        }
        Ok(())
    }
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

/// The bare name of the picture that a `.mtl` file gives as its base color (`map_Kd`), if any.
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
            return Err(source.unsupported(at, "a mesh with several base colors"));
        }
        found = Some(name);
    }
    Ok(found)
}

fn floats<'w>(words: impl Iterator<Item = &'w str>, source: &Source, at: &dyn Display) -> Result<Vec<f64>> {
    let float = |w: &str| match w.parse::<f64>() {
        Ok(v) if (v as f32).is_finite() => Ok(v),
        _ => Err(source.broken(at, format!("`{}` is not a finite number", start(w)))),
    };
    words.map(float).collect()
}

/// One-based from the start, or negative from the end, to zero-based.
fn resolve(text: &str, count: usize, what: &str, source: &Source, at: &dyn Display) -> Result<u32> {
    let index = match text.parse::<i64>() {
        Ok(i) if i > 0 => Some(i - 1),
        Ok(i) if i < 0 => (count as i64).checked_add(i),
        _ => None,
    };
    index.filter(|&i| (0..count as i64).contains(&i)).map(|i| i as u32).ok_or_else(|| {
        source.broken(at, format!("index `{}`, but there are {count} {what} so far", start(text)))
    })
}

/// As much of a word as a message can show.
fn start(word: &str) -> String {
    word.chars().take(40).collect()
}
