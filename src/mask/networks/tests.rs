//! SAM and ViTMatte against the stored inputs and outputs of the reference.
//!
//! Tolerances are those of the vectors' own description: 1e-4 for embeddings, masks and logits,
//! 5e-5 for scores and alphas, 1e-6 for normalized pixels, 2 of 255 and a mean of 0.3 for resized
//! pictures, 1 % of mask pixels.

use super::Networks;
use super::processor::IMAGENET;
use super::sam::{Sam, enlarged, normalized, resized};
use super::vitmatte::VitMatte;
use crate::config::{MaskConfig, VitmatteColors};
use crate::mask::Click;
use crate::onnx::tests::{config, made, shared};
use crate::onnx::{NetworkArray, NetworkSession, Role};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use tiface_base::Result;
use tiface_base::image::{Gray, Photo};
use tiface_base::io::{Limits, NpyValues, read_gray, read_json, read_npy, read_photo};

fn array(path: &Path) -> NetworkArray {
    let npy = read_npy(path, &Limits::default()).unwrap();
    let NpyValues::Number(values) = npy.values else { panic!("{} holds booleans", path.display()) };
    NetworkArray::new(&npy.shape, values.iter().map(|&v| v as f32).collect())
}

fn numbers(array: &NetworkArray) -> &[f32] {
    &array.values
}

/// Checks the largest difference and prints it: the record of how far results are from the
/// reference.
fn close(what: &str, found: &[f32], expected: &[f32], tolerance: f32) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let worst = found.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    println!("{what} differs by at most {worst:.2e} (allowed {tolerance:.0e})");
    assert!(worst <= tolerance, "{what}: {worst} > {tolerance}");
}

/// Bytes of the largest array that may be planned.
const ARRAY_BYTES: u64 = 1 << 32;

fn picture(folder: &Path) -> Photo {
    read_photo(&folder.join("image.png"), None, &Limits::default()).unwrap()
}

fn gray(path: &Path) -> Gray {
    read_gray(path, None, &Limits::default()).unwrap()
}

fn clicks(folder: &Path) -> Vec<Click> {
    let json = read_json(&folder.join("prompts.json"), &Limits::default()).unwrap();
    let points = json["points"].as_array().unwrap();
    points
        .iter()
        .map(|p| Click {
            x: p["x"].as_f64().unwrap() as f32,
            y: p["y"].as_f64().unwrap() as f32,
            head: p["label"] == 1,
        })
        .collect()
}

const DECODER: &str = "prompt_encoder_mask_decoder.onnx";
const NO_LABELS: &str = "prompt_encoder_mask_decoder_nolabels.onnx";
const ORIGINAL: &str = "sam_decoder_multi.onnx";

fn sam(folder: &Path, decoder: &str) -> Result<Sam> {
    Sam::open(&folder.join("vision_encoder.onnx"), &folder.join(decoder), ARRAY_BYTES)
}

fn text(path: PathBuf) -> String {
    path.to_str().unwrap().into()
}

/// The network with the decoder of the reference, opened once a test program.
fn reference_sam(folder: &Path) -> &'static Sam {
    static SAM: OnceLock<Sam> = OnceLock::new();
    SAM.get_or_init(|| sam(folder, DECODER).unwrap())
}

fn sam_files(folder: &Path, decoder: &str) -> MaskConfig {
    MaskConfig {
        sam: text(folder.join("vision_encoder.onnx")),
        sam_decoder: text(folder.join(decoder)),
        ..config()
    }
}

fn opened(config: &MaskConfig) -> Networks {
    Networks::open(config).unwrap().expect("files are named")
}

/// Share of pixels on which two masks differ.
fn differing(a: &Gray, b: &Gray) -> f64 {
    assert_eq!((a.width, a.height), (b.width, b.height));
    let wrong = a.values.iter().zip(&b.values).filter(|(a, b)| (**a > 127) != (**b > 127)).count();
    wrong as f64 / a.values.len() as f64
}

