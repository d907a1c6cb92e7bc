//! Locates the head: a box from cameras and masks, which gives near, far and radius.
//!
//! With masks: the rays through the masks' centroids meet near the head. A cube around that point, wide
//! enough for every frame, is carved by the silhouettes at a coarse resolution, shrunk to the remaining cells, and
//! carved again until it no longer shrinks. Space outside a frame, beyond a border that the mask touches, is undecided
//! for that view. So two rules define the end of a body that the frames cut:
//!
//! - the *box* is drawn around the cells that touch the masks of a third of the views (three at least):
//!   farther out, too few cameras see the body to reconstruct it;
//! - the *hull* is everything inside that box that touches three masks: the space in which the head may still be.
//!
//! Without masks: the box of the region that 40 % of the cameras have in their frame, no farther from the
//! meeting point of the viewing axes than 0.6 of the cameras' median distance to it; drawn tighter around the
//! dataset's points within it, or the dataset's own box.
//!
//! A given box, and the published one, override the masks. TI-Face's code
//! has two worlds for its captures: T-Face's and the baseline's is the dataset's divided by 0.3, their box
//! ±(1.5, 1.67, 1.0) in it; I-Face's is the dataset's, its box ±0.3. So a scene whose unit is 0.3 of the dataset's has
//! I-Face in [-1, 1]³, as every scene has, and T-Face in its published numbers.
//!
//! A body that the frames cut continues where hardly any camera sees it; a field can only guess that part.
//! Training still needs that part (rays of good pixels pass through it), the mesh does not: it is closed by
//! a flat cap where too few cameras see the body ([`well_seen`]).

use super::carve::{self, Cube, Projector, SilhouetteTable};
use super::masks::few;
use super::view::View;
use crate::error::counted;
use crate::geom::{Aabb, Camera, Similarity};
use crate::image::Gray;
use crate::{Error, Result};
use glam::{DMat3, DQuat, DVec3, Vec3};
use serde::{Deserialize, Serialize};

/// The head's box and how it sits in the world.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Scene {
    /// The box's longest side fills [-1, 1], to within a tenth. Up is an axis of the scene where masks locate the head;
    /// elsewhere the scene has the axes of the world.
    pub scene_from_world: Similarity,
    /// The tight box in scene coordinates, within [-1, 1]³.
    pub aabb: Aabb,
    /// The visual hull; `None` without masks.
    pub hull: Option<Hull>,
}

/// The visual hull as cells over [-1, 1]³ of the scene; it contains the whole head.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Hull {
    /// Cells per axis.
    pub resolution: usize,
    /// One bit per cell, cell `(x · R + y) · R + z`, lowest bit first.
    pub bits: Vec<u64>,
}

impl Hull {
    fn new(resolution: usize, kept: &[bool]) -> Hull {
        let mut bits = vec![0u64; kept.len().div_ceil(64)];
        for (i, _) in kept.iter().enumerate().filter(|(_, k)| **k) {
            bits[i / 64] |= 1 << (i % 64);
        }
        Hull { resolution, bits }
    }

    /// Returns whether cell `i = (x · R + y) · R + z` is part of the hull.
    pub fn get(&self, i: usize) -> bool {
        self.bits[i / 64] >> (i % 64) & 1 == 1
    }

    /// Returns the number of cells in the hull.
    pub fn count(&self) -> usize {
        self.bits.iter().map(|b| b.count_ones() as usize).sum()
    }

    /// Returns whether a point in scene coordinates is in a cell of the hull.
    pub fn contains(&self, point: Vec3) -> bool {
        if !Aabb::SCENE.contains(point) {
            return false;
        }
        let r = self.resolution;
        let cell = (point + 1.0) * 0.5 * r as f32;
        let [x, y, z] = cell.to_array().map(|c| (c as usize).min(r - 1));
        self.get((x * r + y) * r + z)
    }
}

/// Mask values above this may be head; low, so that soft hair is not carved away.
const THRESHOLD: u8 = 12;

/// Number of masks that a cell must touch, or all if there are fewer.
const MIN_VIEWS: usize = 3;

/// Margin of empty cells around the hull.
const MARGIN_CELLS: usize = 2;

/// Options of [`fit`].
#[derive(Clone, Debug, PartialEq)]
pub struct SceneOptions {
    /// Cells per axis of the hull.
    pub resolution: usize,
    /// Names of the views for messages; numbers where absent.
    pub names: Vec<String>,
    /// The dataset's own box of the head; used with fewer than two masks.
    pub focus: Option<Aabb>,
    /// Up in the world, a unit vector: the scene is turned to have it as the nearest axis, so that the box ends level.
    pub up: Option<Vec3>,
}

impl Default for SceneOptions {
    fn default() -> SceneOptions {
        SceneOptions { resolution: 128, names: Vec::new(), focus: None, up: None }
    }
}

/// Returns the scene: the box, and with masks the hull; warnings name suspicious views.
///
/// `masks[i]` belongs to `cameras[i]`; a view without one does not carve. Masks may have another size than
/// their camera. Empty and all-white masks are left out with a warning.
///
/// ```
/// use tiface::capture::scene::{self, SceneOptions};
/// use tiface::capture::synthetic::{SyntheticHead, SyntheticOptions, cameras};
///
/// // without masks: where the cameras look
/// let cameras: Vec<_> = cameras(&SyntheticOptions::default()).into_iter().map(|(camera, _)| camera).collect();
/// let (scene, warnings) = scene::fit(&cameras, &vec![None; cameras.len()], &SceneOptions::default())?;
/// assert!(warnings.is_empty() && scene.hull.is_none());
/// let (found, head) = (scene::world_box(&scene), SyntheticHead.bounds());
/// assert!(found.contains(head.min) && found.contains(head.max));
/// # Ok::<(), tiface::Error>(())
/// ```
pub fn fit(
    cameras: &[Camera],
    masks: &[Option<Gray>],
    options: &SceneOptions,
) -> Result<(Scene, Vec<String>)> {
    if let Some(upright) = options.up.and_then(upright) {
        let turned: Vec<Camera> = cameras.iter().map(|c| c.transformed(&upright)).collect();
        let (mut scene, warnings) = fit_axes(&turned, masks, options)?;
        if scene.hull.is_some() {
            scene.scene_from_world = scene.scene_from_world.after(&upright);
            return Ok((scene, warnings));
        }
    }
    fit_axes(cameras, masks, options)
}

