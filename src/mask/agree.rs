//! Do the masks of all views fit one body? Silhouette consistency (Laurentini 1994; Boyer 2006).
//!
//! Of masks that are right, every ray through a masked pixel meets the visual hull: somewhere along it lies a point
//! that no other mask rules out. Where none does, masks contradict each other: either this view shows too much, or
//! each view that rules out the best point of the ray shows too little. One such pixel cannot tell which; all of
//! them together can. The view whose removal settles most of the quarrel is named first, and the rest is asked
//! again without it, until what is left is no more than discretisation.
//!
//! Nothing but masks and cameras is needed, so masks a person brought are checked the same way.

use super::cut_error::CutError;
use super::distance::squared_distance;
use super::hull;
use crate::capture::carve::{Cube, Projector};
use crate::geom::Camera;
use crate::image::Gray;
use glam::Vec2;
use rayon::prelude::*;

/// How masks are checked against each other.
#[derive(Clone, Debug, PartialEq)]
pub struct AgreeOptions {
    /// Rows that masks are reduced to.
    pub rows: u32,
    /// Cells along each side of the cube.
    pub cells: usize,
    /// Half side of the cube, in half heights of the frames at the point they look at.
    pub cube: f64,
    /// How many reduced pixels beside a mask, beyond the footprint of a cell, nothing is ruled out yet.
    pub slack_px: f32,
    /// Share of a mask that no other mask explains, from which it is named.
    pub too_much: f64,
    /// Share of the other masks that one takes away, from which it is named.
    pub too_little: f64,
}

impl Default for AgreeOptions {
    fn default() -> AgreeOptions {
        AgreeOptions { rows: 160, cells: 128, cube: 1.3, slack_px: 1.0, too_much: 0.02, too_little: 0.004 }
    }
}

/// A view with its mask.
#[derive(Clone, Copy, Debug)]
pub struct AgreeView<'a> {
    /// Its name in messages.
    pub name: &'a str,
    /// Its camera.
    pub camera: &'a Camera,
    /// Its mask at any size, head from 128; a view without one takes no part.
    pub mask: Option<&'a Gray>,
}

