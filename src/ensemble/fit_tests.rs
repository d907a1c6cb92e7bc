//! Fits of the blend: known weights are found again, and scarce data change little.

use super::*;
use crate::image::{Gray, Image, Photo, quantise};
use crate::kernel::rng::{normal, uniform};

const SIZE: u32 = 64;
const PIXELS: usize = (SIZE * SIZE) as usize;

fn view(color: impl Fn(usize, usize) -> f32) -> Image {
    let mut image = Image::new(SIZE, SIZE, 4);
    for (i, pixel) in image.data.as_chunks_mut::<4>().0.iter_mut().enumerate() {
        *pixel = [color(i, 0), color(i, 1), color(i, 2), 1.0];
    }
    image
}

fn photo(color: impl Fn(usize, usize) -> f32) -> Photo {
    let rgb = (0..PIXELS).map(|i| std::array::from_fn(|j| quantise(color(i, j)))).collect();
    Photo { width: SIZE, height: SIZE, rgb, alpha: None }
}

fn everywhere() -> Gray {
    Gray { width: SIZE, height: SIZE, values: vec![255; PIXELS] }
}

/// A colour from 0.3 to 0.7.
fn color(seed: u64, i: usize, j: usize) -> f32 {
    0.3 + 0.4 * uniform(seed, j as u64, i as u64)
}

fn noise(seed: u64, sigma: f32, i: usize, j: usize) -> f32 {
    sigma * normal(seed, 20 + j as u64, i as u64)
}

fn members(views: &[Image]) -> Members<'_> {
    let names = ["baseline", "tface", "iface", "other"];
    let list: Vec<Member> =
        views.iter().zip(names).map(|(image, name)| Member { name, image, masked: true }).collect();
    Members::new(&list).unwrap()
}

fn fit(views: &[Image], photo: &Photo, weight: &Gray) -> Fit {
    let mut fit = Fit::new(views.len()).unwrap();
    fit.add(&members(views), &Target { photo, weight }).unwrap();
    fit
}

#[test]
fn two_flat_members_are_weighed_as_worked_by_hand() {
    // 0.2 and 0.4 around 68/255 = 0.2667: two thirds and a third; none beyond the greater one
    let views = [view(|_, _| 0.2), view(|_, _| 0.4)];
    let between = fit(&views, &photo(|_, _| 68.0 / 255.0), &everywhere());
    let w = between.solve().unwrap();
    assert!((w[0] - 2.0 / 3.0).abs() < 1e-4 && (w[1] - 1.0 / 3.0).abs() < 1e-4, "{w:?}");
    let beyond = fit(&views, &photo(|_, _| 0.6), &everywhere());
    assert_eq!(beyond.solve().unwrap(), [0.0, 1.0]);
    // error 0.2 of the second: −10 log10 0.04 = 13.9794; halves: 0.3, 10.4576
    assert!((beyond.psnr(&[0.0, 1.0]).unwrap().unwrap() - 13.9794).abs() < 1e-4);
    assert!((beyond.psnr(&[0.5, 0.5]).unwrap().unwrap() - 10.4576).abs() < 1e-4);
}

#[test]
fn known_weights_are_found_again_inside_and_on_the_boundary() {
    for truth in [[0.1, 0.6, 0.3], [0.0, 0.7, 0.3], [0.0, 0.0, 1.0]] {
        let views: Vec<Image> = (0..3).map(|k| view(|i, j| color(k, i, j))).collect();
        let photo = photo(|i, j| {
            let mix: f32 = (0..3).map(|k| truth[k] * color(k as u64, i, j)).sum();
            mix + noise(9, 0.01, i, j)
        });
        let fit = fit(&views, &photo, &everywhere());
        let w = fit.solve().unwrap();
        assert!((0..3).all(|k| (w[k] - truth[k]).abs() < 0.005), "{truth:?} → {w:?}");
        assert!((w.iter().sum::<f32>() - 1.0).abs() < 1e-6 && w.iter().all(|v| *v >= 0.0));
        // no better than the noise of 0.01 (40 dB), and no worse than the truth
        let psnr = |w: &[f32]| fit.psnr(w).unwrap().unwrap();
        assert!((psnr(&w) - 40.0).abs() < 0.3 && psnr(&w) >= psnr(&truth) - 1e-9);
    }
}

