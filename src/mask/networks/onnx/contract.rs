//! Which network a file is, by its inputs and outputs and never by its name.
//!
//! | form | inputs → outputs |
//! | --- | --- |
//! | split SAM encoder | `pixel_values` `[B,3,S,S]` → `image_embeddings`, `image_positional_embeddings` |
//! | split SAM decoder | `input_points`, `input_labels` (absent in the oldest), both embeddings → `iou_scores`, `pred_masks` |
//! | original encoder | a picture `[H,W,3]` 0..255, or normalised `[1,3,S,S]` → `image_embeddings` |
//! | original decoder | `image_embeddings`, `point_coords`, `point_labels`, `mask_input`, `has_mask_input`, `orig_im_size` → `iou_predictions`, `low_res_masks` |
//! | ViTMatte | `pixel_values` `[B,4,H,W]` → `alphas` `[B,1,H,W]` |

use super::scan::{Interface, Kind, Port};
use std::fmt;

/// The form of a network: how it is fed and what it answers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Contract {
    /// SAM's image encoder as transformers exports it.
    SamEncoder,
    /// SAM's prompt encoder and mask decoder as transformers exports them.
    SamDecoder {
        /// Does it take labels? The oldest exports call every point head.
        labels: bool,
    },
    /// SAM's or MobileSAM's image encoder for the original decoder.
    OriginalEncoder {
        /// Does it take the picture `[H,W,3]` in 0..255, and normalise and pad inside?
        picture: bool,
    },
    /// The original SAM decoder export.
    OriginalDecoder,
    /// ViTMatte.
    VitMatte,
}

impl fmt::Display for Contract {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Contract::SamEncoder => "SAM encoder (split export)",
            Contract::SamDecoder { labels: true } => "SAM decoder (split export)",
            Contract::SamDecoder { labels: false } => "SAM decoder (split export, without labels)",
            Contract::OriginalEncoder { picture: true } => "SAM encoder (original form, takes the picture)",
            Contract::OriginalEncoder { picture: false } => {
                "SAM encoder (original form, takes normalised numbers)"
            }
            Contract::OriginalDecoder => "SAM decoder (original form)",
            Contract::VitMatte => "ViTMatte network",
        })
    }
}

/// One input a form has: its name, what numbers, which fixed extents (0: any).
struct Want(&'static str, Kind, &'static [u64]);

const EMBEDDING: Want = Want("image_embeddings", Kind::F32, &[0, 0, 0, 0]);
const POSITION: Want = Want("image_positional_embeddings", Kind::F32, &[0, 0, 0, 0]);
const POINTS: Want = Want("input_points", Kind::F32, &[0, 0, 0, 2]);

/// The form of a file with this interface, or why it is none.
pub fn recognise(interface: &Interface) -> Result<Contract, String> {
    let has = |name: &str| interface.inputs.iter().any(|p| p.name == name);
    let gives = |name: &str| interface.outputs.iter().any(|p| p.name == name);
    if gives("alphas") && has("pixel_values") {
        fits(&interface.inputs, &[Want("pixel_values", Kind::F32, &[0, 4, 0, 0])])?;
        return Ok(Contract::VitMatte);
    }
    if gives("pred_masks") && has("input_points") {
        promises(interface, &["iou_scores"])?;
        let labels = has("input_labels");
        let mut wanted = vec![POINTS, EMBEDDING, POSITION];
        if labels {
            wanted.push(Want("input_labels", Kind::I64, &[0, 0, 0]));
        }
        fits(&interface.inputs, &wanted)?;
        return Ok(Contract::SamDecoder { labels });
    }
    if gives("low_res_masks") || (gives("iou_predictions") && has("point_coords")) {
        promises(interface, &["low_res_masks", "iou_predictions"])?;
        let wanted = [
            EMBEDDING,
            Want("point_coords", Kind::F32, &[0, 0, 2]),
            Want("point_labels", Kind::F32, &[0, 0]),
            Want("mask_input", Kind::F32, &[0, 1, 0, 0]),
            Want("has_mask_input", Kind::F32, &[1]),
            Want("orig_im_size", Kind::F32, &[2]),
        ];
        fits(&interface.inputs, &wanted)?;
        return Ok(Contract::OriginalDecoder);
    }
    if gives("image_embeddings") && gives("image_positional_embeddings") && has("pixel_values") {
        fits(&interface.inputs, &[Want("pixel_values", Kind::F32, &[0, 3, 0, 0])])?;
        return Ok(Contract::SamEncoder);
    }
    if gives("image_embeddings")
        && let [input] = interface.inputs.as_slice()
    {
        return original_encoder(input);
    }
    Err("its inputs and outputs are those of no known form".into())
}

