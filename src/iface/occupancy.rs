//! The grid of cells that may contain surface.

use crate::config::iface::{IfaceConfig, OccupancyRule};
use crate::field::checkpoint::Checkpoint;
use rayon::prelude::*;
use tiface_base::Result;
use tiface_base::geom::{BitGrid, Ray};
use tiface_kernels::cpu::march::{MarchCells, Samples};
use tiface_kernels::cpu::neus;
use tiface_kernels::cpu::occupancy::{self, BandRule};

/// Cells to march through, cells known to be deep inside, and the history of the nerfacc rule.
#[derive(Clone, Debug, PartialEq)]
pub struct Occupancy {
    /// Cells to march through.
    pub occupied: BitGrid,
    /// Cells deep inside, where rays end (`band` rule only; empty under `nerfacc`).
    pub solid: BitGrid,
    /// Cells that may ever be occupied: the visual hull, or all.
    allowed: BitGrid,
    /// Decaying maximum of the opacity (`nerfacc` rule), `[cells]`.
    pub history: Vec<f32>,
    /// Occupied and solid cells, for rays.
    march_cells: MarchCells,
}

/// Returns the rule for the width of the band around the zero set.
pub fn band(config: &IfaceConfig) -> BandRule {
    BandRule { width: config.band, soften: config.soften as f32 }
}

/// Resamples `hull` to another resolution: a cell is set if it overlaps a set cell.
fn resampled(hull: &BitGrid, resolution: usize) -> BitGrid {
    let mut out = BitGrid::filled(resolution, false);
    let n = hull.resolution;
    // the range of hull cells that overlap cell i of the new grid
    let span = |i: usize| (i * n / resolution)..=(((i + 1) * n).div_ceil(resolution) - 1).min(n - 1);
    for x in 0..resolution {
        for y in 0..resolution {
            for z in 0..resolution {
                let any = span(x).any(|a| span(y).any(|b| span(z).any(|c| hull.get((a * n + b) * n + c))));
                out.set((x * resolution + y) * resolution + z, any);
            }
        }
    }
    out
}

impl Occupancy {
    /// Marks all cells of the hull as occupied, or all cells without a hull. The `band` rule adds
    /// one layer of cells: rays would otherwise enter a surface learned slightly outside the hull
    /// from its inside, which renders as a hole.
    pub fn new(config: &IfaceConfig, hull: Option<&BitGrid>) -> Occupancy {
        let r = config.occupancy_resolution;
        // The published system does not use a hull.
        let hull = hull.filter(|_| config.occupancy == OccupancyRule::Band);
        let allowed = match hull {
            Some(hull) if hull.resolution == r => hull.clone(),
            Some(hull) => resampled(hull, r),
            None => BitGrid::filled(r, true),
        };
        let allowed = match config.occupancy {
            OccupancyRule::Band => allowed.grown(),
            OccupancyRule::Nerfacc => allowed,
        };
        let history = match config.occupancy {
            OccupancyRule::Band => Vec::new(),
            OccupancyRule::Nerfacc => vec![0.0; r * r * r],
        };
        let solid = BitGrid::filled(r, false);
        let march_cells = MarchCells::new(&allowed, None);
        Occupancy { occupied: allowed.clone(), solid, allowed, history, march_cells }
    }

    /// Replaces occupied and solid cells.
    #[cfg(feature = "wgpu")]
    pub fn replace(&mut self, [occupied, solid]: [BitGrid; 2]) {
        (self.occupied, self.solid) = (occupied, solid);
        self.prepare();
    }

    /// Prepares changed cells for rays.
    fn prepare(&mut self) {
        // the nerfacc rule has a history and no solid cells
        let solid = self.history.is_empty().then_some(&self.solid);
        self.march_cells = MarchCells::new(&self.occupied, solid);
    }

    /// Writes cells and their history into a checkpoint.
    pub fn save(&self, into: &mut Checkpoint) {
        into.put_words("occupancy.occupied", self.occupied.bits.clone());
        into.put_words("occupancy.solid", self.solid.bits.clone());
        if !self.history.is_empty() {
            into.put_floats("occupancy.history", &[self.history.len()], self.history.clone());
        }
    }

    /// Reads cells and history from a checkpoint of the same resolution and rule.
    pub fn restore(&mut self, from: &mut Checkpoint) -> Result<()> {
        if !self.history.is_empty() {
            self.history = from.floats("occupancy.history", &[self.history.len()])?;
        }
        for (name, mask) in [("occupancy.occupied", &mut self.occupied), ("occupancy.solid", &mut self.solid)]
        {
            // Checkpoints of a density have no solid cells, because the nerfacc rule has none.
            if name == "occupancy.solid" && !self.history.is_empty() && !from.has(name) {
                continue;
            }
            let bits = from.words(name)?;
            *mask = BitGrid::from_words(mask.resolution, bits)
                .ok_or_else(|| from.mismatch(format!("tensor `{name}` has another size")))?;
        }
        self.prepare();
        Ok(())
    }

