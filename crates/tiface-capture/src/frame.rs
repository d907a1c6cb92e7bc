//! The content of camera files, before any photograph is read: frames, their poses and intrinsics.

use super::view::Split;
use glam::{DMat3, DVec3};
use serde::Serialize;
use std::path::PathBuf;
use tiface_base::Error;
use tiface_base::geom::{Aabb, Camera, Distortion};

/// Everything that a reader of camera files found.
#[derive(Debug)]
pub(super) struct Listing {
    /// Name of the format, once recognized.
    pub format: Option<&'static str>,
    pub frames: Vec<CameraFrame>,
    /// How the format was recognized, and other findings.
    pub reasons: Vec<String>,
    pub warnings: Vec<String>,
    pub problems: Vec<Error>,
    /// Agreement of each LLFF file with the JSON next to it.
    pub agreements: Vec<Agreement>,
    /// Up direction of the world, if the dataset names it.
    pub up: Option<DVec3>,
    /// Source of the frames' own masks, for messages.
    pub masks_named: &'static str,
    /// Where no mask is found, what may be masks and is not used, in a sentence.
    pub stray_masks: Option<String>,
    /// The dataset's own box of the head.
    pub focus: Option<Aabb>,
    /// Points on the photographed surface.
    pub points: Vec<DVec3>,
    /// Whether only their order pairs photographs with cameras, and by number it is another one.
    pub order_is_open: bool,
    /// Likewise of masks with photographs.
    pub mask_order_is_open: bool,
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
            stray_masks: None,
            focus: None,
            points: Vec::new(),
            order_is_open: false,
            mask_order_is_open: false,
        }
    }
}

/// Agreement of two camera files.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Agreement {
    /// The LLFF file.
    pub poses: String,
    /// Number of compared cameras.
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
    /// The photograph's name as written in that file.
    pub name: String,
    /// The photograph, if it exists.
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
    /// Returns a frame of `file`, without split, mask and region. `name` is the photograph's name
    /// as written in it, `photo` the result of
    /// [`CaptureFolder::photo`](super::folder::CaptureFolder::photo).
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
    /// Full fields of view in radians, used if the focal length is absent.
    pub angle: [Option<f64>; 2],
    /// Principal point from the top-left corner, pixels; the center if absent.
    pub center: [Option<f64>; 2],
    pub distortion: Distortion,
}

impl Intrinsics {
    /// Returns whether a focal length or an angle is declared.
    pub fn has_focal(&self) -> bool {
        self.focal.iter().chain(&self.angle).any(Option::is_some)
    }

    /// Returns the camera of a picture of `size`. A single focal length is used for both axes.
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
        self.check_pixels(side)?;
        let [cx, cy] = [0, 1].map(|k| self.center[k].unwrap_or(0.5 * side[k]));
        let (width, height) = size;
        // a principal point farther outside than a whole picture belongs to another size
        if [(cx, side[0]), (cy, side[1])].iter().any(|&(c, side)| !(c > -side && c < 2.0 * side)) {
            return Err(format!(
                "the principal point ({cx}, {cy}) is far outside its {width} × {height} pixels"
            ));
        }
        let distortion = self.distortion;
        Ok(Camera { width, height, fx, fy, cx, cy, distortion, rotation, position })
    }

    /// Refuses a focal length and a principal point that cannot be pixels of a picture of this
    /// size: a lens of more than 157°, and a principal point in the corner or on the edge.
    fn check_pixels(&self, side: [f64; 2]) -> Result<(), String> {
        let longest = side[0].max(side[1]);
        for (k, name) in ["fl_x", "fl_y"].into_iter().enumerate() {
            let Some(f) = self.focal[k].filter(|f| *f < 0.1 * longest) else { continue };
            let unit = if f < 10.0 {
                format!("as a share of the picture's side (normalized) it is {:.1} pixels", f * side[k])
            } else {
                "millimeters are multiplied by the picture's width and divided by the sensor's".into()
            };
            return Err(format!(
                "the focal length `{name}` is {f} of a picture with {longest} pixels, which no lens has; it must be in \
                 pixels: {unit}"
            ));
        }
        let is_off = |k: &usize| self.center[*k].is_some_and(|c| c.abs() <= 1.0);
        let off: Vec<usize> = [0, 1].into_iter().filter(is_off).collect();
        if off.is_empty() || side[0].min(side[1]) <= 4.0 {
            return Ok(());
        }
        let [w, h] = side;
        let value = |k: usize| self.center[k].unwrap_or(0.0);
        let is_share = off.iter().all(|k| value(*k) > 0.0);
        let told = |k: &usize| match (["cx", "cy"][*k], is_share) {
            (name, true) => format!("`{name}` is {:.1}", value(*k) * side[*k]),
            (name, false) => format!("`{name}` is {:.2}", value(*k) + 0.5 * side[*k]),
        };
        let told = off.iter().map(told).collect::<Vec<_>>().join(" and ");
        let unit =
            if is_share { "as a share of the picture (normalized)" } else { "counted from the middle," };
        let place = match off[..] {
            [k] => format!("`{}` of the principal point is {}, on the edge", ["cx", "cy"][k], value(k)),
            _ => format!("the principal point ({}, {}) is in the corner", value(0), value(1)),
        };
        Err(format!(
            "{place} of its {w} × {h} pixels; `cx` and `cy` must be pixels from the top left corner: {unit} \
             {told}; the middle is meant where both are absent"
        ))
    }
}

