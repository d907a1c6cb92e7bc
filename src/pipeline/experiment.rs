//! The paper's tables: the runs that they are made of and their results. A row is a preset of
//! settings; its run is made by the pipeline like any other, and a finished run is not made again.

use super::inputs::capture_options;
use super::session::Session;
use super::{Stage, complete, learn, reconstruct};
use crate::config::iface::FieldKind;
use crate::config::{
    Config, MaskLoss, MaskSource, MaskUse, Method, Preset, Sources, TruthPhoto, VmBackground, VmConfig,
};
use crate::report::experiment::{ExperimentRow, Measured, Ordering};
use crate::run::{Cost, read_record, read_status};
use serde_json::Value;
use tiface_base::io::{self, Limits};
use tiface_base::{Error, Result};
use tiface_capture as capture;

/// The tables, by their name and heading.
pub const TABLES: [(&str, &str); 4] = [
    ("components", "Components"),
    ("tface", "T-Face: masks and mask losses"),
    ("iface", "I-Face: density, distance, mask, sparsity"),
    ("leaderboard", "Whole systems"),
];

const fn row(
    table: &'static str,
    row: &'static str,
    title: &'static str,
    run: &'static str,
    pictures: &'static str,
) -> ExperimentRow {
    ExperimentRow { table, row, title, run, pictures }
}

/// Every row of every table.
pub const ROWS: [ExperimentRow; 24] = [
    row("components", "baseline", "baseline (TensoRF)", "paper", "baseline"),
    row("components", "iface", "I-Face", "paper", "volume"),
    row("components", "tface", "T-Face", "paper", "tface"),
    row("components", "ensemble", "ensemble", "paper", "ensemble"),
    row("tface", "baseline-reference", "baseline", "paper", "baseline"),
    row("tface", "sam-reference", "+ SAM mask (hard)", "tface-sam", "tface"),
    row("tface", "mask-reference", "+ our mask", "tface-mask", "tface"),
    row("tface", "ce-reference", "+ CE", "tface-ce", "tface"),
    row("tface", "l2-reference", "+ L2 (T-Face)", "paper", "tface"),
    row("tface", "baseline-one", "baseline, one background", "baseline-one", "baseline"),
    row("tface", "sam-one", "+ SAM mask (hard), one background", "tface-sam-one", "tface"),
    row("tface", "mask-one", "+ our mask (soft), one background", "tface-mask-one", "tface"),
    row("tface", "ce-one", "+ CE, one background", "tface-ce-one", "tface"),
    row("tface", "l2-one", "+ L2, one background", "tface-l2-one", "tface"),
    row("iface", "nerf", "Instant-NeRF", "iface-nerf", "volume"),
    row("iface", "bare", "Instant-NeuS", "iface-bare", "volume"),
    row("iface", "mask", "+ mask", "iface-mask", "volume"),
    row("iface", "sparsity", "+ mask + sparsity (I-Face)", "paper", "volume"),
    row("leaderboard", "baseline", "baseline (TensoRF)", "paper", "baseline"),
    row("leaderboard", "paper", "TI-Face as published", "paper", "ensemble"),
    row("leaderboard", "standard", "preset standard", "standard", "ensemble"),
    row("leaderboard", "standard-tface", "its T-Face", "standard", "tface"),
    row("leaderboard", "standard-volume", "its I-Face", "standard", "volume"),
    row("leaderboard", "standard-mesh", "its mesh", "standard", "raycast"),
];

const fn more(table: &'static str, better: &'static str, worse: &'static str, by: &'static str) -> Ordering {
    Ordering { table, better, worse, by, or_equal: false }
}

/// The claims of the paper and of our own rows, for example that a blend is better than each of its
/// members.
pub const ORDERINGS: [Ordering; 15] = [
    more("components", "tface", "baseline", "masked"),
    more("components", "iface", "baseline", "masked"),
    more("components", "tface", "iface", "masked"),
    more("components", "ensemble", "tface", "masked"),
    more("tface", "mask-one", "sam-one", "masked"),
    Ordering { or_equal: true, ..more("tface", "ce-one", "mask-one", "masked") },
    more("tface", "l2-one", "ce-one", "masked"),
    more("tface", "l2-reference", "baseline-reference", "masked"),
    more("tface", "l2-one", "l2-reference", "masked"),
    more("iface", "mask", "bare", "masked"),
    more("iface", "sparsity", "mask", "masked"),
    more("leaderboard", "paper", "baseline", "masked"),
    more("leaderboard", "standard", "standard-tface", "masked"),
    more("leaderboard", "standard", "standard-volume", "masked"),
    more("leaderboard", "standard", "standard-mesh", "masked"),
];