    /// Returns the cells that may ever be marched through.
    #[cfg(feature = "wgpu")]
    pub fn allowed(&self) -> &BitGrid {
        &self.allowed
    }

    /// Updates the cells from the field, which returns distances at points in field coordinates,
    /// and the logarithm of the local sharpness relative to `inv_s`; `step` is the march step.
    pub fn update(
        &mut self,
        config: &IfaceConfig,
        (seed, n): (u64, u64),
        inv_s: f32,
        step: f32,
        field: impl Fn(&[[f32; 3]]) -> Vec<[f32; 2]>,
    ) {
        match config.occupancy {
            OccupancyRule::Band => {
                let cells = [&mut self.occupied, &mut self.solid];
                occupancy::update_band(cells, &self.allowed, config.radius, band(config), inv_s, field);
                self.prepare();
            }
            OccupancyRule::Nerfacc => {
                let opacity = |points: &[[f32; 3]]| -> Vec<f32> {
                    let each = field(points).into_par_iter();
                    each.map(|[f, soft]| neus::occupancy(f, 0.5 * step, inv_s * soft.exp())).collect()
                };
                self.update_nerfacc((seed, n), config.radius, occupancy::OPAQUE, opacity);
            }
        }
    }

    /// Updates the cells by nerfacc's rule: cells above `threshold`, or above the mean if that is
    /// less, are occupied.
    pub fn update_nerfacc(
        &mut self,
        at: (u64, u64),
        radius: f32,
        threshold: f32,
        opacity: impl Fn(&[[f32; 3]]) -> Vec<f32>,
    ) {
        let cells = (&mut self.occupied, &mut self.history[..]);
        occupancy::update_nerfacc(cells, &self.allowed, radius, at, threshold, opacity);
        self.prepare();
    }

    /// Marches rays through the occupied cells, with steps of `dt`; see [`MarchCells::march`].
    pub fn march(&self, config: &IfaceConfig, dt: f32, rays: &[Ray], jitter: &[f32]) -> Samples {
        let limit = (3.6 * config.radius / dt) as usize + 2;
        self.march_cells.march(config.radius, dt, rays, jitter, limit)
    }

    /// Returns the share of cells that are occupied.
    pub fn share(&self) -> f64 {
        self.occupied.count() as f64 / self.occupied.resolution.pow(3) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Preset;

    /// Returns a field of one sharpness everywhere.
    fn even(sdf: impl Fn(&[f32; 3]) -> f32) -> impl Fn(&[[f32; 3]]) -> Vec<[f32; 2]> {
        move |points| points.iter().map(|p| [sdf(p), 0.0]).collect()
    }

    fn sphere(p: &[f32; 3]) -> f32 {
        (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]).sqrt() - 0.5
    }

    #[test]
    fn the_band_keeps_every_cell_the_sphere_crosses_and_nothing_far() {
        let config =
            IfaceConfig { occupancy_resolution: 32, band: 6.0, ..IfaceConfig::preset(Preset::Draft) };
        let mut o = Occupancy::new(&config, None);
        o.update(&config, (1, 0), 600.0, 0.0, even(sphere));
        let center = |i: usize| [i / 1024, i / 32 % 32, i % 32].map(|c| (c as f32 + 0.5) / 16.0 - 1.0);
        for i in 0..32 * 32 * 32 {
            let f = sphere(&center(i));
            // half diagonal of a cell is 0.054, band 6 / 600 = 0.01
            assert_eq!(o.occupied.get(i), f.abs() < 0.06413);
            assert_eq!(o.solid.get(i), f <= -0.06413);
        }
    }

    #[test]
    fn cells_outside_the_hull_never_come_back() {
        let config = IfaceConfig { occupancy_resolution: 16, ..IfaceConfig::preset(Preset::Draft) };
        let mut hull = BitGrid::filled(8, true);
        (0..512).filter(|i| i / 64 < 4).for_each(|i| hull.set(i, false));
        let mut o = Occupancy::new(&config, Some(&hull));
        // half of the box is hull, and one layer more is kept
        assert_eq!(o.occupied.count(), 16 * 16 * 9);
        o.update(&config, (1, 0), 20.0, 0.01, even(sphere));
        assert!((0..16 * 16 * 7).all(|i| !o.occupied.get(i)) && o.occupied.count() > 0);
        // the published rule knows no hull
        let config = IfaceConfig { occupancy: OccupancyRule::Nerfacc, ..config };
        assert_eq!(Occupancy::new(&config, Some(&hull)).occupied.count(), 16 * 16 * 16);
    }