#[test]
fn photographs_are_resized_as_pillow_does() {
    let Some(folder) = shared("sam_tiny") else { return };
    let (photo, reference) =
        (picture(&folder), read_photo(&folder.join("resized.png"), None, &Limits::default()));
    let reference = reference.unwrap();
    let resized = resized(&photo, 192, 256);
    let off: Vec<u8> =
        resized.iter().flatten().zip(reference.rgb.iter().flatten()).map(|(a, b)| a.abs_diff(*b)).collect();
    let (worst, sum) = (off.iter().max().unwrap(), off.iter().map(|&v| f64::from(v)).sum::<f64>());
    println!("resized: worst {worst} of 255, mean {:.4}", sum / off.len() as f64);
    assert!(*worst <= 2 && sum / off.len() as f64 <= 0.3);
}

#[test]
fn the_encoder_sees_the_pixels_of_the_reference() {
    let Some(folder) = shared("sam_tiny") else { return };
    let resized = read_photo(&folder.join("resized.png"), None, &Limits::default()).unwrap();
    let pixels = normalized(&resized.rgb, 192, 256, &IMAGENET);
    close("pixel_values", numbers(&pixels), numbers(&array(&folder.join("pixel_values.npy"))), 1e-6);
    // the file's own side and processor are obeyed: 256, not 1024
    let sam = reference_sam(&folder);
    assert_eq!((sam.side, sam.fitted(150, 200)), (256, (192, 256)));
}

#[test]
fn sam_gives_the_reference_from_the_stored_inputs() {
    let Some(folder) = shared("sam_tiny") else { return };
    let at = |name: &str| array(&folder.join(name));
    let open = |role, name: &str| NetworkSession::open(role, &folder.join(name), ARRAY_BYTES).unwrap();
    let encoder = open(Role::SAM, "vision_encoder.onnx");
    let names = ["image_embeddings", "image_positional_embeddings"];
    let given = encoder.run(&[("pixel_values", at("pixel_values.npy"))]).unwrap();
    for (name, output) in names.iter().zip(&given) {
        close(name, &output.values, numbers(&at(&format!("{name}.npy"))), 1e-4);
    }
    for (file, prefix) in [(DECODER, ""), (NO_LABELS, "nolabels_")] {
        let mut inputs = vec![
            ("input_points", at("input_points.npy")),
            (names[0], at("image_embeddings.npy")),
            (names[1], at("image_positional_embeddings.npy")),
        ];
        if prefix.is_empty() {
            inputs.push(("input_labels", at("input_labels.npy")));
        }
        let given = open(Role::SAM_DECODER, file).run(&inputs).unwrap();
        for (name, tolerance, output) in [("iou_scores", 5e-5, &given[0]), ("pred_masks", 1e-4, &given[1])] {
            let name = format!("{prefix}{name}");
            close(&name, &output.values, numbers(&at(&format!("{name}.npy"))), tolerance);
        }
    }
    let decoder = open(Role::SAM_DECODER, ORIGINAL);
    for (prefix, has) in [("meta_", 0.0), ("meta_with_mask_", 1.0)] {
        let inputs = [
            (names[0], at("image_embeddings.npy")),
            ("point_coords", at("meta_point_coords.npy")),
            ("point_labels", at("meta_point_labels.npy")),
            ("mask_input", at("meta_mask_input.npy")),
            ("has_mask_input", NetworkArray::new(&[1], vec![has])),
            ("orig_im_size", at("meta_orig_im_size.npy")),
        ];
        let given = decoder.run(&inputs).unwrap();
        for (name, tolerance, output) in
            [("iou_predictions", 5e-5, &given[0]), ("low_res_masks", 1e-4, &given[1])]
        {
            let name = format!("{prefix}{name}");
            close(&name, &output.values, numbers(&at(&format!("{name}.npy"))), tolerance);
        }
    }
}

#[test]
fn logits_reach_the_photograph_as_in_the_reference() {
    let Some(folder) = shared("sam_tiny") else { return };
    for (small, large, count) in
        [("pred_masks.npy", "mask_logits.npy", 3), ("meta_low_res_masks.npy", "meta_masks.npy", 4)]
    {
        let small = array(&folder.join(small));
        let found: Vec<f32> = (0..count)
            .flat_map(|i| enlarged(&numbers(&small)[i * 4096..][..4096], 64, 256, (192, 256), (150, 200)))
            .collect();
        close(large, &found, numbers(&array(&folder.join(large))), 1e-4);
    }
}

