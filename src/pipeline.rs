//! The pipeline: from photographs to a mesh, views and metrics. Stages meet only in this module.
//!
//! ```text
//! mask      which pixels are the head, and where the head is in space
//! baseline  a radiance field trained on whole photographs
//! tface     the same, trained on masked photographs
//! iface     a signed distance field trained on the masked photographs
//! mesh      its zero level set, closed, in the dataset's world
//! render    held-out views, by marching the fields and by casting rays at the mesh
//! ensemble  blends those views into one
//! metrics   compares all of them with the photographs
//! ```
//!
//! Views from other cameras, a turntable for example, are a separate output of the pipeline
//! ([`Session::with_camera_path`]).
//!
//! Each stage names the stages that it reads from ([`Stage::needs`]); a command runs what its stage
//! needs and nothing else. A stage is determined by its settings and by those of the stages it
//! needs, which are known before it runs. So all fingerprints can be computed at once
//! ([`Session::plan`]), a dry run lists what would be done, and a finished stage is skipped without
//! loading anything. The device is not part of the fingerprint, because it decides how fast a field
//! is trained, not what the field is.

mod advice;
mod bench;
mod cameras;
mod clean;
mod clicks;
mod compare;
mod cost;
mod ensemble;
pub mod experiment;
mod export;
mod exposure;
mod finish;
mod frames;
mod glare;
mod hair_views;
mod inputs;
mod learn;
mod mask;
mod mesh;
mod mesh_files;
mod metrics;
mod page;
mod path;
mod pictures;
mod plan;
mod preview;
mod readings;
mod render;
mod renderer;
mod rig_photos;
mod scene_file;
mod session;
mod surface;
mod truth;

pub use crate::config::Stage;
pub use bench::{Bench, SWEEPS};
pub use clean::{cost_of_removal, remove_surplus, stage_folders, surplus};
pub use compare::{Judged, compare_runs, judge};
pub use export::{Cut, ExportRequest, KeptHead, Size};
pub use frames::MeshFrame;
pub use inputs::capture_options;
pub use mask::{click_page, inspect_capture};
pub use mesh_files::{Export, Material};
pub use page::{curves, head_page, renew_report, viewer_of_file};
pub use preview::{Preview, PreviewPicture, PreviewRenderer, field_view};
pub use readings::open_capture;
pub use session::{DEMO_CAPTURE, Session, check_feasible, require_device};
pub use surface::{Fields, Radiance, Surface};
pub use tiface_base::geom::RayResult;
pub use truth::{Truth, against_truth};

use crate::run::{Done, StageDir};
use renderer::{Meshes, Renderer};
use tiface_base::{Result, io};
use tiface_kernels as kernel;

/// Completes `until` and every stage that it needs, and writes the report.
pub fn reconstruct(session: &Session, until: Stage) -> Result<Vec<(Stage, Done)>> {
    let fields = learn::trained_fields(session);
    let mut done = Vec::new();
    for stage in session.order(until) {
        done.push((stage, complete(session, stage, &fields)?));
    }
    let idle = done.iter().all(|(_, stage)| stage.skipped);
    page::write_report(session, idle)?;
    Ok(done)
}

/// Completes a stage from the outputs of the stages before it, or skips it if it is done. `fields`
/// are the trained fields; only a stage that has work to do loads them.
pub fn complete(session: &Session, stage: Stage, fields: &dyn Fields) -> Result<Done> {
    let Session { capture, config, run, .. } = session;
    if stage == Stage::Ensemble {
        ensemble::can_blend(config)?;
    }
    let work = |dir: &StageDir| match stage {
        Stage::Mask => {
            session.inputs.write(dir.folder())?;
            capture.warnings.iter().for_each(|text| dir.keep_warning(text));
            mask::mask(capture, session.inputs.clicks.as_ref(), config, dir)
        }
        Stage::Baseline | Stage::Tface | Stage::Iface => {
            learn::learn(stage, session.refined_capture()?, &session.scene()?, config, dir)
        }
        Stage::Mesh => mesh::mesh(session.refined_capture()?, &session.scene()?, fields, config, dir),
        Stage::Render => {
            let (scene, c) = (session.scene()?, session.render_config());
            let cameras = render::cameras(session.refined_capture()?, session.path.as_ref(), &scene)?;
            let check = session.camera_check()?.filter(|_| session.path.is_none());
            let fitted = check.map_or(Vec::new(), |check| check.fitted(&cameras));
            let meshes = Meshes::load(run, config, &c.method)?;
            let renderer = Renderer::new(&scene, fields, &meshes, c.samples, dir.monitor());
            let renderer = match c.shows_residuals(&c.method) {
                true => {
                    let (capture, leaves_out_own) = (session.refined_capture()?, session.path.is_none());
                    let renderer = renderer.with_pixel_filter(capture, &scene, config)?;
                    let residuals = renderer.residuals(capture, &scene, config, leaves_out_own)?;
                    dir.check_stop()?; // residuals of a stopped stage lack views
                    if leaves_out_own && ensemble::fits_with_residuals(config) {
                        session.keep_residuals(residuals.clone());
                    }
                    renderer.with_residuals(residuals)
                }
                false => renderer,
            };
            render::render(c, &renderer, &cameras, &fitted, &scene, config.capture.unit_m, dir)
        }
        Stage::Ensemble => {
            let residuals = session.take_residuals();
            ensemble::ensemble(
                session.refined_capture()?,
                config,
                run,
                &session.scene()?,
                fields,
                residuals,
                dir,
            )
        }
        Stage::Metrics => {
            let has_mesh = session.order(Stage::Metrics).contains(&Stage::Mesh);
            let demo = has_mesh && session::is_demo(config, run);
            let surface = demo.then(|| mesh::surface_in_world(run)).transpose()?;
            let evaluated = session.evaluation_capture()?;
            let masks = session.mask_source(&evaluated);
            let exposure = session.exposure()?;
            metrics::metrics(&evaluated, config, run, masks, surface.as_ref(), exposure.as_ref(), dir)
        }
    };
    let done = run.stage(session.plan(stage), |dir| {
        let summary = work(dir)?;
        if matches!(stage, Stage::Mesh | Stage::Render | Stage::Ensemble) {
            fields.warnings().into_iter().for_each(|text| dir.warn(text));
        }
        Ok(summary)
    })?;
    if !done.skipped {
        give_memory_back();
    }
    if stage == Stage::Mask {
        session.write_cameras(done.skipped)?;
    }
    Ok(done)
}

/// Frees what a stage kept for its next step, so that the next stage begins with the memory that it
/// needs itself.
fn give_memory_back() {
    kernel::cpu::pool::clear();
    io::give_memory_back();
}

#[cfg(test)]
mod cameras_tests;
#[cfg(test)]
mod clicks_tests;
#[cfg(test)]
mod ensemble_tests;
#[cfg(test)]
mod exposure_tests;
#[cfg(test)]
mod formula_tests;
#[cfg(test)]
mod glare_tests;
#[cfg(test)]
mod path_tests;
#[cfg(test)]
mod plan_tests;
#[cfg(test)]
mod session_tests;
#[cfg(test)]
mod tests;
