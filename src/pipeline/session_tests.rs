//! A session on the demo head: what it plans, costs, refuses and goes on with.

use super::tests::{NoFields, head_run, masked, quiet, tiny_run, words};
use super::*;
use crate::config::{
    ColorSource, Config, Hair, HairViews, MaskSource, MeshConfig, MeshFormat, Method, ViewBackground,
};
use crate::run::{Run, Stop};
use serde_json::json;
use tiface_base::io::{self, Limits};
use tiface_base::{ErrorKind, Result};
use tiface_capture::Split;

#[test]
fn views_held_out_for_validation_cost_what_test_views_cost() {
    let (dir, config, run) = tiny_run();
    let root = dir.path().join("head");
    let costs = || {
        let session = Session::open(&config, &run).unwrap();
        [Stage::Render, Stage::Ensemble, Stage::Metrics].map(|stage| session.cost(stage).cpu_s)
    };
    let of_test = costs();
    let test = root.join("transforms_test.json");
    let text = std::fs::read_to_string(&test).unwrap().replace("\"test\"", "\"val\"");
    std::fs::write(root.join("transforms_val.json"), text).unwrap();
    std::fs::remove_file(test).unwrap();
    assert_eq!(costs(), of_test);
}

#[test]
fn a_large_texture_is_told_the_memory_that_it_takes_and_no_three_times_of_it() {
    let (_dir, mut config, run) = tiny_run();
    let mut mib = |texture_px: u32| {
        config.mesh.texture_px = texture_px;
        let bytes = Session::open(&config, &run).unwrap().cost(Stage::Mesh).memory_bytes;
        bytes as f64 / f64::from(1 << 20)
    };
    // measured on a bust of 384 x 512 pixels: 651 MiB, and 3133 MiB
    let ratio = (mib(4096) - mib(1024)) / (3133.0 - 651.0);
    assert!((1.0..1.3).contains(&ratio), "{ratio}");
}

#[test]
fn the_disk_told_is_what_a_field_leaves_not_what_its_checkpoints_take_meanwhile() {
    let (_dir, config, run) = tiny_run();
    let session = Session::open(&config, &run).unwrap();
    // 96 channels of 192 x 193 floats, and a megabyte of logs
    let left = 4.0 * 96.0 * 192.0 * 193.0 + 1e6;
    let told = session.cost(Stage::Tface).disk_bytes as f64;
    assert!((1.0..1.3).contains(&(told / left)), "{told}");
    assert!(session.plan(Stage::Tface).needs_bytes as f64 > 3.0 * told);
}

#[test]
fn a_stage_gives_the_scratch_memory_of_its_kernels_back() {
    use tiface_kernels::cpu::pool::{Buffer, keeps};
    let (_dir, config, run) = tiny_run();
    let session = Session::open(&config, &run).unwrap();
    // rounded up to 5 eighths of 2^20; nobody else has one of this size
    drop(Buffer::scratch(640_001));
    complete(&session, Stage::Mask, &NoFields).unwrap();
    assert!(!keeps(5 << 17));
}

/// A radiance field that is one color, and counts the views it was asked for.
struct Fog(std::sync::atomic::AtomicUsize, Option<Stop>);

impl Radiance for Fog {
    fn render_rays(&self, rays: &[tiface_base::geom::Ray], _: glam::Vec3) -> Vec<RayResult> {
        let views = self.0.fetch_add(1, std::sync::atomic::Ordering::SeqCst) + 1;
        if let Some(stop) = self.1.as_ref().filter(|_| views == 2) {
            stop.request(ErrorKind::Interrupted);
        }
        vec![RayResult { color: [0.25; 3], opacity: 0.5, depth: 2.0, ..RayResult::default() }; rays.len()]
    }
}

impl Fields for Fog {
    fn surface(&self) -> Result<&dyn Surface> {
        panic!("no surface is asked for")
    }

    fn radiance(&self, stage: Stage) -> Result<&dyn Radiance> {
        assert_eq!(stage, Stage::Tface);
        Ok(self)
    }
}

