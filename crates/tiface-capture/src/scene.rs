//! Locates the head: a box from cameras and masks, and with masks its visual hull.
//!
//! With masks: the rays through the masks' centroids meet near the head. A cube around that point,
//! wide enough for every frame, is carved by the silhouettes at a coarse resolution, shrunk to the
//! remaining cells, and carved again until it no longer shrinks. Space outside a frame, beyond a
//! border that the mask touches, is undecided for that view. So two rules define the end of a body
//! that the frames cut:
//!
//! - the *box* is drawn around the cells that touch the masks of a third of the views (three at
//!   least): farther out, too few cameras see the body to reconstruct it;
//! - the *hull* is everything inside that box that touches three masks: the space in which the head
//!   may still be.
//!
//! Without masks, the frames of the cameras and the dataset's points or box decide (`frusta`); a
//! given box, and the published one, override both ([`SceneBox`]).

mod aim;
mod frusta;
mod scene_box;
mod well_seen;

pub(super) use frusta::around_points;
pub use scene_box::{SceneBox, in_box};
pub use well_seen::well_seen;

use super::carve::{self, SilhouetteTable};
use super::masks::few;
use super::projector::Projector;
use aim::ray_to;
use frusta::from_frusta;
use glam::{DMat3, DQuat, DVec3, Vec3};
use serde::{Deserialize, Serialize};
use tiface_base::error::counted;
use tiface_base::geom::{
    Aabb, BitGrid, Camera, CellCube, Similarity, drop_small_components, extent_of_cells, meeting_point,
};
use tiface_base::image::Gray;
use tiface_base::math::rank::median;
use tiface_base::{Error, Result};

/// The head's box and how it sits in the world.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Scene {
    /// The box's longest side fills [-1, 1], to within a tenth. Up is an axis of the scene where
    /// masks locate the head; elsewhere the scene has the axes of the world.
    pub scene_from_world: Similarity,
    /// The tight box in scene coordinates, within [-1, 1]³.
    pub aabb: Aabb,
    /// The visual hull as cells over [-1, 1]³ of the scene, which contains the whole head; `None`
    /// without masks.
    pub hull: Option<BitGrid>,
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
    /// Up in the world, a unit vector: the scene is turned to have it as the nearest axis, so that
    /// the box ends level.
    pub up: Option<Vec3>,
}

impl Default for SceneOptions {
    fn default() -> SceneOptions {
        SceneOptions { resolution: 128, names: Vec::new(), focus: None, up: None }
    }
}

/// Returns the scene: the box, and with masks the hull; warnings name suspicious views.
///
/// `masks[i]` belongs to `cameras[i]`; a view without one does not carve. Masks may have another
/// size than their camera. Empty and all-white masks are left out with a warning.
///
/// ```
/// use tiface_capture::scene::{self, SceneOptions};
/// use tiface_capture::synthetic::{SyntheticHead, SyntheticOptions, cameras};
///
/// // without masks: where the cameras look
/// let cameras = cameras(&SyntheticOptions::default());
/// let cameras: Vec<_> = cameras.into_iter().map(|(camera, _)| camera).collect();
/// let masks = vec![None; cameras.len()];
/// let (scene, warnings) = scene::fit(&cameras, &masks, &SceneOptions::default())?;
/// assert!(warnings.is_empty() && scene.hull.is_none());
/// let (found, head) = (scene::world_box(&scene), SyntheticHead.bounds());
/// assert!(found.contains(head.min) && found.contains(head.max));
/// # Ok::<(), tiface_base::Error>(())
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
    let aims: Vec<_> = used.iter().map(|&i| ray_to(&cameras[i], masks[i].as_ref())).collect();
    let some: Vec<&Camera> = used.iter().map(|&i| &cameras[i]).collect();
    let center = aim(&some, &aims)?;
    let silhouettes: Vec<SilhouetteTable> = used
        .iter()
        .filter_map(|&i| Some(SilhouetteTable::new(i, &cameras[i], masks[i].as_ref()?, THRESHOLD)))
        .collect();
    let cube = CellCube { center, half: first_half(&some, center), n: 64.min(options.resolution) };
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
    cube: CellCube,
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
    mut cube: CellCube,
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
        let dropped = drop_small_components(&mut kept, cube.n, 0.02);
        let total = kept.iter().filter(|k| **k).count() as u64;
        if shrunk == 0 {
            (alone, coarse_total) = (carved.alone.clone(), total);
        }
        let Some(extent) = extent_of_cells(&kept, cube.n) else {
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
fn around_cells(cube: &CellCube, extent: &[(usize, usize); 3], resolution: usize) -> CellCube {
    let lo = DVec3::from(extent.map(|(lo, _)| lo as f64));
    let hi = DVec3::from(extent.map(|(_, hi)| hi as f64 + 1.0));
    let center = cube.center - cube.half + 0.5 * (lo + hi) * cube.cell();
    let cells = (hi - lo).max_element();
    // the margin is counted in cells of the next cube, of which `resolution` make its side
    let share = 1.0 - 2.0 * MARGIN_CELLS as f64 / resolution as f64;
    CellCube { center, half: 0.5 * cells * cube.cell() / share.max(0.5), n: resolution }
}

impl CarvedHead {
    /// Returns a warning for each view whose mask removes much more space than the others' do.
    fn contradictions(&self, silhouettes: &[SilhouetteTable], options: &SceneOptions) -> Vec<String> {
        let median = median(&mut self.alone.clone(), u64::cmp).unwrap_or(0);
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
        let hull = BitGrid::from_cells(cube.n, &kept);
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
    let center = meeting_point(rays).ok_or_else(|| alike("look in one direction"))?;
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

/// Returns half the side of a cube around `center` that covers every frame, and does not reach the
/// cameras.
fn first_half(cameras: &[&Camera], center: DVec3) -> f64 {
    let wide = cameras.iter().map(|c| {
        let (x, y) = (0.5 * c.width as f64 / c.fx, 0.5 * c.height as f64 / c.fy);
        c.position.distance(center) * x.hypot(y)
    });
    let nearest = cameras.iter().map(|c| c.position.distance(center)).fold(f64::INFINITY, f64::min);
    (1.2 * wide.fold(0.0, f64::max)).min(0.95 * nearest)
}

/// Plausible heights of a head, meters: with or without neck and shoulders, of a child or an adult.
const HEIGHTS_M: std::ops::RangeInclusive<f64> = 0.15..=0.6;

/// Returns the height of the hull along `up`, in dataset units; `None` without a hull, because the
/// end of the head is then unknown.
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

/// Returns a warning if the height is implausible for a head, probably because `capture.unit_m` is
/// wrong.
pub fn doubtful_height(height: f64, unit_m: f64) -> Option<String> {
    let height_m = height * unit_m;
    (!HEIGHTS_M.contains(&height_m)).then(|| {
        format!(
            "the head is {height:.3} units high: {height_m:.3} m if a unit of the dataset is {unit_m} m, and a head is {} to \
             {} m high. Give the unit's length in meters, `--set capture.unit_m=METERS` (with {:.3} this head is 0.3 m high), \
             or the height from chin to crown that a file should have, `tiface export --height METERS`",
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

/// Returns a line that describes a scene: its box in world units and the share of it that the hull
/// fills.
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

#[cfg(test)]
mod tests {
    use super::*;

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
    fn a_ball_is_as_high_as_it_is_wide_and_one_of_six_meters_is_doubted() {
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
}
