//! What the camera files say, before any photograph is looked at.

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
}
