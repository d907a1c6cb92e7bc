//! The plain way to lay a mesh into a texture: every triangle the half of a square, in rows.
//!
//! Works for any triangles, at the price of a seam along every edge. Two halves share a square:
//! right angles in opposite corners, `gap` to the square's sides and 2 gap between the long sides.

use super::chart::widest;
use super::{AtlasConfig, AtlasLayout};
use glam::{DVec2, Vec2};
use tiface_base::geom::{Atlas, Mesh};
use tiface_base::{Error, Result};

/// The shortest leg worth having, in texels.
const MIN_LEG_PX: f64 = 1.0;

/// Gives each triangle a half square; the gutter becomes as wide as leaves a third of each square
/// to its triangles.
pub(super) fn half_squares(mesh: &Mesh, config: &AtlasConfig) -> Result<AtlasLayout> {
    let (count, size) = (mesh.triangles.len(), f64::from(config.size_px));
    let squares = count.div_ceil(2);
    let rows = (1..).find(|r| r * r >= squares).unwrap_or(1);
    // leg = side − 2 gap − √2 gap, see the module; the texture's border is another gap away
    let spent = 2.0 + 2f64.sqrt();
    let side_with = |gap: f64| (size - 2.0 * gap) / rows as f64;
    let mut gap = f64::from(config.gutter_px);
    let leg_with = |gap: f64| side_with(gap) - spent * gap;
    let min_leg = (side_with(0.0) / 3.0).max(MIN_LEG_PX);
    if leg_with(gap) < min_leg {
        // linear in the gap: leg_with(gap) = size / rows − gap (2 / rows + spent)
        gap = ((size / rows as f64 - min_leg) / (2.0 / rows as f64 + spent)).max(0.0);
    }
    let (side, leg) = (side_with(gap), leg_with(gap));
    if leg < MIN_LEG_PX {
        let px = config.size_px;
        let message = format!("{count} triangles do not fit into a texture of {px} × {px} texels");
        return Err(Error::cannot(message, "a larger texture, or a mesh simplified to fewer triangles"));
    }
    let mut atlas = Atlas { width: config.size_px, height: config.size_px, ..Atlas::default() };
    for t in 0..count as u32 {
        let square = t as usize / 2;
        let low = DVec2::new((square % rows) as f64, (square / rows) as f64) * side + gap;
        // v runs down: right, then up the image, is counter-clockwise as seen
        let (corner, along) = match t % 2 {
            0 => (low + DVec2::new(gap, side - gap), [DVec2::X, -DVec2::Y]),
            _ => (low + DVec2::new(side - gap, gap), [-DVec2::X, DVec2::Y]),
        };
        let first = atlas.uvs.len() as u32;
        let points = [corner, corner + leg * along[0], corner + leg * along[1]];
        atlas.uvs.extend(points.map(|p| -> Vec2 { (p / size).as_vec2().clamp(Vec2::ZERO, Vec2::ONE) }));
        let mut triangle = [first, first + 1, first + 2];
        triangle.rotate_right(widest(mesh, t));
        atlas.triangles.push(triangle);
    }
    Ok(AtlasLayout { atlas, repaired: 0, gutter_px: gap, head: None })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::uv_check;
    use glam::Vec3;

    fn heap(count: u32) -> Mesh {
        let positions =
            (0..3 * count).map(|i| Vec3::new((i * 7 % 11) as f32, (i * 5 % 13) as f32, i as f32)).collect();
        Mesh {
            positions,
            triangles: (0..count).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect(),
            ..Mesh::default()
        }
    }

    #[test]
    fn halves_keep_the_gutter_or_say_what_is_left_of_it() {
        for (count, size_px, full) in [(1, 128, true), (2, 128, true), (7, 256, true), (3000, 512, false)] {
            let config = AtlasConfig { size_px, ..AtlasConfig::default() };
            let mesh = heap(count);
            let laid = half_squares(&mesh, &config).unwrap();
            let r = uv_check(&mesh, &laid.atlas);
            assert!(r.is_sound() && r.mirrored_charts == 0, "{count}: {r}");
            assert_eq!(laid.gutter_px == 8.0, full, "{count}");
            assert!(r.border_distance_px > 2.0 * laid.gutter_px - 1e-3, "{count}: {r}");
            let apart = r.chart_distance_px.unwrap_or(f64::INFINITY);
            assert!(apart > 2.0 * laid.gutter_px - 1e-3, "{count}: {r}");
        }
    }

    #[test]
    fn a_texture_without_room_is_refused() {
        let config = AtlasConfig { size_px: 16, ..AtlasConfig::default() };
        assert!(half_squares(&heap(3000), &config).is_err());
    }
}