/// Returns the runs that some tables are made of, each once, in the order of the rows.
pub fn runs(tables: &[&str]) -> Vec<&'static str> {
    let mut out = Vec::new();
    for row in ROWS.iter().filter(|row| tables.contains(&row.table)) {
        if !out.contains(&row.run) {
            out.push(row.run);
        }
    }
    out
}

/// Returns whether a run belongs to I-Face's table, which counts the pieces of the surface.
fn has_surface(run: &str) -> bool {
    run.starts_with("iface") || run == "paper"
}

/// Returns the settings of a run, at a share of the published effort; `set` are `KEY=VALUE` pairs
/// applied on top of them.
///
/// A scale of 1 is the publication. Below, rays, voxels, samples and steps of I-Face are that
/// share, steps of T-Face and the baseline its square (each costs more rays and samples, too), and
/// warm-up and annealing follow the steps.
///
/// # Errors
///
/// Fails for an unknown run or for settings that are not allowed.
pub fn config(run: &str, scale: f64, set: &[String]) -> Result<Config> {
    let mut c = full_scale(run)?;
    if scale < 1.0 {
        shrink(&mut c, scale);
    }
    // parsed from text, as the user's settings are, so that ranges are checked and explicit
    // settings win
    let sources = Sources {
        preset: Some(c.preset),
        files: vec![(format!("run `{run}`"), c.to_toml())],
        set: set.to_vec(),
        ..Sources::default()
    };
    Config::resolve(&sources)
}

/// Returns the settings of a run at the published effort.
fn full_scale(run: &str) -> Result<Config> {
    let mut c = Config::preset(if run == "standard" { Preset::Standard } else { Preset::Paper });
    c.metrics.truth = TruthPhoto::Photo;
    let shows = |c: &mut Config, method: Method| {
        c.render.method = vec![method];
        c.ensemble.members = Vec::new();
        c.ensemble.weights = Vec::new();
    };
    let (own, one) = match run.strip_suffix("-one") {
        Some(own) => (own, true),
        None => (run, false),
    };
    let known = ROWS.iter().any(|row| row.run == run);
    match own {
        _ if !known => return Err(unknown(run)),
        "paper" => c.render.method = vec![Method::Baseline, Method::Tface, Method::Volume],
        // Its blend has two members; the table shows the field between them too.
        "standard" => c.render.method.push(Method::Volume),
        "baseline" => shows(&mut c, Method::Baseline),
        iface if iface.starts_with("iface") => {
            shows(&mut c, Method::Volume);
            c.iface.sparsity = 0.0;
        }
        _ => shows(&mut c, Method::Tface),
    }
    let t = &mut c.tface;
    (t.masks, t.mask_loss) = match own {
        "tface-sam" => (MaskUse::Hard, MaskLoss::None),
        "tface-mask" => (MaskUse::Binary, MaskLoss::None),
        "tface-ce" => (MaskUse::Binary, MaskLoss::Ce),
        _ => (t.masks, t.mask_loss),
    };
    if one {
        t.background = VmBackground::Random; // the baseline's is black then
        if t.masks == MaskUse::Binary {
            t.masks = MaskUse::Soft;
        }
    }
    match own {
        "iface-nerf" => {
            c.iface.field = FieldKind::Density;
            (c.iface.base_resolution, c.iface.growth) = (16, 1.447_269_237_440_378);
            c.mesh.resolution = 256;
        }
        "iface-bare" => {
            c.mask.source = MaskSource::None;
            c.iface.mask = 0.0;
        }
        _ => {}
    }
    Ok(c)
}

/// Adapts the settings of a run to a capture without masks, if the run needs none; returns them
/// unchanged otherwise.
pub fn without_masks(run: &str, config: &mut Config) {
    let options = capture_options(config);
    let bare = || {
        let capture = capture::open(&config.capture.path, &options)?;
        capture::require_masks(&capture, &options)
    };
    if run == "baseline-one" && bare().is_err() {
        config.mask.source = MaskSource::None;
    }
}

fn unknown(run: &str) -> Error {
    let known: Vec<&str> = runs(&TABLES.map(|t| t.0));
    Error::usage(format!("no table has a run `{run}`"), format!("runs are {}", known.join(", ")))
}