/// Returns the rotation that takes a direction to the nearest axis; `None` for an axis.
fn upright(up: Vec3) -> Option<Similarity> {
    let up = up.as_dvec3().try_normalize()?;
    let axis = up.abs().max_position();
    let mut nearest = DVec3::ZERO;
    nearest[axis] = up[axis].signum();
    let rotation = DMat3::from_quat(DQuat::from_rotation_arc(up, nearest));
    (up.distance(nearest) > 1e-6).then_some(Similarity { rotation, ..Similarity::IDENTITY })
}

/// Returns the scene with the axes of the cameras' world.
fn fit_axes(
    cameras: &[Camera],
    masks: &[Option<Gray>],
    options: &SceneOptions,
) -> Result<(Scene, Vec<String>)> {
    if cameras.len() != masks.len() {
        let message = format!("there are {} cameras but {} masks", cameras.len(), masks.len());
        return Err(Error::cannot(message, "give one mask, or none, per camera"));
    }
    if cameras.len() < 2 {
        let message = format!("{} cameras cannot place a head, two are needed at least", cameras.len());
        return Err(Error::cannot(message, "photograph the head from more sides"));
    }
    let mut warnings = Vec::new();
    let used = locating_views(masks, options, &mut warnings)?;
    if used.len() < 2 {
        // a single silhouette gives no bound in depth
        let scene = from_frusta(cameras, options.focus)?;
        return Ok((scene, warnings));
    }
    let aims: Vec<_> = used.iter().map(|&i| carve::ray_to(&cameras[i], masks[i].as_ref())).collect();
    let some: Vec<&Camera> = used.iter().map(|&i| &cameras[i]).collect();
    let center = aim(&some, &aims)?;
    let silhouettes: Vec<SilhouetteTable> = used
        .iter()
        .filter_map(|&i| Some(SilhouetteTable::new(i, &cameras[i], masks[i].as_ref()?, THRESHOLD)))
        .collect();
    let cube = Cube { center, half: first_half(&some, center), n: 64.min(options.resolution) };
    let head = carve_tightly(cube, &silhouettes, options, &mut warnings)?;
    warnings.extend(head.contradictions(&silhouettes, options));
    Ok((head.scene(), warnings))
}

impl SceneOptions {
    /// Returns the name of view `i` for messages.
    fn name(&self, i: usize) -> String {
        self.names.get(i).cloned().unwrap_or_else(|| i.to_string())
    }
}

/// Returns the views whose masks are neither empty nor white everywhere, and warns of the others.
///
/// # Errors
///
/// Fails if there are masks but none of them locates the head.
fn locating_views(
    masks: &[Option<Gray>],
    options: &SceneOptions,
    warnings: &mut Vec<String>,
) -> Result<Vec<usize>> {
    let (mut white, mut empty, mut used) = (Vec::new(), Vec::new(), Vec::new());
    for (i, mask) in masks.iter().enumerate() {
        let Some(mask) = mask else { continue };
        if mask.values.iter().all(|&v| v <= THRESHOLD) {
            empty.push(options.name(i));
        } else if mask.values.iter().all(|&v| v > THRESHOLD) {
            white.push(options.name(i));
        } else {
            used.push(i);
        }
    }
    if used.is_empty() && !white.is_empty() {
        let n = white.len();
        return Err(Error::cannot(
            format_args!("all {n} masks are white everywhere, so they do not locate the head"),
            "make head masks: `tiface mask CAPTURE --page`; or continue without: `--set mask.source=none`",
        ));
    }
    if used.is_empty() && !empty.is_empty() {
        let message = format!("all {} masks are empty", empty.len());
        return Err(Error::cannot(message, "white must keep the head: were the masks saved as 0 and 1?"));
    }
    for (views, what) in [(empty, "empty"), (white, "white everywhere")] {
        if !views.is_empty() {
            let (n, named) = (counted(views.len(), "view"), few(views.iter().map(String::as_str)));
            warnings.push(format!("in {n} the mask is {what} and does not place the head: {named}"));
        }
    }
    Ok(used)
}

/// The carved head in a cube that it fills, but for the margin.
struct CarvedHead {
    cube: Cube,
    /// First and last cell of the box on each axis.
    extent: [(usize, usize); 3],
    /// Cells that enough masks touch for the hull, in the box and outside it.
    kept: Vec<bool>,
    /// Cells of the coarse cube, which contains everything, that each view alone removes.
    alone: Vec<u64>,
    /// Cells of the coarse cube that all views keep.
    total: u64,
}

