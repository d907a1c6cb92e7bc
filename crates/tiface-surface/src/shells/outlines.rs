//! Photographs' outlines as equations for the opacities of layers.

use super::super::appearance::{Nodes, Photograph};
use super::super::regularized::{Equation, Prior, step};
use glam::Vec2;
use rayon::prelude::*;
use tiface_base::geom::{Bvh, Hit, Mesh, ShellCaster, Shells};
use tiface_base::{Monitor, Result};

/// Width of the band on each side of a mask's outline whose pixels are compared: no layer may reach
/// beyond it unseen. It is the largest distance of the outer layer, 11 / s, at a softness of almost
/// two pixels.
const BAND_PX: usize = 20;

/// Approximate maximum number of compared pixels.
const MAX_PIXELS: usize = 600_000;

/// Rays along each side of a pixel.
const RAYS_PER_SIDE: usize = 2;

/// Rays of a pixel.
const RAYS_PER_PIXEL: usize = RAYS_PER_SIDE * RAYS_PER_SIDE;

/// Prior of the changes of opacities, against the square of one pixel's error: where no outline
/// tells, they stay as the field says. Neighbors without a layer have none, so that opacity falls
/// towards them as the field's does.
const PRIOR: Prior = Prior { ridge: 0.02, smooth: 3.0 };

/// Gauss-Newton steps.
const ROUNDS: usize = 3;

/// Maximum number of steps of conjugate gradients in each.
const STEPS: usize = 60;

/// Maximum opacity of a layer: beyond it no light would be left to learn from.
const MAX_ALPHA: f32 = 0.95;

/// The hits of the rays of pixels near the outlines.
#[derive(Default)]
pub struct Outlines {
    /// Photograph of each row.
    view: Vec<u32>,
    /// Its mask, 0..=1.
    target: Vec<f32>,
    /// Rays of each row that meet the mesh itself.
    bare: Vec<usize>,
    /// Rays of each row that meet the opaque mesh under the layers.
    whole: Vec<usize>,
    /// The other rays of each row: the layers that each meets, the nearest first.
    pub rays: Vec<[Layers; RAYS_PER_PIXEL]>,
    /// Of each photograph the number of pixels near the outline, and the squared error of those
    /// that are opaque with and without layers, and so have no row.
    pixels: Vec<(usize, f64)>,
    /// Vertices of the triangles of the mesh.
    triangles: Vec<[u32; 3]>,
}

/// The layers that a ray meets, the nearest first, and where.
pub type Layers = Vec<(usize, Hit)>;

/// What the rays of a pixel meet.
#[derive(Default)]
struct Met {
    bare: usize,
    whole: usize,
    rays: [Layers; RAYS_PER_PIXEL],
}

/// A mesh, and the layers around the opaque mesh under them, as rays meet them.
struct Target<'a> {
    bare: Bvh,
    core: Bvh,
    layers: ShellCaster<'a>,
}

/// Returns what the rays of a pixel meet. Those of a rendered pixel are all the one that it was
/// rendered with.
fn look(photograph: &Photograph, (x, y): (usize, usize), target: &Target) -> Met {
    let side = if photograph.rendered { 1 } else { RAYS_PER_SIDE };
    let stand_for = RAYS_PER_PIXEL / (side * side);
    let mut met = Met::default();
    for (k, rays) in met.rays.chunks_exact_mut(stand_for).enumerate() {
        let sub = |at: usize, k: usize| at as f32 + (k as f32 + 0.5) / side as f32;
        let Some(ray) = photograph.camera.ray(Vec2::new(sub(x, k % side), sub(y, k / side))) else {
            continue;
        };
        met.bare += stand_for * usize::from(target.bare.any_hit(&ray));
        if target.core.any_hit(&ray) {
            met.whole += stand_for;
        } else {
            let mut layers = Layers::new();
            target.layers.cast(&ray, f32::INFINITY, |layer, hit, _| layers.push((layer, hit)));
            rays.fill(layers);
        }
    }
    met
}

impl Outlines {
    /// Casts the rays of the pixels near the outlines of photographs, on a mesh with normals and
    /// these layers.
    ///
    /// # Errors
    ///
    /// A request to stop.
    pub fn new(
        mesh: &Mesh,
        shells: &Shells,
        photographs: &[Photograph],
        monitor: &dyn Monitor,
    ) -> Result<Outlines> {
        let (core, around) = shells.on_core(mesh);
        let layers = ShellCaster::new(&core, &around);
        let target = Target { bare: Bvh::new(mesh), core: Bvh::new(&core), layers };
        let mut all = Outlines { triangles: mesh.triangles.clone(), ..Outlines::default() };
        let bands: Vec<Vec<usize>> = photographs.par_iter().map(|p| p.outline(BAND_PX)).collect();
        let stride = bands.iter().map(Vec::len).sum::<usize>().div_ceil(MAX_PIXELS).max(1);
        for ((v, photograph), band) in photographs.iter().enumerate().zip(bands) {
            monitor.check_stop()?;
            let Some(mask) = photograph.mask else {
                all.pixels.push((0, 0.0));
                continue;
            };
            let some: Vec<usize> = band.into_iter().step_by(stride).collect();
            let row = |&at: &usize| {
                let opacity = f32::from(mask.values[at]) / 255.0;
                let (x, y) = (at % mask.width as usize, at / mask.width as usize);
                let met = look(photograph, (x, y), &target);
                (opacity, met)
            };
            let mut opaque = 0.0;
            for (opacity, Met { bare, whole, rays }) in some.par_iter().map(row).collect::<Vec<_>>() {
                // pixels without opacity in render and mask, and opaque ones, carry no information
                if whole == RAYS_PER_PIXEL {
                    opaque += f64::from(1.0 - opacity).powi(2);
                    continue;
                }
                if opacity == 0.0 && rays.iter().all(Vec::is_empty) && bare == 0 {
                    continue;
                }
                all.view.push(v as u32);
                all.target.push(opacity);
                all.bare.push(bare);
                all.whole.push(whole);
                all.rays.push(rays);
            }
            all.pixels.push((some.len(), opaque));
        }
        Ok(all)
    }