/// Scales the effort of all settings down.
fn shrink(c: &mut Config, scale: f64) {
    let share = |n: u64, by: f64, least: u64| ((n as f64 * by).round() as u64).max(least.min(n));
    let published = c.preset == Preset::Paper;
    // our own presets already have few steps of many rays
    let (of_steps, of_rays) = if published { (scale * scale, scale) } else { (scale.sqrt(), 1.0) };
    let radiance = |t: &mut VmConfig| {
        t.steps = share(t.steps, of_steps, 50);
        t.rays = share(t.rays as u64, of_rays, 256) as usize;
        if published {
            t.voxels_start = share(t.voxels_start, scale, 8000);
            t.voxels_final = share(t.voxels_final, scale, 27_000).max(t.voxels_start);
        }
    };
    radiance(&mut c.tface);
    c.baseline.steps = share(c.baseline.steps, of_steps, 50);
    c.baseline.rays = share(c.baseline.rays as u64, of_rays, 256) as usize;
    let i = &mut c.iface;
    i.steps = share(i.steps, if published { scale } else { scale.sqrt() }, 100);
    if published {
        i.samples = share(i.samples as u64, scale, 4096) as usize;
        i.max_rays = share(i.max_rays as u64, scale, 256) as usize;
        i.rays = i.rays.min(i.max_rays);
        i.log2_table = ((f64::from(i.log2_table) + scale.log2()).round() as u32).clamp(14, i.log2_table);
    }
    c.mesh.resolution = share(c.mesh.resolution.into(), scale.sqrt(), 96) as u32;
}

/// Completes the unfinished stages of a run. I-Face's rows count surfaces, so a missing surface is
/// a result and no error.
pub fn work(session: &Session, run: &str) -> Result<()> {
    session.remember(Stage::Metrics)?;
    reconstruct(session, Stage::Metrics)?;
    if has_surface(run) {
        let fields = learn::trained_fields(session);
        match complete(session, Stage::Mesh, &fields) {
            Err(e) if !e.is_no_surface() => return Err(e),
            _ => {}
        }
    }
    Ok(())
}

/// Returns the stages that a run is made of.
fn stages(session: &Session, run: &str) -> Vec<Stage> {
    let mut order = session.order(Stage::Metrics);
    order.extend(has_surface(run).then_some(Stage::Mesh));
    order
}

/// Returns the errors of a run's failed stages, and the first stage that is not done with the
/// session's settings.
fn problems(session: &Session, run: &str) -> Vec<String> {
    let failed = |stage: Stage| {
        let status = read_status(&session.run.path(stage)).ok().flatten()?;
        Some(format!("stage `{stage}`: {}", status.error?))
    };
    let mut out: Vec<String> = Stage::ALL.into_iter().filter_map(failed).collect();
    let plans: Vec<_> = stages(session, run).into_iter().map(|stage| session.plan(stage)).collect();
    if let Some(e) = plans.iter().find_map(|plan| session.run.agrees(plan).err()) {
        out.push(e.to_string());
    } else if let Some(plan) = plans.iter().find(|plan| !session.run.is_done(plan))
        && out.is_empty()
    {
        out.push(format!("stage `{}` is not done yet", plan.name));
    }
    // each changed setting is on a line of its own; a problem must fit on one line
    out.iter().map(|text| text.replace(":\n  ", ": ").replace("\n  ", ", ")).collect()
}

/// Returns the results of a row in its run. Figures count only if the run's stages are done with
/// the session's configuration; results of other settings in the same folder are ignored.
pub fn measured(session: &Session, row: &ExperimentRow) -> Measured {
    let mut out = Measured::default();
    let mut problems = problems(session, row.run);
    if session.order(Stage::Metrics).into_iter().all(|stage| session.run.is_done(&session.plan(stage))) {
        match io::read_json(&session.run.path("metrics/metrics.json"), &Limits::default()) {
            Ok(value) => out = figures(session, row, &value),
            Err(e) => problems.push(e.to_string()),
        }
    }
    out.problem = (!problems.is_empty()).then(|| problems.join("; "));
    out
}

