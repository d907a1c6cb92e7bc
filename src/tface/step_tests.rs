//! A whole optimizer step against the same arithmetic in f64: sampling, field, compositing, every
//! loss term and the groups of Adam, parameter by parameter, for every row of the paper's table;
//! and the terms on numbers worked by hand.

use super::super::ops::mask_term;
use super::*;
use crate::config::{DensityActivation, MaskLoss, Preset, VmBackground};
use crate::field::ball::views;
use crate::field::parameters::HostGroup;
use crate::field::testing::{session, temporary};
use crate::reference::tape::{AdamW, Stepped, Var, gradient};
use crate::reference::{Real, vm, wide};
use std::path::Path;
use tiface_base::Quiet;
use tiface_base::math::rng;
use tiface_kernels::cpu::vm::Grid;
use tiface_kernels::cpu::vm::losses::{Targets, of_rays};

const BOX: [[f32; 3]; 2] = [[-0.8, -0.7, -0.75], [0.8, 0.7, 0.75]];

/// As published, but for the sizes.
fn paper() -> VmConfig {
    VmConfig {
        rays: 40,
        voxels_start: 6 * 6 * 6,
        voxels_final: 9 * 9 * 9,
        density_rank: vec![3, 2, 1],
        color_rank: vec![4, 2, 3],
        features: 6,
        hidden: 8,
        // the published weight would hardly be seen beside the color's
        mask_weight: 0.1,
        ..VmConfig::preset(Preset::Paper)
    }
    .placed(BOX)
}

fn model<'a>(config: &'a VmConfig, sampler: &'a RaySampler<'a>, dir: &'a Path) -> VmModel<'a, CpuVm<'a>> {
    let session = session("tface", dir, "step", &Quiet);
    let state = VmState::new(config, session.seed, BOX, None);
    let mut model = VmModel::new(CpuVm::new(config, sampler), state, config, &session);
    model.load();
    model
}

/// 2 (Σ (∂_h x)² / (C (H − 1) W) + Σ (∂_w x)² / (C H (W − 1))) of all planes.
fn total_variation(grid: &Grid, x: &[Var]) -> Var {
    let mut sum = Var::of(0.0);
    for i in 0..3 {
        let f = grid.plane(i);
        let (h, w, c) = (f.height, f.width, f.channels);
        let at = |y: usize, x_: usize, k: usize| x[f.start + (y * w + x_) * c + k];
        let (mut down, mut right) = (Var::of(0.0), Var::of(0.0));
        for (y, x_, k) in (0..h).flat_map(|y| (0..w).flat_map(move |x| (0..c).map(move |k| (y, x, k)))) {
            let square = |d: Var| d * d;
            if y > 0 {
                down += square(at(y, x_, k) - at(y - 1, x_, k));
            }
            if x_ > 0 {
                right += square(at(y, x_, k) - at(y, x_ - 1, k));
            }
        }
        sum += (down / Var::of((c * (h - 1) * w) as f64) + right / Var::of((c * h * (w - 1)) as f64))
            * Var::of(2.0);
    }
    sum
}

/// Color loss, mask loss and all together, by the formulas.
fn formulas((config, sampler, state): (&VmConfig, &RaySampler, &VmState), x: &[Var], step: u64) -> [Var; 3] {
    let of = Var::of;
    let seed = 3; // of the session
    let field = state.field(config, true);
    let batch = sampler.draw(seed, step, config.rays, true, 0.0);
    let out = vm::render(&field, x, &batch.rays, &batch.jitter);
    let n = batch.rays.len();
    let white = config.background == VmBackground::Reference && rng::uniform(seed, step << 4 | 9, 0) < 0.5;
    let (mut squares, mut outside, mut cross, mut count) = (of(0.0), of(0.0), of(0.0), 0.0);
    for (r, out) in out.chunks(5).enumerate() {
        let open = of(1.0) - out[3];
        for c in 0..3 {
            let behind = match config.background {
                VmBackground::Random => f64::from(rng::uniform(seed, step << 4 | 8, (3 * r + c) as u64)),
                _ => f64::from(white),
            };
            // the published flip changes what is rendered, never what is asked for
            let shown = if config.background == VmBackground::Random { behind } else { 0.0 };
            let target = f64::from(batch.color[r][c]) + (1.0 - f64::from(batch.alpha[r])) * shown;
            let e = (out[c] + open * of(behind)).within(0.0, 1.0) - of(target);
            squares += e * e;
        }
        let head = f64::from(batch.alpha[r] > 0.0);
        outside += out[3] * out[3] * of(1.0 - head);
        count += 1.0 - head;
        let p = out[3].within(1e-3, 1.0 - 1e-3);
        cross += -(of(head) * p.ln() + of(1.0 - head) * (of(1.0) - p).ln());
    }
    let rgb = squares / of(3.0 * n as f64);
    let mask = match config.mask_loss {
        _ if !sampler.has_masks => of(0.0),
        MaskLoss::None => of(0.0),
        MaskLoss::L2 => outside / of(count),
        MaskLoss::Ce => cross / of(n as f64),
    };
    // both weights fade by the same factor before every use
    let fade = 0.1f64.powf((step + 1) as f64 / config.steps as f64);
    let (density, color) = (&x[..field.density.len()], &x[field.density.len()..][..field.color.len()]);
    let total = rgb
        + mask * of(config.mask_weight)
        + total_variation(&field.density, density) * of(0.01 * config.tv_density * fade)
        + total_variation(&field.color, color) * of(0.01 * config.tv_color * fade);
    [rgb, mask, total]
}

