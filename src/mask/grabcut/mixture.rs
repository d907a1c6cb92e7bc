//! Colors of one thing as a mixture of Gaussians with full covariances, in coded RGB 0..=255.
//!
//! `p(c) = Σ_k w_k · N(c; μ_k, Σ_k)`. It starts from seeded k-means (Arthur & Vassilvitskii 2007)
//! and is refitted as in GrabCut (Rother, Kolmogorov, Blake 2004): every color goes to its
//! likeliest Gaussian, whose mean and covariance are measured again. A covariance always gains the
//! minimum that 8-bit rounding and sensor noise leave, so that one flat color is no singular
//! Gaussian.

use tiface_base::geom::cofactors;
use tiface_base::math::rng;

/// A color in coded 0..=255.
pub type Rgb = [u8; 3];

/// Added to every variance, in squared steps of 8 bit: a standard deviation of one step.
const MIN_VARIANCE: f64 = 1.0;

/// The stream of random numbers that the k-means start draws from.
const STREAM: u64 = 0x6d_6978_7475_7265;

#[derive(Clone, Debug, PartialEq)]
struct Gaussian {
    /// Share of the colors; 0 where none is left.
    weight: f64,
    mean: [f64; 3],
    /// Inverse covariance: xx, xy, xz, yy, yz, zz.
    precision: [f64; 6],
    /// `ln w − ½ ln |2πΣ|`; minus infinity without colors.
    offset: f64,
}

/// A mixture of Gaussians over colors.
#[derive(Clone, Debug, PartialEq)]
pub struct Mixture {
    gaussians: Vec<Gaussian>,
}

impl Mixture {
    /// Fits `count` Gaussians to colors: k-means from a seeded start, then one measurement. `None`
    /// without colors. Fewer distinct colors than Gaussians leave some without weight.
    pub fn fit(colors: &[Rgb], count: usize, seed: u64) -> Option<Mixture> {
        let first = colors.get(rng::below(seed, STREAM, 0, colors.len().max(1) as u64) as usize)?;
        let mut centers = vec![first.map(f64::from)];
        // k-means++ : the next center is drawn with the squared distance to the nearest one as its
        // chance
        let mut nearest = vec![f64::INFINITY; colors.len()];
        while centers.len() < count {
            let last = centers[centers.len() - 1];
            let mut total = 0.0;
            for (d, c) in nearest.iter_mut().zip(colors) {
                *d = d.min(square_distance(c, &last));
                total += *d;
            }
            if total <= 0.0 {
                break;
            }
            let mut left = total * rng::uniform(seed, STREAM, centers.len() as u64) as f64;
            let drawn = nearest.iter().position(|d| {
                left -= d;
                left < 0.0
            });
            centers.push(colors[drawn.unwrap_or(colors.len() - 1)].map(f64::from));
        }
        let mut member = vec![0u8; colors.len()];
        for _ in 0..10 {
            let mut sums = vec![[0.0; 4]; centers.len()];
            for (m, c) in member.iter_mut().zip(colors) {
                let best = first_largest(centers.iter().map(|center| -square_distance(c, center)));
                *m = best as u8;
                let s = &mut sums[best];
                for a in 0..3 {
                    s[a] += c[a] as f64;
                }
                s[3] += 1.0;
            }
            for (center, s) in centers.iter_mut().zip(&sums) {
                if s[3] > 0.0 {
                    *center = [s[0] / s[3], s[1] / s[3], s[2] / s[3]];
                }
            }
        }
        Some(Mixture::measure(colors, &member, centers.len()))
    }

    /// Sends every color to its likeliest Gaussian and measures these again; unchanged without
    /// colors.
    pub fn refit(&self, colors: &[Rgb]) -> Mixture {
        if colors.is_empty() {
            return self.clone();
        }
        let member: Vec<u8> = colors.iter().map(|c| self.likeliest(c) as u8).collect();
        Mixture::measure(colors, &member, self.gaussians.len())
    }