/// Returns the figures of a row whose stages are done; `value` is the content of `metrics.json`.
fn figures(session: &Session, row: &ExperimentRow, value: &Value) -> Measured {
    let mut out = Measured::default();
    let set = &value[row.pictures];
    let list = |part: &str| set[part]["views"].as_array().cloned().unwrap_or_default();
    let (heads, regions) = (list("head"), list("region"));
    for head in &heads {
        let name = head["name"].as_str().unwrap_or_default();
        let region = regions.iter().find(|r| r["name"] == head["name"]);
        let of = |key: &str| head[key].as_f64();
        let region = region.and_then(|r| r["psnr_masked"].as_f64());
        out.figures.push([of("psnr_masked"), of("psnr"), region, of("ssim_masked"), of("ssim"), of("lpips")]);
        out.views.push(name.into());
    }
    out.masks = value["truth"]["masks"].as_str().map(String::from);
    out.outside = set["mean_square_opacity_outside"].as_f64();
    let summary = |stage: Stage| {
        read_record(&session.run.path(stage)).ok().flatten().map_or(Value::Null, |r| r.summary)
    };
    let shown = summary(Stage::Render);
    // a time of 0 means that an interrupted process had rendered all views, so the time they took
    // is unknown
    let seconds = |method: &str| shown["seconds_per_view"][method].as_f64().filter(|s| *s > 0.0);
    out.seconds = match row.pictures {
        "ensemble" => {
            let blend = summary(Stage::Ensemble)["seconds_per_view"].as_f64();
            let members = session.config.ensemble.members.iter().map(|member| seconds(member.as_str()));
            members.chain([blend]).sum()
        }
        method => seconds(method),
    };
    if row.table == "iface" && has_surface(row.run) && session.run.is_done(&session.plan(Stage::Mesh)) {
        out.pieces = summary(Stage::Mesh)["report"]["topology"]["pieces"].as_u64();
    }
    out
}

/// Returns the estimated cost of the unfinished stages of a run, one after the other; `None` if all
/// are done.
pub fn ahead(session: &Session, run: &str) -> Result<Option<Cost>> {
    let is_left = |stage: &Stage| !session.run.is_done(&session.plan(*stage));
    let left: Vec<Stage> = stages(session, run).into_iter().filter(is_left).collect();
    session.require_work(&left)?;
    Ok(left.into_iter().map(|stage| session.cost(stage)).reduce(|sum, cost| sum + cost))
}

#[cfg(test)]
mod tests {
    use super::super::tests::demo_head;
    use super::*;
    use crate::run::Run;
    use glam::Vec3;
    use serde_json::json;
    use std::path::{Path, PathBuf};
    use tiface_base::Quiet;
    use tiface_base::geom::Aabb;
    use tiface_surface::extract_dense;

    /// Writes a tiny capture into a folder and returns its path.
    fn head(dir: &Path) -> PathBuf {
        let root = dir.join("head");
        demo_head(&root, (32, 40), (8, 2));
        root
    }

    fn row_of(table: &str, row: &str) -> ExperimentRow {
        ROWS.into_iter().find(|r| r.table == table && r.row == row).unwrap()
    }

    #[test]
    fn every_row_has_a_run_whose_pictures_it_names() {
        for row in ROWS {
            let c = config(row.run, 1.0, &[]).unwrap();
            let made = c.render.method.iter().any(|m| m.as_str() == row.pictures);
            let blended = row.pictures == "ensemble" && !c.ensemble.members.is_empty();
            assert!(made || blended, "{row:?}");
            assert_eq!(c.metrics.truth, TruthPhoto::Photo);
            assert!(TABLES.iter().any(|t| t.0 == row.table));
        }
        for o in ORDERINGS {
            for row in [o.better, o.worse] {
                assert!(ROWS.iter().any(|r| r.table == o.table && r.row == row), "{o:?}");
            }
        }
        assert_eq!(runs(&["components"]), ["paper"]);
        assert_eq!(runs(&TABLES.map(|t| t.0)).len(), 13);
        assert!(config("tface-best", 1.0, &[]).unwrap_err().hint().contains("tface-mask"));
    }