fn original_encoder(input: &Port) -> Result<Contract, String> {
    let Some(dims) = &input.dims else {
        return Err(format!("`{}` does not say how many axes it has", input.name));
    };
    let any = |d: Option<u64>, wanted: u64| d.is_none_or(|d| d == wanted);
    if input.kind != Kind::F32 {
        return Err(format!("`{}` takes {}, not float32", input.name, input.kind));
    }
    match dims.as_slice() {
        [_, _, c] if any(*c, 3) => Ok(Contract::OriginalEncoder { picture: true }),
        [b, c, _, _] if any(*b, 1) && any(*c, 3) => Ok(Contract::OriginalEncoder { picture: false }),
        _ => Err(format!("`{}` is {}, neither [H,W,3] nor [1,3,S,S]", input.name, input.shape_in_words())),
    }
}

fn promises(interface: &Interface, outputs: &[&str]) -> Result<(), String> {
    match outputs.iter().find(|name| !interface.outputs.iter().any(|p| p.name == **name)) {
        Some(name) => Err(format!("it lacks the output `{name}`")),
        None => Ok(()),
    }
}

/// Are these exactly the inputs wanted?
fn fits(inputs: &[Port], wanted: &[Want]) -> Result<(), String> {
    for Want(name, kind, extents) in wanted {
        let Some(port) = inputs.iter().find(|p| p.name == *name) else {
            return Err(format!("it lacks the input `{name}`"));
        };
        if port.kind != *kind {
            return Err(format!("`{name}` takes {}, not {kind}: use the float32 file", port.kind));
        }
        let Some(dims) = &port.dims else { continue };
        let same = dims.len() == extents.len()
            && dims.iter().zip(*extents).all(|(d, e)| d.is_none_or(|d| d == *e || *e == 0));
        if !same {
            let words: Vec<String> =
                extents.iter().map(|e| if *e == 0 { "any".into() } else { e.to_string() }).collect();
            return Err(format!("`{name}` is {}, expected [{}]", port.shape_in_words(), words.join(", ")));
        }
    }
    match inputs.iter().find(|p| !wanted.iter().any(|w| w.0 == p.name)) {
        Some(port) => Err(format!("it asks for `{}` too, which no known form has", port.name)),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn port(name: &str, kind: Kind, dims: &[u64]) -> Port {
        let dims = dims.iter().map(|&d| (d > 0).then_some(d)).collect();
        Port { name: name.into(), kind, dims: Some(dims) }
    }

    fn interface(inputs: Vec<Port>, outputs: &[&str]) -> Interface {
        let outputs = outputs.iter().map(|n| port(n, Kind::F32, &[])).collect();
        Interface { inputs, outputs, ..Interface::default() }
    }

    #[test]
    fn both_original_encoders_are_told_by_their_axes() {
        let of =
            |dims: &[u64]| recognise(&interface(vec![port("x", Kind::F32, dims)], &["image_embeddings"]));
        assert_eq!(of(&[0, 0, 3]), Ok(Contract::OriginalEncoder { picture: true }));
        assert_eq!(of(&[1, 3, 1024, 1024]), Ok(Contract::OriginalEncoder { picture: false }));
        assert!(of(&[1, 4, 64, 64]).unwrap_err().contains("[1, 4, 64, 64]"));
    }

    #[test]
    fn half_precision_inputs_and_unknown_inputs_are_named() {
        let half = interface(vec![port("pixel_values", Kind::F16, &[0, 4, 0, 0])], &["alphas"]);
        assert!(recognise(&half).unwrap_err().contains("float16"));
        let more = vec![port("pixel_values", Kind::F32, &[0, 4, 0, 0]), port("style", Kind::F32, &[1])];
        assert!(recognise(&interface(more, &["alphas"])).unwrap_err().contains("`style`"));
    }

    #[test]
    fn an_encoder_with_the_channels_of_vitmatte_is_neither() {
        let odd = interface(vec![port("pixel_values", Kind::F32, &[0, 3, 0, 0])], &["alphas"]);
        assert!(recognise(&odd).unwrap_err().contains("expected [any, 4, any, any]"));
    }
}
