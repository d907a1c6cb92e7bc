//! How well calibrated cameras fit each other, and poses that fit better.
//!
//! The visual hull of the masks is a rough surface. Patches of it are found again in the
//! photographs (`tracks`), and poses and points that explain where they were found follow from a
//! robust bundle adjustment (`adjust`). Points are free: a surface contains the errors of the poses
//! that it was made with, so aligning photographs to it would keep half of them. The points that
//! result are the next surface; after four rounds they lie within a fraction of a pixel, whatever
//! the hull was like.
//!
//! Exact cameras gain an error this way, since shading that moves with the view moves patches a
//! little. `gate` therefore decides from the residuals which cameras are refined: none, those that
//! stand out, or all. Held-out cameras take no part; each can then be fitted alone to the points,
//! which stay.
//!
//! Everything is in scene coordinates and in pixels of the pictures searched, and a function of its
//! arguments alone, whatever the threads.

mod adjust;
pub mod exposure;
mod gate;
mod tracks;

pub use gate::{CameraFit, CameraState, LEAST_SIGHTINGS, PoseDecision};
pub use tracks::RigView;

use adjust::{Track, adjust, gauge, median, project, resected};
use glam::DVec3;
use tiface_base::geom::{Camera, Mesh};

/// Points to spread over the surface. A third of them is found on skin with stubble and pores.
pub const POINTS: usize = 8000;

/// Maximum number of points that are looked up again.
const MOST_AGAIN: usize = 3000;

/// For each round, the passes of its search: two begin in blurred pictures.
const ROUNDS: [usize; 4] = [2, 2, 1, 1];

/// Points that represent the head where cameras are compared.
const SAMPLED: usize = 500;

/// Residual of half weight where no residual has been measured yet, pixels.
const FIRST_SCALE: f64 = 1.0;

/// Least residual of half weight, pixels.
const LEAST_SCALE: f64 = 0.1;

/// Largest residual of a camera fitted alone, pixels. Points that stay have errors of their own, of
/// up to 1.2; those found by chance lie anywhere within the reach of the search, some ten pixels.
const MOST_ALONE_PX: f64 = 2.0;

/// Result of the adjustment of a rig.
#[derive(Clone, Debug)]
pub struct Rig {
    /// Which poses are to be refined.
    pub verdict: PoseDecision,
    /// Every camera, in the order given.
    pub cameras: Vec<CameraFit>,
    /// Median distance of a sighting from its point's projection with the poses given and free
    /// points, pixels.
    pub given_px: f64,
    /// The same after the adjustment of all cameras.
    pub adjusted_px: f64,
    /// The points found, in the world of the cameras with the poses to use.
    tracks: Vec<Track>,
}

/// A camera that took no part in the measurement of its rig, fitted alone to the points that the
/// rig found.
#[derive(Clone, Debug)]
pub struct HeldOutFit {
    /// How many of the points were found in its photograph.
    pub sightings: usize,
    /// Median distance of these from the projections of the points with the pose given, pixels.
    pub given_px: f64,
    /// The same with the pose fitted.
    pub fitted_px: f64,
    /// How far the head moves in its picture from the pose given to the fitted one, pixels (root
    /// mean square).
    pub moved_px: f64,
    /// The camera with the pose fitted; `None` where too few points were found, or fit no pose.
    pub camera: Option<Camera>,
}

impl Rig {
    /// Fits a camera that took no part to the points, which stay. `views` are the photographs that
    /// were measured.
    pub fn fit_held_out(&self, views: &[RigView], photo: &RigView, given: &Camera) -> HeldOutFit {
        let cameras: Vec<Camera> = self.cameras.iter().map(|fit| fit.camera.clone()).collect();
        let found = tracks::find_in((photo, given), views, &cameras, &self.tracks);
        let residual =
            |camera: &Camera| median(&mut residuals(std::slice::from_ref(camera), &found).concat());
        let mut camera = resected(given, given, &found, FIRST_SCALE);
        for _ in 0..2 {
            camera = resected(given, &camera, &found, residual(&camera).max(LEAST_SCALE));
        }
        let (sightings, fitted_px) = (found.len(), residual(&camera));
        let fits = sightings >= LEAST_SIGHTINGS && fitted_px <= MOST_ALONE_PX;
        let moved_px = distance_px(given, &camera, &sampled(&self.tracks));
        HeldOutFit {
            sightings,
            given_px: residual(given),
            fitted_px,
            moved_px,
            camera: fits.then_some(camera),
        }
    }
}

