//! A mesh with a texture, before it becomes a file.
//!
//! `Mesh` and [`Atlas`] are indexed apart, as OBJ is: a vertex on a seam has one position and several
//! texture coordinates, and the surface stays closed. GLB and textured PLY have one index for
//! everything, so there vertices are split where corners disagree. The copies are bit-identical in
//! position and normal: welding equal positions closes the surface again.

use super::export::{ExportError, Ready, has_three_corners, ready};
use crate::geom::{Atlas, Mesh, Similarity};
use crate::image::Photo;
use glam::{Vec2, Vec3, Vec4};
use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use serde_json::{Map, Value};
use std::collections::HashMap;

/// A mesh, where it lies in its texture, and the texture.
#[derive(Clone, Debug)]
pub struct Textured<'a> {
    /// The surface. Its vertex colours stay behind where a texture is written, except in PLY.
    pub mesh: &'a Mesh,
    /// Where its triangles lie in the pictures.
    pub atlas: &'a Atlas,
    /// Base colour, sRGB-coded; its alpha is not written.
    pub color: &'a Photo,
    /// Normals in tangent space: linear, +X along u, +Y up the picture (OpenGL), for the tangents of
    /// [`super::tangents::tangents`]. GLB only.
    pub normal: Option<&'a Photo>,
    /// Further textures, for colours that depend on the view. GLB only.
    pub lobes: Vec<Lobe<'a>>,
    /// What a reader must know to use the lobes; goes into the material's `extras.tiface`, beside our
    /// own list `lobes`.
    pub extras: Map<String, Value>,
}

/// One further texture.
#[derive(Clone, Debug)]
pub struct Lobe<'a> {
    /// What it is called in the file.
    pub name: String,
    /// Its picture; its alpha is not written.
    pub picture: &'a Photo,
}

impl<'a> Textured<'a> {
    /// A mesh with a base colour alone.
    pub fn new(mesh: &'a Mesh, atlas: &'a Atlas, color: &'a Photo) -> Textured<'a> {
        Textured { mesh, atlas, color, normal: None, lobes: Vec::new(), extras: Map::new() }
    }
}

/// How colours are stored. Normal maps are always PNG.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PictureFormat {
    /// Lossless.
    #[default]
    Png,
    /// Smaller, and a little wrong.
    Jpeg {
        /// 1..=100.
        quality: u8,
    },
}

/// How a textured mesh is stored.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TextureOptions {
    /// What the files are called, without ending. Other characters than ASCII letters, digits, `-`,
    /// `_` and `.` become `_`, since readers of MTL take a space for the end of a name.
    pub stem: String,
    /// How colours are stored.
    pub picture: PictureFormat,
    /// GLB only: `KHR_mesh_quantization`, 16 bits a number. About half the size of the vertices; the
    /// error is half of 1/65,535 of the longest side of the box. Some readers cannot: see the warning.
    pub quantize: bool,
}

impl Default for TextureOptions {
    fn default() -> TextureOptions {
        TextureOptions { stem: "head".into(), picture: PictureFormat::Png, quantize: false }
    }
}

/// Files that belong together, to be written side by side.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Exported {
    /// Bare names and bytes; the mesh comes first.
    pub files: Vec<(String, Vec<u8>)>,
    /// What the format could not hold, or which readers will stumble.
    pub warnings: Vec<String>,
}

/// A textured mesh that can be written: checked, turned, scaled; still indexed apart.
pub(super) struct Prepared {
    pub ready: Ready,
    /// + 0, so that equal coordinates are equal bytes.
    pub uvs: Vec<Vec2>,
    /// Parallel to `ready.triangles`.
    pub corners: Vec<[u32; 3]>,
}