#[test]
fn the_sums_say_what_the_pixels_say() {
    let views: Vec<Image> = (0..3).map(|k| view(|i, j| color(k, i, j))).collect();
    let photo = photo(|i, j| color(7, i, j));
    let mut weight = everywhere();
    (0..PIXELS / 2).for_each(|i| weight.values[i] = 0);
    let blended = blend(&members(&views), &PAPER_WEIGHTS).unwrap();
    let squares = (PIXELS / 2..PIXELS)
        .flat_map(|i| (0..3).map(move |j| (i, j)))
        .map(|(i, j)| (blended.data[4 * i + j] as f64 - photo.rgb[i][j] as f64 / 255.0).powi(2));
    let expected = -10.0 * (squares.sum::<f64>() / (1.5 * PIXELS as f64)).log10();
    let found = fit(&views, &photo, &weight).psnr(&PAPER_WEIGHTS).unwrap().unwrap();
    assert!((found - expected).abs() < 1e-5, "{found} {expected}");
}

#[test]
fn members_that_are_the_same_share_alike() {
    let views = [view(|i, j| color(1, i, j)), view(|i, j| color(1, i, j)), view(|i, j| color(2, i, j))];
    let photo = photo(|i, j| color(1, i, j) + noise(3, 0.02, i, j));
    let w = fit(&views, &photo, &everywhere()).solve().unwrap();
    assert!((w[0] - w[1]).abs() < 1e-4 && w[2] < 0.01, "{w:?}");
    // and a member that is perfect takes all, without dividing by 0
    let black = [view(|_, _| 0.0), view(|_, _| 1.0)];
    let perfect = fit(&black, &self::photo(|_, _| 0.0), &everywhere());
    assert_eq!(perfect.psnr(&[1.0, 0.0]).unwrap(), None);
    assert!(perfect.solve().unwrap()[0] > 0.999_999);
}

#[test]
fn half_a_weight_counts_half_a_pixel_and_views_add_up() {
    let views = [view(|i, j| color(1, i, j)), view(|i, j| color(2, i, j))];
    let photo = photo(|i, j| color(3, i, j));
    let mut weight = everywhere();
    weight.values.fill(51); // a fifth
    let fifth = fit(&views, &photo, &weight);
    assert!((fifth.pixels() - PIXELS as f64 / 5.0).abs() < 1e-6);
    let whole = fit(&views, &photo, &everywhere());
    assert!(
        (fifth.psnr(&[0.5, 0.5]).unwrap().unwrap() - whole.psnr(&[0.5, 0.5]).unwrap().unwrap()).abs() < 1e-9
    );
    let mut twice = whole.clone();
    twice.merge(&whole).unwrap();
    let mut streamed = whole.clone();
    streamed.add(&members(&views), &Target { photo: &photo, weight: &everywhere() }).unwrap();
    assert!((twice.pixels() - streamed.pixels()).abs() < 1e-9);
    let (a, b) = (twice.solve().unwrap(), streamed.solve().unwrap());
    assert!((a[0] - b[0]).abs() < 1e-6);
}

/// x, y over the picture from −1 to 1, z from the seed; the last two rows show nothing.
fn points(seed: u64) -> Image {
    let mut points = Image::new(SIZE, SIZE, 3);
    for (i, p) in points.data.as_chunks_mut::<3>().0.iter_mut().enumerate() {
        let at = |v: usize| (v as f32 + 0.5) / SIZE as f32 * 2.0 - 1.0;
        let (x, y) = (i % SIZE as usize, i / SIZE as usize);
        *p = [at(x), at(y), 0.8 * uniform(seed, 30, i as u64) - 0.4];
        if y >= SIZE as usize - 2 {
            p.fill(f32::NAN);
        }
    }
    points
}

/// The first member is right (error 0.01) for x < 0, the second for x > 0; elsewhere error 0.08.
fn split(seed: u64) -> ([Image; 2], Photo) {
    let side = |i: usize| i % SIZE as usize >= SIZE as usize / 2;
    let make = |k: u64, right: bool| {
        view(|i, j| {
            let sigma = if side(i) == right { 0.01 } else { 0.08 };
            color(seed, i, j) + noise(seed * 10 + k, sigma, i, j)
        })
    };
    ([make(1, false), make(2, true)], photo(|i, j| color(seed, i, j)))
}

fn region_fit(seed: u64, weight: &Gray) -> RegionFit {
    let (views, photo) = split(seed);
    let mut fit = RegionFit::new(2, NODES).unwrap();
    fit.add(&members(&views), &points(seed), &Target { photo: &photo, weight }).unwrap();
    fit
}

