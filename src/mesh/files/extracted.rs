//! The extracted surface, as the stages after this one find it: what rays are cast at.

use super::stored::{StoredTensors, floats, format, geometry};
use crate::Result;
use crate::geom::{Aabb, Mesh};
use crate::io;
use crate::mesh::extract::{Cap, Skin};
use std::path::Path;

const FILE: &str = "surface.safetensors";

/// The whole zero level set of a field, in scene coordinates.
#[derive(Clone, Debug, PartialEq)]
pub struct ExtractedSurface {
    /// Without colors: those of rays are the field's.
    pub mesh: Mesh,
    /// What closes it where the box ends.
    pub cap: Option<Cap>,
}

impl ExtractedSurface {
    /// Writes it into a folder, which is made if need be.
    ///
    /// # Errors
    ///
    /// The folder cannot be written to.
    pub fn save(&self, folder: &Path) -> Result<()> {
        io::create_folder(folder)?;
        let mut tensors = geometry(&self.mesh);
        if let Some(cap) = &self.cap {
            let of = |value: &dyn Fn(&Skin) -> [f32; 3]| cap.ring.iter().map(value).collect::<Vec<_>>();
            tensors.push(floats("cap_box", &[cap.bounds.min.to_array(), cap.bounds.max.to_array()]));
            tensors.push(floats("cap_near", &[[cap.near]]));
            tensors.push(floats("cap_ring", &of(&|s| s.position.to_array())));
            tensors.push(floats("cap_ring_normals", &of(&|s| s.normal.to_array())));
            tensors.push(floats("cap_ring_colors", &of(&|s| s.color)));
        }
        Ok(io::write_tensors(&folder.join(FILE), &tensors, &format())?)
    }

    /// Reads it back.
    ///
    /// # Errors
    ///
    /// The file is missing, damaged or of another version; the suggested fix is to make it again.
    pub fn load(folder: &Path) -> Result<ExtractedSurface> {
        let mut stored = StoredTensors::open(&folder.join(FILE))?;
        let mesh = stored.mesh()?;
        if !stored.contains("cap_box") {
            return Ok(ExtractedSurface { mesh, cap: None });
        }
        let near = stored.rows::<1>("cap_near")?;
        let (corners, ring) = (stored.vectors("cap_box")?, stored.vectors("cap_ring")?);
        let (normals, colors) = (stored.vectors("cap_ring_normals")?, stored.rows("cap_ring_colors")?);
        let (&[min, max], &[[near]]) = (&corners[..], &near[..]) else {
            return Err(stored.missing("cap_box"));
        };
        if normals.len() != ring.len() || colors.len() != ring.len() {
            return Err(stored.missing("cap_ring"));
        }
        let ring = ring.into_iter().zip(normals).zip(colors);
        let ring = ring.map(|((position, normal), color)| Skin { position, normal, color }).collect();
        if min.cmpge(max).any() {
            return Err(stored.wrong("cap_box", format!("{min} to {max}"), "a box, its lowest corner first"));
        }
        if near < 0.0 {
            return Err(stored.wrong("cap_near", near, "0 or more"));
        }
        Ok(ExtractedSurface { mesh, cap: Some(Cap { bounds: Aabb { min, max }, near, ring }) })
    }
}

#[cfg(test)]
mod tests {
    use super::super::head::tests::head;
    use super::*;
    use glam::Vec3;

    #[test]
    fn a_surface_comes_back_with_its_cap() {
        let dir = tempfile::tempdir().unwrap();
        let skin = |x: f32| Skin { position: Vec3::splat(x), normal: Vec3::Y, color: [x, 0.5, 0.25] };
        let cap = Cap { bounds: Aabb::SCENE, near: 1e-5, ring: vec![skin(0.1), skin(0.2)] };
        let mesh = Mesh { colors: Vec::new(), ..head().mesh };
        for cap in [Some(Cap { ring: Vec::new(), ..cap.clone() }), Some(cap), None] {
            let whole = ExtractedSurface { mesh: mesh.clone(), cap };
            whole.save(dir.path()).unwrap();
            assert_eq!(ExtractedSurface::load(dir.path()).unwrap(), whole);
        }
    }

    #[test]
    fn a_hostile_cap_is_refused_with_its_key() {
        let dir = tempfile::tempdir().unwrap();
        let error = |bounds: Aabb, near: f32| {
            let mesh = Mesh { colors: Vec::new(), ..head().mesh };
            ExtractedSurface { mesh, cap: Some(Cap { bounds, near, ring: Vec::new() }) }
                .save(dir.path())
                .unwrap();
            let error = ExtractedSurface::load(dir.path()).unwrap_err();
            assert!(error.hint().contains("--fresh mesh"), "{error:?}");
            error.to_string()
        };
        let swapped = Aabb { min: Vec3::ONE, max: Vec3::NEG_ONE };
        assert!(error(swapped, 1e-5).contains("`cap_box`"));
        assert!(error(Aabb::SCENE, -1.0).contains("`cap_near` is -1, expected 0 or more"));
        std::fs::write(dir.path().join("surface.safetensors"), b"torn").unwrap();
        assert!(ExtractedSurface::load(dir.path()).unwrap_err().hint().contains("--fresh mesh"));
        let missing = ExtractedSurface::load(&dir.path().join("nothing")).unwrap_err();
        assert!(missing.hint().contains("--fresh mesh"), "{missing:?}");
    }
}
