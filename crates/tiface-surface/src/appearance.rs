//! Colors of a mesh, fitted to the photographs by linear least squares.
//!
//! A pixel `p` of a photograph is the mean of what its rays meet, and so linear in colors that live
//! at nodes of the surface: texels of an atlas, or vertices.
//!
//! ```text
//! min_c  Σ_p D_p ‖ g y_p − b_p − Σ_k Y_k(d_p) Σ_t W_pt c_tk ‖²
//!        + μ₀ ‖∇c₀‖² + μ₁ Σ_{k>0} ‖∇c_k‖² + λ Σ_{k>0} ‖c_k‖²
//!        + ν Σ_t ∫_{U_t} ‖Σ_k Y_k c_tk‖²
//! ```
//!
//! `y` is the photograph's pixel and `g` its photograph's gain, `b` the color of the surface before
//! the fit, `W` the shares of the nodes under the pixel's rays (visibility, footprint and the
//! opacity of soft layers, which have the colors of the surface under them, in one), `Y_k` real
//! spherical harmonics of the direction to the viewer and `∇` the difference between neighboring
//! nodes. `D` is the root of the cosine between view and surface where the head alone fills the
//! pixel, by the mask and by all rays, and else 0: what is behind the head never bleeds in. Near
//! the mask's outline pixels that shine or look like what is behind count as that, too. All values
//! are sRGB-coded, as the metrics are.
//!
//! It is solved twice. The diffuse color (one function) has the finest nodes available, and is what
//! every viewer shows. What depends on the view is smooth over the surface, so that the vertices
//! carry it, as a difference to the diffuse color. It is kept small in the directions `U` from
//! which a vertex could be seen but no photograph looks: a fit to the others may be anything there,
//! and would glare from behind. What no photograph shows follows its neighbors some nodes far, and
//! keeps its color beyond.

mod glare;
mod nodes;
mod photograph;
mod rows;
mod solve;

pub(super) use nodes::Nodes;
pub use photograph::Photograph;

use glam::{Mat3, Vec3};
use rows::{RayTarget, Row, Rows};
use serde::Serialize;
use solve::{Smoothness, System};
use std::time::Instant;
use tiface_base::geom::sphharm::{Y0, functions};
use tiface_base::geom::{Atlas, Bvh, Harmonics, Mesh, ShellCaster, Shells, area_vector};
use tiface_base::image::Image;
use tiface_base::io::give_memory_back;
use tiface_base::{Error, Monitor, Result};

/// Approximate maximum number of photographs' pixels that colors are fitted to: more hardly change
/// the colors.
const MAX_PIXELS: usize = 1_000_000;

/// Every n-th photograph is left out of the first fits, to validate them.
const VALIDATION_STRIDE: u32 = 6;

/// Gains stay within this factor of their mean: more is no exposure.
const MAX_GAIN: f32 = 1.25;

/// Smoothness of the diffuse color over texels.
const TEXELS: Smoothness = Smoothness { constant: 0.25, others: 0.0, ridge: 0.0, unseen: 0.0 };

/// Candidates for the smoothness of view-dependent color, over vertices: skin prefers the first,
/// hair the second.
const VERTICES: [Smoothness; 2] = [
    Smoothness { constant: 0.02, others: 0.05, ridge: 8e-6, unseen: 0.05 },
    Smoothness { constant: 0.25, others: 0.75, ridge: 1e-4, unseen: 0.05 },
];

/// Fitted colors.
pub struct Appearance {
    /// Diffuse color of the texels, sRGB-coded, and which of them were fitted; empty where colors
    /// are those of vertices.
    pub texels: (Vec<[f32; 3]>, Vec<bool>),
    /// Diffuse color of the vertices, sRGB-coded.
    pub vertices: Vec<[f32; 3]>,
    /// View-dependent color, if it improves photographs that were left out.
    pub harmonics: Option<Harmonics>,
    /// A report of the fit.
    pub report: AppearanceReport,
}

