//! Silhouette consistency: whether the masks of all views fit one body (Laurentini 1994; Boyer
//! 2006).
//!
//! With correct masks, every ray through a masked pixel meets the visual hull: somewhere along it
//! lies a point that no other mask rules out. Where none does, masks contradict each other: either
//! this view shows too much, or each view that rules out the best point of the ray shows too
//! little. One such pixel cannot tell which; all of them together can. The view whose removal
//! settles most of the conflict is named first, and the comparison is repeated without it, until
//! the rest is no more than discretization.
//!
//! Nothing but masks and cameras is needed, so the masks of a capture are checked in the same way.

mod proposals;

pub use proposals::{MaskVerdict, verdicts};

use super::distance::squared_distance;
use super::hull::{self, ViewFrame};
use glam::{DVec3, Vec2};
use rayon::prelude::*;
use tiface_base::Result;
use tiface_base::geom::{Camera, CellCube};
use tiface_base::image::{Gray, resize_hard};

/// Rows that masks are reduced to.
const ROWS: u32 = 160;
/// Cells along each side of the cube.
const CELLS: usize = 128;
/// Half side of the cube, in half heights of the frames at the point where the viewing axes meet.
const CUBE: f64 = 1.6;
/// Margin around a mask, in reduced pixels beyond the footprint of a cell, within which no cell is
/// ruled out.
const SLACK_PX: f32 = 1.0;
/// Conflicts of a view, in whole masks, below which it is never named …
const THRESHOLD: f64 = 0.005;
/// … and from which it always is.
const CERTAIN_THRESHOLD: f64 = 0.05;
/// Between the two, a view is named if its conflict is this many times the mean.
const OUTLIER_RATIO: f64 = 4.0;

/// A view with its mask.
#[derive(Clone, Copy, Debug)]
pub struct ConsistencyView<'a> {
    /// Its name in messages.
    pub name: &'a str,
    /// Its camera.
    pub camera: &'a Camera,
    /// Its mask at any size, head from 128; a view without one takes no part.
    pub mask: Option<&'a Gray>,
}

/// A mask that does not fit the others.
#[derive(Clone, Debug, PartialEq)]
pub struct Conflict {
    /// Which view, counted as given.
    pub view: usize,
    /// Share of its mask, 0..=1, where no point in space is on the head in the other views.
    pub too_much: f64,
    /// Share of the other views' masks, 0..=1, that it takes away.
    pub too_little: f64,
    /// A sentence for the user.
    pub text: String,
}

/// The result of the check.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Consistency {
    /// Number of compared masks.
    pub masks: usize,
    /// The conflicting masks, the worst first.
    pub conflicts: Vec<Conflict>,
    /// Share of all masks that is left unexplained once those are set aside.
    pub left: f64,
}

/// Compares the masks of all views. Fewer than two masks cannot conflict.
///
/// # Errors
/// When the cameras stand at one place or look in one direction.
pub fn check_consistency(views: &[ConsistencyView]) -> Result<Consistency> {
    check_at(ROWS, CELLS, views)
}

fn check_at(rows: u32, cells: usize, views: &[ConsistencyView]) -> Result<Consistency> {
    let used: Vec<usize> =
        (0..views.len()).filter(|&i| views[i].mask.is_some_and(|m| !m.values.is_empty())).collect();
    if used.len() < 2 {
        return Ok(Consistency { masks: used.len(), ..Consistency::default() });
    }
    let (cube, claims) = claims_of(views, &used, cells, rows)?;
    let votes = Votes::count(cube, &claims);
    let mut active = vec![true; claims.len()];
    let mut conflicts = Vec::new();
    loop {
        let conflict = Conflicts::among(&votes, &claims, &active);
        let left = active.iter().filter(|a| **a).count();
        // of equals the first
        let worst = (0..claims.len())
            .filter(|&i| active[i])
            .rev()
            .max_by(|&a, &b| conflict.credit[a].total_cmp(&conflict.credit[b]))
            .filter(|&i| conflict.names(i, left));
        let Some(worst) = worst.filter(|_| left >= 2) else {
            let total: f64 = (0..claims.len()).filter(|&i| active[i]).map(|i| conflict.too_much[i]).sum();
            return Ok(Consistency { masks: claims.len(), conflicts, left: total / left.max(1) as f64 });
        };
        // of two masks it is unknown which one is wrong
        let named = if left == 2 { (0..claims.len()).filter(|&i| active[i]).collect() } else { vec![worst] };
        for i in named {
            active[i] = false;
            let (much, little) = (conflict.too_much[i], conflict.too_little(i));
            let text = sentence(views[used[i]].name, much, little, conflict.taken[i], left == 2);
            conflicts.push(Conflict { view: used[i], too_much: much, too_little: little, text });
        }
    }
}

