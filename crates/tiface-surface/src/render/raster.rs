//! Rasterization of a mesh: the same view as the ray caster's, in a fraction of the time.
//!
//! 1. Corners are projected and snapped to 1/256 of a pixel, triangles clipped to the frustum, and
//!    sorted into tiles of 32 × 32 pixels (`project`). A lens that bends straight lines gets
//!    triangles halved until that no longer shows: so edges stay shared, which a picture that is
//!    bent afterwards could not promise.
//! 2. In each tile the nearest triangle is found at the center of every pixel and at four samples
//!    around it (`tile`).
//! 3. What is seen is colored once a pixel, and again for each surface that ends within the pixel.
//!    The ray through the pixel is met with its triangle as a ray caster would do it, so depth and
//!    attributes do not depend on the snapping (`paint`).
//!
//! Translucent layers are drawn each into a tile of its own, where the mesh does not hide it, and
//! blended sample by sample: the front faces from the outermost layer, then the back faces from the
//! innermost. Where a side of a layer lies over itself, the nearest one is drawn.
//!
//! Coverage is that of the four samples; uncovered pixels are transparent black. Every tile is made
//! by one thread in the order of the triangles: same mesh, same picture.

mod paint;
mod project;
mod tile;

use super::hits::RayHits;
use super::view::RenderedView;
use bytemuck::Zeroable;
use paint::{Painter, PictureRows, RasterSurface, SampleBatch, TileArea, straight_rays};
use project::{Bins, Faces, Lens, Sides, TILE};
use rayon::prelude::*;
use tiface_base::geom::{Camera, Mesh, ShellLayer, Shells, Similarity};
use tiface_base::image::Image;
use tile::{NOTHING, SAMPLES, Tile};

/// Depth change over one pixel, in pixel footprints, from which on a surface ends: tan 84°, as in
/// the ray caster.
const JUMP: f32 = 10.0;

/// Options of rasterization.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RasterOptions {
    /// Whether back faces are culled. On a closed mesh they are always hidden.
    pub cull: bool,
    /// Whether the picture of normals is rendered; otherwise it has no pixels.
    pub normals: bool,
    /// Whether hits are passed to the color function without points and normals, which texture
    /// lookups do not need.
    pub bare_hits: bool,
    /// The transform from the mesh's coordinates (which the camera is in, too) to those of depth
    /// and normals.
    pub world_from_scene: Similarity,
}

impl Default for RasterOptions {
    fn default() -> RasterOptions {
        RasterOptions { cull: false, normals: true, bare_hits: false, world_from_scene: Similarity::IDENTITY }
    }
}

/// The view of one camera, with the visible triangles.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RasterView {
    /// Color, depth and normals, as from the ray caster.
    pub view: RenderedView,
    /// `[height · width]` triangles at the centers of the pixels, [`RasterView::NOTHING`] for empty
    /// ones.
    pub triangles: Vec<u32>,
}

impl RasterView {
    /// The index that stands for no triangle.
    pub const NOTHING: u32 = NOTHING;
}

/// Rasterizes a mesh, with optional translucent layers around it.
///
/// `color` gets batches of hits and returns sRGB-coded colors in 0..=1, one per hit, `[n, 3]`;
/// missing ones are black. It runs on several threads at once.
///
/// # Examples
///
/// ```
/// use glam::Vec3;
/// use tiface_base::geom::{Camera, Mesh};
/// use tiface_surface::render::{RasterOptions, raster};
///
/// let corners = [(-3.0, -3.0), (3.0, -3.0), (0.0, 3.0)].map(|(x, y)| Vec3::new(x, y, 0.0));
/// let mesh = Mesh { positions: corners.to_vec(), triangles: vec![[0, 1, 2]], ..Mesh::default() };
/// let camera = Camera::above(20, 10, 10.0, 2.0);
/// let seen = raster(&mesh, None, &camera, &RasterOptions::default(), |hits| {
///     hits.normals.iter().map(|n| n.to_array().map(|v| v.abs())).collect()
/// });
/// // blue where the normal is +Z, two units away
/// assert_eq!(seen.view.color.pixel(10, 5), [0.0, 0.0, 1.0, 1.0]);
/// assert!((seen.view.depth.pixel(10, 5)[0] - 2.0).abs() < 1e-6);
/// assert_eq!(seen.triangles[5 * 20 + 10], 0);
/// ```
pub fn raster(
    mesh: &Mesh,
    layers: Option<&RasterLayers>,
    camera: &Camera,
    options: &RasterOptions,
    color: impl Fn(&RayHits) -> Vec<[f32; 3]> + Sync,
) -> RasterView {
    let mut view = RasterView::default();
    raster_into(&mut view, mesh, layers, camera, options, color);
    view
}

