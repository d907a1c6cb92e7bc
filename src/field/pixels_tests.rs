//! Tests of pixel sampling on the CPU and on a device.

use super::*;
use tiface_base::geom::Camera;
use tiface_base::image::{Gray, Photo};

fn view() -> LoadedView {
    let camera = Camera::above(20, 10, 20.0, 4.0);
    let rgb = (0..200).map(|i| [i as u8, 0, 255]).collect();
    let mut values = vec![0; 200];
    values[5 * 20 + 8] = 255;
    LoadedView {
        camera,
        photo: Photo { width: 20, height: 10, rgb, alpha: None },
        mask: Some(Gray { width: 20, height: 10, values }),
        valid: None,
        region: None,
    }
}

#[test]
fn only_pixels_near_the_mask_are_drawn_and_carry_their_own_color() {
    // margin = ceil(0.1 · 20 / 3) + 1 = 2: a square of 5 × 5 around (8, 5)
    let views = [view()];
    let sampler = RaySampler::new(&views, 0.1, 1.0, Foreground::Photo, false);
    assert_eq!(sampler.count(), 25);
    let batch = sampler.draw(1, 2, 400, true, 0.0);
    assert_eq!(batch.rays.len(), 400);
    let mut head = 0;
    for (ray, (color, alpha)) in batch.rays.iter().zip(batch.color.iter().zip(&batch.alpha)) {
        let d = ray.direction;
        let (x, y) = (d[0] / -d[2] * 20.0 + 10.0, d[1] / d[2] * 20.0 + 5.0);
        assert!((x - 8.5).abs() < 2.01 && (y - 5.5).abs() < 2.01, "{x} {y}");
        if *alpha > 0.0 {
            // pixel (8, 5) is number 108 and has red 108
            assert!((x - 8.5).abs() < 1e-3 && (y - 5.5).abs() < 1e-3);
            assert!((color[0] * 255.0 - 108.0).abs() < 1e-3);
            head += 1;
        } else {
            assert_eq!(*color, [0.0; 3]);
        }
    }
    assert!(head > 4 && head < 40, "{head} of 400 should be about 16");
}

#[test]
fn a_ray_of_a_large_photograph_stands_for_a_square_of_pixels_while_the_field_is_coarse() {
    // a pixel is 4 / 20 = 0.2 wide at the middle: less than 0.3, so two of them for a detail of
    // 0.5, not four
    let views = [view()];
    let large = RaySampler::new(&views, 0.1, 1.0, Foreground::Photo, false).with_large(0.3);
    let batch = large.draw(1, 2, 400, true, 0.5);
    assert_eq!(batch.rays.len(), 400);
    let mut head = 0;
    for (ray, (color, alpha)) in batch.rays.iter().zip(batch.color.iter().zip(&batch.alpha)) {
        let d = ray.direction;
        let (x, y) = (d[0] / -d[2] * 20.0 + 10.0, d[1] / d[2] * 20.0 + 5.0);
        // Columns 6 to 10 and rows 3 to 7 are drawable. Squares begin at even ones, and their rays
        // pass through the middle of their drawable pixels.
        let near = |v: f32, middles: &[f32]| middles.iter().any(|m| (v - m).abs() < 1e-3);
        assert!(near(x, &[7.0, 9.0, 10.5]) && near(y, &[3.5, 5.0, 7.0]), "{x} {y}");
        if *alpha > 0.0 {
            // pixel (8, 5), red 108, is one of four
            assert!(near(x, &[9.0]) && near(y, &[5.0]));
            assert!(
                (alpha - 0.25).abs() < 1e-6 && (color[0] * 255.0 - 27.0).abs() < 1e-3,
                "{alpha} {color:?}"
            );
            head += 1;
        }
    }
    // four of 25 pixels lie in that square
    assert!((40..90).contains(&head), "{head} of 400 should be about 64");
    // At detail 0, and for pixels that are not that fine, every ray is a single pixel.
    let small = RaySampler::new(&views, 0.1, 1.0, Foreground::Photo, false).with_large(0.1);
    for (sampler, detail) in [(&large, 0.0), (&small, 0.5)] {
        let [one, two] = [sampler.draw(1, 2, 400, true, detail), large.draw(1, 2, 400, true, 0.3)];
        assert_eq!((one.rays, one.jitter), (two.rays, two.jitter));
    }
    assert_eq!([0.1f32, 0.2, 0.4, 0.9, 9.0].map(|detail| side(0.1, detail)), [1, 2, 4, 8, 8]);
}

