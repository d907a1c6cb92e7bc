//! A mesh as PLY: binary little endian, in the dataset's own world.
//!
//! No turn and no unit: PLY says nothing of either, and Blender does not turn it. Colours are 8-bit
//! and sRGB-coded, as every reader takes them.

use super::export::{ExportError, ready};
use crate::geom::Mesh;
use crate::image::quantise;
use glam::DMat3;

/// The mesh as the bytes of a `.ply` file.
///
/// # Errors
///
/// [`ExportError`] when there is nothing to write or the mesh is damaged.
pub fn to_ply(mesh: &Mesh) -> Result<Vec<u8>, ExportError> {
    let mesh = ready(mesh, DMat3::IDENTITY, 1.0, false)?;
    let mut header = String::from("ply\nformat binary_little_endian 1.0\n");
    header += concat!("comment tiface ", env!("CARGO_PKG_VERSION"), "\n");
    header += "comment dataset world, dataset units; vertex colours are sRGB\n";
    header += &format!("element vertex {}\n", mesh.positions.len());
    let mut property = |kind: &str, names: &[&str]| {
        for name in names {
            header += &format!("property {kind} {name}\n");
        }
    };
    property("float", &["x", "y", "z"]);
    if !mesh.normals.is_empty() {
        property("float", &["nx", "ny", "nz"]);
    }
    if !mesh.colors.is_empty() {
        property("uchar", &["red", "green", "blue"]);
    }
    header += &format!("element face {}\n", mesh.triangles.len());
    header += "property list uchar uint vertex_indices\nend_header\n";

    let mut out = header.into_bytes();
    out.reserve(mesh.positions.len() * 27 + mesh.triangles.len() * 13);
    for (i, p) in mesh.positions.iter().enumerate() {
        let normal = mesh.normals.get(i);
        for v in [Some(p), normal].into_iter().flatten().flat_map(|v| v.to_array()) {
            out.extend_from_slice(&v.to_le_bytes());
        }
        out.extend(mesh.colors.get(i).into_iter().flatten().map(|&c| quantise(c)));
    }
    for t in &mesh.triangles {
        out.push(3);
        out.extend(t.iter().flat_map(|i| i.to_le_bytes()));
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::read::read;
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
}
