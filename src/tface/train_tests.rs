//! Training on an analytic ball: does it learn, resume, guard and stop?

use super::*;
use crate::config::{DensityActivation, Preset};
use crate::field::ball::{BALL, hull, views};
use crate::field::checkpoint;
use crate::field::testing::{
    StopAfter, bytes, negative, refuses, resumes, says, session, tampered, temporary, words,
};
use crate::tface::{TFace, train};
use glam::{Vec2, Vec3};
use std::path::Path;
use tiface_base::geom::Aabb;
use tiface_base::{Monitor, Quiet};
use tiface_kernels::cpu::vm::size_for;

const BOX: Aabb = Aabb { min: Vec3::splat(-0.8), max: Vec3::splat(0.8) };

fn config() -> VmConfig {
    VmConfig {
        steps: 150,
        rays: 512,
        voxels_start: 16 * 16 * 16,
        voxels_final: 28 * 28 * 28,
        upsample_at: vec![0.267, 0.467],
        mask_at: vec![0.267, 0.6],
        density_rank: vec![8, 8, 8],
        color_rank: vec![8, 4, 9],
        hidden: 32,
        ..VmConfig::preset(Preset::Draft)
    }
}

fn run(config: &VmConfig, dir: &Path, monitor: &dyn Monitor) -> Result<TfaceReport> {
    train(views(), BOX, Some(&hull()), config, &session("baseline", dir, "ball", monitor))
}

#[test]
fn a_ball_is_learned_from_eight_views() {
    let dir = temporary();
    let report = run(&config(), dir.path(), &Quiet).unwrap();
    let face = TFace::load("tface", dir.path()).unwrap();
    assert!(report.train_psnr > 20.0, "{report:?}");
    // color is evaluated of a part of the densities, and those of a part of the lattice
    assert!(report.color_samples < report.density_samples && report.density_samples < report.lattice_samples);
    // the box has shrunk around a ball of 0.6 and its first guesses are finer now
    assert!(report.size.iter().all(|n| (24..40).contains(n)), "{report:?}");
    let camera = views().remove(0).camera;
    let ray = camera.ray(Vec2::new(20.0, 12.0)).unwrap();
    let seen = face.render(&[ray], camera.forward())[0];
    assert!(seen.opacity > 0.9 && seen.color[0] > seen.color[1], "{seen:?}");
    // the ray of the middle meets the ball at 3 − 0.6
    let middle = face.render(&[camera.ray(Vec2::new(20.0, 21.0)).unwrap()], camera.forward())[0];
    assert!((middle.depth - (3.0 - BALL)).abs() < 0.1, "{middle:?}");
    // nothing beside it
    let beside = face.render(&[camera.ray(Vec2::new(2.0, 20.0)).unwrap()], camera.forward())[0];
    assert!(beside.opacity < 0.05, "{beside:?}");
}

#[test]
fn stopping_and_going_on_gives_the_bytes_of_an_undisturbed_run() {
    // two upsamplings, two masks and the shrinking box lie before, between and after the stops
    let (upsample_at, mask_at) = (vec![0.17, 0.42], vec![0.17, 0.5]);
    let config = VmConfig { steps: 60, rays: 128, upsample_at, mask_at, ..config() };
    resumes(&|dir, monitor| run(&config, dir, monitor).map(|r| r.warnings), 5);
}

#[test]
fn rays_and_samples_of_a_training_that_was_stopped_are_those_of_all_its_steps() {
    let config = VmConfig { steps: 12, upsample_at: vec![0.5], mask_at: vec![0.5], ..config() };
    let whole = temporary();
    let want = run(&config, whole.path(), &Quiet).unwrap().counts();
    assert!(want.iter().all(|&n| n > 0), "{want:?}");
    // killed when all steps were saved, but not yet recorded
    assert_eq!(run(&config, whole.path(), &Quiet).unwrap().counts(), want);
    let stopped = temporary();
    assert!(run(&config, stopped.path(), &StopAfter::new(5)).is_err());
    assert_eq!(run(&config, stopped.path(), &Quiet).unwrap().counts(), want);
    // checkpoints of earlier versions have no counts
    tampered(stopped.path(), |(_, metadata)| drop(metadata.remove("rays")));
    assert_eq!(run(&config, stopped.path(), &Quiet).unwrap().rays, 0);
}

#[test]
fn a_hostile_checkpoint_is_named_and_the_one_before_it_is_taken() {
    let config = VmConfig { steps: 9, upsample_at: vec![0.55], mask_at: vec![0.55], ..config() };
    let infinite = f64::INFINITY.to_bits().to_string();
    refuses(
        &|dir, monitor| run(&config, dir, monitor).map(|r| r.warnings),
        3,
        "baseline",
        &[
            ("`step`", &says("step", "18446744073709551615")),
            ("`mean_square`", &says("mean_square", &infinite)),
            ("`reset`", &says("reset", "7")),
            ("`moments_from`", &says("moments_from", "18446744073709551615")),
            ("second.color", &negative("second.color")),
            ("`masked`", &says("masked", "2")),
            ("`rays`", &says("rays", "18446744073709551615")),
            // compared with what the file holds before anything of that size is reserved
            ("`model.density` has shape", &words("size", [1 << 16; 3])),
            ("`size`", &words("size", [1, 8, 8])),
            ("`salt`", &says("salt", "9")),
            // it would go on without moments
            ("`step`", &says("finished", "1")),
        ],
    );
}