#[test]
fn rendering_goes_on_after_a_stop_with_the_view_it_was_stopped_in() {
    let (dir, mut config, run) = head_run((32, 40), (4, 3));
    config.render.method = vec![Method::Tface];
    config.render.background = ViewBackground::White;
    masked(&Session::open(&config, &run).unwrap());
    let interrupted = Fog(0.into(), Some(run.stop().clone()));
    let e = complete(&Session::open(&config, &run).unwrap(), Stage::Render, &interrupted).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::Interrupted);
    let made = |run: &Run| io::list_files(&run.path("render/tface")).map_or(0, |f| f.len());
    assert_eq!(made(&run), 1);
    let run = quiet(dir.path());
    let rest = Fog(0.into(), None);
    let session = Session::open(&config, &run).unwrap();
    assert_eq!(complete(&session, Stage::Render, &rest).unwrap().summary["cameras"], 3);
    assert_eq!((made(&run), rest.0.into_inner()), (3, 2));
    // half a gray of 0.5 over white is 0.25 + 0.5; in float it is as it was
    let name = session.capture().split(Split::Test).next().unwrap().name.clone();
    let shown = pictures::read(&run.path(format!("render/tface/{name}.png"))).unwrap();
    assert_eq!(shown.pixel(3, 3), [191.0 / 255.0, 191.0 / 255.0, 191.0 / 255.0, 1.0]);
    let float = pictures::read_float(&run.path(format!("render/tface/float/{name}.exr"))).unwrap();
    assert_eq!(float.pixel(3, 3), [0.25, 0.25, 0.25, 0.5]);
}

#[test]
fn a_run_without_masks_stops_before_anything_is_written_unless_masks_are_declined() {
    let (dir, mut config, run) = tiny_run();
    let root = dir.path().join("head");
    std::fs::remove_dir_all(root.join("masks")).unwrap();
    for name in io::list_files(&root).unwrap().iter().filter(|n| n.ends_with(".json")) {
        let mut value = io::read_json(&root.join(name), &Limits::default()).unwrap();
        for frame in value["frames"].as_array_mut().unwrap() {
            frame.as_object_mut().unwrap().remove("mask_path");
        }
        std::fs::write(root.join(name), value.to_string()).unwrap();
    }
    let e = Session::open(&config, &run).err().unwrap();
    assert!(e.to_string().contains("head mask") && e.kind() == ErrorKind::Cannot, "{e}");
    assert!(e.hint().contains("--page") && e.hint().contains("--set mask.source=none"), "{}", e.hint());
    assert!(!run.dir().exists());
    config.mask.source = MaskSource::None;
    let session = Session::open(&config, &run).unwrap();
    session.remember(Stage::Mask).unwrap();
    assert_eq!(complete(&session, Stage::Mask, &NoFields).unwrap().summary["masks"], 0);
}

#[test]
fn a_scene_that_was_changed_by_hand_stops_every_stage_and_names_the_way_out() {
    let (_dir, mut config, run) = tiny_run();
    config.render.method = vec![Method::Tface];
    let session = Session::open(&config, &run).unwrap();
    masked(&session);
    let path = run.path("mask/scene.json");
    let mut value = io::read_json(&path, &Limits::default()).unwrap();
    value["hull"] = json!({"resolution": 0, "bits": []});
    std::fs::write(&path, value.to_string()).unwrap();
    let fog = Fog(0.into(), None);
    // a stage that was done has lost what it made
    let e = complete(&session, Stage::Mask, &NoFields).unwrap_err();
    assert!(e.to_string().contains("mask/scene.json` has "), "{e}");
    assert!(e.hint().contains("`--fresh mask`") && e.kind() == ErrorKind::Cannot, "{}", e.hint());
    for e in [
        complete(&session, Stage::Mesh, &NoFields).unwrap_err(),
        complete(&session, Stage::Render, &fog).unwrap_err(),
    ] {
        assert!(e.to_string().contains("`hull.resolution` is 0, expected 2 to 1024"), "{e}");
        assert!(e.hint().contains("`--fresh mask`") && e.kind() == ErrorKind::Cannot, "{}", e.hint());
    }
    // which it is
    session.fresh(Stage::Mask, Stage::Mask).unwrap();
    masked(&session);
}

