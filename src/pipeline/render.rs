//! Stage `render`: the views, one folder per method.
//!
//! ```text
//! render/tface/NAME.png   as asked for: 8-bit or EXR, over the background
//!        tface/depth/     16-bit millimeters beside 8-bit views
//!        tface/float/     the same view for `ensemble`: float, coded, no background
//! ```
//!
//! These are the held-out views. Where poses were refined, T-Face and the ray-cast mesh are also
//! shown from the poses fitted to each held-out view alone, in `own_pose/` below the method's
//! folder. Views along a camera path are written to a folder of their own, `render/paths/`.

use super::learn;
use super::mesh::{extracted_surface, head_mesh};
use super::path::{CameraPath, cameras_of};
use super::pictures;
use super::surface::{Fields, march};
use crate::capture::path::{NamedCamera, orbit};
use crate::capture::scene::{self, Scene};
use crate::capture::{Capture, Split};
use crate::config::{ColorSource, Config, Method, RenderConfig};
use crate::run::{Run, StageDir};
use serde_json::{Map, Value, json};
use std::time::{Duration, Instant};
use tiface_base::geom::{Bvh, Camera, Ray, ShellCaster, Similarity};
use tiface_base::io;
use tiface_base::{Error, Monitor, Result};
use tiface_surface::files::{ExtractedSurface, HeadMesh};
use tiface_surface::render::{
    LobePictures, MeshTexture, RasterLayers, RasterOptions, RayHits, RaycastOptions, RenderedView,
    ResidualSource, ResidualView, Residuals, Surface, raster, raycast,
};

/// Renders one folder per method and one picture per camera, and the `fitted` cameras by the
/// methods that compare poses; `unit_m` is the number of meters in a dataset unit.
pub(super) fn render(
    c: &RenderConfig,
    renderer: &Renderer,
    cameras: &[NamedCamera],
    fitted: &[NamedCamera],
    scene: &Scene,
    unit_m: f64,
    dir: &StageDir,
) -> Result<Value> {
    let background = pictures::background_color(c.background);
    let own_poses = |m: Method| if matches!(m, Method::Tface | Method::Raycast) { fitted } else { &[] };
    let total: usize = c.method.iter().map(|&m| cameras.len() + own_poses(m).len()).sum();
    let mut done = 0;
    let mut seconds = Map::new();
    for &method in &c.method {
        let (mut spent, mut made) = (Duration::ZERO, 0);
        let whole = dir.folder().join(method.as_str());
        let own = own_poses(method).iter().map(|camera| (camera, whole.join(pictures::OWN_POSE), None));
        let float = c.float.then(|| whole.join(pictures::FLOAT));
        let given = cameras.iter().map(|camera| (camera, whole.clone(), float.clone()));
        for (NamedCamera { name, camera }, folder, float) in given.chain(own) {
            let files = pictures::files(&folder, name, float.as_deref(), c.format);
            // an interrupted process left only complete files of the same settings
            if !files.iter().all(|file| io::is_file(file)) {
                let camera = camera.transformed(&scene.scene_from_world);
                let begin = Instant::now();
                let view = renderer.view(method, &camera)?;
                spent += begin.elapsed();
                made += 1;
                dir.check_stop()?; // what it holds then is not whole
                if let Some(mut view) = view {
                    if let Some(float) = &float {
                        pictures::write_float(float, name, &view)?;
                    }
                    if let Some(background) = background {
                        pictures::over(&mut view, background);
                    }
                    pictures::write(&folder, name, &view, c.format, unit_m)?;
                }
            }
            done += 1;
            dir.step(done, total)?;
        }
        let per_view = spent.as_secs_f64() / made.max(1) as f64;
        seconds.insert(method.as_str().to_owned(), json!(per_view));
    }
    let methods: Vec<_> = c.method.iter().map(|m| m.as_str()).collect();
    Ok(json!({"cameras": cameras.len(), "methods": methods, "seconds_per_view": seconds}))
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

/// Returns whether some methods show the head mesh. Fitted colors lie on it; the network's colors
/// are evaluated on the extracted surface.
pub(super) fn shows_head(config: &Config, methods: &[Method]) -> bool {
    let fitted = config.mesh.color == ColorSource::Photographs;
    let shows =
        |m: &Method| matches!(m, Method::Textured | Method::Raster) || *m == Method::Raycast && fitted;
    methods.iter().any(shows)
}

/// The meshes that the chosen methods show.
pub(super) struct Meshes {
    extracted: Option<ExtractedSurface>,
    head: Option<HeadMesh>,
    /// Whether the head is shown as a viewer shows it, and with view-dependent color.
    shown: [bool; 2],
}

impl Meshes {
    /// Loads the meshes that `methods` show from the run.
    pub fn load(run: &Run, config: &Config, methods: &[Method]) -> Result<Meshes> {
        let (raycast, textured) = (methods.contains(&Method::Raycast), methods.contains(&Method::Textured));
        let raster = methods.contains(&Method::Raster);
        let fitted = config.mesh.color == ColorSource::Photographs;
        let extracted = (raycast && !fitted).then(|| extracted_surface(run)).transpose()?;
        let head = shows_head(config, methods).then(|| head_mesh(run)).transpose()?;
        if textured && head.as_ref().is_some_and(|head| head.texture.is_none()) {
            return Err(Error::cannot(
                "the mesh has no texture to be shown",
                "make one: `tiface mesh RUN --fresh mesh --texture 2048`",
            ));
        }
        Ok(Meshes { extracted, head, shown: [textured || raster, raycast && fitted] })
    }

    /// Prepares a head mesh for rendering as a viewer shows it and with view-dependent color.
    pub fn of_head(head: HeadMesh, shown: [bool; 2]) -> Meshes {
        Meshes { extracted: None, head: Some(head), shown }
    }
}

/// The head mesh with its acceleration structure.
pub(super) struct VisibleHead<'a> {
    head: &'a HeadMesh,
    bvh: Bvh,
    shells: Option<ShellCaster<'a>>,
    layers: Option<RasterLayers<'a>>,
    /// The texture as an ordinary viewer shows it.
    shown: Option<MeshTexture>,
    /// The base color alone.
    base: Option<MeshTexture>,
}

