//! Filling of the texels between charts.
//!
//! Filtering and mip maps read beyond a chart's border. The nearest `gutter` texels repeat the
//! chart's own (nearest covered texel), all else is filled by pull and push over a pyramid (Gortler
//! et al. 1996), so that every mip level of every chart sees its own colors.
//! ([`Seams`](super::Seams) then moves the texels next to a seam a little.)

use tiface_base::image::Image;

/// Fills uncovered texels. `covered` has one flag per texel; values of covered texels are kept.
///
/// Without a covered texel the image stays as it is.
pub fn fill(image: &mut Image, covered: &[bool], gutter: u32) {
    if !covered.contains(&true) {
        return;
    }
    let known = grow(image, covered, gutter);
    push_pull(image, &known);
}

/// Copies the nearest covered texel into every texel within `gutter` of one (Euclidean); which are
/// known now.
fn grow(image: &mut Image, covered: &[bool], gutter: u32) -> Vec<bool> {
    let (w, h) = (image.width as usize, image.height as usize);
    // the nearest covered texel, found ring by ring through the neighbors' (a chamfer propagation:
    // exact but for rare ties a fraction of a texel apart)
    let mut source: Vec<u32> =
        covered.iter().enumerate().map(|(i, &c)| if c { i as u32 } else { u32::MAX }).collect();
    let distance = |i: usize, s: u32| {
        let (dx, dy) = ((i % w).abs_diff(s as usize % w), (i / w).abs_diff(s as usize / w));
        dx * dx + dy * dy
    };
    let mut front: Vec<u32> = Vec::new();
    let neighbors = |i: usize| {
        let (x, y) = ((i % w) as isize, (i / w) as isize);
        (0..9).filter(|&k| k != 4).filter_map(move |k| {
            let (x, y) = (x + k % 3 - 1, y + k / 3 - 1);
            (x >= 0 && y >= 0 && x < w as isize && y < h as isize).then(|| y as usize * w + x as usize)
        })
    };
    for i in (0..w * h).filter(|&i| covered[i]) {
        if neighbors(i).any(|j| !covered[j]) {
            front.push(i as u32);
        }
    }
    let reach = (gutter * gutter) as usize;
    while !front.is_empty() {
        let mut next = Vec::new();
        for &i in &front {
            let s = source[i as usize];
            for j in neighbors(i as usize) {
                let d = distance(j, s);
                if d <= reach && !covered[j] && (source[j] == u32::MAX || distance(j, source[j]) > d) {
                    source[j] = s;
                    next.push(j as u32);
                }
            }
        }
        front = next;
    }
    let c = image.channels;
    for i in (0..w * h).filter(|&i| !covered[i] && source[i] != u32::MAX) {
        let from = source[i] as usize * c;
        image.data.copy_within(from..from + c, i * c);
    }
    source.into_iter().map(|s| s != u32::MAX).collect()
}

