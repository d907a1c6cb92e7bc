//! Materials of a head: skin, hair and cloth, told apart by color alone.
//!
//! Colors that are trusted fall into a few clusters of Oklab (Ottosson 2020), in which lightness
//! counts half: light changes it most within a material. Clusters are found by k-means from seeds
//! that lie far apart, and near ones become one.

use glam::Vec3;
use tiface_base::image::linear_from_srgb;

/// Weight of lightness relative to the two axes of hue.
const LIGHTNESS: f32 = 0.5;

/// Most clusters before near ones are joined.
const SEEDS: usize = 8;

/// Share of the colors that are no outliers; a seed is never an outlier.
const INLIERS: f64 = 0.995;

/// Rounds of k-means.
const ROUNDS: usize = 30;

/// Clusters closer than this become one.
const SAME: f32 = 0.06;

/// Standard deviation of the colors of a material.
const SPREAD: f32 = 0.05;

/// The materials, as centers of clusters.
pub struct Materials(Vec<[f32; 3]>);

impl Materials {
    /// Finds the materials among sRGB-coded colors. Without a color there is one material.
    pub fn of(colors: &[[f32; 3]]) -> Materials {
        let points: Vec<[f32; 3]> = colors.iter().map(|c| perceived(*c)).collect();
        if points.is_empty() {
            return Materials(vec![[0.0; 3]]);
        }
        let mut centers = seeds(&points);
        let mut counts = vec![0usize; centers.len()];
        for _ in 0..ROUNDS {
            let mut sums = vec![[0f64; 3]; centers.len()];
            counts.fill(0);
            for point in &points {
                let k = nearest(&centers, point);
                counts[k] += 1;
                sums[k].iter_mut().zip(point).for_each(|(s, p)| *s += f64::from(*p));
            }
            for ((center, sum), &count) in centers.iter_mut().zip(&sums).zip(&counts) {
                if count > 0 {
                    *center = sum.map(|s| (s / count as f64) as f32);
                }
            }
        }
        join(&mut centers, &mut counts);
        Materials(centers)
    }

    /// Returns the number of materials, at least 1.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Returns how probable each material is for an sRGB-coded color; the sum is 1.
    pub fn probabilities(&self, color: [f32; 3]) -> Vec<f64> {
        let point = perceived(color);
        let squares: Vec<f32> = self.0.iter().map(|c| distance_squared(c, &point)).collect();
        let least = squares.iter().copied().fold(f32::INFINITY, f32::min);
        let weight = |d: &f32| f64::from((least - d) / (2.0 * SPREAD * SPREAD)).exp();
        let total: f64 = squares.iter().map(weight).sum();
        squares.iter().map(|d| weight(d) / total).collect()
    }
}

/// Returns the first centers: the color nearest to the mean, then each time one far from all before
/// it.
fn seeds(points: &[[f32; 3]]) -> Vec<[f32; 3]> {
    let mean: [f32; 3] = std::array::from_fn(|k| {
        (points.iter().map(|p| f64::from(p[k])).sum::<f64>() / points.len() as f64) as f32
    });
    let mut centers = vec![points[nearest(points, &mean)]];
    let mut squares = vec![f32::INFINITY; points.len()];
    while centers.len() < SEEDS {
        let newest = centers[centers.len() - 1];
        squares.iter_mut().zip(points).for_each(|(d, p)| *d = d.min(distance_squared(p, &newest)));
        let mut order: Vec<u32> = (0..points.len() as u32).collect();
        let at = ((points.len() - 1) as f64 * INLIERS) as usize;
        let by = |a: &u32, b: &u32| squares[*a as usize].total_cmp(&squares[*b as usize]).then(a.cmp(b));
        let far = *order.select_nth_unstable_by(at, by).1 as usize;
        if squares[far] <= 0.0 {
            break;
        }
        centers.push(points[far]);
    }
    centers
}