    #[test]
    fn rows_differ_from_the_paper_by_what_their_names_say() {
        let paper = config("paper", 1.0, &[]).unwrap();
        assert_eq!(paper.tface, Config::preset(Preset::Paper).tface);
        let t = |run: &str| config(run, 1.0, &[]).unwrap().tface;
        assert_eq!(t("tface-ce"), VmConfig { mask_loss: MaskLoss::Ce, ..paper.tface.clone() });
        assert_eq!(
            t("tface-l2-one"),
            VmConfig { background: VmBackground::Random, masks: MaskUse::Soft, ..paper.tface.clone() }
        );
        let hard = VmConfig { masks: MaskUse::Hard, mask_loss: MaskLoss::None, ..paper.tface.clone() };
        assert_eq!(t("tface-sam"), hard);
        let b = config("baseline-one", 1.0, &[]).unwrap().radiance(Stage::Baseline);
        assert_eq!((b.background, b.masks), (VmBackground::Black, MaskUse::None));
        let i = |run: &str| config(run, 1.0, &[]).unwrap();
        assert_eq!((i("iface-mask").iface.sparsity, i("iface-mask").iface.mask), (0.0, 0.1));
        assert_eq!((i("iface-bare").iface.mask, i("iface-bare").mask.source), (0.0, MaskSource::None));
        assert_eq!(i("iface-nerf").iface.field, FieldKind::Density);
    }

    #[test]
    fn less_effort_keeps_what_makes_a_row_and_settings_win() {
        let c = config("paper", 0.1, &["tface.steps=77".into(), "seed=5".into()]).unwrap();
        assert_eq!((c.tface.steps, c.baseline.steps, c.iface.steps, c.seed), (77, 500, 2000, 5));
        assert_eq!((c.tface.rays, c.tface.voxels_final, c.iface.samples), (410, 2_700_000, 26_214));
        assert_eq!(c.iface.log2_table, 16);
        assert!(config("paper", 0.1, &["tface.stepz=1".into()]).is_err());
        // no setting names shares of the steps themselves, so that none is overwritten
        for constant in ["iface.warmup", "iface.anneal_end"] {
            let e = config("paper", 0.1, &[format!("{constant}=7")]).unwrap_err().to_string();
            assert!(e.ends_with(&format!("there is no key `{constant}`")), "{e}");
        }
    }

    #[test]
    fn a_capture_without_masks_has_the_rows_that_learn_from_none() {
        let dir = tempfile::tempdir().unwrap();
        let path = head(dir.path());
        let opens = |run: &str| {
            let mut c = config(run, 0.01, &["device=cpu".into()]).unwrap();
            c.capture.path.clone_from(&path);
            without_masks(run, &mut c);
            let run = Run::quiet(&dir.path().join("run"));
            Session::open(&c, &run).map(|_| c.mask.source)
        };
        assert!(opens("baseline-one").is_ok_and(|source| source == MaskSource::Auto));
        std::fs::remove_dir_all(path.join("masks")).unwrap();
        for file in ["transforms.json", "transforms_train.json", "transforms_test.json"] {
            let file = path.join(file);
            let text = std::fs::read_to_string(&file).unwrap();
            std::fs::write(&file, text.replace("mask_path", "no_path")).unwrap();
        }
        let bare = ["baseline-one", "iface-bare"].map(|run| opens(run).unwrap());
        assert_eq!(bare, [MaskSource::None; 2]);
        for run in ["paper", "tface-l2-one", "standard"] {
            let e = opens(run).unwrap_err().to_string();
            assert!(e.contains("mask"), "{run}: {e}");
        }
    }

    #[test]
    fn a_device_that_is_set_is_that_of_every_run() {
        let device = |run: &str| config(run, 1.0, &["device=wgpu:1".into()]).unwrap().device;
        assert_eq!(["iface-nerf", "iface-bare", "paper"].map(device), ["wgpu:1"; 3]);
        assert!(config("iface-nerf", 1.0, &["device=gpu".into()]).is_err());
    }