/// A report of a fit.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct AppearanceReport {
    /// Pixels that were fitted to, those of rendered views included.
    pub pixels: usize,
    /// Share of the nodes that some of them show, 0..=1.
    pub seen: f64,
    /// Degree of view-dependent color.
    pub degree: u32,
    /// Weight of its smoothness, if its degree is above 0.
    pub smoothness: f32,
    /// PSNR of photographs left out, dB: diffuse, then per candidate (degree, smoothness, PSNR).
    pub left_out: Vec<(u32, f32, f64)>,
    /// PSNR of the fitted pixels, dB: before, diffuse, with view-dependent color.
    pub psnr: [f64; 3],
    /// Smallest and largest gain of a photograph.
    pub gains: [f32; 2],
    /// Duration of the fit.
    pub seconds: f64,
}

/// The nodes of the colors, with their values before the fit, sRGB-coded.
pub enum Colors<'a> {
    /// Texels of an atlas: a picture of its size, 3 channels.
    Texels(&'a Atlas, &'a Image),
    /// The vertices' own colors.
    Vertices,
}

/// Fits colors to photographs, whose masks have their sizes; vertices have colors, and normals if
/// there are `shells` around the mesh. What depends on the view has degree `max_degree` at most,
/// and 2: the one that shows photographs best that were left out of a first fit. They decide
/// between two smoothnesses of this degree, too.
///
/// Returns `None` where no photograph shows the head.
///
/// # Errors
///
/// A request to stop.
pub fn fit(
    mesh: &Mesh,
    shells: Option<&Shells>,
    colors: Colors,
    photographs: &[Photograph],
    max_degree: u32,
    turned: Mat3,
    monitor: &dyn Monitor,
) -> Result<Option<Appearance>> {
    let (begin, max_degree) = (Instant::now(), max_degree.min(2));
    let taken = photographs.iter().filter(|p| !p.rendered);
    let head: usize = taken.map(Photograph::head_pixels).sum();
    let stride = (head as f64 / MAX_PIXELS as f64).sqrt().ceil().max(1.0) as u32;
    let shown = shells.map(|shells| shells.on_core(mesh));
    let (core, layers) = shown.as_ref().map_or((mesh, None), |(core, layers)| (core, Some(layers)));
    let layers = layers.map(|layers| ShellCaster::new(core, layers));
    let target = RayTarget { mesh: core, bvh: Bvh::new(core), layers };
    let rows = Rows::new(&target, photographs, stride, turned);
    if rows.is_empty() {
        return Ok(None);
    }
    let vertices = Nodes::vertices(mesh);
    let normals = vertex_normals(mesh, turned);
    let (fine, before) = match colors {
        Colors::Vertices => (Nodes::vertices(mesh), mesh.colors.clone()),
        Colors::Texels(atlas, image) => {
            let nodes = Nodes::texels(atlas);
            let before = nodes.texels_of(image);
            (nodes, before)
        }
    };
    let smooth = match colors {
        Colors::Texels(..) => TEXELS,
        Colors::Vertices => VERTICES[0],
    };
    monitor.check_stop()?;
    let fine_start = (&fine, &before[..], &smooth);
    let lobes = (&vertices, &normals[..]);
    let choice = choose(&rows.half(), lobes, fine_start, photographs, max_degree, monitor)?;
    let Choice { degree, smoothness, gains, left_out } = choice;
    monitor.check_stop()?;
    // the matrices of the choice: freed, they would stay resident beside those that follow
    give_memory_back();

    let all = |_: u32| true;
    let in_fine = rows.matrix(&fine);
    let system = System { rows: &rows, matrix: &in_fine, nodes: &fine, normals: &[] };
    let target = system.missing(&photo(&rows, &gains), &before, 1);
    let change = system.solve(&target, 1, &smooth, &all);
    let rest = system.missing(&target, &change, 1);
    let seen = in_fine.seen();
    drop(in_fine);
    monitor.check_stop()?;
    give_memory_back();
    let mut report =
        AppearanceReport { psnr: [&target, &rest, &rest].map(|e| psnr(e)), ..Default::default() };
    let harmonics = (degree > 0).then(|| {
        let in_vertices = rows.matrix(&vertices);
        let system = System { rows: &rows, matrix: &in_vertices, nodes: &vertices, normals: &normals };
        let functions = functions(degree);
        let mut coefficients = system.solve(&rest, functions, &smoothness, &all);
        report.psnr[2] = psnr(&system.missing(&rest, &coefficients, functions));
        // the first function of the fit was 1
        coefficients.iter_mut().step_by(functions).for_each(|c| *c = c.map(|v| v / Y0));
        Harmonics { functions, coefficients, turned }
    });

    let color = |(b, c): (&[f32; 3], &[f32; 3])| std::array::from_fn(|k| (b[k] + c[k]).clamp(0.0, 1.0));
    let own: Vec<[f32; 3]> = before.iter().zip(&change).map(color).collect();
    let (texels, vertices) = match colors {
        Colors::Vertices => (Default::default(), own),
        Colors::Texels(_, image) => (fine.onto(&own, image), fine.at_corners(mesh, &own)),
    };
    let shown = |v: &usize| rows.binary_search_by_key(&(*v as u32), |row| row.view).is_ok();
    let of_all = (0..gains.len()).filter(|&v| !photographs[v].rendered).filter(shown).flat_map(|v| gains[v]);
    report = AppearanceReport {
        pixels: rows.len(),
        seen,
        degree,
        smoothness: smoothness.others,
        left_out,
        gains: [of_all.clone().fold(f32::MAX, f32::min), of_all.fold(0.0, f32::max)],
        seconds: begin.elapsed().as_secs_f64(),
        ..report
    };
    Ok(Some(Appearance { texels, vertices, harmonics, report }))
}

