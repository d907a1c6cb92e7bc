//! A mask that a network proposes for every view → a mask for every view.
//!
//! Those that agree ([`agreement`](crate::mask::agreement)) stand for the clicked ones: they teach the colors and carve the hull.
//! What lies well inside a proposal that is not unlike the others is definite head.

use super::{AT_ONCE, CELLS, HardMasks, PropagateView, Propagation, StartViews};
use crate::image::{Gray, Photo};
use crate::mask::agreement::{Belief, beliefs};
use crate::mask::consistency::ConsistencyView;
use crate::mask::distance::shrink;
use crate::mask::grabcut;
use crate::mask::grabcut::mixture::Rgb;
use crate::{Error, Result};

/// How far inside a proposed mask definite head begins, share of the picture's height.
const INSIDE: f32 = 0.012;

/// Masks every view from what a network has proposed for each, at the size [`rows_size`] gives; head from 128. As
/// [`propagate`](super::propagate), without any click.
///
/// # Errors
/// When fewer than two of the views that may vote agree; when cameras stand or look alike; when a photograph cannot be loaded
/// or is not of its camera's size.
pub fn propagate_proposals<F>(views: &[PropagateView], proposals: &[Gray], load: F) -> Result<HardMasks>
where
    F: Fn(usize) -> Result<Photo> + Sync,
{
    let asked: Vec<ConsistencyView> = (views.iter().zip(proposals))
        .map(|(v, mask)| ConsistencyView {
            name: v.name,
            camera: v.camera,
            mask: Some(mask).filter(|_| v.votes),
        })
        .collect();
    let beliefs = beliefs(&asked)?;
    let mut propagation = Propagation::new(CELLS, AT_ONCE, views, load)?;
    let start = propagation.proposed(proposals, &beliefs)?;
    Ok(propagation.run(start))
}

/// Width and height that a photograph is cut at.
pub fn rows_size(photo: &Photo) -> (u32, u32) {
    match photo.height {
        h if h <= grabcut::ROWS => (photo.width, h),
        h => ((photo.width as f64 * grabcut::ROWS as f64 / h as f64).round().max(1.0) as u32, grabcut::ROWS),
    }
}

impl Propagation<'_> {
    /// Takes the proposed masks of the views that agree, and learns the common colors from them.
    fn proposed(&mut self, proposals: &[Gray], beliefs: &[Belief]) -> Result<StartViews> {
        let (mut inside, mut outside): (Vec<Rgb>, Vec<Rgb>) = Default::default();
        let mut heads: Vec<Option<Vec<bool>>> = vec![None; self.views.len()];
        let mut others = Vec::new();
        for (i, (mask, belief)) in proposals.iter().zip(beliefs).enumerate() {
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
            let head: Vec<bool> = mask.values.iter().map(|&v| v > 127).collect();
            // nobody judged a held-out view, and only its own mask comes from it
            if !view.votes || *belief != Belief::Unlike {
                self.inside[i] = shrink(&head, w, h, INSIDE * h as f32);
            }
            if *belief != Belief::Agrees || !view.votes {
                others.extend(view.votes.then_some(view.name));
                continue;
            }
            for (color, &h) in photo.rgb.iter().zip(&head) {
                if h { inside.push(*color) } else { outside.push(*color) }
            }
            heads[i] = Some(head);
        }
        let (agree, asked) = (heads.iter().flatten().count(), self.views.iter().filter(|v| v.votes).count());
        let models = self.common(inside, outside).filter(|_| agree >= 2).ok_or_else(|| {
            Error::cannot(
                format!("of the masks that the network proposes for {asked} views only {agree} agree"),
                "try another network, see that `mask.alpha_input` is what it wants, or click: `tiface mask CAPTURE \
                 --page`",
            )
        })?;
        self.notes.push(format!(
            "{agree} of {asked} proposed masks agree{}{}",
            if others.is_empty() { "" } else { "; made again by what those say: " },
            others.join(", ")
        ));
        let own = heads.into_iter().map(|head| Some((head?, models.clone()))).collect();
        Ok(StartViews { models, own })
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{photo, ring};
    use super::*;

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