impl<'a> VisibleHead<'a> {
    /// Prepares a head to be shown as a viewer shows it, and with view-dependent color.
    pub fn new(head: &'a HeadMesh, shown: [bool; 2]) -> VisibleHead<'a> {
        let (mesh, world_from_scene) = (&head.mesh, head.world_from_scene.rotation_f32());
        let texture = |lobes: bool| {
            let texture = head.texture.as_ref()?;
            let lobes = texture.lobes.as_ref().filter(|_| lobes).map(|l| LobePictures {
                pictures: &l.pictures,
                scale: &l.scale,
                turned: l.asset_from_world * world_from_scene,
            });
            Some(MeshTexture::new(mesh, &texture.atlas, &texture.color, lobes.as_ref()))
        };
        let [shown, base] = [(shown[0], true), (shown[1], false)]
            .map(|(is_shown, lobes)| is_shown.then(|| texture(lobes)).flatten());
        let shells = head.shells.as_ref().map(|shells| ShellCaster::new(mesh, shells));
        let layers = head.shells.as_ref().map(|shells| RasterLayers::new(mesh, shells));
        VisibleHead { head, bvh: Bvh::new(mesh), shells, layers, shown, base }
    }

    /// Renders a view with its soft layers, in these colors.
    fn view(
        &self,
        camera: &Camera,
        options: &RaycastOptions,
        color: impl Fn(&RayHits) -> Vec<[f32; 3]> + Sync,
    ) -> RenderedView {
        raycast(&self.bvh, &self.head.mesh, self.shells.as_ref(), camera, options, color)
    }

    /// Renders a view as a viewer shows the head: with its texture or the colors of its vertices,
    /// else in gray, lit from the camera.
    pub fn as_in_viewer(&self, camera: &Camera, options: &RaycastOptions) -> RenderedView {
        let mesh = &self.head.mesh;
        self.view(camera, options, |hits| match &self.shown {
            Some(texture) => texture.colors(hits, camera, options.samples),
            None if mesh.colors.is_empty() => {
                let normals = hits.normals.iter().zip(&hits.directions);
                normals.map(|(n, d)| [n.dot(*d).abs(); 3]).collect()
            }
            None => hits.hits.iter().map(|hit| mesh.color_at(hit)).collect(),
        })
    }

    /// Returns the sRGB-coded colors of hits, with view-dependent color.
    fn colors(&self, hits: &RayHits, camera: &Camera, samples: u32) -> Vec<[f32; 3]> {
        let mesh = &self.head.mesh;
        let mut colors = match &self.base {
            Some(texture) => texture.colors(hits, camera, samples),
            None => hits.hits.iter().map(|hit| mesh.color_at(hit)).collect(),
        };
        if let Some(harmonics) = &self.head.harmonics {
            for ((color, hit), &direction) in colors.iter_mut().zip(&hits.hits).zip(&hits.directions) {
                let more = harmonics.seen_along(direction, hit, mesh.triangles[hit.triangle as usize]);
                (0..3).for_each(|k| color[k] = (color[k] + more[k]).clamp(0.0, 1.0));
            }
        }
        colors
    }
}

/// Renders views by any method.
pub(super) struct Renderer<'a> {
    fields: &'a dyn Fields,
    extracted: Option<(&'a ExtractedSurface, Bvh)>,
    head: Option<VisibleHead<'a>>,
    samples: u32,
    world_from_scene: Similarity,
    /// Residuals of ray casting in the training photographs.
    residuals: Option<Residuals>,
    monitor: &'a dyn Monitor,
}

impl<'a> Renderer<'a> {
    /// Returns a renderer of these fields and meshes; `samples` is the number of rays along each
    /// side of a pixel that shows a mesh.
    pub fn new(
        scene: &Scene,
        fields: &'a dyn Fields,
        meshes: &'a Meshes,
        samples: u32,
        monitor: &'a dyn Monitor,
    ) -> Renderer<'a> {
        Renderer {
            fields,
            extracted: meshes.extracted.as_ref().map(|s| (s, Bvh::new(&s.mesh))),
            head: meshes.head.as_ref().map(|head| VisibleHead::new(head, meshes.shown)),
            samples,
            world_from_scene: scene.scene_from_world.inverse(),
            residuals: None,
            monitor,
        }
    }

