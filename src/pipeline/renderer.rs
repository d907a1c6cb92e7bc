//! The renderer of views, by any method: the fields, or rays cast at the head, with its residuals
//! and pixel filter.

use super::mesh::{extracted_surface, head_mesh};
use super::surface::{Fields, march};
use super::{learn, pictures};
use crate::config::{ColorSource, Config, Method};
use crate::run::Run;
use std::sync::Arc;
use tiface_base::geom::{Bvh, Camera, Harmonics, Ray, ShellCaster, Similarity};
use tiface_base::{Monitor, Result};
use tiface_capture::Capture;
use tiface_capture::scene::Scene;
use tiface_surface::files::{ExtractedSurface, HeadMesh, HeadTexture};
use tiface_surface::render::{
    MeshTexture, PixelFilterFit, RasterLayers, RasterOptions, RayHits, RaycastOptions, RenderedView,
    ResidualSource, ResidualView, Residuals, Surface, raster, raycast, raycast_each,
};

/// Most training views that the pixel filter of ray casting is fitted to. Six chose the same width
/// for the heads of the results.
const FILTERED_VIEWS: usize = 3;

/// Returns whether some methods show the head mesh. Fitted colors lie on it; the network's colors
/// are evaluated on the extracted surface.
pub(super) fn shows_head(config: &Config, methods: &[Method]) -> bool {
    let fitted = config.mesh.color == ColorSource::Photographs;
    let shows = |m: &Method| match m {
        Method::Plain | Method::Textured | Method::Raster => true,
        Method::Raycast => fitted,
        _ => false,
    };
    methods.iter().any(shows)
}

/// The meshes that the chosen methods show.
pub(super) struct Meshes {
    pub extracted: Option<ExtractedSurface>,
    pub head: Option<HeadMesh>,
}

impl Meshes {
    /// Loads the meshes that `methods` show from the run.
    pub fn load(run: &Run, config: &Config, methods: &[Method]) -> Result<Meshes> {
        let fitted = config.mesh.color == ColorSource::Photographs;
        let extracted =
            (methods.contains(&Method::Raycast) && !fitted).then(|| extracted_surface(run)).transpose()?;
        let head = shows_head(config, methods).then(|| head_mesh(run)).transpose()?;
        Ok(Meshes { extracted, head: head.map(HeadMesh::as_drawn) })
    }

    /// Prepares a head mesh for rendering.
    pub fn of_head(head: HeadMesh) -> Meshes {
        Meshes { extracted: None, head: Some(head.as_drawn()) }
    }
}

/// The head mesh with its acceleration structure.
pub(super) struct VisibleHead<'a> {
    head: &'a HeadMesh,
    bvh: Bvh,
    shells: Option<ShellCaster<'a>>,
    layers: Option<RasterLayers<'a>>,
    texture: Option<MeshTexture>,
}

