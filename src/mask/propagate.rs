//! A few clicked views → a mask for every view, through the known cameras.
//!
//! 1. The clicked views are cut by themselves; from all of them together the colors of head and
//!    background are learned once, and frozen.
//! 2. The masks so far carve a cube of cells: the visual hull, which the head cannot leave.
//! 3. In each view what lies outside the hull's silhouette is definite background and what the
//!    hull's core covers is definite head; between them the frozen colors cut.
//! 4. All masks carve again, each cell forgiven a few votes against it, and 3 is repeated.
//!
//! The hull is an outer bound: it excludes and never includes, but for its core.
//!
//! Where a network has proposed a mask for every view ([`propagate_proposals`]), those that agree
//! ([`verdicts`]) stand for the clicked ones: they teach the colors and carve the hull. What lies
//! well inside a proposal that is not unlike the others is definite head.

use super::clicks::{self, Click};
use super::consistency::{ConsistencyView, MaskVerdict, verdicts};
use super::grabcut::mixture::Rgb;
use super::grabcut::seeds::{BORDER_MARGIN, Seed};
use super::grabcut::{self, Grabcut, Models};
use super::hull::{self, Voter};
use super::morphology::gray;
use glam::DVec3;
use rayon::prelude::*;
use tiface_base::geom::{Camera, CellCube, drop_small_components};
use tiface_base::image::{Gray, Photo, grow, reduce_to_rows, shrink, size_at_rows};
use tiface_base::{Error, Result};
use tiface_capture::findings;

/// Cells along each side of the carved cube.
const CELLS: usize = 112;
/// Half side of the cube, in half heights of the frames at the point where the viewing axes meet.
const CUBE: f64 = 1.15;
/// Distance from the hull's silhouette at which definite background begins, as a share of the
/// picture's height.
const BACKGROUND_MARGIN: f32 = 0.012;
/// Cells deeper inside than this share of the deepest one are the core.
const CORE_DEPTH: f64 = 0.55;
/// By how much the core's silhouette is shrunk, share of the picture's height.
const CORE_SHRINK: f32 = 0.008;
/// Votes against a cell that are forgiven once all views have masks.
const MAX_NEGATIVE: usize = 2;
/// Share of the views that must vote for a cell then.
const MIN_POSITIVE: f64 = 0.1;
/// Rounds of carving and cutting.
const ROUNDS: usize = 3;
/// Pieces of a mask below this share of the picture are left out, unless clicked or in the core.
const MIN_PIECE_SHARE: f64 = 0.002;
/// Views loaded at once; bounds the memory.
const BATCH_VIEWS: usize = 8;
/// Colors of one side that the common mixtures learn from, at most; more would only take time.
const MAX_COLORS: usize = 600_000;

/// One view to be masked.
#[derive(Clone, Copy, Debug)]
pub struct PropagateView<'a> {
    /// Its name in messages.
    pub name: &'a str,
    /// Its camera, at the size of the photograph.
    pub camera: &'a Camera,
    /// Its clicks in pixels of the photograph; none for a view without clicks.
    pub clicks: &'a [Click],
    /// Whether its photograph affects the masks of other views; not for held-out views.
    pub votes: bool,
}

/// Masks of all views.
#[derive(Clone, Debug, PartialEq)]
pub struct HardMasks {
    /// In the order of the views given: 255 head, 0 background, at the working size.
    pub masks: Vec<Gray>,
    /// Warnings for the user.
    pub warnings: Vec<String>,
    /// Notes for the user.
    pub notes: Vec<String>,
}

/// Masks every view from the clicks on some. `load` gives the photograph of a view by its index.
///
/// Photographs are loaded a few at a time and kept at the working size only. The result does not
/// depend on the number of threads.
///
/// # Errors
/// When clicks cannot be used, all lie on held-out views or leave nothing of the head; when cameras
/// stand or look alike; when a photograph cannot be loaded or is not of its camera's size.
pub fn propagate<F>(views: &[PropagateView], load: F) -> Result<HardMasks>
where
    F: Fn(usize) -> Result<Photo> + Sync,
{
    propagate_in(CELLS, BATCH_VIEWS, views, load)
}