/// Carves a cube, grows it if it cuts the head, and shrinks it to the remaining cells until it no
/// longer shrinks.
fn carve_tightly(
    mut cube: Cube,
    silhouettes: &[SilhouetteTable],
    options: &SceneOptions,
    warnings: &mut Vec<String>,
) -> Result<CarvedHead> {
    let least = MIN_VIEWS.min(silhouettes.len());
    let core = silhouettes.len().div_ceil(3).max(least);
    let (mut grown, mut shrunk) = (0, 0);
    let (mut alone, mut coarse_total) = (Vec::new(), 0);
    loop {
        let carved = carve::carve(&cube, silhouettes);
        let mut kept = carved.touching(core);
        let dropped = carve::drop_dust(&mut kept, cube.n, 0.02);
        let total = kept.iter().filter(|k| **k).count() as u64;
        if shrunk == 0 {
            (alone, coarse_total) = (carved.alone.clone(), total);
        }
        let Some(extent) = carve::extent(&kept, cube.n) else {
            return Err(no_common_point(silhouettes, &alone, options));
        };
        let (first, last) = (cube.n == options.resolution, shrunk == 4);
        let cut = extent.iter().any(|&(lo, hi)| lo == 0 || hi == cube.n - 1);
        if cut && shrunk == 0 && grown < 2 {
            cube.half *= 1.6;
            grown += 1;
            continue;
        }
        if cut && shrunk == 0 {
            warnings.push("the cameras hardly bound the head in depth, so the box was cut off".into());
        }
        let tight = around_cells(&cube, &extent, options.resolution);
        if first && (tight.half > 0.93 * cube.half || last) {
            if dropped as u64 * 20 > total {
                let share = 100.0 * dropped as f64 / total as f64;
                warnings.push(format!("pieces apart from the head, {share:.0} % of its size, were left out"));
            }
            return Ok(CarvedHead { cube, extent, kept: carved.touching(least), alone, total: coarse_total });
        }
        cube = tight;
        shrunk += 1;
    }
}

/// Returns the error for masks that keep no cell together; `alone` counts the cells that each view
/// alone removes.
fn no_common_point(silhouettes: &[SilhouetteTable], alone: &[u64], options: &SceneOptions) -> Error {
    let most = (0..silhouettes.len()).max_by_key(|&i| alone[i]);
    let culprit = most.filter(|&i| alone[i] > 0).map_or(String::new(), |i| {
        let name = options.name(silhouettes[i].view);
        format!("; the mask of view `{name}` contradicts the others most")
    });
    Error::cannot(
        format_args!("no point in space is inside all {} masks{culprit}", silhouettes.len()),
        "look at that view's mask and pose; are masks inverted, or poses of another capture?",
    )
}

/// Returns the cube of `resolution` cells a side around cells of another, with the margin.
fn around_cells(cube: &Cube, extent: &[(usize, usize); 3], resolution: usize) -> Cube {
    let lo = DVec3::from(extent.map(|(lo, _)| lo as f64));
    let hi = DVec3::from(extent.map(|(_, hi)| hi as f64 + 1.0));
    let center = cube.center - cube.half + 0.5 * (lo + hi) * cube.cell();
    let cells = (hi - lo).max_element();
    // the margin is counted in cells of the next cube, of which `resolution` make its side
    let share = 1.0 - 2.0 * MARGIN_CELLS as f64 / resolution as f64;
    Cube { center, half: 0.5 * cells * cube.cell() / share.max(0.5), n: resolution }
}

impl CarvedHead {
    /// Returns a warning for each view whose mask removes much more space than the others' do.
    fn contradictions(&self, silhouettes: &[SilhouetteTable], options: &SceneOptions) -> Vec<String> {
        let mut sorted = self.alone.clone();
        sorted.sort_unstable();
        let median = sorted[sorted.len() / 2];
        let total = self.total;
        // with few views each one rightly removes a lot; a wrong one stands out from the others too
        let stands_out = |count: u64| 4 * count > total && count > 4 * median;
        let suspects = silhouettes.iter().zip(&self.alone).filter(|(_, count)| stands_out(**count));
        let warning = |(s, &count): (&SilhouetteTable, &u64)| {
            format!(
                "the mask of view `{}` alone removes {:.0} % as much space as all masks together keep; look at \
                 its mask and pose",
                options.name(s.view),
                100.0 * count as f64 / total as f64
            )
        };
        suspects.map(warning).collect()
    }

    /// Returns the scene of the cube; its hull ends with the box and the margin.
    fn scene(self) -> Scene {
        let CarvedHead { cube, extent, mut kept, .. } = self;
        for (i, cell) in kept.iter_mut().enumerate() {
            let at = [i / (cube.n * cube.n), i / cube.n % cube.n, i % cube.n];
            *cell &= at
                .iter()
                .zip(&extent)
                .all(|(&v, &(lo, hi))| v + MARGIN_CELLS >= lo && v <= hi + MARGIN_CELLS);
        }
        let hull = Hull::new(cube.n, &kept);
        let margin = MARGIN_CELLS as f64;
        let scene_coordinate = |cells: f64| (2.0 * cells / cube.n as f64 - 1.0).clamp(-1.0, 1.0) as f32;
        let aabb = Aabb {
            min: Vec3::from(extent.map(|(lo, _)| scene_coordinate(lo as f64 - margin))),
            max: Vec3::from(extent.map(|(_, hi)| scene_coordinate(hi as f64 + 1.0 + margin))),
        };
        Scene { scene_from_world: scene_from(cube.center, cube.half), aabb, hull: Some(hull) }
    }
}

fn scene_from(center: DVec3, half: f64) -> Similarity {
    Similarity::scale_translate(1.0 / half, -center / half)
}

