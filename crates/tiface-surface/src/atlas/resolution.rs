//! How many texels each chart gets: by what it shows, and never finer than the photographs.
//!
//! With `k` texels along a unit of the face, a part of fineness `f` has `k f`. Where the
//! photographs resolve no more than that on the face, hair takes what is left, up to what they
//! resolve there; a garment never does, and the face keeps its share.

use super::chart::Flat;
use super::head::HeadChart;
use super::regions::Part;
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

/// Least share of the texels that a face has.
const FACE_SHARE: f64 = 0.4;

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
    is_hair: bool,
}

impl Claim {
    /// Returns the texels along a unit with `k` of them on the face.
    fn scale(&self, k: f64) -> f64 {
        (k * self.fineness).min(self.most)
    }

    /// Returns the texels with `k` of them along a unit of the face.
    fn texels(&self, k: f64) -> f64 {
        self.area * self.scale(k).powi(2)
    }
}

/// Scales charts to their texels, if their area may be `texels`.
pub(super) fn share_out(charts: &mut [HeadChart], resolved: Option<&[f32]>, texels: f64) -> Shares {
    let claims: Vec<Claim> = charts.iter().map(|chart| claim(chart, resolved)).collect();
    let taken = |k: f64, wanted: &dyn Fn(&Claim) -> bool| -> f64 {
        claims.iter().filter(|c| wanted(c)).map(|c| c.texels(k)).sum()
    };
    let most = claims[0].most;
    let k = solved(texels, |k| taken(k, &|_| true)).min(most);
    let of_face = claims[0].texels(k);
    let of_hair = texels.min(of_face / FACE_SHARE) - taken(k, &|c| !c.is_hair);
    let hair = solved(of_hair, |k| taken(k, &|c| c.is_hair)).min(k / Part::Left.fineness());
    let mut limit = f64::INFINITY;
    for (chart, claim) in charts.iter_mut().zip(&claims) {
        let scale = claim.scale(if claim.is_hair { hair } else { k });
        chart.flat.points.iter_mut().for_each(|p| *p *= scale);
        limit = limit.min(claim.most / scale);
    }
    Shares { limit, sufficient_texels: most.is_finite().then(|| taken(most, &|_| true)) }
}

/// Returns the number whose `value`, which grows with it from 0, is `wanted`; a large one if there
/// is none.
fn solved(wanted: f64, value: impl Fn(f64) -> f64) -> f64 {
    let (mut low, mut high) = (1e-12, 1e12);
    for _ in 0..100 {
        let middle = f64::sqrt(low * high);
        if value(middle) < wanted { low = middle } else { high = middle }
    }
    low
}

fn claim(chart: &HeadChart, resolved: Option<&[f32]>) -> Claim {
    let Flat { triangles, .. } = &chart.flat;
    let (area, fineness) = (chart.flat.area(), chart.part.fineness());
    let is_hair = matches!(chart.part, Part::Left | Part::Right);
    let Some(resolved) = resolved else { return Claim { area, fineness, most: f64::INFINITY, is_hair } };
    let texel = |&t: &u32| resolved.get(t as usize).copied().filter(|r| r.is_finite() && *r > 0.0);
    let mut seen: Vec<f32> = triangles.iter().filter_map(texel).collect();
    seen.sort_by(f32::total_cmp);
    let most = nearest_rank(&seen, FINEST_SHARE).map_or(f64::INFINITY, |texel| 1.0 / f64::from(texel));
    let fineness = if 2 * seen.len() < triangles.len() { UNSEEN * fineness } else { fineness };
    Claim { area, fineness, most, is_hair }
}

#[cfg(test)]
mod tests {
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
        assert!((found[0] - 0.02 / TEXELS_PER_PIXEL).abs() < 1e-6 && found[1].is_infinite(), "{found:?}");
    }

    /// Returns a chart of one triangle with an area of one half.
    fn chart(triangle: u32, part: Part) -> HeadChart {
        let points = vec![DVec2::ZERO, DVec2::X, DVec2::Y];
        HeadChart { flat: Flat { triangles: vec![triangle], corners: vec![[0, 1, 2]], points }, part }
    }

    /// Returns the texels along a unit of a face, a scalp and a cap of one size after they were
    /// shared out.
    fn shared(resolved: Option<&[f32]>) -> ([f64; 3], Shares) {
        let mut charts = vec![chart(0, Part::Face), chart(1, Part::Left), chart(2, Part::Cap)];
        // (1 + 0.65² + 0.12²) / 2: 100 texels along a unit of the face
        let shares = share_out(&mut charts, resolved, 7184.5);
        ([0, 1, 2].map(|k| charts[k].flat.points[1].x), shares)
    }

    #[test]
    fn texels_follow_importance_and_hair_takes_what_the_face_may_not_have() {
        let near = |found: [f64; 3], expected: [f64; 3]| {
            assert!(
                found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-3 * b),
                "{found:?} {expected:?}"
            );
        };
        let (found, shares) = shared(None);
        near(found, [100.0, 65.0, 12.0]);
        assert!(shares.limit.is_infinite() && shares.sufficient_texels.is_none());
        // 50 resolved along a unit: as many on the hair, and 6 still on the cap
        let (found, shares) = shared(Some(&[0.02; 3]));
        near(found, [50.0, 50.0, 6.0]);
        assert!((shares.limit - 1.0).abs() < 1e-5);
        // the face at 50, the others below
        assert!((shares.sufficient_texels.unwrap() - 1250.0 * (1.0 + 0.4225 + 0.0144)).abs() < 0.1);
        // what no camera sees gets less, though no less hair than there is room for
        let (found, _) = shared(Some(&[1e-6, 1e-6, f32::INFINITY]));
        assert!((found[2] / found[0] - 0.12 * 0.6).abs() < 1e-6, "{found:?}");
    }

    #[test]
    fn much_hair_leaves_the_face_its_share() {
        let mut charts = vec![chart(0, Part::Face), chart(1, Part::Left), chart(2, Part::Right)];
        for hair in &mut charts[1..] {
            hair.flat.points.iter_mut().for_each(|p| *p *= 3.0);
        }
        share_out(&mut charts, None, 1000.0);
        let areas: Vec<f64> = charts.iter().map(|c| c.flat.area()).collect();
        assert!((areas[0] / areas.iter().sum::<f64>() - FACE_SHARE).abs() < 1e-3, "{areas:?}");
    }
}