    /// Stages that are marked as done without any work, in a folder that is then queried with other
    /// settings.
    #[test]
    fn figures_count_only_where_the_stages_are_done_as_asked_for() {
        let dir = tempfile::tempdir().unwrap();
        let path = head(dir.path());
        let of = |scale: f64| {
            let mut c = config("paper", scale, &["device=cpu".into()]).unwrap();
            c.capture.path.clone_from(&path);
            c
        };
        let (c, other) = (of(0.01), of(0.02));
        let run = Run::quiet(&dir.path().join("run"));
        let session = Session::open(&c, &run).unwrap();
        let view = json!([{"name": "v", "psnr_masked": 30.0, "psnr": 20.0}]);
        let set = json!({"head": {"views": view}});
        let metrics =
            json!({"volume": set, "ensemble": set, "truth": {"photographs": "photo", "masks": "run"}});
        for stage in session.order(Stage::Metrics) {
            let made = run.stage(session.plan(stage), |dir| match stage {
                Stage::Render => {
                    Ok(json!({"seconds_per_view": {"baseline": 1.5, "tface": 2.0, "volume": 4.0}}))
                }
                Stage::Ensemble => Ok(json!({"seconds_per_view": 0.5})),
                Stage::Metrics => {
                    io::write_atomic(&dir.folder().join("metrics.json"), metrics.to_string().as_bytes())?;
                    Ok(Value::Null)
                }
                _ => Ok(Value::Null),
            });
            made.unwrap();
        }
        let (surface, blend) = (row_of("iface", "sparsity"), row_of("components", "ensemble"));
        let problem_of = |m: &Measured| m.problem.clone().unwrap_or_default();

        // the row needs a surface, too; a missing one is a result and reported as such
        let found = measured(&session, &surface);
        assert_eq!((found.figures.len(), problem_of(&found).as_str()), (1, "stage `mesh` is not done yet"));
        let none = run.stage(session.plan(Stage::Mesh), |_| {
            extract_dense(&|_: Vec3| 1.0, Aabb::SCENE, 9, &Quiet)?;
            Ok(Value::Null)
        });
        assert!(none.unwrap_err().is_no_surface());
        let found = measured(&session, &surface);
        assert!(found.figures.len() == 1 && found.pieces.is_none(), "{found:?}");
        assert!(problem_of(&found).starts_with("stage `mesh`: no surface"), "{found:?}");
        // of every row of the run
        assert_eq!(problem_of(&measured(&session, &blend)), problem_of(&found));
        run.stage(session.plan(Stage::Mesh), |_| Ok(json!({"report": {"topology": {"pieces": 3}}}))).unwrap();
        let found = measured(&session, &surface);
        assert_eq!((found.pieces, found.seconds, found.problem), (Some(3), Some(4.0), None));
        assert_eq!(found.masks.as_deref(), Some("run"));
        // its members' 1.5, 2 and 4, and 0.5 of the blend
        assert_eq!(measured(&session, &blend).seconds, Some(8.0));

        // a different mesh: the figures of the views still count, the pieces do not
        let mut finer = c.clone();
        finer.mesh.resolution += 1;
        let found = measured(&Session::open(&finer, &run).unwrap(), &surface);
        assert!(found.figures.len() == 1 && found.pieces.is_none(), "{found:?}");
        assert!(
            problem_of(&found).contains("stage `mesh` was done with other settings: mesh.resolution: was")
        );

        // a different scale: no figure counts
        let session = Session::open(&other, &run).unwrap();
        let refused = work(&session, "paper").unwrap_err();
        assert!(refused.to_string().contains("was done with other settings") && !refused.is_no_surface());
        for row in [surface, blend] {
            let found = measured(&session, &row);
            assert!(found.views.is_empty() && found.figures.is_empty());
            assert_eq!((found.seconds, found.pieces, found.masks.clone()), (None, None, None));
            let problem = problem_of(&found);
            assert!(
                problem.contains("was done with other settings: ") && !problem.contains('\n'),
                "{problem}"
            );
            assert!(problem.contains("voxels_final: was "), "{problem}");
        }
    }

    /// Two rows of a tiny capture are made, read, and not made again.
    #[test]
    fn a_row_is_made_measured_and_not_made_again() {
        let dir = tempfile::tempdir().unwrap();
        let less = ["tface.steps=12", "tface.rays=128", "tface.voxels_start=1000", "tface.voxels_final=2000"];
        let less = less.map(String::from);
        let mut c = config("tface-ce-one", 0.01, &less).unwrap();
        c.capture.path = head(dir.path());
        let run = Run::quiet(&dir.path().join("run"));
        let row = row_of("tface", "ce-one");
        let session = Session::open(&c, &run).unwrap();
        assert_eq!(measured(&session, &row).problem.as_deref(), Some("stage `mask` is not done yet"));
        work(&session, row.run).unwrap();
        assert!(ahead(&session, row.run).unwrap().is_none());
        let found = measured(&session, &row);
        assert_eq!((found.views.len(), found.problem.clone()), (2, None));
        assert_eq!(found.masks.as_deref(), Some("capture"));
        assert!(found.figures.iter().all(|f| f[0].is_some() && f[1].is_some()) && found.seconds.is_some());
        let when = |file: &str| std::fs::metadata(run.path(file)).unwrap().modified().unwrap();
        let before = when("tface/checkpoint.safetensors");
        work(&session, row.run).unwrap();
        assert_eq!(when("tface/checkpoint.safetensors"), before);
    }
}