/// Returns the point where the rays meet, or an error if they do not.
fn aim(cameras: &[&Camera], rays: &[(DVec3, DVec3)]) -> Result<DVec3> {
    let n = cameras.len();
    let alike = |how: &str| {
        Error::cannot(
            format_args!("all {n} cameras {how}, so the distance of the head is unknown"),
            "check that each frame has its own pose; cameras must look from different sides",
        )
    };
    let mean = cameras.iter().map(|c| c.position).sum::<DVec3>() / n as f64;
    let spread = cameras.iter().map(|c| c.position.distance(mean)).fold(0.0, f64::max);
    if spread <= 1e-9 * (1.0 + mean.length()) {
        return Err(alike("stand at one place"));
    }
    let center = carve::meeting_point(rays).ok_or_else(|| alike("look in one direction"))?;
    let distance = cameras.iter().map(|c| c.position.distance(center)).fold(0.0, f64::max);
    if spread < 1e-4 * distance {
        return Err(alike("stand at one place"));
    }
    let seen = cameras.iter().filter(|c| Projector::new(c).sees(center)).count();
    if seen < n.min(3) {
        return Err(head_outside(seen, n));
    }
    Ok(center)
}

fn head_outside(seen: usize, cameras: usize) -> Error {
    Error::cannot(
        format_args!("the point all views aim at is inside the frame of only {seen} of {cameras} cameras"),
        "check the axis convention of the poses: cameras must look along their -Z axis (OpenGL)",
    )
}

/// Returns half the side of a cube around `center` that covers every frame, and does not reach the cameras.
fn first_half(cameras: &[&Camera], center: DVec3) -> f64 {
    let wide = cameras.iter().map(|c| {
        let (x, y) = (0.5 * c.width as f64 / c.fx, 0.5 * c.height as f64 / c.fy);
        c.position.distance(center) * x.hypot(y)
    });
    let nearest = cameras.iter().map(|c| c.position.distance(center)).fold(f64::INFINITY, f64::min);
    (1.2 * wide.fold(0.0, f64::max)).min(0.95 * nearest)
}

/// Minimum number of points for a box around them.
const MIN_POINTS: usize = 100;

/// Returns the box of the points that the cameras see, without one percent on each side, enlarged by a twentieth; `None`
/// for too few points.
pub(super) fn around_points(views: &[View], points: &[DVec3]) -> Option<Aabb> {
    if points.len() < MIN_POINTS {
        return None;
    }
    let cameras: Vec<Camera> = views.iter().map(|v| v.camera.clone()).collect();
    let seen = world_box(&from_frusta(&cameras, None).ok()?);
    let within: Vec<Vec3> = points.iter().map(|p| p.as_vec3()).filter(|p| seen.contains(*p)).collect();
    if within.len() < MIN_POINTS {
        return None;
    }
    let [x, y, z] = [0, 1, 2].map(|k| {
        let mut along: Vec<f32> = within.iter().map(|p| p[k]).collect();
        along.sort_by(f32::total_cmp);
        (along[along.len() / 100], along[along.len() - 1 - along.len() / 100])
    });
    let (min, max) = (Vec3::new(x.0, y.0, z.0), Vec3::new(x.1, y.1, z.1));
    let more = 0.05 * (max - min);
    Some(Aabb { min: (min - more).max(seen.min), max: (max + more).min(seen.max) })
}

/// Returns the scene of a box in the world, without a hull; `None` for a flat box.
fn from_box(b: Aabb) -> Option<Scene> {
    let (size, middle) = (b.size().as_dvec3(), b.center().as_dvec3());
    let half = 0.5 * size.max_element();
    if !(half.is_finite() && size.min_element() > 1e-3 * half) {
        return None;
    }
    let reach = (0.5 * size / half).as_vec3();
    let aabb = Aabb { min: -reach, max: reach };
    Some(Scene { scene_from_world: scene_from(middle, half), aabb, hull: None })
}

/// Returns the scene without masks, as described in the module documentation.
fn from_frusta(cameras: &[Camera], focus: Option<Aabb>) -> Result<Scene> {
    if let Some(scene) = focus.and_then(from_box) {
        return Ok(scene);
    }
    let some: Vec<&Camera> = cameras.iter().collect();
    let axes: Vec<_> = cameras.iter().map(|c| carve::ray_to(c, None)).collect();
    let center = aim(&some, &axes)?;
    let mut distances: Vec<f64> = cameras.iter().map(|c| c.position.distance(center)).collect();
    distances.sort_by(f64::total_cmp);
    let half = 0.6 * distances[distances.len() / 2];
    let cube = Cube { center, half, n: 48 };
    let projectors: Vec<Projector> = cameras.iter().map(Projector::new).collect();
    let least = (2 * cameras.len()).div_ceil(5).max(2);
    let mut kept = vec![false; cube.n.pow(3)];
    for (i, cell) in kept.iter_mut().enumerate() {
        let p = cube.cell_center(i / (cube.n * cube.n), i / cube.n % cube.n, i % cube.n);
        *cell = p.distance(center) <= half && projectors.iter().filter(|c| c.sees(p)).count() >= least;
    }
    carve::drop_dust(&mut kept, cube.n, 1.0);
    let Some(extent) = carve::extent(&kept, cube.n) else {
        let seen = projectors.iter().filter(|c| c.sees(center)).count();
        return Err(head_outside(seen, cameras.len()));
    };
    let lo = DVec3::from(extent.map(|(lo, _)| lo as f64));
    let hi = DVec3::from(extent.map(|(_, hi)| hi as f64 + 1.0));
    let middle = center - half + 0.5 * (lo + hi) * cube.cell();
    let size = (hi - lo) * cube.cell();
    let half = 0.5 * size.max_element();
    let reach = (0.5 * size / half).as_vec3();
    Ok(Scene {
        scene_from_world: scene_from(middle, half),
        aabb: Aabb { min: -reach, max: reach },
        hull: None,
    })
}

