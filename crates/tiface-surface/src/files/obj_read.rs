//! OBJ → mesh: `v` with optional colors, `vt`, `vn`, `f` in all its spellings, the names of its
//! materials, and the colors that ZBrush writes in comments (`#MRGB`, eight digits a vertex: mask,
//! red, green, blue); the rest is passed over. Its `.mtl` is read apart.
//!
//! Written here because `tobj` 4 names no line in its errors, refuses lines that go on in the next
//! and comments after a face, takes NaN for a number, passes over faces of two corners and splits
//! vertices by object; it knows no `#MRGB`, and keeps quotes as part of names.

use super::beside::unquoted;
use super::color_range::bring_into_range;
use super::source::{NO_NORMALS, PictureSource, ReadMesh, Source, line_end};
use glam::{DVec3, Vec2, Vec3};
use std::borrow::Cow;
use std::fmt::Display;
use tiface_base::Result;
use tiface_base::geom::Atlas;

/// Files of materials of one mesh; more are an attack.
pub(super) const MAX_LIBRARIES: usize = 64;

/// A mesh while the lines of its file are read.
#[derive(Default)]
struct Obj {
    out: ReadMesh,
    atlas: Atlas,
    normals: Vec<Vec3>,
    /// Index of the normal that each vertex was used with, if any.
    normal_of: Vec<Option<u32>>,
    /// Whether a vertex has two normals, as on a crease, or none.
    creased: bool,
    /// Whether a face lacks texture coordinates.
    bare: bool,
    /// The material of the faces that follow.
    material: Option<String>,
    /// Colors of `#MRGB`, and whether one of its lines is damaged.
    paint: Vec<[f32; 3]>,
    is_paint_damaged: bool,
}

pub(super) fn read(bytes: &[u8], source: Source) -> Result<ReadMesh> {
    let mut obj = Obj::default();
    for (number, line) in lines(bytes) {
        obj.line(&line, &source, &format_args!("line {number}"))?;
    }
    obj.finish_colors();
    let Obj { mut out, normals, normal_of, atlas, .. } = obj;
    if !obj.creased {
        let normals = normal_of.iter().map(|n| n.map(|n| normals[n as usize].normalize_or_zero()));
        out.mesh.normals = normals.collect::<Option<_>>().unwrap_or_default();
    }
    out.atlas = (source.options.texture && !obj.bare).then_some(atlas);
    Ok(out)
}

