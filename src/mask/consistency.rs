//! Do the masks of all views fit one body? Silhouette consistency (Laurentini 1994; Boyer 2006).
//!
//! Of masks that are right, every ray through a masked pixel meets the visual hull: somewhere along it lies a point
//! that no other mask rules out. Where none does, masks contradict each other: either this view shows too much, or
//! each view that rules out the best point of the ray shows too little. One such pixel cannot tell which; all of
//! them together can. The view whose removal settles most of the conflict is named first, and the rest is asked
//! again without it, until what is left is no more than discretisation.
//!
//! Nothing but masks and cameras is needed, so masks a person brought are checked the same way.

use super::distance::squared_distance;
use super::error::CutError;
use super::hull;
use crate::capture::carve::{Cube, Projector};
use crate::geom::Camera;
use crate::image::Gray;
use glam::Vec2;
use rayon::prelude::*;

/// How masks are checked against each other.
#[derive(Clone, Debug, PartialEq)]
pub struct ConsistencyOptions {
    /// Rows that masks are reduced to.
    pub rows: u32,
    /// Cells along each side of the cube.
    pub cells: usize,
    /// Half side of the cube, in half heights of the frames at the point they look at.
    pub cube: f64,
    /// How many reduced pixels beside a mask, beyond the footprint of a cell, nothing is ruled out yet.
    pub slack_px: f32,
    /// Conflicts of a view, in whole masks, below which it is never named.
    pub threshold: f64,
    /// … and from which it always is.
    pub certain_threshold: f64,
    /// Between the two it is named when its conflict is this many times the mean.
    pub stand_out: f64,
}

impl Default for ConsistencyOptions {
    fn default() -> ConsistencyOptions {
        ConsistencyOptions {
            rows: 160,
            cells: 128,
            cube: 1.6,
            slack_px: 1.0,
            threshold: 0.005,
            certain_threshold: 0.05,
            stand_out: 4.0,
        }
    }
}

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
    /// What a person should read.
    pub text: String,
}

/// What the check found.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Consistency {
    /// How many masks were compared.
    pub masks: usize,
    /// The masks to look at, the worst first.
    pub conflicts: Vec<Conflict>,
    /// Share of all masks that is left unexplained once those are set aside.
    pub left: f64,
}

/// Compares the masks of all views. Fewer than two masks have nothing to disagree about.
pub fn check_consistency(
    views: &[ConsistencyView],
    options: &ConsistencyOptions,
) -> Result<Consistency, CutError> {
    let used: Vec<usize> =
        (0..views.len()).filter(|&i| views[i].mask.is_some_and(|m| !m.values.is_empty())).collect();
    if used.len() < 2 {
        return Ok(Consistency { masks: used.len(), ..Consistency::default() });
    }
    let cameras: Vec<Camera> = used.iter().map(|&i| views[i].camera.clone()).collect();
    let cube = hull::cube(&cameras, options.cells.max(8), options.cube)?;
    let silhouettes: Vec<Silhouette> = (used.par_iter())
        .filter_map(|&i| Some(Silhouette::new(views[i].camera, views[i].mask?, &cube, options)))
        .collect();
    let space = Space::new(cube, &silhouettes);
    let mut active = vec![true; silhouettes.len()];
    let mut conflicts = Vec::new();
    loop {
        let conflict = Conflicts::of(&space, &silhouettes, &active);
        let left = active.iter().filter(|a| **a).count();
        // of equals the first
        let worst = (0..silhouettes.len())
            .filter(|&i| active[i])
            .rev()
            .max_by(|&a, &b| conflict.credit[a].total_cmp(&conflict.credit[b]))
            .filter(|&i| conflict.names(i, left, options));
        let Some(worst) = worst.filter(|_| left >= 2) else {
            let total: f64 =
                (0..silhouettes.len()).filter(|&i| active[i]).map(|i| conflict.too_much[i]).sum();
            return Ok(Consistency { masks: silhouettes.len(), conflicts, left: total / left.max(1) as f64 });
        };
        // of two masks nothing says which is wrong
        let named =
            if left == 2 { (0..silhouettes.len()).filter(|&i| active[i]).collect() } else { vec![worst] };
        for i in named {
            active[i] = false;
            let (much, little) = (conflict.too_much[i], conflict.too_little(i));
            let text = sentence(views[used[i]].name, much, little, conflict.taken[i], left == 2);
            conflicts.push(Conflict { view: used[i], too_much: much, too_little: little, text });
        }
    }
}