    fn measure(colors: &[Rgb], member: &[u8], count: usize) -> Mixture {
        // sums of whole numbers are exact, so no mean has to be taken off first
        let mut sums = vec![[0u64; 10]; count];
        for (c, &m) in colors.iter().zip(member) {
            let [r, g, b] = c.map(u64::from);
            let all = [1, r, g, b, r * r, r * g, r * b, g * g, g * b, b * b];
            sums[m as usize].iter_mut().zip(all).for_each(|(s, v)| *s += v);
        }
        let gaussians = sums.iter().map(|s| Gaussian::measure(s, colors.len())).collect();
        Mixture { gaussians }
    }

    fn likeliest(&self, color: &Rgb) -> usize {
        first_largest(self.gaussians.iter().map(|g| g.log_density(color)))
    }

    /// `ln p(color)`, per cubic step of 8 bit; always finite.
    pub fn log_likelihood(&self, color: &Rgb) -> f64 {
        let mut largest = f64::NEG_INFINITY;
        let mut logs = [f64::NEG_INFINITY; 16];
        for (l, g) in logs.iter_mut().zip(&self.gaussians) {
            *l = g.log_density(color);
            largest = largest.max(*l);
        }
        largest + logs.iter().map(|l| (l - largest).exp()).sum::<f64>().ln()
    }
}

impl Gaussian {
    /// Computes a Gaussian from the number of colors, their sums and the sums of their products.
    fn measure(s: &[u64; 10], total: usize) -> Gaussian {
        let n = s[0] as f64;
        if s[0] == 0 {
            let none = f64::NEG_INFINITY;
            return Gaussian { weight: 0.0, mean: [0.0; 3], precision: [0.0; 6], offset: none };
        }
        let mean = [s[1] as f64 / n, s[2] as f64 / n, s[3] as f64 / n];
        let c = |k: usize, a: usize, b: usize| s[k] as f64 / n - mean[a] * mean[b];
        let (xx, yy, zz) = (
            c(4, 0, 0).max(0.0) + MIN_VARIANCE,
            c(7, 1, 1).max(0.0) + MIN_VARIANCE,
            c(9, 2, 2).max(0.0) + MIN_VARIANCE,
        );
        let (xy, xz, yz) = (c(5, 0, 1), c(6, 0, 2), c(8, 1, 2));
        let (cofactors, det) = cofactors([xx, xy, xz, yy, yz, zz]);
        // the floor on the diagonal keeps it above MIN_VARIANCE³ up to rounding
        let det = det.max(0.5 * MIN_VARIANCE.powi(3));
        let precision = cofactors.map(|v| v / det);
        let weight = n / total as f64;
        let offset = weight.ln() - 0.5 * (det.ln() + 3.0 * std::f64::consts::TAU.ln());
        Gaussian { weight, mean, precision, offset }
    }

    /// `ln (w · N(color))`.
    fn log_density(&self, color: &Rgb) -> f64 {
        let [x, y, z] = [0, 1, 2].map(|a| color[a] as f64 - self.mean[a]);
        let [xx, xy, xz, yy, yz, zz] = self.precision;
        let square = x * (xx * x + 2.0 * (xy * y + xz * z)) + y * (yy * y + 2.0 * yz * z) + z * zz * z;
        self.offset - 0.5 * square
    }
}

/// Returns which value is the largest, of equals the first.
fn first_largest(values: impl Iterator<Item = f64>) -> usize {
    let mut best = (f64::NEG_INFINITY, 0);
    for (k, value) in values.enumerate() {
        if value > best.0 {
            best = (value, k);
        }
    }
    best.1
}