pub(super) fn prepare(textured: &Textured, file_from_mesh: &Similarity) -> Result<Prepared, ExportError> {
    let Textured { mesh, atlas, .. } = *textured;
    check_atlas(mesh, atlas)?;
    let ready = ready(mesh, file_from_mesh)?;
    check_picture("base colour", textured.color, atlas)?;
    if let Some(normal) = textured.normal {
        check_picture("normal map", normal, atlas)?;
        if ready.normals.is_empty() {
            // nothing to be tangent to
            return Err(ExportError::Length { what: "normals", found: 0, expected: mesh.positions.len() });
        }
    }
    for lobe in &textured.lobes {
        check_picture(&format!("texture `{}`", lobe.name), lobe.picture, atlas)?;
    }
    let kept = mesh.triangles.iter().zip(&atlas.triangles).filter(|(t, _)| has_three_corners(t));
    let corners = kept.map(|(_, c)| *c).collect();
    let uvs = atlas.uvs.iter().map(|&uv| uv + Vec2::ZERO).collect();
    Ok(Prepared { ready, uvs, corners })
}

/// Does the atlas belong to this mesh, and does it stay on its texture?
pub(super) fn check_atlas(mesh: &Mesh, atlas: &Atlas) -> Result<(), ExportError> {
    let (found, expected) = (atlas.triangles.len(), mesh.triangles.len());
    if found != expected {
        return Err(ExportError::AtlasLength { found, expected });
    }
    let uvs = atlas.uvs.len();
    for (triangle, t) in atlas.triangles.iter().enumerate() {
        if let Some(&index) = t.iter().find(|&&i| i as usize >= uvs) {
            return Err(ExportError::AtlasIndex { triangle, index, uvs });
        }
    }
    let inside = |uv: &Vec2| uv.to_array().iter().all(|v| (0.0..=1.0).contains(v));
    match atlas.uvs.iter().position(|uv| !inside(uv)) {
        Some(index) => Err(ExportError::Uv { index, found: atlas.uvs[index].to_string() }),
        None => Ok(()),
    }
}

/// Is a picture whole, and of the atlas's shape? Its scale is free.
fn check_picture(what: &str, picture: &Photo, atlas: &Atlas) -> Result<(), ExportError> {
    let (w, h) = (picture.width as u64, picture.height as u64);
    let bad = |found: String, expected: String| {
        Err(ExportError::Picture { what: what.to_string(), found, expected })
    };
    if w * h == 0 || w * h != picture.rgb.len() as u64 {
        let found = format!("{} pixels for {w} × {h}", picture.rgb.len());
        return bad(found, "one for each, and at least one".into());
    }
    if w * atlas.height as u64 != h * atlas.width as u64 {
        let expected = format!("the shape of its atlas, {} × {}", atlas.width, atlas.height);
        return bad(format!("{w} × {h} pixels"), expected);
    }
    Ok(())
}

/// One index for everything.
#[derive(Default)]
pub(super) struct Split {
    pub positions: Vec<Vec3>,
    pub normals: Vec<Vec3>,
    pub colors: Vec<[f32; 3]>,
    pub uvs: Vec<Vec2>,
    pub tangents: Vec<Vec4>,
    pub triangles: Vec<[u32; 3]>,
}

/// Splits vertices where corners disagree about the texture coordinate or the tangent. Vertices come
/// in the order of their first use; those without a triangle are left out.
pub(super) fn split(prepared: &Prepared, tangents: Option<&[[Vec4; 3]]>) -> Split {
    let Prepared { ready, uvs, corners } = prepared;
    let mut out = Split::default();
    let mut known: HashMap<(u32, [u32; 2], [u32; 4]), u32> = HashMap::with_capacity(ready.positions.len());
    for (t, (vertices, corner)) in ready.triangles.iter().zip(corners).enumerate() {
        let mut triangle = [0; 3];
        for k in 0..3 {
            let (vertex, uv) = (vertices[k], uvs[corner[k] as usize]);
            let tangent = tangents.map(|all| all[t][k]);
            let key = (
                vertex,
                uv.to_array().map(f32::to_bits),
                tangent.unwrap_or(Vec4::ZERO).to_array().map(f32::to_bits),
            );
            let next = out.positions.len() as u32;
            triangle[k] = *known.entry(key).or_insert_with(|| {
                let vertex = vertex as usize;
                out.positions.push(ready.positions[vertex]);
                out.normals.extend(ready.normals.get(vertex));
                out.colors.extend(ready.colors.get(vertex));
                out.uvs.push(uv);
                out.tangents.extend(tangent);
                next
            });
        }
        out.triangles.push(triangle);
    }
    out
}

