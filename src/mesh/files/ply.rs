//! A mesh as PLY: binary little endian, in the dataset's own world.
//!
//! Neither rotated nor scaled: PLY defines no axes and no unit, and Blender does not rotate it (it does turn OBJ and
//! GLB). Colors are 8-bit and sRGB-coded, as every reader takes them. Positions are `float`, or `double` where
//! the mesh lies so far from the origin that f32 would show.
//!
//! PLY has one index for everything. Without a texture vertices stay whole, and so the surface closed:
//! this is the file that later stages read. With one they are split at seams for the sake
//! of `s t` (v up, Blender's and trimesh's spelling) and names its picture in a comment, as MeshLab
//! does; weld equal positions to close it again.
//!
//! # Reading
//!
//! PLY → mesh: text and both binary orders, any scalar types, any line ends, polygons fanned, strips cut up.
//!
//! Written here because `ply-rs-bw` 4 refuses carriage returns as line ends and several rows of text in one line.

use super::file_mesh::{
    ExportOptions, ExportedFiles, FileMesh, HeadTexture, distance_warning, encode, left_out, safe_name,
};
use super::source::{PictureSource, ReadMesh, Source};
use crate::Result;
use crate::geom::{Atlas, Mesh};
use crate::image::quantize;
use glam::{DVec3, Vec2, Vec3};

/// Returns a mesh as a `.ply`, colored by its vertices; a textured mesh is split at seams, with its picture beside
/// it. The options `up` and `unit_m` do not matter.
///
/// # Errors
///
/// Fails if the mesh is empty or damaged, or if texture and mesh do not belong together.
pub fn to_ply(mesh: &Mesh, texture: Option<&HeadTexture>, options: &ExportOptions) -> Result<ExportedFiles> {
    let world_from_mesh = &options.world_from_mesh;
    let file = FileMesh::new(mesh, texture, world_from_mesh)?.split(false);
    let stem = safe_name(&options.stem);
    let mut files = Vec::new();
    if let Some(texture) = texture {
        let (picture, ending) = encode("base color", &texture.color, options.jpeg_quality)?;
        files.push((format!("{stem}.{ending}"), picture));
    }
    let ply = bytes(&file, files.first().map(|(name, _)| name.as_str()));
    files.insert(0, (format!("{stem}.ply"), ply));
    let mut warnings = left_out(texture, "ply");
    warnings.extend(distance_warning(mesh, world_from_mesh, "ply"));
    Ok(ExportedFiles { files, warnings })
}

fn bytes(mesh: &FileMesh, picture: Option<&str>) -> Vec<u8> {
    let far = mesh.is_far();
    let mut header = String::from("ply\nformat binary_little_endian 1.0\n");
    header += concat!("comment tiface ", env!("CARGO_PKG_VERSION"), "\n");
    header += "comment dataset world, dataset units; vertex colors are sRGB\n";
    if let Some(name) = picture {
        header += &format!("comment TextureFile {name}\n");
    }
    header += &format!("element vertex {}\n", mesh.positions.len());
    let mut property = |kind: &str, names: &[&str]| {
        for name in names {
            header += &format!("property {kind} {name}\n");
        }
    };
    property(if far { "double" } else { "float" }, &["x", "y", "z"]);
    if !mesh.normals.is_empty() {
        property("float", &["nx", "ny", "nz"]);
    }
    if !mesh.colors.is_empty() {
        property("uchar", &["red", "green", "blue"]);
    }
    if !mesh.uvs.is_empty() {
        property("float", &["s", "t"]);
    }
    header += &format!("element face {}\n", mesh.triangles.len());
    header += "property list uchar uint vertex_indices\nend_header\n";

    let mut out = header.into_bytes();
    out.reserve(mesh.positions.len() * if far { 47 } else { 35 } + mesh.triangles.len() * 13);
    for (i, p) in mesh.positions.iter().enumerate() {
        if far {
            out.extend(mesh.place(*p).to_array().iter().flat_map(|v| v.to_le_bytes()));
        } else {
            out.extend(p.to_array().iter().flat_map(|v| v.to_le_bytes()));
        }
        out.extend(mesh.normals.get(i).iter().flat_map(|n| n.to_array()).flat_map(f32::to_le_bytes));
        out.extend(mesh.colors.get(i).into_iter().flatten().map(|&c| quantize(c)));
        if let Some(uv) = mesh.uvs.get(i) {
            out.extend_from_slice(&uv.x.to_le_bytes());
            out.extend_from_slice(&(1.0 - uv.y).to_le_bytes());
        }
    }
    for t in &mesh.triangles {
        out.push(3);
        out.extend(t.iter().flat_map(|i| i.to_le_bytes()));
    }
    out
}