/// Joins the two nearest centers, as long as they are near; empty ones go.
fn join(centers: &mut Vec<[f32; 3]>, counts: &mut Vec<usize>) {
    for k in (0..centers.len()).rev().filter(|&k| counts[k] == 0).collect::<Vec<_>>() {
        centers.swap_remove(k);
        counts.swap_remove(k);
    }
    loop {
        let pairs = (0..centers.len()).flat_map(|a| (0..a).map(move |b| (b, a)));
        let apart = |&(a, b): &(usize, usize)| distance_squared(&centers[a], &centers[b]);
        let Some((a, b)) = pairs.min_by(|p, q| apart(p).total_cmp(&apart(q))) else { return };
        if apart(&(a, b)) > SAME * SAME {
            return;
        }
        let share = counts[b] as f32 / (counts[a] + counts[b]).max(1) as f32;
        centers[a] = std::array::from_fn(|k| centers[a][k] + share * (centers[b][k] - centers[a][k]));
        counts[a] += counts[b];
        // b is the later of the two
        centers.swap_remove(b);
        counts.swap_remove(b);
    }
}

fn nearest(centers: &[[f32; 3]], point: &[f32; 3]) -> usize {
    let mut best = (0, f32::INFINITY);
    for (k, center) in centers.iter().enumerate() {
        let d = distance_squared(center, point);
        if d < best.1 {
            best = (k, d);
        }
    }
    best.0
}

fn distance_squared(a: &[f32; 3], b: &[f32; 3]) -> f32 {
    Vec3::from(*a).distance_squared(Vec3::from(*b))
}

/// Returns a color in Oklab, its lightness weighted.
fn perceived(coded: [f32; 3]) -> [f32; 3] {
    let [r, g, b] = coded.map(linear_from_srgb);
    let l = (0.412_221_47 * r + 0.536_332_54 * g + 0.051_445_993 * b).max(0.0).cbrt();
    let m = (0.211_903_5 * r + 0.680_699_55 * g + 0.107_396_96 * b).max(0.0).cbrt();
    let s = (0.088_302_46 * r + 0.281_718_84 * g + 0.629_978_7 * b).max(0.0).cbrt();
    [
        LIGHTNESS * (0.210_454_26 * l + 0.793_617_8 * m - 0.004_072_047 * s),
        1.977_998_5 * l - 2.428_592_2 * m + 0.450_593_7 * s,
        0.025_904_037 * l + 0.782_771_77 * m - 0.808_675_77 * s,
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    const SKIN: [f32; 3] = [0.8, 0.62, 0.52];
    const HAIR: [f32; 3] = [0.2, 0.14, 0.1];
    const SHIRT: [f32; 3] = [0.2, 0.24, 0.38];

    #[test]
    fn white_is_at_the_top_and_gray_has_no_hue() {
        // Oklab of white is (1, 0, 0)
        let [l, a, b] = perceived([1.0; 3]);
        assert!((l - 0.5).abs() < 1e-4 && a.abs() < 1e-4 && b.abs() < 1e-4, "{l} {a} {b}");
        let [_, a, b] = perceived([0.3; 3]);
        assert!(a.abs() < 1e-4 && b.abs() < 1e-4);
    }

    #[test]
    fn skin_hair_and_cloth_are_three_whatever_the_light_and_an_outlier_is_none() {
        let mut colors = Vec::new();
        for i in 0..600 {
            let light = 0.85 + 0.3 * (i % 10) as f32 / 10.0;
            colors.push([SKIN, HAIR, SHIRT][i % 3].map(|c| c * light));
        }
        colors.push([1.0, 1.0, 0.0]);
        let materials = Materials::of(&colors);
        let of = |color: [f32; 3]| {
            let p = materials.probabilities(color);
            assert!((p.iter().sum::<f64>() - 1.0).abs() < 1e-9);
            (0..p.len()).max_by(|&a, &b| p[a].total_cmp(&p[b])).unwrap()
        };
        assert_eq!(materials.len(), 3);
        let [skin, hair, shirt] = [SKIN, HAIR, SHIRT].map(of);
        assert!(skin != hair && hair != shirt && shirt != skin);
        assert_eq!([of(SKIN.map(|c| 0.9 * c)), of(SHIRT.map(|c| 1.1 * c))], [skin, shirt]);
    }

    #[test]
    fn one_color_or_none_is_one_material() {
        assert_eq!(Materials::of(&[]).len(), 1);
        let one = Materials::of(&[SKIN; 50]);
        assert_eq!((one.len(), one.probabilities(HAIR)), (1, vec![1.0]));
    }
}