#[test]
fn clicks_become_the_mask_of_the_reference_end_to_end() {
    let Some(folder) = shared("sam_tiny") else { return };
    let (photo, clicks) = (picture(&folder), clicks(&folder));
    let networks = opened(&sam_files(&folder, DECODER));
    let (mask, score) = networks.segment(&photo, &clicks).unwrap().unwrap();
    let off = differing(&mask, &gray(&folder.join("mask.png")));
    println!("the mask differs on {:.3} % of the pixels, score {score}", 100.0 * off);
    assert!(off <= 0.01);
    let scores = array(&folder.join("iou_scores.npy"));
    let best = numbers(&scores).iter().copied().fold(f32::MIN, f32::max);
    assert!((score - best).abs() < 1e-2, "{score} {best}");
}

#[test]
fn the_original_decoder_gets_the_padding_point_once_and_gives_the_first_of_four_masks() {
    let Some(folder) = shared("sam_tiny") else { return };
    let (photo, clicks) = (picture(&folder), clicks(&folder));
    let reference = array(&folder.join("meta_masks.npy"));
    let coords = array(&folder.join("meta_point_coords.npy"));
    let sam = sam(&folder, ORIGINAL).unwrap();
    let embedding = sam.embed(&photo).unwrap();
    // the prompt holds four clicks and one padding point, as the stored one
    let prompt = sam.prompt(&embedding, &clicks);
    let (_, points) = prompt.iter().find(|(name, _)| *name == "point_coords").unwrap();
    let (_, labels) = prompt.iter().find(|(name, _)| *name == "point_labels").unwrap();
    close("point_coords", numbers(points), numbers(&coords), 1e-4);
    assert_eq!(numbers(labels), [1.0, 1.0, 1.0, 0.0, -1.0]);
    let candidates = sam.decode(&embedding, &clicks).unwrap();
    assert_eq!((candidates.scores.len(), candidates.best), (4, 0));
    let logits = sam.on_photo(&embedding, &candidates, 0);
    // from the photograph on: the resized pixels may differ from the stored ones by rounding
    let off = logits.iter().zip(numbers(&reference)).filter(|(a, b)| (**a > 0.0) != (**b > 0.0)).count();
    assert!(off * 100 <= logits.len(), "{off} pixels of {}", logits.len());
    // one click alone: the best of the three others
    let one = sam.decode(&embedding, &clicks[..1]).unwrap();
    let best = (1..4).max_by(|&a, &b| one.scores[a].total_cmp(&one.scores[b])).unwrap();
    assert_eq!(one.best, best);
}

#[test]
fn a_decoder_without_labels_takes_clicks_on_the_head_and_no_others() {
    let Some(folder) = shared("sam_tiny") else { return };
    let (photo, clicks) = (picture(&folder), clicks(&folder));
    let sam = sam(&folder, NO_LABELS).unwrap();
    let Err(error) = sam.segment(&photo, &clicks) else { panic!("the background was taken for head") };
    assert!(error.to_string().contains("click 4 is on the background"), "{error}");
    assert!(error.hint().contains("input_labels"));
    sam.segment(&photo, &clicks[..3]).unwrap();
}

#[test]
fn clicks_that_make_no_sense_are_named() {
    let Some(folder) = shared("sam_tiny") else { return };
    let photo = picture(&folder);
    let sam = reference_sam(&folder);
    let head = |x: f32, y: f32| Click { x, y, head: true };
    for (clicks, word) in [
        (vec![], "the photograph has no clicks"),
        (vec![Click { head: false, ..head(5.0, 5.0) }], "none is on the head"),
        (vec![head(5.0, 5.0), head(150.0, 5.0)], "click 2 at (150, 5) is outside"),
        (vec![head(5.0, -3.0)], "is outside"),
        (vec![head(f32::NAN, 5.0)], "is outside"),
        (vec![head(5.0, f32::INFINITY)], "is outside"),
        (vec![head(5.0, 5.0); 257], "has 257 clicks"),
    ] {
        let Err(error) = sam.segment(&photo, &clicks) else { panic!("{word}") };
        let said = error.to_string();
        assert!(said.contains("the photograph") && said.contains(word), "{said}");
    }
    // two clicks that fell together when the photograph was reduced
    let pair = [head(5.2, 5.0), Click { head: false, ..head(4.9, 5.0) }];
    sam.segment(&photo, &pair).unwrap();
}