fn propagate_in<F>(cells: usize, at_once: usize, views: &[PropagateView], load: F) -> Result<HardMasks>
where
    F: Fn(usize) -> Result<Photo> + Sync,
{
    let clicked: Vec<usize> = (0..views.len()).filter(|&i| !views[i].clicks.is_empty()).collect();
    if clicked.is_empty() {
        return Err(clicks::no_clicks(&format!("view `{}`", views.first().map_or("", |v| v.name))));
    }
    if !clicked.iter().any(|&i| views[i].votes) {
        let names: Vec<&str> = clicked.iter().map(|&i| views[i].name).collect();
        let names = names.join(", ");
        return Err(Error::cannot(
            format!(
                "the clicks are all on held-out views ({names}), which may not shape the masks of others"
            ),
            "click on photographs that are trained on; `tiface inspect CAPTURE --json` tells which are",
        ));
    }
    for &i in &clicked {
        let v = &views[i];
        clicks::check(&format!("view `{}`", v.name), v.clicks, v.camera.width, v.camera.height)?;
    }
    let mut propagation = Propagation::new(cells, at_once, views, load)?;
    let start = propagation.clicked(&clicked)?;
    Ok(propagation.run(start))
}

/// Returns the photograph of a view at its working size, if it is one of its camera.
fn reduced(view: &PropagateView, photo: Photo) -> Result<Photo> {
    let PropagateView { name, camera, .. } = view;
    let (w, h) = (photo.width, photo.height);
    if (w, h) != (camera.width, camera.height) {
        let (cw, ch) = (camera.width, camera.height);
        return Err(Error::cannot(
            format!("view `{name}`: the photograph is {w} × {h} pixels, its camera {cw} × {ch}"),
            "use photographs of the size their cameras were calibrated for",
        ));
    }
    grabcut::check_size(name, w, h)?;
    Ok(reduce_to_rows(&photo, grabcut::ROWS))
}

/// Results of the clicked views, or of the views that agree.
struct StartViews {
    /// Colors of all of them together.
    models: Models,
    /// Per view: its labels and the colors it is cut by, where it is one of them.
    own: Vec<Option<(Vec<bool>, Models)>>,
}

struct Propagation<'a> {
    views: &'a [PropagateView<'a>],
    /// At the working size.
    photos: Vec<Photo>,
    cube: CellCube,
    /// Per view: what lies well inside its proposed mask; empty where that is not believed.
    inside: Vec<Vec<bool>>,
    warnings: Vec<String>,
    notes: Vec<String>,
}