#[test]
fn of_smooth_pixels_two_of_five_are_drawn_and_all_of_the_others() {
    // left of column 10 one gray, right of it stripes; all is head but a column at either border
    let stripes = |i: usize| if i % 20 < 10 || i % 2 == 1 { [90; 3] } else { [120; 3] };
    let views = [LoadedView {
        photo: Photo { rgb: (0..200).map(stripes).collect(), ..view().photo },
        mask: Some(Gray {
            width: 20,
            height: 10,
            values: (0..200).map(|i| if matches!(i % 20, 0 | 19) { 0 } else { 255 }).collect(),
        }),
        ..view()
    }];
    let all = RaySampler::new(&views, f32::INFINITY, 1.0, Foreground::Estimated, false);
    assert_eq!(all.count(), 200);
    let thinned = RaySampler::new(&views, f32::INFINITY, 1.0, Foreground::Estimated, false).thinned();
    let drawn = |x: usize, y: usize| {
        let p = 20 * y + x;
        thinned.drawable[0].4[p >> 6] >> (p & 63) & 1 == 1
    };
    for y in 0..10 {
        // windows of two pixels to either side: columns 3 to 7 see neither the border nor a stripe
        assert_eq!((3..8).filter(|&x| drawn(x, y)).count(), 2, "{y}");
        assert!((0..3).chain(8..20).all(|x| drawn(x, y)), "{y}");
        // none is left out without a neighbor that is drawn
        assert!((3..8).all(|x| drawn(x - 1, y) || drawn(x, y) || drawn(x + 1, y)), "{y}");
    }
    assert_eq!(thinned.count(), 200 - 3 * 10);
    // nothing is dropped from a large photograph (pixels are 0.2 wide), and nothing without masks
    let large = RaySampler::new(&views, f32::INFINITY, 1.0, Foreground::Estimated, false).with_large(0.3);
    assert_eq!(large.thinned().count(), 200);
    let bare = [LoadedView { mask: None, ..view() }];
    let bare = RaySampler::new(&bare, f32::INFINITY, 1.0, Foreground::Estimated, false).thinned();
    assert_eq!(bare.count(), 200);
    // behind the photograph's stripes nothing is head: only the outline is no smooth place
    let outside = [LoadedView {
        mask: Some(Gray {
            width: 20,
            height: 10,
            values: (0..200).map(|i| 255 * u8::from(i % 20 < 10)).collect(),
        }),
        ..views[0].clone()
    }];
    let count =
        |foreground| RaySampler::new(&outside, f32::INFINITY, 1.0, foreground, false).thinned().count();
    // columns 8 to 11 see the outline; of 8 columns to either side two fifths stay
    assert_eq!([Foreground::Estimated, Foreground::Photo].map(count), [40 + 64; 2]);
}

#[test]
fn a_view_without_a_mask_teaches_nothing_beside_views_with_one() {
    let mut white = view();
    white.mask.as_mut().unwrap().values.fill(255);
    let views = [view(), LoadedView { mask: None, ..view() }, white];
    let sampler = RaySampler::new(&views, 0.1, 1.0, Foreground::Photo, false);
    assert_eq!(sampler.count(), 25);
    // As the only view it is drawn from everywhere.
    let alone = [LoadedView { mask: None, ..view() }];
    assert_eq!(RaySampler::new(&alone, 0.1, 1.0, Foreground::Photo, false).count(), 200);
}