/// Plausible heights of a head, metres: with or without neck and shoulders, of a child or an adult.
const HEIGHTS_M: std::ops::RangeInclusive<f64> = 0.15..=0.6;

/// Returns the height of the hull along `up`, in dataset units; `None` without a hull, because the end of the head is then
/// unknown.
pub fn height(scene: &Scene, up: Vec3) -> Option<f64> {
    let hull = scene.hull.as_ref()?;
    let r = hull.resolution;
    let cells = (0..r.pow(3)).filter(|&i| hull.get(i));
    let up = scene.scene_from_world.direction(up);
    let along = cells.map(|i| Vec3::new((i / (r * r)) as f32, (i / r % r) as f32, (i % r) as f32).dot(up));
    let (low, high) = along.fold((f32::MAX, f32::MIN), |(low, high), v| (low.min(v), high.max(v)));
    let cell = 2.0 / (r as f64 * scene.scene_from_world.scale);
    (low <= high).then(|| f64::from(high - low + 1.0) * cell)
}

/// Returns a warning if the height is implausible for a head, probably because `capture.unit_m` is wrong.
pub fn doubtful_height(height: f64, unit_m: f64) -> Option<String> {
    let height_m = height * unit_m;
    (!HEIGHTS_M.contains(&height_m)).then(|| {
        format!(
            "the head is {height:.3} units high: {height_m:.3} m if a unit of the dataset is {unit_m} m, and a head is {} to \
             {} m high. Give the unit's length in metres, `--set capture.unit_m=METRES` (with {:.3} this head is 0.3 m high), \
             or the height that exported meshes should have, `--set mesh.height_m=METRES`",
            HEIGHTS_M.start(),
            HEIGHTS_M.end(),
            0.3 / height
        )
    })
}

/// Returns the box in world coordinates, or one around it where the scene is turned.
pub fn world_box(scene: &Scene) -> Aabb {
    let world_from_scene = scene.scene_from_world.inverse();
    let corner = |i: usize| Vec3::from([0, 1, 2].map(|k| [scene.aabb.min, scene.aabb.max][i >> k & 1][k]));
    let corners = (0..8).map(|i| world_from_scene.point(corner(i)));
    let none = Aabb { min: Vec3::INFINITY, max: Vec3::NEG_INFINITY };
    corners.fold(none, |b, p| Aabb { min: b.min.min(p), max: b.max.max(p) })
}

/// Returns a line that describes a scene: its box in world units and the share of it that the hull fills.
pub fn describe(scene: &Scene) -> String {
    let b = world_box(scene);
    let size = b.size();
    let hull = scene.hull.as_ref().map_or("no hull, no masks".into(), |h| {
        format!("hull fills {:.1} % of the cube", 100.0 * h.count() as f64 / h.resolution.pow(3) as f64)
    });
    format!(
        "[{:.4}, {:.4}, {:.4}] .. [{:.4}, {:.4}, {:.4}], {:.4} × {:.4} × {:.4} units; {hull}",
        b.min.x, b.min.y, b.min.z, b.max.x, b.max.y, b.max.z, size.x, size.y, size.z
    )
}

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
/// `found` locates the head by cameras and masks, and is not called for a given box, which has no hull.
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

/// Returns the part of the scene's box, in scene coordinates, whose outermost slabs of hull cells are, in the
/// median, inside the frames of a `share` of the cameras, 0..=1 (three at least). `cameras` are in the world;
/// only the face that looks most downward moves (`up` is a world direction): frames cut heads below, and a body
/// whose shoulders end in walls left and right looks like a box.
///
/// Without a hull, and where every slab is seen, the whole box.
pub fn well_seen(scene: &Scene, cameras: &[Camera], up: Vec3, share: f64) -> Aabb {
    let Some(hull) = &scene.hull else { return scene.aabb };
    let least = ((share * cameras.len() as f64).ceil() as usize).max(3).min(cameras.len());
    let projectors: Vec<Projector> = cameras.iter().map(Projector::new).collect();
    let world_from_scene = scene.scene_from_world.inverse();
    let r = hull.resolution;
    let cell = 2.0 / r as f64;
    let middle = |i: usize| (i as f64 + 0.5) * cell - 1.0;
    // how many cameras see each cell of a slab across an axis; the median decides
    let seen_enough = |axis: usize, slab: usize| -> Option<bool> {
        let mut seen: Vec<usize> = Vec::new();
        for a in 0..r {
            for b in 0..r {
                let mut c = [a, b, slab];
                c.rotate_left(2 - axis); // the slab's index goes to its axis, (a, b) to the others in turn
                if hull.get((c[0] * r + c[1]) * r + c[2]) {
                    let p = world_from_scene.point_f64(DVec3::from_array(c.map(middle)));
                    seen.push(projectors.iter().filter(|q| q.sees(p)).count());
                }
            }
        }
        if seen.is_empty() {
            return None;
        }
        let half = seen.len() / 2;
        Some(*seen.select_nth_unstable(half).1 >= least)
    };
    let mut low = scene.aabb.min;
    let mut high = scene.aabb.max;
    let up = scene.scene_from_world.direction(up);
    let axis = up.abs().max_position();
    let good: Vec<usize> = (0..r).filter(|&s| seen_enough(axis, s) == Some(true)).collect();
    let poor: Vec<usize> = (0..r).filter(|&s| seen_enough(axis, s) == Some(false)).collect();
    let (Some(&first), Some(&last)) = (good.first(), good.last()) else { return scene.aabb };
    // it moves only where a poorly seen slab lies beyond the last good one
    let below = poor.iter().filter(|&&s| s < first).max();
    let above = poor.iter().filter(|&&s| s > last).min();
    match (up[axis] > 0.0, below, above) {
        (true, Some(&edge), _) => low[axis] = low[axis].max(((edge + 1) as f64 * cell - 1.0) as f32),
        (false, _, Some(&edge)) => high[axis] = high[axis].min((edge as f64 * cell - 1.0) as f32),
        _ => {}
    }
    Aabb { min: low, max: high.max(low + Vec3::splat(cell as f32)) }
}

