//! What the camera files say, before any photograph is looked at; and pose matrices: a rotation and a position, or a
//! reason why not.

use super::view::Split;
use crate::Error;
use crate::geom::{Aabb, Camera, Distortion};
use glam::{DMat3, DVec3};
use serde::Serialize;
use std::path::PathBuf;

/// Everything a format's reader found.
#[derive(Debug)]
pub(super) struct Listing {
    /// The format, in words, once one was recognized.
    pub format: Option<&'static str>,
    pub frames: Vec<CameraFrame>,
    /// What the format was recognized by, and what else was found.
    pub reasons: Vec<String>,
    pub warnings: Vec<String>,
    pub problems: Vec<Error>,
    /// How well each LLFF file agrees with the JSON beside it.
    pub agreements: Vec<Agreement>,
    /// The world's up, where the dataset names it.
    pub up: Option<DVec3>,
    /// Where the frames' own masks are from, in words.
    pub masks_named: &'static str,
    /// Where the dataset says the head is.
    pub focus: Option<Aabb>,
    /// Points on what was photographed.
    pub points: Vec<DVec3>,
}

impl Default for Listing {
    fn default() -> Listing {
        Listing {
            format: None,
            frames: Vec::new(),
            reasons: Vec::new(),
            warnings: Vec::new(),
            problems: Vec::new(),
            agreements: Vec::new(),
            up: None,
            masks_named: "`mask_path` of each frame",
            focus: None,
            points: Vec::new(),
        }
    }
}

/// How well two camera files agree.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Agreement {
    /// The LLFF file.
    pub poses: String,
    /// How many cameras were compared.
    pub cameras: usize,
    /// Largest difference of positions, dataset units.
    pub position: f64,
    /// Largest angle between rotations, radians.
    pub rotation: f64,
    /// Largest relative difference of focal lengths.
    pub focal: f64,
}

/// One camera as its file describes it.
#[derive(Clone, Debug)]
pub(super) struct CameraFrame {
    /// The camera file.
    pub file: String,
    /// The photograph as written there.
    pub name: String,
    /// The photograph, if there is one.
    pub photo: Option<PathBuf>,
    /// Its path relative to the capture.
    pub relative: PathBuf,
    pub split: Option<Split>,
    pub intrinsics: Intrinsics,
    pub rotation: DMat3,
    pub position: DVec3,
    pub mask: Option<PathBuf>,
    pub region: Option<PathBuf>,
}

impl CameraFrame {
    /// A frame of `file`, without split, mask and region. `name` is the photograph as written there, `photo` what
    /// [`CaptureFolder::photo`](super::folder::CaptureFolder::photo) found of it.
    pub fn new(
        file: &str,
        name: &str,
        (relative, photo): (PathBuf, Option<PathBuf>),
        intrinsics: Intrinsics,
        (rotation, position): (DMat3, DVec3),
    ) -> CameraFrame {
        let (file, name) = (file.to_string(), name.to_string());
        let (split, mask, region) = (None, None, None);
        CameraFrame { file, name, photo, relative, split, intrinsics, rotation, position, mask, region }
    }
}

/// Intrinsics as declared; complete only together with the photograph's size.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Intrinsics {
    pub size: Option<(u32, u32)>,
    /// Focal lengths in pixels.
    pub focal: [Option<f64>; 2],
    /// Full opening angles in radians, used where the focal length is absent.
    pub angle: [Option<f64>; 2],
    /// Principal point from the top-left corner, pixels; the middle where absent.
    pub center: [Option<f64>; 2],
    pub distortion: Distortion,
}

impl Intrinsics {
    /// The camera of a picture of `size`. One focal length stands for both.
    pub fn camera(&self, size: (u32, u32), rotation: DMat3, position: DVec3) -> Result<Camera, String> {
        let side = [size.0 as f64, size.1 as f64];
        let focal =
            |k: usize| self.focal[k].or_else(|| self.angle[k].map(|a| 0.5 * side[k] / (0.5 * a).tan()));
        let (fx, fy) = match (focal(0), focal(1)) {
            (Some(fx), Some(fy)) => (fx, fy),
            (Some(f), None) | (None, Some(f)) => (f, f),
            (None, None) => {
                return Err("it has neither `fl_x` nor `camera_angle_x`, nor has the whole file".into());
            }
        };
        for (name, f) in [("fl_x", fx), ("fl_y", fy)] {
            if !(f.is_finite() && f > 0.0) {
                return Err(format!("the focal length `{name}` is {f}, it must be positive"));
            }
        }
        let [cx, cy] = [0, 1].map(|k| self.center[k].unwrap_or(0.5 * side[k]));
        let (width, height) = size;
        // beyond a whole picture beside it, the intrinsics belong to another size
        if [(cx, side[0]), (cy, side[1])].iter().any(|&(c, side)| !(c > -side && c < 2.0 * side)) {
            return Err(format!(
                "the principal point ({cx}, {cy}) is far outside its {width} × {height} pixels"
            ));
        }
        let distortion = self.distortion;
        Ok(Camera { width, height, fx, fy, cx, cy, distortion, rotation, position })
    }
}

