//! Hostile files, each with the error it must produce; and that the engine really refuses what it
//! refuses.

use self::made::{Message, floats, graph, integers, model, node, port, tensor, trimap_times, vitmatte};
use super::*;
use crate::config::{MaskConfig, Preset};
use crate::mask::networks::Networks;
use std::fs;
use std::path::PathBuf;
use tiface_base::image::{Gray, Photo};

pub(crate) mod made;

/// The shared data, where it is.
pub(crate) fn shared(folder: &str) -> Option<PathBuf> {
    let root = std::env::var_os("TIFACE_SHARED")
        .map(PathBuf::from)
        .unwrap_or_else(|| PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../shared")));
    let path = root.join("data/mask-models").join(folder);
    if path.is_dir() {
        return Some(path);
    }
    eprintln!("skipped: `{}` is not there", path.display());
    None
}

/// A configuration that names nothing.
pub(crate) fn config() -> MaskConfig {
    MaskConfig::preset(Preset::Standard)
}

fn opened_with(bytes: &[u8]) -> Result<Networks> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("network.onnx");
    fs::write(&path, bytes).unwrap();
    let vitmatte = path.to_str().unwrap().to_owned();
    let networks = Networks::open(&MaskConfig { vitmatte, ..config() })?;
    Ok(networks.expect("a file is named"))
}

/// Opens a file and runs it once on an empty photograph.
fn tried(bytes: &[u8]) -> Result<Networks> {
    let networks = opened_with(bytes)?;
    networks.prepare(32, 32)?;
    Ok(networks)
}

/// What a file that must not be used is refused with: a sentence with its name, and a suggested
/// fix.
fn refusal(bytes: &[u8]) -> String {
    match tried(bytes) {
        Ok(_) => panic!("it runs"),
        Err(error) => {
            let said = error.to_string();
            assert!(said.contains("network.onnx") && !said.contains('\n'), "{said}");
            assert!(error.hint().len() > 10, "no suggested fix of: {said}");
            said
        }
    }
}

/// As [`refusal`], which contains the word.
fn refused_for(word: &str, bytes: &[u8]) {
    let said = refusal(bytes);
    assert!(said.contains(word), "not for `{word}`: {said}");
}

/// Why a file was refused, if it is one of the reasons that lie in the file.
fn reason(error: &Error) -> Option<&'static str> {
    let said = error.to_string();
    let reasons = [
        "is not a valid ONNX file",
        "is refused: its weights lie in another file",
        "is no network that is known",
        ", but was given as the ViTMatte network",
        " cannot load `",
        " cannot run `",
        "gave an unusable `alphas`",
    ];
    reasons.into_iter().find(|reason| said.contains(reason))
}

fn photo(width: u32, height: u32) -> (Photo, Gray) {
    let rgb = (0..width * height).map(|i| [(i % 251) as u8, (i % 83) as u8, 200]).collect();
    let values = (0..width * height).map(|i| [0, 128, 255][i as usize % 3]).collect();
    (Photo { width, height, rgb, alpha: None }, Gray { width, height, values })
}

#[test]
fn a_valid_network_made_by_hand_gives_the_trimap() {
    // odd sizes: padded to 64 × 64, cut back to 35 × 33
    let (photo, trimap) = photo(35, 33);
    let networks = opened_with(&trimap_times(1.0)).unwrap();
    let alpha = networks.alpha(&photo, &trimap).unwrap().unwrap();
    let expected: Vec<f32> = trimap.values.iter().map(|&v| [0.0, 0.5, 1.0][v as usize / 100]).collect();
    assert_eq!(alpha, expected);
}

#[test]
fn text_and_nothing_are_no_onnx() {
    let page = b"<!DOCTYPE html><html><body>404</body></html>".as_slice();
    for bytes in [page, b"version https://git-lfs.github.com/spec/v1\n", &[0xff; 100], b"\n\x00\x12"] {
        refused_for("is not a valid ONNX file", bytes);
    }
    refused_for("it holds no graph", &Message::new().int(1, 7).0);
    assert!(tried(b"").is_err_and(|e| e.to_string().contains("is empty (0 bytes)")));
}