#[cfg(test)]
mod tests {
    use super::super::synthetic;
    use super::*;
    use crate::config::{Preset, VmConfig};
    use crate::geom::{Distortion, Similarity};
    use crate::kernel::cpu::vm::{samples_across, size_for, step_size};

    /// Returns a camera at `position` looking at `target`, 60 × 60 pixels, focal length 80.
    fn camera(position: DVec3, target: DVec3) -> Camera {
        let back = (position - target).normalize();
        let right = DVec3::Z.cross(back).normalize();
        Camera {
            width: 60,
            height: 60,
            fx: 80.0,
            fy: 80.0,
            cx: 30.0,
            cy: 30.0,
            distortion: Default::default(),
            rotation: DMat3::from_cols(right, back.cross(right), back),
            position,
        }
    }

    const CENTER: DVec3 = DVec3::new(10.0, -5.0, 2.0);
    const RADIUS: f64 = 0.4;

    /// `n` cameras on a ring of radius 2 around [`CENTER`], alternately above and below.
    fn ring(n: usize) -> Vec<Camera> {
        (0..n)
            .map(|i| {
                let a = i as f64 / n as f64 * std::f64::consts::TAU;
                let up = if i % 2 == 0 { 0.8 } else { -0.5 };
                camera(CENTER + DVec3::new(2.0 * a.cos(), 2.0 * a.sin(), up), CENTER)
            })
            .collect()
    }

    /// Returns the silhouette of the ball of [`RADIUS`] around [`CENTER`].
    fn ball(camera: &Camera) -> Option<Gray> {
        let values = (0..3600)
            .map(|i| {
                let pixel = glam::Vec2::new((i % 60) as f32 + 0.5, (i / 60) as f32 + 0.5);
                let ray = camera.ray(pixel).unwrap();
                let to = CENTER - camera.position;
                let along = to.dot(ray.direction.as_dvec3());
                if to.length_squared() - along * along < RADIUS * RADIUS { 255 } else { 0 }
            })
            .collect();
        Some(Gray { width: 60, height: 60, values })
    }

    fn small() -> SceneOptions {
        SceneOptions { resolution: 64, ..SceneOptions::default() }
    }

    #[test]
    fn points_draw_the_box_tighter_and_a_flat_box_is_no_scene() {
        let options = synthetic::SyntheticOptions::default();
        let cameras: Vec<Camera> =
            synthetic::cameras(&options).into_iter().map(|(camera, _)| camera).collect();
        let view = |camera: &Camera| View {
            name: String::new(),
            camera: camera.clone(),
            split: super::super::view::Split::Train,
            photo: Default::default(),
            mask: super::super::view::ViewMask::None,
            mask_meaning: crate::config::MaskMeaning::Empty,
            mask_reading: Default::default(),
            side_turn: None,
            valid: None,
            region: None,
            downscale: 1,
            photo_size: (1, 1),
            declared: (1, 1),
            declared_by: String::new(),
            turn: None,
            mask_turn: None,
            exposure: None,
        };
        let views: Vec<View> = cameras.iter().map(view).collect();
        let mut points: Vec<DVec3> =
            synthetic::SyntheticHead.surface_points(2000, 3).iter().map(|p| p.as_dvec3()).collect();
        points.push(DVec3::splat(500.0)); // what else is in the pictures
        points.push(DVec3::splat(f64::NAN));
        let found = around_points(&views, &points).unwrap();
        let truth = synthetic::SyntheticHead.bounds();
        let off = (found.min - truth.min).abs().max((found.max - truth.max).abs());
        assert!(off.max_element() < 0.1 * truth.size().max_element(), "{found:?} {truth:?}");
        assert_eq!(around_points(&views, &points[..99]), None);
        let options = SceneOptions { focus: Some(found), ..SceneOptions::default() };
        let (scene, _) = fit(&cameras, &vec![None; cameras.len()], &options).unwrap();
        assert!((world_box(&scene).min - found.min).abs().max_element() < 1e-3);
        assert!(from_box(Aabb { min: Vec3::ZERO, max: Vec3::new(1.0, 1.0, 0.0) }).is_none());
    }

    #[test]
    fn the_hull_of_a_ball_holds_the_ball_and_little_more() {
        let cameras = ring(12);
        let masks: Vec<_> = cameras.iter().map(ball).collect();
        let (scene, warnings) = fit(&cameras, &masks, &small()).unwrap();
        assert!(warnings.is_empty(), "{warnings:?}");
        let hull = scene.hull.as_ref().unwrap();
        let mut inside = 0;
        for i in 0..2000 {
            // points of a spiral on the sphere
            let z = 1.0 - 2.0 * (i as f64 + 0.5) / 2000.0;
            let (r, a) = ((1.0 - z * z).sqrt(), i as f64 * 2.399_963);
            let p = CENTER + 0.99 * RADIUS * DVec3::new(r * a.cos(), r * a.sin(), z);
            inside += hull.contains(scene.scene_from_world.point(p.as_vec3())) as usize;
        }
        assert_eq!(inside, 2000);
        let size = world_box(&scene).size();
        // the ball is 0.8 wide; pixel footprints, cells and two cells of margin may add a fifth
        assert!(size.max_element() < 1.05 && size.min_element() > 0.8, "{size}");
        let longest = scene.aabb.size().max_element();
        assert!(longest > 1.8 && longest <= 2.0, "{longest}");
    }