/// Maximum difference of `RᵀR` from the identity.
const TOLERANCE: f64 = 1e-3;

/// Returns rotation and position of the upper three rows of a camera-to-world matrix, the rotation
/// exactly orthonormal. The error says whether the matrix mirrors, scales or shears.
pub(super) fn pose(rows: &[[f64; 4]; 3]) -> Result<(DMat3, DVec3), String> {
    if rows.iter().flatten().any(|v| !v.is_finite()) {
        return Err("its pose holds a number that is not finite".into());
    }
    let column = |k: usize| DVec3::new(rows[0][k], rows[1][k], rows[2][k]);
    let rotation = orthonormal(DMat3::from_cols(column(0), column(1), column(2)))?;
    Ok((rotation, column(3)))
}

/// Returns the nearest rotation to a matrix that is a rotation within [`TOLERANCE`].
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

    #[test]
    fn lens_parameters_that_are_not_pixels_are_refused_with_their_value_in_pixels() {
        let of = |focal: f64, center: [Option<f64>; 2], size| {
            let intrinsics = Intrinsics { focal: [Some(focal); 2], center, ..Intrinsics::default() };
            intrinsics.camera(size, DMat3::IDENTITY, DVec3::ZERO).map(|camera| (camera.fx, camera.cx))
        };
        let says = |focal, center, size| of(focal, center, size).unwrap_err();
        let middle = [None; 2];
        // 1.2 · 96
        assert!(says(1.2, middle, (96, 128)).contains("(normalized) it is 115.2 pixels"));
        assert!(says(50.0, middle, (4000, 3000)).contains("millimeters"));
        assert!(says(330.0, [Some(0.5); 2], (96, 128)).contains("`cx` is 48.0 and `cy` is 64.0"));
        assert!(says(330.0, [Some(0.0), Some(-0.25)], (96, 128)).contains("`cx` is 48.00 and `cy` is 63.75"));
        // a fisheye of 180° on 96 pixels, and a picture cut from the corner of another
        assert_eq!(of(30.6, middle, (96, 96)), Ok((30.6, 48.0)));
        assert_eq!(of(330.0, [Some(1.5), Some(40.0)], (96, 128)), Ok((330.0, 1.5)));
        assert_eq!(of(330.0, [Some(-40.0), Some(2.5)], (96, 128)), Ok((330.0, -40.0)));
    }

    #[test]
    fn one_coordinate_of_the_principal_point_that_is_no_pixel_is_refused_alone() {
        let says = |center| {
            let intrinsics = Intrinsics { focal: [Some(330.0); 2], center, ..Intrinsics::default() };
            intrinsics.camera((96, 128), DMat3::IDENTITY, DVec3::ZERO).unwrap_err()
        };
        for (center, name, there) in [
            ([Some(0.5), Some(64.0)], "`cx` of the principal point is 0.5", "(normalized) `cx` is 48.0;"),
            ([None, Some(0.5)], "`cy` of the principal point is 0.5", "(normalized) `cy` is 64.0;"),
            ([Some(48.0), Some(-0.25)], "`cy` of the principal point is -0.25", "the middle, `cy` is 63.75;"),
        ] {
            let text = says(center);
            assert!(text.contains(name) && text.contains(there), "{text}");
        }
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
