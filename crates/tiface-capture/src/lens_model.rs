//! Lens models by COLMAP's names, which nerfstudio and instant-ngp also use.

use super::frame::Intrinsics;
use tiface_base::geom::{Camera, Distortion, Projection};

/// A lens model: its number in binary files, its name, and its parameters in order.
#[derive(Debug, PartialEq)]
pub(super) struct LensModel {
    pub id: i32,
    pub name: &'static str,
    pub parameters: &'static str,
}

/// Models with an inverse (COLMAP, `src/colmap/sensor/models.h`).
pub(super) const MODELS: [LensModel; 13] = [
    model(0, "SIMPLE_PINHOLE", "f cx cy"),
    model(1, "PINHOLE", "fx fy cx cy"),
    model(2, "SIMPLE_RADIAL", "f cx cy k1"),
    model(3, "RADIAL", "f cx cy k1 k2"),
    model(4, "OPENCV", "fx fy cx cy k1 k2 p1 p2"),
    model(5, "OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4"),
    model(6, "FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    model(7, "FOV", "fx fy cx cy omega"),
    model(8, "SIMPLE_RADIAL_FISHEYE", "f cx cy k1"),
    model(9, "RADIAL_FISHEYE", "f cx cy k1 k2"),
    model(10, "THIN_PRISM_FISHEYE", "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1"),
    model(14, "SIMPLE_FISHEYE", "f cx cy"),
    model(15, "FISHEYE", "fx fy cx cy"),
];

const fn model(id: i32, name: &'static str, parameters: &'static str) -> LensModel {
    LensModel { id, name, parameters }
}

/// Names of COLMAP's other models, for messages.
const UNSUPPORTED_MODELS: [(i32, &str); 5] = [
    (11, "RAD_TAN_THIN_PRISM_FISHEYE"),
    (12, "SIMPLE_DIVISION"),
    (13, "DIVISION"),
    (16, "EUCM"),
    (17, "EQUIRECTANGULAR"),
];

/// Returns the projection of a lens model.
pub(super) fn projection(model: &str) -> Projection {
    match model {
        "FOV" => Projection::Fov,
        fisheye if fisheye.ends_with("FISHEYE") => Projection::Fisheye,
        _ => Projection::Perspective,
    }
}

impl LensModel {
    /// Returns the model of this name, be it in small letters.
    pub fn named(name: &str) -> Result<&'static LensModel, String> {
        MODELS.iter().find(|m| m.name.eq_ignore_ascii_case(name)).ok_or_else(|| unknown(name))
    }

    /// Returns the model of this number.
    pub fn numbered(id: i32) -> Result<&'static LensModel, String> {
        let other = || {
            UNSUPPORTED_MODELS.iter().find(|(n, _)| *n == id).map_or(format!("number {id}"), |o| o.1.into())
        };
        MODELS.iter().find(|m| m.id == id).ok_or_else(|| unknown(&other()))
    }

    /// Returns the number of parameters.
    pub fn count(&self) -> usize {
        self.parameters.split(' ').count()
    }

    /// Returns the intrinsics of these parameters.
    pub fn intrinsics(&self, size: (u32, u32), values: &[f64]) -> Result<Intrinsics, String> {
        if values.len() != self.count() {
            let (name, parameters, found) = (self.name, self.parameters, values.len());
            return Err(format!("its model {name} has the parameters {parameters}, but {found} are given"));
        }
        if let Some(v) = values.iter().find(|v| !v.is_finite()) {
            return Err(format!("a parameter of its lens is {v}"));
        }
        let mut out = Intrinsics { size: Some(size), ..Intrinsics::default() };
        out.distortion.projection = projection(self.name);
        for (key, &value) in self.parameters.split(' ').zip(values) {
            match key {
                "f" => out.focal = [Some(value); 2],
                "fx" => out.focal[0] = Some(value),
                "fy" => out.focal[1] = Some(value),
                "cx" => out.center[0] = Some(value),
                "cy" => out.center[1] = Some(value),
                key => *coefficient(&mut out.distortion, key) = value,
            }
        }
        check_distortion(&out.distortion)?;
        Ok(out)
    }

    /// Returns the shortest model that says everything about a camera's lens, and its parameters.
    pub fn for_camera(camera: &Camera) -> Option<(&'static LensModel, Vec<f64>)> {
        let shortest = ["PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE", "FOV"];
        shortest.into_iter().find_map(|name| {
            let model = LensModel::named(name).ok()?;
            let mut distortion = camera.distortion;
            let value = |key: &str| match key {
                "fx" => camera.fx,
                "fy" => camera.fy,
                "cx" => camera.cx,
                "cy" => camera.cy,
                key => *coefficient(&mut distortion, key),
            };
            let values: Vec<f64> = model.parameters.split(' ').map(value).collect();
            let back = model.intrinsics((camera.width, camera.height), &values).ok()?;
            (back.distortion == camera.distortion).then_some((model, values))
        })
    }
}

