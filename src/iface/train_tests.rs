//! Training on an analytic ball: does it learn, resume, guard and stop?

use super::*;
use crate::Quiet;
use crate::config::Preset;
use crate::field::ball::{BALL, StopAfter, hull, negative, says, tampered, temporary, views};
use crate::io::Tensors;
use glam::{Vec2, Vec3};

fn config() -> IfaceConfig {
    IfaceConfig {
        steps: 240,
        rays: 256,
        max_rays: 512,
        samples: 4096,
        levels: 6,
        log2_table: 12,
        occupancy_resolution: 32,
        level_every: 30,
        anneal_end: 50,
        warmup: 20,
        min_step: 0.02,
        ..IfaceConfig::preset(Preset::Draft)
    }
}

#[test]
fn a_ball_is_learned_from_eight_views() {
    let dir = temporary();
    let (views, hull) = (views(), hull());
    let (face, report) = train(&views, Some(&hull), &config(), 3, "cpu", dir.path(), "ball", &Quiet).unwrap();
    assert!(report.train_psnr > 18.0, "{report:?}");
    // the surface along three axes, off by less than a pixel (3 / 60 = 0.05)
    for direction in [Vec3::X, Vec3::new(0.0, 0.8, 0.6), Vec3::new(-0.6, 0.0, -0.8)] {
        let along: Vec<Vec3> = (0..400).map(|i| direction * (i as f32 * 0.0025)).collect();
        let sdf = face.sdf(&along);
        let radius = sdf.iter().position(|&f| f > 0.0).map(|i| i as f32 * 0.0025).unwrap_or(1.0);
        assert!((radius - BALL).abs() < 0.05, "{direction}: {radius}");
    }
    let ray = views[0].camera.ray(Vec2::new(20.0, 12.0)).unwrap();
    let seen = face.render(&[ray])[0];
    assert!(seen.opacity > 0.9 && seen.color[0] > seen.color[1], "{seen:?}");
    // the same field comes back from its checkpoint
    let loaded = IFace::load(dir.path(), &config(), Some(&hull)).unwrap();
    assert_eq!(loaded.render(&[ray])[0], seen);
}

fn bytes(dir: &Path) -> Vec<u8> {
    std::fs::read(checkpoint::newest(dir)).unwrap()
}

#[test]
fn stopping_and_going_on_gives_the_bytes_of_an_undisturbed_run() {
    let (views, hull) = (views(), hull());
    let config = IfaceConfig { steps: 40, ..config() };
    let run = |dir: &Path, monitor: &dyn Monitor| {
        train(&views, Some(&hull), &config, 3, "cpu", dir, "ball", monitor).map(|(_, report)| report.steps)
    };
    let undisturbed = temporary();
    run(undisturbed.path(), &Quiet).unwrap();
    let stopped = temporary();
    for _ in 0..3 {
        let end = run(stopped.path(), &StopAfter::new(11));
        assert!(matches!(end, Err(IfaceError::Stopped { steps: 40, .. })));
    }
    // a checkpoint cut short by a crash: the one before it is taken
    let newest = checkpoint::newest(stopped.path());
    let whole = bytes(stopped.path());
    std::fs::write(&newest, &whole[..whole.len() / 2]).unwrap();
    run(stopped.path(), &Quiet).unwrap();
    assert_eq!(bytes(undisturbed.path()), bytes(stopped.path()));
    assert!(!stopped.path().join("checkpoint.previous.safetensors").exists());
}