#[test]
fn a_hostile_description_of_a_field_is_refused_before_it_is_rendered() {
    let dir = temporary();
    run(&VmConfig { steps: 2, ..config() }, dir.path(), &Quiet).unwrap();
    let whole = bytes(dir.path());
    for (key, value) in [
        ("density_rank", "[18446744073709551615,1,1]"),
        ("color_rank", "[0,0,0]"),
        ("features", "18446744073709551615"),
        ("hidden", "0"),
        ("step_ratio", "0.0"),
        ("stop", "1e300"),
        ("mask_threshold", "1e300"),
        ("near", "7.0e6"),
        ("placement", r#"{"scale":0.0,"offset":[0,0,0],"depth_directions":false}"#),
        ("placement", r#"{"scale":1.0,"offset":[1e300,0,0],"depth_directions":false}"#),
    ] {
        std::fs::write(checkpoint::newest(dir.path()), &whole).unwrap();
        tampered(dir.path(), |(_, metadata)| {
            let mut field: serde_json::Value = serde_json::from_str(&metadata["field"]).unwrap();
            assert!(field.get(key).is_some(), "{key}");
            field[key] = serde_json::from_str(value).unwrap();
            metadata.insert("field".into(), field.to_string());
        });
        let e =
            TFace::load("tface", dir.path()).err().unwrap_or_else(|| panic!("{key} = {value} is accepted"));
        assert!(e.to_string().contains("checkpoint.safetensors"), "{key}: {e}");
        assert!(e.hint().contains("--fresh tface"), "{key}: {e}");
    }
}

#[test]
fn published_rates_are_reproduced() {
    let p = VmConfig::preset(Preset::Paper);
    // decay per step, then rates used at steps 1999, 2001 (just started again) and 49999 (7001 was
    // the last start)
    assert!((learning_rate(&p, 1) - 0.99995395).abs() < 1e-8);
    assert!((0.02 * learning_rate(&p, 1999) - 0.0182411).abs() < 1e-7);
    assert_eq!(0.02 * learning_rate(&p, 0), 0.02);
    assert!((0.02 * learning_rate(&p, 49_999 - 7001) - 0.00276102).abs() < 1e-8);
    assert!((0.001 * learning_rate(&p, 49_999 - 7001) - 0.000138051).abs() < 1e-9);
    assert!((tv_fade(&p, 0) - 0.99995395).abs() < 1e-8 && (tv_fade(&p, 49_999) - 0.1).abs() < 1e-12);
}

#[test]
fn the_total_variation_of_every_fourth_step_counts_as_that_of_four() {
    let every = |tv_every| VmConfig { tv_every, tv_density: 2.0, ..VmConfig::preset(Preset::Draft) };
    for step in 0..9 {
        let [density, color] = penalties(&every(1), step).unwrap();
        assert!(density == 2.0 * color && color > 0.0);
        let want = step.is_multiple_of(4).then_some([4.0 * density, 4.0 * color]);
        assert_eq!(penalties(&every(4), step), want, "{step}");
    }
}

#[test]
fn upsampling_starts_the_rates_again_from_the_next_step() {
    let config = config();
    let mut state = VmState::new(&config, 1, [[-1.0; 3], [1.0; 3]], None);
    assert_eq!(state.size, [16; 3]);
    upsample(&mut state, &config, 1, 2001);
    assert_eq!((state.size, state.reset), (size_for([2.0; 3], 28 * 28 * 28), 2001));
}

#[test]
fn a_diverging_run_restores_once_and_then_names_term_and_step() {
    let dir = temporary();
    // softplus, or every density would die before a color breaks
    let activation = DensityActivation::Softplus;
    let config = VmConfig { lr_grid: 1e38, lr_network: 1e38, activation, mask_at: vec![], ..config() };
    let e = run(&config, dir.path(), &Quiet).err().unwrap();
    let message = e.to_string();
    assert!(message.contains("NaN at step") || message.contains("inf at step"), "{message}");
    assert!(message.contains("again after restoring") && e.hint().contains("baseline.lr_grid"), "{e:?}");
}

#[test]
fn impossible_settings_and_empty_masks_are_named() {
    let dir = temporary();
    let message = |config: &VmConfig| run(config, dir.path(), &Quiet).err().unwrap().to_string();
    let cases = [
        (VmConfig { density_rank: vec![4, 4], ..config() }, "`baseline.density_rank` needs three numbers"),
        (VmConfig { upsample_at: vec![0.9, 0.5], ..config() }, "`baseline.upsample_at` must rise"),
        (VmConfig { hidden: 30, ..config() }, "`baseline.hidden` must be a multiple of 8"),
        (VmConfig { voxels_final: 100, ..config() }, "`baseline.voxels_final` is less"),
    ];
    for (config, want) in cases {
        assert!(message(&config).starts_with(want), "{}", message(&config));
    }
    let mut empty = views();
    empty.iter_mut().for_each(|v| v.mask.as_mut().unwrap().values.fill(0));
    let end = train(empty, BOX, Some(&hull()), &config(), &session("tface", dir.path(), "e", &Quiet));
    assert!(end.unwrap_err().to_string().starts_with("no training view has a pixel"));
    // a hull without a cell: the first alpha mask has nothing to keep
    let nothing = BitGrid::filled(32, false);
    let end = train(views(), BOX, Some(&nothing), &config(), &session("tface", dir.path(), "n", &Quiet));
    let e = end.unwrap_err();
    assert!(e.to_string().starts_with("the field is empty at step 40"), "{e}");
    assert!(e.hint().contains("tface.mask_threshold"), "{e:?}");
}

#[test]
fn a_checkpoint_of_other_settings_is_refused() {
    let dir = temporary();
    let config = VmConfig { steps: 2, ..config() };
    run(&config, dir.path(), &Quiet).unwrap();
    let again = train(views(), BOX, Some(&hull()), &config, &session("tface", dir.path(), "other", &Quiet));
    let message = again.err().unwrap().to_string();
    assert!(message.contains("checkpoint.safetensors") && message.contains("other settings"), "{message}");
}
