//! Views of camera paths, beside a finished evaluation.

use super::tests::{NoFields, head_run, masked, quiet, words};
use super::*;
use crate::config::{Config, Method, RenderConfig, ViewBackground};
use crate::run::Run;
use serde_json::Value;
use std::path::{Path, PathBuf};
use tempfile::TempDir;
use tiface_base::io;
use tiface_base::{ErrorKind, Result};

/// Radiance fields that are one color; others may not be asked for.
struct Fog;

impl Radiance for Fog {
    fn render_rays(&self, rays: &[tiface_base::geom::Ray], _: glam::Vec3) -> Vec<RayResult> {
        vec![RayResult { color: [0.25; 3], opacity: 0.5, depth: 2.0, ..RayResult::default() }; rays.len()]
    }
}

impl Fields for Fog {
    fn surface(&self) -> Result<&dyn Surface> {
        panic!("no surface is asked for")
    }

    fn radiance(&self, _: Stage) -> Result<&dyn Radiance> {
        Ok(self)
    }
}

/// The least capture, whose views are those of two radiance fields and their blend.
fn head() -> (TempDir, Config, Run) {
    let (dir, mut config, run) = head_run((16, 20), (4, 2));
    config.render.method = vec![Method::Baseline, Method::Tface];
    config.ensemble.members = vec![Method::Baseline, Method::Tface];
    config.ensemble.weights = vec![0.25, 0.75];
    (dir, config, run)
}

/// As `--cameras CAMERAS --with tface --background white` asks for it.
fn turn(config: &Config, cameras: &str) -> RenderConfig {
    RenderConfig {
        cameras: cameras.into(),
        method: vec![Method::Tface],
        background: ViewBackground::White,
        orbit_views: 3,
        ..config.render.clone()
    }
}

/// Completes all stages with a constant field; returns whether each was skipped.
fn evaluate(session: &Session) -> Vec<bool> {
    session.remember(Stage::Metrics).unwrap();
    let skipped = |stage| complete(session, stage, &Fog).unwrap().skipped;
    let mask = skipped(Stage::Mask);
    for stage in [Stage::Baseline, Stage::Tface] {
        session.run.stage(session.plan(stage), |_| Ok(Value::Null)).unwrap();
    }
    let rest = [Stage::Render, Stage::Ensemble, Stage::Metrics].map(skipped);
    page::write_report(session, false).unwrap();
    [&[mask], &rest[..]].concat()
}

/// Completes all stages for tests of what follows.
fn finished(session: &Session) {
    masked(session);
    evaluate(session);
}

/// Every file of a run with its bytes, those of paths left out.
fn files(run: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut found = Vec::new();
    let mut folders = vec![run.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.ends_with("render/paths") {
                continue;
            } else if path.is_dir() {
                folders.push(path);
            } else {
                let bytes = std::fs::read(&path).unwrap();
                found.push((path, bytes));
            }
        }
    }
    found.sort();
    found
}

