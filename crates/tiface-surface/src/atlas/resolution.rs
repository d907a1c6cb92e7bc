//! How many texels each chart gets: by what it shows, and never finer than the photographs.
//!
//! With `k` for the whole texture, a chart of the part's fineness `f` has `min(k f, m)` texels
//! along a unit, `m` being what the cameras in front of it resolve. So what one chart may not have
//! goes to the others.

use super::chart::Flat;
use super::head::HeadChart;
use glam::Vec3;
use rayon::prelude::*;
use tiface_base::geom::{Camera, Mesh, area_vector};
use tiface_base::math::rank::nearest_rank;

/// Texels along the footprint of a pixel: photographs from several sides resolve more than one of
/// them does, yet not twice as much.
const TEXELS_PER_PIXEL: f32 = 2.0;

/// Cosine between a surface and the direction to a camera from which on it counts as seen.
const SEEN_COSINE: f32 = 0.2;

/// Fineness of a chart that no camera sees, over that of one that is seen.
const UNSEEN: f64 = 0.6;

/// Share of the triangles that may have coarser texels than the photographs resolve there.
const FINEST_SHARE: f64 = 0.1;

/// Returns the side of the finest texel that photographs resolve on each triangle, from the nearest
/// camera that it faces; infinite where it faces none.
pub fn resolved(mesh: &Mesh, cameras: &[Camera]) -> Vec<f32> {
    let finest = |t: u32| {
        let corners = mesh.corners(t);
        let (middle, normal) = (corners.iter().sum::<Vec3>() / 3.0, area_vector(corners).normalize_or_zero());
        let footprint = |camera: &Camera| {
            let (_, depth) = camera.project(middle)?;
            let towards = (camera.position.as_vec3() - middle).normalize_or_zero();
            (towards.dot(normal) > SEEN_COSINE).then(|| depth / camera.fx.max(camera.fy) as f32)
        };
        cameras.iter().filter_map(footprint).fold(f32::INFINITY, f32::min) / TEXELS_PER_PIXEL
    };
    (0..mesh.triangles.len() as u32).into_par_iter().map(finest).collect()
}

/// How a head's charts share the texture.
pub(super) struct Shares {
    /// Most texels a unit of the scaled charts.
    pub limit: f64,
    /// Size of a texture with the area in which the face has all that photographs resolve.
    pub sufficient_texels: Option<f64>,
}

struct Claim {
    area: f64,
    fineness: f64,
    /// Most texels along a unit.
    most: f64,
}

/// Scales charts to their texels, if their area may be `texels`.
pub(super) fn share_out(charts: &mut [HeadChart], resolved: Option<&[f32]>, texels: f64) -> Shares {
    let claims: Vec<Claim> = charts.iter().map(|chart| claim(chart, resolved)).collect();
    let taken = |k: f64| claims.iter().map(|c| c.area * (k * c.fineness).min(c.most).powi(2)).sum::<f64>();
    let whole = claims.iter().map(|c| c.area * c.fineness.powi(2)).sum::<f64>();
    let face = &claims[0];
    let sufficient = face.most.is_finite().then(|| taken(face.most / face.fineness));
    // the area grows with k, from one that no chart limits
    let (mut low, mut high) = ((texels / whole).sqrt(), 1e3 * (texels / whole).sqrt());
    for _ in 0..60 {
        let k = (low * high).sqrt();
        if taken(k) < texels { low = k } else { high = k }
    }
    let mut limit = f64::INFINITY;
    for (chart, claim) in charts.iter_mut().zip(&claims) {
        let scale = (low * claim.fineness).min(claim.most);
        chart.flat.points.iter_mut().for_each(|p| *p *= scale);
        limit = limit.min(claim.most / scale);
    }
    Shares { limit, sufficient_texels: sufficient }
}

fn claim(chart: &HeadChart, resolved: Option<&[f32]>) -> Claim {
    let Flat { triangles, .. } = &chart.flat;
    let (area, fineness) = (chart.flat.area(), chart.part.fineness());
    let Some(resolved) = resolved else { return Claim { area, fineness, most: f64::INFINITY } };
    let texel = |&t: &u32| resolved.get(t as usize).copied().filter(|r| r.is_finite() && *r > 0.0);
    let mut seen: Vec<f32> = triangles.iter().filter_map(texel).collect();
    seen.sort_by(f32::total_cmp);
    let most = nearest_rank(&seen, FINEST_SHARE).map_or(f64::INFINITY, |texel| 1.0 / f64::from(texel));
    let fineness = if 2 * seen.len() < triangles.len() { UNSEEN * fineness } else { fineness };
    Claim { area, fineness, most }
}

#[cfg(test)]
mod tests {
    use super::super::regions::Part;
    use super::*;
    use glam::DVec2;

    #[test]
    fn a_triangle_is_resolved_by_the_nearest_camera_that_it_faces() {
        let p = |x: f32, y: f32| Vec3::new(x, y, 0.0);
        let positions = vec![p(0., 0.), p(1., 0.), p(0., 1.)];
        let mesh = Mesh { positions, triangles: vec![[0, 1, 2], [0, 2, 1]], ..Mesh::default() };
        // 100 pixels a unit of slope, 5 and 2 units above: 0.05 and 0.02 a pixel
        let cameras = [5.0, 2.0].map(|z| Camera::above(80, 60, 100.0, z));
        let found = resolved(&mesh, &cameras);
        assert!((found[0] - 0.01).abs() < 1e-6 && found[1].is_infinite(), "{found:?}");
    }

    /// Returns a chart of one triangle with an area of one half.
    fn chart(triangle: u32, part: Part) -> HeadChart {
        let points = vec![DVec2::ZERO, DVec2::X, DVec2::Y];
        HeadChart { flat: Flat { triangles: vec![triangle], corners: vec![[0, 1, 2]], points }, part }
    }

    #[test]
    fn what_a_chart_may_not_have_goes_to_the_others() {
        let charts = || vec![chart(0, Part::Face), chart(1, Part::Cap)];
        let sides = |charts: &[HeadChart]| [0, 1].map(|k| charts[k].flat.points[1].x);
        // 1 and 0.12 of 0.5072 in all: 100 texels along a unit of the face
        let mut free = charts();
        let shares = share_out(&mut free, None, 5072.0);
        let [face, cap] = sides(&free);
        assert!((face - 100.0).abs() < 0.01 && (cap - 12.0).abs() < 0.01, "{face} {cap}");
        assert!(shares.limit.is_infinite() && shares.sufficient_texels.is_none());
        // 50 resolved along a unit everywhere: 1250 texels for the face, 1250 of 3822 for the cap
        let mut limited = charts();
        let shares = share_out(&mut limited, Some(&[0.02, 0.02]), 5072.0);
        let [face, cap] = sides(&limited);
        assert!((face - 50.0).abs() < 1e-3 && (cap - 50.0).abs() < 1e-3, "{face} {cap}");
        assert!((shares.limit - 1.0).abs() < 1e-5);
        // the face at 50, the cap at 6
        assert!((shares.sufficient_texels.unwrap() - (1250.0 + 18.0)).abs() < 0.01);
        // what no camera sees gets less
        let mut unseen = charts();
        share_out(&mut unseen, Some(&[1e-6, f32::INFINITY]), 5072.0);
        let [face, cap] = sides(&unseen);
        assert!((cap / face - 0.12 * 0.6).abs() < 1e-6, "{face} {cap}");
    }
}
