//! Previews of a mesh: of a run's head, or of any mesh file.
//!
//! A small view of a field in training is rendered from its newest checkpoint ([`field_view`]). The
//! viewing process renders it, so the training is not disturbed and its results stay the same, bit
//! by bit.

use super::advice::advised;
use super::frames::{center as center_of, front as front_of};
use super::learn::load_field;
use super::mesh::read_finished;
use super::page::views::{error, heat};
use super::path::cameras_of_file;
use super::pictures::{self, background_color, expected, over, straight};
use super::scene_file::{read_capture, read_scene};
use crate::config::{Config, Stage, ViewBackground};
use glam::{DMat3, DVec3, Vec3};
use rayon::prelude::*;
use std::ops::Range;
use std::path::Path;
use tiface_base::geom::{Atlas, Camera, Distortion, Similarity};
use tiface_base::image::{Image, Photo, quantize, reduce_photo, working_size};
use tiface_base::io::{self, Limits};
use tiface_base::{Error, Result};
use tiface_capture::path::{NamedCamera, orbit};
use tiface_capture::{Split, View};
use tiface_surface::files::{HeadMesh, HeadTexture, OpenedMesh, open_mesh};
use tiface_surface::render::{
    Look, MeshTexture, RasterLayers, RasterOptions, RasterView, Surface, raster_into,
};

/// The lens of a preview: distance over visible width. A long one, as for portraits.
const FOCAL: f64 = 2.5;

/// Sizes of a mesh whose squares and cubes are safe in 32-bit floats.
const SIZES: Range<f64> = 1e-9..1e9;

/// A mesh that can be shown.
pub struct Preview {
    head: HeadMesh,
    /// The UV coordinates of a mesh without a texture.
    bare_atlas: Option<Atlas>,
    /// The up and front directions: unit vectors in the mesh's coordinates, perpendicular to each
    /// other.
    up: Vec3,
    front: Vec3,
    /// The photographs of a run with their cameras in the world.
    views: Vec<View>,
    /// Features of the file that cannot be shown.
    pub warnings: Vec<String>,
}

impl Preview {
    /// Returns the head of a run as the stage `mesh` left it. Its photographs are not opened, and
    /// no stage is disturbed.
    ///
    /// # Errors
    ///
    /// Fails if the run has no mesh yet, or if it is damaged, or being made again.
    pub fn of_run(run: &Path) -> Result<Preview> {
        let (head, warnings) = read_finished(run, |record| {
            // previews show `mesh/parts`: a problem with other files of the stage does not matter
            let problem = record.require_products(&run.join(Stage::Mesh)).err();
            let warnings = problem.map(|e| format!("{e}; {}", e.hint())).into_iter().collect();
            Ok((HeadMesh::load(&run.join("mesh/parts")).map_err(advised)?, warnings))
        })?;
        let capture = read_capture(&run.join("cameras.json"), Path::new(""))?;
        let to_scene = head.world_from_scene.rotation_f32().transpose();
        let center = center_of(&head.mesh, &head.world_from_scene);
        let eyes: Vec<DVec3> = capture.views.iter().map(|v| v.camera.position).collect();
        let front = front_of(capture.up, &eyes, center);
        let up = to_scene * capture.up.normalize_or(Vec3::Y);
        let front = front.map_or_else(|| up.any_orthonormal_vector(), |f| to_scene * f);
        let head = head.as_drawn();
        Ok(Preview { head, bare_atlas: None, up, front, views: capture.views, warnings })
    }

    /// Returns the mesh in a `.glb`, `.gltf`, `.obj`, `.ply` or `.stl` file. `up` is its up
    /// direction, +Y for most files; the front is then +Z, or −Y if +Z is up, as in Blender.
    ///
    /// # Errors
    ///
    /// Fails if the file cannot be read or has no surface.
    pub fn of_file(path: &Path, up: Vec3) -> Result<Preview> {
        let opened = open_mesh(path)?;
        let warnings = opened.warnings();
        let OpenedMesh { mut head, bare_atlas, .. } = opened;
        at_hand(&mut head, path)?;
        let front = if up.z.abs() > 0.5 { Vec3::NEG_Y } else { Vec3::Z };
        Ok(Preview { head, bare_atlas, up, front, views: Vec::new(), warnings })
    }