/// The third step, as it is by the formulas?
fn agrees(config: &VmConfig) {
    let dir = temporary();
    let views = masked_as_configured(views(), config.masks);
    let sampler = RaySampler::permuted(&views, config.foreground, BOX, config.depth_directions);
    let mut model = model(config, &sampler, dir.path());
    let seed = model.session.seed;
    let progress = |step: u64| TrainingProgress { step, ..TrainingProgress::default() };
    for step in 0..2 {
        assert!(training::step(&mut model, seed, &progress(step), true).is_ok());
    }
    let kept = |model: &VmModel<CpuVm>| model.state().ok().unwrap().groups.map(|group| group.state);
    let before = kept(&model);
    let x: Vec<f64> = before.iter().flat_map(|[v, ..]| wide(v)).collect();
    let mut terms = [0.0; 2];
    let (_, slopes) = gradient(&x, |x| {
        let [rgb, mask, total] = formulas((config, &sampler, &model.state), x, 2);
        terms = [rgb.value(), mask.value()];
        total
    });
    let Ok(Some(report)) = training::step(&mut model, seed, &progress(2), true) else {
        panic!("a finite step")
    };
    for ((name, got), want) in report.figures.iter().zip(terms) {
        assert!((got - want).abs() <= 1e-5 * want.abs(), "{name}: {got} {want}");
    }
    let after = kept(&model);
    let factor = 0.1f64.powf(2.0 / config.steps as f64);
    let mut start = 0;
    for (i, (before, after)) in before.iter().zip(&after).enumerate() {
        let own = &slopes[start..start + before[0].len()];
        start += own.len();
        let lr = if i < 2 { config.lr_grid } else { config.lr_network };
        let step = AdamW { lr: lr * factor, epsilon: 1e-8, decay: 0.0, step: 3 };
        let [value, first, second] = before.each_ref().map(|v| wide(v));
        let array =
            Stepped { value, moments: [first, second], after: wide(&after[0]), first_after: wide(&after[1]) };
        let mut errors = step.errors(&array, own);
        errors.sort_by(f64::total_cmp);
        let (median, worst) = (errors[errors.len() / 2], errors[errors.len() - 1]);
        let what = format!("{:?} {:?} {:?}", config.masks, config.mask_loss, config.background);
        println!("{what}: {} of array {i}: median {median:.1e}, worst {worst:.1e}", errors.len());
        assert!(worst <= 1e-3 && median <= 1e-5, "{what}, array {i}: median {median:.1e}, worst {worst:.1e}");
    }
}

#[test]
fn a_step_of_every_row_of_the_table_is_the_one_of_its_formulas() {
    for (masks, mask_loss) in [
        (MaskUse::None, MaskLoss::None),
        (MaskUse::Hard, MaskLoss::None),
        (MaskUse::Binary, MaskLoss::None),
        (MaskUse::Binary, MaskLoss::Ce),
        (MaskUse::Binary, MaskLoss::L2),
    ] {
        agrees(&VmConfig { masks, mask_loss, ..paper() });
        let background = if masks == MaskUse::None { VmBackground::Black } else { VmBackground::Random };
        agrees(&VmConfig { masks, mask_loss, background, ..paper() });
    }
}

#[test]
fn a_step_with_softplus_and_encodings_is_the_one_of_its_formulas() {
    agrees(&VmConfig {
        activation: DensityActivation::Softplus,
        density_shift: -1.0,
        feature_frequencies: 1,
        view_frequencies: 2,
        masks: MaskUse::Soft,
        background: VmBackground::Random,
        ..paper()
    });
}

/// Color and mask losses of three rays, half seen on head, background of which 0.6 and 0.2 are
/// collected.
fn losses_of(config: &VmConfig, step: u64) -> (f32, f32) {
    let composed = [
        0.3, 0.2, 0.1, 0.5, 0.0, //
        0.1, 0.1, 0.1, 0.6, 0.0, //
        0.0, 0.0, 0.0, 0.2, 0.0,
    ];
    let views = views();
    let sampler = RaySampler::permuted(&views, config.foreground, BOX, false);
    let random = config.background == VmBackground::Random;
    let behind = |r: u64| std::array::from_fn(|c| rng::uniform(3, step << 4 | 8, 3 * r + c as u64));
    let background = [0, 1, 2].map(|r| if random { behind(r) } else { [0.0; 3] });
    let color = [[0.4, 0.2, 0.3], [0.0; 3], [0.0; 3]];
    let targets = Targets { color: &color, alpha: &[1.0, 0.0, 0.0], background: &background };
    let mode = background_mode(config, StepAt { seed: 3, step });
    let ([rgb, mask, outside], _) = of_rays(&composed, targets, mode, mask_term(config, &sampler));
    // (0.36 + 0.04) / 2, whatever the loss
    assert!((outside - 0.2).abs() < 1e-6);
    (rgb, mask)
}

