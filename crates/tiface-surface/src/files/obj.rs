//! A mesh as Wavefront OBJ: text, +Y up, meters.
//!
//! Numbers are the shortest that read back as the same f32, which is never more than nine
//! significant digits. `v`, `vt` and `vn` are indexed apart, so a surface that is closed stays
//! closed whatever its seams. Color is `v x y z r g b`, sRGB-coded, or a picture that a `.mtl`
//! beside it names; never both.
//!
//! A mesh far from the origin needs more digits than f32 has: its positions are written with as
//! many as hold a billionth of its size, for readers that keep f64.

use super::file_mesh::{
    ExportOptions, ExportedFiles, FileMesh, distance_warning, encode, left_out, safe_name,
};
use super::head_texture::HeadTexture;
use std::io::Write;
use tiface_base::Result;
use tiface_base::geom::{Aabb, Mesh};

/// Returns a mesh as an `.obj`, with a texture also its `.mtl` and its picture, which must lie in
/// one folder; without one it is colored by its vertices.
///
/// # Errors
///
/// Fails if the mesh is empty or damaged, if texture and mesh do not belong together, or if an
/// option is invalid.
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
            let p = mesh.translated(*p);
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

/// A number displayed by the shortest digits that give the same f32 back; with an exponent if zeros
/// would fill the line.
pub(super) struct Short(pub f32);

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
    use crate::files::file_mesh::tests::tetrahedron;
    use crate::files::{PictureSource, ReadOptions, materials_of_mtl, read, read_with};
    use glam::Vec3;
    use std::path::Path;

    #[test]
    fn a_colored_triangle_is_these_lines() {
        let mesh = Mesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::new(0.0, 0.0, 1e-7)],
            normals: vec![-Vec3::Y; 3],
            colors: vec![[1.0, 0.5, 0.25], [0.0; 3], [2.0, -1.0, 0.1]],
            triangles: vec![[0, 1, 2]],
            ..Mesh::default()
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