#[test]
fn odd_sizes_and_a_single_row_of_pixels_get_a_mask_of_their_own_size() {
    let Some(folder) = shared("sam_tiny") else { return };
    let vitmatte = shared("vitmatte_tiny").map_or(String::new(), |f| text(f.join("model.onnx")));
    let has_vitmatte = !vitmatte.is_empty();
    let networks = opened(&MaskConfig { vitmatte, ..sam_files(&folder, DECODER) });
    for (width, height) in [(75, 49), (49, 75), (333, 1), (1, 1), (257, 256)] {
        let rgb = (0..width * height).map(|i| [(i % 255) as u8; 3]).collect();
        let photo = Photo { width, height, rgb, alpha: None };
        let click = Click { x: (width - 1) as f32, y: (height - 1) as f32, head: true };
        let (mask, _) = networks.segment(&photo, &[click]).unwrap().unwrap();
        assert_eq!((mask.width, mask.height, mask.values.len()), (width, height, (width * height) as usize));
        assert!(mask.values.iter().all(|&v| v == 0 || v == 255));
        let alpha = networks.alpha(&photo, &mask).unwrap();
        assert_eq!(alpha.map(|a| a.len()), has_vitmatte.then_some((width * height) as usize));
    }
}

#[test]
fn both_encoders_of_the_original_form_feed_the_original_decoder() {
    let Some(folder) = shared("sam_tiny") else { return };
    let dir = tempfile::tempdir().unwrap();
    // 256 × 256: nothing to resize, nothing to pad
    let rgb: Vec<[u8; 3]> = (0..256 * 256).map(|i| [(i % 256) as u8, (i / 256) as u8, 40]).collect();
    let photo = Photo { width: 256, height: 256, rgb, alpha: None };
    let click = Click { x: 120.0, y: 130.0, head: true };
    for picture in [true, false] {
        let path = dir.path().join(format!("encoder_{picture}.onnx"));
        fs::write(&path, made::original_encoder(picture, 256, 32)).unwrap();
        let sam = Sam::open(&path, &folder.join(ORIGINAL), ARRAY_BYTES).unwrap();
        assert_eq!(sam.side, 256);
        let pixels = sam.pixels(&photo);
        let shape: &[usize] = if picture { &[256, 256, 3] } else { &[1, 3, 256, 256] };
        assert_eq!(pixels.shape, shape);
        // cell (1, 0) spans columns 16..32: mean red 23.5, of rows 0..16: mean green 7.5; channel 1
        // weighs 3, 4, 5 of 96
        let given = sam.encoder.run(&[("input_image", pixels)]).unwrap();
        let color =
            |v: f64, c: usize| if picture { v } else { (v / 255.0 - IMAGENET.mean[c]) / IMAGENET.std[c] };
        let expected = (3.0 * color(23.5, 0) + 4.0 * color(7.5, 1) + 5.0 * color(40.0, 2)) / 96.0;
        close("cell (1, 0)", &[given[0].values[256 + 1]], &[expected as f32], 1e-5);
        let (mask, score) = sam.segment(&photo, &[click]).unwrap();
        assert!(mask.values.len() == 65536 && score.is_finite());
    }
}

