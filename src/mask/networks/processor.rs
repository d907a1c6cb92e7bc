//! `preprocessor_config.json`: the preparation of pictures that a network's publisher declares next
//! to its file.
//!
//! It is searched in the folder of the network's file, and in the parent of a folder called `onnx`,
//! as in public collections. A file of another network's processor is ignored.

use crate::onnx::file_error;
use serde::Deserialize;
use serde_json::Value;
use std::path::Path;
use tiface_base::Result;
use tiface_base::io::{self, Limits};

/// Mean and standard deviation of ImageNet's colors in 0..1: what SAM and ViTMatte were trained
/// with.
pub(super) const IMAGENET: Normal = Normal { mean: [0.485, 0.456, 0.406], std: [0.229, 0.224, 0.225] };

/// Normalization of colors: `(c / 255 − mean) / std`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Normal {
    /// Of red, green, blue in 0..1.
    pub mean: [f64; 3],
    /// Of red, green, blue in 0..1; positive.
    pub std: [f64; 3],
}

impl Normal {
    /// Planes `[channels, height, width]`: normalized colors of a picture `from` wide in the upper
    /// left of the first three, zeros elsewhere.
    pub(super) fn planes(
        &self,
        rgb: &[[u8; 3]],
        from: usize,
        (width, height): (usize, usize),
        channels: usize,
    ) -> Vec<f32> {
        let mut planes = vec![0.0; channels * width * height];
        for (i, color) in rgb.iter().enumerate() {
            let at = i / from * width + i % from;
            for c in 0..3 {
                let coded = f64::from(color[c]) / 255.0;
                planes[c * width * height + at] = ((coded - self.mean[c]) / self.std[c]) as f32;
            }
        }
        planes
    }
}

/// The content of a processor file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Processor {
    /// Its normalization.
    pub normal: Normal,
    /// Side of the square (`pad_size`, else `size.longest_edge`, `size.height` or
    /// `size.shortest_edge`), if given.
    pub side: Option<usize>,
}

/// The file; sizes have many forms, of which two are read.
#[derive(Default, Deserialize)]
#[serde(default)]
struct ProcessorFile {
    image_mean: Option<[f64; 3]>,
    image_std: Option<[f64; 3]>,
    pad_size: Value,
    size: Value,
}

/// Returns the processor file of the network at `network`, `None` without one, or if it is of
/// another network than `kind` ("sam", "vitmatte", or empty for any).
pub(super) fn find(network: &Path, kind: &str) -> Result<Option<Processor>> {
    const NAME: &str = "preprocessor_config.json";
    let folder = network.parent().unwrap_or(Path::new(""));
    let mut places = vec![folder.join(NAME)];
    if folder.file_name().is_some_and(|n| n == "onnx") {
        places.extend(folder.parent().map(|above| above.join(NAME)));
    }
    let Some(path) = places.into_iter().find(|p| io::is_file(p)) else { return Ok(None) };
    let wrong = |problem: String| {
        let hint = "take the processor file of the same export, or remove it: then the network's published numbers hold";
        file_error(&path, &format!("is unusable: {problem}"), hint)
    };
    let json = io::read_json(&path, &Limits { json_bytes: 1 << 20, ..Limits::default() })?;
    let types = ["image_processor_type", "feature_extractor_type", "processor_class"];
    let mut types = types.into_iter().filter_map(|key| json[key].as_str()).map(str::to_lowercase).peekable();
    if types.peek().is_some() && !types.any(|name| name.starts_with(kind)) {
        return Ok(None);
    }
    let file: ProcessorFile = io::typed(&json)
        .map_err(|[key, found, expected]| wrong(format!("`{key}` is {found}, expected {expected}")))?;
    let three = |key: &str, numbers: Option<[f64; 3]>, usual: [f64; 3], min: f64| {
        let numbers = numbers.unwrap_or(usual);
        match numbers.iter().all(|v| (min..=1.0).contains(v)) {
            true => Ok(numbers),
            false => Err(wrong(format!("`{key}` is {numbers:?}, expected three numbers of colors in 0..1"))),
        }
    };
    let mean = three("image_mean", file.image_mean, IMAGENET.mean, 0.0)?;
    let std = three("image_std", file.image_std, IMAGENET.std, 1e-3)?;
    let said = |key: &str| file.size[key].as_u64();
    let side = file.pad_size["height"].as_u64().or(said("longest_edge"));
    let side = side.or(said("height").or(said("shortest_edge")).filter(|_| kind.is_empty()));
    let used = kind != "vitmatte";
    if let Some(side) = side.filter(|side| used && (side % 16 != 0 || !(64..=4096).contains(side))) {
        return Err(wrong(format!("the side is {side}, expected a multiple of 16 from 64 to 4096")));
    }
    let side = side.and_then(|side| usize::try_from(side).ok());
    Ok(Some(Processor { normal: Normal { mean, std }, side }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    fn at(text: &str, kind: &str) -> Result<Option<Processor>> {
        let dir = tempfile::tempdir().unwrap();
        fs::write(dir.path().join("preprocessor_config.json"), text).unwrap();
        find(&dir.path().join("x.onnx"), kind)
    }

    #[test]
    fn the_side_and_the_colors_are_read() {
        let text =
            r#"{"image_mean": [0.5, 0.5, 0.5], "image_std": [0.5, 0.5, 0.25], "pad_size": {"height": 256}}"#;
        let found = at(text, "sam").unwrap().unwrap();
        assert_eq!(found.side, Some(256));
        assert_eq!(found.normal, Normal { mean: [0.5; 3], std: [0.5, 0.5, 0.25] });
    }

    #[test]
    fn the_file_of_the_other_network_is_not_obeyed() {
        let text = r#"{"image_processor_type": "SamImageProcessor", "image_mean": [0.1, 0.1, 0.1]}"#;
        assert_eq!(at(text, "vitmatte").unwrap(), None);
        assert!(at(text, "sam").unwrap().is_some());
        // whatever else it holds
        let text =
            r#"{"image_processor_type": "SegformerImageProcessor", "processor_class": 3, "image_std": "no"}"#;
        assert_eq!(at(text, "sam").unwrap(), None);
    }

    #[test]
    fn impossible_numbers_are_an_error_with_the_key() {
        for text in [
            r#"{"image_std": [0, 0.2, 0.2]}"#,
            r#"{"image_mean": [0.5, 0.5]}"#,
            r#"{"image_mean": "0.5"}"#,
            r#"{"image_mean": [1, "x", 0.5, 0.5]}"#,
            r#"{"pad_size": {"height": 1000}}"#,
        ] {
            let error = at(text, "sam").unwrap_err();
            assert!(error.to_string().contains("preprocessor_config.json` is unusable"), "{error}");
        }
        assert!(at("{", "sam").unwrap_err().to_string().contains("preprocessor_config.json"));
    }

    #[test]
    fn the_folder_above_counts_only_from_a_folder_called_onnx() {
        let dir = tempfile::tempdir().unwrap();
        fs::write(dir.path().join("preprocessor_config.json"), "{}").unwrap();
        for (folder, is_found) in [("onnx", true), ("weights", false)] {
            fs::create_dir(dir.path().join(folder)).unwrap();
            let found = find(&dir.path().join(folder).join("model.onnx"), "sam").unwrap();
            assert_eq!(found.is_some(), is_found);
        }
    }
}