/// Translucent layers around a mesh, ready to be rasterized.
pub struct RasterLayers<'a> {
    /// The innermost first.
    layers: Vec<RasterLayer<'a>>,
}

struct RasterLayer<'a> {
    layer: &'a ShellLayer,
    surface: Mesh,
    /// The indices of its triangles in the mesh.
    ids: Vec<u32>,
}

impl<'a> RasterLayers<'a> {
    /// Returns the layers around a mesh with normals.
    ///
    /// # Panics
    ///
    /// Panics if a layer does not have one offset and one alpha for each vertex.
    pub fn new(mesh: &Mesh, shells: &'a Shells) -> RasterLayers<'a> {
        let layer = |layer: &'a ShellLayer| {
            let (surface, ids) = layer.surface(mesh);
            RasterLayer { layer, surface, ids }
        };
        RasterLayers { layers: shells.layers.iter().map(layer).collect() }
    }
}

/// Rasterizes a mesh like [`raster`], reusing the memory of an earlier view.
pub fn raster_into(
    seen: &mut RasterView,
    mesh: &Mesh,
    layers: Option<&RasterLayers>,
    camera: &Camera,
    options: &RasterOptions,
    color: impl Fn(&RayHits) -> Vec<[f32; 3]> + Sync,
) {
    let is_clear = resize(seen, camera, options.normals);
    let clear = |out: &mut PictureRows| {
        if !is_clear {
            out.rgba.fill([0.0; 4]);
            out.depth.fill(0.0);
            out.normal.fill([0.0; 3]);
        }
        out.triangles.fill(NOTHING);
    };
    let (width, height) = (camera.width as usize, camera.height as usize);
    let rows = bands(seen, width, height);
    let lens = if width == 0 || height == 0 { None } else { Lens::new(camera, mesh) };
    let Some(lens) = lens else { return rows.for_each(|mut out| clear(&mut out)) };
    let surfaces = surfaces(&lens, mesh, layers, options.cull);
    let painter = Painter {
        mesh,
        camera,
        origin: camera.position.as_vec3(),
        forward: camera.forward(),
        scale: options.world_from_scene.scale as f32,
        world_from_mesh: options.world_from_scene.rotation_f32(),
        straight: straight_rays(camera),
        jump: JUMP / camera.fx.abs() as f32,
        bare: options.bare_hits,
        color,
    };
    rows.for_each_init(Scratch::new, |scratch, mut out| {
        clear(&mut out);
        draw_band(&painter, &surfaces, width, &mut out, scratch);
    });
}

/// Gives the pictures the size of a camera's, and returns whether all their pixels are 0.
fn resize(seen: &mut RasterView, camera: &Camera, has_normals: bool) -> bool {
    let (width, height) = (camera.width, camera.height);
    let RasterView { view, triangles } = seen;
    let normals = if has_normals { [width, height] } else { [0, 0] };
    // every pixel of a new picture is 0
    let mut is_clear = true;
    for (image, [width, height], channels) in [
        (&mut view.color, [width, height], 4),
        (&mut view.depth, [width, height], 1),
        (&mut view.normal, normals, 3),
    ] {
        if (image.width, image.height, image.channels) == (width, height, channels) {
            is_clear = false;
        } else {
            *image = Image::new(width, height, channels);
        }
    }
    triangles.resize(width as usize * height as usize, NOTHING);
    is_clear
}

/// Returns the pictures in bands as high as a tile.
fn bands(
    seen: &mut RasterView,
    width: usize,
    height: usize,
) -> impl ParallelIterator<Item = PictureRows<'_>> {
    let RasterView { view, triangles } = seen;
    // a picture that is not rendered has no rows
    let mut normal_rows: Vec<&mut [f32]> = view.normal.data.chunks_mut((TILE * width * 3).max(1)).collect();
    normal_rows.resize_with(height.div_ceil(TILE), Default::default);
    view.color
        .data
        .par_chunks_mut((TILE * width * 4).max(1))
        .zip(view.depth.data.par_chunks_mut((TILE * width).max(1)))
        .zip(normal_rows)
        .zip(triangles.par_chunks_mut((TILE * width).max(1)))
        .enumerate()
        .map(|(row, (((rgba, depth), normal), triangles))| PictureRows {
            top: row * TILE,
            rgba: rgba.as_chunks_mut().0,
            depth,
            normal: normal.as_chunks_mut().0,
            triangles,
        })
}