/// A picture as a file: its bytes and its ending.
pub(super) fn encode(
    what: &str,
    picture: &Photo,
    format: PictureFormat,
) -> Result<(Vec<u8>, &'static str), ExportError> {
    let (rgb, w, h) = (picture.rgb.as_flattened(), picture.width, picture.height);
    let mut bytes = Vec::new();
    let (done, ending) = match format {
        PictureFormat::Png => {
            let encoder =
                PngEncoder::new_with_quality(&mut bytes, CompressionType::Default, FilterType::Adaptive);
            (encoder.write_image(rgb, w, h, ExtendedColorType::Rgb8), "png")
        }
        PictureFormat::Jpeg { quality } => {
            if !(1..=100).contains(&quality) {
                let found = quality.to_string();
                return Err(ExportError::Option { what: "quality", found, expected: "1 to 100" });
            }
            let encoder = JpegEncoder::new_with_quality(&mut bytes, quality);
            (encoder.write_image(rgb, w, h, ExtendedColorType::Rgb8), "jpg")
        }
    };
    match done {
        Ok(()) => Ok((bytes, ending)),
        Err(e) => Err(ExportError::Picture {
            what: what.to_string(),
            found: format!("{w} × {h} pixels: {e}"),
            expected: format!("something a .{ending} can hold"),
        }),
    }
}

/// A name, of a file too, that every reader of OBJ and MTL understands.
pub(super) fn safe_name(name: &str) -> String {
    let safe = |c: char| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '_' };
    let name: String = name.trim().chars().map(safe).collect();
    // a leading dot hides a file, and `..` leaves the folder
    let name = name.trim_start_matches('.');
    if name.is_empty() { "mesh".into() } else { name.into() }
}

