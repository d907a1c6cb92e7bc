//! From clicks to masks.

use super::{Bench, meter, sweep};
use crate::capture::Split;
use crate::config::{CutMethod, MaskConfig, MattingMethod};
use crate::image::Gray;
use crate::io::Limits;
use crate::mask::Click;
use crate::pipeline::clicks::{MaskPrompts, make_masks, propagated_clicks};
use crate::report::bench::{Measure, Row, Sweep};
use crate::run::{Fingerprint, Plan};
use crate::{Error, Result};
use rayon::prelude::*;
use serde_json::Value;
use std::collections::BTreeMap;

/// Photographs that are clicked on.
const CLICKED: usize = 3;

impl Bench<'_> {
    /// Masks from the same clicks, against the capture's own; `None` where it has none.
    pub(super) fn masks(&self) -> Result<Option<Sweep>> {
        let capture = &self.line.capture;
        let truth: Vec<Option<Gray>> = capture
            .views
            .par_iter()
            .map(|v| self.line.judged(v).load_mask(&Limits::default()))
            .collect::<Result<_>>()?;
        if self.line.judges() != "capture" || truth.iter().any(Option::is_none) {
            return Ok(None);
        }
        let truth: Vec<Gray> = truth.into_iter().flatten().collect();
        let trained: Vec<usize> =
            (0..truth.len()).filter(|&i| capture.views[i].split == Split::Train).collect();
        let clicked: Vec<usize> = (0..CLICKED.min(trained.len()))
            .map(|k| trained[(2 * k + 1) * trained.len() / (2 * CLICKED)])
            .collect();
        let of = |(i, mask): (usize, &Gray)| -> Vec<Click> {
            let size = (mask.width, mask.height);
            if clicked.contains(&i) { propagated_clicks(mask, size) } else { Vec::new() }
        };
        let clicks: Vec<Vec<Click>> = truth.iter().enumerate().map(of).collect();
        let count: usize = clicks.iter().map(Vec::len).sum();
        let note = format!(
            "From {count} clicks on {} photographs, carried to all {}; the clicks lie deep inside and outside the \
             capture's own masks, which the results are compared with. A time is that of one view.",
            clicked.len(),
            truth.len()
        );
        let measures = vec![Measure::more("mean IoU", 4, 0.002), Measure::more("worst IoU", 4, 0.005)];
        let mut sweep = sweep("masks", "Masks", note, measures);
        let own = &self.config().mask;
        let built_in = MaskConfig { cut: CutMethod::Grabcut, matting: MattingMethod::Closed, ..own.clone() };
        let mut choices = vec![
            ("hard", MaskConfig { band: 0.0, kernel: 0, ..built_in.clone() }),
            ("closed form", built_in.clone()),
            ("closed form, band twice as wide", MaskConfig { band: 2.0 * built_in.band, ..built_in.clone() }),
        ];
        if own.with_sam() || own.with_vitmatte() {
            choices.push(("networks", own.clone()));
        }
        for (word, config) in choices {
            self.check_stop()?;
            let prompts = MaskPrompts { clicks: clicks.clone(), file: Vec::new(), inputs: Vec::new() };
            let name = format!("masks-{}", sweep.rows.len());
            let fingerprint = Fingerprint::new(1, BTreeMap::new());
            let plan = Plan { name: &name, fingerprint, device: "cpu", needs_bytes: 0, saves: false };
            let mut measured = None;
            self.line.run.stage(plan, |dir| {
                let mut found: Vec<Gray> = Vec::new();
                let m = meter::once(|| {
                    make_masks(capture, &prompts, &config, dir, &mut |_, _, mask| {
                        found.push(mask.alpha);
                        Ok(())
                    })
                });
                let m = m.whole()?;
                measured = Some((found, m.row("", word, truth.len(), Vec::new())));
                Ok(Value::Null)
            })?;
            let Some((found, row)) = measured else {
                return Err(Error::cannot("these masks were made before", ""));
            };
            let shares: Vec<f64> = found.iter().zip(&truth).map(|(a, b)| iou(a, b)).collect();
            let mean = shares.iter().sum::<f64>() / shares.len().max(1) as f64;
            let figures = vec![Some(mean), shares.iter().copied().reduce(f64::min)];
            sweep.rows.push(Row { figures, ..row });
        }
        Ok(Some(sweep))
    }
}

/// Intersection over union of soft masks: Σ min / Σ max; 1 where both are empty.
fn iou(a: &Gray, b: &Gray) -> f64 {
    let sum = |of: fn(u8, u8) -> u8| {
        a.values.iter().zip(&b.values).map(|(&a, &b)| u64::from(of(a, b))).sum::<u64>()
    };
    let (both, either) = (sum(std::cmp::min), sum(std::cmp::max));
    if either == 0 { 1.0 } else { both as f64 / either as f64 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn soft_masks_overlap_by_their_least_over_their_most() {
        let gray = |values: [u8; 3]| Gray { width: 3, height: 1, values: values.to_vec() };
        // (0 + 100 + 200) / (50 + 100 + 250)
        assert_eq!(iou(&gray([0, 100, 200]), &gray([50, 100, 250])), 300.0 / 400.0);
        assert_eq!(iou(&gray([0; 3]), &gray([0; 3])), 1.0);
    }
}