#[test]
fn encoder_and_decoder_that_do_not_fit_are_named_together() {
    let Some(folder) = shared("sam_tiny") else { return };
    let dir = tempfile::tempdir().unwrap();
    let encoder = |picture, side, depth| {
        let path = dir.path().join(format!("{picture}{side}{depth}.onnx"));
        fs::write(&path, made::original_encoder(picture, side, depth)).unwrap();
        path
    };
    let decoder = |name: &str| folder.join(name);
    let open = |e: &Path, d: &Path| Sam::open(e, d, ARRAY_BYTES);
    let Err(error) = open(&encoder(false, 256, 32), &decoder(DECODER)) else { panic!("no position") };
    assert!(error.to_string().contains("image_positional_embeddings"), "{error}");
    let Err(error) = open(&encoder(false, 512, 32), &decoder(ORIGINAL)) else { panic!("512 is not 256") };
    assert!(error.to_string().contains("32 × 32 cells, the decoder takes 16 × 16"), "{error}");
    // the width of the embedding shows in its output
    let sam = open(&encoder(false, 256, 8), &decoder(ORIGINAL)).unwrap();
    let photo = Photo { width: 8, height: 8, rgb: vec![[9; 3]; 64], alpha: None };
    let Err(error) = sam.segment(&photo, &[Click { x: 1.0, y: 1.0, head: true }]) else {
        panic!("8 is not 32")
    };
    assert!(error.to_string().contains("[1, 8, 16, 16], expected [1, 32, 16, 16]"), "{error}");
    // each in the other's place
    let swapped = open(&decoder(DECODER), &decoder("vision_encoder.onnx"));
    assert!(swapped.is_err_and(|e| e.to_string().contains("was given as the SAM encoder")));
    let alone = Networks::open(&MaskConfig { sam: text(decoder("vision_encoder.onnx")), ..config() });
    assert!(alone.is_err_and(|e| e.to_string().contains("no file was given")));
}

#[test]
fn vitmatte_gives_the_reference_from_the_stored_inputs() {
    let Some(folder) = shared("vitmatte_tiny") else { return };
    let open = |name: &str| NetworkSession::open(Role::VITMATTE, &folder.join(name), ARRAY_BYTES);
    let session = open("model.onnx").unwrap();
    for kind in ["", "_imagenet", "_random_160x224", "_random_96x128"] {
        let pixels = array(&folder.join(format!("pixel_values{kind}.npy")));
        let alphas = array(&folder.join(format!("alphas{kind}.npy")));
        let given = session.run(&[("pixel_values", pixels.clone())]).unwrap();
        assert_eq!(given[0].shape, alphas.shape);
        close(&format!("alphas{kind}"), &given[0].values, numbers(&alphas), 5e-5);
        // the harder file: the same numbers, or one clear sentence
        let recent =
            open("model_recent_exporter.onnx").and_then(|session| session.run(&[("pixel_values", pixels)]));
        match recent {
            Ok(given) => {
                let what = format!("alphas{kind} of the recent exporter");
                close(&what, &given[0].values, numbers(&alphas), 5e-5);
            }
            Err(error) => {
                println!("{error}; {}", error.hint());
                assert!(error.to_string().ends_with("Reshape: Reshape volume mismatch"), "{error}");
                assert!(error.hint().contains("exporters"));
            }
        }
    }
}

#[test]
fn vitmatte_is_shown_the_colors_of_each_convention() {
    let Some(folder) = shared("vitmatte_tiny") else { return };
    let (photo, trimap) = (picture(&folder), gray(&folder.join("trimap.png")));
    let dir = tempfile::tempdir().unwrap();
    let alone = dir.path().join("model.onnx");
    fs::copy(folder.join("model.onnx"), &alone).unwrap();
    let beside = folder.join("model.onnx");
    // shown the same numbers from another file, the network is not run again
    for (path, set, kind, runs) in [
        (&beside, VitmatteColors::Auto, "", true),
        (&alone, VitmatteColors::Auto, "_imagenet", true),
        (&beside, VitmatteColors::Imagenet, "_imagenet", false),
        (&alone, VitmatteColors::Half, "", false),
    ] {
        let network = VitMatte::open(path, ARRAY_BYTES, set).unwrap();
        let recorded = &network.session.file.contract;
        assert_eq!(recorded.ends_with("colors as in the original code"), kind == "_imagenet");
        let padded = network.padded(150, 200).unwrap();
        assert_eq!(padded, (160, 224));
        let pixels = network.pixels(&photo, &trimap, padded);
        let expected = array(&folder.join(format!("pixel_values{kind}.npy")));
        close("pixel_values", numbers(&pixels), numbers(&expected), 1e-6);
        if !runs {
            continue;
        }
        let alpha = network.alpha(&photo, &trimap).unwrap();
        let whole = array(&folder.join(format!("alphas{kind}.npy")));
        let cut: Vec<f32> =
            numbers(&whole).chunks(160).take(200).flat_map(|row| row[..150].to_vec()).collect();
        close(&format!("alpha{kind} of the photograph"), &alpha, &cut, 5e-5);
    }
}