    #[test]
    fn a_ball_is_as_high_as_it_is_wide_and_one_of_six_metres_is_doubted() {
        let cameras = ring(12);
        let masks: Vec<_> = cameras.iter().map(ball).collect();
        let (scene, _) = fit(&cameras, &masks, &small()).unwrap();
        for up in [Vec3::Z, Vec3::X, Vec3::new(0.6, 0.0, 0.8)] {
            let height = height(&scene, up).unwrap();
            assert!(height > 2.0 * RADIUS && height < 2.4 * RADIUS, "{up}: {height}");
        }
        assert_eq!((doubtful_height(0.8, 0.4), doubtful_height(0.8, 0.5)), (None, None));
        let text = doubtful_height(6.0, 1.0).unwrap();
        assert!(
            text.contains("6.000 units high: 6.000 m") && text.contains("with 0.050 this head is 0.3 m"),
            "{text}"
        );
        assert!(doubtful_height(0.3, 0.001).is_some());
        let (bare, _) = fit(&cameras, &[const { None }; 12], &small()).unwrap();
        assert_eq!(super::height(&bare, Vec3::Z), None);
    }

    #[test]
    fn a_moved_world_moves_the_box_with_it() {
        let cameras = ring(8);
        let masks: Vec<_> = cameras.iter().map(ball).collect();
        let shift = DVec3::new(-30.0, 4.0, 100.0);
        let moved: Vec<_> =
            cameras.iter().map(|c| Camera { position: c.position + shift, ..c.clone() }).collect();
        let (a, _) = fit(&cameras, &masks, &small()).unwrap();
        let (b, _) = fit(&moved, &masks, &small()).unwrap();
        assert!((world_box(&b).center() - world_box(&a).center() - shift.as_vec3()).length() < 0.03);
    }

    #[test]
    fn a_turned_world_has_the_scene_of_the_upright_one() {
        let cameras = ring(12);
        let masks: Vec<_> = cameras.iter().map(ball).collect();
        let fitted = |cameras: &[Camera], up: Vec3| {
            fit(cameras, &masks, &SceneOptions { up: Some(up), ..small() }).unwrap().0
        };
        let level = fitted(&cameras, Vec3::Z);
        assert_eq!(level.scene_from_world.rotation, DMat3::IDENTITY);
        let rotation = DMat3::from_rotation_x(0.5) * DMat3::from_rotation_y(-0.3);
        let world = Similarity { rotation, ..Similarity::IDENTITY };
        let moved: Vec<Camera> = cameras.iter().map(|c| c.transformed(&world)).collect();
        let up = world.direction(Vec3::Z);
        let turned = fitted(&moved, up);
        assert!((turned.scene_from_world.direction(up) - Vec3::Z).length() < 1e-6);
        assert!((turned.aabb.size() - level.aabb.size()).abs().max_element() < 0.1);
        // one lies where the other does, and the box in the world's axes is around it
        let center = |scene: &Scene| scene.scene_from_world.inverse().point(scene.aabb.center());
        assert!(world.point(center(&level)).distance(center(&turned)) < 0.03);
        assert!((height(&turned, up).unwrap() - height(&level, Vec3::Z).unwrap()).abs() < 0.04);
        assert!(world_box(&turned).size().min_element() > 2.0 * RADIUS as f32);
        // without masks the scene has the axes of the world
        let options = SceneOptions { up: Some(up), ..small() };
        let (bare, _) = fit(&moved, &[const { None }; 12], &options).unwrap();
        assert_eq!(bare.scene_from_world.rotation, DMat3::IDENTITY);
    }

    #[test]
    fn cameras_that_are_all_alike_are_an_error() {
        let one = ring(1)[0].clone();
        let cameras = vec![one.clone(); 5];
        let error = fit(&cameras, &vec![None; 5], &small()).unwrap_err();
        assert!(error.to_string().contains("all 5 cameras stand at one place"), "{error}");
        let side = one.rotation.x_axis;
        let beside = vec![one.clone(), Camera { position: one.position + side, ..one }];
        let error = fit(&beside, &[None, None], &small()).unwrap_err();
        assert!(error.to_string().contains("all 2 cameras look in one direction"), "{error}");
    }

    #[test]
    fn cameras_that_look_away_are_an_error() {
        let cameras: Vec<_> =
            ring(6).into_iter().map(|c| camera(c.position, c.position + (c.position - CENTER))).collect();
        let error = fit(&cameras, &vec![None; 6], &small()).unwrap_err();
        assert!(error.to_string().contains("only 0 of 6 cameras"), "{error}");
    }

    #[test]
    fn white_empty_and_contradicting_masks_are_named_errors() {
        let cameras = ring(6);
        let flat = |v: u8| vec![Some(Gray { width: 60, height: 60, values: vec![v; 3600] }); 6];
        let message = |masks: &[Option<Gray>]| fit(&cameras, masks, &small()).unwrap_err().to_string();
        assert!(message(&flat(255)).starts_with("all 6 masks are white everywhere"));
        assert_eq!(message(&flat(0)), "all 6 masks are empty");
        let mut masks: Vec<_> = cameras.iter().map(ball).collect();
        let mut corner = vec![0; 3600];
        corner[..5].fill(255);
        masks[2] = Some(Gray { width: 60, height: 60, values: corner });
        let options = SceneOptions { names: (0..6).map(|i| format!("cam{i}")).collect(), ..small() };
        let error = fit(&cameras, &masks, &options).unwrap_err();
        assert!(error.to_string().contains("inside all 6 masks; the mask of view `cam2`"), "{error}");
    }

