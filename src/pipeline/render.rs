//! Stage `render`: the views, one folder per method.
//!
//! ```text
//! render/tface/NAME.png   as asked for: 8-bit or EXR, over the background
//!        tface/depth/     16-bit millimeters beside 8-bit views
//!        tface/float/     the same view for `ensemble`: float, coded, not filtered, no background
//! ```
//!
//! These are the held-out views. Where poses were refined, T-Face and the ray-cast mesh are also
//! shown from the poses fitted to each held-out view alone, in `own_pose/` below the method's
//! folder. Views along a camera path are written to a folder of their own, `render/paths/`.

use super::path::{CameraPath, cameras_of};
use super::pictures;
use super::renderer::Renderer;
use crate::config::{Method, RenderConfig};
use crate::run::StageDir;
use serde_json::{Map, Value, json};
use std::path::PathBuf;
use std::time::{Duration, Instant};
use tiface_base::geom::Camera;
use tiface_base::{Result, io};
use tiface_capture::path::{NamedCamera, orbit};
use tiface_capture::scene::{self, Scene};
use tiface_capture::{Capture, Split};
use tiface_surface::render::RenderedView;

/// Renders one folder per method and one picture per camera, and the `fitted` cameras by the
/// methods that compare poses; `unit_m` is the number of meters in a dataset unit. Methods that
/// show the same surface share its rays, and so the seconds of a view.
pub(super) fn render(
    c: &RenderConfig,
    renderer: &Renderer,
    cameras: &[NamedCamera],
    fitted: &[NamedCamera],
    scene: &Scene,
    unit_m: f64,
    dir: &StageDir,
) -> Result<Value> {
    let own_poses = |m: &Method| if matches!(m, Method::Tface | Method::Raycast) { fitted.len() } else { 0 };
    let total: usize = c.method.iter().map(|m| cameras.len() + own_poses(m)).sum();
    let mut done = 0;
    let mut seconds = Map::new();
    for group in renderer.groups(&c.method) {
        let (mut spent, mut made) = (Duration::ZERO, 0);
        let fitting: Vec<Method> = group.iter().copied().filter(|m| own_poses(m) > 0).collect();
        let given = cameras.iter().map(|camera| (camera, &group, false));
        let own = fitted.iter().map(|camera| (camera, &fitting, true));
        for (NamedCamera { name, camera }, methods, is_own_pose) in given.chain(own) {
            let target = |method: &Method| ViewTarget::new(c, dir, *method, name, is_own_pose);
            // an interrupted process left only complete files of the same settings
            let targets = methods.iter().map(|method| (*method, target(method)));
            let missing: Vec<(Method, ViewTarget)> = targets.filter(|(_, t)| !t.is_complete(c)).collect();
            if !missing.is_empty() {
                let camera = camera.transformed(&scene.scene_from_world);
                let begin = Instant::now();
                let methods: Vec<Method> = missing.iter().map(|(method, _)| *method).collect();
                let views = renderer.views(&methods, &camera)?;
                spent += begin.elapsed();
                made += missing.len();
                dir.check_stop()?; // what it holds then is not whole
                for ((method, target), view) in missing.iter().zip(views) {
                    let filter_px = if *method == Method::Raycast { renderer.pixel_filter_px } else { 0.0 };
                    view.map_or(Ok(()), |view| target.write(view, c, unit_m, filter_px))?;
                }
            }
            done += methods.len();
            dir.step(done, total)?;
        }
        let per_view = spent.as_secs_f64() / made.max(1) as f64;
        seconds.extend(group.iter().map(|m| (m.as_str().to_owned(), json!(per_view))));
    }
    let methods: Vec<_> = c.method.iter().map(|m| m.as_str()).collect();
    let tenths = (10.0 * f64::from(renderer.pixel_filter_px)).round();
    let filter = (tenths > 0.0).then_some(tenths / 10.0);
    Ok(json!({
        "cameras": cameras.len(), "methods": methods, "seconds_per_view": seconds, "pixel_filter_px": filter,
    }))
}

/// Where a view is written.
struct ViewTarget<'a> {
    name: &'a str,
    folder: PathBuf,
    float: Option<PathBuf>,
}