/// Triangles that share their vertices, sorted into tiles.
type BinnedSurface<'a> = (Vec<Bins>, RasterSurface<'a>);

/// Returns the mesh, and the sides of the layers around it, the nearest first.
fn surfaces<'a>(
    lens: &Lens,
    mesh: &'a Mesh,
    layers: Option<&'a RasterLayers>,
    cull: bool,
) -> Vec<BinnedSurface<'a>> {
    let sides = if cull { Sides::Front } else { Sides::Both };
    let core = Faces { positions: &mesh.positions, triangles: &mesh.triangles, ids: None, sides };
    let mut surfaces = vec![(lens.bin(&core), RasterSurface { positions: &mesh.positions, shell: None })];
    let layers = layers.map_or(&[][..], |l| &l.layers);
    let fronts = layers.iter().rev().map(|layer| (layer, Sides::Front));
    for (layer, sides) in fronts.chain(layers.iter().map(|layer| (layer, Sides::Back))) {
        let RasterLayer { layer, surface: Mesh { positions, triangles, .. }, ids } = layer;
        let faces = Faces { positions, triangles, ids: Some(ids), sides };
        surfaces.push((lens.bin(&faces), RasterSurface { positions, shell: Some(layer) }));
    }
    surfaces
}

/// Memory of a thread, reused from band to band.
struct Scratch {
    tile: Box<Tile>,
    /// The tile of the layers, once there are any.
    over: Vec<Box<Tile>>,
    batch: Box<SampleBatch>,
    queue: RayHits,
}

impl Scratch {
    fn new() -> Scratch {
        Scratch {
            tile: Tile::new(),
            over: Vec::new(),
            batch: Box::<SampleBatch>::new(Zeroable::zeroed()),
            queue: RayHits::default(),
        }
    }
}

/// Draws the tiles of a band of a picture of this width: the layers from the nearest side, then the
/// mesh.
fn draw_band<C: Fn(&RayHits) -> Vec<[f32; 3]>>(
    painter: &Painter<'_, C>,
    surfaces: &[BinnedSurface],
    width: usize,
    out: &mut PictureRows,
    scratch: &mut Scratch,
) {
    let Scratch { tile, over, batch, queue } = scratch;
    let (across, height) = (width.div_ceil(TILE), out.depth.len() / width);
    for column in 0..across {
        let index = out.top / TILE * across + column;
        let has = |bins: &[Bins]| bins.iter().any(|b| b.faces(index).len() > 0);
        if !surfaces.iter().any(|(bins, _)| has(bins)) {
            continue;
        }
        let area = TileArea { left: column * TILE, width: TILE.min(width - column * TILE), height };
        tile.move_to(area.left, out.top, area.width, area.height);
        let (core, own) = &surfaces[0];
        draw(tile, core, index);
        let mut light = Vec::new();
        for (bins, surface) in surfaces[1..].iter().filter(|(bins, _)| has(bins)) {
            if over.is_empty() {
                over.push(Tile::new());
            }
            light.resize(TILE * TILE, [1.0; SAMPLES]);
            over[0].behind(tile);
            draw(&mut over[0], bins, index);
            painter.paint(&over[0], surface, &mut light, area, out, batch, queue);
        }
        painter.paint(tile, own, &mut light, area, out, batch, queue);
    }
}

tiface_base::dispatch! {
    /// Draws the faces of a tile: first the front faces, which hide most of the rest.
    fn draw / draw_faces(tile: &mut Tile, bins: &[Bins], index: usize)
}

#[inline(always)]
fn draw_faces<const F: bool>(tile: &mut Tile, bins: &[Bins], index: usize) {
    let mut has_backs = false;
    for face in bins.iter().flat_map(|b| b.faces(index)) {
        if face.back {
            has_backs = true;
        } else {
            tile.draw(face);
        }
    }
    if has_backs {
        tile.look_up_farthest();
        bins.iter().flat_map(|b| b.faces(index)).filter(|face| face.back).for_each(|face| tile.draw(face));
    }
}

#[cfg(test)]
mod tests;