impl<'a> VisibleHead<'a> {
    /// Prepares a head to be shown.
    pub fn new(head: &'a HeadMesh) -> VisibleHead<'a> {
        let mesh = &head.mesh;
        let prepared = |t: &HeadTexture| MeshTexture::new(mesh, &t.atlas, &t.color, t.lobes.as_ref());
        let shells = head.shells.as_ref().map(|shells| ShellCaster::new(mesh, shells));
        let layers = head.shells.as_ref().map(|shells| RasterLayers::new(mesh, shells));
        let texture = head.texture.as_ref().map(prepared);
        VisibleHead { head, bvh: Bvh::new(mesh), shells, layers, texture }
    }

    /// Renders views with soft layers, one for each list of colors that `colors` returns.
    fn views(
        &self,
        camera: &Camera,
        options: &RaycastOptions,
        count: usize,
        colors: impl Fn(&RayHits) -> Vec<Vec<[f32; 3]>> + Sync,
    ) -> Vec<RenderedView> {
        raycast_each(&self.bvh, &self.head.mesh, self.shells.as_ref(), camera, options, count, colors)
    }

    /// Renders a view as our viewers show the head.
    pub fn as_in_viewer(&self, camera: &Camera, options: &RaycastOptions) -> RenderedView {
        let colors = |hits: &RayHits| self.colors(&[Method::Textured], hits, camera, options.samples);
        self.views(camera, options, 1, colors).remove(0)
    }

    /// Rasterizes what ray casting shows of the head without residuals, with depth in the mesh's
    /// units and without normals.
    fn rasterized(&self, camera: &Camera) -> RenderedView {
        // colors of heads without any are those of their normals
        let bare_hits = self.texture.is_some() || !self.head.mesh.colors.is_empty();
        let options = RasterOptions { normals: false, bare_hits, ..RasterOptions::default() };
        let colors = |hits: &RayHits| self.colors(&[Method::Raycast], hits, camera, 1).remove(0);
        raster(&self.head.mesh, self.layers.as_ref(), camera, &options, colors).view
    }

    /// Returns the sRGB-coded base colors of hits: the texture's or the vertices', else gray, lit
    /// from the camera.
    fn base_colors(&self, hits: &RayHits, camera: &Camera, samples: u32) -> Vec<[f32; 3]> {
        let mesh = &self.head.mesh;
        match &self.texture {
            Some(texture) => texture.base_colors(hits, camera, samples),
            None if mesh.colors.is_empty() => {
                let normals = hits.normals.iter().zip(&hits.directions);
                normals.map(|(n, d)| [n.dot(*d).abs(); 3]).collect()
            }
            None => hits.hits.iter().map(|hit| mesh.color_at(hit)).collect(),
        }
    }

    /// Returns the sRGB-coded colors of hits by each of these methods. They differ in what is added
    /// to the base color: nothing (plain), the lobes of the file (textured), or the harmonics that
    /// these were drawn from (ray cast).
    fn colors(
        &self,
        methods: &[Method],
        hits: &RayHits,
        camera: &Camera,
        samples: u32,
    ) -> Vec<Vec<[f32; 3]>> {
        let base = self.base_colors(hits, camera, samples);
        let by = |method: &Method| {
            let mut colors = base.clone();
            match (method, &self.texture, &self.head.harmonics) {
                (Method::Textured, Some(texture), _) => {
                    texture.add_lobes(hits, camera, samples, &mut colors);
                }
                (Method::Raycast, _, Some(harmonics)) => self.add_harmonics(harmonics, hits, &mut colors),
                _ => {}
            }
            colors
        };
        methods.iter().map(by).collect()
    }

    fn add_harmonics(&self, harmonics: &Harmonics, hits: &RayHits, colors: &mut [[f32; 3]]) {
        let triangles = &self.head.mesh.triangles;
        for ((color, hit), &direction) in colors.iter_mut().zip(&hits.hits).zip(&hits.directions) {
            let more = harmonics.seen_along(direction, hit, triangles[hit.triangle as usize]);
            (0..3).for_each(|k| color[k] = (color[k] + more[k]).clamp(0.0, 1.0));
        }
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
    residuals: Option<Arc<Residuals>>,
    /// Deviation of the Gaussian that makes a ray-cast view look like a photograph, pixels.
    pub pixel_filter_px: f32,
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
            head: meshes.head.as_ref().map(VisibleHead::new),
            samples,
            world_from_scene: scene.scene_from_world.inverse(),
            residuals: None,
            pixel_filter_px: 0.0,
            monitor,
        }
    }