/// A header is a few lines; more is an attack or another format.
const HEADER_BYTES: usize = 1 << 20;

#[derive(Clone, Copy, PartialEq)]
enum Order {
    Text,
    Little,
    Big,
}

#[derive(Clone, Copy, PartialEq)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn named(name: &str) -> Option<Scalar> {
        Some(match name {
            "char" | "int8" => Scalar::I8,
            "uchar" | "uint8" => Scalar::U8,
            "short" | "int16" => Scalar::I16,
            "ushort" | "uint16" => Scalar::U16,
            "int" | "int32" => Scalar::I32,
            "uint" | "uint32" => Scalar::U32,
            "float" | "float32" => Scalar::F32,
            "double" | "float64" => Scalar::F64,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::F64 => 8,
        }
    }

    /// Returns the value of white, for colors.
    fn white(self) -> f64 {
        match self {
            Scalar::U8 => 255.0,
            Scalar::U16 => 65535.0,
            _ => 1.0,
        }
    }
}

struct Property {
    name: String,
    item: Scalar,
    /// The type of a list's length.
    length: Option<Scalar>,
}

struct Element {
    name: String,
    count: usize,
    properties: Vec<Property>,
}

pub(super) fn read(bytes: &[u8], source: Source) -> Result<ReadMesh> {
    let Header { order, elements, start, picture } = header(bytes, source)?;
    let mut body = Body { bytes, at: start, order, source };
    let mut out = ReadMesh::default();
    let mut uvs = None;
    for element in &elements {
        body.check(element)?;
        match element.name.as_str() {
            "vertex" => uvs = vertices(&mut body, element, &mut out)?,
            "face" | "tristrips" => triangles(&mut body, element, &mut out.mesh.triangles)?,
            _ => {
                for _ in 0..element.count {
                    element.properties.iter().try_for_each(|p| body.each(p, |_| Ok(())))?;
                }
            }
        }
    }
    let count = out.places.len();
    for (i, t) in out.mesh.triangles.iter().enumerate() {
        if let Some(v) = t.iter().find(|&&v| v as usize >= count) {
            let what = format!("index {v}, but there are {count} vertices");
            return Err(source.broken(format!("triangle {i}"), what));
        }
    }
    out.atlas = uvs.map(|uvs| Atlas { uvs, triangles: out.mesh.triangles.clone(), width: 0, height: 0 });
    out.picture = picture.map(PictureSource::Beside);
    Ok(out)
}

struct Header {
    order: Order,
    elements: Vec<Element>,
    /// Offset of the body.
    start: usize,
    /// The picture named by `comment TextureFile`, as MeshLab writes it.
    picture: Option<String>,
}