#[test]
fn a_hostile_checkpoint_is_named_and_the_one_before_it_is_taken() {
    let (views, hull) = (views(), hull());
    let config = IfaceConfig { steps: 9, start: Start::Sphere, ..config() };
    let run = |dir: &Path, monitor: &dyn Monitor| {
        train(&views, Some(&hull), &config, 3, "cpu", dir, "ball", monitor).map(|(_, report)| report.warnings)
    };
    let begun = temporary();
    for _ in 0..2 {
        assert!(run(begun.path(), &StopAfter::new(2)).is_err());
    }
    let undisturbed = temporary();
    run(undisturbed.path(), &Quiet).unwrap();
    let nan = f64::NAN.to_bits().to_string();
    let rows: [(&str, &dyn Fn(&mut Tensors)); 8] = [
        ("`rays`", &says("rays", "18446744073709551615")),
        ("`rays`", &says("rays", "0")),
        ("`step`", &says("step", "10")),
        ("`step`", &says("step", "-1")),
        ("`mean_square`", &says("mean_square", &nan)),
        ("`salt`", &says("salt", "2")),
        ("`rays`", &|all| drop(all.1.remove("rays"))),
        ("second.table", &negative("second.table")),
    ];
    for (i, (key, change)) in rows.iter().enumerate() {
        let dir = temporary();
        for file in std::fs::read_dir(begun.path()).unwrap().map(|f| f.unwrap()) {
            std::fs::copy(file.path(), dir.path().join(file.file_name())).unwrap();
        }
        tampered(dir.path(), change);
        if i % 4 == 0 {
            let warnings = run(dir.path(), &Quiet).unwrap();
            assert!(warnings.iter().any(|w| w.contains(key) && w.contains("falling back")), "{warnings:?}");
            assert_eq!(bytes(undisturbed.path()), bytes(dir.path()));
        } else {
            // nothing before it to take
            std::fs::remove_file(dir.path().join("checkpoint.previous.safetensors")).unwrap();
            let e = run(dir.path(), &Quiet).unwrap_err();
            assert!(e.to_string().contains(key) && e.to_string().contains("checkpoint.safetensors"), "{e}");
            assert_eq!(e.hint().unwrap(), "start the stage afresh with `--fresh iface`");
        }
    }
    tampered(undisturbed.path(), says("rays", "18446744073709551615"));
    assert!(IFace::load(undisturbed.path(), &config, Some(&hull)).is_err());
}

#[test]
fn a_checkpoint_of_other_settings_is_refused() {
    let (views, hull) = (views(), hull());
    let dir = temporary();
    let config = IfaceConfig { steps: 2, ..config() };
    train(&views, Some(&hull), &config, 3, "cpu", dir.path(), "one", &Quiet).unwrap();
    let again = train(&views, Some(&hull), &config, 3, "cpu", dir.path(), "two", &Quiet);
    let message = again.err().unwrap().to_string();
    assert!(message.contains("checkpoint.safetensors") && message.contains("other settings"), "{message}");
}

#[test]
fn a_diverging_run_restores_once_and_then_names_step_term_and_rate() {
    let (views, hull) = (views(), hull());
    let dir = temporary();
    let config = IfaceConfig { lr_table: 1e38, warmup: 0, ..config() };
    let end = train(&views, Some(&hull), &config, 3, "cpu", dir.path(), "ball", &Quiet);
    match end.err() {
        Some(IfaceError::Diverged { term, value, lr, .. }) => {
            assert!(!value.is_finite() && lr > 0.0 && !term.is_empty());
        }
        other => panic!("expected divergence, got {other:?}"),
    }
}

#[test]
fn empty_masks_and_unseen_boxes_do_not_crash() {
    let hull = hull();
    let dir = temporary();
    let mut empty = views();
    empty.iter_mut().for_each(|v| v.mask.as_mut().unwrap().values.fill(0));
    let end = train(&empty, Some(&hull), &config(), 3, "cpu", dir.path(), "empty", &Quiet);
    assert!(matches!(end, Err(IfaceError::NoPixels)));
    // a hull without a cell: no step meets a sample, and training says so instead of ending well
    let nothing = Bitmask::filled(32, false);
    let config = IfaceConfig { start: Start::Sphere, ..config() };
    let views = views();
    let end = train(&views, Some(&nothing), &config, 3, "cpu", dir.path(), "nothing", &Quiet);
    assert!(matches!(end, Err(IfaceError::SurfaceLost { step: 19, steps_without: 20 })));
}

#[test]
fn the_paper_preset_trains_too() {
    let dir = temporary();
    let views = views();
    let config = IfaceConfig {
        steps: 12,
        levels: 4,
        start_levels: 4,
        log2_table: 10,
        samples: 8192,
        occupancy_resolution: 16,
        samples_per_ray: 64,
        ..IfaceConfig::preset(Preset::Paper)
    };
    let (face, report) = train(&views, None, &config, 3, "cpu", dir.path(), "p", &Quiet).unwrap();
    assert!(report.train_psnr.is_finite() && face.sdf(&[Vec3::ZERO])[0] < 0.0);
}