    #[test]
    fn an_empty_and_a_halved_mask_are_named_in_warnings() {
        let cameras = ring(12);
        let mut masks: Vec<_> = cameras.iter().map(ball).collect();
        masks[3] = Some(Gray { width: 60, height: 60, values: vec![0; 3600] });
        let half = masks[7].as_mut().unwrap();
        for (i, v) in half.values.iter_mut().enumerate() {
            *v *= (i % 60 < 30) as u8;
        }
        let (_, warnings) = fit(&cameras, &masks, &small()).unwrap();
        assert!(
            warnings.iter().any(|w| w.contains("in 1 view the mask is empty") && w.contains("`3`")),
            "{warnings:?}"
        );
        assert!(warnings.iter().any(|w| w.contains("view `7` alone removes")), "{warnings:?}");
        assert_eq!(warnings.len(), 2, "{warnings:?}");
    }

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
        // T-Face's own numbers: 25 per unit, entry between 3.5 and 7, 141 × 157 × 94 vertices, 459 samples
        let bounds = [scene.aabb.min.to_array(), scene.aabb.max.to_array()];
        let c = VmConfig::preset(Preset::Paper).placed(bounds);
        assert!((c.distance_scale - 25.0).abs() < 1e-5 && (c.alpha_unit - 1.0).abs() < 1e-6, "{c:?}");
        assert_eq!((c.near, c.far), (3.5, 7.0));
        // 83.3 per dataset unit
        assert!((c.distance_scale * scene.scene_from_world.scale - 83.333).abs() < 1e-2);
        let extent = scene.aabb.size().to_array();
        let size = size_for(extent, c.voxels_start);
        assert_eq!(size, [141, 157, 94]);
        let step = step_size(extent, size, c.step_ratio as f32);
        assert_eq!(samples_across(extent, step), 459);
    }

    #[test]
    fn another_box_has_the_same_optics_for_its_size_and_no_near_nor_far() {
        let (scene, warnings) = in_box(found(3.0, 0.3), SceneBox::Ilsh).unwrap();
        assert!(warnings[0].contains("its own box is taken"), "{warnings:?}");
        let bounds = [scene.aabb.min.to_array(), scene.aabb.max.to_array()];
        let c = VmConfig::preset(Preset::Paper).placed(bounds);
        // 25 · 1.67 / 1: as thick across the box as in the published one
        assert!((c.distance_scale - 41.75).abs() < 1e-9 && c.near == 0.0, "{c:?}");
        // alpha of a step: 1 − exp(−σ step), the step in units of 1 / 1.67
        assert!((c.alpha_unit * 1.67 - 1.0).abs() < 1e-9);
        assert_eq!(in_box(found(0.0, 3.0), SceneBox::Ilsh).unwrap().1.len(), 1);
        // and the others' constants are of the scene, whatever the box
        let c = VmConfig::preset(Preset::Draft).placed(bounds);
        assert_eq!((c.distance_scale, c.alpha_unit, c.near, c.far), (100.0, 1.0, 0.0, 1e6));
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

    /// Eight cameras around the y axis at distance 4, looking at the middle from `height` above.
    fn cameras(height: f64) -> Vec<Camera> {
        (0..8)
            .map(|i| {
                let turn = DMat3::from_rotation_y(i as f64 * std::f64::consts::TAU / 8.0);
                Camera {
                    width: 100,
                    height: 100,
                    fx: 200.0,
                    fy: 200.0,
                    cx: 50.0,
                    cy: 50.0,
                    distortion: Distortion::default(),
                    rotation: turn,
                    position: turn * DVec3::new(0.0, height, 4.0),
                }
            })
            .collect()
    }

    fn scene() -> Scene {
        let bits = vec![u64::MAX; 16 * 16 * 16 / 64];
        Scene {
            scene_from_world: Similarity::IDENTITY,
            aabb: Aabb::SCENE,
            hull: Some(Hull { resolution: 16, bits }),
        }
    }

    #[test]
    fn what_every_frame_holds_is_kept_whole() {
        // half the frame at distance 3, the nearest: 50 / 200 · 3 = 0.75; at 4: 1.0; median cells are in
        let wide: Vec<Camera> =
            cameras(0.0).into_iter().map(|c| Camera { fx: 80.0, fy: 80.0, ..c }).collect();
        assert_eq!(well_seen(&scene(), &wide, Vec3::Y, 1.0 / 3.0), Aabb::SCENE);
    }

    #[test]
    fn a_body_that_the_frames_cut_below_ends_where_they_end() {
        // one unit up: the frame reaches from about 0 to 2 on the axis, so the lower half is not seen
        let part = well_seen(&scene(), &cameras(1.0), Vec3::Y, 1.0 / 3.0);
        assert_eq!((part.max, part.min.x, part.min.z), (Vec3::ONE, -1.0, -1.0));
        assert!(part.min.y > -0.3 && part.min.y < 0.3, "{part:?}");
    }

    #[test]
    fn fewer_cameras_keep_more_of_a_body() {
        // five cameras look one unit higher than the other three, whose frames reach farther down
        let split: Vec<Camera> =
            cameras(1.5).into_iter().take(5).chain(cameras(0.5).into_iter().skip(5)).collect();
        let low = |share: f64| well_seen(&scene(), &split, Vec3::Y, share).min.y;
        // three of eight are the least of either share; more than half are those that look higher
        assert_eq!(low(0.25), low(0.375));
        assert!(low(0.25) + 0.5 < low(0.6), "{} {}", low(0.25), low(0.6));
    }
}