#[test]
fn camera_paths_never_touch_the_evaluations_views() {
    let (dir, config, run) = head();
    let open = || Session::open(&config, &run).unwrap();
    assert_eq!(evaluate(&open()), [false; 4]);
    let before = files(run.dir());
    assert!(before.iter().any(|(path, _)| path.ends_with("metrics/metrics.json")));

    let flight = dir.path().join("flight.json");
    let eye = "[[1,0,0,0],[0,1,0,0],[0,0,1,2],[0,0,0,1]]";
    std::fs::write(&flight, format!(r#"{{"frames": [{{"transform_matrix": {eye}}}]}}"#)).unwrap();
    for (cameras, views) in [("orbit", 3), ("train", 4), (flight.to_str().unwrap(), 1)] {
        let session = open().with_camera_path(turn(&config, cameras)).unwrap();
        // nothing but what the views show, and nothing that builds on them
        assert_eq!(words(&session.order(Stage::Render)), "mask tface render");
        session.fresh(Stage::Render, Stage::Render).unwrap();
        for again in [false, true] {
            session.remember(Stage::Render).unwrap();
            let done = complete(&session, Stage::Render, &Fog).unwrap();
            page::write_report(&session, false).unwrap();
            assert_eq!((done.skipped, &done.summary["cameras"]), (again, &Value::from(views)), "{cameras}");
        }
        let folder = run.path(session.views());
        assert!(folder.starts_with(run.path("render/paths")), "{}", folder.display());
        assert_eq!(io::list_files(&folder.join("tface")).unwrap().len() as u64, views);
        assert!(!folder.join("tface/float").exists());
    }
    assert!(run.path("render/paths/orbit/done.json").is_file());
    assert_eq!(io::list_folders(&run.path("render/paths")).unwrap().len(), 3);
    // half a gray of 0.5 over white
    let shown = pictures::read(&run.path("render/paths/orbit/tface/0001.png")).unwrap();
    assert_eq!(shown.pixel(3, 3)[0], 191.0 / 255.0);

    assert!(before == files(run.dir()), "the evaluation has changed");
    assert_eq!(evaluate(&open()), [true; 4]);
    assert!(before == files(run.dir()), "the evaluation has changed");
}

#[test]
fn views_of_a_path_are_made_again_alone_and_never_in_silence() {
    let (_dir, config, run) = head();
    let session = || Session::open(&config, &run).unwrap();
    finished(&session());
    let orbit = turn(&config, "orbit");
    complete(&session().with_camera_path(orbit.clone()).unwrap(), Stage::Render, &Fog).unwrap();
    complete(&session().with_camera_path(turn(&config, "train")).unwrap(), Stage::Render, &Fog).unwrap();
    let black = session()
        .with_camera_path(RenderConfig { background: ViewBackground::Black, ..orbit.clone() })
        .unwrap();
    let e = black.remember(Stage::Render).unwrap_err();
    assert!(e.to_string().contains("render.background: was \"white\", is \"black\""), "{e}");
    assert!(e.hint().contains("`--fresh render`") && e.hint().contains("nothing else"), "{}", e.hint());
    black.fresh(Stage::Render, Stage::Render).unwrap();
    assert!(!complete(&black, Stage::Render, &Fog).unwrap().skipped);
    assert_eq!(evaluate(&session()), [true; 4]);
    assert!(
        complete(&session().with_camera_path(turn(&config, "train")).unwrap(), Stage::Render, &Fog)
            .unwrap()
            .skipped
    );
    // the held-out views made again are no reason to make others again, another field is one
    session().fresh(Stage::Render, Stage::Metrics).unwrap();
    assert!(run.path("render/paths/orbit/done.json").is_file() && !run.path("render/done.json").is_file());
    session().fresh(Stage::Baseline, Stage::Metrics).unwrap();
    assert!(run.path("render/paths/orbit/done.json").is_file());
    session().fresh(Stage::Tface, Stage::Metrics).unwrap();
    assert!(!run.path("render/paths/orbit/done.json").exists());
}

#[test]
fn views_of_a_path_whose_records_cannot_be_read_are_made_again_with_any_field() {
    let (_dir, config, run) = head();
    finished(&Session::open(&config, &run).unwrap());
    let session = Session::open(&config, &run).unwrap().with_camera_path(turn(&config, "orbit")).unwrap();
    complete(&session, Stage::Render, &Fog).unwrap();
    let orbit = "render/paths/orbit".to_string();
    let is_out_of_date = |stage| session.out_of_date(stage).unwrap().contains(&orbit);
    assert!(is_out_of_date(Stage::Tface) && !is_out_of_date(Stage::Iface));
    // the finished record says it as well
    std::fs::write(run.path(&orbit).join("status.json"), "{").unwrap();
    assert!(is_out_of_date(Stage::Tface) && !is_out_of_date(Stage::Iface));
    std::fs::write(run.path(&orbit).join("done.json"), "{").unwrap();
    assert!(is_out_of_date(Stage::Iface));
}

#[test]
fn a_file_of_cameras_is_read_before_anything_is_learned() {
    let (dir, config, run) = head();
    let path = dir.path().join("path.json");
    let along = |text: &str| {
        std::fs::write(&path, text).unwrap();
        let session = Session::open(&config, &run).unwrap();
        let session = session.with_camera_path(turn(&config, path.to_str().unwrap()))?;
        Ok::<_, tiface_base::Error>(session.views().to_owned())
    };
    let e = along("{}").unwrap_err();
    assert!(e.to_string().contains("camera_path") && e.kind().code() == 1, "{e}");
    let frame = r#"{"file_path": "a.png", "transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,2],[0,0,0,1]]}"#;
    let e = along(&format!(r#"{{"frames": [{frame}, {frame}]}}"#)).unwrap_err();
    assert!(e.to_string().contains("two cameras `a`"), "{e}");
    // another content, another folder
    let (first, second) =
        (along(&format!(r#"{{"frames": [{frame}]}}"#)), along(&format!(r#"{{"frames":[{frame}]}}"#)));
    assert_ne!(first.unwrap(), second.unwrap());
}

#[test]
fn a_method_that_is_not_asked_for_is_not_called_changed() {
    let (_dir, mut config, run) = head();
    finished(&Session::open(&config, &run).unwrap());
    config.render.method = vec![Method::Tface];
    let e = Session::open(&config, &run).unwrap().remember(Stage::Render).unwrap_err().to_string();
    assert!(e.contains("render.method: was [\"baseline\", \"tface\"], is [\"tface\"]"), "{e}");
    assert!(e.contains("baseline: was an input, is none now") && !e.contains("has changed"), "{e}");
}

#[test]
fn an_evaluation_of_other_cameras_than_the_held_out_ones_is_refused_with_the_way_out() {
    let (_dir, mut config, run) = head();
    config.render.cameras = "orbit".into();
    let session = Session::open(&config, &run).unwrap();
    let e = session.remember(Stage::Metrics).unwrap_err();
    assert!(e.to_string().starts_with("`render.cameras` is orbit") && e.kind() == ErrorKind::Usage, "{e}");
    assert!(
        e.hint().contains("--set render.cameras=test") && e.hint().contains("--cameras orbit"),
        "{}",
        e.hint()
    );
    assert!(session.stage_states(Stage::Metrics).is_err() && !run.dir().exists());
}

#[test]
fn nothing_to_judge_is_an_error_and_no_empty_file() {
    let (_dir, mut config, run) = head();
    config.render.method.clear();
    config.ensemble.members.clear();
    let session = Session::open(&config, &run).unwrap();
    masked(&session);
    complete(&session, Stage::Render, &Fog).unwrap();
    let e = complete(&session, Stage::Metrics, &NoFields).unwrap_err();
    assert!(e.hint().contains("`render.method`") && !run.path("metrics/metrics.json").exists(), "{e}");
}

#[test]
fn a_stage_command_does_not_shrink_the_report_of_a_finished_run() {
    let (_dir, config, run) = head();
    let session = Session::open(&config, &run).unwrap();
    finished(&session);
    let page = || std::fs::read_to_string(run.path("report.html")).unwrap();
    let whole = page();
    assert!(whole.contains("<span>mask</span>") && whole.contains("<h2>Against the photographs</h2>"));
    std::fs::remove_file(run.path("report.html")).unwrap();
    // as a later command on one stage leaves it
    let session = Session::open(&config, &run).unwrap();
    session.remember(Stage::Mask).unwrap();
    complete(&session, Stage::Mask, &NoFields).unwrap();
    page::write_report(&session, false).unwrap();
    assert!(page() == whole);
    // if nothing was done, it is not made again except on request
    std::fs::write(run.path("report.html"), "kept").unwrap();
    page::write_report(&session, true).unwrap();
    assert!(page() == "kept");
    renew_report(&session).unwrap();
    assert!(page() == whole);
}

#[test]
fn a_finished_run_needs_its_capture_no_more_and_an_unfinished_one_says_how_to_name_it() {
    let (dir, config, run) = head();
    let root = dir.path().join("head");
    let first = Session::open(&config, &run).unwrap();
    finished(&first);
    let (before, export) = (files(run.dir()), Export::new(first.capture(), &config));
    std::fs::rename(&root, dir.path().join("moved")).unwrap();

    let session = Session::open(&config, &run).unwrap();
    assert_eq!(evaluate(&session), [true; 4]);
    assert!(session.stage_states(Stage::Metrics).is_ok());
    assert!(before == files(run.dir()));
    let again = Export::new(session.capture(), &config);
    assert_eq!((again.name, again.up, again.cameras), (export.name, export.up, export.cameras));

    // there is work: nothing is removed or written before it is known that it cannot be done
    for e in [
        session.fresh(Stage::Metrics, Stage::Metrics).unwrap_err(),
        Session::open(&config, &run)
            .unwrap()
            .with_camera_path(turn(&config, "orbit"))
            .unwrap()
            .remember(Stage::Render)
            .unwrap_err(),
    ] {
        assert!(e.to_string().contains("head") && e.kind().code() == 1, "{e}");
        assert!(e.hint().contains("--set capture.path="), "{}", e.hint());
    }
    assert!(before == files(run.dir()));
    std::fs::remove_file(run.path("mask/done.json")).unwrap();
    let e = Session::open(&config, &run).err().unwrap();
    assert!(e.hint().contains("--set capture.path="), "{e}");

    // and the suggested fix is one
    let mut moved = config.clone();
    moved.capture.path = dir.path().join("moved");
    assert_eq!(evaluate(&Session::open(&moved, &run).unwrap()), [false, true, true, true]);
    // where there is no run, it is the capture that is wrong
    let e = Session::open(&config, &quiet(&dir.path().join("new"))).err().unwrap();
    assert!(!e.hint().contains("capture.path"), "{e}");
}

#[test]
fn a_finished_run_that_cannot_be_written_is_still_done() {
    let (_dir, mut config, run) = head();
    finished(&Session::open(&config, &run).unwrap());
    // a folder in the place of a file cannot be written by anybody
    for file in ["config.toml", "cameras.json", "report.html"] {
        std::fs::remove_file(run.path(file)).unwrap();
        std::fs::create_dir(run.path(file)).unwrap();
    }
    config.device = "cpu".into();
    let session = Session::open(&config, &run).unwrap();
    session.remember(Stage::Metrics).unwrap();
    let done = reconstruct(&session, Stage::Metrics).unwrap();
    assert!(done.len() == 6 && done.iter().all(|(_, stage)| stage.skipped), "{done:?}");
    // with work to do it is an error, before that is begun
    session.fresh(Stage::Metrics, Stage::Metrics).unwrap();
    assert!(session.remember(Stage::Metrics).unwrap_err().to_string().contains("config.toml"));
}

#[test]
fn a_command_that_is_refused_clears_nothing_with_fresh() {
    let (_dir, config, run) = head();
    finished(&Session::open(&config, &run).unwrap());
    let before = files(run.dir());
    let refused = |change: &dyn Fn(&mut Config)| {
        let mut config = config.clone();
        change(&mut config);
        let session = Session::open(&config, &run).unwrap();
        session.fresh(Stage::Render, Stage::Metrics).unwrap_err().to_string()
    };
    // what has no member, other cameras, and a field of other settings that is not made again
    assert!(refused(&|c| c.render.method = vec![Method::Tface]).contains("`ensemble.members`"));
    assert!(refused(&|c| c.render.cameras = "orbit".into()).contains("`render.cameras`"));
    assert!(refused(&|c| c.tface.steps += 1).contains("tface.steps"));
    assert!(before == files(run.dir()));
}