impl<'a> ViewTarget<'a> {
    fn new(
        c: &RenderConfig,
        dir: &StageDir,
        method: Method,
        name: &'a str,
        is_own_pose: bool,
    ) -> ViewTarget<'a> {
        let whole = dir.folder().join(method.as_str());
        match is_own_pose {
            true => ViewTarget { name, folder: whole.join(pictures::OWN_POSE), float: None },
            false => ViewTarget { name, float: c.float.then(|| whole.join(pictures::FLOAT)), folder: whole },
        }
    }

    fn is_complete(&self, c: &RenderConfig) -> bool {
        let files = pictures::files(&self.folder, self.name, self.float.as_deref(), c.format);
        files.iter().all(|file| io::is_file(file))
    }

    /// Writes a view, with its pixels filtered where it is shown: blended, it is to be as sharp as
    /// it can be.
    fn write(&self, mut view: RenderedView, c: &RenderConfig, unit_m: f64, filter_px: f32) -> Result<()> {
        if let Some(float) = &self.float {
            pictures::write_float(float, self.name, &view)?;
        }
        view.filter(filter_px);
        if let Some(background) = pictures::background_color(c.background) {
            pictures::over(&mut view, background);
        }
        Ok(pictures::write(&self.folder, self.name, &view, c.format, unit_m)?)
    }
}

/// Returns the cameras of the evaluation: those held out from training, or all if none is.
pub(super) fn held_out(capture: &Capture) -> Vec<NamedCamera> {
    let mut splits = [Split::Test, Split::Val, Split::Train].map(|s| cameras_of(capture, s)).into_iter();
    splits.find(|cameras| !cameras.is_empty()).unwrap_or_default()
}

/// Returns the cameras to render, named after their photographs if they have one.
pub(super) fn cameras(
    capture: &Capture,
    path: Option<&CameraPath>,
    scene: &Scene,
) -> Result<Vec<NamedCamera>> {
    match path {
        None => Ok(held_out(capture)),
        Some(CameraPath { cameras: Some(cameras), .. }) => Ok(cameras.clone()),
        Some(CameraPath { render, .. }) => {
            let all: Vec<Camera> = capture.views.iter().map(|v| v.camera.clone()).collect();
            Ok(orbit(&all, scene::world_box(scene), capture.up, render.orbit_views as usize)?)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::renderer::Meshes;
    use super::super::renderer::tests::Red;
    use super::*;
    use crate::config::{Config, Preset};
    use crate::run::{Plan, Run};
    use glam::Vec3;
    use tiface_base::geom::{Aabb, Mesh, Similarity};
    use tiface_base::{Fingerprint, Quiet};
    use tiface_surface::files::ExtractedSurface;

    #[test]
    fn fitted_poses_are_shown_beside_the_given_ones_by_t_face_and_the_ray_cast_mesh() {
        let corners = [(-0.5, -0.5), (0.5, -0.5), (0.0, 0.5)].map(|(x, y)| Vec3::new(x, y, 0.0));
        let mesh = Mesh { positions: corners.to_vec(), triangles: vec![[0, 1, 2]], ..Mesh::default() };
        let meshes = Meshes { extracted: Some(ExtractedSurface { mesh, cap: None }), head: None };
        let scene_from_world = Similarity::IDENTITY;
        let scene = Scene { scene_from_world, aabb: Aabb::SCENE, hull: None };
        let named = |height| NamedCamera { name: "a".into(), camera: Camera::above(16, 16, 16.0, height) };
        let folder = tempfile::tempdir().unwrap();
        let run = Run::quiet(folder.path());
        let c = RenderConfig {
            method: vec![Method::Raycast, Method::Textured],
            float: true,
            ..Config::preset(Preset::Draft).render
        };
        let fingerprint = Fingerprint::default();
        let plan = Plan { name: "render", fingerprint, device: "cpu", needs_bytes: 0, saves: false };
        run.stage(plan, |dir| {
            let mut renderer = Renderer::new(&scene, &Red, &meshes, 1, &Quiet);
            renderer.pixel_filter_px = 1.0;
            render(&c, &renderer, &[named(4.0)], &[named(3.0)], &scene, 1.0, dir)
        })
        .unwrap();
        // what is shown is filtered, what is blended is not: its pixels are covered or not
        let float = pictures::float_path(&run.path("render/raycast/float"), "a");
        let sharp = pictures::read_float(&float).unwrap().channel(3);
        assert!(sharp.iter().all(|a| [0.0, 1.0].contains(a)));
        let shown = io::read_photo(&run.path("render/raycast/a.png"), None, &io::Limits::default()).unwrap();
        let soft = shown.alpha.unwrap().iter().filter(|a| (1..255).contains(*a)).count();
        assert!(soft > 8, "{soft}");
        let picture = |place: &str| std::fs::read(run.path("render/raycast").join(place)).unwrap();
        assert_ne!(picture("a.png"), picture("own_pose/a.png"));
        assert!(io::is_file(&run.path("render/raycast/float/a.exr")));
        assert!(!io::is_folder(&run.path("render/raycast/own_pose/float")));
        assert!(!io::is_folder(&run.path("render/textured/own_pose")));
    }
}