#[test]
fn the_terms_are_those_worked_by_hand() {
    let is = |found: f32, want: f64| assert!((f64::from(found) - want).abs() < 1e-6, "{found} {want}");
    let with = |mask_loss, background| VmConfig { mask_loss, background, ..paper() };
    // over black: 0.1² + 0 + 0.2² on the head, 3 · 0.1² and nothing beside it, of nine
    let (rgb, mask) = losses_of(&with(MaskLoss::L2, VmBackground::Black), 0);
    is(rgb, (0.01 + 0.04 + 0.03) / 9.0);
    // (0.6² + 0.2²) / 2
    is(mask, 0.2);
    // −(ln 0.5 + ln 0.4 + ln 0.8) / 3
    let (_, mask) = losses_of(&with(MaskLoss::Ce, VmBackground::Black), 0);
    is(mask, -(0.5f64 * 0.4 * 0.8).ln() / 3.0);
    assert_eq!(losses_of(&with(MaskLoss::None, VmBackground::Black), 0).1, 0.0);
    // over white against a black target: 0.8, 0.7, 0.6 for 0.4, 0.2, 0.3; 0.5 and 0.8 thrice for
    // nothing
    let white = (0.16 + 0.25 + 0.09 + 3.0 * 0.25 + 3.0 * 0.64) / 9.0;
    let step_of =
        |is_white: bool| (0..).find(|s| (rng::uniform(3, s << 4 | 9, 0) < 0.5) == is_white).unwrap();
    is(losses_of(&with(MaskLoss::None, VmBackground::Reference), step_of(true)).0, white);
    is(losses_of(&with(MaskLoss::None, VmBackground::Reference), step_of(false)).0, 0.08 / 9.0);
    // one random color behind both: what is collected beside the head hides it, what is missing
    // lets it through
    let step = 5;
    let behind = |i: u64| f64::from(rng::uniform(3, step << 4 | 8, i));
    let (color, open, target) = ([0.3, 0.2, 0.1], [0.5, 0.4, 0.8], [0.4, 0.2, 0.3]);
    let error = |i: usize| {
        let (r, b) = (i / 3, behind(i as u64));
        let (own, wanted) = [(color[i % 3], target[i % 3]), (0.1, b), (0.0, b)][r];
        ((own + open[r] * b).clamp(0.0, 1.0) - wanted).powi(2)
    };
    let wanted = (0..9).map(error).sum::<f64>() / 9.0;
    is(losses_of(&with(MaskLoss::None, VmBackground::Random), step).0, wanted);
}

#[test]
fn the_published_background_is_white_in_half_of_the_batches() {
    let white = (0..10_000u64).filter(|step| rng::uniform(3, step << 4 | 9, 0) < 0.5).count();
    assert!((4850..5150).contains(&white), "{white}");
    // and of single steps the loss says which: 0.08 / 9 or 3.17 / 9
    let config = VmConfig { mask_loss: MaskLoss::None, ..paper() };
    assert_eq!(config.background, VmBackground::Reference);
    for step in 0..6 {
        let rgb = losses_of(&config, step).0;
        assert_eq!(rgb > 0.1, rng::uniform(3, step << 4 | 9, 0) < 0.5, "step {step}: {rgb}");
    }
}

#[test]
fn the_alpha_mask_looks_at_steps_of_the_published_world() {
    // box of half 0.8 for 1.67: 1 − exp(−σ step / unit) ≥ 1e-4. Density of one value everywhere:
    // 0.1 · 0.1 · 6 channels
    let config = VmConfig { mask_at: vec![0.0], ..paper() };
    let (dir, views) = (temporary(), views());
    let sampler = RaySampler::permuted(&views, config.foreground, BOX, true);
    let unit = 0.8 / 1.67;
    assert!((config.alpha_unit - unit).abs() < 1e-6 && (config.distance_scale - 25.0 / unit).abs() < 1e-4);
    let mut state = model(&config, &sampler, dir.path()).state;
    let field = state.field(&config, false);
    let step = f64::from(field.lattice.step) / unit;
    // Σ of plane · line over 6 channels at the threshold
    let sigma = -(1.0f64 - 1e-4).ln() / step;
    for (share, kept) in [(1.001, true), (0.999, false)] {
        let value = (share * sigma / 6.0).sqrt() as f32;
        state = VmState::new(&config, 3, BOX, None);
        state.groups[0] = HostGroup::flat("density", vec![value; field.density.len()]);
        assert_eq!(update_mask(&mut state, &config, 1), kept, "{share}");
    }
}