fn header(bytes: &[u8], source: Source) -> Result<Header> {
    let (mut order, mut elements, mut at) = (None, Vec::<Element>::new(), 0);
    let mut picture = None;
    // All lines end as the first one does: the byte after the last line end may be anything, also a line feed.
    let end = bytes.iter().position(|b| b"\r\n".contains(b)).unwrap_or(0);
    let ending: &[u8] = match bytes.get(end..) {
        Some([b'\r', b'\n', ..]) => b"\r\n",
        Some([b'\r', ..]) => b"\r",
        _ => b"\n",
    };
    for number in 1.. {
        let rest = &bytes[at..bytes.len().min(HEADER_BYTES).max(at)];
        let broken = |what: String| source.broken(format!("header line {number}"), what);
        let Some(length) = rest.windows(ending.len()).position(|w| w == ending) else {
            return Err(broken("the header has no end".into()));
        };
        let line = String::from_utf8_lossy(rest[..length].trim_ascii()).into_owned();
        at += length + ending.len();
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match words[..] {
            ["comment", "TextureFile", ref name @ ..] if source.options.texture => {
                let name = source.bare_name(format!("header line {number}"), &name.join(" "))?;
                if picture.as_ref().is_some_and(|p| *p != name) {
                    return Err(source.unsupported(format!("header line {number}"), "a second texture"));
                }
                picture = Some(name);
            }
            ["ply"] | ["comment" | "obj_info", ..] | [] => {}
            ["format", kind, _] => {
                order = match kind {
                    "ascii" => Some(Order::Text),
                    "binary_little_endian" => Some(Order::Little),
                    "binary_big_endian" => Some(Order::Big),
                    _ => return Err(broken(format!("format `{kind}` is unknown"))),
                }
            }
            ["element", name, count] => {
                let count = count.parse().map_err(|_| broken(format!("`{count}` is not a count")))?;
                elements.push(Element { name: name.into(), count, properties: Vec::new() });
            }
            ["property", ref kind @ .., name] => {
                let scalar =
                    |k: &str| Scalar::named(k).ok_or_else(|| broken(format!("type `{k}` is unknown")));
                let (item, length) = match *kind {
                    ["list", length, item] => {
                        let length = scalar(length)?;
                        if matches!(length, Scalar::F32 | Scalar::F64) {
                            return Err(broken("a list length that is not an integer".into()));
                        }
                        (scalar(item)?, Some(length))
                    }
                    [item] => (scalar(item)?, None),
                    _ => return Err(broken(format!("`{line}` is no property"))),
                };
                let element =
                    elements.last_mut().ok_or_else(|| broken("a property before any element".into()))?;
                element.properties.push(Property { name: name.into(), item, length });
            }
            ["end_header"] => {
                let order = order.ok_or_else(|| broken("there was no `format`".into()))?;
                return Ok(Header { order, elements, start: at, picture });
            }
            _ => {
                return Err(broken(format!(
                    "`{}` is not understood",
                    line.chars().take(60).collect::<String>()
                )));
            }
        }
    }
    unreachable!("the loop over line numbers only returns")
}

/// The body after the header, with the reading position.
struct Body<'a> {
    bytes: &'a [u8],
    at: usize,
    order: Order,
    source: Source<'a>,
}

impl Body<'_> {
    /// Checks that the remaining bytes can hold this element, before any allocation.
    fn check(&self, element: &Element) -> Result<()> {
        let sizes = element.properties.iter().map(|p| match self.order {
            Order::Text => 1, // one digit; the spaces are extra
            _ => p.length.unwrap_or(p.item).size(),
        });
        let row: usize = sizes.sum();
        let remain = self.bytes.len() - self.at;
        if element.count > 0 && row == 0 {
            return Err(self.source.broken(format!("element `{}`", element.name), "has no properties"));
        }
        if element.count.checked_mul(row).is_none_or(|n| n > remain) {
            let what = format!("{} of at least {row} bytes each, but {remain} remain", element.count);
            return Err(self.source.broken(format!("element `{}`", element.name), what));
        }
        Ok(())
    }

    fn next(&mut self, scalar: Scalar) -> Result<f64> {
        let at = self.at;
        let broken = |what: String| self.source.broken(format!("byte {at}"), what);
        if self.order == Order::Text {
            let rest = &self.bytes[self.at..];
            let start = rest.iter().position(|b| !b.is_ascii_whitespace()).unwrap_or(rest.len());
            let length =
                rest[start..].iter().position(|b| b.is_ascii_whitespace()).unwrap_or(rest.len() - start);
            let word = String::from_utf8_lossy(&rest[start..start + length.min(64)]);
            self.at += start + length;
            return word.parse().map_err(|_| broken(format!("expected a number, found `{word}`")));
        }
        let size = scalar.size();
        let Some(slice) = self.bytes.get(at..at + size) else {
            return Err(broken("the file ends here".into()));
        };
        self.at += size;
        let mut b = [0u8; 8];
        b[..size].copy_from_slice(slice);
        if self.order == Order::Big {
            b[..size].reverse();
        }
        let [b0, b1, b2, b3, ..] = b;
        Ok(match scalar {
            Scalar::I8 => b0 as i8 as f64,
            Scalar::U8 => b0 as f64,
            Scalar::I16 => i16::from_le_bytes([b0, b1]) as f64,
            Scalar::U16 => u16::from_le_bytes([b0, b1]) as f64,
            Scalar::I32 => i32::from_le_bytes([b0, b1, b2, b3]) as f64,
            Scalar::U32 => u32::from_le_bytes([b0, b1, b2, b3]) as f64,
            Scalar::F32 => f32::from_le_bytes([b0, b1, b2, b3]) as f64,
            Scalar::F64 => f64::from_le_bytes(b),
        })
    }

    /// Calls `take` with the value of a property, or with each value of its list.
    fn each(&mut self, property: &Property, mut take: impl FnMut(f64) -> Result<()>) -> Result<()> {
        let mut count = 1;
        if let Some(length) = property.length {
            let at = self.at;
            let length = self.next(length)?;
            let size = if self.order == Order::Text { 1 } else { property.item.size() };
            let max_length = ((self.bytes.len() - self.at) / size) as f64;
            // negative and fractional lengths fail here too
            if length.fract() != 0.0 || !(0.0..=max_length).contains(&length) {
                let what = format!("a list of {length} values does not fit");
                return Err(self.source.broken(format!("byte {at}"), what));
            }
            count = length as usize;
        }
        for _ in 0..count {
            let value = self.next(property.item)?;
            take(value)?;
        }
        Ok(())
    }
}