    /// Returns the default look: the color if the mesh has one, else the shape.
    pub fn look(&self) -> Look {
        let is_colored = self.head.texture.is_some() || !self.head.mesh.colors.is_empty();
        if is_colored { Look::Unlit } else { Look::Studio }
    }

    /// Returns whether the mesh says how many cameras see it.
    pub fn knows_cameras(&self) -> bool {
        !self.head.mesh.seen_by.is_empty()
    }

    /// Returns whether the mesh has UV coordinates.
    pub fn has_uvs(&self) -> bool {
        self.head.texture.is_some() || self.bare_atlas.is_some()
    }

    /// Returns `count` cameras on a circle around the mesh, in its coordinates, far enough away
    /// that square pictures of `side` pixels show all of it. The first is turned by `turn` radians
    /// from the front towards the mesh's left, and all of them `tilt` radians above.
    pub fn around(&self, turn: f64, tilt: f64, side: u32, count: usize) -> Result<Vec<NamedCamera>> {
        let (up, front) = (self.up.as_dvec3(), self.front.as_dvec3());
        let level = front * turn.cos() + up.cross(front) * turn.sin();
        let (mut up, mut toward) = (up, level * tilt.cos() + up * tilt.sin());
        if tilt.cos() < 1e-3 {
            // from above: the front is below
            (up, toward) = (-level, up);
        }
        let bounds = self.head.mesh.bounds();
        let reach = 0.5 * f64::from(bounds.size().length());
        let side_px = f64::from(side);
        let like = Camera {
            width: side,
            height: side,
            fx: FOCAL * side_px,
            fy: FOCAL * side_px,
            cx: 0.5 * side_px,
            cy: 0.5 * side_px,
            distortion: Distortion::default(),
            rotation: DMat3::IDENTITY,
            position: bounds.center().as_dvec3() + reach * toward,
        };
        orbit(&[like], bounds, up.as_vec3(), count)
    }

    /// Returns the cameras that `--cameras` names, in the mesh's coordinates: `train` or `test` of
    /// a run, or a file (a nerfstudio camera path or a transforms.json, in the world).
    pub fn cameras(&self, which: &str, side: u32) -> Result<Vec<NamedCamera>> {
        let scene_from_world = self.head.world_from_scene.inverse();
        let split =
            [("train", Split::Train), ("test", Split::Test)].into_iter().find(|(word, _)| *word == which);
        let cameras = match split {
            Some((_, split)) => {
                let named = |v: &View| NamedCamera { name: v.name.clone(), camera: v.camera.clone() };
                self.views.iter().filter(|v| v.split == split).map(named).collect()
            }
            None => {
                let like = self.around(0.0, 0.0, side, 1)?.remove(0).camera;
                cameras_of_file(which, &io::read_bytes(Path::new(which), &Limits::default())?, &like)?
            }
        };
        if cameras.is_empty() {
            let what = format!("there are no cameras of `--cameras {which}`");
            return Err(Error::cannot(what, "name a file of cameras, or a run that has such photographs"));
        }
        let moved = |c: NamedCamera| NamedCamera { camera: c.camera.transformed(&scene_from_world), ..c };
        Ok(cameras.into_iter().map(moved).collect())
    }

    /// Prepares the mesh for rendering.
    pub fn renderer(&self) -> PreviewRenderer<'_> {
        let HeadMesh { mesh, texture, shells, .. } = &self.head;
        let layers = shells.as_ref().map(|shells| RasterLayers::new(mesh, shells));
        let prepared = |t: &HeadTexture| MeshTexture::new(mesh, &t.atlas, &t.color, t.lobes.as_ref());
        let texture = texture.as_ref().map(prepared);
        PreviewRenderer { preview: self, texture, layers }
    }
}

/// An 8-bit preview picture, sRGB-coded with straight alpha.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PreviewPicture {
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// `[height · width]` pixels.
    pub rgba: Vec<[u8; 4]>,
}