impl<'a> Propagation<'a> {
    fn new<F>(cells: usize, at_once: usize, views: &'a [PropagateView<'a>], load: F) -> Result<Self>
    where
        F: Fn(usize) -> Result<Photo> + Sync,
    {
        let cameras: Vec<Camera> = views.iter().map(|v| v.camera.clone()).collect();
        let cube = hull::cube(&cameras, cells, CUBE)?;
        let mut photos = Vec::with_capacity(views.len());
        for start in (0..views.len()).step_by(at_once) {
            let some = start..(start + at_once).min(views.len());
            let loaded: Vec<Result<Photo>> =
                some.into_par_iter().map(|i| reduced(&views[i], load(i)?)).collect();
            for photo in loaded {
                photos.push(photo?);
            }
        }
        let inside = vec![Vec::new(); views.len()];
        Ok(Propagation { views, photos, cube, inside, warnings: Vec::new(), notes: Vec::new() })
    }

    /// Returns the colors of both sides.
    fn common(&self, mut inside: Vec<Rgb>, mut outside: Vec<Rgb>) -> Option<Models> {
        for side in [&mut inside, &mut outside] {
            let every = side.len().div_ceil(MAX_COLORS).max(1);
            *side = side.iter().step_by(every).copied().collect();
        }
        let mut models = Models::fit(&inside, &outside)?;
        for _ in 0..grabcut::ROUNDS {
            models = models.refit(&inside, &outside);
        }
        Some(models)
    }

    /// Returns the clicks of a view brought to its working size. The border margins are a guess:
    /// once a hull says where the head is, it may touch any border.
    fn grabcut(&self, i: usize, margins: bool) -> (Grabcut, Vec<String>) {
        let (v, photo) = (&self.views[i], &self.photos[i]);
        let margin = if margins { BORDER_MARGIN } else { 0.0 };
        Grabcut::new(v.name, photo.clone(), (v.camera.width, v.camera.height), v.clicks, margin)
    }

    /// Cuts the clicked views by themselves and learns the common colors.
    fn clicked(&mut self, clicked: &[usize]) -> Result<StartViews> {
        let found: Vec<_> = clicked
            .par_iter()
            .map(|&i| {
                let (grabcut, warnings) = self.grabcut(i, true);
                let (head, models) = grabcut.cut_from_clicks();
                let head = grabcut.finish_clicked(head);
                let models = models.filter(|_| head.contains(&true) && head.contains(&false));
                (head, models, warnings)
            })
            .collect();
        let mut own: Vec<Option<(Vec<bool>, Models)>> = vec![None; self.views.len()];
        let (mut inside, mut outside): (Vec<Rgb>, Vec<Rgb>) = Default::default();
        for (&i, (head, models, warnings)) in clicked.iter().zip(found) {
            self.warnings.extend(warnings);
            let Some(models) = models else {
                return Err(grabcut::empty(self.views[i].name));
            };
            // held-out views do not contribute to the colors of other views
            if self.views[i].votes {
                for (color, &h) in self.photos[i].rgb.iter().zip(&head) {
                    if h { inside.push(*color) } else { outside.push(*color) }
                }
            }
            own[i] = Some((head, models));
        }
        let empty = || grabcut::empty(self.views[clicked[0]].name);
        let models = self.common(inside, outside).ok_or_else(empty)?;
        Ok(StartViews { models, own })
    }

    /// Carves and cuts in turn.
    fn run(mut self, start: StartViews) -> HardMasks {
        let mut masks: Vec<Option<Gray>> = (start.own.iter().zip(&self.photos))
            .map(|(own, photo)| {
                own.as_ref().map(|(head, _)| gray(head, photo.width as usize, photo.height as usize))
            })
            .collect();
        let mut ambiguous = vec![0.0; self.views.len()];
        for round in 0..ROUNDS {
            let (hull, core) = self.carve(&masks);
            let [hull, core] = [hull, core].map(|cells| hull::surface(&self.cube, &cells));
            let done: Vec<(Gray, f64)> = (0..self.views.len())
                .into_par_iter()
                .map(|i| {
                    let models = start.own[i].as_ref().map_or(&start.models, |(_, own)| own);
                    self.cut_one(i, models, &hull, &core, round)
                })
                .collect();
            for (i, (mask, open)) in done.into_iter().enumerate() {
                masks[i] = Some(mask);
                ambiguous[i] = open;
            }
        }
        let masks: Vec<Gray> = masks.into_iter().flatten().collect();
        self.warn(&masks, &ambiguous);
        if start.own.iter().flatten().count() < 2 {
            self.warnings.push(
                "only one view is clicked: nothing bounds the head in depth at first; click a side view too"
                    .into(),
            );
        }
        HardMasks { masks, warnings: self.warnings, notes: self.notes }
    }

    /// Returns whether a proposed mask replaces the clicks.
    fn is_proposed(&self) -> bool {
        self.inside.iter().any(|inside| !inside.is_empty())
    }

    /// Returns the cells where the head may be, and the core where it must be.
    fn carve(&self, masks: &[Option<Gray>]) -> (Vec<bool>, Vec<bool>) {
        let voters: Vec<Voter> = (self.views.iter().zip(masks))
            .filter(|(v, _)| v.votes)
            .filter_map(|(v, m)| Some((v, m.as_ref().filter(|m| m.values.contains(&255))?)))
            .map(|(v, m)| Voter::new(v.camera, m))
            .collect();
        let votes = hull::count(&self.cube, &voters);
        let (n, total) = (self.cube.n, voters.len());
        // while only the clicked views have masks they decide alone; an empty mask is one, too
        let unmasked = self.views.iter().zip(masks).any(|(v, m)| v.votes && m.is_none());
        let (against, support) = match unmasked {
            // clicked masks were checked by the user
            true if self.is_proposed() => (MAX_NEGATIVE.min(total / 6), 0),
            true => (0, 0),
            false => (MAX_NEGATIVE.min(total / 6), (MIN_POSITIVE * total as f64).ceil() as usize),
        };
        let mut hull = hull::cells(&votes, against, support);
        drop_small_components(&mut hull, n, 0.02);
        let mut solid = hull::cells(&votes, against, support.max(total.div_ceil(2)));
        solid.iter_mut().zip(&hull).for_each(|(s, h)| *s &= h);
        let core = hull::core(&solid, n, CORE_DEPTH);
        (hull, core)
    }

    /// Cuts one view within the constraints of the hull and its core, whose surfaces are given.
    fn cut_one(
        &self,
        i: usize,
        models: &Models,
        hull: &[DVec3],
        core: &[DVec3],
        round: usize,
    ) -> (Gray, f64) {
        let (mut grabcut, _) = self.grabcut(i, round == 0 && !self.is_proposed());
        let (w, h) = (grabcut.width, grabcut.height);
        let camera = self.views[i].camera.resized(w as u32, h as u32);
        let allowed = hull::silhouette(&self.cube, hull, &camera);
        let allowed = grow(&allowed, w, h, BACKGROUND_MARGIN * h as f32);
        let within = hull::silhouette(&self.cube, core, &camera);
        let within = shrink(&within, w, h, CORE_SHRINK * h as f32);
        for (p, seeds) in grabcut.seeds.iter_mut().enumerate() {
            // clicks override constraints from other views
            if *seeds == Seed::Unknown {
                if !allowed[p] {
                    *seeds = Seed::Background;
                } else if within[p] || self.inside[i].get(p) == Some(&true) {
                    *seeds = Seed::Head;
                }
            }
        }
        let head = grabcut.min_cut(models);
        // the hull leaves only possible head: large pieces need no click
        let head = grabcut.finish(head, MIN_PIECE_SHARE * (w * h) as f64);
        let ambiguous = if round + 1 == ROUNDS { grabcut.ambiguous(&head, models) } else { 0.0 };
        (gray(&head, w, h), ambiguous)
    }

    /// Adds warnings about the finished masks.
    fn warn(&mut self, masks: &[Gray], ambiguous: &[f64]) {
        for (i, mask) in masks.iter().enumerate().filter(|(i, _)| !self.views[*i].clicks.is_empty()) {
            let head = mask.inside();
            let found = self.grabcut(i, false).0.warnings(self.views[i].name, &head);
            self.warnings.extend(found);
        }
        for (i, mask) in masks.iter().enumerate() {
            let view = self.views[i].name;
            // shoulders do touch the sides
            for finding in findings(mask).into_iter().filter(|f| !f.starts_with("touches")) {
                self.warnings.push(format!("the mask cut for view `{view}` {finding}"));
            }
            if ambiguous[i] > 0.05 {
                self.warnings.push(format!(
                    "view `{view}`: {:.0} % of the picture may be head or background by its color; click on both",
                    100.0 * ambiguous[i]
                ));
            }
        }
    }
}

