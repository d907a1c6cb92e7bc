//! What is asked of an export: which files, and what they show of a head.

use crate::config::MeshFormat;
use crate::pipeline::frames::MeshFrame;
use crate::pipeline::mesh_files::Material;
use glam::DVec3;
use tiface_base::{Error, Result};

/// What files show of a kept head, and how they are written.
#[derive(Clone, Debug)]
pub struct ExportRequest {
    /// Formats to write.
    pub formats: Vec<MeshFormat>,
    /// Material of GLB and USDZ; unlit by default, but lit with a normal map.
    pub material: Option<Material>,
    /// Coordinate frame.
    pub frame: MeshFrame,
    /// Whether the color is stored as JPEG, not PNG.
    pub jpeg: bool,
    /// Whether a GLB is compressed, with its color as JPEG.
    pub compress: bool,
    /// Meters per unit of an OBJ, which states none.
    pub obj_unit_m: f64,
    /// What the size of the files follows.
    pub size: Size,
    /// Where the head ends.
    pub cut: Cut,
    /// Number of triangles at most; by default those of the run's own files.
    pub triangles: Option<u32>,
    /// Number of levels of detail, each with half the triangles of the one before.
    pub levels: usize,
    /// Side of the texture, texels, 0 for colors at the vertices; by default the kept one.
    pub texture_px: Option<u32>,
    /// Whether soft layers are written.
    pub layers: bool,
    /// Whether view-dependent color is written.
    pub lobes: bool,
    /// Whether a normal map is written.
    pub normal_map: bool,
}

impl Default for ExportRequest {
    fn default() -> ExportRequest {
        ExportRequest {
            formats: vec![MeshFormat::Glb],
            material: None,
            frame: MeshFrame::Dataset,
            jpeg: false,
            compress: false,
            obj_unit_m: 1.0,
            size: Size::Dataset,
            cut: Cut::None,
            triangles: None,
            levels: 1,
            texture_px: None,
            layers: true,
            lobes: true,
            normal_map: true,
        }
    }
}

/// What the size of a head in its files follows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Size {
    /// The length of the dataset's unit, `capture.unit_m`.
    Dataset,
    /// The head's height from chin to crown, meters.
    Head(f64),
    /// The distance between two points of the dataset's world, meters.
    Between([DVec3; 2], f64),
}

/// Where a head ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cut {
    /// Where the run's own ends.
    None,
    /// Below the chin, rising to the nape.
    Chin,
    /// At the neck's base, above the shoulders.
    Collar,
}

/// Formats of a textured mesh in meters; the others keep the dataset's world.
pub(super) const TEXTURED: &[MeshFormat] = &[MeshFormat::Glb, MeshFormat::Obj, MeshFormat::Usdz];

/// Formats that say how light falls on a mesh.
const SHADED: &[MeshFormat] = &[MeshFormat::Glb, MeshFormat::Usdz];

impl ExportRequest {
    /// Returns the options that are asked for, each with what it is and the formats that show it.
    pub(super) fn options(&self) -> Vec<(&'static str, &'static str, &'static [MeshFormat])> {
        let options = [
            (self.material.is_some(), "--material", "choice of material", SHADED),
            (self.frame != MeshFrame::Dataset, "--frame", "frame but the dataset's", TEXTURED),
            (self.jpeg, "--jpeg", "picture", TEXTURED),
            (self.compress, "--compress", "compression", &[MeshFormat::Glb]),
            (self.obj_unit_m != 1.0, "--unit", "choice of unit", &[MeshFormat::Obj]),
            (matches!(self.size, Size::Head(_)), "--height", "height in meters", TEXTURED),
            (matches!(self.size, Size::Between(..)), "--measure", "length in meters", TEXTURED),
        ];
        let asked = options.into_iter().filter(|(asked, ..)| *asked);
        asked.map(|(_, option, what, shown_by)| (option, what, shown_by)).collect()
    }
}

/// Returns a warning that names the formats which do not show what an option asks for. Fails if
/// none shows it.
pub(super) fn not_shown(
    option: &str,
    what: &str,
    shown_by: &[MeshFormat],
    formats: &[MeshFormat],
) -> Result<Option<String>> {
    let endings = |list: &mut dyn Iterator<Item = &MeshFormat>| {
        list.map(|format| format!(".{}", format.as_str())).collect::<Vec<_>>().join(", ")
    };
    let without = endings(&mut formats.iter().filter(|f| !shown_by.contains(f)));
    if without.is_empty() {
        return Ok(None);
    }
    let problem = format!("`{option}` does not affect {without} files, which have no {what}");
    match formats.iter().any(|f| shown_by.contains(f)) {
        true => Ok(Some(problem)),
        false => {
            Err(Error::usage(problem, format!("leave it out, or write {}", endings(&mut shown_by.iter()))))
        }
    }
}
