//! A mesh as PLY: binary little endian, in the dataset's own world.
//!
//! Neither rotated nor scaled: PLY defines no axes and no unit, and Blender does not rotate it (it
//! does turn OBJ and GLB). Colors are 8-bit and sRGB-coded, as every reader takes them. Positions
//! are `float`, or `double` where the mesh lies so far from the origin that f32 would show.
//!
//! How many cameras see a vertex is its property `seen_by`, if the mesh knows.
//!
//! PLY has one index for everything. Without a texture vertices stay whole, and so the surface
//! closed: this is the file that later stages read. With one they are split at seams for the sake
//! of `s t` (v up, Blender's and trimesh's spelling) and names its picture in a comment, as MeshLab
//! does; weld equal positions to close it again.

use super::file_mesh::{
    ExportOptions, ExportedFiles, FileMesh, distance_warning, encode, left_out, safe_name,
};
use super::head_texture::HeadTexture;
use tiface_base::Result;
use tiface_base::geom::Mesh;
use tiface_base::image::quantize;

/// Returns a mesh as a `.ply`, colored by its vertices; a textured mesh is split at seams, with its
/// picture beside it. The options `up` and `unit_m` do not matter.
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
    if !mesh.seen_by.is_empty() {
        property("uchar", &["seen_by"]);
    }
    header += &format!("element face {}\n", mesh.triangles.len());
    header += "property list uchar uint vertex_indices\nend_header\n";

    let mut out = header.into_bytes();
    out.reserve(mesh.positions.len() * if far { 48 } else { 36 } + mesh.triangles.len() * 13);
    for (i, p) in mesh.positions.iter().enumerate() {
        if far {
            out.extend(mesh.translated(*p).to_array().iter().flat_map(|v| v.to_le_bytes()));
        } else {
            out.extend(p.to_array().iter().flat_map(|v| v.to_le_bytes()));
        }
        out.extend(mesh.normals.get(i).iter().flat_map(|n| n.to_array()).flat_map(f32::to_le_bytes));
        out.extend(mesh.colors.get(i).into_iter().flatten().map(|&c| quantize(c)));
        if let Some(uv) = mesh.uvs.get(i) {
            out.extend_from_slice(&uv.x.to_le_bytes());
            out.extend_from_slice(&(1.0 - uv.y).to_le_bytes());
        }
        out.extend(mesh.seen_by.get(i));
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
    use crate::files::file_mesh::tests::tetrahedron;
    use crate::files::{PictureSource, ReadOptions, read, read_with, weld};
    use glam::Vec3;
    use std::path::Path;

    #[test]
    fn what_is_written_reads_back_in_the_same_world() {
        let mesh = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::new(0.1, 0.2, 0.3)],
            normals: vec![Vec3::Z; 3],
            colors: vec![[0.0, 1.0, 0.2]; 3], // 0.2 is 51/255
            seen_by: vec![0, 3, 255],
            triangles: vec![[0, 1, 2], [2, 1, 0]],
        };
        let bytes = |mesh: &Mesh| to_ply(mesh, None, &ExportOptions::default()).unwrap().files.remove(0).1;
        let ply = bytes(&mesh);
        assert_eq!(read(&ply, Path::new("a.ply")).unwrap(), mesh);
        let bare = Mesh { normals: vec![], colors: vec![], seen_by: vec![], ..mesh };
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
