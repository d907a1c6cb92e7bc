//! A head mesh in fewer triangles, and chains of them for programs that show distant heads by less
//! detail.
//!
//! Each smaller mesh is made from the head itself, never from another smaller one, so that errors
//! do not add up: edges are collapsed ([`simplify`]), the mesh gets an atlas of its own, and
//! everything that it shows comes from the nearest points of the head ([`Original`]).

use crate::bake::{Original, tangent_space};
use crate::files::{HeadMesh, HeadTexture, LOBE_TEXEL, Lobes, tangents};
use crate::{AtlasConfig, SimplifyConfig, Warning, atlas, setting, simplify};
use tiface_base::geom::distance::{Distances, one_way};
use tiface_base::geom::{Bvh, Mesh};
use tiface_base::{Monitor, Result};

/// Options of [`resized`].
#[derive(Clone, Debug, PartialEq)]
pub struct Resize {
    /// Number of triangles to keep.
    pub triangles: usize,
    /// The atlas of the smaller mesh, its texture's size and gutter among them; `None` leaves the
    /// texture out. Without effect on a head that has none.
    pub atlas: Option<AtlasConfig>,
}

/// Returns a head in other triangles and with a new texture of it; with its soft layers and lobes,
/// and with a normal map if it has one. Harmonics are left out: no file holds those of vertices.
///
/// `surface` is simplified to these triangles: the head's own mesh, or the finer one that the head
/// was made from. One that has no more triangles than asked for stays as it is. The result is
/// closed if `surface` is, and comes with what is doubtful of it.
///
/// # Errors
///
/// An option out of range, a texture too small for its triangles, a damaged mesh, or a request to
/// stop.
pub fn resized(
    head: &HeadMesh,
    surface: &Mesh,
    resize: &Resize,
    monitor: &dyn Monitor,
) -> Result<(HeadMesh, Vec<Warning>)> {
    let mut mesh = surface.clone();
    let config = SimplifyConfig { triangles: resize.triangles, ..SimplifyConfig::default() };
    let mut warnings = simplify(&mut mesh, None, &config, monitor)?.warnings(&config);
    let original = Original::new(head);
    let shells = original.carry_vertices(&mut mesh);
    let mut texture = None;
    if let (Some(from), Some(config)) = (&head.texture, &resize.atlas) {
        let (layout, done) = atlas(&mesh, config, monitor)?;
        warnings.extend(done.warnings());
        let AtlasConfig { size_px, gutter_px, .. } = *config;
        let side = from.color.width.div_ceil(size_px).clamp(1, 2);
        let carried = original.carry_texture(from, &mesh, &layout, side, gutter_px, monitor)?;
        let bend = |normals| -> Result<_> {
            Ok(tangent_space(&mesh, &layout, &tangents(&mesh, &layout)?, normals, gutter_px))
        };
        let normal = carried.normal.as_ref().map(bend).transpose()?;
        let lobes = from.lobes.as_ref().and_then(|l| Lobes::new(&carried.lobes, l.turned));
        let lobes = lobes.map(|l| l.reduced(size_px / LOBE_TEXEL));
        texture = Some(HeadTexture { color: carried.color.encoded(), normal, lobes, atlas: layout });
    }
    let world_from_scene = head.world_from_scene;
    Ok((HeadMesh { mesh, world_from_scene, texture, harmonics: None, shells }, warnings))
}

/// A smaller head of a chain of levels of detail.
#[derive(Clone, Debug)]
pub struct DetailLevel {
    /// The head.
    pub head: HeadMesh,
    /// Largest distance between its surface and that of the chain's head, measured both ways, in
    /// scene units.
    pub largest: f64,
    /// Mean distance, the larger of both ways, in scene units.
    pub mean: f64,
    /// What is doubtful of it.
    pub warnings: Vec<Warning>,
}

/// Points for each triangle of the head at which the distance between two surfaces is measured.
const DISTANCE_SAMPLES: usize = 4;

/// Fewest triangles of a level: fewer show no face.
const FEWEST: usize = 200;

/// Smallest side of a level's texture.
const SMALLEST_PX: u32 = 128;

/// Returns how many levels of detail a mesh of so many triangles can have, itself among them.
pub fn most_levels(triangles: usize) -> usize {
    1 + (triangles / FEWEST).max(1).ilog2() as usize
}