/// How far `RᵀR` may be from the identity.
const TOLERANCE: f64 = 1e-3;

/// Rotation and position of the upper three rows of a camera-to-world matrix; the rotation comes back
/// exactly orthonormal. The problem says whether the matrix mirrors, scales or shears.
pub(super) fn pose(rows: &[[f64; 4]; 3]) -> Result<(DMat3, DVec3), String> {
    if rows.iter().flatten().any(|v| !v.is_finite()) {
        return Err("its pose holds a number that is not finite".into());
    }
    let column = |k: usize| DVec3::new(rows[0][k], rows[1][k], rows[2][k]);
    let rotation = orthonormal(DMat3::from_cols(column(0), column(1), column(2)))?;
    Ok((rotation, column(3)))
}

/// The nearest rotation to one that is a rotation within [`TOLERANCE`].
pub(super) fn orthonormal(m: DMat3) -> Result<DMat3, String> {
    let lengths = [m.x_axis.length(), m.y_axis.length(), m.z_axis.length()];
    let determinant = m.determinant();
    let volume = lengths[0] * lengths[1] * lengths[2];
    if volume <= 1e-30 || determinant.abs() < 1e-6 * volume {
        return Err("its rotation is singular: it flattens space".into());
    }
    if determinant < 0.0 {
        return Err(format!("its rotation mirrors (determinant {determinant:.4}), cameras cannot"));
    }
    let error = m.transpose() * m - DMat3::IDENTITY;
    let worst = error.to_cols_array().iter().fold(0.0f64, |a, b| a.max(b.abs()));
    if worst > TOLERANCE {
        let mean = (lengths[0] + lengths[1] + lengths[2]) / 3.0;
        let scaled = (m.transpose() * m) * (1.0 / (mean * mean)) - DMat3::IDENTITY;
        if scaled.to_cols_array().iter().all(|e| e.abs() <= TOLERANCE) {
            return Err(format!("its rotation also scales, by {mean:.6}"));
        }
        return Err(format!(
            "its rotation is not orthonormal: RᵀR differs from the identity by {worst:.4} (allowed {TOLERANCE})"
        ));
    }
    // Newton's iteration for the polar decomposition; from 1e-3 three steps reach 1e-16
    let mut r = m;
    for _ in 0..4 {
        r = (r + r.inverse().transpose()) * 0.5;
    }
    Ok(r)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_opening_angle_becomes_a_focal_length() {
        // 90° over 200 pixels: f = 100 / tan 45° = 100
        let intrinsics = Intrinsics { angle: [Some(90f64.to_radians()), None], ..Intrinsics::default() };
        let c = intrinsics.camera((200, 100), DMat3::IDENTITY, DVec3::ZERO).unwrap();
        assert!((c.fx - 100.0).abs() < 1e-9 && c.fy == c.fx);
        assert_eq!((c.cx, c.cy), (100.0, 50.0));
        assert!(Intrinsics::default().camera((2, 2), DMat3::IDENTITY, DVec3::ZERO).is_err());
    }

    fn rows(m: DMat3) -> [[f64; 4]; 3] {
        [0, 1, 2].map(|r| [m.x_axis[r], m.y_axis[r], m.z_axis[r], r as f64])
    }

    #[test]
    fn a_rotation_passes_and_is_made_exact() {
        let r = DMat3::from_rotation_y(0.3) * DMat3::from_rotation_x(1.0);
        let (found, position) = pose(&rows(r * 1.0003)).unwrap();
        assert!((found - r).to_cols_array().iter().all(|e| e.abs() < 1e-12));
        assert_eq!(position, DVec3::new(0.0, 1.0, 2.0));
    }

    #[test]
    fn mirrors_scales_shears_and_flat_ones_are_told_apart() {
        let says = |m: DMat3| pose(&rows(m)).unwrap_err();
        assert!(says(DMat3::from_diagonal(DVec3::new(1.0, 1.0, -1.0))).contains("mirrors"));
        assert!(says(DMat3::IDENTITY * 2.0).contains("scales, by 2.0"));
        assert!(says(DMat3::from_diagonal(DVec3::new(1.0, 1.01, 1.0))).contains("not orthonormal"));
        assert!(says(DMat3::from_diagonal(DVec3::new(1.0, 1.0, 0.0))).contains("singular"));
        assert!(says(DMat3::IDENTITY * f64::NAN).contains("not finite"));
    }
}