fn unknown(name: &str) -> String {
    let known: Vec<&str> = MODELS.iter().map(|m| m.name).collect();
    format!(
        "its camera model `{name}` is not supported ({} are); undistort the photographs first: `colmap image_undistorter`",
        known.join(", ")
    )
}

/// Returns the coefficient that a parameter names.
pub(super) fn coefficient<'d>(d: &'d mut Distortion, key: &str) -> &'d mut f64 {
    match key {
        "k1" => &mut d.k1,
        "k2" => &mut d.k2,
        "k3" => &mut d.k3,
        "k4" => &mut d.k4,
        "k5" => &mut d.k5,
        "k6" => &mut d.k6,
        "p1" => &mut d.p1,
        "p2" => &mut d.p2,
        "sx1" => &mut d.sx1,
        "sy1" => &mut d.sy1,
        "omega" => &mut d.omega,
        other => unreachable!("`{other}` is no coefficient"),
    }
}

/// Refuses coefficients that no lens can have.
pub(super) fn check_distortion(d: &Distortion) -> Result<(), String> {
    if !(0.0..std::f64::consts::PI).contains(&d.omega) {
        return Err(format!("its `omega` is {}, not an angle from 0 to π", d.omega));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DMat3, DVec3, Vec2};

    #[test]
    fn every_model_is_read_as_it_was_written() {
        for model in &MODELS {
            let value = |(i, key): (usize, &str)| match key {
                "f" | "fx" | "fy" => 300.0 + i as f64,
                "cx" => 81.25,
                "cy" => 58.5,
                "omega" => 0.7,
                _ => 0.01 / (i + 1) as f64,
            };
            let values: Vec<f64> = model.parameters.split(' ').enumerate().map(value).collect();
            let intrinsics = model.intrinsics((160, 120), &values).unwrap();
            let camera = intrinsics.camera((160, 120), DMat3::IDENTITY, DVec3::ZERO).unwrap();
            let (other, again) = LensModel::for_camera(&camera).unwrap();
            let back = other.intrinsics((160, 120), &again).unwrap();
            assert_eq!(back.camera((160, 120), DMat3::IDENTITY, DVec3::ZERO).unwrap(), camera, "{model:?}");
            // and its corners look somewhere
            assert!(camera.ray(Vec2::ZERO).is_some(), "{model:?}");
            assert!(model.intrinsics((160, 120), &values[1..]).is_err());
        }
    }

    #[test]
    fn models_without_an_inverse_are_named() {
        assert!(LensModel::numbered(11).unwrap_err().contains("RAD_TAN_THIN_PRISM_FISHEYE"));
        assert!(LensModel::numbered(-7).unwrap_err().contains("number -7"));
        assert_eq!(LensModel::named("Simple_pinhole").unwrap().name, "SIMPLE_PINHOLE");
        assert!(LensModel::named("EQUIRECTANGULAR").unwrap_err().contains("image_undistorter"));
        let fov = LensModel::named("FOV").unwrap();
        assert!(fov.intrinsics((9, 9), &[1.0, 1.0, 4.0, 4.0, 4.0]).unwrap_err().contains("omega"));
    }
}