    /// Returns the renderer with the pixel filter that makes ray-cast views without residuals most
    /// like the training photographs.
    pub fn with_pixel_filter(
        mut self,
        capture: &Capture,
        scene: &Scene,
        config: &Config,
    ) -> Result<Renderer<'a>> {
        debug_assert!(self.residuals.is_none());
        let options = RaycastOptions { samples: self.samples, ..RaycastOptions::default() };
        let mut fit = PixelFilterFit::default();
        let views = learn::held_out_tiles(capture, config);
        let every = views.len().div_ceil(FILTERED_VIEWS).max(1);
        for (view, tiles) in views.into_iter().step_by(every) {
            if self.monitor.stop() {
                break; // what was made is not used then
            }
            let loaded = learn::training_view(view, &tiles, scene)?;
            if loaded.mask.is_some() {
                let (photo, weight) = pictures::target(&loaded);
                let shown = self.cast(&[Method::Raycast], &loaded.camera, &options)?.pop();
                shown.iter().for_each(|view| fit.add(view, &photo, &weight));
            }
        }
        self.pixel_filter_px = fit.deviation_px();
        Ok(self)
    }

    /// Returns what ray casting misses of the training photographs. With `leaves_out_own`, a
    /// training view adds nothing to a view from its own position. `None` if nothing can be
    /// compared.
    pub fn residuals(
        &self,
        capture: &Capture,
        scene: &Scene,
        config: &Config,
        leaves_out_own: bool,
    ) -> Result<Option<Arc<Residuals>>> {
        debug_assert!(self.residuals.is_none());
        let meshes =
            [self.extracted.as_ref().map(|(s, _)| &s.mesh), self.head.as_ref().map(|h| &h.head.mesh)];
        let Some(mesh) = meshes.into_iter().flatten().next() else { return Ok(None) };
        let mut residuals = Vec::new();
        // one photograph at a time: all of them with their views could fill the memory
        for (view, tiles) in learn::held_out_tiles(capture, config) {
            if self.monitor.stop() {
                break; // what was made is not used then
            }
            let loaded = learn::training_view(view, &tiles, scene)?;
            let (camera, mask, valid) = (&loaded.camera, loaded.mask.as_ref(), loaded.valid.as_ref());
            let view = match self.head.as_ref().filter(|_| self.casts_at_head(Method::Raycast)) {
                // only pixels count whose neighbors show the same surface: there a ray through the
                // center sees the same, but for the edges of layers
                Some(head) => Some(head.rasterized(camera)),
                None => {
                    // depth in the scene's units; colors are filtered over a pixel, whatever the
                    // number of rays
                    let options = RaycastOptions { samples: 1, ..RaycastOptions::default() };
                    self.cast(&[Method::Raycast], camera, &options)?.pop()
                }
            };
            if let Some(view) = view {
                let source = ResidualSource { camera, photo: &loaded.photo, mask, valid, view };
                residuals.extend(ResidualView::new(source));
            }
        }
        Ok(Residuals::new(residuals, mesh.bounds().center(), leaves_out_own).map(Arc::new))
    }

    /// Returns the renderer with residuals that are added to ray-cast views.
    pub fn with_residuals(self, residuals: Option<Arc<Residuals>>) -> Renderer<'a> {
        Renderer { residuals, ..self }
    }

    /// Returns these methods in groups whose views come from the same rays, in their order.
    pub fn groups(&self, methods: &[Method]) -> Vec<Vec<Method>> {
        let mut groups: Vec<Vec<Method>> = Vec::new();
        for &method in methods {
            let shares = |other: &Method| self.casts_at_head(*other) && self.casts_at_head(method);
            match groups.iter_mut().find(|group| group.iter().any(shares)) {
                Some(group) => group.push(method),
                None => groups.push(vec![method]),
            }
        }
        groups
    }

    /// Returns whether a method's rays are cast at the head mesh.
    fn casts_at_head(&self, method: Method) -> bool {
        match method {
            Method::Plain | Method::Textured => true,
            Method::Raycast => self.extracted.is_none(),
            _ => false,
        }
    }

    /// Casts the rays of a camera at the mesh of a group of methods, once for all of them; by ray
    /// casting, it has all that is known of its color. Returns no view without a mesh.
    fn cast(
        &self,
        methods: &[Method],
        camera: &Camera,
        options: &RaycastOptions,
    ) -> Result<Vec<RenderedView>> {
        let residuals = &self.residuals;
        let improve = |hits: &RayHits, colors: &mut [[f32; 3]]| {
            residuals.iter().for_each(|residuals| residuals.add(hits, camera, colors));
        };
        if let Some((ExtractedSurface { mesh, cap }, bvh)) =
            self.extracted.as_ref().filter(|_| methods == [Method::Raycast])
        {
            let field = self.fields.surface()?;
            return Ok(vec![raycast(bvh, mesh, None, camera, options, |hits| {
                let mut colors = field.color(&hits.points, &hits.normals, &hits.directions);
                // the field's color at the cap is that of the body's inside
                if let Some(cap) = cap {
                    cap.recolor(&hits.points, &mut colors);
                }
                improve(hits, &mut colors);
                colors
            })]);
        }
        let Some(visible) = &self.head else { return Ok(Vec::new()) };
        let colors = |hits: &RayHits| {
            let mut all = visible.colors(methods, hits, camera, options.samples);
            let known = all.iter_mut().zip(methods).filter(|(_, method)| **method == Method::Raycast);
            known.for_each(|(colors, _)| improve(hits, colors));
            all
        };
        Ok(visible.views(camera, options, methods.len(), colors))
    }

    /// Renders the view of a camera in scene coordinates, over nothing.
    pub fn view(&self, method: Method, camera: &Camera) -> Result<Option<RenderedView>> {
        Ok(self.views(&[method], camera)?.remove(0))
    }

    /// Renders the same by each method of a group.
    pub fn views(&self, methods: &[Method], camera: &Camera) -> Result<Vec<Option<RenderedView>>> {
        let options = RaycastOptions { samples: self.samples, world_from_scene: self.world_from_scene };
        let [method] = methods else {
            let mut views = self.cast(methods, camera, &options)?.into_iter();
            return Ok(methods.iter().map(|_| views.next()).collect());
        };
        let view = match method {
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
            Method::Raycast | Method::Plain | Method::Textured => self.cast(methods, camera, &options)?.pop(),
            Method::Raster => self.head.as_ref().map(|VisibleHead { head, layers, texture, .. }| {
                let options = RasterOptions {
                    world_from_scene: self.world_from_scene,
                    bare_hits: true,
                    ..RasterOptions::default()
                };
                let (mesh, harmonics) = (&head.mesh, head.harmonics.as_ref());
                let surface = Surface { mesh, texture: texture.as_ref(), atlas: None, harmonics };
                raster(mesh, layers.as_ref(), camera, &options, |hits| surface.colors(hits, camera)).view
            }),
        };
        Ok(vec![view])
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::surface::{Radiance, Surface};
    use super::*;
    use crate::config::Stage;
    use glam::Vec3;
    use tiface_base::Quiet;
    use tiface_base::geom::{Aabb, Mesh, SdfField};
    use tiface_surface::files::testing::tetrahedron;
    use tiface_surface::{Cap, RimVertex};

    /// A field that is red everywhere.
    pub struct Red;

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
    fn rays_are_cast_once_for_all_methods_that_show_the_head() {
        use Method::*;
        let meshes = Meshes::of_head(tetrahedron());
        let scene = Scene { scene_from_world: Similarity::IDENTITY, aabb: Aabb::SCENE, hull: None };
        let renderer = Renderer::new(&scene, &Red, &meshes, 2, &Quiet);
        let groups = renderer.groups(&[Tface, Raycast, Plain, Raster, Textured]);
        assert_eq!(groups, [vec![Tface], vec![Raycast, Plain, Textured], vec![Raster]]);
        let camera = Camera::above(32, 32, 32.0, 4.0);
        let views = renderer.views(&groups[1], &camera).unwrap();
        for (method, view) in groups[1].iter().zip(&views) {
            assert!(view.is_some() && *view == renderer.view(*method, &camera).unwrap(), "{method:?}");
        }
        let [raycast, plain, textured] = &views[..] else { panic!("{}", views.len()) };
        let [raycast, plain, textured] = [raycast, plain, textured].map(|view| view.as_ref().unwrap());
        assert!(raycast.depth == plain.depth && plain.depth == textured.depth);
        // the base color alone where nothing shines through; what is added to it differs
        let pixels = |view: &RenderedView| view.color.data.as_chunks::<4>().0.to_vec();
        let covered: Vec<usize> = (0..32 * 32).filter(|&i| pixels(plain)[i][3] > 0.999).collect();
        assert!(covered.len() > 20, "{}", covered.len());
        for &i in &covered {
            let [r, g, b, _] = pixels(plain)[i].map(|v| 255.0 * v);
            assert!((r - 9.0).abs() < 0.1 && (g - 1.0).abs() < 0.1 && (b - 2.0).abs() < 0.1, "{r} {g} {b}");
        }
        let differs =
            |a: &RenderedView, b: &RenderedView| covered.iter().any(|&i| pixels(a)[i] != pixels(b)[i]);
        assert!(differs(plain, textured) && differs(plain, raycast) && differs(textured, raycast));
    }

    #[test]
    fn inside_of_the_head_rasterized_views_show_what_rays_see() {
        let meshes = Meshes::of_head(HeadMesh { shells: None, ..tetrahedron() });
        let scene = Scene { scene_from_world: Similarity::IDENTITY, aabb: Aabb::SCENE, hull: None };
        let renderer = Renderer::new(&scene, &Red, &meshes, 1, &Quiet);
        let camera = Camera::above(64, 64, 128.0, 4.0);
        let cast = renderer.view(Method::Raycast, &camera).unwrap().unwrap();
        let plain = renderer.view(Method::Plain, &camera).unwrap().unwrap();
        let rasterized = renderer.head.as_ref().unwrap().rasterized(&camera);
        let covered = |x: u32, y: u32| {
            let around = (y - 1..=y + 1).flat_map(|y| (x - 1..=x + 1).map(move |x| (x, y)));
            around.into_iter().all(|(x, y)| rasterized.color.pixel(x, y)[3] > 0.999)
        };
        let inner = (1..63).flat_map(|y| (1..63).map(move |x| (x, y))).filter(|&(x, y)| covered(x, y));
        let (mut errors, mut harmonics) = (Vec::new(), 0f32);
        for (x, y) in inner {
            let apart = |a: &RenderedView, b: &RenderedView| {
                let channels = a.color.pixel(x, y).iter().zip(b.color.pixel(x, y));
                channels.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
            };
            let depths = [&rasterized, &cast].map(|view| view.depth.pixel(x, y)[0]);
            assert!((depths[0] - depths[1]).abs() < 1e-5, "{x} {y}: {depths:?}");
            errors.push(apart(&rasterized, &cast));
            harmonics = harmonics.max(apart(&rasterized, &plain));
        }
        errors.sort_unstable_by(f32::total_cmp);
        assert!(errors.len() > 50 && harmonics > 0.01, "{} {harmonics}", errors.len());
        // a rasterized pixel is the mean of four samples where surfaces meet in it
        assert!(errors[errors.len() * 4 / 5] < 1e-3, "{errors:?}");
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
            let meshes = Meshes { extracted: Some(surface), head: None };
            let scene = Scene { scene_from_world: Similarity::IDENTITY, aabb: Aabb::SCENE, hull: None };
            let renderer = Renderer::new(&scene, &Red, &meshes, 1, &Quiet);
            let view = renderer.view(Method::Raycast, &camera).unwrap().unwrap();
            // at x = (2.5 − 4) / 8 · 3 = −0.56 and (5.5 − 4) / 8 · 3.5 = 0.66
            [view.color.pixel(2, 4).to_vec(), view.color.pixel(5, 4).to_vec()]
        };
        let red = vec![1.0, 0.0, 0.0, 1.0];
        assert_eq!(look(Some(cap)), [vec![0.0, 1.0, 0.0, 1.0], red.clone()]);
        assert_eq!(look(None), [red.clone(), red]);
    }
}