/// Measures how well cameras fit each other by this many points ([`POINTS`]). `surface` is any
/// rough surface of the head with normals; `views` and `given` are photographs and cameras of the
/// same order. `all` asks for all cameras to be refined, whatever the gain.
pub fn measure(views: &[RigView], given: &[Camera], surface: &Mesh, points: usize, all: bool) -> Rig {
    let mut cameras = given.to_vec();
    let mut seeds = tracks::seeds(surface, given, |v, pixel| views[v].is_usable(pixel), points);
    let (mut tracks, mut expected) = (Vec::new(), Vec::new());
    for passes in ROUNDS {
        expected = tracks::looked_up(&cameras, &seeds);
        let found = tracks::find(views, &cameras, &seeds, passes);
        let every = found.iter().flatten().count().div_ceil(MOST_AGAIN).max(1);
        let kept = seeds.into_iter().zip(found).filter_map(|(seed, track)| Some((seed, track?)));
        (seeds, tracks) = kept.step_by(every).unzip();
        cameras = refined(given, cameras, &mut tracks);
        seeds = tracks::moved_to(&seeds, &tracks);
    }
    gate::decide(given, cameras, tracks, &expected, all)
}

/// Returns the cameras that fit the tracks best, in the world of the given ones, and moves the
/// tracks' points there. A camera with too few sightings stays as it was given.
fn refined(given: &[Camera], start: Vec<Camera>, tracks: &mut [Track]) -> Vec<Camera> {
    let mut cameras = start;
    let free: Vec<bool> = sightings(tracks, given.len()).iter().map(|&n| n >= LEAST_SIGHTINGS).collect();
    for (v, _) in free.iter().enumerate().filter(|(_, free)| !**free) {
        cameras[v] = given[v].clone();
    }
    adjust(given, &mut cameras, tracks, &vec![false; given.len()], FIRST_SCALE);
    for _ in 0..2 {
        let scale = median(&mut residuals(&cameras, tracks).concat()).max(LEAST_SCALE);
        adjust(given, &mut cameras, tracks, &free, scale);
    }
    let measured = |cameras: &[Camera]| -> Vec<Camera> {
        cameras.iter().zip(&free).filter(|(_, free)| **free).map(|(c, _)| c.clone()).collect()
    };
    let world = gauge(&measured(given), &measured(&cameras), &sampled(tracks));
    for (camera, _) in cameras.iter_mut().zip(&free).filter(|(_, free)| **free) {
        *camera = camera.transformed(&world);
    }
    for track in tracks {
        track.position = world.point_f64(track.position);
        track.normal = world.direction(track.normal);
    }
    cameras
}

/// Returns how many sightings each camera has.
fn sightings(tracks: &[Track], cameras: usize) -> Vec<usize> {
    let mut counts = vec![0; cameras];
    tracks.iter().flat_map(|t| &t.sightings).for_each(|s| counts[s.view] += 1);
    counts
}

/// Returns for each camera the distances of its sightings from where their points are projected,
/// pixels.
fn residuals(cameras: &[Camera], tracks: &[Track]) -> Vec<Vec<f64>> {
    let mut all = vec![Vec::new(); cameras.len()];
    for track in tracks {
        for s in &track.sightings {
            all[s.view].extend(project(&cameras[s.view], track.position).map(|p| p.distance(s.pixel)));
        }
    }
    all
}

/// Returns points of the tracks that represent the head.
fn sampled(tracks: &[Track]) -> Vec<DVec3> {
    tracks.iter().step_by(tracks.len().div_ceil(SAMPLED).max(1)).map(|t| t.position).collect()
}

/// Returns how far two cameras' projections of points lie apart, pixels: the root mean square.
fn distance_px(a: &Camera, b: &Camera, points: &[DVec3]) -> f64 {
    let square = |p: &DVec3| Some(project(a, *p)?.distance_squared(project(b, *p)?));
    let squares: Vec<f64> = points.iter().filter_map(square).collect();
    (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt()
}
