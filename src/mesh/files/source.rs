//! What the readers of all formats share: which file, how much it may ask for, and what is wrong with it.

use crate::geom::{Atlas, Mesh};
use crate::{Error, Result};
use glam::DVec3;
use std::fmt::Display;
use std::path::Path;

/// What is read of a file, and how much it may ask for. GLB can show one buffer many times, so bytes alone do not
/// bound it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReadOptions {
    /// Most vertices.
    pub vertices: usize,
    /// Most triangles, after polygons are fanned.
    pub triangles: usize,
    /// Most bytes of JSON in a GLB. Of them, at most 2²⁰ may be objects or arrays, and 2²² values.
    pub json: usize,
    /// Also the texture? Else it is passed over, sound or not.
    pub texture: bool,
}

impl ReadOptions {
    /// Everything, of a file that a machine can hold.
    pub const DEFAULT: ReadOptions =
        ReadOptions { vertices: 30_000_000, triangles: 30_000_000, json: 64 << 20, texture: true };

    /// The surface alone.
    pub const SURFACE: ReadOptions = ReadOptions { texture: false, ..ReadOptions::DEFAULT };
}

impl Default for ReadOptions {
    fn default() -> ReadOptions {
        ReadOptions::DEFAULT
    }
}

/// Where the base color of a file is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PictureSource {
    /// In the file: PNG or JPEG, for [`crate::io::parse_photo`]. Its header is within the limits for
    /// pictures; nothing more is known.
    Inside(Vec<u8>),
    /// In a picture of this bare name, in the same folder.
    Beside(String),
    /// In the picture that [`super::picture_of_mtl`] finds in the `.mtl` of this bare name, in the same folder.
    Material(String),
}

/// What a reader finds.
#[derive(Default)]
pub(super) struct ParsedMesh {
    /// In the file's coordinates.
    pub positions: Vec<DVec3>,
    /// All but the positions.
    pub mesh: Mesh,
    pub atlas: Option<Atlas>,
    pub picture: Option<PictureSource>,
    /// Linear red, green and blue that the picture is multiplied with.
    pub tint: Option<[f32; 3]>,
}

/// Which file is read, as what, and how much it may ask for.
#[derive(Clone, Copy)]
pub(super) struct Source<'a> {
    pub path: &'a Path,
    /// `GLB`, `PLY`, `OBJ` or `MTL`.
    pub format: &'static str,
    pub options: &'a ReadOptions,
}

impl Source<'_> {
    /// A file that breaks its own rules.
    pub fn broken(&self, at: impl Display, what: impl Display) -> Error {
        let hint = match self.format {
            "GLB" => "export it again; the Khronos validator explains a GLB in detail",
            _ => "export it again, or open it in Blender or MeshLab and save it anew from there",
        };
        Error::cannot(format!("`{}`, {at}: {what}", self.path.display()), hint)
    }

    /// A file that is right, but beyond this reader.
    pub fn unsupported(&self, at: impl Display, feature: impl Display) -> Error {
        let hint = match self.format {
            "GLB" => {
                "export it as a plain .glb: shape keys, poses and instances applied, no compression, one picture inside"
            }
            _ => {
                "export it with one texture that lies in the same folder, or as a .glb with the picture inside"
            }
        };
        let what = format!("`{}`, {at}: {feature} is not supported", self.path.display());
        Error::cannot(what, hint)
    }

    /// The name of a file in the same folder: no path, no address.
    pub fn bare_name(&self, at: impl Display, name: &str) -> Result<String> {
        let name = name.trim();
        let name = name.strip_prefix("./").unwrap_or(name);
        let is_bare = !name.is_empty()
            && name != ".."
            && !name.contains(|c: char| c.is_control() || "/\\:".contains(c));
        if is_bare { Ok(name.into()) } else { Err(self.unsupported(at, "a texture outside the folder")) }
    }

    /// Are this many vertices and triangles allowed?
    pub fn allow(&self, vertices: usize, triangles: usize) -> Result<()> {
        let limits = self.options;
        for (what, found, limit) in
            [("vertices", vertices, limits.vertices), ("triangles", triangles, limits.triangles)]
        {
            if found > limit {
                let what = format!("`{}` has more than {limit} {what}", self.path.display());
                return Err(Error::cannot(what, "simplify it first"));
            }
        }
        Ok(())
    }
}