/// Returns the cube in view of the cameras, and the constraints of each mask.
fn claims_of(
    views: &[ConsistencyView],
    used: &[usize],
    cells: usize,
    rows: u32,
) -> Result<(CellCube, Vec<SilhouetteConstraints>)> {
    let cameras: Vec<Camera> = used.iter().map(|&i| views[i].camera.clone()).collect();
    let cube = hull::cube(&cameras, cells, CUBE)?;
    let claims = used
        .par_iter()
        .filter_map(|&i| Some(SilhouetteConstraints::new(views[i].camera, views[i].mask?, &cube, rows)))
        .collect();
    Ok((cube, claims))
}

fn sentence(view: &str, much: f64, little: f64, taken: f64, two: bool) -> String {
    let percent =
        |v: f64| if v < 0.02 { format!("{:.1} %", 100.0 * v) } else { format!("{:.0} %", 100.0 * v) };
    let parts = if much > 0.9 {
        "contradicts its camera or the other masks: no other view has anything where it shows the head".into()
    } else if much > 3.0 * taken {
        format!("shows too much: no other view has anything for {} of it", percent(much))
    } else if much < 0.01 && taken > 3.0 * much {
        format!("shows too little: it takes away {} of what the other masks show", percent(little))
    } else {
        format!(
            "does not fit: no other view has anything for {} of it, and it takes away {} of what the others show",
            percent(much),
            percent(little)
        )
    };
    let which = if two { "; with two masks left, the other may be the wrong one" } else { "" };
    format!("the mask of view `{view}` {parts}{which}")
}

/// Constraints of a reduced mask: pixels that are head, and pixels that rule out the head.
struct SilhouetteConstraints {
    camera: Camera,
    frame: ViewFrame,
    /// Pixels so far beside the mask that they rule out the cells they show.
    beside: Vec<bool>,
    on: Vec<bool>,
    /// Pixels well inside the mask, whose rays must meet something.
    inner: Vec<usize>,
}

impl SilhouetteConstraints {
    fn new(camera: &Camera, mask: &Gray, cube: &CellCube, rows: u32) -> SilhouetteConstraints {
        let height = rows.clamp(16, mask.height.max(16));
        let width = ((mask.width as f64 * height as f64 / mask.height as f64).round() as u32).max(1);
        let camera = camera.resized(width, height);
        let on = resize_hard(mask, (width, height)).inside();
        let (w, h) = (width as usize, height as usize);
        let off: Vec<bool> = on.iter().map(|o| !o).collect();
        // half the diagonal of a cell where the cube's middle is
        let footprint = cube.radius() * camera.fy / camera.position.distance(cube.center);
        let slack = footprint as f32 + SLACK_PX;
        let beside = squared_distance(&on, w, h).iter().map(|&d| d > slack * slack).collect();
        // an all-white mask is infinitely far from its outside
        let depth = squared_distance(&off, w, h);
        let inner = (0..w * h).filter(|&i| depth[i] > SLACK_PX * SLACK_PX).collect();
        SilhouetteConstraints { frame: ViewFrame::new(&camera), camera, beside, on, inner }
    }
}

/// Which views vote against and for every cell: bits of views, `words` of them against and as many
/// for.
struct Votes {
    cube: CellCube,
    words: usize,
    bits: Vec<u64>,
}

impl Votes {
    fn count(cube: CellCube, claims: &[SilhouetteConstraints]) -> Votes {
        let words = claims.len().div_ceil(64);
        let frames: Vec<&ViewFrame> = claims.iter().map(|c| &c.frame).collect();
        let bits = hull::vote(&cube, &frames, 2 * words, |cell: &mut [u64], k, pixel| {
            cell[k / 64] |= (claims[k].beside[pixel] as u64) << (k % 64);
            cell[words + k / 64] |= (claims[k].on[pixel] as u64) << (k % 64);
        });
        Votes { cube, words, bits }
    }

