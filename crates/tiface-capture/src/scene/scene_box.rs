//! The box in which fields are trained: around the head, the published one, or a given one.
//!
//! A given box, and the published one, override the masks. TI-Face's code has two worlds for its
//! captures: T-Face's and the baseline's is the dataset's divided by 0.3, their box ±(1.5, 1.67,
//! 1.0) in it; I-Face's is the dataset's, its box ±0.3. So a scene whose unit is 0.3 of the
//! dataset's has I-Face in [-1, 1]³, as every scene has, and T-Face in its published numbers.

use super::{Scene, world_box};
use glam::{DVec3, Vec3};
use tiface_base::geom::{Aabb, Similarity};
use tiface_base::{Error, Result};

/// Half of the sides of T-Face's published box, in units of 0.3 of the dataset's.
const ILSH_HALF: Vec3 = Vec3::new(1.5, 1.67, 1.0);

/// Dataset units in a unit of T-Face's published world.
const ILSH_UNIT: f64 = 0.3;

/// The box in which fields are trained: `capture.box`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SceneBox {
    /// The box located by cameras and masks.
    Head,
    /// The published box of the ILSH captures, if it contains the head.
    Ilsh,
    /// Any box, in dataset units.
    Given(Aabb),
}

impl SceneBox {
    /// Parses `capture.box`.
    pub fn parse(text: &str) -> Result<SceneBox> {
        let wrong = |why: String| {
            let hint = "write head, ilsh or the lowest and the highest corner: `-0.4,-0.5,-0.3,0.4,0.5,0.3`";
            Err(Error::usage(format!("`capture.box` {why}"), hint))
        };
        match text.trim() {
            "head" | "" => return Ok(SceneBox::Head),
            "ilsh" => return Ok(SceneBox::Ilsh),
            _ => {}
        }
        let numbers: Vec<&str> = text.split([',', ' ']).filter(|word| !word.is_empty()).collect();
        let values: Vec<f32> = numbers.iter().filter_map(|n| n.parse().ok()).collect();
        let [x0, y0, z0, x1, y1, z1] = values[..] else {
            return wrong(format!("is `{text}`: neither a word nor six numbers"));
        };
        let (min, max) = (Vec3::new(x0, y0, z0), Vec3::new(x1, y1, z1));
        if !(min.is_finite() && max.is_finite() && min.cmplt(max).all()) {
            return wrong(format!("is `{text}`, which is not a box with its lowest corner first"));
        }
        Ok(SceneBox::Given(Aabb { min, max }))
    }
}

/// Returns the scene of the published box: its unit is 0.3 dataset units, its origin the dataset's.
fn ilsh() -> Scene {
    Scene {
        scene_from_world: Similarity::scale_translate(1.0 / ILSH_UNIT, DVec3::ZERO),
        aabb: Aabb { min: -ILSH_HALF, max: ILSH_HALF },
        hull: None,
    }
}

/// Returns the scene of the configured box, and a warning if it cannot be used.
///
/// `found` locates the head by cameras and masks, and is not called for a given box, which has no
/// hull.
pub fn in_box(
    found: impl FnOnce() -> Result<(Scene, Vec<String>)>,
    wanted: SceneBox,
) -> Result<(Scene, Vec<String>)> {
    if let SceneBox::Given(b) = wanted {
        let (middle, half) = (b.center().as_dvec3(), 0.5 * b.size());
        let longest = half.max_element();
        let aabb = Aabb { min: -half / longest, max: half / longest };
        let scale = 1.0 / f64::from(longest);
        let scene =
            Scene { scene_from_world: Similarity::scale_translate(scale, -middle * scale), aabb, hull: None };
        return Ok((scene, Vec::new()));
    }
    let (scene, mut warnings) = found()?;
    if wanted == SceneBox::Head {
        return Ok((scene, warnings));
    }
    let head = world_box(&scene);
    let cube = ILSH_UNIT as f32;
    let (middle, half) = (head.center(), 0.5 * head.size().max_element());
    if middle.abs().max_element() < cube && (0.5 * cube..2.5 * cube).contains(&half) {
        return Ok((ilsh(), warnings));
    }
    warnings.push(format!(
        "the published box, ±{cube} dataset units around the origin, does not hold the head, which is around \
         {middle:.2} and {:.2} units long: its own box is taken",
        2.0 * half
    ));
    Ok((scene, warnings))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(center: f32, half: f32) -> impl FnOnce() -> Result<(Scene, Vec<String>)> {
        let scale = 1.0 / f64::from(half);
        let middle = DVec3::splat(f64::from(center));
        let scene_from_world = Similarity::scale_translate(scale, -middle * scale);
        move || Ok((Scene { scene_from_world, aabb: Aabb::SCENE, hull: None }, Vec::new()))
    }

    #[test]
    fn the_published_box_has_the_published_numbers_in_both_worlds() {
        let (scene, warnings) = in_box(found(0.02, 0.3), SceneBox::Ilsh).unwrap();
        assert!(warnings.is_empty());
        // ±(0.45, 0.501, 0.3) dataset units
        let world = world_box(&scene);
        assert!((world.max - Vec3::new(0.45, 0.501, 0.3)).abs().max_element() < 1e-6, "{world:?}");
        assert!((world.min + world.max).abs().max_element() < 1e-6);
        // I-Face's cube is [-1, 1]³ of every scene
        let corner = scene.scene_from_world.inverse().point(Vec3::ONE);
        assert!((corner - 0.3).abs().max_element() < 1e-7, "{corner}");
        // T-Face's box in its own world
        assert_eq!(scene.aabb, Aabb { min: -ILSH_HALF, max: Vec3::new(1.5, 1.67, 1.0) });
    }

    #[test]
    fn a_head_outside_the_published_box_keeps_its_own() {
        let (scene, warnings) = in_box(found(3.0, 0.3), SceneBox::Ilsh).unwrap();
        assert!(warnings[0].contains("its own box is taken"), "{warnings:?}");
        assert_eq!(scene, found(3.0, 0.3)().unwrap().0);
        // and one of another size
        assert_eq!(in_box(found(0.0, 3.0), SceneBox::Ilsh).unwrap().1.len(), 1);
    }

    #[test]
    fn a_given_box_is_taken_as_it_is_and_what_is_none_is_refused() {
        let b = SceneBox::parse("-1, 0 2  3,2,3").unwrap();
        assert_eq!(
            b,
            SceneBox::Given(Aabb { min: Vec3::new(-1.0, 0.0, 2.0), max: Vec3::new(3.0, 2.0, 3.0) })
        );
        let search = || -> Result<(Scene, Vec<String>)> { panic!("nothing is looked for") };
        let (scene, _) = in_box(search, b).unwrap();
        // 4 long: 2 units are one of the scene
        assert_eq!(scene.aabb.max, Vec3::new(1.0, 0.5, 0.25));
        let world = world_box(&scene);
        assert!((world.min - Vec3::new(-1.0, 0.0, 2.0)).abs().max_element() < 1e-6);
        assert_eq!(SceneBox::parse("head").unwrap(), SceneBox::Head);
        for bad in ["1,2,3", "body", "0,0,0,1,1,nan", "0,0,0,1,0,1"] {
            let e = SceneBox::parse(bad).unwrap_err();
            assert!(e.to_string().contains("capture.box") && e.to_string().contains(bad), "{e}");
        }
    }
}