/// Returns all but the first of a chain of `levels` heads: the first is the head itself, each other
/// has half as many triangles as the one before. A quarter of the triangles is for a head of half
/// the size on the screen, so the side of the texture halves from the first to the second and at
/// every other level after it, down to 128. `atlas` has the options of the new atlases; its
/// `size_px` is the side of the head's own texture.
///
/// # Errors
///
/// As [`resized`]; and a chain whose last level would have fewer than 200 triangles.
pub fn lods(
    head: &HeadMesh,
    levels: usize,
    atlas: &AtlasConfig,
    monitor: &dyn Monitor,
) -> Result<Vec<DetailLevel>> {
    let triangles = head.mesh.triangles.len();
    let most = most_levels(triangles);
    setting((1..=most).contains(&levels), "levels", &format!("1..={most} of {triangles} triangles"), levels)?;
    let (kept, samples) = (Bvh::new(&head.mesh), DISTANCE_SAMPLES * triangles);
    let mut chain = Vec::new();
    for level in 1..levels {
        let size_px = (atlas.size_px >> level.div_ceil(2)).max(SMALLEST_PX.min(atlas.size_px));
        // a gutter as wide on the surface
        let gutter_px = (atlas.gutter_px >> level.div_ceil(2)).max(2).min(atlas.gutter_px);
        let atlas = AtlasConfig { size_px, gutter_px, resolved: None, ..atlas.clone() };
        let resize = Resize { triangles: triangles >> level, atlas: Some(atlas) };
        let (smaller, warnings) = resized(head, &head.mesh, &resize, monitor)?;
        let ways =
            [one_way(&smaller.mesh, &kept, samples), one_way(&head.mesh, &Bvh::new(&smaller.mesh), samples)];
        let most = |of: fn(&Distances) -> f64| ways.iter().flatten().map(of).fold(0.0, f64::max);
        let (largest, mean) = (most(|way| way.max), most(|way| way.mean));
        chain.push(DetailLevel { head: smaller, largest, mean, warnings });
    }
    Ok(chain)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bake::testing::ball;
    use crate::files::check;
    use tiface_base::Quiet;

    #[test]
    fn each_level_has_half_the_triangles_and_lies_within_its_distance() {
        let head = ball();
        let atlas = AtlasConfig { size_px: 512, gutter_px: 4, ..AtlasConfig::default() };
        let chain = lods(&head, 4, &atlas, &Quiet).unwrap();
        assert_eq!(chain.len(), 3);
        let (all, mut before) = (head.mesh.triangles.len(), 0.0);
        for (k, DetailLevel { head, largest, mean, .. }) in (1..).zip(&chain) {
            let (found, asked) = (head.mesh.triangles.len(), all >> k);
            assert!(found <= asked && found + 2 >= asked, "{found} of {asked}");
            let report = check(&head.mesh, 1.0);
            assert!(
                report.require(&["watertight", "one-piece", "no-self-intersections"]).is_ok(),
                "{report}"
            );
            let texture = head.texture.as_ref().unwrap();
            assert_eq!(texture.color.width, [512, 256, 256, 128][k]);
            assert!(texture.lobes.is_some() && head.shells.is_some());
            // a chord of a ball of radius 12 of n triangles, each of area 4 π r² / n with sides of
            // about 2.3 r √(4 π / √3 / n) / 2, lies r (side / r)² / 6 inside at most
            let told = 12.0 * 14.5 / found as f64;
            assert!(*mean <= *largest && *largest < 2.0 * told, "level {k}: {mean} {largest} {told}");
            assert!(*mean > before, "level {k}: {mean}");
            before = *mean;
        }
        assert!(lods(&head, 1, &atlas, &Quiet).unwrap().is_empty());
        let e = lods(&head, 9, &atlas, &Quiet).unwrap_err();
        assert!(e.to_string().contains("`levels` is 9"), "{e}");
    }

    #[test]
    fn a_head_without_a_texture_or_a_wish_for_one_gets_none() {
        let head = ball();
        let resize = Resize { triangles: 1000, atlas: None };
        let (small, _) = resized(&head, &head.mesh, &resize, &Quiet).unwrap();
        assert!(small.texture.is_none() && small.mesh.is_closed());
        let [colors, vertices] = [small.mesh.colors.len(), small.mesh.positions.len()];
        assert!(small.mesh.triangles.len() <= 1000 && colors == vertices && small.harmonics.is_none());
    }
}