    /// Returns the costs of cells: how many active views rule each out, and how many have it on the
    /// head.
    fn costs(&self, active: &[bool]) -> Vec<(u16, u16)> {
        let mut mask = vec![0u64; self.words];
        for i in (0..active.len()).filter(|&i| active[i]) {
            mask[i / 64] |= 1 << (i % 64);
        }
        let ones = |set: &[u64]| set.iter().zip(&mask).map(|(s, m)| (s & m).count_ones() as u16).sum::<u16>();
        let cells = self.bits.par_chunks_exact(2 * self.words);
        cells.map(|cell| (ones(&cell[..self.words]), ones(&cell[self.words..]))).collect()
    }

    /// Returns whether a view rules a cell out.
    fn rules_out(&self, view: usize, cell: usize) -> bool {
        self.bits[2 * cell * self.words + view / 64] & (1 << (view % 64)) != 0
    }
}

/// The conflicts among the views that are still active.
struct Conflicts {
    /// Per view: unexplained share of its own claims.
    too_much: Vec<f64>,
    /// Per view: shares of other views' claims that it takes away, summed.
    taken: Vec<f64>,
    /// Part of the conflict that removing the view settles, in whole masks.
    credit: Vec<f64>,
    others: f64,
}

impl Conflicts {
    fn among(votes: &Votes, claims: &[SilhouetteConstraints], active: &[bool]) -> Conflicts {
        let count = claims.len();
        let costs = votes.costs(active);
        let found = oppositions(votes, claims, active, |claims, pixel| {
            best_on_ray(&votes.cube, claims, pixel, &costs).map(|(no, cell)| (false, no, cell))
        });
        let others = (active.iter().filter(|a| **a).count().max(2) - 1) as f64;
        let zero = || vec![0.0; count];
        let mut conflict = Conflicts { too_much: zero(), taken: zero(), credit: zero(), others };
        for (j, open) in found.into_iter().enumerate() {
            let Some(Opposition { asked, open, opposing }) = open else { continue };
            // if hardly any ray enters another view's frustum, the camera is turned away from the
            // head that its mask shows
            let is_turned = 10 * asked < claims[j].inner.len();
            let own = if is_turned { 1.0 } else { open };
            conflict.too_much[j] = own;
            conflict.credit[j] += own;
            for (i, [taken, _]) in opposing.into_iter().enumerate().filter(|_| !is_turned) {
                conflict.taken[i] += taken;
                conflict.credit[i] += taken;
            }
        }
        conflict
    }

    /// Returns whether a view's part in the conflict is large, or at least unlike that of the
    /// others. Of `left` views a single wrong one has half of all credit, so few views can stand
    /// out less.
    fn names(&self, i: usize, left: usize) -> bool {
        let mean = self.credit.iter().sum::<f64>() / left as f64;
        let times = if left == 2 { 0.0 } else { (left as f64 / 6.0).clamp(1.2, OUTLIER_RATIO) };
        let own = self.credit[i];
        own > CERTAIN_THRESHOLD || (own > THRESHOLD && own > times * mean)
    }

    /// Returns the mean share that a view takes away from the others.
    fn too_little(&self, i: usize) -> f64 {
        self.taken[i] / self.others
    }
}

/// Conflicts of one view's claims with the other views.
struct Opposition {
    /// Claims whose ray meets a cell in another view's frame.
    asked: usize,
    /// Share of them that no cell explains.
    open: f64,
    /// Per view: the share of the claims that it rules out, divided among all views that do; and
    /// the same undivided.
    opposing: Vec<[f64; 2]>,
}

/// Returns the conflicts of each active view with the other ones; `best` is that of
/// [`Opposition::against`] for a pixel of any view.
fn oppositions(
    votes: &Votes,
    claims: &[SilhouetteConstraints],
    active: &[bool],
    best: impl Fn(&SilhouetteConstraints, usize) -> Option<(bool, u16, usize)> + Sync,
) -> Vec<Option<Opposition>> {
    let opposition =
        |j: usize| Opposition::against(votes, &claims[j], active, |pixel| best(&claims[j], pixel));
    (0..claims.len()).into_par_iter().map(|j| active[j].then(|| opposition(j))).collect()
}

