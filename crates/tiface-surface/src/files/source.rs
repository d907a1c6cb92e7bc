//! Types that all readers share: the mesh that they return, the file, its limits, and its errors.

use glam::DVec3;
use std::fmt::Display;
use std::path::{Path, PathBuf};
use tiface_base::geom::{Atlas, Mesh};
use tiface_base::{Error, Result};

/// Options and limits of reading a file. GLB can reuse one buffer many times, so the number of
/// bytes alone is no limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReadOptions {
    /// Maximum number of vertices.
    pub vertices: usize,
    /// Maximum number of triangles, after polygons are fanned.
    pub triangles: usize,
    /// Maximum number of bytes of JSON in a GLB. Of them, at most 2²⁰ may be objects or arrays, and
    /// 2²² values.
    pub json: usize,
    /// Whether to read the texture; otherwise it is skipped, valid or not.
    pub texture: bool,
}

impl ReadOptions {
    /// Reads the whole file, if it fits in memory.
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

/// Location of a file's base color.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PictureSource {
    /// In the file: PNG or JPEG, for [`tiface_base::io::parse_photo`]. Its header is within the
    /// limits for pictures; the data is not checked.
    Inside(Vec<u8>),
    /// In a picture of this name, as it is written, without quotes; it is looked for in the mesh's
    /// folder alone.
    Beside(String),
    /// In the pictures and colors of `.mtl` files, which [`super::materials_of_mtl`] reads: what
    /// stands behind each `mtllib`, a name, or several between blanks.
    Materials(Vec<String>),
}

/// Lobes beside a base color, which only a GLB of ours holds.
#[derive(Clone, Debug, PartialEq)]
pub struct LobeSource {
    /// One picture a function, as in [`PictureSource::Inside`].
    pub pictures: Vec<Vec<u8>>,
    /// Scale of each.
    pub scale: Vec<f32>,
}

/// The file being read, its format, and its limits.
#[derive(Clone, Copy)]
pub(super) struct Source<'a> {
    pub path: &'a Path,
    /// `GLB`, `PLY`, `OBJ`, `STL` or `MTL`.
    pub format: &'static str,
    pub options: &'a ReadOptions,
}

impl Source<'_> {
    /// Returns the error for a file that breaks its format's rules.
    pub fn broken(&self, at: impl Display, what: impl Display) -> Error {
        let hint = match self.format {
            "GLB" => "export it again; the Khronos validator explains a GLB in detail",
            _ => "export it again, or open it in Blender or MeshLab and save it again",
        };
        Error::cannot(format!("`{}`, {at}: {what}", self.path.display()), hint)
    }

    /// Returns the error for a word that is no number. A decimal comma is told with the way to a
    /// point.
    pub fn no_number(&self, at: impl Display, what: impl Display, word: &str) -> Error {
        let error = self.broken(at, what);
        let pointed = word.replacen(',', ".", 1);
        let has_decimal_comma = word.contains(',')
            && pointed.ends_with(|c: char| c.is_ascii_digit())
            && pointed.parse::<f64>().is_ok();
        let way = || format!("export it with decimal points: `{pointed}`, not `{word}`");
        if has_decimal_comma { error.with_hint(way()) } else { error }
    }

    /// Returns the error for a valid file that this reader does not support.
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

    /// Checks the numbers of vertices and triangles against the limits.
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

/// A mesh as it was read, with its texture.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReadMesh {
    /// The surface, its positions relative to `origin`.
    pub mesh: Mesh,
    /// The origin of the mesh in the file's coordinates: the center of a mesh that lies more than
    /// fifteen of its sizes from the file's origin, else that origin.
    pub origin: DVec3,
    /// Texture coordinates, if the file has them for all triangles. The size is that of the picture
    /// in the file, else 0 × 0. Coordinates are finite; in files of other programs they may leave
    /// 0..=1, where a texture repeats.
    pub atlas: Option<Atlas>,
    /// The base color.
    pub picture: Option<PictureSource>,
    /// Lobes beside the base color.
    pub lobes: Option<LobeSource>,
    /// Linear red, green and blue factors of the base color, if the file has them.
    pub tint: Option<[f32; 3]>,
    /// The names of the materials that an OBJ uses, each with the triangle where it begins.
    pub materials: Vec<(u32, String)>,
    /// Number of soft layers around the surface, which are not read.
    pub soft_layers: usize,
    /// Files beside it that were read.
    pub beside: Vec<PathBuf>,
    /// Values that were read otherwise than they are written, or left out; one sentence each.
    pub notes: Vec<String>,
    /// The positions in the file's coordinates while the file is read; then they move to `mesh`.
    pub(super) places: Vec<DVec3>,
}

/// The sentence about normals of which some are NaN.
pub(super) const NO_NORMALS: &str = "normals are not read: some are no numbers (NaN)";

impl ReadMesh {
    /// Adds a sentence, once.
    pub(super) fn note(&mut self, text: impl Into<String>) {
        let text = text.into();
        if !self.notes.contains(&text) {
            self.notes.push(text);
        }
    }
}

/// Returns a text without the byte order mark that some editors put before it.
pub(super) fn without_byte_order_mark(bytes: &[u8]) -> &[u8] {
    bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes)
}

/// Returns what ends the lines of a text: a line feed, which may follow a carriage return, or that
/// alone.
pub(super) fn line_end(bytes: &[u8]) -> u8 {
    if bytes.contains(&b'\n') { b'\n' } else { b'\r' }
}
