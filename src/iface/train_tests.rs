//! Training on an analytic ball: does it learn, resume, guard and stop?

use super::super::stereo::SurfacePoint;
use super::*;
use crate::config::Preset;
use crate::field::ball::{BALL, hull, textured_views, views};
use crate::field::checkpoint::{self, Checkpoint};
use crate::field::testing::{
    negative, refuses, resumes, resumes_from, says, session, tampered, temporary, undisturbed,
};
use glam::{Vec2, Vec3};
use std::path::Path;
use std::sync::OnceLock;
use tiface_base::geom::SdfField;
use tiface_base::{Monitor, Quiet};
use tiface_capture::testing::Files;

fn config() -> IfaceConfig {
    IfaceConfig {
        steps: 240,
        rays: 256,
        max_rays: 512,
        samples: 4096,
        levels: 6,
        log2_table: 12,
        occupancy_resolution: 32,
        anneal_end: 0.2,
        warmup: 0.08,
        min_step: 0.02,
        ..IfaceConfig::preset(Preset::Draft)
    }
}

/// Enough for what does not depend on what is learned; the fit to the hull alone takes seconds.
fn small() -> IfaceConfig {
    IfaceConfig { rays: 64, max_rays: 128, samples: 1024, start: Start::Sphere, ..config() }
}

/// Points are found at step 42.
fn with_points() -> IfaceConfig {
    IfaceConfig { steps: 70, anneal_end: 0.7, warmup: 0.3, ..config() }
}

/// The checkpoint that a training [`with_points`] begins with, and its end. All trainings of
/// [`config`] begin with that checkpoint, whatever is photographed: that of the fit to the hull,
/// which takes seconds. Made once a test program.
fn fitted() -> &'static [Files; 2] {
    static FITTED: OnceLock<[Files; 2]> = OnceLock::new();
    FITTED.get_or_init(|| {
        let (views, hull) = (textured_views(), hull());
        let run = |dir: &Path, monitor: &dyn Monitor| {
            train(&views, Some(&hull), &with_points(), &session("iface", dir, "ball", monitor))
                .map(|(_, r)| r.warnings)
        };
        undisturbed(&run)
    })
}

/// Longer than a second: the fit to the hull makes 250 steps, and a surface within a pixel takes as
/// many.
#[test]
fn a_ball_is_learned_from_eight_views() {
    let dir = temporary();
    fitted()[0].write(dir.path());
    let (views, hull) = (views(), hull());
    let (face, report) =
        train(&views, Some(&hull), &config(), &session("iface", dir.path(), "ball", &Quiet)).unwrap();
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
    let load = || IFace::load(dir.path(), &config(), Some(&hull));
    assert_eq!(load().unwrap().render(&[ray])[0], seen);
    // and without the moments, two thirds of the file, which an unfinished one must have
    let file = checkpoint::newest(dir.path());
    let size = std::fs::metadata(&file).unwrap().len();
    let rest = crate::iface::without_moments(&file).unwrap().unwrap();
    assert!((rest.len() as u64) < size * 2 / 5, "{} of {size}", rest.len());
    std::fs::write(&file, &rest).unwrap();
    assert_eq!(load().unwrap().render(&[ray])[0], seen);
    let (again, _) =
        train(&views, Some(&hull), &config(), &session("iface", dir.path(), "ball", &Quiet)).unwrap();
    assert_eq!(again.render(&[ray])[0], seen);
    assert_eq!(std::fs::read(&file).unwrap(), rest);
    assert!(crate::iface::without_moments(&file).unwrap().is_none());
    tampered(dir.path(), says("finished", "0"));
    let error = load().map(drop).unwrap_err().to_string();
    assert!(error.contains("`first.table` is missing"), "{error}");
}

#[test]
fn stopping_and_going_on_gives_the_bytes_of_an_undisturbed_run() {
    let (views, hull) = (views(), hull());
    let config = IfaceConfig { steps: 40, ..small() };
    let run = |dir: &Path, monitor: &dyn Monitor| {
        train(&views, Some(&hull), &config, &session("iface", dir, "ball", monitor)).map(|(_, r)| r.warnings)
    };
    resumes(&run, 3);
}

