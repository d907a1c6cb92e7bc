//! The published algorithm written in burn tensors, as one writes it first: every sample of every ray is a
//! row, rows outside the box and the alpha mask are dropped by indices, corners of planes are selected.

use crate::scene::Scene;
use burn::tensor::activation::{relu, sigmoid};
use burn::tensor::{Device, IndexingUpdateOp, Int, Tensor, TensorData};
use std::ops::Range;
use tiface::field::tensor;
use tiface::kernel::adam::AdamStep;
use tiface::kernel::vm::{Factor, Grid, LINE_AXIS, PLANE_AXES};

/// Planes and lines of the density (6), of the appearance (6), and the decoder's matrices (7), each with its
/// moments.
pub struct Plain {
    pub leaves: Vec<Tensor<2>>,
    moments: Vec<[Tensor<2>; 2]>,
    /// Cells of the alpha mask as 0 and 1, `[cells]`; everything is valid without.
    occupied: Option<Tensor<1>>,
}

/// What a step did.
#[derive(Default)]
pub struct Counts {
    /// Samples inside the box.
    pub inside: usize,
    /// Those whose density was evaluated.
    pub density: usize,
    /// Those whose color was.
    pub color: usize,
}

/// Lattice samples of rays, `[r, k]`, and what their densities make of them.
struct Marched {
    /// Components of the rays' directions, `[r, 1]`.
    direction: [Tensor<2>; 3],
    /// `[r, k]`
    t: Tensor<2>,
    /// Coordinates, `[r k]`.
    flat: [Tensor<1>; 3],
    /// Those that were evaluated, and their features `[n, 1]`.
    ids: Tensor<1, Int>,
    feature: Tensor<2>,
    /// `[r, k]`
    weight: Tensor<2>,
}

/// Cells of samples: vertex below `[n]` and fraction `[n, 1]`, per axis.
struct Cells {
    index: [Tensor<1, Int>; 3],
    frac: [Tensor<2>; 3],
}

fn factors(grid: &Grid) -> Vec<Factor> {
    (0..3).map(|i| grid.plane(i)).chain((0..3).map(|i| grid.line(i))).collect()
}

impl Plain {
    pub fn new(s: &Scene, masked: bool, device: &Device) -> Plain {
        let mut leaves = Vec::new();
        for (grid, values) in [(&s.field.density, &s.density), (&s.field.color, &s.color)] {
            for f in factors(grid) {
                let own = values[f.range()].to_vec();
                leaves.push(tensor(own, [f.height * f.width, f.channels], device));
            }
        }
        let mut rest = &s.network[..];
        for (rows, columns) in s.field.decoder.shapes() {
            let (own, tail) = rest.split_at(rows * columns);
            rest = tail;
            leaves.push(tensor(own.to_vec(), [rows, columns], device));
        }
        let zeros = |t: &Tensor<2>| [Tensor::zeros(t.dims(), device), Tensor::zeros(t.dims(), device)];
        let moments = leaves.iter().map(zeros).collect();
        let leaves = leaves.into_iter().map(|t| t.autodiff().require_grad()).collect();
        let occupied = s.field.mask.as_ref().filter(|_| masked).map(|mask| {
            let cells: usize = mask.size().iter().product();
            let bit = |i: usize| (mask.bits()[i >> 6] >> (i & 63) & 1) as f32;
            tensor((0..cells).map(bit).collect(), [cells], device)
        });
        Plain { leaves, moments, occupied }
    }