fn sentence(view: &str, much: f64, little: f64, taken: f64, two: bool) -> String {
    let percent =
        |v: f64| if v < 0.02 { format!("{:.1} %", 100.0 * v) } else { format!("{:.0} %", 100.0 * v) };
    let parts = if much > 3.0 * taken {
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

/// A reduced mask and what it rules out.
struct Silhouette {
    camera: Camera,
    projector: Projector,
    width: usize,
    height: usize,
    /// Pixels so far beside the mask that a cell there is ruled out.
    beside: Vec<bool>,
    on: Vec<bool>,
    /// Pixels well inside the mask, whose rays must meet something.
    claims: Vec<usize>,
}

impl Silhouette {
    fn new(camera: &Camera, mask: &Gray, cube: &Cube, options: &ConsistencyOptions) -> Silhouette {
        let height = options.rows.clamp(16, mask.height.max(16));
        let width = ((mask.width as f64 * height as f64 / mask.height as f64).round() as u32).max(1);
        let camera = camera.resized(width, height);
        let on = reduced(mask, width as usize, height as usize);
        let (w, h) = (width as usize, height as usize);
        let off: Vec<bool> = on.iter().map(|o| !o).collect();
        // half the diagonal of a cell where the cube's middle is
        let footprint = cube.radius() * camera.fy / camera.position.distance(cube.center);
        let slack = footprint as f32 + options.slack_px;
        let beside = squared_distance(&on, w, h).iter().map(|&d| d > slack * slack).collect();
        // an all-white mask is infinitely far from its outside
        let inner = squared_distance(&off, w, h);
        let claims = (0..w * h).filter(|&i| inner[i] > options.slack_px * options.slack_px).collect();
        Silhouette { projector: Projector::new(&camera), camera, width: w, height: h, beside, on, claims }
    }
}

/// Head where at least half of the area is masked.
fn reduced(mask: &Gray, width: usize, height: usize) -> Vec<bool> {
    let (w, h) = (mask.width as usize, mask.height as usize);
    let span = |i: usize, to: usize, from: usize| {
        let first = i * from / to;
        first..((i + 1) * from).div_ceil(to).clamp(first + 1, from)
    };
    let mut on = Vec::with_capacity(width * height);
    for y in 0..height {
        let rows = span(y, height, h);
        for x in 0..width {
            let columns = span(x, width, w);
            let head = |v: usize| mask.values[v * w..][columns.clone()].iter().filter(|&&m| m > 127).count();
            let sum: usize = rows.clone().map(head).sum();
            on.push(2 * sum >= rows.len() * columns.len());
        }
    }
    on
}

/// Who says what about every cell: bits of views, `words` to a cell.
struct Space {
    cube: Cube,
    words: usize,
    /// Views that rule the cell out.
    no: Vec<u64>,
    /// Views that have it on the head.
    yes: Vec<u64>,
}

impl Space {
    fn new(cube: Cube, silhouettes: &[Silhouette]) -> Space {
        let (n, words) = (cube.n, silhouettes.len().div_ceil(64));
        let slabs: Vec<(Vec<u64>, Vec<u64>)> = (0..n)
            .into_par_iter()
            .map(|x| {
                let (mut no, mut yes) = (vec![0u64; n * n * words], vec![0u64; n * n * words]);
                for (p, silhouette) in silhouettes.iter().enumerate() {
                    for i in 0..n * n {
                        let Some((u, v, _)) = silhouette.projector.project(cube.cell_center(x, i / n, i % n))
                        else {
                            continue;
                        };
                        if u < 0.0 || v < 0.0 || u >= silhouette.width as f64 || v >= silhouette.height as f64
                        {
                            continue;
                        }
                        let pixel = v as usize * silhouette.width + u as usize;
                        let at = i * words + p / 64;
                        no[at] |= (silhouette.beside[pixel] as u64) << (p % 64);
                        yes[at] |= (silhouette.on[pixel] as u64) << (p % 64);
                    }
                }
                (no, yes)
            })
            .collect();
        let (no, yes): (Vec<_>, Vec<_>) = slabs.into_iter().unzip();
        Space { cube, words, no: no.concat(), yes: yes.concat() }
    }
}

/// Who stands against whom among the views still believed.
struct Conflicts {
    /// Per view: unexplained share of its own claims.
    too_much: Vec<f64>,
    /// Per view: shares of other views' claims that it takes away, summed.
    taken: Vec<f64>,
    /// How much of the conflict its removal settles, in whole masks.
    credit: Vec<f64>,
    others: f64,
}

impl Conflicts {
    fn of(space: &Space, silhouettes: &[Silhouette], active: &[bool]) -> Conflicts {
        let count = silhouettes.len();
        let mut mask = vec![0u64; space.words];
        for i in (0..count).filter(|&i| active[i]) {
            mask[i / 64] |= 1 << (i % 64);
        }
        // cells as what they cost: how many active views rule them out, and how many have them on the head
        let bits = |set: &[u64], i: usize| -> u32 {
            (0..space.words).map(|k| (set[i * space.words + k] & mask[k]).count_ones()).sum()
        };
        let cells = space.cube.n.pow(3);
        let costs: Vec<(u16, u16)> = (0..cells)
            .into_par_iter()
            .map(|i| (bits(&space.no, i) as u16, bits(&space.yes, i) as u16))
            .collect();
        let found: Vec<Option<(f64, Vec<f64>)>> = (0..count)
            .into_par_iter()
            .map(|j| active[j].then(|| open_claims(space, &silhouettes[j], &costs, &mask, count)))
            .collect();
        let others = (active.iter().filter(|a| **a).count().max(2) - 1) as f64;
        let zero = || vec![0.0; count];
        let mut conflict = Conflicts { too_much: zero(), taken: zero(), credit: zero(), others };
        for (j, open) in found.into_iter().enumerate() {
            let Some((own, takers)) = open else { continue };
            conflict.too_much[j] = own;
            conflict.credit[j] += own;
            for (i, t) in takers.into_iter().enumerate() {
                conflict.taken[i] += t;
                conflict.credit[i] += t;
            }
        }
        conflict
    }

    /// Is a view's part in the conflict large, or at least unlike that of the others? Of `left` views a single
    /// wrong one has half of all credit, so few views can stand out less.
    fn names(&self, i: usize, left: usize, options: &ConsistencyOptions) -> bool {
        let mean = self.credit.iter().sum::<f64>() / left as f64;
        let times = if left == 2 { 0.0 } else { (left as f64 / 6.0).max(1.2).min(options.stand_out) };
        let own = self.credit[i];
        own > options.certain_threshold || (own > options.threshold && own > times * mean)
    }

    /// Mean share that a view takes away from the others.
    fn too_little(&self, i: usize) -> f64 {
        self.taken[i] / self.others
    }
}

/// The share of a view's claims that nothing explains, and the views that rule out the best point of each such
/// ray: `k` of them share a claim in equal parts.
fn open_claims(
    space: &Space,
    silhouette: &Silhouette,
    costs: &[(u16, u16)],
    mask: &[u64],
    count: usize,
) -> (f64, Vec<f64>) {
    let mut takers = vec![0.0; count];
    let (mut open, mut asked) = (0usize, 0usize);
    for &pixel in &silhouette.claims {
        let (x, y) = (pixel % silhouette.width, pixel / silhouette.width);
        let Some((cost, cell)) = best_on_ray(space, &silhouette.camera, x, y, costs) else { continue };
        asked += 1;
        if cost == 0 {
            continue;
        }
        open += 1;
        for i in 0..count {
            let bit = space.no[cell * space.words + i / 64] & mask[i / 64] & (1 << (i % 64));
            if bit != 0 {
                takers[i] += 1.0 / cost as f64;
            }
        }
    }
    let asked = asked.max(1) as f64;
    takers.iter_mut().for_each(|t| *t /= asked);
    (open as f64 / asked, takers)
}

/// The cell on a pixel's ray that fewest views rule out, of those that another view has on the head if there are
/// any; of equals the one that most have there. Nothing when no other view looks at the ray within the cube.
fn best_on_ray(
    space: &Space,
    camera: &Camera,
    x: usize,
    y: usize,
    costs: &[(u16, u16)],
) -> Option<(u16, usize)> {
    let ray = camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5))?;
    let (n, cell) = (space.cube.n, space.cube.cell());
    // in cells from the cube's corner
    let origin = (camera.position - space.cube.center + space.cube.half) / cell;
    let direction = ray.direction.as_dvec3();
    let (mut begin, mut end) = (0.0f64, f64::INFINITY);
    for a in 0..3 {
        let (o, d) = (origin[a], direction[a]);
        if d.abs() < 1e-12 {
            if o < 0.0 || o >= n as f64 {
                return None;
            }
            continue;
        }
        let (p, q) = (-o / d, (n as f64 - o) / d);
        begin = begin.max(p.min(q));
        end = end.min(p.max(q));
    }
    // whom the ray's own view has on its side comes first, then who is against
    let mut best: Option<(bool, u16, u16, usize)> = None;
    let mut t = begin + 0.25;
    while t < end {
        let p = origin + direction * t;
        t += 0.5;
        let at = [p.x, p.y, p.z].map(|v| v as usize);
        if at.iter().any(|&v| v >= n) {
            continue;
        }
        let i = (at[0] * n + at[1]) * n + at[2];
        let (no, yes) = costs[i];
        if no == 0 && yes < 2 {
            continue; // no other view looks there, which explains nothing
        }
        let alone = yes < 2;
        if best.is_none_or(|(a, cost, agreed, _)| (alone, no, agreed) < (a, cost, yes)) {
            best = Some((alone, no, yes, i));
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
    use crate::geom::Distortion;
    use glam::{DMat3, DVec3};

    /// Eight cameras on a ring, rising a little from one to the next.
    fn ring(count: usize) -> Vec<Camera> {
        (0..count)
            .map(|i| {
                let turn = i as f64 * std::f64::consts::TAU / 9.0;
                let rotation = DMat3::from_rotation_y(turn) * DMat3::from_rotation_x(-0.05 * i as f64);
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
            })
            .collect()
    }

    /// A snowman with a nose, seen by a camera.
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
        check_consistency(
            &views,
            &ConsistencyOptions { rows: 128, cells: 64, ..ConsistencyOptions::default() },
        )
        .unwrap()
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
        assert_eq!(reduced(&mask, 2, 1), [true, false]);
    }
}
