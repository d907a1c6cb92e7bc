//! A mesh as PLY: binary little endian, in the dataset's own world.
//!
//! No turn and no unit: PLY says nothing of either, and Blender does not turn it (it does turn OBJ and
//! GLB). Colours are 8-bit and sRGB-coded, as every reader takes them. Positions are `float`, or `double` where
//! the mesh lies so far from the origin that f32 would show.
//!
//! PLY has one index for everything. [`to_ply`] keeps vertices whole, so the surface stays closed:
//! this is the file that later stages read. [`textured_to_ply`] splits vertices at seams for the sake
//! of `s t` (v up, Blender's and trimesh's spelling) and names its picture in a comment, as MeshLab
//! does; weld equal positions to close it again.

use super::export::{ExportError, ready};
use super::textured::{
    Exported, Split, TextureOptions, Textured, encode, left_out, prepare, safe_name, split,
};
use crate::geom::{Mesh, Similarity};
use crate::image::quantise;
use glam::DVec3;

/// The mesh as the bytes of a `.ply` file, coloured by its vertices.
///
/// # Errors
///
/// [`ExportError`] when there is nothing to write or the mesh is damaged.
pub fn to_ply(mesh: &Mesh) -> Result<Vec<u8>, ExportError> {
    placed_to_ply(mesh, &Similarity::IDENTITY)
}

/// [`to_ply`] of a mesh in coordinates of its own.
///
/// # Errors
///
/// As [`to_ply`].
pub fn placed_to_ply(mesh: &Mesh, world_from_mesh: &Similarity) -> Result<Vec<u8>, ExportError> {
    let ready = ready(mesh, world_from_mesh)?;
    let translation = ready.translation;
    let shape = Split {
        positions: ready.positions,
        normals: ready.normals,
        colors: ready.colors,
        triangles: ready.triangles,
        ..Split::default()
    };
    Ok(bytes(&shape, translation, None))
}

/// The mesh as a `.ply`, split at seams, with its vertex colours too, and its picture beside it.
///
/// # Errors
///
/// [`ExportError`] when mesh, atlas and pictures do not belong together, before there are any bytes;
/// else as [`to_ply`].
pub fn textured_to_ply(textured: &Textured, texture: &TextureOptions) -> Result<Exported, ExportError> {
    let prepared = prepare(textured, &Similarity::IDENTITY)?;
    let (picture, ending) = encode("base colour", textured.color, texture.picture)?;
    let stem = safe_name(&texture.stem);
    let name = format!("{stem}.{ending}");
    let ply = bytes(&split(&prepared, None), prepared.ready.translation, Some(&name));
    let files = vec![(format!("{stem}.ply"), ply), (name.clone(), picture)];
    let mut warnings = Vec::new();
    left_out(textured, "ply", &mut warnings);
    Ok(Exported { files, warnings })
}

fn bytes(mesh: &Split, translation: DVec3, picture: Option<&str>) -> Vec<u8> {
    let far = translation != DVec3::ZERO;
    let mut header = String::from("ply\nformat binary_little_endian 1.0\n");
    header += concat!("comment tiface ", env!("CARGO_PKG_VERSION"), "\n");
    header += "comment dataset world, dataset units; vertex colours are sRGB\n";
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
            out.extend((translation + p.as_dvec3()).to_array().iter().flat_map(|v| v.to_le_bytes()));
        } else {
            out.extend(p.to_array().iter().flat_map(|v| v.to_le_bytes()));
        }
        out.extend(mesh.normals.get(i).iter().flat_map(|n| n.to_array()).flat_map(f32::to_le_bytes));
        out.extend(mesh.colors.get(i).into_iter().flatten().map(|&c| quantise(c)));
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::files::textured::tests::tetrahedron;
    use crate::mesh::files::{Texture, read, read_whole, weld};
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
        let ply = to_ply(&mesh).unwrap();
        assert_eq!(read(&ply, Path::new("a.ply")).unwrap(), mesh);
        let bare = Mesh { normals: vec![], colors: vec![], ..mesh };
        let ply = to_ply(&bare).unwrap();
        assert_eq!(read(&ply, Path::new("a.ply")).unwrap(), bare);
        assert_eq!(to_ply(&Mesh::default()), Err(ExportError::Empty));
    }

    #[test]
    fn a_textured_ply_is_split_and_closes_when_welded() {
        let (mesh, atlas, color) = tetrahedron();
        let textured = Textured::new(&mesh, &atlas, &color);
        let out = textured_to_ply(&textured, &TextureOptions::default()).unwrap();
        let names: Vec<&str> = out.files.iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(names, ["head.ply", "head.png"]);
        let back = read_whole(&out.files[0].1, Path::new("a.ply")).unwrap();
        assert_eq!(back.texture, Some(Texture::Beside("head.png".into())));
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