#[test]
fn a_command_runs_what_its_stage_needs_and_nothing_else() {
    let (_dir, base, run) = tiny_run();
    let order = |until: Stage, methods: &[Method]| {
        let mut config = base.clone();
        if !methods.is_empty() {
            config.render.method = methods.to_vec();
        }
        words(&Session::open(&config, &run).unwrap().order(until))
    };
    assert_eq!(order(Stage::Baseline, &[]), "mask baseline");
    assert_eq!(order(Stage::Tface, &[]), "mask tface");
    assert_eq!(order(Stage::Iface, &[]), "mask iface");
    assert_eq!(order(Stage::Mesh, &[]), "mask iface mesh");
    assert_eq!(order(Stage::Render, &[Method::Tface]), "mask tface render");
    assert_eq!(order(Stage::Render, &[Method::Baseline]), "mask baseline render");
    assert_eq!(order(Stage::Render, &[Method::Volume]), "mask iface render");
    assert_eq!(order(Stage::Render, &[Method::Raycast]), "mask iface mesh render");
    assert_eq!(order(Stage::Ensemble, &[Method::Tface]), "mask tface render ensemble");
    // the paper's baseline is learned where it is shown
    assert_eq!(order(Stage::Metrics, &[]), words(&Stage::ALL).replace("baseline ", ""));
    let shown = [Method::Baseline, Method::Tface, Method::Volume, Method::Raycast];
    assert_eq!(order(Stage::Metrics, &shown), words(&Stage::ALL));
    // and only those that build on it are out of date with it
    assert_eq!(words(&Stage::Tface.followers(&base)), "tface render ensemble metrics");
    assert_eq!(words(&Stage::Iface.followers(&base)), "iface mesh render ensemble metrics");
    assert_eq!(words(&Stage::Mask.followers(&base)), words(&Stage::ALL));
    // hair that is fitted to views of T-Face needs them
    let mut fitted = base.clone();
    (fitted.mesh.hair, fitted.mesh.hair_views) = (Hair::Shells, HairViews::Tface);
    assert_eq!(words(&Session::open(&fitted, &run).unwrap().order(Stage::Mesh)), "mask tface iface mesh");
    assert_eq!(words(&Stage::Tface.followers(&fitted)), "tface mesh render ensemble metrics");
    fitted.mesh.hair = Hair::None;
    assert_eq!(words(&Session::open(&fitted, &run).unwrap().order(Stage::Mesh)), "mask iface mesh");
}

#[test]
fn a_changed_setting_changes_its_stage_and_those_after_it_only() {
    let (dir, draft, run) = tiny_run();
    std::fs::write(dir.path().join("a.safetensors"), b"weights").unwrap();
    let digests = |change: &dyn Fn(&mut Config)| -> Vec<String> {
        let mut config = draft.clone();
        change(&mut config);
        let session = Session::open(&config, &run).unwrap();
        Stage::ALL.iter().map(|s| session.plan(*s).fingerprint.digest()).collect()
    };
    let base = digests(&|_| {});
    let changed = |change: &dyn Fn(&mut Config)| -> String {
        let now = digests(change);
        let names = Stage::ALL.iter().zip(base.iter().zip(&now)).filter(|(_, (a, b))| a != b);
        names.map(|(s, _)| s.as_str()).collect::<Vec<_>>().join(" ")
    };
    let all = words(&Stage::ALL);
    assert_eq!(changed(&|c| c.mesh.resolution = 100), "mesh render ensemble metrics");
    assert_eq!(changed(&|c| c.tface.steps += 1), "tface render ensemble metrics");
    assert_eq!(changed(&|c| c.baseline.steps += 1), "baseline");
    assert_eq!(changed(&|c| c.tface.checkpoint_s = 7.0), "");
    assert_eq!(changed(&|c| c.ensemble.weights = vec![0.5, 0.5]), "ensemble metrics");
    assert_eq!(changed(&|c| c.seed = 7), all.replace("mask ", ""));
    assert_eq!(changed(&|c| c.capture.downscale = 2), all);
    assert_eq!(changed(&|c| c.capture.tiles = 0.0), all.replace("mask ", ""));
    assert_eq!(changed(&|c| c.device = "cpu".into()), "");
    // the imported content counts, not its path
    let import = |name: &str| {
        let path = dir.path().join(name).to_str().unwrap().to_string();
        digests(&|c| c.tface.import = path.clone())
    };
    let first = import("a.safetensors");
    assert_ne!(first[2], base[2]);
    assert_eq!(Stage::ALL[2], Stage::Tface);
    std::fs::copy(dir.path().join("a.safetensors"), dir.path().join("b.safetensors")).unwrap();
    assert_eq!(import("b.safetensors"), first);
    std::fs::write(dir.path().join("a.safetensors"), b"other").unwrap();
    assert_ne!(import("a.safetensors"), first);
}