/// Says what a format without a place for it leaves out.
pub(super) fn left_out(textured: &Textured, ending: &str, warnings: &mut Vec<String>) {
    if textured.normal.is_some() {
        warnings.push(format!("a .{ending} has no place for the normal map; it is in the .glb alone"));
    }
    if !textured.lobes.is_empty() {
        warnings.push(format!(
            "a .{ending} has no place for {} textures that depend on the view; they are in the .glb alone",
            textured.lobes.len()
        ));
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// A tetrahedron of which every face has a corner of the texture to itself, and its pictures.
    pub fn tetrahedron() -> (Mesh, Atlas, Photo) {
        let mesh = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z],
            normals: vec![-Vec3::ONE.normalize(), Vec3::X, Vec3::Y, Vec3::Z],
            colors: vec![[0.0, 0.2, 0.4], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
        };
        let mut atlas = Atlas { width: 8, height: 4, ..Atlas::default() };
        for i in 0..4 {
            let low = Vec2::new((i % 2) as f32 * 0.5, (i / 2) as f32 * 0.5);
            let first = atlas.uvs.len() as u32;
            atlas.uvs.extend([low, low + Vec2::new(0.0, 0.375), low + Vec2::new(0.375, 0.0)]);
            atlas.triangles.push([first, first + 1, first + 2]);
        }
        let rgb = (0..32u8).map(|i| [i * 8, 255 - i, i]).collect();
        (mesh, atlas, Photo { width: 8, height: 4, rgb, alpha: None })
    }

    fn go(textured: &Textured) -> Result<Prepared, ExportError> {
        prepare(textured, &Similarity::IDENTITY)
    }

    #[test]
    fn a_seam_splits_vertices_into_bit_identical_copies() {
        let (mesh, atlas, color) = tetrahedron();
        // every face is a chart: 4 · 3 corners, none shared
        let apart = split(&go(&Textured::new(&mesh, &atlas, &color)).unwrap(), None);
        assert_eq!((apart.positions.len(), apart.normals.len(), apart.uvs.len()), (12, 12, 12));
        for (t, s) in mesh.triangles.iter().zip(&apart.triangles) {
            for k in 0..3 {
                assert_eq!(apart.positions[s[k] as usize], mesh.positions[t[k] as usize]);
                assert_eq!(apart.colors[s[k] as usize], mesh.colors[t[k] as usize]);
            }
        }
        // one coordinate per vertex: nothing to split, though the atlas names each corner apart
        let shared = Atlas {
            uvs: mesh.triangles.iter().flatten().map(|&v| Vec2::splat(v as f32 / 4.0)).collect(),
            triangles: (0..4).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect(),
            ..atlas
        };
        let whole = split(&go(&Textured::new(&mesh, &shared, &color)).unwrap(), None);
        assert_eq!(whole.positions.len(), 4);
    }

    #[test]
    fn an_atlas_that_does_not_fit_is_an_error() {
        let (mesh, atlas, color) = tetrahedron();
        let fails = |atlas: &Atlas, color: &Photo| go(&Textured::new(&mesh, atlas, color)).err();
        let mut short = atlas.clone();
        short.triangles.pop();
        assert_eq!(fails(&short, &color), Some(ExportError::AtlasLength { found: 3, expected: 4 }));
        let mut outside = atlas.clone();
        outside.triangles[2][1] = 12;
        assert_eq!(
            fails(&outside, &color),
            Some(ExportError::AtlasIndex { triangle: 2, index: 12, uvs: 12 })
        );
        for bad in [f32::NAN, -1e-6, 1.000_001, f32::INFINITY] {
            let mut off = atlas.clone();
            off.uvs[5].y = bad;
            assert!(matches!(fails(&off, &color), Some(ExportError::Uv { index: 5, .. })), "{bad}");
        }
        let cut = Photo { rgb: color.rgb[1..].to_vec(), ..color.clone() };
        let e = fails(&atlas, &cut).unwrap();
        assert_eq!(
            e.to_string(),
            "the base colour is 31 pixels for 8 × 4, expected one for each, and at least one"
        );
        let square = Photo { width: 1, height: 1, rgb: vec![[0; 3]], alpha: None };
        assert!(fails(&atlas, &square).unwrap().to_string().contains("the shape of its atlas, 8 × 4"));
        let half = Photo { width: 2, height: 1, rgb: vec![[0; 3]; 2], alpha: None };
        assert!(fails(&atlas, &half).is_none());
        let bare = Mesh { normals: vec![], ..mesh.clone() };
        let mapped = Textured { normal: Some(&color), ..Textured::new(&bare, &atlas, &color) };
        assert!(matches!(go(&mapped).err(), Some(ExportError::Length { what: "normals", .. })));
    }

    #[test]
    fn folded_triangles_leave_mesh_and_atlas_together() {
        let (mut mesh, atlas, color) = tetrahedron();
        mesh.triangles[1] = [0, 0, 3];
        let prepared = go(&Textured::new(&mesh, &atlas, &color)).unwrap();
        assert_eq!(prepared.corners, [atlas.triangles[0], atlas.triangles[2], atlas.triangles[3]]);
    }

    #[test]
    fn names_of_files_are_plain() {
        let safe = safe_name;
        assert_eq!(safe("my head/../Büste"), "my_head_.._B_ste");
        assert_eq!(
            (safe(".."), safe(""), safe("head-2.v")),
            ("mesh".into(), "mesh".into(), "head-2.v".into())
        );
    }

    #[test]
    fn pictures_are_stored_exactly_or_as_asked() {
        let (_, _, color) = tetrahedron();
        let limits = crate::io::Limits::default();
        let path = std::path::Path::new("a");
        let (png, _) = encode("x", &color, PictureFormat::Png).unwrap();
        assert_eq!(crate::io::parse_photo(&png, path, &limits).unwrap(), color);
        let (jpeg, ending) = encode("x", &color, PictureFormat::Jpeg { quality: 95 }).unwrap();
        assert_eq!(ending, "jpg");
        assert_eq!(crate::io::parse_photo(&jpeg, path, &limits).unwrap().width, 8);
        assert!(encode("x", &color, PictureFormat::Jpeg { quality: 0 }).is_err());
    }
}