/// Adds the vertices; returns their texture coordinates if they are wanted and present.
fn vertices(body: &mut Body, element: &Element, out: &mut ReadMesh) -> Result<Option<Vec<Vec2>>> {
    let source = body.source;
    source.allow(element.count, 0)?;
    if !out.places.is_empty() {
        return Err(source.broken("element `vertex`", "comes twice"));
    }
    let slot = |name: &str| element.properties.iter().position(|p| p.name == name && p.length.is_none());
    let triple = |names: [&str; 3]| match names.map(slot) {
        [Some(a), Some(b), Some(c)] => Some([a, b, c]),
        _ => None,
    };
    let Some(xyz) = triple(["x", "y", "z"]) else {
        return Err(source.broken("element `vertex`", "has no x, y, z"));
    };
    let (normal, color) = (triple(["nx", "ny", "nz"]), triple(["red", "green", "blue"]));
    let spellings = [["s", "t"], ["u", "v"], ["texture_u", "texture_v"]];
    let uv = spellings.into_iter().find_map(|names| match names.map(slot) {
        [Some(s), Some(t)] if source.options.texture => Some([s, t]),
        _ => None,
    });
    let mut uvs = uv.map(|_| Vec::new());
    let mut row = vec![0.0; element.properties.len()];
    for i in 0..element.count {
        for (k, property) in element.properties.iter().enumerate() {
            // lists are none of the slots
            body.each(property, |v| {
                row[k] = v;
                Ok(())
            })?;
        }
        let vector = |at: [usize; 3]| DVec3::from(at.map(|k| row[k]));
        let position = vector(xyz);
        let direction = normal.map_or(Vec3::ZERO, |n| vector(n).as_vec3());
        if !position.as_vec3().is_finite() || !direction.is_finite() {
            return Err(source.broken(format!("vertex {i}"), format!("{position} {direction} is not finite")));
        }
        out.places.push(position);
        if normal.is_some() {
            out.mesh.normals.push(direction.normalize_or_zero());
        }
        if let Some(color) = color {
            let coded = color.map(|k| ((row[k] / element.properties[k].item.white()) as f32).clamp(0.0, 1.0));
            if coded.iter().any(|c| c.is_nan()) {
                return Err(source.broken(format!("vertex {i}"), "its color is not a number"));
            }
            out.mesh.colors.push(coded);
        }
        if let (Some([s, t]), Some(uvs)) = (uv, &mut uvs) {
            // PLY's v runs up
            let uv = Vec2::new(row[s] as f32, 1.0 - row[t] as f32);
            if !uv.is_finite() {
                return Err(source.broken(format!("vertex {i}"), "its texture coordinate is not finite"));
            }
            uvs.push(uv);
        }
    }
    Ok(uvs)
}