    /// From rays to weights.
    fn march(&self, s: &Scene, rays: Range<usize>, device: &Device, n: &mut Counts) -> Marched {
        let (l, rays) = (&s.field.lattice, &s.rays[rays]);
        let (r, k) = (rays.len(), l.samples);
        let of_rays =
            |f: &dyn Fn(usize) -> f32| -> Tensor<2> { tensor((0..r).map(f).collect(), [r, 1], device) };
        let origin = [0, 1, 2].map(|a| of_rays(&|i| rays[i].origin[a]));
        let direction = [0, 1, 2].map(|a| of_rays(&|i| rays[i].direction[a]));

        // all lattice samples, [r, k]
        let [x, y, z] = [0, 1, 2].map(|a| {
            let d = direction[a].clone();
            let d = d.clone().mask_fill(d.equal_elem(0.0), 1e-6);
            let wall = |v: f32| (origin[a].clone().neg() + v) / d.clone();
            wall(l.min[a]).min_pair(wall(l.max[a]))
        });
        let enter = x.max_pair(y).max_pair(z).clamp(l.near, l.far);
        let steps: Tensor<2> = tensor((0..k).map(|i| i as f32).collect(), [1, k], device);
        let t = (steps + of_rays(&|i| rays[i].jitter)) * l.step + enter;
        let p = [0, 1, 2].map(|a| t.clone() * direction[a].clone() + origin[a].clone());

        // those inside the box, and of these those in occupied cells
        let within = |a: usize| {
            let p: &Tensor<2> = &p[a];
            p.clone().greater_equal_elem(l.min[a]).bool_and(p.clone().lower_equal_elem(l.max[a]))
        };
        let inside = within(0).bool_and(within(1)).bool_and(within(2));
        let mut ids = inside.reshape([r * k]).nonzero().remove(0);
        let flat = p.map(|p| p.reshape([r * k]));
        let mut at = flat.clone().map(|p| p.select(0, ids.clone()));
        n.inside += ids.dims()[0];
        if let (Some(mask), Some(occupied)) = (&s.field.mask, &self.occupied) {
            let (size, (low, high)) = (mask.size(), mask.bounds());
            let [x, y, z] = [0, 1, 2].map(|a| {
                let g = (at[a].clone() - low[a]) / (high[a] - low[a]) * size[a] as f32;
                g.clamp(0.0, (size[a] - 1) as f32).int()
            });
            let cell = (x * size[1] as i64 + y) * size[2] as i64 + z;
            let kept = occupied.clone().select(0, cell).greater_elem(0.0).nonzero().remove(0);
            ids = ids.select(0, kept.clone());
            at = at.map(|p| p.select(0, kept.clone()));
        }
        n.density += ids.dims()[0];

        // densities to weights
        let cells = self.cells(s, at);
        let feature = self.products(&s.field.density, 0, &cells).map(|p| p.sum_dim(1));
        let feature = feature.into_iter().reduce(|a, b| a + b).expect("three terms"); // [n, 1]
        let sigma = relu(feature.clone());
        let sigma = spread(sigma, ids.clone(), r * k, device).reshape([r, k]);
        let mut length = vec![l.step * s.field.shading.distance_scale; k];
        length[k - 1] = 0.0;
        let length: Tensor<2> = tensor(length, [1, k], device).autodiff();
        let alpha = (sigma * length).neg().exp().neg() + 1.0;
        let open = alpha.clone().neg() + 1.0 + 1e-10;
        let first = Tensor::ones([r, 1], device).autodiff();
        let before = Tensor::cat(vec![first, open.narrow(1, 0, k - 1)], 1);
        let weight = alpha * before.cumprod(1); // [r, k]
        Marched { direction, t, flat, ids, feature, weight }
    }

    /// Colors `[m, 3]` where they are seen, with both hidden layers before their relu `[m, hidden]`.
    fn decode(&self, s: &Scene, marched: &Marched) -> (Tensor<1, Int>, [Tensor<2>; 3]) {
        let [r, k] = marched.weight.dims();
        let seen = marched.weight.clone().inner().greater_elem(s.field.shading.weight_threshold);
        let ids = seen.reshape([r * k]).nonzero().remove(0);
        let cells = self.cells(s, marched.flat.clone().map(|p| p.select(0, ids.clone())));
        let ray = ids.clone() / k as i64;
        let view = Tensor::cat(marched.direction.to_vec(), 1).select(0, ray).autodiff(); // [m, 3]
        let products = Tensor::cat(self.products(&s.field.color, 6, &cells).to_vec(), 1); // [m, 72]
        let m = |i: usize| self.leaves[12 + i].clone().transpose();
        let input = Tensor::cat(vec![products.matmul(m(0)), view], 1);
        let first = input.matmul(m(1)) + m(2);
        let second = relu(first.clone()).matmul(m(3)) + m(4);
        let rgb = sigmoid(relu(second.clone()).matmul(m(5)) + m(6));
        (ids, [first, second, rgb])
    }