#[test]
fn the_record_names_each_file_with_its_size_and_its_hash() {
    let (Some(folder), Some(matte)) = (shared("sam_tiny"), shared("vitmatte_tiny")) else { return };
    let vitmatte = text(matte.join("model.onnx"));
    let files = MaskConfig { vitmatte, memory_gib: 8.0, ..sam_files(&folder, DECODER) };
    let networks = opened(&files);
    let record = networks.files();
    let roles: Vec<_> = record.iter().map(|f| f.role).collect();
    assert_eq!(roles, ["sam", "sam_decoder", "vitmatte"]);
    assert_eq!(record[0].bytes, 899_688);
    assert!(record.iter().all(|f| f.sha256.len() == 64));
    for file in record {
        println!("{file:?}");
    }
    assert_eq!(networks.photos_at_once(384, 512, 2), 2);
    let tight = opened(&MaskConfig { memory_gib: 1e-9, ..files });
    assert_eq!(tight.photos_at_once(384, 512, 2), 1);
    networks.prepare(150, 200).unwrap();
}

#[test]
fn photographs_side_by_side_get_what_they_get_alone() {
    let (Some(folder), Some(matte)) = (shared("sam_tiny"), shared("vitmatte_tiny")) else { return };
    let (photo, clicks, trimap) = (picture(&folder), clicks(&folder), gray(&matte.join("trimap.png")));
    let sam = reference_sam(&folder);
    let vitmatte = VitMatte::open(&matte.join("model.onnx"), ARRAY_BYTES, VitmatteColors::Auto).unwrap();
    let both = || (sam.segment(&photo, &clicks).unwrap(), vitmatte.alpha(&photo, &trimap).unwrap());
    let alone = both();
    std::thread::scope(|scope| {
        let each: Vec<_> = (0..3).map(|_| scope.spawn(both)).collect();
        assert!(each.into_iter().all(|thread| thread.join().unwrap() == alone));
    });
}

#[test]
fn a_photograph_beyond_the_memory_limit_is_refused_before_it_is_run() {
    let Some(folder) = shared("vitmatte_tiny") else { return };
    let networks = opened(&MaskConfig { vitmatte: text(folder.join("model.onnx")), ..config() });
    // 3000 × 4096 is 48 128 cells, and 48 bytes for each pair of them 104 GiB
    let error = networks.prepare(3000, 4096).unwrap_err();
    assert!(error.to_string().contains("GiB") && error.hint().contains("1024"), "{error}");
    networks.prepare(64, 64).unwrap();
    let photo = Photo { width: 4, height: 4, rgb: vec![[0; 3]; 16], alpha: None };
    let trimap = Gray { width: 4, height: 3, values: vec![0; 12] };
    assert!(networks.alpha(&photo, &trimap).is_err_and(|e| e.to_string().contains("its trimap 4 × 3")));
    assert_eq!(networks.segment(&photo, &[]), Ok(None));
    // a photograph that is not as large as it says
    let photo = Photo { height: 5, ..photo };
    let trimap = Gray { width: 4, height: 5, values: vec![0; 20] };
    assert!(
        networks.alpha(&photo, &trimap).is_err_and(|e| e.to_string().contains("4 × 5 pixels, but 16 colors"))
    );
    let photo = Photo { height: 4, ..photo };
    let trimap = Gray { width: 4, height: 4, values: vec![0; 12] };
    assert!(networks.alpha(&photo, &trimap).is_err_and(|e| e.to_string().contains("its trimap 4 × 4")));
}

/// Networks may be shared between threads: this does not compile where they may not.
const _: fn() = || {
    fn shared<T: Send + Sync>() {}
    shared::<Networks>();
};
