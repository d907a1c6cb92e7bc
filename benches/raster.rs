//! CPU milliseconds a picture, and how far it agrees with the ray caster: a head-like mesh of
//! 200,000 triangles with a texture of 2048², 1024 × 1024 pixels.
//!
//! ```text
//! cargo bench --bench raster
//! ```
//!
//! CPU time (user + system of the process) does not depend on what else the machine does, nor on
//! the number of threads.

mod head;
mod process;

use glam::{DMat3, DVec3, Vec2};
use head::head;
use process::cpu_s;
use process::roof::Roof;
use tiface::geom::{Atlas, Bvh, Camera, Distortion, Mesh};
use tiface::image::Photo;
use tiface::render::{
    MeshTexture, RasterOptions, RasterView, RayHits, RaycastOptions, raster, raster_into, raycast,
};

const SIDE: u32 = 1024;
const PICTURES: usize = 60;

fn main() {
    let n = 129;
    let mut mesh = head(n);
    mesh.normals = mesh.angle_weighted_normals();
    let (atlas, photo) = texture(&mesh, n);
    let texture = MeshTexture::new(&mesh, &atlas, &photo, None);
    let camera = camera(&mesh);
    let roof = Roof::measure();
    println!(
        "{} triangles, {SIDE} × {SIDE} pixels, {} covered",
        mesh.triangles.len(),
        covered(&mesh, &camera)
    );
    let bent =
        Camera { distortion: Distortion { k1: -0.2, k2: 0.05, ..Distortion::default() }, ..camera.clone() };
    let both = RasterOptions { normals: false, ..RasterOptions::default() };
    let cull = RasterOptions { cull: true, ..both };
    for (name, options, camera) in
        [("front faces", &cull, &camera), ("both sides", &both, &camera), ("bent lens", &both, &bent)]
    {
        let options = &RasterOptions { bare_hits: true, ..*options };
        let mut view = RasterView::default();
        let color = |hits: &RayHits| texture.smooth_colors(hits, camera);
        let textured = cost(|| raster_into(&mut view, &mesh, None, camera, options, color));
        let bare = cost(|| raster_into(&mut view, &mesh, None, camera, options, |_| Vec::new()));
        // corners and triangles are read; color, depth and triangle of every pixel are written
        let bytes = 24 * mesh.positions.len() + 12 * mesh.triangles.len() + 24 * (SIDE * SIDE) as usize;
        let bare = roof.moved(bare, bytes as f64);
        println!("{name:12} {textured:6.1} CPU ms textured, {bare} without a texture");
    }
    let seen = raster(&mesh, None, &camera, &both, |hits| texture.smooth_colors(hits, &camera));
    let options = RaycastOptions::default();
    let cast =
        raycast(&Bvh::new(&mesh), &mesh, None, &camera, &options, |hits| texture.colors(hits, &camera, 2));
    let square = |(a, b): (&f32, &f32)| f64::from(a - b).powi(2);
    let error: f64 = seen.view.color.data.iter().zip(&cast.color.data).map(square).sum();
    let psnr = -10.0 * (error / cast.color.data.len() as f64).log10();
    println!("{psnr:.1} dB from the ray caster's");
    assert!(psnr > 30.0, "the rasterizer shows another picture than the ray caster");
}

/// CPU milliseconds of a picture, warm.
fn cost(mut picture: impl FnMut()) -> f64 {
    (0..3).for_each(|_| picture());
    let start = cpu_s();
    (0..PICTURES).for_each(|_| picture());
    1e3 * (cpu_s() - start) / PICTURES as f64
}

fn covered(mesh: &Mesh, camera: &Camera) -> usize {
    let seen = raster(mesh, None, camera, &RasterOptions::default(), |_| Vec::new());
    seen.triangles.iter().filter(|&&t| t != RasterView::NOTHING).count()
}

fn camera(mesh: &Mesh) -> Camera {
    let (bounds, rotation) = (mesh.bounds(), DMat3::from_rotation_y(0.5));
    let distance = 2.0 * f64::from(bounds.size().max_element());
    let (middle, focal) = (f64::from(SIDE) / 2.0, 1.6 * f64::from(SIDE));
    Camera {
        width: SIDE,
        height: SIDE,
        fx: focal,
        fy: focal,
        cx: middle,
        cy: middle,
        distortion: Distortion::default(),
        rotation,
        position: bounds.center().as_dvec3() + rotation * DVec3::new(0.0, 0.0, distance),
    }
}

/// Six grids of n × n squares side by side, three in a row, in smooth patches of color.
fn texture(mesh: &Mesh, n: usize) -> (Atlas, Photo) {
    let per_side = (n + 1) * (n + 1);
    let uv = |vertex: usize| {
        let (side, at) = (vertex / per_side, vertex % per_side);
        let within = Vec2::new((at % (n + 1)) as f32, (at / (n + 1)) as f32) / n as f32;
        let corner = Vec2::new((side % 3) as f32 / 3.0, (side / 3) as f32 / 2.0);
        corner + Vec2::new(0.01, 0.01) + within * Vec2::new(0.31, 0.48)
    };
    let uvs = (0..mesh.positions.len()).map(uv).collect();
    let (width, height) = (2048, 2048);
    let wave = |i: u32| {
        let (x, y) = ((i % width) as f32, (i / width) as f32);
        [(x * 0.03).sin() * (y * 0.021).cos(), (x * 0.011).cos(), (y * 0.05).sin()]
            .map(|v| (128.0 + 90.0 * v) as u8)
    };
    let rgb = (0..width * height).map(wave).collect();
    (
        Atlas { uvs, triangles: mesh.triangles.clone(), width, height },
        Photo { width, height, rgb, alpha: None },
    )
}
