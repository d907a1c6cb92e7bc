//! Tiles: squares of the training photographs that are excluded from training; the weights are
//! fitted on them.
//!
//! Excluding whole views would harm the fields; excluding a few squares of each does not, since
//! other views show the same skin. The squares are large enough that their content cannot be
//! guessed from the pixels around.

use tiface_base::math::rng;

/// The side of a tile is this part of the shorter side of its photograph: a third of an eye.
const TILES_PER_SIDE: u32 = 16;

/// The least side of a tile, pixels.
const MIN_TILE_PX: u32 = 8;

/// A square of a photograph.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tile {
    /// Its first column.
    pub x: u32,
    /// Its first row.
    pub y: u32,
    /// Pixels along each side.
    pub side: u32,
}

impl Tile {
    /// Returns the pixels of the tile in a picture `width` wide, row by row.
    pub fn pixels(self, width: u32) -> impl Iterator<Item = usize> {
        let Tile { x, y, side } = self;
        (y..y + side).flat_map(move |y| (x..x + side).map(move |x| y as usize * width as usize + x as usize))
    }
}

/// Returns the tiles of photograph number `view`: about `share` of its pixels, at least one tile,
/// each at a random position in its own cell of a grid; none if `share` is 0. The same arguments
/// give the same tiles.
pub fn tiles(width: u32, height: u32, share: f64, seed: u64, view: u64) -> Vec<Tile> {
    let shorter = width.min(height);
    let side = (shorter / TILES_PER_SIDE).max(MIN_TILE_PX).min(shorter);
    if share <= 0.0 || side == 0 {
        return Vec::new();
    }
    let cell = side as f64 / share.min(1.0).sqrt();
    // a cell holds its tile
    let cells = |length: u32| ((length as f64 / cell).round() as u32).clamp(1, length / side);
    let (columns, rows) = (cells(width), cells(height));
    let place = |length: u32, count: u32, at: u32, stream: u64, tile: u64| {
        let (from, to) = (length * at / count, length * (at + 1) / count);
        from + rng::below(seed, stream, tile, (to - from - side + 1) as u64) as u32
    };
    (0..columns * rows)
        .map(|i| Tile {
            x: place(width, columns, i % columns, 2 * view, i as u64),
            y: place(height, rows, i / columns, 2 * view + 1, i as u64),
            side,
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiles_never_overlap_and_are_about_the_share_that_was_asked_for() {
        for (width, height) in [(384, 512), (3000, 4096), (640, 90), (17, 9), (5, 4), (1, 1)] {
            for share in [0.001, 0.04, 0.25] {
                let made = tiles(width, height, share, 42, 3);
                assert_eq!(made, tiles(width, height, share, 42, 3));
                let mut taken = vec![false; (width * height) as usize];
                for i in made.iter().flat_map(|t| t.pixels(width)) {
                    assert!(!std::mem::replace(&mut taken[i], true), "{width} × {height}, {share}");
                }
                let found = made.iter().map(|t| t.side * t.side).sum::<u32>() as f64;
                let wanted = share * (width * height) as f64;
                if width > 100 && share > 0.01 && height > 100 {
                    assert!(
                        (0.7..1.4).contains(&(found / wanted)),
                        "{width} × {height}: {found} of {wanted}"
                    );
                }
                assert!(!made.is_empty());
            }
        }
        assert!(tiles(384, 512, 0.0, 42, 3).is_empty());
        assert_ne!(tiles(384, 512, 0.04, 42, 3), tiles(384, 512, 0.04, 42, 4));
        assert_ne!(tiles(384, 512, 0.04, 42, 3), tiles(384, 512, 0.04, 43, 3));
    }
}