#[test]
fn regions_find_where_each_member_is_right_and_gain_on_fresh_pixels() {
    let mut fit = region_fit(1, &everywhere());
    fit.merge(&region_fit(2, &everywhere())).unwrap();
    let global = fit.global().solve().unwrap();
    assert!((global[0] - 0.5).abs() < 0.02, "{global:?}");
    let regions = fit.solve(&global, Stiffness::default()).unwrap();
    let left = regions.at(glam::Vec3::new(-0.8, 0.0, 0.0));
    let right = regions.at(glam::Vec3::new(0.8, 0.0, 0.0));
    assert!(left[0] > 0.8 && right[1] > 0.8, "{left:?} {right:?}");
    assert_eq!(regions.at(glam::Vec3::NAN), global);
    for x in -10..=10 {
        let w = regions.at(glam::Vec3::new(x as f32 / 8.0, 0.3, 0.2));
        assert!((w.iter().sum::<f32>() - 1.0).abs() < 1e-5 && w.iter().all(|v| *v >= 0.0));
    }
    // pixels that no fit has seen
    let fresh = region_fit(3, &everywhere());
    let (before, after) =
        (fresh.global().psnr(&global).unwrap().unwrap(), fresh.psnr(&regions).unwrap().unwrap());
    assert!(after > before + 2.0, "{before} → {after}");
    // the sums say what the blended pixels say
    let (views, photo) = split(3);
    let out = blend_regions(&members(&views), &points(3), &regions).unwrap();
    let squares = out
        .data
        .chunks(4)
        .zip(&photo.rgb)
        .map(|(c, p)| (0..3).map(|j| (c[j] as f64 - p[j] as f64 / 255.0).powi(2)).sum::<f64>());
    let expected = -10.0 * (squares.sum::<f64>() / (3.0 * PIXELS as f64)).log10();
    assert!((after - expected).abs() < 1e-4, "{after} {expected}");
}

#[test]
fn the_regions_are_the_minimum_that_can_be_checked_by_moving_each_node() {
    let fit = region_fit(4, &everywhere());
    let global = fit.global().solve().unwrap();
    // without any pull to speak of: no move of a node's weights may lower the error
    let regions = fit.solve(&global, Stiffness { to_global: 0.0, to_neighbours: 0.0 }).unwrap();
    let best = fit.psnr(&regions).unwrap().unwrap();
    let json = serde_json::to_value(&regions).unwrap();
    for node in [31, 37, 62, 63, 67, 92] {
        for step in [-0.05f32, 0.05] {
            let mut moved = json.clone();
            let first = moved["weights"][node][0].as_f64().unwrap() as f32;
            let first = (first + step).clamp(0.0, 1.0);
            moved["weights"][node] = serde_json::json!([first, 1.0 - first]);
            let moved: RegionWeights = serde_json::from_value(moved).unwrap();
            assert!(fit.psnr(&moved).unwrap().unwrap() <= best + 1e-6, "node {node}, {step}");
        }
    }
}

#[test]
fn little_data_and_great_stiffness_leave_the_global_weights() {
    let mut few = everywhere();
    few.values.fill(0);
    (0..6).for_each(|i| few.values[2000 + 5 * i] = 255);
    let fit = region_fit(5, &few);
    let start = [0.5, 0.5];
    let far = |regions: &RegionWeights| {
        let at = |i: usize| regions.at(glam::Vec3::new(i as f32 / 10.0 - 1.0, 0.0, 0.0))[0];
        (0..=20).map(|i| (at(i) - 0.5).abs()).fold(0.0, f32::max)
    };
    let regions = fit.solve(&start, Stiffness::default()).unwrap();
    assert!(far(&regions) < 0.03, "{}", far(&regions));
    // and with all pixels, the stiffness decides
    let all = region_fit(5, &everywhere());
    let loose = all.solve(&start, Stiffness::default()).unwrap();
    let stiff = all.solve(&start, Stiffness { to_global: 1e4, to_neighbours: 0.0 }).unwrap();
    assert!(far(&stiff) < 0.001 && far(&loose) > 0.3);
    // as stiff neighbours have: one weight everywhere, which may move as a whole
    let rigid = all.solve(&start, Stiffness { to_global: 0.0, to_neighbours: 1e4 }).unwrap();
    assert!(far(&rigid) < 0.02);
}