impl PreviewPicture {
    /// Arranges pictures of one size in a grid of this many columns.
    pub fn sheet(pictures: &[PreviewPicture], columns: usize) -> PreviewPicture {
        let Some(PreviewPicture { width, height, .. }) = pictures.first() else {
            return PreviewPicture { width: 0, height: 0, rgba: Vec::new() };
        };
        let (w, h) = (*width as usize, *height as usize);
        let (across, rows) = (w * columns, pictures.len().div_ceil(columns));
        let mut rgba = vec![[0; 4]; across * rows * h];
        for (i, picture) in pictures.iter().enumerate() {
            let corner = i / columns * h * across + i % columns * w;
            for (y, row) in picture.rgba.chunks(w).enumerate() {
                rgba[corner + y * across..][..w].copy_from_slice(row);
            }
        }
        PreviewPicture { width: across as u32, height: (rows * h) as u32, rgba }
    }
}

/// Renders previews of a mesh.
pub struct PreviewRenderer<'a> {
    preview: &'a Preview,
    texture: Option<MeshTexture>,
    layers: Option<RasterLayers<'a>>,
}

impl PreviewRenderer<'_> {
    /// Renders the view of a camera in the mesh's coordinates, reusing the memory of an earlier
    /// view.
    fn view(&self, seen: &mut RasterView, camera: &Camera, look: Look) {
        let Preview { head, bare_atlas, .. } = self.preview;
        let surface = Surface {
            mesh: &head.mesh,
            texture: self.texture.as_ref(),
            atlas: head.texture.as_ref().map(|t| &t.atlas).or(bare_atlas.as_ref()),
            harmonics: head.harmonics.as_ref(),
        };
        let options = RasterOptions {
            normals: false,
            bare_hits: look.is_bare(),
            world_from_scene: head.world_from_scene,
            ..RasterOptions::default()
        };
        let layers = self.layers.as_ref().filter(|_| look.has_layers());
        raster_into(seen, &head.mesh, layers, camera, &options, |hits| surface.shown(look, hits, camera));
    }

    /// Returns the held-out photograph nearest to the face's front, cut out by its mask, and the
    /// mesh's error against it in the colors of the error scale, each centered in a square of
    /// `side` pixels; `None` if no such photograph exists.
    ///
    /// # Errors
    ///
    /// Fails if the photograph has been moved or cannot be read.
    pub fn against_photograph(&self, side: u32) -> Result<Option<[PreviewPicture; 2]>> {
        let Preview { head, views, front, .. } = self.preview;
        let scene_from_world = head.world_from_scene.inverse();
        let placed = |v: &View| v.camera.transformed(&scene_from_world);
        let facing = |v: &View| -placed(v).forward().dot(*front);
        let of = |split: Split| views.iter().filter(|v| v.split == split).collect::<Vec<_>>();
        let held_out = Some(of(Split::Test)).filter(|v| !v.is_empty()).unwrap_or_else(|| of(Split::Val));
        let Some(view) = held_out.into_iter().max_by(|a, b| facing(a).total_cmp(&facing(b))) else {
            return Ok(None);
        };
        let loaded = view.load(&Limits::default())?;
        let black = ViewBackground::Black;
        let (w, h) = working_size(loaded.photo.width, loaded.photo.height, side);
        let photo = reduce_photo(&expected(&loaded.photo, loaded.mask.as_ref(), black), (w, h));
        let ours =
            self.picture(&mut RasterView::default(), &placed(view).resized(w, h), self.preview.look(), black);
        let apart = ours.rgba.iter().zip(&photo.rgb).map(|(a, b)| error([a[0], a[1], a[2]], *b)[0]);
        let heat = apart.map(|e| heat(f32::from(e) / 255.0)).collect();
        let (left, top) = ((side - w) / 2, (side - h) / 2);
        let framed = |rgb: Vec<[u8; 3]>| {
            let mut rgba = vec![[0; 4]; (side * side) as usize];
            for (i, [r, g, b]) in (0..).zip(rgb) {
                rgba[((top + i / w) * side + left + i % w) as usize] = [r, g, b, 255];
            }
            PreviewPicture { width: side, height: side, rgba }
        };
        Ok(Some([framed(photo.rgb), framed(heat)]))
    }

    /// Renders many previews in parallel.
    pub fn pictures(
        &self,
        shots: &[(Camera, Look)],
        background: ViewBackground,
        stop: impl Fn() -> bool + Sync,
    ) -> Vec<PreviewPicture> {
        // each picture uses one thread if there are many of them
        let picture = |seen: &mut RasterView, (camera, look): &(Camera, Look)| match stop() {
            true => PreviewPicture { width: 0, height: 0, rgba: Vec::new() },
            false => self.picture(seen, camera, *look, background),
        };
        shots.par_iter().map_init(RasterView::default, picture).collect()
    }

    /// Renders one preview, over a color or over nothing.
    fn picture(
        &self,
        seen: &mut RasterView,
        camera: &Camera,
        look: Look,
        background: ViewBackground,
    ) -> PreviewPicture {
        self.view(seen, camera, look);
        if let Some(color) = background_color(background) {
            over(&mut seen.view, color);
        }
        let Image { width, height, data, .. } = &seen.view.color;
        let rgba = data.as_chunks::<4>().0.iter().map(|&p| straight(p).map(quantize)).collect();
        PreviewPicture { width: *width, height: *height, rgba }
    }
}

