//! A mesh as Wavefront OBJ: text, +Y up, metres.
//!
//! Numbers are the shortest that read back as the same f32, which is never more than nine
//! significant digits. `v`, `vt` and `vn` are indexed apart, so a surface that is closed stays closed
//! whatever its seams. Colour is `v x y z r g b`, sRGB-coded, or a picture that a `.mtl` beside it
//! names; never both.
//!
//! A mesh far from the origin needs more digits than f32 has: its positions are written with as many as
//! hold a billionth of its size, for readers that keep f64.

use super::export::{ExportError, ExportOptions, Ready, ready};
use super::textured::{Exported, TextureOptions, Textured, encode, left_out, prepare, safe_name};
use crate::geom::{Aabb, Mesh};
use std::io::Write;

/// The mesh as the bytes of an `.obj` file, coloured by its vertices.
///
/// # Errors
///
/// [`ExportError`] when there is nothing to write, the mesh is damaged, or an option makes no sense.
pub fn to_obj(mesh: &Mesh, options: &ExportOptions) -> Result<Vec<u8>, ExportError> {
    let mesh = ready(mesh, &options.file_from_mesh()?)?;
    let header = concat!("# tiface ", env!("CARGO_PKG_VERSION"), ": metres, +Y up, sRGB vertex colours\n");
    let mut out = header.as_bytes().to_vec();
    let mut write = || -> std::io::Result<()> {
        writeln!(out, "o {}", safe_name(&options.name))?;
        write_vertices(&mut out, &mesh)?;
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

/// The mesh as an `.obj`, its `.mtl` and its picture, which must lie in one folder.
///
/// # Errors
///
/// [`ExportError`] when mesh, atlas and pictures do not belong together, before there are any bytes;
/// else as [`to_obj`].
pub fn textured_to_obj(
    textured: &Textured,
    options: &ExportOptions,
    texture: &TextureOptions,
) -> Result<Exported, ExportError> {
    let prepared = prepare(textured, &options.file_from_mesh()?)?;
    let mut mesh = prepared.ready;
    mesh.colors = Vec::new(); // some readers multiply them into the texture
    let (stem, name) = (safe_name(&texture.stem), safe_name(&options.name));
    let (picture, ending) = encode("base colour", textured.color, texture.picture)?;
    let generator = concat!("# tiface ", env!("CARGO_PKG_VERSION"));
    let mut out = Vec::new();
    let mut write = || -> std::io::Result<()> {
        writeln!(out, "{generator}: metres, +Y up\nmtllib {stem}.mtl\no {name}")?;
        write_vertices(&mut out, &mesh)?;
        for uv in &prepared.uvs {
            // OBJ's v runs up
            writeln!(out, "vt {} {}", Short(uv.x), Short(1.0 - uv.y))?;
        }
        writeln!(out, "usemtl {name}")?;
        for (vertices, corners) in mesh.triangles.iter().zip(&prepared.corners) {
            write!(out, "f")?;
            for (v, t) in vertices.map(|i| i as u64 + 1).iter().zip(corners.map(|i| i as u64 + 1)) {
                if mesh.normals.is_empty() {
                    write!(out, " {v}/{t}")?;
                } else {
                    write!(out, " {v}/{t}/{v}")?;
                }
            }
            writeln!(out)?;
        }
        Ok(())
    };
    write().expect("writing to memory does not fail");
    let mtl = format!(
        "{generator}\nnewmtl {name}\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {stem}.{ending}\n"
    );
    let files = vec![
        (format!("{stem}.obj"), out),
        (format!("{stem}.mtl"), mtl.into_bytes()),
        (format!("{stem}.{ending}"), picture),
    ];
    let mut warnings = Vec::new();
    left_out(textured, "obj", &mut warnings);
    Ok(Exported { files, warnings })
}

/// `v` with colours where there are any, then `vn`.
fn write_vertices(out: &mut Vec<u8>, mesh: &Ready) -> std::io::Result<()> {
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
    use crate::mesh::files::textured::tests::tetrahedron;
    use crate::mesh::files::{Texture, picture_of_mtl, read, read_whole};
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
        let obj = to_obj(&mesh, &ExportOptions::default()).unwrap();
        assert_eq!(read(&obj, Path::new("a.obj")).unwrap(), mesh);
    }

    #[test]
    fn a_textured_obj_stays_closed_and_names_its_files_plainly() {
        let (mesh, atlas, color) = tetrahedron();
        let texture = TextureOptions { stem: "my head".into(), ..Default::default() };
        let textured = Textured { normal: Some(&color), ..Textured::new(&mesh, &atlas, &color) };
        let options = ExportOptions { name: "Büste 7".into(), ..Default::default() };
        let out = textured_to_obj(&textured, &options, &texture).unwrap();
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
        let picture = picture_of_mtl(&out.files[1].1, Path::new("my_head.mtl")).unwrap();
        assert_eq!(picture.as_deref(), Some("my_head.png"));
        let back = read_whole(&out.files[0].1, Path::new("a.obj")).unwrap();
        assert_eq!(back.texture, Some(Texture::Material("my_head.mtl".into())));
        assert!(back.mesh.is_closed() && back.mesh.colors.is_empty());
        let read_atlas = back.atlas.unwrap();
        assert_eq!((&read_atlas.uvs, &read_atlas.triangles), (&atlas.uvs, &atlas.triangles));
    }
}
