//! Schedules of a training: learning rate, rays per step, active levels, march step.

use crate::config::iface::{IfaceConfig, OccupancyRule};
use tiface_kernels::cpu::adam::AdamStep;
use tiface_kernels::cpu::schedule::{RayBudget, StepLength};

/// Returns a share of the steps as a number of steps, at least one.
fn steps(config: &IfaceConfig, share: f64) -> u64 {
    ((config.steps as f64 * share).round() as u64).max(1)
}

/// Learning-rate factor at optimizer step `n`: linear from 1 % over `warmup`, then exponential down
/// to `lr_final` at `steps`.
pub fn learning_rate(config: &IfaceConfig, n: u64) -> f64 {
    let (n, warmup, steps) = (n as f64, steps(config, config.warmup) as f64, config.steps as f64);
    if n < warmup {
        0.01 + 0.99 * n / warmup
    } else {
        config.lr_final.powf((n - warmup) / (steps - warmup).max(1.0))
    }
}

/// Returns the AdamW parameters of the three groups at step number `step`, counted from 1, with
/// learning rates at `factor` of their peak.
pub fn adam_steps(config: &IfaceConfig, factor: f64, step: u64) -> [AdamStep; 3] {
    let rate = |lr: f64, decay: f64| AdamStep {
        weight_decay: decay as f32,
        ..AdamStep::new(lr * factor, 1e-15, step)
    };
    let table = rate(config.lr_table, config.table_decay);
    let [network, variance] = [config.lr_network, config.lr_variance].map(|lr| rate(lr, config.weight_decay));
    [AdamStep { skip_zero: config.touched_rows, ..table }, network, variance]
}

/// Returns the rule by which the number of rays adapts to the samples of the previous step.
pub fn ray_budget(config: &IfaceConfig) -> RayBudget {
    let min = if config.occupancy == OccupancyRule::Band { 64 } else { 1 };
    RayBudget { samples: config.samples, min, max: config.max_rays }
}

/// Returns the number of active hash levels at a step.
pub fn active_levels(config: &IfaceConfig, step: u64) -> usize {
    let added = config.levels.saturating_sub(config.start_levels);
    // the share of all levels that is due, of `added` equal intervals
    let due = (step * added as u64).checked_div((config.steps as f64 * config.all_levels).round() as u64);
    config.levels.min(config.start_levels + due.map_or(added, |due| due as usize))
}

/// Returns the cell width of the finest of `levels` levels, scene units.
pub fn cell(config: &IfaceConfig, levels: usize) -> f32 {
    (2.0 / (config.base_resolution as f64 * config.growth.powi(levels as i32 - 1))) as f32
}

/// Returns the width that a ray of a large photograph stands for at a step, scene units: the cell
/// width of the finest active level, or a single pixel (0) in the second half of the training.
pub fn detail(config: &IfaceConfig, step: u64) -> f32 {
    if 2 * step < config.steps { cell(config, active_levels(config, step)) } else { 0.0 }
}

/// Returns the share of the hard cosine in the alpha at a step: 0 → 1 over `anneal_end`.
pub fn anneal(config: &IfaceConfig, step: u64) -> f32 {
    (step as f32 / steps(config, config.anneal_end) as f32).min(1.0)
}

/// Returns the step at which stereo points are searched, or `None` if their loss has no weight.
pub fn stereo_step(config: &IfaceConfig) -> Option<u64> {
    (config.stereo > 0.0).then_some((config.steps as f64 * config.stereo_at) as u64)
}

/// Returns the rule for the length of march steps.
pub fn step_length(config: &IfaceConfig) -> StepLength {
    match config.occupancy {
        // nerfacc's constant 1.732 where √3 is meant, kept for the published step length
        OccupancyRule::Nerfacc => {
            StepLength::Constant(1.732 * 2.0 * config.radius / config.samples_per_ray as f32)
        }
        OccupancyRule::Band => {
            StepLength::OfSharpness { units: config.march, min: config.min_step, max: config.max_step }
        }
    }
}

/// Returns whether the occupancy is updated before this step. A new level, and the end of the
/// hull's fit, move the surface, so the update of the `band` rule follows at once.
pub fn updates_occupancy(config: &IfaceConfig, step: u64) -> bool {
    /// As published.
    const NERFACC_EVERY: u64 = 16;
    match config.occupancy {
        OccupancyRule::Nerfacc => step.is_multiple_of(NERFACC_EVERY),
        OccupancyRule::Band => {
            let level_came = active_levels(config, step) != active_levels(config, step.saturating_sub(1));
            level_came || step.is_multiple_of(steps(config, config.occupancy_every))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Preset;

    #[test]
    fn learning_rates_match_the_published_schedule() {
        let config = IfaceConfig::preset(Preset::Paper);
        for (n, want) in [
            (0, 1e-4),
            (1, 1.198e-4),
            (250, 0.00505),
            (499, 0.0099802),
            (500, 0.01),
            (501, 0.0099988193),
            (10_000, 0.0032570207),
            (19_999, 0.0010001181),
        ] {
            let got = config.lr_network * learning_rate(&config, n);
            assert!((got - want).abs() < 1e-7 * want.max(1e-3), "{n}: {got} {want}");
        }
    }

    #[test]
    fn a_schedule_keeps_its_shape_for_any_number_of_steps() {
        let [few, many] =
            [400, 4000].map(|steps| IfaceConfig { steps, ..IfaceConfig::preset(Preset::Draft) });
        for step in (0..400).filter(|step| step % 5 == 0) {
            assert_eq!(active_levels(&few, step), active_levels(&many, 10 * step), "{step}");
            assert!((anneal(&few, step) - anneal(&many, 10 * step)).abs() < 1e-6, "{step}");
            assert!((learning_rate(&few, step) - learning_rate(&many, 10 * step)).abs() < 1e-9, "{step}");
        }
        // at each of the eight levels that are added, and every 32 or 320 steps
        let updates =
            |config: &IfaceConfig| (0..config.steps).filter(|&s| updates_occupancy(config, s)).count();
        assert_eq!((updates(&few), updates(&many)), (8 + 13, 8 + 13));
        let one = IfaceConfig { steps: 1, ..few };
        assert!(updates_occupancy(&one, 0) && learning_rate(&one, 0) > 0.0 && anneal(&one, 0) == 0.0);
    }

    #[test]
    fn rays_stand_for_less_as_levels_come_and_for_a_pixel_in_the_second_half() {
        let config = IfaceConfig { steps: 3200, ..IfaceConfig::preset(Preset::Draft) };
        // all fourteen levels after a quarter of the steps, eight of them in intervals of a
        // hundred; cells of the level with 16 · 1.4⁵ = 86.05 of them on a side of 2, then 120.5;
        // the finest has 1269.7
        for (step, want) in
            [(0, 0.023_242), (99, 0.023_242), (100, 0.016_602), (1599, 0.001_575_2), (1600, 0.0)]
        {
            assert!((detail(&config, step) - want).abs() < 1e-6, "{step}: {}", detail(&config, step));
        }
        assert!((cell(&config, config.levels) - 0.001_575_2).abs() < 1e-6);
    }
}