    /// nerfacc 0.3.3 with I-Face's opacity: inv_s = e³, step 0.00101484375, of which 0.05 from the
    /// surface has 0.00546357 and 0.2 has 0.000370632.
    #[test]
    fn the_published_rule_decays_what_it_visits_and_keeps_what_is_above_the_mean_or_a_thousandth() {
        let config = IfaceConfig { occupancy_resolution: 8, ..IfaceConfig::preset(Preset::Paper) };
        let (inv_s, step) = (3f32.exp(), 0.001_014_843_75);
        let all = |f: f32| even(move |_| f);
        let near = |a: f32, b: f64| (f64::from(a) - b).abs() < 2e-4 * b;
        // below step 256 every cell is visited; 0.00546 is more than a thousandth
        let mut o = Occupancy::new(&config, None);
        o.update(&config, (1, 0), inv_s, step, all(0.05));
        assert!(o.history.iter().all(|&h| near(h, 0.005_463_57)) && o.occupied.count() == 512);
        // what is seen later is less than 0.95 of it
        for k in 1..16u64 {
            o.update(&config, (1, 16 * k), inv_s, step, all(0.2));
            assert!(o.history.iter().all(|&h| near(h, 0.005_463_57 * 0.95f64.powi(k as i32))), "{k}");
        }
        // from then on a quarter anywhere and as many of the occupied, both with repetition: of 512
        // cells some 512 (1 − (1 − 1/512)²⁵⁶) = 201 fall once
        let before = o.history[0];
        o.update(&config, (1, 256), inv_s, step, all(0.2));
        let fallen = o.history.iter().filter(|&&h| near(h, 0.95 * f64::from(before))).count();
        let kept = o.history.iter().filter(|&&h| h == before).count();
        assert!((180..225).contains(&fallen) && fallen + kept == 512, "{fallen} {kept}");
        // one cell near the surface, 511 far: the mean, 0.00038, is the threshold
        let corner = even(|p| if p.iter().all(|&c| c < -0.225) { 0.05 } else { 0.2 });
        let mut o = Occupancy::new(&config, None);
        o.update(&config, (1, 0), inv_s, step, corner);
        assert!(o.occupied.count() == 1 && o.occupied.get(0));
        assert!(near(o.history[511], 3.706_32e-4) && near(o.history[0], 0.005_463_57));
    }

    #[test]
    fn a_steep_wall_is_kept_although_its_values_are_large() {
        // slope 40: every center is far from zero in value, the wall at x = 0.01 is crossed all the
        // same
        let config = IfaceConfig { occupancy_resolution: 16, ..IfaceConfig::preset(Preset::Draft) };
        let mut o = Occupancy::new(&config, None);
        o.update(&config, (1, 0), 600.0, 0.0, even(|p| 40.0 * (p[0] - 0.01)));
        for x in 0..16 {
            assert_eq!(o.occupied.get((x * 16 + 5) * 16 + 5), x == 7 || x == 8, "{x}");
            assert_eq!(o.solid.get((x * 16 + 5) * 16 + 5), x < 7, "{x}");
        }
    }

    #[test]
    fn soft_places_are_kept_wider_and_their_neighbors_with_them() {
        let config =
            IfaceConfig { occupancy_resolution: 32, band: 4.0, ..IfaceConfig::preset(Preset::Draft) };
        // one side of the sphere is eight times softer
        let soft = |p: &[[f32; 3]]| {
            let share = |p: &[f32; 3]| if p[0] > 0.0 { -(8f32.ln()) } else { 0.0 };
            p.iter().map(|p| [sphere(p), share(p)]).collect()
        };
        let mut o = Occupancy::new(&config, None);
        o.update(&config, (1, 0), 200.0, 0.0, soft);
        let at = |x: f32| {
            let cell = |c: f32| ((c + 1.0) * 16.0) as usize;
            let i = (cell(x) * 32 + cell(0.01)) * 32 + cell(0.01);
            (o.occupied.get(i), o.solid.get(i))
        };
        // 0.13 inside: beyond 4 / 200 of the sharp side, within 4 / 25 of the soft one
        assert_eq!((at(-0.37), at(0.37)), ((false, true), (true, false)));
        // a sharp cell beside soft ones does not end a ray either
        let hard_spot = |p: &[[f32; 3]]| {
            let share = |p: &[f32; 3]| if (p[0] - 0.36).abs() < 0.032 { 0.0 } else { -(8f32.ln()) };
            p.iter().map(|p| [sphere(p), share(p)]).collect()
        };
        o.update(&config, (1, 1), 200.0, 0.0, hard_spot);
        let i = ((1.36f32 * 16.0) as usize * 32 + 16) * 32 + 16;
        assert!(o.occupied.get(i) && !o.solid.get(i));
    }
}
