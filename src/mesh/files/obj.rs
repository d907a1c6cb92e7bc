//! A mesh as Wavefront OBJ: text, +Y up, meters.
//!
//! Numbers are the shortest that read back as the same f32, which is never more than nine
//! significant digits. `v`, `vt` and `vn` are indexed apart, so a surface that is closed stays closed
//! whatever its seams. Color is `v x y z r g b`, sRGB-coded, or a picture that a `.mtl` beside it
//! names; never both.
//!
//! A mesh far from the origin needs more digits than f32 has: its positions are written with as many as
//! hold a billionth of its size, for readers that keep f64.
//!
//! # Reading
//!
//! OBJ → mesh: `v` with optional colors, `vt`, `vn`, `f` in all its spellings, the names of its materials, and the
//! colors that ZBrush writes in comments (`#MRGB`, eight digits a vertex: mask, red, green, blue); the rest is passed
//! over. Its `.mtl` is read apart.
//!
//! Written here because `tobj` 4 names no line in its errors, refuses lines that go on in the next and comments
//! after a face, takes NaN for a number, passes over faces of two corners and splits vertices by object; it knows no
//! `#MRGB`, and keeps quotes as part of names.

use super::beside::unquoted;
use super::color_range::bring_into_range;
use super::file_mesh::{
    ExportOptions, ExportedFiles, FileMesh, distance_warning, encode, left_out, safe_name,
};
use super::head_texture::HeadTexture;
use super::source::{NO_NORMALS, PictureSource, ReadMesh, Source, line_end};
use crate::Result;
use crate::geom::{Aabb, Atlas, Mesh};
use glam::{DVec3, Vec2, Vec3};
use std::borrow::Cow;
use std::fmt::Display;
use std::io::Write;

/// Returns a mesh as an `.obj`, with a texture also its `.mtl` and its picture, which must lie in one folder; without
/// one it is colored by its vertices.
///
/// # Errors
///
/// Fails if the mesh is empty or damaged, if texture and mesh do not belong together, or if an option is invalid.
pub fn to_obj(mesh: &Mesh, texture: Option<&HeadTexture>, options: &ExportOptions) -> Result<ExportedFiles> {
    let file_from_mesh = options.file_from_mesh()?;
    let mut file = FileMesh::new(mesh, texture, &file_from_mesh)?;
    let (stem, name) = (safe_name(&options.stem), safe_name(&options.name));
    let mut files = Vec::new();
    if let Some(texture) = texture {
        file.colors = Vec::new(); // some readers multiply them into the texture
        let (picture, ending) = encode("base color", &texture.color, options.jpeg_quality)?;
        let mtl = format!(
            "{GENERATOR}\nnewmtl {name}\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {stem}.{ending}\n"
        );
        files.push((format!("{stem}.mtl"), mtl.into_bytes()));
        files.push((format!("{stem}.{ending}"), picture));
    }
    let mut out = Vec::new();
    write(&mut out, &file, &stem, &name).expect("writing to memory does not fail");
    files.insert(0, (format!("{stem}.obj"), out));
    let mut warnings = left_out(texture, "obj");
    warnings.extend(distance_warning(mesh, &file_from_mesh, "obj"));
    Ok(ExportedFiles { files, warnings })
}

/// Files of materials of one mesh; more are an attack.
pub(super) const MAX_LIBRARIES: usize = 64;

const GENERATOR: &str = concat!("# tiface ", env!("CARGO_PKG_VERSION"));

fn write(out: &mut Vec<u8>, file: &FileMesh, stem: &str, name: &str) -> std::io::Result<()> {
    let textured = !file.corners.is_empty();
    if textured {
        writeln!(out, "{GENERATOR}: metres, +Y up\nmtllib {stem}.mtl\no {name}")?;
    } else {
        writeln!(out, "{GENERATOR}: metres, +Y up, sRGB vertex colors\no {name}")?;
    }
    write_vertices(out, file)?;
    for uv in &file.uvs {
        // OBJ's v runs up
        writeln!(out, "vt {} {}", Short(uv.x), Short(1.0 - uv.y))?;
    }
    if textured {
        writeln!(out, "usemtl {name}")?;
    }
    for (t, triangle) in file.triangles.iter().enumerate() {
        write!(out, "f")?;
        for (k, v) in triangle.map(|i| u64::from(i) + 1).into_iter().enumerate() {
            let uv = file.corners.get(t).map(|c| u64::from(c[k]) + 1);
            match (uv, file.normals.is_empty()) {
                (None, true) => write!(out, " {v}")?,
                (None, false) => write!(out, " {v}//{v}")?,
                (Some(uv), true) => write!(out, " {v}/{uv}")?,
                (Some(uv), false) => write!(out, " {v}/{uv}/{v}")?,
            }
        }
        writeln!(out)?;
    }
    Ok(())
}

