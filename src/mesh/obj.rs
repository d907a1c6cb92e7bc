//! A mesh as Wavefront OBJ: text, +Y up, metres, `v x y z r g b` with sRGB-coded colours.
//!
//! Numbers are the shortest that read back as the same f32, which is never more than nine
//! significant digits. Vertices and triangles are those of the GLB.

use super::export::{ExportError, ExportOptions, check_unit, ready, turn_to_y_up};
use crate::geom::Mesh;
use std::io::Write;

/// The mesh as the bytes of an `.obj` file.
///
/// # Errors
///
/// [`ExportError`] when there is nothing to write, the mesh is damaged, or an option makes no sense.
pub fn to_obj(mesh: &Mesh, options: &ExportOptions) -> Result<Vec<u8>, ExportError> {
    check_unit(options.unit_m)?;
    let mesh = ready(mesh, turn_to_y_up(options.up)?, options.unit_m, false)?;
    let mut out = Vec::with_capacity(mesh.positions.len() * 60 + mesh.triangles.len() * 30);
    // A name is one line; what would end it becomes a space.
    let name: String = options.name.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    let header = concat!("# tiface ", env!("CARGO_PKG_VERSION"), ": metres, +Y up, sRGB vertex colours");
    let mut write = || -> std::io::Result<()> {
        writeln!(out, "{header}\no {}", name.trim())?;
        for (i, p) in mesh.positions.iter().enumerate() {
            write!(out, "v {} {} {}", Short(p.x), Short(p.y), Short(p.z))?;
            match mesh.colors.get(i).map(|c| c.map(|v| v.clamp(0.0, 1.0))) {
                Some([r, g, b]) => writeln!(out, " {} {} {}", Short(r), Short(g), Short(b))?,
                None => writeln!(out)?,
            }
        }
        for n in &mesh.normals {
            writeln!(out, "vn {} {} {}", Short(n.x), Short(n.y), Short(n.z))?;
        }
        for [a, b, c] in mesh.triangles.iter().map(|t| t.map(|i| i as u64 + 1)) {
            if mesh.normals.is_empty() {
                writeln!(out, "f {a} {b} {c}")?;
            } else {
                writeln!(out, "f {a}//{a} {b}//{b} {c}//{c}")?;
            }
        }
        Ok(())
    };
    write().expect("writing to memory does not fail");
    Ok(out)
}

/// Shortest digits that give the same f32 back; with an exponent where zeros would fill the line.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::read::read;
    use glam::Vec3;
    use std::path::Path;

    #[test]
    fn a_coloured_triangle_is_these_lines() {
        let mesh = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::new(0.0, 0.0, 1e-7)],
            normals: vec![-Vec3::Y; 3],
            colors: vec![[1.0, 0.5, 0.25], [0.0; 3], [2.0, -1.0, 0.1]],
            triangles: vec![[0, 1, 2]],
        };
        let options = ExportOptions { up: Vec3::Z, name: "two\nlines".into(), ..Default::default() };
        let obj = String::from_utf8(to_obj(&mesh, &options).unwrap()).unwrap();
        // z becomes y; −y, the normal, becomes z
        let expected = "o two lines\nv 0 0 0 1 0.5 0.25\nv 1 0 0 0 0 0\nv 0 1e-7 0 1 0 0.1\n\
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
        let obj = to_obj(&mesh, &ExportOptions::default()).unwrap();
        assert_eq!(read(&obj, Path::new("a.obj")).unwrap(), mesh);
    }
}