/// Distance from the outline of a proposed mask at which definite head begins, as a share of the
/// picture's height.
const HEAD_MARGIN: f32 = 0.012;

/// Masks every view from what a network has proposed for each, at the size [`rows_size`] gives;
/// head from 128. As [`propagate`], without any click.
///
/// # Errors
/// When fewer than two of the views that may vote agree; when cameras stand or look alike; when a
/// photograph cannot be loaded or is not of its camera's size.
pub fn propagate_proposals<F>(views: &[PropagateView], proposals: &[Gray], load: F) -> Result<HardMasks>
where
    F: Fn(usize) -> Result<Photo> + Sync,
{
    let voters: Vec<ConsistencyView> = (views.iter().zip(proposals))
        .map(|(v, mask)| ConsistencyView {
            name: v.name,
            camera: v.camera,
            mask: Some(mask).filter(|_| v.votes),
        })
        .collect();
    let verdicts = verdicts(&voters)?;
    let mut propagation = Propagation::new(CELLS, BATCH_VIEWS, views, load)?;
    let start = propagation.proposed(proposals, &verdicts)?;
    Ok(propagation.run(start))
}

/// Width and height that a photograph is cut at.
pub fn rows_size(photo: &Photo) -> (u32, u32) {
    size_at_rows((photo.width, photo.height), grabcut::ROWS)
}