/// Writes `v`, with colors if the mesh has any, then `vn`.
fn write_vertices(out: &mut Vec<u8>, mesh: &FileMesh) -> std::io::Result<()> {
    out.reserve(mesh.positions.len() * 60 + mesh.triangles.len() * 30);
    let size = Aabb::around(mesh.positions.iter().copied()).size().max_element();
    let digits = (9.0 - size.log10()).ceil().clamp(0.0, 45.0) as usize;
    for (i, p) in mesh.positions.iter().enumerate() {
        if mesh.is_far() {
            let p = mesh.place(*p);
            write!(out, "v {:.digits$} {:.digits$} {:.digits$}", p.x, p.y, p.z)?;
        } else {
            write!(out, "v {} {} {}", Short(p.x), Short(p.y), Short(p.z))?;
        }
        match mesh.colors.get(i).map(|c| c.map(|v| v.clamp(0.0, 1.0))) {
            Some([r, g, b]) => writeln!(out, " {} {} {}", Short(r), Short(g), Short(b))?,
            None => writeln!(out)?,
        }
    }
    for n in &mesh.normals {
        writeln!(out, "vn {} {} {}", Short(n.x), Short(n.y), Short(n.z))?;
    }
    Ok(())
}

/// A number displayed by the shortest digits that give the same f32 back; with an exponent if zeros would fill the line.
struct Short(f32);

impl std::fmt::Display for Short {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let size = self.0.abs();
        if size == 0.0 || (1e-5..1e9).contains(&size) {
            write!(f, "{}", self.0)
        } else {
            write!(f, "{:e}", self.0)
        }
    }
}

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

/// Returns the lines with their numbers. A line that ends with a backslash continues in the next, under its own
/// number; a comment does not.
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

/// Returns whether a word is NaN, as any compiler writes it: `nan`, `-nan(ind)`, `1.#QNAN`, `-1.#IND`.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::files::file_mesh::tests::tetrahedron;
    use crate::mesh::files::{PictureSource, ReadOptions, materials_of_mtl, read, read_with};
    use glam::Vec3;
    use std::path::Path;

    #[test]
    fn a_colored_triangle_is_these_lines() {
        let mesh = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::new(0.0, 0.0, 1e-7)],
            normals: vec![-Vec3::Y; 3],
            colors: vec![[1.0, 0.5, 0.25], [0.0; 3], [2.0, -1.0, 0.1]],
            triangles: vec![[0, 1, 2]],
        };
        let options = ExportOptions { up: Vec3::Z, name: "two\nlines".into(), ..Default::default() };
        let obj = String::from_utf8(to_obj(&mesh, None, &options).unwrap().files.remove(0).1).unwrap();
        // z becomes y; −y, the normal, becomes z
        let expected = "o two_lines\nv 0 0 0 1 0.5 0.25\nv 1 0 0 0 0 0\nv 0 1e-7 0 1 0 0.1\n\
                        vn 0 0 1\nvn 0 0 1\nvn 0 0 1\nf 1//1 2//2 3//3\n";
        assert_eq!(obj.split_once('\n').unwrap().1, expected);
    }

    #[test]
    fn every_number_reads_back_as_itself() {
        let numbers = [1.0f32 / 3.0, 123_456.79, 1e-20, 3e20, f32::MIN_POSITIVE, -0.1];
        let mesh = Mesh {
            positions: numbers.iter().map(|&v| Vec3::new(v, -v, 1.0)).collect(),
            triangles: vec![[0, 1, 2], [3, 4, 5]],
            ..Mesh::default()
        };
        let obj = to_obj(&mesh, None, &ExportOptions::default()).unwrap();
        assert_eq!(read(&obj.files[0].1, Path::new("a.obj")).unwrap(), mesh);
    }

    #[test]
    fn a_textured_obj_stays_closed_and_names_its_files_plainly() {
        let (mesh, texture) = tetrahedron();
        let texture = HeadTexture { normal: Some(texture.color.clone()), ..texture };
        let options =
            ExportOptions { name: "Büste 7".into(), stem: "my head".into(), ..ExportOptions::default() };
        let out = to_obj(&mesh, Some(&texture), &options).unwrap();
        let names: Vec<&str> = out.files.iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(names, ["my_head.obj", "my_head.mtl", "my_head.png"]);
        assert!(out.warnings[0].contains("normal map"));
        let obj = String::from_utf8(out.files[0].1.clone()).unwrap();
        assert_eq!(obj.lines().nth(1), Some("mtllib my_head.mtl"));
        assert!(obj.contains("\nvt 0 0.625\n"), "v = 0.375 from the top is 0.625 from the bottom");
        // object and material are called after the head
        assert!(obj.contains("\no B_ste_7\n") && obj.contains("\nusemtl B_ste_7\nf 1/1/1 3/2/3 2/3/2\n"));
        let mtl = String::from_utf8(out.files[1].1.clone()).unwrap();
        assert!(mtl.contains("\nnewmtl B_ste_7\n"), "{mtl}");
        assert!(mtl.ends_with("Ka 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd my_head.png\n"));
        let materials = materials_of_mtl(&out.files[1].1, Path::new("my_head.mtl")).unwrap();
        assert_eq!(materials[0].picture.as_deref(), Some("my_head.png"));
        let back = read_with(&out.files[0].1, Path::new("a.obj"), &ReadOptions::default()).unwrap();
        assert_eq!(back.picture, Some(PictureSource::Materials(vec!["my_head.mtl".into()])));
        assert!(back.mesh.is_closed() && back.mesh.colors.is_empty());
        let read_atlas = back.atlas.unwrap();
        assert_eq!((&read_atlas.uvs, &read_atlas.triangles), (&texture.atlas.uvs, &texture.atlas.triangles));
    }
}