#[test]
fn views_left_out_tell_whether_regions_are_worth_it() {
    let judge = |views: &[RegionFit], stiffness| RegionFit::leave_one_out(views, stiffness).unwrap().unwrap();
    let views: Vec<RegionFit> = (1..4).map(|seed| region_fit(seed, &everywhere())).collect();
    assert!(judge(&views, Some(Stiffness::default())) > judge(&views, None) + 2.0);
    // six pixels a view, hardly held back: worse than the global weights on the others
    let mut few = everywhere();
    few.values.fill(0);
    (0..6).for_each(|i| few.values[650 * i + 30] = 255);
    let same = |seed: u64| {
        let views = [1, 2].map(|k| view(|i, j| color(seed, i, j) + noise(seed * 10 + k, 0.05, i, j)));
        let photo = photo(|i, j| color(seed, i, j));
        let mut fit = RegionFit::new(2, NODES).unwrap();
        fit.add(&members(&views), &points(1), &Target { photo: &photo, weight: &few }).unwrap();
        fit
    };
    let views: Vec<RegionFit> = (1..9).map(same).collect();
    let loose = Stiffness { to_global: 1e-6, to_neighbours: 0.0 };
    let (loose, global) = (judge(&views, Some(loose)), judge(&views, None));
    let held = judge(&views, Some(Stiffness::default()));
    assert!(loose < global - 0.2 && (held - global).abs() < 0.1, "{loose} {held} {global}");
    assert_eq!(RegionFit::leave_one_out(&views[..1], None), Err(EnsembleError::Views { found: 1 }));
}

#[test]
fn pixels_without_any_point_leave_every_node_at_the_global_weights() {
    let (views, photo) = split(6);
    let mut nowhere = Image::new(SIZE, SIZE, 3);
    nowhere.data.fill(f32::NAN);
    let mut fit = RegionFit::new(2, 3).unwrap();
    fit.add(&members(&views), &nowhere, &Target { photo: &photo, weight: &everywhere() }).unwrap();
    let regions = fit.solve(&[0.25, 0.75], Stiffness::default()).unwrap();
    assert_eq!(regions, RegionWeights::new(3, vec![0.25, 0.75], vec![vec![0.25, 0.75]; 27]).unwrap());
    assert_eq!(fit.psnr(&regions).unwrap(), fit.global().psnr(&[0.25, 0.75]).unwrap());
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let fit = region_fit(7, &everywhere());
            let regions = fit.solve(&fit.global().solve().unwrap(), Stiffness::default()).unwrap();
            let (views, _) = split(7);
            let out = blend_regions(&members(&views), &points(7), &regions).unwrap();
            (fit, regions, out)
        })
    };
    let one = run(1);
    let nan_free = |image: &Image| image.data.iter().all(|v| v.is_finite());
    assert!(nan_free(&one.2) && one == run(3) && one == run(5));
}

#[test]
fn what_cannot_be_fitted_is_said() {
    assert_eq!(Fit::new(0), Err(EnsembleError::NoMembers));
    assert_eq!(Fit::new(9), Err(EnsembleError::TooManyMembers { found: 9 }));
    assert_eq!(Fit::new(2).unwrap().solve(), Err(EnsembleError::NoPixels));
    assert!(matches!(RegionFit::new(2, 1), Err(EnsembleError::Nodes { found: 1 })));
    let regions = RegionFit::new(2, 3).unwrap();
    assert_eq!(regions.solve(&[0.5, 0.5], Stiffness::default()), Err(EnsembleError::NoPixels));
    let negative = regions.solve(&[0.5, 0.5], Stiffness { to_global: -1.0, to_neighbours: 0.0 });
    assert_eq!(negative, Err(EnsembleError::Stiffness { name: "to_global", value: -1.0 }));
    let finer = RegionFit::new(2, 4).unwrap();
    let e = regions.clone().merge(&finer).unwrap_err();
    assert_eq!(e, EnsembleError::NodeCount { found: 64, expected: 27 });

    let views = [view(|_, _| 0.5), view(|_, _| 0.5)];
    let (photo, weight) = (photo(|_, _| 0.5), Gray { width: 1, height: 1, values: vec![255] });
    let e =
        Fit::new(2).unwrap().add(&members(&views), &Target { photo: &photo, weight: &weight }).unwrap_err();
    assert_eq!(e.to_string(), "the weight map is 1 × 1 pixels, expected 64 × 64");
    let target = Target { photo: &photo, weight: &everywhere() };
    let e = Fit::new(3).unwrap().add(&members(&views), &target).unwrap_err();
    assert_eq!(e.to_string(), "there are 2 members, expected 3");
}