/// Returns the unit normals of a mesh's vertices, by the areas around them, turned.
fn vertex_normals(mesh: &Mesh, turned: Mat3) -> Vec<Vec3> {
    let mut sums = vec![Vec3::ZERO; mesh.positions.len()];
    for (t, triangle) in mesh.triangles.iter().enumerate() {
        let area = turned * area_vector(mesh.corners(t as u32));
        triangle.iter().for_each(|&v| sums[v as usize] += area);
    }
    sums.into_iter().map(Vec3::normalize_or_zero).collect()
}

/// Degree and smoothness, chosen by the photographs that were left out.
struct Choice {
    degree: u32,
    smoothness: Smoothness,
    /// `[photographs]`, per channel; the mean of those that are not rendered is 1.
    gains: Vec<[f32; 3]>,
    left_out: Vec<(u32, f32, f64)>,
}

fn choose(
    rows: &Rows,
    (vertices, normals): (&Nodes, &[Vec3]),
    (fine, before, smooth): (&Nodes, &[[f32; 3]], &Smoothness),
    photographs: &[Photograph],
    max_degree: u32,
    monitor: &dyn Monitor,
) -> Result<Choice> {
    let all = |_: u32| true;
    let held = |v: u32| v % VALIDATION_STRIDE == VALIDATION_STRIDE / 2 && !photographs[v as usize].rendered;
    let ones = vec![[1f32; 3]; photographs.len()];
    let (in_fine, in_vertices) = (rows.matrix(fine), rows.matrix(vertices));
    let (of_fine, of_vertices) = (
        System { rows, matrix: &in_fine, nodes: fine, normals: &[] },
        System { rows, matrix: &in_vertices, nodes: vertices, normals },
    );
    let start = of_fine.missing(&photo(rows, &ones), before, 1);
    // even a coarse fit to all photographs gives their brightness; twice, since the fit follows
    // them. It is one of whole colors, which no direction makes small
    let (count, mut gains) = (functions(max_degree.min(1)), ones.clone());
    let coarse = Smoothness { unseen: 0.0, ..VERTICES[0] };
    for _ in 0..2 {
        let target = of_fine.missing(&photo(rows, &gains), before, 1);
        monitor.check_stop()?;
        let x = of_vertices.solve(&target, count, &coarse, &all);
        gains = gains_of(rows, &of_vertices.missing(&start, &x, count), photographs);
    }
    let target = of_fine.missing(&photo(rows, &gains), before, 1);
    let change = of_fine.solve(&target, 1, smooth, &|v| !held(v));
    let rest = of_fine.missing(&target, &change, 1);
    drop(in_fine);
    let judge = |error: &[[f32; 3]]| -> f64 {
        let of: Vec<[f32; 3]> =
            rows.iter().zip(error).filter(|(row, _)| held(row.view)).map(|(_, e)| *e).collect();
        psnr(&of)
    };
    let view_dependent = |degree: u32, smoothness: Smoothness| {
        monitor.check_stop()?;
        let x = of_vertices.solve(&rest, functions(degree), &smoothness, &|v| !held(v));
        let error = of_vertices.missing(&rest, &x, functions(degree));
        Ok::<_, Error>((degree, smoothness, judge(&error)))
    };
    let mut candidates: Vec<(u32, Smoothness, f64)> = vec![(0, VERTICES[1], judge(&rest))];
    for degree in 1..=max_degree {
        candidates.push(view_dependent(degree, VERTICES[0])?);
    }
    if max_degree > 0 {
        // the second smoothness, of the degree that is best by the first
        let degree = best_of(&candidates[1..]).0;
        candidates.push(view_dependent(degree, VERTICES[1])?);
    }
    let left_out = candidates.iter().map(|(d, s, db)| (*d, s.others, *db)).collect();
    // without data to decide on, the more careful one
    let enough = (0..photographs.len() as u32).any(held);
    let best = match enough {
        true => best_of(&candidates),
        false => &candidates[0],
    };
    Ok(Choice { degree: best.0, smoothness: best.1, gains, left_out })
}