/// Gives every unknown texel a smooth mixture of the known ones around it.
fn push_pull(image: &mut Image, known: &[bool]) {
    let c = image.channels;
    let mut levels = vec![(image.width as usize, image.height as usize)];
    let mut values: Vec<Vec<f32>> = Vec::new();
    let mut flags: Vec<Vec<bool>> = Vec::new();
    // pull: the mean of the known of four
    loop {
        let (w, h) = levels[levels.len() - 1];
        if w == 1 && h == 1 {
            break;
        }
        let (half_w, half_h) = (w.div_ceil(2), h.div_ceil(2));
        let above = values.last().unwrap_or(&image.data);
        let above_known = flags.last().map_or(known, |f| &f[..]);
        let mut mean = vec![0f32; half_w * half_h * c];
        let mut any = vec![false; half_w * half_h];
        for i in 0..half_w * half_h {
            let (x, y) = (2 * (i % half_w), 2 * (i / half_w));
            let mut n = 0.0;
            for (x, y) in [(x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)] {
                if x < w && y < h && above_known[y * w + x] {
                    n += 1.0;
                    (0..c).for_each(|k| mean[i * c + k] += above[(y * w + x) * c + k]);
                }
            }
            if n > 0.0 {
                any[i] = true;
                (0..c).for_each(|k| mean[i * c + k] /= n);
            }
        }
        levels.push((half_w, half_h));
        values.push(mean);
        flags.push(any);
    }
    // push: unknown texels take the coarser level, interpolated
    for level in (0..levels.len() - 1).rev() {
        let (w, h) = levels[level];
        let (cw, ch) = levels[level + 1];
        let (finer, coarser) = values.split_at_mut(level);
        let coarse = &coarser[0];
        let fine = finer.last_mut().unwrap_or(&mut image.data);
        let fine_known = if level == 0 { known } else { &flags[level - 1] };
        for i in (0..w * h).filter(|&i| !fine_known[i]) {
            let at = |i: usize, n: usize| {
                let p = ((i as f32 + 0.5) / 2.0 - 0.5).clamp(0.0, (n - 1) as f32);
                (p as usize, (p as usize + 1).min(n - 1), p.fract())
            };
            let (x0, x1, fx) = at(i % w, cw);
            let (y0, y1, fy) = at(i / w, ch);
            for k in 0..c {
                let v = |x: usize, y: usize| coarse[(y * cw + x) * c + k];
                let top = v(x0, y0) + fx * (v(x1, y0) - v(x0, y0));
                let bottom = v(x0, y1) + fx * (v(x1, y1) - v(x0, y1));
                fine[i * c + k] = top + fy * (bottom - top);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two half-covered charts, red left and green right, with a gap between.
    fn charts() -> (Image, Vec<bool>) {
        let mut image = Image::new(64, 32, 3);
        let mut covered = vec![false; 64 * 32];
        for i in 0..64 * 32 {
            let x = i % 64;
            let color = if x < 20 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] };
            if !(20..44).contains(&x) {
                covered[i] = true;
                image.data[3 * i..3 * i + 3].copy_from_slice(&color);
            }
        }
        (image, covered)
    }

    #[test]
    fn the_gutter_repeats_its_own_chart_and_the_middle_blends() {
        let (mut image, covered) = charts();
        let before = image.clone();
        fill(&mut image, &covered, 8);
        for y in 0..32 {
            for x in 0..64 {
                let p = image.pixel(x, y);
                if x < 28 {
                    assert_eq!(p, [1.0, 0.0, 0.0], "{x}");
                } else if x >= 36 {
                    assert_eq!(p, [0.0, 1.0, 0.0], "{x}");
                } else {
                    assert!(p[0] > 0.0 && p[1] > 0.0 || x < 32 && p[0] > 0.9 || x >= 32 && p[1] > 0.9);
                    assert!((p[0] + p[1] - 1.0).abs() < 1e-5 && p[2] == 0.0);
                }
            }
        }
        assert!(
            (0..64 * 32)
                .filter(|&i| covered[i])
                .all(|i| before.data[3 * i..3 * i + 3] == image.data[3 * i..3 * i + 3])
        );
    }

    #[test]
    fn mip_levels_of_a_chart_keep_its_color() {
        let (mut image, covered) = charts();
        fill(&mut image, &covered, 8);
        // level 3: a texel is the mean of 8 × 8; columns 16..24 hold the red chart's border and its
        // gutter
        let mean = |texel: u32, channel: usize| -> f32 {
            let all = (0..64).map(|i| image.pixel(8 * texel + i % 8, 8 + i / 8)[channel]);
            all.sum::<f32>() / 64.0
        };
        assert!((mean(2, 0) - 1.0).abs() < 1e-6 && mean(2, 1) == 0.0);
        // level 4 reaches four columns beyond the gutter: still three quarters its own
        let wide = 0.5 * (mean(2, 0) + mean(3, 0));
        assert!(wide > 0.75, "{wide}");
    }

    #[test]
    fn one_texel_fills_any_picture_and_none_fills_nothing() {
        let mut image = Image::new(7, 5, 1);
        image.data[17] = 0.25;
        let mut covered = vec![false; 35];
        fill(&mut image, &covered, 2);
        assert_eq!(image.data.iter().filter(|&&v| v != 0.0).count(), 1);
        covered[17] = true;
        fill(&mut image, &covered, 2);
        assert!(image.data.iter().all(|&v| (v - 0.25).abs() < 1e-6));
    }

    #[test]
    fn the_nearest_texel_wins_between_two() {
        let mut image = Image::new(9, 1, 1);
        let mut covered = vec![false; 9];
        (image.data[0], image.data[8], covered[0], covered[8]) = (1.0, 3.0, true, true);
        fill(&mut image, &covered, 4);
        assert_eq!(&image.data[..4], [1.0; 4]);
        assert_eq!(&image.data[5..], [3.0; 4]);
    }
}