    /// Rendered rays `[rays, 5]`, differentiable by all leaves.
    fn render(&self, s: &Scene, rays: Range<usize>, device: &Device, n: &mut Counts) -> Tensor<2> {
        let marched = self.march(s, rays, device, n);
        let [r, k] = marched.weight.dims();
        let (ids, [_, _, rgb]) = self.decode(s, &marched);
        n.color += ids.dims()[0];
        let Marched { t, weight, .. } = marched;
        let rgb = spread(rgb, ids, r * k, device).reshape([r, k, 3]);
        let color = (weight.clone().reshape([r, k, 1]) * rgb).sum_dim(1).reshape([r, 3]);
        let depth = (weight.clone().inner() * t).sum_dim(1).autodiff();
        Tensor::cat(vec![color, weight.sum_dim(1), depth], 1)
    }

    /// Rays with a sample so near the color threshold, no density, or a hidden unit's kink that rounding
    /// decides what its gradient is.
    pub fn undecided(&self, s: &Scene, device: &Device) -> Vec<bool> {
        // the finer the grid, the more a rounded position moves a feature
        let near_kink = 3e-8 * s.field.density.size.into_iter().fold(0, usize::max) as f32;
        let marched = self.march(s, 0..s.rays.len(), device, &mut Counts::default());
        let [r, k] = marched.weight.dims();
        let (ids, hidden) = self.decode(s, &marched);
        let [first, second, _] = hidden.map(|h| h.inner().abs().min_dim(1));
        let kink = first.min_pair(second).lower_elem(near_kink).float();
        let kink = spread(kink.autodiff(), ids, r * k, device).inner().reshape([r, k]);
        let near_zero = marched.feature.inner().abs().lower_elem(1e-6 * s.peak).float();
        let near_zero = spread(near_zero.autodiff(), marched.ids, r * k, device).inner();
        let ratio = marched.weight.inner() / s.field.shading.weight_threshold;
        let near_threshold = (ratio - 1.0).abs().lower_elem(5e-3).float();
        let bad = (near_zero.reshape([r, k]) + near_threshold + kink).sum_dim(1);
        tiface::field::values(bad).into_iter().map(|n| n > 0.0).collect()
    }

    fn cells(&self, s: &Scene, p: [Tensor<1>; 3]) -> Cells {
        let (l, size) = (&s.field.lattice, s.field.density.size);
        let mut axis = 0;
        let cells = p.map(|p| {
            let a = axis;
            axis += 1;
            let n = p.dims()[0];
            let last = (size[a] - 1) as f32;
            let x = ((p - l.min[a]) / (l.max[a] - l.min[a]) * last).clamp(0.0, last);
            let below = x.clone().floor().clamp_max(last - 1.0);
            (below.clone().int(), (x - below).reshape([n, 1]))
        });
        let [(i, x), (j, y), (k, z)] = cells;
        Cells { index: [i, j, k], frac: [x, y, z] }
    }

    /// Plane times line of each term, `[n, channels]`; `first` is the grid's first leaf.
    fn products(&self, grid: &Grid, first: usize, cells: &Cells) -> [Tensor<2>; 3] {
        [0, 1, 2].map(|i| {
            let (a, b) = PLANE_AXES[i];
            let (width, c) = (grid.size[a] as i64, grid.rank[i]);
            let n = cells.frac[a].dims()[0];
            let (x, y) = (cells.frac[a].clone(), cells.frac[b].clone());
            let (left, top) = (x.clone().neg() + 1.0, y.clone().neg() + 1.0);
            let corner = cells.index[b].clone() * width + cells.index[a].clone();
            let corners =
                [0, 1, width, width + 1].map(|offset| (corner.clone() + offset).autodiff()).to_vec();
            let weights = [left.clone() * top.clone(), x.clone() * top, left * y.clone(), x * y].to_vec();
            let rows = self.leaves[first + i].clone().select(0, Tensor::cat(corners, 0));
            let rows = rows * Tensor::cat(weights, 0).autodiff(); // [4 n, c]
            let plane = rows.reshape([4, n, c]).sum_dim(0).reshape([n, c]);
            let (line, below) = (&self.leaves[first + 3 + i], &cells.index[LINE_AXIS[i]]);
            let z = cells.frac[LINE_AXIS[i]].clone();
            let low = line.clone().select(0, below.clone().autodiff());
            let high = line.clone().select(0, (below.clone() + 1).autodiff());
            plane * (low * (z.clone().neg() + 1.0).autodiff() + high * z.autodiff())
        })
    }