fn square_distance(color: &Rgb, center: &[f64; 3]) -> f64 {
    (0..3).map(|a| (color[a] as f64 - center[a]).powi(2)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Normal draws around `mean` with deviations along the three axes.
    fn cloud(mean: [f64; 3], deviation: [f64; 3], n: u64, stream: u64) -> Vec<Rgb> {
        (0..n)
            .map(|i| {
                [0, 1, 2].map(|a| {
                    let draw = rng::normal(3, stream, 3 * i + a as u64) as f64;
                    (mean[a] + deviation[a] * draw).round().clamp(0.0, 255.0) as u8
                })
            })
            .collect()
    }

    #[test]
    fn one_gaussian_is_the_clouds_own_density() {
        let colors = cloud([100.0, 80.0, 60.0], [10.0, 5.0, 8.0], 20_000, 1);
        let m = Mixture::fit(&colors, 1, 7).unwrap();
        // at the mean: −½ ln((2π)³ · 101 · 26 · 65), variances with the floor of 1
        let expected = -0.5 * (3.0 * std::f64::consts::TAU.ln() + (101.0f64 * 26.0 * 65.0).ln());
        assert!((m.log_likelihood(&[100, 80, 60]) - expected).abs() < 0.03);
        // two deviations along red cost 20² / (2 · 101)
        let fall = m.log_likelihood(&[100, 80, 60]) - m.log_likelihood(&[120, 80, 60]);
        assert!((fall - 400.0 / 202.0).abs() < 0.06, "{fall}");
    }

    #[test]
    fn the_density_of_a_mixture_sums_to_one() {
        let mut colors = cloud([40.0, 40.0, 40.0], [6.0, 4.0, 5.0], 3000, 1);
        colors.extend(cloud([90.0, 60.0, 50.0], [5.0, 8.0, 4.0], 1000, 2));
        let m = Mixture::fit(&colors, 5, 7).unwrap();
        let mut sum = 0.0;
        for r in 0..140 {
            for g in 0..120 {
                for b in 0..100 {
                    sum += m.log_likelihood(&[r, g, b]).exp();
                }
            }
        }
        assert!((sum - 1.0).abs() < 0.01, "{sum}");
    }

    #[test]
    fn flat_and_few_colors_leave_finite_likelihoods() {
        for colors in [vec![[7, 7, 7]; 50], vec![[0, 0, 0], [255, 255, 255]], vec![[1, 2, 3]]] {
            let m = Mixture::fit(&colors, 5, 1).unwrap();
            for c in [[0, 0, 0], [255, 255, 255], [7, 7, 7], [0, 255, 0]] {
                assert!(m.log_likelihood(&c).is_finite(), "{colors:?} at {c:?}");
                assert!(m.refit(&colors).log_likelihood(&c).is_finite());
            }
            assert!(m.log_likelihood(&colors[0]) > m.log_likelihood(&[0, 255, 0]));
        }
        assert!(Mixture::fit(&[], 5, 1).is_none());
    }

    #[test]
    fn a_line_of_colors_is_no_singular_covariance() {
        // red = green = blue: the covariance has rank one before the floor
        let colors: Vec<Rgb> = (0..=255).map(|i| [i, i, i]).collect();
        let m = Mixture::fit(&colors, 1, 1).unwrap();
        assert!(m.log_likelihood(&[128, 128, 128]) > m.log_likelihood(&[128, 138, 128]) + 10.0);
    }

    #[test]
    fn refitting_raises_the_likelihood_and_the_seed_decides_alone() {
        let mut colors = cloud([60.0, 60.0, 60.0], [20.0, 3.0, 3.0], 2000, 1);
        colors.extend(cloud([70.0, 66.0, 66.0], [3.0, 20.0, 3.0], 2000, 2));
        let m = Mixture::fit(&colors, 5, 9).unwrap();
        let total = |m: &Mixture| colors.iter().map(|c| m.log_likelihood(c)).sum::<f64>();
        assert!(total(&m.refit(&colors).refit(&colors)) > total(&m));
        assert_eq!(m, Mixture::fit(&colors, 5, 9).unwrap());
    }
}