#[test]
fn what_is_not_rendered_does_not_shape_the_views() {
    let (_dir, draft, run) = tiny_run();
    let render = |change: &dyn Fn(&mut Config)| {
        let mut config = draft.clone();
        config.render.method = vec![Method::Tface];
        change(&mut config);
        Session::open(&config, &run).unwrap().plan(Stage::Render).fingerprint
    };
    let base = render(&|_| {});
    assert_eq!(base.inputs.keys().map(String::as_str).collect::<Vec<_>>(), ["mask", "tface"]);
    assert_eq!(render(&|c| c.mesh.resolution = 100), base);
    assert_eq!(render(&|c| c.baseline.steps = 9), base);
    assert_ne!(render(&|c| c.tface.steps = 9), base);
}

/// Records every stage as done without any work.
fn finish(session: &Session) {
    for stage in session.order(Stage::Metrics) {
        session.run.stage(session.plan(stage), |_| Ok(json!(null))).unwrap();
    }
}

/// The stages of a run that are done as planned.
fn done(session: &Session) -> String {
    words(&Stage::ALL.into_iter().filter(|s| session.run.is_done(&session.plan(*s))).collect::<Vec<_>>())
}

#[test]
fn other_formats_leave_the_views_and_their_figures_alone() {
    let (dir, mut config, run) = tiny_run();
    finish(&Session::open(&config, &run).unwrap());
    let all = "mask tface iface mesh render ensemble metrics";
    for change in [
        |c: &mut Config| c.mesh.format = vec![MeshFormat::Glb, MeshFormat::Obj],
        |c: &mut Config| c.mesh.exr = true,
    ] {
        change(&mut config);
        let session = Session::open(&config, &run).unwrap();
        assert_eq!(session.require(Stage::Mesh, Some(Stage::Mesh)).unwrap(), ["mesh"]);
        session.fresh(Stage::Mesh, Stage::Mesh).unwrap();
        assert_eq!(done(&session), all.replace("mesh ", ""));
        // also where the command is repeated after it was killed
        assert!(session.require(Stage::Mesh, Some(Stage::Mesh)).unwrap().is_empty());
        session.run.stage(session.plan(Stage::Mesh), |_| Ok(json!(null))).unwrap();
        assert_eq!(done(&session), all);
    }
    // views of a path stay as well, unless the mesh has fewer triangles
    let orbit = crate::config::RenderConfig {
        cameras: "orbit".into(),
        method: vec![Method::Raycast],
        ..config.render.clone()
    };
    let session = Session::open(&config, &run).unwrap().with_camera_path(orbit).unwrap();
    session.run.stage(session.plan(Stage::Render), |_| Ok(json!(null))).unwrap();
    for (exr, triangles, expected) in [
        (false, config.mesh.triangles, &["mesh"][..]),
        (true, 100, &["mesh", "render", "ensemble", "metrics", "render/paths/orbit"]),
    ] {
        let mesh = MeshConfig { exr, triangles, ..config.mesh.clone() };
        let other = Config { mesh, ..config.clone() };
        let session = Session::open(&other, &run).unwrap();
        assert_eq!(session.out_of_date(Stage::Mesh).unwrap(), expected);
    }
    // fewer triangles are seen, but where rays meet the surface that they are made from
    let follow = ["mesh", "render", "ensemble", "metrics"];
    for (color, method, expected) in [
        (ColorSource::Photographs, Method::Raycast, &follow[..]),
        (ColorSource::Network, Method::Textured, &follow),
        (ColorSource::Network, Method::Raycast, &follow[..1]),
    ] {
        config.mesh.color = color;
        config.render.method = vec![method];
        (config.ensemble.members, config.ensemble.weights) = (vec![method], vec![1.0]);
        let run = Run::quiet(&dir.path().join(format!("{color:?} {method:?}")));
        finish(&Session::open(&config, &run).unwrap());
        let fewer = Config { mesh: MeshConfig { triangles: 100, ..config.mesh.clone() }, ..config.clone() };
        let session = Session::open(&fewer, &run).unwrap();
        assert_eq!(session.out_of_date(Stage::Mesh).unwrap(), expected, "{color:?} {method:?}");
        // what is made again as it was is made again with all that follows
        let session = Session::open(&config, &run).unwrap();
        assert_eq!(session.out_of_date(Stage::Mesh).unwrap(), follow);
    }
}

