//! Reading of PLY: text and both binary orders, any scalar types, any line ends, polygons fanned,
//! strips cut up.
//!
//! Colors stand at vertices or on faces, under the names that programs give them; texture
//! coordinates at vertices, or at the corners of faces as MeshLab writes them (`texcoord`, with
//! `texnumber` for the picture).
//!
//! Written here because `ply-rs-bw` 4 refuses carriage returns as line ends and several rows of
//! text in one line.

use super::beside::unquoted;
use super::color_range::{at_vertices, bring_into_range};
use super::ply_element::{Element, Property, Scalar};
use super::source::{NO_NORMALS, PictureSource, ReadMesh, Source};
use glam::{DVec3, Vec2, Vec3};
use tiface_base::Result;
use tiface_base::geom::Atlas;

/// A header is a few lines; more is an attack or another format.
const HEADER_BYTES: usize = 1 << 20;

#[derive(Clone, Copy, PartialEq)]
enum Order {
    Text,
    Little,
    Big,
}

impl Order {
    fn named(word: &str) -> Option<Order> {
        match word {
            "ascii" => Some(Order::Text),
            "binary_little_endian" => Some(Order::Little),
            "binary_big_endian" => Some(Order::Big),
            _ => None,
        }
    }
}

pub(super) fn read(bytes: &[u8], source: Source) -> Result<ReadMesh> {
    let Header { order, elements, start, pictures } = header(bytes, source)?;
    let mut body = Body { bytes, at: start, order, source };
    let (mut out, mut faces) = (ReadMesh::default(), Faces::default());
    let mut uvs = None;
    for element in &elements {
        body.check(element)?;
        match element.name.to_ascii_lowercase().as_str() {
            "vertex" => uvs = vertices(&mut body, element, &mut out)?,
            "face" | "tristrips" => triangles(&mut body, element, &mut faces)?,
            name => {
                if name.contains("texture") && source.options.texture {
                    out.note(format!("the element `{name}` is not looked at"));
                }
                for _ in 0..element.count {
                    element.properties.iter().try_for_each(|p| body.each(p, |_| Ok(())))?;
                }
            }
        }
    }
    let count = out.places.len();
    for (i, t) in faces.triangles.iter().enumerate() {
        if let Some(v) = t.iter().find(|&&v| v as usize >= count) {
            let what = format!("index {v}, but there are {count} vertices");
            return Err(source.broken(format!("triangle {i}"), what));
        }
    }
    out.picture = picture(&pictures, &faces, source)?.map(PictureSource::Beside);
    let Faces { triangles, colors, wedges, is_mapped, .. } = faces;
    out.mesh.triangles = triangles;
    let has_face_colors = out.mesh.colors.is_empty() && !colors.is_empty();
    if has_face_colors && colors.len() == out.mesh.triangles.len() {
        out.mesh.colors = at_vertices(count, &out.mesh.triangles, |t| colors[t]);
        out.note("its faces have colors; vertices show the mean of those around them");
    }
    if out.mesh.colors.is_empty() && out.picture.is_none() {
        let mut others = elements.iter().filter(|e| e.count > 0);
        if let Some((element, name)) = others.find_map(|e| Some((e, e.like_a_color()?))) {
            let (name, of) = (shown(name), shown(&element.name));
            let ways = "colors are read from `red`, `green` and `blue` of vertices or faces";
            out.note(format!("the property `{name}` of `{of}` is not shown: {ways}"));
        }
    } else if !colors.is_empty() && out.picture.is_none() && !has_face_colors {
        out.note("its faces have colors, too; those of its vertices are shown");
    }
    let range = bring_into_range(&mut out.mesh.colors, "colors");
    range.into_iter().for_each(|note| out.note(note));
    // coordinates at corners decide, unless a face lacks them
    let at_corners = is_mapped.then_some(wedges).filter(|at| at.triangles.len() == out.mesh.triangles.len());
    let of_vertices = |uvs| Atlas { uvs, triangles: out.mesh.triangles.clone(), width: 0, height: 0 };
    out.atlas = at_corners.or_else(|| uvs.map(of_vertices));
    Ok(out)
}

/// Returns the name of the only picture that faces show.
fn picture(pictures: &[String], faces: &Faces, source: Source) -> Result<Option<String>> {
    let Some(first) = pictures.first() else { return Ok(None) };
    let Some(second) = pictures.iter().find(|name| *name != first) else { return Ok(Some(first.clone())) };
    match faces.page {
        Some(page) if !faces.has_pages && (0.0..pictures.len() as f64).contains(&page) => {
            Ok(Some(pictures[page as usize].clone()))
        }
        _ => Err(source.unsupported("the header", format!("a second texture, `{second}` beside `{first}`,"))),
    }
}

struct Header {
    order: Order,
    elements: Vec<Element>,
    /// Offset of the body.
    start: usize,
    /// The pictures named by `comment TextureFile`, as MeshLab writes it, in the order of
    /// `texnumber`.
    pictures: Vec<String>,
}