impl Propagation<'_> {
    /// Takes the proposed masks of the views that agree, and learns the common colors from them.
    fn proposed(&mut self, proposals: &[Gray], verdicts: &[MaskVerdict]) -> Result<StartViews> {
        let (mut inside, mut outside): (Vec<Rgb>, Vec<Rgb>) = Default::default();
        let mut heads: Vec<Option<Vec<bool>>> = vec![None; self.views.len()];
        let mut others = Vec::new();
        for (i, (mask, verdict)) in proposals.iter().zip(verdicts).enumerate() {
            let (photo, view) = (&self.photos[i], &self.views[i]);
            let (w, h) = (photo.width as usize, photo.height as usize);
            if (mask.width, mask.height) != (photo.width, photo.height) {
                return Err(Error::cannot(
                    format!(
                        "view `{}`: a mask of {} × {} pixels is proposed",
                        view.name, mask.width, mask.height
                    ),
                    format!("propose one of {w} × {h}"),
                ));
            }
            let head = mask.inside();
            // held-out views are not compared, and shape only their own masks
            if !view.votes || *verdict != MaskVerdict::Unlike {
                self.inside[i] = shrink(&head, w, h, HEAD_MARGIN * h as f32);
            }
            if *verdict != MaskVerdict::Agrees || !view.votes {
                others.extend(view.votes.then_some(view.name));
                continue;
            }
            for (color, &h) in photo.rgb.iter().zip(&head) {
                if h { inside.push(*color) } else { outside.push(*color) }
            }
            heads[i] = Some(head);
        }
        let (agree, proposed) =
            (heads.iter().flatten().count(), self.views.iter().filter(|v| v.votes).count());
        let models = self.common(inside, outside).filter(|_| agree >= 2).ok_or_else(|| {
            Error::cannot(
                format!("of the masks that the network proposes for {proposed} views only {agree} agree"),
                "try another network, see that `mask.alpha_input` is what it wants, or click: `tiface mask CAPTURE \
                 --page`",
            )
        })?;
        self.notes.push(format!(
            "{agree} of {proposed} proposed masks agree{}{}",
            if others.is_empty() { "" } else { "; made again by what those say: " },
            others.join(", ")
        ));
        let own = heads.into_iter().map(|head| Some((head?, models.clone()))).collect();
        Ok(StartViews { models, own })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DMat3, DVec3, Vec2};
    use tiface_base::geom::Distortion;
    use tiface_base::math::rng;

    pub(super) fn ring() -> Vec<Camera> {
        (0..6)
            .map(|i| {
                let rotation = DMat3::from_rotation_y(0.5 * i as f64);
                Camera {
                    width: 72,
                    height: 96,
                    fx: 240.0,
                    fy: 240.0,
                    cx: 36.0,
                    cy: 48.0,
                    distortion: Distortion::default(),
                    rotation,
                    position: rotation * DVec3::new(0.0, 0.0, 10.0),
                }
            })
            .collect()
    }

    /// Returns a ball of two colors before a dark background with lamps, and which pixels are the
    /// ball.
    pub(super) fn photo(camera: &Camera, stream: u64) -> (Photo, Vec<bool>) {
        let mut truth = Vec::new();
        let rgb = (0..72 * 96u32)
            .map(|i| {
                let ray = camera.ray(Vec2::new((i % 72) as f32 + 0.5, (i / 72) as f32 + 0.5)).unwrap();
                let near = (-camera.position).cross(ray.direction.as_dvec3()).length();
                truth.push(near < 1.0);
                let noise = (3.0 * rng::normal(1, stream, i as u64)) as i32;
                let base = match (near < 1.0, i / 72 < 40) {
                    (true, true) => [80, 55, 35],
                    (true, false) => [200, 150, 130],
                    _ if (i % 72 % 30).abs_diff(6) < 3 && (i / 72 % 30).abs_diff(6) < 3 => [210, 160, 140],
                    _ => [14, 14, 16],
                };
                base.map(|c| (c + noise).clamp(0, 255) as u8)
            })
            .collect();
        (Photo { width: 72, height: 96, rgb, alpha: None }, truth)
    }

    fn clicks() -> Vec<Click> {
        [(36.0, 60.0, true), (36.0, 34.0, true), (20.0, 16.0, false), (66.0, 80.0, false)]
            .map(|(x, y, head)| Click { x, y, head })
            .into()
    }

    fn run(clicked: &[usize]) -> Result<HardMasks> {
        let (cameras, clicks) = (ring(), clicks());
        let views: Vec<PropagateView> = (cameras.iter().enumerate())
            .map(|(i, camera)| {
                let clicks: &[Click] = if clicked.contains(&i) { &clicks } else { &[] };
                PropagateView { name: "v", camera, clicks, votes: i != 5 }
            })
            .collect();
        propagate_in(48, 2, &views, |i| Ok(photo(&cameras[i], i as u64).0))
    }

    #[test]
    fn lamps_of_the_heads_own_color_are_left_out_of_views_nobody_clicked() {
        let masks = run(&[0, 3]).unwrap();
        for (i, mask) in masks.masks.iter().enumerate() {
            let truth = photo(&ring()[i], i as u64).1;
            let wrong = mask.values.iter().zip(&truth).filter(|(m, t)| (**m > 127) != **t).count();
            // the ball covers 1800 pixels
            assert!(wrong < 40, "view {i}: {wrong} pixels are wrong");
        }
        assert_eq!(masks.warnings, Vec::<String>::new());
    }

    #[test]
    fn the_same_masks_come_from_any_number_of_threads() {
        let on = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| run(&[0, 3])).unwrap()
        };
        assert_eq!(on(1), on(3));
    }

    #[test]
    fn no_clicks_and_failing_photographs_end_with_their_error() {
        assert!(run(&[]).unwrap_err().to_string().contains("has no clicks"));
        assert!(run(&[1]).unwrap().warnings.iter().any(|w| w.contains("only one view")));
        let (cameras, clicks) = (ring(), clicks());
        let views =
            cameras.iter().map(|camera| PropagateView { name: "v", camera, clicks: &clicks, votes: true });
        let views: Vec<PropagateView> = views.collect();
        let small = |_| Ok(Photo { width: 20, height: 20, rgb: vec![[0; 3]; 400], alpha: None });
        let e = propagate(&views, small).unwrap_err();
        assert!(e.to_string().contains("the photograph is 20 × 20 pixels, its camera 72 × 96"), "{e}");
        let gone = grabcut::empty("gone");
        assert_eq!(propagate(&views, |_| Err(gone.clone())), Err(gone.clone()));
    }

    #[test]
    fn proposals_that_leave_a_color_out_are_made_whole_by_those_that_do_not() {
        let cameras = ring();
        let views: Vec<PropagateView> = (cameras.iter().enumerate())
            .map(|(i, camera)| PropagateView { name: "v", camera, clicks: &[], votes: i != 5 })
            .collect();
        let truth: Vec<Vec<bool>> = (0..6).map(|i| photo(&cameras[i], i as u64).1).collect();
        // two views, and a held-out one, lack the upper color
        let proposals: Vec<Gray> = (0..6)
            .map(|i| {
                let least = if [1, 4, 5].contains(&i) { 40 * 72 } else { 0 };
                let values = truth[i].iter().enumerate().map(|(p, &t)| 255 * (t && p >= least) as u8);
                Gray { width: 72, height: 96, values: values.collect() }
            })
            .collect();
        let load = |i: usize| Ok(photo(&cameras[i], i as u64).0);
        let found = propagate_proposals(&views, &proposals, load).unwrap();
        assert_eq!(found.notes, ["3 of 5 proposed masks agree; made again by what those say: v, v"]);
        for (i, mask) in found.masks.iter().enumerate() {
            let wrong = mask.values.iter().zip(&truth[i]).filter(|(m, t)| (**m > 127) != **t).count();
            assert!(wrong < 40, "view {i}: {wrong} pixels are wrong");
        }
        let nothing = vec![Gray { width: 72, height: 96, values: vec![0; 72 * 96] }; 6];
        let e = propagate_proposals(&views, &nothing, load).unwrap_err();
        assert!(e.to_string().contains("only 0 agree"), "{e}");
    }
}