    /// Output `[rays, 5]` and the gradient of every leaf, of color and mask losses and `tv` times the total
    /// variation of both grids. Rays go in pieces of `chunk`, their gradients are added up.
    pub fn gradients(
        &self,
        s: &Scene,
        tv: f32,
        chunk: usize,
        device: &Device,
    ) -> (Tensor<2>, Vec<Tensor<2>>, Counts) {
        let mut counts = Counts::default();
        let mut sums: Vec<Option<Tensor<2>>> = vec![None; self.leaves.len()];
        let mut add = |loss: Tensor<1>| {
            let mut gradients = loss.backward();
            for (sum, leaf) in sums.iter_mut().zip(&self.leaves) {
                if let Some(g) = leaf.grad_remove(&mut gradients) {
                    *sum = Some(match sum.take() {
                        Some(sum) => sum + g,
                        None => g,
                    });
                }
            }
        };
        let mut out = Vec::new();
        for start in (0..s.rays.len()).step_by(chunk) {
            let rays = start..(start + chunk).min(s.rays.len());
            let rendered = self.render(s, rays.clone(), device, &mut counts);
            out.push(rendered.clone().inner());
            add(crate::losses(rendered, s, rays, device));
        }
        if tv > 0.0 {
            add(self.total_variation(s) * tv);
        }
        let sums = sums.into_iter().map(|g| g.expect("every leaf takes part")).collect();
        (Tensor::cat(out, 0), sums, counts)
    }

    fn total_variation(&self, s: &Scene) -> Tensor<1> {
        let planes = [(&s.field.density, 0), (&s.field.color, 6)]
            .into_iter()
            .flat_map(|(grid, first)| (0..3).map(move |i| (grid.plane(i), first + i)));
        let terms = planes.map(|(f, leaf)| {
            let (h, w, c) = (f.height, f.width, f.channels);
            let x: Tensor<3> = self.leaves[leaf].clone().reshape([h, w, c]);
            let along = |d: usize, n: usize| {
                let difference = x.clone().narrow(d, 1, n - 1) - x.clone().narrow(d, 0, n - 1);
                difference.square().mean()
            };
            (along(0, h) + along(1, w)) * 2.0
        });
        terms.reduce(|a, b| a + b).expect("six planes")
    }

    /// Adam on every leaf.
    pub fn adam(&mut self, gradients: Vec<Tensor<2>>, grid: &AdamStep, network: &AdamStep) {
        for (i, g) in gradients.into_iter().enumerate() {
            let a = if i < 12 { grid } else { network };
            let [m, v] = self.moments[i].clone();
            let m = m * a.beta1 + g.clone() * (1.0 - a.beta1);
            let v = v * a.beta2 + g.square() * (1.0 - a.beta2);
            let mean = m.clone() / (1.0 - a.beta1.powi(a.step as i32));
            let square = v.clone() / (1.0 - a.beta2.powi(a.step as i32));
            let p = self.leaves[i].clone().inner() - mean / (square.sqrt() + a.epsilon) * a.lr;
            self.leaves[i] = p.autodiff().require_grad();
            self.moments[i] = [m, v];
        }
    }
}

/// Rows of samples put into their places among `total`, zeros elsewhere.
fn spread(rows: Tensor<2>, ids: Tensor<1, Int>, total: usize, device: &Device) -> Tensor<2> {
    let empty: Tensor<2> = Tensor::zeros([total, rows.dims()[1]], device).autodiff();
    empty.select_assign(0, ids.autodiff(), rows, IndexingUpdateOp::Add)
}

/// All gradients one after another, in the order of the flat parameters: density, appearance, network.
pub fn flat(gradients: &[Tensor<2>]) -> [Vec<f32>; 3] {
    [0..6, 6..12, 12..19].map(|own| {
        let values = |t: &Tensor<2>| -> Vec<f32> {
            let data: TensorData = t.clone().into_data();
            data.try_into_vec::<f32>().expect("f32")
        };
        gradients[own].iter().flat_map(values).collect()
    })
}