fn header(bytes: &[u8], source: Source) -> Result<Header> {
    let (mut order, mut elements, mut at) = (None, Vec::<Element>::new(), 0);
    let mut pictures = Vec::<String>::new();
    // All lines end as the first one does: the byte after the last line end may be anything, also a
    // line feed.
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
            ["comment", key, ..] if source.options.texture && is_texture_key(key) => {
                let name = line.split_once(key).map_or("", |(_, name)| name);
                pictures.push(unquoted(name).to_owned());
            }
            ["ply"] | ["comment" | "obj_info", ..] | [] => {}
            ["format", kind, _] => {
                let named = Order::named(kind);
                order = Some(named.ok_or_else(|| broken(format!("format `{kind}` is unknown")))?);
            }
            ["element", name, count] => {
                let count = count.parse().map_err(|_| broken(format!("`{count}` is not a count")))?;
                elements.push(Element { name: name.into(), count, properties: Vec::new() });
            }
            ["property", ref kind @ .., name] => {
                let (item, length) = property_type(kind, &line).map_err(broken)?;
                let element =
                    elements.last_mut().ok_or_else(|| broken("a property before any element".into()))?;
                element.properties.push(Property { name: name.into(), item, length });
            }
            ["end_header"] => {
                let order = order.ok_or_else(|| broken("there was no `format`".into()))?;
                return Ok(Header { order, elements, start: at, pictures });
            }
            _ => {
                return Err(broken(format!("`{}` is not understood", shown(&line))));
            }
        }
    }
    unreachable!("the loop over line numbers only returns")
}

/// Returns the type of a property's items, and that of the length of a list.
fn property_type(kind: &[&str], line: &str) -> Result<(Scalar, Option<Scalar>), String> {
    let scalar = |k: &str| Scalar::named(k).ok_or_else(|| format!("type `{k}` is unknown"));
    match *kind {
        ["list", length, item] => {
            let length = scalar(length)?;
            if matches!(length, Scalar::F32 | Scalar::F64) {
                return Err("a list length that is not an integer".into());
            }
            Ok((scalar(item)?, Some(length)))
        }
        [item] => Ok((scalar(item)?, None)),
        _ => Err(format!("`{line}` is no property")),
    }
}

/// Returns the beginning of a text, for messages.
fn shown(text: &str) -> String {
    text.chars().take(60).collect()
}