impl Obj {
    fn line(&mut self, line: &str, source: &Source, at: &dyn Display) -> Result<()> {
        if let Some(code) = line.strip_prefix("#MRGB") {
            return self.read_paint(code.trim(), source);
        }
        let mut words = line.split_ascii_whitespace().take_while(|w| !w.starts_with('#'));
        let few = |numbers: &[f64], expected: &str| {
            source.broken(at, format!("{} numbers, expected {expected}", numbers.len()))
        };
        match words.next().unwrap_or("") {
            "v" => {
                let numbers = floats(words, source, at)?;
                let [x, y, z, rest @ ..] = &numbers[..] else { return Err(few(&numbers, "x y z")) };
                source.allow(self.out.places.len() + 1, 0)?;
                self.out.places.push(DVec3::new(*x, *y, *z));
                self.normal_of.push(None);
                if let [r, g, b] | [r, g, b, _] = rest {
                    self.out.mesh.colors.push([*r, *g, *b].map(|c| c as f32));
                }
                if rest.len() == 4 {
                    let what = "vertices have seven numbers: x y z, red, green, blue, and an alpha that is not shown";
                    self.out.note(what);
                }
            }
            // programs write them for triangles without an area
            "vn" if words.clone().any(is_no_number) => {
                self.creased = true;
                self.normals.push(Vec3::ZERO);
                self.out.note(NO_NORMALS);
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
            "f" => self.face(words, source, at)?,
            key if source.options.texture && key.eq_ignore_ascii_case("mtllib") => {
                let names = line[key.len()..].trim().to_owned();
                match &mut self.out.picture {
                    Some(PictureSource::Materials(all)) if all.contains(&names) => {}
                    Some(PictureSource::Materials(all)) if all.len() < MAX_LIBRARIES => all.push(names),
                    Some(_) => {
                        return Err(
                            source.broken(at, format!("more than {MAX_LIBRARIES} files of materials"))
                        );
                    }
                    None => self.out.picture = Some(PictureSource::Materials(vec![names])),
                }
            }
            key if source.options.texture && key.eq_ignore_ascii_case("usemtl") => {
                self.material = Some(unquoted(&line[key.len()..]).into());
            }
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
            let vertex = resolve(part(), self.out.places.len(), "vertices", source, at)?;
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
        let first = self.out.mesh.triangles.len();
        source.allow(0, first + corners.len() - 2)?;
        let last = self.out.materials.last().map(|(_, name)| name);
        if let Some(name) = self.material.take().filter(|name| last != Some(name)) {
            self.out.materials.push((first as u32, name));
        }
        let fan = |c: &[u32], out: &mut Vec<[u32; 3]>| {
            out.extend(c.windows(2).skip(1).map(|w| [c[0], w[0], w[1]]));
        };
        fan(&corners, &mut self.out.mesh.triangles);
        self.bare |= mapped.len() != corners.len();
        if !self.bare {
            fan(&mapped, &mut self.atlas.triangles);
        }
        Ok(())
    }
}

impl Obj {
    /// Adds the colors of a line of `#MRGB`.
    fn read_paint(&mut self, code: &str, source: &Source) -> Result<()> {
        source.allow(self.paint.len() + code.len() / 8, 0)?;
        for block in code.as_bytes().chunks(8) {
            let word = std::str::from_utf8(block).ok().filter(|word| word.len() == 8);
            match word.and_then(|word| u32::from_str_radix(word, 16).ok()) {
                Some(word) => {
                    let [_, r, g, b] = word.to_be_bytes();
                    self.paint.push([r, g, b].map(|c| f32::from(c) / 255.0));
                }
                None => self.is_paint_damaged = true,
            }
        }
        Ok(())
    }

    /// Chooses the colors of the vertices, and brings them into range.
    fn finish_colors(&mut self) {
        let (vertices, painted) = (self.out.places.len(), self.paint.len());
        let colors = &mut self.out.mesh.colors;
        if painted == vertices && !self.is_paint_damaged {
            *colors = std::mem::take(&mut self.paint);
        } else if painted > 0 || self.is_paint_damaged {
            self.out.note(format!("`#MRGB` is not shown: it has {painted} colors for {vertices} vertices"));
        }
        let colored = self.out.mesh.colors.len();
        if colored != vertices {
            self.out.mesh.colors.clear();
            if colored > 0 {
                self.out.note(format!("colors are not shown: {colored} of {vertices} vertices have one"));
            }
        }
        let range = bring_into_range(&mut self.out.mesh.colors, "vertex colors");
        range.into_iter().for_each(|note| self.out.note(note));
    }
}

/// Returns the lines with their numbers. A line that ends with a backslash continues in the next,
/// under its own number; a comment does not.
fn lines(bytes: &[u8]) -> impl Iterator<Item = (usize, Cow<'_, str>)> {
    let end = line_end(bytes);
    let mut lines = bytes.split(move |&b| b == end).map(|line| line.trim_ascii()).zip(1..);
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

/// Returns whether a word is NaN, as any compiler writes it: `nan`, `-nan(ind)`, `1.#QNAN`,
/// `-1.#IND`.
fn is_no_number(word: &str) -> bool {
    let word = word.trim_start_matches(['-', '+']);
    let begins = |with: &str| word.get(..with.len()).is_some_and(|start| start.eq_ignore_ascii_case(with));
    ["nan", "1.#qnan", "1.#ind"].into_iter().any(begins)
}

fn floats<'w>(words: impl Iterator<Item = &'w str>, source: &Source, at: &dyn Display) -> Result<Vec<f64>> {
    let float = |w: &str| match w.parse::<f64>() {
        Ok(v) if (v as f32).is_finite() => Ok(v),
        _ => Err(source.no_number(at, format!("`{}` is not a finite number", start(w)), &start(w))),
    };
    words.map(float).collect()
}

/// Converts an index, one-based from the start or negative from the end, to a zero-based one.
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

/// Returns the beginning of a word, for messages.
fn start(word: &str) -> String {
    word.chars().take(40).collect()
}