impl Opposition {
    /// `best` returns the best cell on a pixel's ray: whether it lacks support (then it explains
    /// nothing, but no view is to blame), how many active views rule it out, and its index.
    fn against(
        votes: &Votes,
        claims: &SilhouetteConstraints,
        active: &[bool],
        best: impl Fn(usize) -> Option<(bool, u16, usize)>,
    ) -> Opposition {
        let mut opposing = vec![[0.0; 2]; active.len()];
        let (mut open, mut asked) = (0usize, 0usize);
        for (unsupported, no, cell) in claims.inner.iter().filter_map(|&pixel| best(pixel)) {
            asked += 1;
            open += (unsupported || no > 0) as usize;
            if unsupported || no == 0 {
                continue;
            }
            for i in (0..active.len()).filter(|&i| active[i] && votes.rules_out(i, cell)) {
                opposing[i][0] += 1.0 / f64::from(no);
                opposing[i][1] += 1.0;
            }
        }
        let total = asked.max(1) as f64;
        opposing.iter_mut().flatten().for_each(|t| *t /= total);
        Opposition { asked, open: open as f64 / total, opposing }
    }
}

/// Returns the cells on a pixel's ray, from the camera on, each half a cell from the last.
fn cells_on_ray<'a>(
    cube: &'a CellCube,
    claims: &SilhouetteConstraints,
    pixel: usize,
) -> impl Iterator<Item = usize> + use<'a> {
    let (n, cell) = (cube.n, cube.cell());
    let (x, y) = (pixel % claims.frame.width, pixel / claims.frame.width);
    let (mut begin, mut end) = (0.0f64, f64::INFINITY);
    let (mut origin, mut direction) = (DVec3::ZERO, DVec3::ZERO);
    match claims.camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5)) {
        None => end = 0.0,
        Some(ray) => {
            // in cells from the cube's corner
            origin = (claims.camera.position - cube.center + cube.half) / cell;
            direction = ray.direction.as_dvec3();
        }
    }
    for a in 0..3 {
        let (o, d) = (origin[a], direction[a]);
        if d.abs() < 1e-12 {
            if o < 0.0 || o >= n as f64 {
                end = 0.0;
            }
            continue;
        }
        let (p, q) = (-o / d, (n as f64 - o) / d);
        begin = begin.max(p.min(q));
        end = end.min(p.max(q));
    }
    let mut t = begin + 0.25;
    std::iter::from_fn(move || {
        while t < end {
            let p = origin + direction * t;
            t += 0.5;
            let at = [p.x, p.y, p.z].map(|v| v as usize);
            if at.iter().all(|&v| v < n) {
                return Some((at[0] * n + at[1]) * n + at[2]);
            }
        }
        None
    })
}