/// Longer than a second: points are found on a surface that is right to a few pixels, which begins
/// with the hull.
#[test]
fn a_training_goes_on_with_the_points_that_photographs_agree_on() {
    let (views, hull, config) = (textured_views(), hull(), with_points());
    let run = |dir: &Path, monitor: &dyn Monitor| {
        train(&views, Some(&hull), &config, &session("iface", dir, "ball", monitor)).map(|(_, r)| r.warnings)
    };
    // stopped before the step at which points are found, and after it; the undisturbed training
    // made its own fit to the hull
    resumes_from(fitted().each_ref(), &run, 5);
    let dir = temporary();
    fitted()[1].write(dir.path());
    let state = |config: &IfaceConfig, dir: &Path| {
        let mut file = Checkpoint::read(&checkpoint::newest(dir), "iface", FORMAT).unwrap();
        SdfState::restore(parts(config), config, Some(&hull), &mut file).unwrap()
    };
    // a pixel is 2.4 / 120 = 0.02, and a flat patch of 9 on a ball of 25 lies some 0.2 of one
    // inside
    let off = |p: &SurfacePoint| (Vec3::from(p.position).length() - BALL).abs();
    let mut off: Vec<f32> = state(&config, dir.path()).stereo.iter().map(off).collect();
    off.sort_by(f32::total_cmp);
    assert!(
        off.len() > 100 && off[off.len() / 2] < 0.007,
        "{} points, {:?}",
        off.len(),
        off.get(off.len() / 2)
    );
    let (none, dir) = (IfaceConfig { stereo: 0.0, steps: 4, start: Start::Sphere, ..config }, temporary());
    train(&views, Some(&hull), &none, &session("iface", dir.path(), "waves", &Quiet)).unwrap();
    assert!(state(&none, dir.path()).stereo.is_empty());
}

#[test]
fn a_hostile_checkpoint_is_named_and_the_one_before_it_is_taken() {
    let (views, hull) = (views(), hull());
    let config = IfaceConfig { steps: 9, ..small() };
    let run = |dir: &Path, monitor: &dyn Monitor| {
        train(&views, Some(&hull), &config, &session("iface", dir, "ball", monitor)).map(|(_, r)| r.warnings)
    };
    let nan = f64::NAN.to_bits().to_string();
    refuses(
        &run,
        2,
        "iface",
        &[
            ("`rays`", &says("rays", "18446744073709551615")),
            ("`rays`", &says("rays", "0")),
            ("`step`", &says("step", "10")),
            ("`step`", &says("step", "-1")),
            ("`mean_square`", &says("mean_square", &nan)),
            ("`salt`", &says("salt", "2")),
            ("`rays`", &|all| drop(all.1.remove("rays"))),
            ("second.table", &negative("second.table")),
        ],
    );
    let finished = temporary();
    run(finished.path(), &Quiet).unwrap();
    tampered(finished.path(), says("rays", "18446744073709551615"));
    assert!(IFace::load(finished.path(), &config, Some(&hull)).is_err());
}

#[test]
fn a_checkpoint_of_other_settings_is_refused() {
    let (views, hull) = (views(), hull());
    let dir = temporary();
    let config = IfaceConfig { steps: 2, ..small() };
    train(&views, Some(&hull), &config, &session("iface", dir.path(), "one", &Quiet)).unwrap();
    let again = train(&views, Some(&hull), &config, &session("iface", dir.path(), "two", &Quiet));
    let message = again.err().unwrap().to_string();
    assert!(message.contains("checkpoint.safetensors") && message.contains("other settings"), "{message}");
}

#[test]
fn a_diverging_run_restores_once_and_then_names_step_term_and_rate() {
    let (views, hull) = (views(), hull());
    let dir = temporary();
    let config = IfaceConfig { lr_table: 1e38, warmup: 0.0, ..small() };
    let end = train(&views, Some(&hull), &config, &session("iface", dir.path(), "ball", &Quiet));
    let e = end.err().unwrap();
    let message = e.to_string();
    assert!(
        message.contains("at step") && !message.contains("rate 0.00") && message.contains("(learning rate "),
        "{message}"
    );
    assert!(message.contains("NaN") || message.contains("inf"), "{message}");
    assert!(e.hint().contains("iface.lr_table"), "{e:?}");
}

#[test]
fn empty_masks_and_unseen_boxes_do_not_crash() {
    let hull = hull();
    let dir = temporary();
    let mut empty = views();
    empty.iter_mut().for_each(|v| v.mask.as_mut().unwrap().values.fill(0));
    let end = train(&empty, Some(&hull), &config(), &session("iface", dir.path(), "empty", &Quiet));
    assert!(end.err().unwrap().to_string().starts_with("no training view has a pixel"));
    // a hull without a cell: no step meets a sample, and training says so instead of ending well
    let nothing = BitGrid::filled(32, false);
    let config = small();
    let views = views();
    let end = train(&views, Some(&nothing), &config, &session("iface", dir.path(), "nothing", &Quiet));
    let lost = "the surface is lost at step 19: no ray of 20 steps met a sample";
    assert_eq!(end.err().unwrap().to_string(), lost);
}