#[test]
fn an_epoch_has_every_valid_pixel_that_meets_the_box_once_with_directions_of_depth_one() {
    let mut one = view();
    let mut valid = vec![255; 200];
    valid[7 * 20 + 9] = 0;
    one.valid = Some(Gray { width: 20, height: 10, values: valid });
    let views = [one, view()];
    // pixels are 1/20 apart at depth 1. The near face at z = 1 is 3 away: |x − 10| < 1.5 · 20 / 3 =
    // 10 has all columns, |y − 5| < 0.4 · 20 / 3 = 2.67 the six rows with centers 0.5, 1.5 and 2.5
    // off the middle
    let bounds = [[-1.5, -0.4, -1.0], [1.5, 0.4, 1.0]];
    let sampler = RaySampler::permuted(&views, Foreground::Photo, bounds, true);
    assert_eq!(sampler.count(), 2 * 20 * 6 - 1);
    // 239 pixels in batches of 50: four a round, and a tail that is left out
    let mut seen = Vec::new();
    for step in 0..4 {
        let batch = sampler.draw(1, step, 50, false, 0.0);
        assert_eq!(batch.rays.len(), 50);
        for (ray, color) in batch.rays.iter().zip(&batch.color) {
            assert!((ray.direction[2] + 1.0).abs() < 1e-6, "{ray:?}");
            let (x, y) = (ray.direction[0] * 20.0 + 9.5, 4.5 - ray.direction[1] * 20.0);
            assert!((x - x.round()).abs() < 1e-4 && (2.0..=7.0).contains(&y.round()), "{x} {y}");
            seen.push((y.round() as u64 * 20 + x.round() as u64, *color));
        }
    }
    let count = |p: u64| seen.iter().filter(|(q, _)| *q == p).count();
    assert!((0..200).all(|p| count(p) <= 2) && count(7 * 20 + 9) <= 1 && seen.len() == 200);
    // pixel (8, 5), number 108, is head
    let head = seen.iter().filter(|(p, _)| *p == 108);
    assert!(head.clone().count() > 0 && head.clone().all(|(_, c)| (c[0] * 255.0 - 108.0).abs() < 1e-3));
    let first = sampler.draw(1, 0, 50, false, 0.0).rays;
    assert!(
        first == sampler.draw(1, 0, 50, false, 0.0).rays && first != sampler.draw(1, 4, 50, false, 0.0).rays
    );
    // A batch larger than the number of pixels draws each of them once.
    assert_eq!(sampler.draw(1, 9, 1000, false, 0.0).rays.len(), 239);
}

#[test]
fn published_sampling_draws_the_whole_frame_of_every_view_as_often() {
    let views = [view(), view()];
    let sampler = RaySampler::new(&views, 0.1, 1.0, Foreground::Photo, true);
    let batch = sampler.draw(1, 2, 2000, false, 0.0);
    assert_eq!(batch.rays.len(), 2000);
    let left = batch.rays.iter().filter(|r| r.direction[0] < 0.0).count();
    assert!((900..1100).contains(&left), "{left}");
    // one pixel of 200 is head
    let head = batch.alpha.iter().filter(|&&a| a > 0.0).count();
    assert!((2..25).contains(&head), "{head}");
}