/// A mask that does not fit the others.
#[derive(Clone, Debug, PartialEq)]
pub struct Doubt {
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
pub struct Agreement {
    /// How many masks were compared.
    pub masks: usize,
    /// The masks to look at, the worst first.
    pub doubts: Vec<Doubt>,
    /// Share of all masks that is left unexplained once those are set aside.
    pub left: f64,
}

/// Compares the masks of all views. Fewer than two masks have nothing to disagree about.
pub fn agree(views: &[AgreeView], options: &AgreeOptions) -> Result<Agreement, CutError> {
    let used: Vec<usize> = (0..views.len()).filter(|&i| views[i].mask.is_some_and(|m| !m.values.is_empty())).collect();
    if used.len() < 2 {
        return Ok(Agreement { masks: used.len(), ..Agreement::default() });
    }
    let cameras: Vec<Camera> = used.iter().map(|&i| views[i].camera.clone()).collect();
    let cube = hull::cube(&cameras, options.cells.max(8), options.cube)?;
    let parties: Vec<Party> = (used.par_iter())
        .filter_map(|&i| Some(Party::new(views[i].camera, views[i].mask?, &cube, options)))
        .collect();
    let space = Space::ask(cube, &parties);
    let mut active = vec![true; parties.len()];
    let mut doubts = Vec::new();
    loop {
        let quarrel = Quarrel::of(&space, &parties, &active);
        let left = active.iter().filter(|a| **a).count();
        let worst = (0..parties.len())
            .filter(|&i| active[i])
            .filter(|&i| {
                quarrel.too_much[i] > options.too_much || quarrel.too_little(i) > options.too_little
            })
            // of equals the first
            .rev()
            .max_by(|&a, &b| quarrel.credit[a].total_cmp(&quarrel.credit[b]));
        let Some(worst) = worst.filter(|_| left >= 2) else {
            let total: f64 = (0..parties.len()).filter(|&i| active[i]).map(|i| quarrel.too_much[i]).sum();
            return Ok(Agreement { masks: parties.len(), doubts, left: total / left.max(1) as f64 });
        };
        // of two masks nothing says which is wrong
        let named = if left == 2 { (0..parties.len()).filter(|&i| active[i]).collect() } else { vec![worst] };
        for i in named {
            active[i] = false;
            let (much, little) = (quarrel.too_much[i], quarrel.too_little(i));
            let text = sentence(views[used[i]].name, much, little, left == 2);
            doubts.push(Doubt { view: used[i], too_much: much, too_little: little, text });
        }
    }
}

fn sentence(view: &str, much: f64, little: f64, two: bool) -> String {
    let percent = |v: f64| if v < 0.01 { format!("{:.1} %", 100.0 * v) } else { format!("{:.0} %", 100.0 * v) };
    let parts = match (much > 0.005, little > 0.001) {
        (true, false) => format!("shows too much: no other view has anything for {} of it", percent(much)),
        (false, _) => format!("shows too little: it takes away {} of what the other masks show", percent(little)),
        (true, true) => format!(
            "does not fit: no other view has anything for {} of it, and it takes away {} of what the others show",
            percent(much),
            percent(little)
        ),
    };
    let which = if two { "; with two masks left, the other may be the wrong one" } else { "" };
    format!("the mask of view `{view}` {parts}{which}")
}

/// A reduced mask and what it rules out.
struct Party {
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

impl Party {
    fn new(camera: &Camera, mask: &Gray, cube: &Cube, options: &AgreeOptions) -> Party {
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
        Party { projector: Projector::new(&camera), camera, width: w, height: h, beside, on, claims }
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
    fn ask(cube: Cube, parties: &[Party]) -> Space {
        let (n, words) = (cube.n, parties.len().div_ceil(64));
        let slabs: Vec<(Vec<u64>, Vec<u64>)> = (0..n)
            .into_par_iter()
            .map(|x| {
                let (mut no, mut yes) = (vec![0u64; n * n * words], vec![0u64; n * n * words]);
                for (p, party) in parties.iter().enumerate() {
                    for i in 0..n * n {
                        let Some((u, v, _)) = party.projector.project(cube.cell_center(x, i / n, i % n)) else {
                            continue;
                        };
                        if u < 0.0 || v < 0.0 || u >= party.width as f64 || v >= party.height as f64 {
                            continue;
                        }
                        let pixel = v as usize * party.width + u as usize;
                        let at = i * words + p / 64;
                        no[at] |= (party.beside[pixel] as u64) << (p % 64);
                        yes[at] |= (party.on[pixel] as u64) << (p % 64);
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
struct Quarrel {
    /// Per view: unexplained share of its own claims.
    too_much: Vec<f64>,
    /// Per view: shares of other views' claims that it takes away, summed.
    taken: Vec<f64>,
    /// How much of the quarrel its removal settles, in whole masks.
    credit: Vec<f64>,
    others: f64,
}

impl Quarrel {
    fn of(space: &Space, parties: &[Party], active: &[bool]) -> Quarrel {
        let count = parties.len();
        let mut mask = vec![0u64; space.words];
        for i in (0..count).filter(|&i| active[i]) {
            mask[i / 64] |= 1 << (i % 64);
        }
        // cells as what they cost: how many active views rule them out, and how many have them on the head
        let bits = |set: &[u64], i: usize| -> u32 {
            (0..space.words).map(|k| (set[i * space.words + k] & mask[k]).count_ones()).sum()
        };
        let cells = space.cube.n.pow(3);
        let costs: Vec<(u16, u16)> =
            (0..cells).into_par_iter().map(|i| (bits(&space.no, i) as u16, bits(&space.yes, i) as u16)).collect();
        let found: Vec<Option<(f64, Vec<f64>)>> = (0..count)
            .into_par_iter()
            .map(|j| active[j].then(|| open_claims(space, &parties[j], &costs, &mask, count)))
            .collect();
        let others = (active.iter().filter(|a| **a).count().max(2) - 1) as f64;
        let zero = || vec![0.0; count];
        let mut quarrel = Quarrel { too_much: zero(), taken: zero(), credit: zero(), others };
        for (j, open) in found.into_iter().enumerate() {
            let Some((own, takers)) = open else { continue };
            quarrel.too_much[j] = own;
            quarrel.credit[j] += own;
            for (i, t) in takers.into_iter().enumerate() {
                quarrel.taken[i] += t;
                quarrel.credit[i] += t;
            }
        }
        quarrel
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
    party: &Party,
    costs: &[(u16, u16)],
    mask: &[u64],
    count: usize,
) -> (f64, Vec<f64>) {
    let mut takers = vec![0.0; count];
    let (mut open, mut asked) = (0usize, 0usize);
    for &pixel in &party.claims {
        let (x, y) = (pixel % party.width, pixel / party.width);
        let Some((cost, cell)) = best_on_ray(space, &party.camera, x, y, costs) else { continue };
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

/// The cell on a pixel's ray that fewest views rule out; of equals the one that most have on the head. Nothing
/// when the ray misses the cube.
fn best_on_ray(space: &Space, camera: &Camera, x: usize, y: usize, costs: &[(u16, u16)]) -> Option<(u16, usize)> {
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
    let mut best: Option<(u16, u16, usize)> = None;
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
        if best.is_none_or(|(cost, agreed, _)| no < cost || (no == cost && yes > agreed)) {
            best = Some((no, yes, i));
            if no == 0 {
                break;
            }
        }
    }
    best.map(|(cost, _, i)| (cost, i))
}