/// Scales a mesh of extreme size so that 32-bit floats can hold its squares and cubes.
fn at_hand(head: &mut HeadMesh, path: &Path) -> Result<()> {
    let corner = |pick: fn(f64, f64) -> f64| {
        let all = head.mesh.positions.iter().map(|p| p.as_dvec3());
        all.reduce(|a, b| DVec3::new(pick(a.x, b.x), pick(a.y, b.y), pick(a.z, b.z))).unwrap_or_default()
    };
    let (low, high) = (corner(f64::min), corner(f64::max));
    let size = (high - low).max_element();
    if size == 0.0 {
        let what = format!("all points of `{}` lie at one place", path.display());
        return Err(Error::cannot(what, "it has no surface to show"));
    }
    if !SIZES.contains(&size) {
        let center = 0.5 * (low + high);
        head.mesh.positions.iter_mut().for_each(|p| *p = ((p.as_dvec3() - center) / size).as_vec3());
        let own = &head.world_from_scene;
        let translation = own.point_f64(center);
        head.world_from_scene = Similarity { scale: own.scale * size, translation, ..*own };
    }
    Ok(())
}

/// Pixels along the longest side.
const SIDE: u32 = 240;

/// Returns the view of the first held-out camera of the field that a stage of a run has trained so
/// far, over black, as a JPEG file.
///
/// # Errors
///
/// Fails if there is no checkpoint yet, or if a file of the run is damaged.
pub fn field_view(run: &Path, config: &Config, stage: Stage) -> Result<Vec<u8>> {
    let scene = read_scene(&run.join("mask/scene.json"))?;
    let capture = read_capture(&run.join("cameras.json"), Path::new(""))?;
    let mut views = [Split::Test, Split::Val, Split::Train].into_iter().flat_map(|s| capture.split(s));
    let camera = views.next().map(|view| view.camera.clone());
    let camera = camera.ok_or_else(|| Error::cannot("the run has no camera", ""))?;
    let share = f64::from(SIDE) / f64::from(camera.width.max(camera.height));
    let side = |pixels: u32| (f64::from(pixels) * share.min(1.0)).round().max(1.0) as u32;
    let camera = camera.resized(side(camera.width), side(camera.height)).transformed(&scene.scene_from_world);
    let mut view = load_field(run, config, &scene, stage)?(&camera);
    if let Some(black) = pictures::background_color(ViewBackground::Black) {
        pictures::over(&mut view, black);
    }
    let rgb = view.color.data.as_chunks::<4>().0.iter().map(|p| [p[0], p[1], p[2]].map(quantize)).collect();
    let photo = Photo { width: view.color.width, height: view.color.height, rgb, alpha: None };
    Ok(io::jpeg_bytes(&photo, 85, run)?)
}