#[cfg(feature = "wgpu")]
#[test]
fn a_device_draws_the_same_rays() {
    use tiface_base::geom::{Distortion, Projection};
    use tiface_kernels::gpu::testing::{agree, device, planes};
    let Some(device) = device() else { return };
    let bent = |distortion: Distortion| {
        let mut view = view();
        view.camera.distortion = distortion;
        view.camera.rotation = glam::DMat3::from_rotation_y(0.4) * glam::DMat3::from_rotation_x(-0.2);
        view.mask.as_mut().unwrap().values.iter_mut().enumerate().for_each(|(i, v)| *v = 40 + i as u8);
        view.valid =
            Some(Gray { width: 20, height: 10, values: (0..200).map(|i| (i % 7 > 1) as u8).collect() });
        view
    };
    let perspective =
        Distortion { k1: -0.2, k2: 0.05, k4: 0.1, p1: 0.01, p2: -0.02, sx1: 0.003, ..Distortion::default() };
    let fisheye = Distortion { k1: 0.02, k4: -0.01, projection: Projection::Fisheye, ..perspective };
    let fov = Distortion { omega: 0.9, projection: Projection::Fov, ..Distortion::default() };
    let empty = LoadedView { mask: None, ..view() };
    let views = [view(), bent(perspective), empty, bent(fisheye), bent(fov)];
    // the last but one with squares of two pixels for a ray, a twentieth of the distance 4 wide
    // each
    let new =
        |foreground, published| RaySampler::new(&views, 0.1, 0.3, foreground, published).with_large(0.3);
    let all = [[-1.0f32; 3], [1.0; 3]];
    let permuted = |depth| RaySampler::permuted(&views, Foreground::Photo, all, depth);
    // all one gray but for a border of background
    let flat = LoadedView {
        photo: Photo { rgb: vec![[90; 3]; 200], ..view().photo },
        mask: Some(Gray {
            width: 20,
            height: 10,
            values: (0..200).map(|i| 255 * u8::from(i % 20 > 1)).collect(),
        }),
        ..view()
    };
    let flat = [view(), flat];
    let unthinned = || RaySampler::new(&flat, 0.1, 0.3, Foreground::Estimated, false);
    let thinned = unthinned().thinned();
    assert!(thinned.count() < unthinned().count() - 50, "{}", thinned.count());
    for (sampler, published, detail, largest) in [
        (new(Foreground::Estimated, false), false, 0.0, u64::MAX),
        (new(Foreground::Photo, true), true, 0.0, u64::MAX),
        (new(Foreground::Estimated, false), false, 0.5, u64::MAX),
        (thinned, false, 0.0, u64::MAX),
        // a buffer holds two photographs of 200 pixels
        (new(Foreground::Estimated, false), false, 0.5, 1600),
        (permuted(false), false, 0.0, 1600),
        (permuted(true), false, 0.0, u64::MAX),
    ] {
        let drawing = gpu::SamplingOptions { jitter: !published, background: true, background_stream: 3 };
        let photographs = sampler.on_device(&device, drawing, largest);
        let (seed, step) = (77, 1 << 33);
        // A batch larger than the number of pixels draws each of them once.
        let wanted = 2000;
        let batch = gpu::DeviceBatch::new(&device, if sampler.order.is_some() { wanted } else { 2050 });
        let rays = batch.rays();
        photographs.draw(&device, (seed, step), &device.upload(&[wanted as u32]), &batch, detail);
        let want = sampler.draw(seed, step, wanted, !published, detail);
        let alive = device.read::<u32>(&batch.alive);
        assert!(alive[wanted..].iter().all(|&a| a == 0));
        let kept: Vec<usize> = (0..rays).filter(|&r| alive[r] == 1).collect();
        // In the published code, pixels that are not valid leave a gap.
        let gaps = published || sampler.order.is_some();
        assert_eq!((kept.len(), kept.len() < wanted), (want.rays.len(), gaps));
        let take = |buffer: &gpu::Buffer, planes: usize| -> Vec<f32> {
            let all = device.read::<f32>(buffer);
            (0..planes)
                .flat_map(|k| kept.iter().map(move |r| (k, *r)))
                .map(|(k, r)| all[k * rays + r])
                .collect()
        };
        let n = want.rays.len();
        let turned = |f: fn(&Ray) -> [f32; 3]| planes(&want.rays.iter().map(f).collect::<Vec<_>>(), n);
        agree("drawn origins", &take(&batch.origin, 3), &turned(|r| r.origin.to_array()), 1e-6);
        agree("drawn directions", &take(&batch.direction, 3), &turned(|r| r.direction.to_array()), 1e-5);
        agree("drawn colors", &take(&batch.color, 3), &planes(&want.color, n), 1e-6);
        assert_eq!(take(&batch.alpha, 1), want.alpha);
        assert_eq!(take(&batch.jitter, 1), want.jitter);
        let background_stream = device.read::<f32>(&batch.background);
        assert_eq!(background_stream[rays + 9], rng::uniform(seed, step << 4 | 3, 3 * 9 + 1));
    }
}