    /// Returns the number of compared pixels.
    pub fn rows(&self) -> usize {
        self.view.len()
    }

    /// Returns the opacity of a row, without layers that of the mesh itself, and adds its
    /// derivatives by the opacities of the layers' vertices, `vertices` a layer.
    pub fn opacity(&self, row: usize, shells: Option<&Shells>, slopes: Option<&mut Vec<(u32, f32)>>) -> f32 {
        let Some(shells) = shells else { return self.bare[row] as f32 / RAYS_PER_PIXEL as f32 };
        let mut opacity = self.whole[row] as f32;
        let mut slopes = slopes;
        for layers in &self.rays[row] {
            let mut through = 1.0;
            let alphas: Vec<f32> = layers
                .iter()
                .map(|(layer, hit)| {
                    let alpha = shells.layers[*layer].alpha(hit, self.triangles[hit.triangle as usize]);
                    through *= 1.0 - alpha;
                    alpha
                })
                .collect();
            opacity += 1.0 - through;
            if let Some(slopes) = slopes.as_deref_mut() {
                for (k, (layer, hit)) in layers.iter().enumerate() {
                    let others =
                        (0..alphas.len()).filter(|&o| o != k).map(|o| 1.0 - alphas[o]).product::<f32>();
                    let own = &shells.layers[*layer].alphas;
                    for (v, w) in self.triangles[hit.triangle as usize].into_iter().zip(hit.weights()) {
                        let slope = others * w / RAYS_PER_PIXEL as f32;
                        let at = (layer * own.len()) as u32 + v;
                        match slopes.iter_mut().find(|s| s.0 == at) {
                            Some(s) => s.1 += slope,
                            None => slopes.push((at, slope)),
                        }
                    }
                }
            }
        }
        opacity / RAYS_PER_PIXEL as f32
    }

    /// Returns the root mean square error of opacity near the outlines of the photographs that
    /// `keep` names.
    pub fn error(&self, shells: Option<&Shells>, keep: &dyn Fn(u32) -> bool) -> f64 {
        let rows = (0..self.rows()).filter(|&row| keep(self.view[row]));
        let square = |row: usize| f64::from(self.opacity(row, shells, None) - self.target[row]).powi(2);
        let kept = (0u32..).zip(&self.pixels).filter(|(view, _)| keep(*view));
        let (count, opaque) = kept.fold((0, 0.0), |sum, (_, own)| (sum.0 + own.0, sum.1 + own.1));
        ((rows.map(square).sum::<f64>() + opaque) / count.max(1) as f64).sqrt()
    }

    /// Returns the opacities that bring the rows that `keep` names (by photograph) closest to their
    /// masks, from those of `shells`; vertices without opacity keep none.
    ///
    /// Steps of Gauss and Newton, each projected onto the opacities' range: a vertex at its lower
    /// end takes part in a step only if it is to leave it.
    pub fn fit(&self, shells: &Shells, nodes: &Nodes, keep: &dyn Fn(u32) -> bool) -> Shells {
        let vertices = nodes.len();
        let rows: Vec<usize> = (0..self.rows()).filter(|&row| keep(self.view[row])).collect();
        let alphas = |shells: &Shells| -> Vec<f64> {
            shells.layers.iter().flat_map(|layer| &layer.alphas).map(|alpha| f64::from(*alpha)).collect()
        };
        let start = alphas(shells);
        let mut fitted = shells.clone();
        for _ in 0..ROUNDS {
            let equations = self.equations(&rows, &fitted);
            let now = alphas(&fitted);
            let changes: Vec<f64> = now.iter().zip(&start).map(|(now, start)| now - start).collect();
            let free = |i: usize, up: f64| start[i] > 0.0 && (now[i] > 0.0 || up > 0.0);
            let step = step(&equations, nodes, &changes, PRIOR, free, STEPS);
            for (layer, step) in fitted.layers.iter_mut().zip(step.chunks(vertices)) {
                for (alpha, step) in layer.alphas.iter_mut().zip(step) {
                    *alpha = (*alpha + *step as f32).clamp(0.0, MAX_ALPHA);
                }
            }
        }
        fitted
    }

    /// Returns what each row misses of its mask's opacity, with the slopes of its own.
    fn equations(&self, rows: &[usize], shells: &Shells) -> Vec<Equation> {
        let equation = |&row: &usize| {
            let mut slopes = Vec::new();
            let opacity = self.opacity(row, Some(shells), Some(&mut slopes));
            (self.target[row] - opacity, slopes)
        };
        rows.par_iter().map(equation).collect()
    }
}
