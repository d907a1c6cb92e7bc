//! What cameras, exposures and glare are measured on: photographs at a moderate size, their masks,
//! and the surface of the hull.

use glam::Vec3;
use rayon::prelude::*;
use tiface_base::Result;
use tiface_base::error::counted;
use tiface_base::geom::{BitGrid, Camera, Mesh, Similarity};
use tiface_base::image::{Gray, Photo, reduce_photo, resize_gray, working_size};
use tiface_base::io::Limits;
use tiface_capture::rig::{self, Rig, RigView};
use tiface_capture::scene::Scene;
use tiface_capture::{Capture, Split, View};
use tiface_surface::{Volume, marching};

/// Longest side of the photographs, pixels.
const SEARCHED_PX: u32 = 1024;

/// Maximum number of training views; the system of their poses is solved densely.
const MAX_VIEWS: usize = 256;

/// Minimum number of training views: a point that two share says nothing of either.
const MIN_VIEWS: usize = 3;

/// Why nothing is measured with masks of this meaning.
pub(super) const NO_SILHOUETTES: &str = "masks say what was not looked at, and not where the head ends";

/// Photographs with masks, training views first.
pub(super) struct RigPhotos<'c> {
    /// The views.
    pub views: Vec<&'c View>,
    /// How many of them are training views.
    pub train: usize,
    /// Each one's photograph and usable part of the mask.
    pub pictures: Vec<(Photo, Gray)>,
    /// The cameras of these photographs, in the scene.
    pub cameras: Vec<Camera>,
    /// The surface of the hull, in the scene.
    pub surface: Mesh,
    /// The transform from the dataset's world to the scene.
    pub scene_from_world: Similarity,
}

impl<'c> RigPhotos<'c> {
    /// Reads what the training views show, and up to 256 held-out views. Returns the reason instead
    /// where nothing can be measured: without a hull, with fewer than three training views that
    /// have a mask, or with more than can be solved at once.
    pub fn load(
        capture: &'c Capture,
        scene: &Scene,
        limits: &Limits,
    ) -> Result<Result<RigPhotos<'c>, String>> {
        RigPhotos::load_at(SEARCHED_PX, capture, scene, limits)
    }

    /// Does what [`RigPhotos::load`] does, with photographs whose longest side has at most this
    /// many pixels.
    pub fn load_at(
        side: u32,
        capture: &'c Capture,
        scene: &Scene,
        limits: &Limits,
    ) -> Result<Result<RigPhotos<'c>, String>> {
        let split = |train: bool| capture.views.iter().filter(move |v| (v.split == Split::Train) == train);
        let all = split(true).count();
        if all > MAX_VIEWS {
            return Ok(Err(format!(
                "there are {all} training views, and at most {MAX_VIEWS} can be compared"
            )));
        }
        let too_few = |found: usize, with: &str| {
            let views = counted(found, "training view");
            format!(
                "there {} {views}{with}, and at least {MIN_VIEWS} are needed",
                if found == 1 { "is" } else { "are" }
            )
        };
        if all < MIN_VIEWS {
            return Ok(Err(too_few(all, "")));
        }
        let Some(hull) = scene.hull.as_ref() else {
            return Ok(Err("there is no hull of head masks".into()));
        };
        let wanted: Vec<&View> = split(true).chain(split(false).take(MAX_VIEWS)).collect();
        let loaded =
            wanted.par_iter().map(|view| searched(view, side, limits)).collect::<Result<Vec<_>>>()?;
        let measured = wanted.iter().zip(loaded).filter_map(|(view, loaded)| Some((*view, loaded?)));
        let (views, pictures): (Vec<&View>, Vec<(Photo, Gray)>) = measured.unzip();
        let train = views.iter().filter(|v| v.split == Split::Train).count();
        if train < MIN_VIEWS {
            return Ok(Err(too_few(train, " with a head mask")));
        }
        let camera = |(view, (photo, _)): (&&View, &(Photo, Gray))| {
            view.camera.resized(photo.width, photo.height).transformed(&scene.scene_from_world)
        };
        let cameras = views.iter().zip(&pictures).map(camera).collect();
        let (surface, scene_from_world) = (hull_surface(hull)?, scene.scene_from_world);
        Ok(Ok(RigPhotos { views, train, pictures, cameras, surface, scene_from_world }))
    }

    /// Measures how well the cameras of the training views fit each other, by this many points.
    /// Returns their photographs as they were searched, and what was found. `all` asks for all
    /// poses to be refined.
    pub fn measure(&self, points: usize, all: bool) -> (Vec<RigView>, Rig) {
        let pictures = self.pictures[..self.train].par_iter();
        let views: Vec<RigView> = pictures.map(|(photo, head)| RigView::new(photo, head)).collect();
        let rig = rig::measure(&views, &self.cameras[..self.train], &self.surface, points, all);
        (views, rig)
    }
}

/// Returns a view's photograph and its mask at the size that is searched; `None` without a mask.
fn searched(view: &View, side: u32, limits: &Limits) -> Result<Option<(Photo, Gray)>> {
    let loaded = view.load(limits)?;
    let Some(mut mask) = loaded.mask else { return Ok(None) };
    if let Some(valid) = &loaded.valid {
        mask.values.iter_mut().zip(&valid.values).for_each(|(m, v)| *m = (*m).min(*v));
    }
    let size = working_size(view.camera.width, view.camera.height, side);
    Ok(Some((reduce_photo(&loaded.photo, size), resize_gray(&mask, size))))
}

/// Returns the surface of a hull, smoothed and drawn in by about a cell, since a hull holds every
/// cell that any mask may touch.
fn hull_surface(hull: &BitGrid) -> Result<Mesh> {
    /// Share of the smoothed cells' value where the surface lies; one half would be the hull's own.
    const LEVEL: f32 = 0.8;
    let r = hull.resolution;
    // the hull's cells run along z first, the volume's nodes along x
    let inside = |i: usize| hull.get((i % r * r + i / r % r) * r + i / (r * r));
    let mut values: Vec<f32> = (0..r.pow(3)).map(|i| f32::from(u8::from(inside(i)))).collect();
    for stride in [1, r, r * r, 1, r, r * r] {
        let before = values.clone();
        let smooth = |(i, value): (usize, &mut f32)| {
            let place = i / stride % r;
            let low = if place > 0 { before[i - stride] } else { 0.0 };
            let high = if place + 1 < r { before[i + stride] } else { 0.0 };
            *value = 0.25 * (low + high) + 0.5 * before[i];
        };
        values.par_iter_mut().enumerate().for_each(smooth);
    }
    values.iter_mut().for_each(|v| *v = LEVEL - *v);
    let cell = 2.0 / r as f32;
    let (origin, spacing) = (Vec3::splat(0.5 * cell - 1.0), Vec3::splat(cell));
    let mut surface = marching(&Volume { dims: [r; 3], values: &values, origin, spacing }, true)?.mesh;
    surface.normals = surface.angle_weighted_normals();
    Ok(surface)
}