#[test]
fn a_stage_that_the_disk_has_no_room_for_is_refused_before_the_old_one_is_cleared() {
    let (dir, mut config, run) = tiny_run();
    finish(&Session::open(&config, &run).unwrap());
    if io::free_bytes(dir.path()).is_none() {
        eprintln!("skipped: this system does not tell how much room is left");
        return;
    }
    config.iface.log2_table = 40;
    let session = Session::open(&config, &run).unwrap();
    let error = session.fresh(Stage::Iface, Stage::Metrics).unwrap_err();
    assert!(
        error.to_string().contains("`iface` needs about") && error.kind() == ErrorKind::Cannot,
        "{error}"
    );
    for stage in session.order(Stage::Metrics) {
        assert!(run.path(stage).join("done.json").is_file(), "{stage} was cleared");
    }
}

#[test]
fn later_stages_read_masks_in_a_color_as_the_stage_mask_found_them() {
    let (dir, config, run) = tiny_run();
    let root = dir.path().join("head");
    let load = |views: &[tiface_capture::View]| -> Vec<Vec<u8>> {
        views.iter().map(|view| view.load_mask(&Limits::default()).unwrap().unwrap().values).collect()
    };
    let capture = tiface_capture::open(&root, &capture_options(&config)).unwrap();
    let truth = load(&capture.views);
    for (view, mask) in capture.views.iter().zip(&truth) {
        let tiface_capture::ViewMask::File(file) = &view.mask else { panic!("{:?}", view.mask) };
        let blue: Vec<[u8; 3]> = mask.iter().map(|&m| [0, 0, m]).collect();
        io::write_png_rgb(file, view.camera.width, view.camera.height, &blue).unwrap();
    }
    complete(&Session::open(&config, &run).unwrap(), Stage::Mask, &NoFields).unwrap();
    // another process goes on
    let session = Session::open(&config, &run).unwrap();
    assert!(complete(&session, Stage::Mask, &NoFields).unwrap().skipped);
    let close = |found: Vec<Vec<u8>>| {
        found.iter().flatten().zip(truth.iter().flatten()).all(|(found, truth)| found.abs_diff(*truth) <= 16)
    };
    assert!(close(load(&session.refined_capture().unwrap().views)));
    assert!(close(load(&session.evaluation_capture().unwrap().views)));
    assert!(!close(load(&session.capture().views)), "blue is an eighth of luma");
    // and what restores the capture from the run alone
    let restored = scene_file::read_capture(&run.path("cameras.json"), &root).unwrap();
    assert!(close(load(&restored.views)));
}