/// Adds the triangles of polygons, which are fanned, or of strips, where each corner forms a triangle with the two
/// before it, with alternating winding, and −1 starts a new strip.
fn triangles(body: &mut Body, element: &Element, out: &mut Vec<[u32; 3]>) -> Result<()> {
    let (source, strips) = (body.source, element.name == "tristrips");
    let is_list =
        |p: &Property| p.length.is_some() && ["vertex_indices", "vertex_index"].contains(&p.name.as_str());
    let Some(list) = element.properties.iter().position(is_list) else {
        let what = "has no list `vertex_indices`";
        return Err(source.broken(format!("element `{}`", element.name), what));
    };
    source.allow(0, if strips { 0 } else { element.count })?;
    for i in 0..element.count {
        // number of corners so far, and the two corners that the next one forms a triangle with
        let (mut corners, mut pair) = (0, [0, 0]);
        let mut corner = |v: f64| {
            if strips && v == -1.0 {
                corners = 0;
                return Ok(());
            }
            if v.fract() != 0.0 || !(0.0..4294967295.0).contains(&v) {
                let (name, least) = if strips { ("strip", "−1") } else { ("face", "0") };
                let what = format!("index {v}, expected a whole number from {least}");
                return Err(source.broken(format!("{name} {i}"), what));
            }
            let ([a, b], c) = (pair, v as u32);
            corners += 1;
            // repeated corners of a strip only continue it
            if corners > 2 && !(strips && (a == b || b == c || c == a)) {
                source.allow(0, out.len() + 1)?;
                out.push(if strips && corners % 2 == 0 { [b, a, c] } else { [a, b, c] });
            }
            pair = match corners {
                1 => [c, c],
                2 => [a, c],
                _ => [if strips { b } else { a }, c],
            };
            Ok(())
        };
        for (k, property) in element.properties.iter().enumerate() {
            body.each(property, |v| if k == list { corner(v) } else { Ok(()) })?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::files::file_mesh::tests::tetrahedron;
    use crate::mesh::files::{PictureSource, ReadOptions, read, read_with, weld};
    use glam::Vec3;
    use std::path::Path;

    #[test]
    fn what_is_written_reads_back_in_the_same_world() {
        let mesh = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::new(0.1, 0.2, 0.3)],
            normals: vec![Vec3::Z; 3],
            colors: vec![[0.0, 1.0, 0.2]; 3], // 0.2 is 51/255
            triangles: vec![[0, 1, 2], [2, 1, 0]],
        };
        let bytes = |mesh: &Mesh| to_ply(mesh, None, &ExportOptions::default()).unwrap().files.remove(0).1;
        let ply = bytes(&mesh);
        assert_eq!(read(&ply, Path::new("a.ply")).unwrap(), mesh);
        let bare = Mesh { normals: vec![], colors: vec![], ..mesh };
        let ply = bytes(&bare);
        assert_eq!(read(&ply, Path::new("a.ply")).unwrap(), bare);
        let e = to_ply(&Mesh::default(), None, &ExportOptions::default()).unwrap_err();
        assert!(e.to_string().contains("no triangles"), "{e}");
    }

    #[test]
    fn a_textured_ply_is_split_and_closes_when_welded() {
        let (mesh, texture) = tetrahedron();
        let atlas = &texture.atlas;
        let out = to_ply(&mesh, Some(&texture), &ExportOptions::default()).unwrap();
        let names: Vec<&str> = out.files.iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(names, ["head.ply", "head.png"]);
        let back = read_with(&out.files[0].1, Path::new("a.ply"), &ReadOptions::default()).unwrap();
        assert_eq!(back.picture, Some(PictureSource::Beside("head.png".into())));
        let read_atlas = back.atlas.unwrap();
        for t in 0..4 {
            assert_eq!(back.mesh.corners(t), mesh.corners(t));
            let expected = atlas.triangles[t as usize].map(|i| atlas.uvs[i as usize]);
            assert_eq!(read_atlas.triangles[t as usize].map(|i| read_atlas.uvs[i as usize]), expected);
        }
        assert_eq!(back.mesh.colors.len(), 12);
        assert!(!back.mesh.is_closed() && weld(&back.mesh).is_closed());
    }
}