/// Returns whether a comment begins with a key that names a picture.
fn is_texture_key(key: &str) -> bool {
    key.trim_end_matches(':').eq_ignore_ascii_case("TextureFile")
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
            let what = || format!("expected a number, found `{word}`");
            return word.parse().map_err(|_| self.source.no_number(format!("byte {at}"), what(), &word));
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
    let Some(xyz) = element.slots(["x", "y", "z"]) else {
        return Err(source.broken("element `vertex`", "has no x, y, z"));
    };
    let (normal, color) = (element.slots(["nx", "ny", "nz"]), element.color());
    let packed = element.packed_color();
    // whole numbers up to 255; of another type they are another program's
    let seen_by = element.slots(["seen_by"]).filter(|[k]| element.properties[*k].item == Scalar::U8);
    let alpha = color
        .and_then(|_| ["alpha", "diffuse_alpha", "a"].into_iter().find_map(|name| element.slots([name])));
    let mut opacity = f64::INFINITY;
    let spellings = [["s", "t"], ["u", "v"], ["texture_u", "texture_v"], ["texcoord_u", "texcoord_v"]];
    let uv = spellings.into_iter().find_map(|names| element.slots(names)).filter(|_| source.options.texture);
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
        if !position.as_vec3().is_finite() {
            return Err(source.broken(format!("vertex {i}"), format!("{position} is not finite")));
        }
        out.places.push(position);
        if normal.is_some() && direction.is_finite() {
            out.mesh.normals.push(direction.normalize_or_zero());
        }
        if let Some(color) = color {
            let coded = element.coded_color(color, &row);
            let what = "its color is not a number";
            out.mesh.colors.push(coded.ok_or_else(|| source.broken(format!("vertex {i}"), what))?);
        }
        out.mesh.colors.extend(packed.and_then(|k| element.properties[k].unpacked(row[k])));
        out.mesh.seen_by.extend(seen_by.map(|[k]| row[k] as u8));
        if let Some([k]) = alpha {
            opacity = opacity.min(f64::from(element.properties[k].coded(row[k])));
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
    // programs write NaN for vertices of triangles without an area
    if normal.is_some() && out.mesh.normals.len() != element.count {
        out.mesh.normals.clear();
        out.note(NO_NORMALS);
    }
    // a color that is none makes all of them unsure
    if out.mesh.colors.len() != element.count {
        out.mesh.colors.clear();
    }
    if opacity < 1.0 {
        out.note(format!("colors have an alpha down to {opacity:.2}; they are shown opaque"));
    }
    Ok(uvs)
}

/// The triangles of a file, with what stands at faces and their corners.
#[derive(Default)]
struct Faces {
    triangles: Vec<[u32; 3]>,
    /// Colors of the triangles.
    colors: Vec<[f32; 3]>,
    /// Texture coordinates of corners; of fewer triangles if faces lack them.
    wedges: Atlas,
    /// Whether faces can have texture coordinates.
    is_mapped: bool,
    /// The number of the picture of the first face, and whether another face has another.
    page: Option<f64>,
    has_pages: bool,
}

impl Faces {
    /// Adds the texture coordinates of a polygon's corners, `u v` each, fanned as its triangles
    /// are.
    fn add_wedges(
        &mut self,
        at: &dyn std::fmt::Display,
        coords: &[f64],
        corners: usize,
        source: Source,
    ) -> Result<()> {
        if coords.is_empty() {
            return Ok(());
        }
        if coords.len() != 2 * corners {
            let what =
                format!("{} numbers in `texcoord`, expected u and v of {corners} corners", coords.len());
            return Err(source.broken(at, what));
        }
        let first = self.wedges.uvs.len() as u32;
        // PLY's v runs up
        self.wedges
            .uvs
            .extend(coords.as_chunks::<2>().0.iter().map(|[u, v]| Vec2::new(*u as f32, 1.0 - *v as f32)));
        if self.wedges.uvs[first as usize..].iter().any(|uv| !uv.is_finite()) {
            return Err(source.broken(at, "its texture coordinate is not finite"));
        }
        self.wedges.triangles.extend((2..corners as u32).map(|k| [first, first + k - 1, first + k]));
        Ok(())
    }
}

/// A polygon, which is fanned, or a strip, where each corner forms a triangle with the two before
/// it, with alternating winding.
struct Polygon {
    strips: bool,
    /// Number of corners so far.
    corners: usize,
    /// The two corners that the next one forms a triangle with.
    pair: [u32; 2],
}

impl Polygon {
    /// Adds a corner, and returns the triangle that it completes.
    fn triangle_with(&mut self, c: u32) -> Option<[u32; 3]> {
        let (strips, [a, b]) = (self.strips, self.pair);
        self.corners += 1;
        self.pair = match self.corners {
            1 => [c, c],
            2 => [a, c],
            _ => [if strips { b } else { a }, c],
        };
        // repeated corners of a strip only continue it
        let is_new = self.corners > 2 && !(strips && (a == b || b == c || c == a));
        let is_turned = strips && self.corners.is_multiple_of(2);
        is_new.then_some(if is_turned { [b, a, c] } else { [a, b, c] })
    }
}

/// Adds the triangles of polygons, or of strips, where −1 starts a new strip.
fn triangles(body: &mut Body, element: &Element, out: &mut Faces) -> Result<()> {
    let (source, strips) = (body.source, element.name.eq_ignore_ascii_case("tristrips"));
    let list_of = |names: &[&str]| {
        let is_it = |p: &Property| names.iter().any(|name| p.name.eq_ignore_ascii_case(name));
        element.properties.iter().position(|p| p.length.is_some() && is_it(p))
    };
    let Some(list) = list_of(&["vertex_indices", "vertex_index"]) else {
        let what = "has no list `vertex_indices`";
        return Err(source.broken(format!("element `{}`", element.name), what));
    };
    let coordinates = list_of(&["texcoord"]).filter(|_| source.options.texture && !strips);
    let (color, page) = (element.color(), element.slots(["texnumber"]));
    out.is_mapped |= coordinates.is_some();
    source.allow(0, if strips { 0 } else { element.count })?;
    let (mut row, mut coords) = (vec![0.0; element.properties.len()], Vec::new());
    for i in 0..element.count {
        let first = out.triangles.len();
        let mut polygon = Polygon { strips, corners: 0, pair: [0, 0] };
        let mut corner = |v: f64| {
            if strips && v == -1.0 {
                polygon.corners = 0;
                return Ok(());
            }
            if v.fract() != 0.0 || !(0.0..4294967295.0).contains(&v) {
                let (name, least) = if strips { ("strip", "−1") } else { ("face", "0") };
                let what = format!("index {v}, expected a whole number from {least}");
                return Err(source.broken(format!("{name} {i}"), what));
            }
            if let Some(triangle) = polygon.triangle_with(v as u32) {
                source.allow(0, out.triangles.len() + 1)?;
                out.triangles.push(triangle);
            }
            Ok(())
        };
        coords.clear();
        for (k, property) in element.properties.iter().enumerate() {
            body.each(property, |v| {
                if k == list {
                    return corner(v);
                }
                if Some(k) == coordinates {
                    coords.push(v);
                }
                row[k] = v;
                Ok(())
            })?;
        }
        if let Some(color) = color {
            let coded = element.coded_color(color, &row);
            let what = "its color is not a number";
            let coded = coded.ok_or_else(|| source.broken(format!("face {i}"), what))?;
            out.colors.resize(out.triangles.len(), coded);
        }
        if let Some([k]) = page {
            out.has_pages |= *out.page.get_or_insert(row[k]) != row[k];
        }
        if coordinates.is_some() && out.triangles.len() > first {
            out.add_wedges(&format_args!("face {i}"), &coords, polygon.corners, source)?;
        }
    }
    Ok(())
}