/// Returns the candidate with the highest PSNR, the first among equals.
fn best_of(candidates: &[(u32, Smoothness, f64)]) -> &(u32, Smoothness, f64) {
    candidates.iter().fold(&candidates[0], |best, c| if c.2 > best.2 { c } else { best })
}

/// Returns the photographs' pixels with gains, `[rows]`.
fn photo(rows: &Rows, gains: &[[f32; 3]]) -> Vec<[f32; 3]> {
    let with = |row: &Row| std::array::from_fn(|k| row.photo[k] * gains[row.view as usize][k]);
    rows.iter().map(with).collect()
}

/// Returns the gain of each photograph that brings it closest to the fitted image, which is the
/// photograph less `error` `[rows]`; relative to the mean of those that are not rendered.
fn gains_of(rows: &Rows, error: &[[f32; 3]], photographs: &[Photograph]) -> Vec<[f32; 3]> {
    let mut sums = vec![[[0f64; 2]; 3]; photographs.len()];
    for (row, error) in rows.iter().zip(error) {
        for k in 0..3 {
            let (y, e) = (f64::from(row.photo[k]), f64::from(error[k]));
            let sum = &mut sums[row.view as usize][k];
            *sum = [sum[0] + (y - e) * y, sum[1] + y * y];
        }
    }
    let raw = |s: &[f64; 2]| if s[1] > 0.0 { s[0] / s[1] } else { 1.0 };
    let mean: [f64; 3] = std::array::from_fn(|k| {
        let taken = sums.iter().zip(photographs).filter(|(_, p)| !p.rendered).map(|(s, _)| s);
        let seen = taken.filter(|s| s[k][1] > 0.0);
        let (total, n) = seen.fold((0.0, 0), |(t, n), s| (t + raw(&s[k]).max(1e-3).ln(), n + 1));
        (total / f64::from(n.max(1))).exp()
    });
    let gain = |s: &[[f64; 2]; 3]| {
        std::array::from_fn(|k| ((raw(&s[k]) / mean[k]) as f32).clamp(1.0 / MAX_GAIN, MAX_GAIN))
    };
    sums.iter().map(gain).collect()
}

/// Returns the PSNR of errors, dB; an exact fit counts as 100.
fn psnr(errors: &[[f32; 3]]) -> f64 {
    let sum: f64 = errors.iter().flatten().map(|e| f64::from(*e).powi(2)).sum();
    (-10.0 * (sum / (3 * errors.len()).max(1) as f64).log10()).min(100.0)
}

impl System<'_> {
    /// Returns the residual of `target` `[rows]` after subtracting the rows of `x`
    /// `[nodes, count]`.
    fn missing(&self, target: &[[f32; 3]], x: &[[f32; 3]], count: usize) -> Vec<[f32; 3]> {
        let left = |(t, shown): (&[f32; 3], [f32; 3])| std::array::from_fn(|k| t[k] - shown[k]);
        target.iter().zip(self.shown(x, count)).map(left).collect()
    }
}

#[cfg(test)]
mod tests;