    /// Returns the renderer with the residuals of the training views, which ray casting then adds
    /// to other views. With `leaves_out_own`, a training view adds nothing to a view from its own
    /// position.
    pub fn with_residuals(
        mut self,
        capture: &Capture,
        scene: &Scene,
        config: &Config,
        leaves_out_own: bool,
    ) -> Result<Renderer<'a>> {
        let meshes =
            [self.extracted.as_ref().map(|(s, _)| &s.mesh), self.head.as_ref().map(|h| &h.head.mesh)];
        let Some(mesh) = meshes.into_iter().flatten().next() else { return Ok(self) };
        // depth in the scene's units; colors are filtered over a pixel, whatever the number of rays
        let options = RaycastOptions { samples: 1, ..RaycastOptions::default() };
        let mut residuals = Vec::new();
        // one photograph at a time: all of them with their views could fill the memory
        for (view, tiles) in learn::held_out_tiles(capture, config) {
            if self.monitor.stop() {
                break; // what was made is not used then
            }
            let (camera, loaded) = learn::training_view(view, &tiles, scene)?;
            let (mask, valid) = (loaded.mask.as_ref(), loaded.valid.as_ref());
            if let Some(view) = self.cast(&camera, &options)? {
                let source = ResidualSource { camera: &camera, photo: &loaded.photo, mask, valid, view };
                residuals.extend(ResidualView::new(source));
            }
        }
        let center = mesh.bounds().center();
        self.residuals = Residuals::new(residuals, center, leaves_out_own);
        Ok(self)
    }

    /// Renders the mesh with all that is known of its color.
    fn cast(&self, camera: &Camera, options: &RaycastOptions) -> Result<Option<RenderedView>> {
        let residuals = &self.residuals;
        let improved = |hits: &RayHits, mut colors: Vec<[f32; 3]>| {
            residuals.iter().for_each(|residuals| residuals.add(hits, camera, &mut colors));
            colors
        };
        if let Some((ExtractedSurface { mesh, cap }, bvh)) = &self.extracted {
            let field = self.fields.surface()?;
            return Ok(Some(raycast(bvh, mesh, None, camera, options, |hits| {
                let mut colors = field.color(&hits.points, &hits.normals, &hits.directions);
                // the field's color at the cap is that of the body's inside
                if let Some(cap) = cap {
                    cap.recolor(&hits.points, &mut colors);
                }
                improved(hits, colors)
            })));
        }
        Ok(self.head.as_ref().map(|visible| {
            visible
                .view(camera, options, |hits| improved(hits, visible.colors(hits, camera, options.samples)))
        }))
    }

    /// Renders the view of a camera in scene coordinates, over nothing.
    pub fn view(&self, method: Method, camera: &Camera) -> Result<Option<RenderedView>> {
        let samples = self.samples;
        let options = RaycastOptions { samples, world_from_scene: self.world_from_scene };
        Ok(match method {
            Method::Baseline | Method::Tface => {
                let field = self.fields.radiance(method.stage())?;
                // a large view takes minutes, so a stop request is checked within it
                let render_rays = |rays: &[Ray]| match self.monitor.stop() {
                    true => Vec::new(),
                    false => field.render_rays(rays, camera.forward()),
                };
                Some(march(camera, &self.world_from_scene, false, render_rays))
            }
            Method::Volume => self.fields.surface()?.volume(camera, &self.world_from_scene),
            Method::Raycast => self.cast(camera, &options)?,
            Method::Textured => {
                let textured = self.head.as_ref().filter(|visible| visible.shown.is_some());
                textured.map(|visible| visible.as_in_viewer(camera, &options))
            }
            Method::Raster => self.head.as_ref().map(|VisibleHead { head, layers, shown, .. }| {
                let options = RasterOptions {
                    world_from_scene: self.world_from_scene,
                    bare_hits: true,
                    ..RasterOptions::default()
                };
                let (mesh, harmonics) = (&head.mesh, head.harmonics.as_ref());
                let surface = Surface { mesh, texture: shown.as_ref(), atlas: None, harmonics };
                raster(mesh, layers.as_ref(), camera, &options, |hits| surface.colors(hits, camera)).view
            }),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::surface::{Radiance, Surface};
    use super::*;
    use crate::config::Stage;
    use glam::Vec3;
    use tiface_base::Quiet;
    use tiface_base::geom::{Aabb, Mesh, SdfField};
    use tiface_surface::{Cap, RimVertex};

    /// A field that is red everywhere.
    struct Red;

    impl Fields for Red {
        fn surface(&self) -> Result<&dyn Surface> {
            Ok(self)
        }

        fn radiance(&self, _: Stage) -> Result<&dyn Radiance> {
            panic!("no radiance field is asked for")
        }
    }

    impl SdfField for Red {
        fn sdf(&self, _: &[Vec3]) -> Vec<f32> {
            panic!("no distance is asked for")
        }

        fn sdf_gradient(&self, _: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
            panic!("no distance is asked for")
        }

        fn colors(&self, _: &[Vec3], _: &[Vec3], _: &[u32], directions: &[Vec3]) -> Vec<[f32; 3]> {
            vec![[1.0, 0.0, 0.0]; directions.len()]
        }
    }

    impl Surface for Red {}

    #[test]
    fn fitted_poses_are_shown_beside_the_given_ones_by_t_face_and_the_ray_cast_mesh() {
        let corners = [(-0.5, -0.5), (0.5, -0.5), (0.0, 0.5)].map(|(x, y)| Vec3::new(x, y, 0.0));
        let mesh = Mesh { positions: corners.to_vec(), triangles: vec![[0, 1, 2]], ..Mesh::default() };
        let meshes =
            Meshes { extracted: Some(ExtractedSurface { mesh, cap: None }), head: None, shown: [false; 2] };
        let scene_from_world = Similarity::IDENTITY;
        let scene = Scene { scene_from_world, aabb: Aabb::SCENE, hull: None };
        let named = |height| NamedCamera { name: "a".into(), camera: Camera::above(16, 16, 16.0, height) };
        let folder = tempfile::tempdir().unwrap();
        let run = Run::quiet(folder.path());
        let c = RenderConfig {
            method: vec![Method::Raycast, Method::Textured],
            float: true,
            ..Config::preset(crate::config::Preset::Draft).render
        };
        let fingerprint = crate::run::Fingerprint::default();
        let plan =
            crate::run::Plan { name: "render", fingerprint, device: "cpu", needs_bytes: 0, saves: false };
        run.stage(plan, |dir| {
            let renderer = Renderer::new(&scene, &Red, &meshes, 1, &Quiet);
            render(&c, &renderer, &[named(4.0)], &[named(3.0)], &scene, 1.0, dir)
        })
        .unwrap();
        let picture = |place: &str| std::fs::read(run.path("render/raycast").join(place)).unwrap();
        assert_ne!(picture("a.png"), picture("own_pose/a.png"));
        assert!(io::is_file(&run.path("render/raycast/float/a.exr")));
        assert!(!io::is_folder(&run.path("render/raycast/own_pose/float")));
        assert!(!io::is_folder(&run.path("render/textured/own_pose")));
    }

    #[test]
    fn rays_see_the_cap_painted_and_the_skin_as_the_field_has_it() {
        // to the left a square in the box's face z = 1, to the right one within
        let square = |x: f32, z: f32| {
            [(x, -0.9), (x + 0.9, -0.9), (x + 0.9, 0.9), (x, 0.9)].map(|(x, y)| Vec3::new(x, y, z))
        };
        let mesh = Mesh {
            positions: [square(-0.9, 1.0), square(0.0, 0.5)].concat(),
            triangles: vec![[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]],
            ..Mesh::default()
        };
        let skin =
            RimVertex { position: Vec3::new(-0.9, 0.0, 0.9), normal: -Vec3::X, color: [0.0, 1.0, 0.0] };
        let cap = Cap { bounds: Aabb::SCENE, near: 1e-4, ring: vec![skin] };
        let camera = Camera::above(8, 8, 8.0, 4.0);
        let look = |cap: Option<Cap>| {
            let surface = ExtractedSurface { mesh: mesh.clone(), cap };
            let bvh = Bvh::new(&surface.mesh);
            let renderer = Renderer {
                fields: &Red,
                extracted: Some((&surface, bvh)),
                head: None,
                samples: 1,
                world_from_scene: Similarity::IDENTITY,
                residuals: None,
                monitor: &Quiet,
            };
            let view = renderer.view(Method::Raycast, &camera).unwrap().unwrap();
            // at x = (2.5 − 4) / 8 · 3 = −0.56 and (5.5 − 4) / 8 · 3.5 = 0.66
            [view.color.pixel(2, 4).to_vec(), view.color.pixel(5, 4).to_vec()]
        };
        let red = vec![1.0, 0.0, 0.0, 1.0];
        assert_eq!(look(Some(cap)), [vec![0.0, 1.0, 0.0, 1.0], red.clone()]);
        assert_eq!(look(None), [red.clone(), red]);
    }
}