/// Ends a file after every multiple of `every` bytes, and damages each of these bytes.
fn damaged(every: usize) {
    let whole = trimap_times(1.0);
    for end in (1..whole.len()).step_by(every) {
        // an end between two fields leaves a message that parses and lacks what comes later; the
        // last one is the opset, without which the rest still stands
        if let Err(error) = tried(&whole[..end]) {
            assert!(reason(&error).is_some(), "cut at {end}: {error}");
        }
    }
    for at in (0..whole.len()).step_by(every) {
        for flip in [0x01, 0xff] {
            let mut bytes = whole.clone();
            bytes[at] ^= flip;
            if let Err(error) = tried(&bytes) {
                assert!(!error.hint().is_empty() && error.to_string().contains("network.onnx"), "{error}");
                assert!(reason(&error).is_some() || error.to_string().contains(" takes only "), "{error}");
            }
        }
    }
}

#[test]
fn half_a_file_and_a_wrong_byte_end_in_a_result_or_an_error() {
    // in steps that fall on tags, lengths and contents alike
    damaged(7);
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; opens some thousand damaged networks"]
fn any_end_and_any_wrong_byte_end_in_a_result_or_an_error() {
    damaged(1);
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; 300 damaged networks take minutes"]
fn random_damage_to_a_whole_network_ends_in_a_result_or_an_error() {
    let Some(folder) = shared("vitmatte_tiny") else { return };
    let whole = fs::read(folder.join("model.onnx")).unwrap();
    let (photo, trimap) = photo(40, 33);
    let mut seed = 20_240_607u64;
    let mut random = || {
        // Steele, Lea & Flood 2014: splitmix64
        seed = seed.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (seed ^ (seed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) as usize
    };
    let mut ends = std::collections::BTreeMap::new();
    for _ in 0..300 {
        let mut bytes = whole.clone();
        // the graph's nodes stand before its weights
        for _ in 0..1 + random() % 3 {
            let at = random() % (whole.len() / 4);
            bytes[at] ^= 1 << (random() % 8);
        }
        let end = match opened_with(&bytes).and_then(|n| n.alpha(&photo, &trimap)) {
            Ok(_) => "an alpha".to_string(),
            Err(e) if e.to_string().contains("inference failed") => format!("a panic caught: {e}"),
            Err(e) => reason(&e).unwrap_or("takes only another size").to_string(),
        };
        *ends.entry(end).or_insert(0) += 1;
    }
    for (end, times) in ends {
        println!("{times:4} {end}");
    }
}

#[test]
fn weights_in_another_file_are_refused_wherever_they_lie() {
    let dir = tempfile::tempdir().unwrap();
    let beside = dir.path().join("weights.bin");
    fs::write(&beside, [0; 16]).unwrap();
    let absolute = beside.display().to_string();
    let nodes = [node("Conv", &["pixel_values", "w"], &["alphas"], &[])];
    let sound = vitmatte(&nodes, &[floats("w", &[1, 4, 1, 1], &[0.0; 4])]);
    for location in [absolute.as_str(), "../weights.bin", "weights.bin", "/etc/passwd", "missing\u{1b}[2J"] {
        let entry = Message::new().text(1, "location").text(2, location);
        let w = tensor("w", 1, &[1, 4, 1, 1]).message(13, &entry).int(14, 1);
        let bytes = vitmatte(&nodes, std::slice::from_ref(&w));
        let path = dir.path().join("network.onnx");
        fs::write(&path, &bytes).unwrap();
        let vitmatte = path.to_str().unwrap().to_owned();
        let Err(error) = Networks::open(&MaskConfig { vitmatte, ..config() }) else {
            panic!("{location} was followed")
        };
        assert!(
            error.to_string().contains("in another file") && error.hint().contains("onnx.save"),
            "{error}"
        );
        refused_for("in another file", &bytes);
        // hidden in a function of the file's own, which the reader of graphs passes over
        let hidden =
            Message(sound.clone()).message(25, &Message::new().message(7, &Message::new().message(5, &w)));
        refused_for("in another file", &hidden.0);
    }
    // the key's length spelled with more bytes than it needs: 88 80 00
    let entry = [b"\x0a\x88\x80\x00location\x12\x01w".as_slice()].concat();
    refused_for("in another file", &vitmatte(&nodes, &[tensor("w", 1, &[1, 4, 1, 1]).bytes(13, &entry)]));
    // announced, but not named
    refusal(&vitmatte(&nodes, &[tensor("w", 1, &[1, 4, 1, 1]).int(14, 1)]));
    // a name that only contains the word is no key
    let named = [node("Conv", &["pixel_values", "relocation"], &["alphas"], &[])];
    let weights = [floats("relocation", &[1, 4, 1, 1], &[0.0; 4])];
    tried(&vitmatte(&named, &weights)).unwrap();
}

#[test]
fn a_circle_and_a_name_from_nowhere_are_refused() {
    let circle = [
        node("Add", &["pixel_values", "b"], &["a"], &[]),
        node("Relu", &["a"], &["b"], &[]),
        node("Identity", &["b"], &["alphas"], &[]),
    ];
    refusal(&vitmatte(&circle, &[]));
    refusal(&vitmatte(&[node("Relu", &["alphas"], &["alphas"], &[])], &[]));
    refusal(&vitmatte(&[node("Add", &["pixel_values", "ghost"], &["alphas"], &[])], &[]));
    refusal(&vitmatte(&[], &[]));
    // graphs in graphs beyond any depth
    let deep = (0..200).fold(graph(&[], &[], &[], &[]), |inner, _| {
        let branch = made::graph_attribute("then_branch", &inner);
        graph(&[node("If", &["pixel_values"], &["x"], &[branch])], &[], &[], &[])
    });
    let branch = made::graph_attribute("then_branch", &deep);
    refusal(&vitmatte(&[node("If", &["pixel_values"], &["alphas"], &[branch])], &[]));
}

#[test]
fn extents_that_the_data_does_not_fill_are_refused() {
    let nodes = [node("Conv", &["pixel_values", "w"], &["alphas"], &[])];
    let huge = [1 << 20, 1 << 20, 16, 16];
    for w in [
        tensor("w", 1, &huge),
        tensor("w", 1, &huge).bytes(9, &[0; 64]),
        tensor("w", 1, &[i64::MAX, i64::MAX]),
        tensor("w", 1, &[-1, 4]),
        tensor("w", 1, &[1; 40]).bytes(9, &[0; 4]),
        // one number short, one too many, and the same as a list instead of raw bytes
        tensor("w", 1, &[4]).bytes(9, &[0; 12]),
        tensor("w", 1, &[4]).bytes(9, &[0; 20]),
        tensor("w", 1, &[4]).bytes(4, &[0; 12]),
        tensor("w", 99, &[1]),
    ] {
        refusal(&vitmatte(&nodes, &[w]));
    }
}

#[test]
fn constants_that_ask_for_an_array_beyond_all_pictures_are_refused() {
    let filled = node("ConstantOfShape", &["size"], &["big"], &[]);
    let tiled = node("Tile", &["pixel_values", "size"], &["big"], &[]);
    let ranged = node("Range", &["zero", "size", "one"], &["big"], &[]);
    for (first, size) in [
        (filled, vec![1 << 20, 1 << 20]),
        (tiled, vec![1, 1 << 15, 1 << 15, 1 << 15]),
        (ranged, vec![1 << 42]),
    ] {
        let nodes = [
            first,
            node("ReduceMax", &["big"], &["most"], &[]),
            node("Add", &["pixel_values", "most"], &["alphas"], &[]),
        ];
        let size = if size.len() == 1 { made::integer("size", size[0]) } else { integers("size", &size) };
        let weights = [size, made::integer("zero", 0), made::integer("one", 1)];
        refusal(&vitmatte(&nodes, &weights));
    }
}

#[test]
fn extents_computed_from_constants_are_followed() {
    // 2¹⁵ · 2¹⁵ joined with 64: 2³⁶ numbers
    let nodes = [
        node("Mul", &["half", "half"], &["square"], &[]),
        node("Concat", &["square", "more"], &["size"], &[made::int("axis", 0)]),
        node("ConstantOfShape", &["size"], &["big"], &[]),
        node("ReduceMax", &["big"], &["most"], &[]),
        node("Add", &["pixel_values", "most"], &["alphas"], &[]),
    ];
    let weights = [integers("half", &[1 << 15]), integers("more", &[64])];
    let Err(error) = tried(&vitmatte(&nodes, &weights)) else { panic!("it runs") };
    assert!(error.to_string().contains("asks for an array of 274877906944 bytes"), "{error}");
}

#[test]
fn extents_computed_from_the_picture_end_in_an_error_too() {
    // the picture's own shape times 2³⁰: [2³⁰, 4, 32, 32], 16 TiB, which is found before it is
    // allocated
    let nodes = [
        node("Shape", &["pixel_values"], &["shape"], &[]),
        node("Mul", &["shape", "factor"], &["size"], &[]),
        node("Expand", &["pixel_values", "size"], &["alphas"], &[]),
    ];
    let bytes = vitmatte(&nodes, &[integers("factor", &[1 << 30, 1, 1, 1])]);
    let said = refusal(&bytes);
    assert!(said.contains("asks for an array of 17592186044416 bytes"), "{said}");
}

#[test]
fn weights_that_are_no_numbers_are_found_before_the_first_photograph() {
    let nodes = [node("Conv", &["pixel_values", "w"], &["alphas"], &[])];
    for bad in [f32::NAN, f32::INFINITY] {
        refused_for("`alphas`", &vitmatte(&nodes, &[floats("w", &[1, 4, 1, 1], &[1.0, 2.0, bad, 4.0])]));
    }
}

#[test]
fn another_network_is_named_by_what_it_takes_and_gives() {
    let classifier = graph(
        &[node("Relu", &["data"], &["prob"], &[])],
        &[],
        &[port("data", 1, &[1, 3, 224, 224])],
        &[port("prob", 1, &[1, 1000])],
    );
    refused_for("data [1, 3, 224, 224] → prob [1, 1000]", &model(&classifier));
    refused_for("was given as the ViTMatte network", &made::original_encoder(true, 256, 32));
}

#[test]
fn outputs_that_are_not_as_promised_are_errors() {
    let (photo, trimap) = photo(32, 32);
    let mean = |op: &[Message]| {
        let head = node("ReduceMean", &["pixel_values"], &["m"], &[made::ints("axes", &[1])]);
        vitmatte(&[[head].as_slice(), op].concat(), &[])
    };
    let four_channels = vitmatte(&[node("Identity", &["pixel_values"], &["alphas"], &[])], &[]);
    // −|m| ≤ 0 has a logarithm that is NaN or −∞
    let nan = mean(&[
        node("Abs", &["m"], &["a"], &[]),
        node("Neg", &["a"], &["n"], &[]),
        node("Log", &["n"], &["alphas"], &[]),
    ]);
    let too_large = trimap_times(7.0);
    for (bytes, word) in [(&four_channels, "[1, 4, 32, 32]"), (&nan, "number"), (&too_large, "0 to 1")] {
        let networks = opened_with(bytes).unwrap();
        let error = networks.alpha(&photo, &trimap).unwrap_err();
        let said = error.to_string();
        assert!(said.contains("gave an unusable `alphas`") && said.contains(word), "{said}");
    }
}

#[test]
fn unknown_operators_are_an_error_of_the_engine_with_a_fix() {
    let bytes = vitmatte(&[node("Teleport", &["pixel_values"], &["alphas"], &[])], &[]);
    let Err(error) = tried(&bytes) else { panic!("it runs") };
    assert!(error.to_string().contains(" cannot "), "{error}");
    assert!(error.hint().contains("float32 file"), "{}", error.hint());
}

#[test]
fn a_panic_inside_the_engine_becomes_its_message() {
    let said = guarded::<()>(|| panic!("index {} of {}", 3, 2)).unwrap_err();
    assert_eq!(said, "inference failed: index 3 of 2");
}

#[test]
fn the_engine_recorded_is_the_one_the_manifest_pins() {
    let version = NAME.strip_prefix("tract ").unwrap();
    assert!(include_str!("../../Cargo.toml").contains(&format!("tract-onnx = {{ version = \"={version}\"")));
}