/// Returns the cell on a pixel's ray that fewest views rule out, among those that another view has
/// on the head, if any; of equals the one that most views have on the head. `None` when no other
/// view looks at the ray within the cube.
fn best_on_ray(
    cube: &CellCube,
    claims: &SilhouetteConstraints,
    pixel: usize,
    costs: &[(u16, u16)],
) -> Option<(u16, usize)> {
    // first whether another view supports it, then how many are against it
    let mut best: Option<(bool, u16, u16, usize)> = None;
    for i in cells_on_ray(cube, claims, pixel) {
        let (no, yes) = costs[i];
        if no == 0 && yes < 2 {
            continue; // no other view sees this cell, so it explains nothing
        }
        let unsupported = yes < 2;
        if best.is_none_or(|(a, cost, agreed, _)| (unsupported, no, agreed) < (a, cost, yes)) {
            best = Some((unsupported, no, yes, i));
            if no == 0 {
                break;
            }
        }
    }
    best.map(|(_, cost, _, i)| (cost, i))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DMat3;
    use tiface_base::geom::Distortion;

    /// Returns a camera that looks at the origin from 10 away, turned around y after it was tilted.
    pub(super) fn camera(turn: f64, tilt: f64) -> Camera {
        let rotation = DMat3::from_rotation_y(turn) * DMat3::from_rotation_x(tilt);
        Camera {
            width: 96,
            height: 128,
            fx: 300.0,
            fy: 300.0,
            cx: 48.0,
            cy: 64.0,
            distortion: Distortion::default(),
            rotation,
            position: rotation * DVec3::new(0.0, 0.0, 10.0),
        }
    }

    /// Returns cameras on a ring, rising a little from one to the next.
    fn ring(count: usize) -> Vec<Camera> {
        (0..count).map(|i| camera(i as f64 * std::f64::consts::TAU / 9.0, -0.05 * i as f64)).collect()
    }

    /// Returns a snowman with a nose, seen by a camera.
    fn mask(camera: &Camera) -> Gray {
        let balls = [
            (DVec3::new(0.0, -0.6, 0.0), 0.8),
            (DVec3::new(0.0, 0.6, 0.0), 0.6),
            (DVec3::new(0.0, 0.6, 0.7), 0.3),
        ];
        let values = (0..96 * 128)
            .map(|i| {
                let ray = camera.ray(Vec2::new((i % 96) as f32 + 0.5, (i / 96) as f32 + 0.5)).unwrap();
                let hit = balls.iter().any(|(c, r)| {
                    let to = *c - camera.position;
                    to.cross(ray.direction.as_dvec3()).length() < *r
                });
                if hit { 255 } else { 0 }
            })
            .collect();
        Gray { width: 96, height: 128, values }
    }

    fn check(cameras: &[Camera], masks: &[Gray]) -> Consistency {
        let views: Vec<ConsistencyView> = cameras
            .iter()
            .zip(masks)
            .map(|(camera, m)| ConsistencyView { name: "v", camera, mask: Some(m) })
            .collect();
        check_at(128, 64, &views).unwrap()
    }

    fn shifted(mask: &Gray, by: usize) -> Gray {
        let (w, n) = (mask.width as usize, mask.values.len());
        let at = |i: usize| if i % w >= by { mask.values[i - by] } else { 0 };
        Gray { values: (0..n).map(at).collect(), ..mask.clone() }
    }

    #[test]
    fn true_masks_are_consistent() {
        let cameras = ring(8);
        let masks: Vec<Gray> = cameras.iter().map(mask).collect();
        let found = check(&cameras, &masks);
        assert_eq!((found.masks, found.conflicts.len()), (8, 0), "{found:?}");
        assert!(found.left < 1e-3);
    }

    #[test]
    fn one_wrong_mask_is_named_with_its_direction() {
        let cameras = ring(8);
        let masks: Vec<Gray> = cameras.iter().map(mask).collect();
        let fill = |v: u8| Gray { values: vec![v; 96 * 128], ..masks[0].clone() };
        let inverted = Gray { values: masks[3].values.iter().map(|v| 255 - v).collect(), ..masks[3].clone() };
        for (wrong, said) in [
            (fill(0), "shows too little"),
            (fill(255), "shows too much"),
            (inverted, "the mask of view"),
            (shifted(&masks[3], 14), "the mask of view"),
        ] {
            let mut masks = masks.clone();
            masks[3] = wrong;
            let found = check(&cameras, &masks);
            assert_eq!(found.conflicts.iter().map(|d| d.view).collect::<Vec<_>>(), [3], "{said}: {found:?}");
            assert!(found.conflicts[0].text.contains(said), "{}", found.conflicts[0].text);
        }
    }

    #[test]
    fn a_camera_turned_away_from_what_its_mask_shows_is_named() {
        let mut cameras = ring(8);
        let masks: Vec<Gray> = cameras.iter().map(mask).collect();
        // half a radian leaves some of its rays on what others show, half a turn none
        for (turn, said) in [(0.5, "shows too much"), (std::f64::consts::PI, "contradicts its camera")] {
            cameras[3].rotation = ring(8)[3].rotation * DMat3::from_rotation_y(turn);
            let found = check(&cameras, &masks);
            assert_eq!(found.conflicts.iter().map(|d| d.view).collect::<Vec<_>>(), [3], "{turn}: {found:?}");
            assert!(found.conflicts[0].text.contains(said), "{}", found.conflicts[0].text);
        }
    }

    #[test]
    fn two_wrong_masks_are_both_named_and_nothing_else() {
        let cameras = ring(8);
        let mut masks: Vec<Gray> = cameras.iter().map(mask).collect();
        masks[1].values.fill(0);
        masks[6].values.fill(0);
        let mut views: Vec<usize> = check(&cameras, &masks).conflicts.iter().map(|d| d.view).collect();
        views.sort_unstable();
        assert_eq!(views, [1, 6]);
    }

    #[test]
    fn of_two_masks_neither_can_be_trusted_and_one_has_no_one_to_disagree_with() {
        let cameras = ring(2);
        let mut masks: Vec<Gray> = cameras.iter().map(mask).collect();
        masks[0].values.fill(0);
        let found = check(&cameras, &masks);
        assert_eq!(found.conflicts.len(), 2);
        assert!(found.conflicts[0].text.contains("two masks left"));
        assert!(check(&cameras[..1], &masks[..1]).conflicts.is_empty());
    }

    #[test]
    fn masks_are_reduced_by_area() {
        // 4 x 2 to 2 x 1: left block three of four masked, right block one
        let mask = Gray { width: 4, height: 2, values: vec![255, 255, 0, 0, 255, 0, 0, 200] };
        assert_eq!(resize_hard(&mask, (2, 1)).values, [255, 0]);
    }
}
