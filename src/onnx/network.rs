//! Which network a file is, by its inputs and outputs and never by its name.

use sha2::{Digest, Sha256};
use std::fmt::{self, Display};
use std::path::{Path, PathBuf};
use tract_onnx::pb;

/// ONNX's number for 32-bit floats.
const F32: i32 = 1;
/// ONNX's number for 64-bit integers.
pub(super) const I64: i32 = 7;

/// Purpose of a file: the setting that names it, and a description.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Role(pub(super) &'static str, pub(super) &'static str);

impl Role {
    pub const SAM: Role = Role("sam", "the SAM encoder");
    pub const SAM_DECODER: Role = Role("sam_decoder", "the SAM decoder");
    pub const VITMATTE: Role = Role("vitmatte", "the ViTMatte network");
    pub const ALPHA: Role = Role("alpha_net", "the network for alphas");
    pub const LPIPS: Role = Role("lpips", "the network for LPIPS");
}

/// The form of a network: how it is fed and what it answers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Contract {
    /// SAM's image encoder as transformers exports it.
    SamEncoder,
    /// SAM's prompt encoder and mask decoder as transformers exports them.
    SamDecoder {
        /// Whether it takes labels; the oldest exports call every point head.
        labels: bool,
    },
    /// SAM's or MobileSAM's image encoder for the original decoder.
    OriginalEncoder {
        /// Whether it takes the picture `[H,W,3]` in 0..255, and normalizes and pads it itself.
        picture: bool,
    },
    /// The original SAM decoder export.
    OriginalDecoder,
    /// ViTMatte.
    VitMatte,
    /// Any network from a picture to its alpha.
    Alpha,
    /// A network that says how far two pictures are apart.
    Lpips,
}

struct Form {
    contract: Contract,
    role: Role,
    name: &'static str,
    /// Name ("" for any), numbers and extents (0 for any) of each input.
    inputs: &'static [(&'static str, i32, &'static [usize])],
    /// No name: the first output is used.
    outputs: &'static [&'static str],
}

const EMBEDDING: (&str, i32, &[usize]) = ("image_embeddings", F32, &[0, 0, 0, 0]);
const POSITION: (&str, i32, &[usize]) = ("image_positional_embeddings", F32, &[0, 0, 0, 0]);
const POINTS: (&str, i32, &[usize]) = ("input_points", F32, &[0, 0, 0, 2]);

/// A file is the first of these whose inputs and outputs it has.
#[rustfmt::skip]
const FORMS: &[Form] = &[
    Form { contract: Contract::VitMatte, role: Role::VITMATTE, name: "ViTMatte network",
        inputs: &[("pixel_values", F32, &[0, 4, 0, 0])], outputs: &["alphas"] },
    Form { contract: Contract::SamDecoder { labels: true }, role: Role::SAM_DECODER, name: "SAM decoder (split export)",
        inputs: &[POINTS, ("input_labels", I64, &[0, 0, 0]), EMBEDDING, POSITION],
        outputs: &["iou_scores", "pred_masks"] },
    Form { contract: Contract::SamDecoder { labels: false }, role: Role::SAM_DECODER, name: "SAM decoder (split export, without labels)",
        inputs: &[POINTS, EMBEDDING, POSITION], outputs: &["iou_scores", "pred_masks"] },
    Form { contract: Contract::OriginalDecoder, role: Role::SAM_DECODER, name: "SAM decoder (original form)",
        inputs: &[EMBEDDING, ("point_coords", F32, &[0, 0, 2]), ("point_labels", F32, &[0, 0]),
            ("mask_input", F32, &[0, 1, 0, 0]), ("has_mask_input", F32, &[1]), ("orig_im_size", F32, &[2])],
        outputs: &["iou_predictions", "low_res_masks"] },
    Form { contract: Contract::SamEncoder, role: Role::SAM, name: "SAM encoder (split export)",
        inputs: &[("pixel_values", F32, &[0, 3, 0, 0])],
        outputs: &["image_embeddings", "image_positional_embeddings"] },
    Form { contract: Contract::OriginalEncoder { picture: true }, role: Role::SAM,
        name: "SAM encoder (original form, takes the picture)",
        inputs: &[("", F32, &[0, 0, 3])], outputs: &["image_embeddings"] },
    Form { contract: Contract::OriginalEncoder { picture: false }, role: Role::SAM,
        name: "SAM encoder (original form, takes normalized numbers)",
        inputs: &[("", F32, &[1, 3, 0, 0])], outputs: &["image_embeddings"] },
    Form { contract: Contract::Alpha, role: Role::ALPHA, name: "network for alphas",
        inputs: &[("", F32, &[0, 3, 0, 0])], outputs: &[] },
    Form { contract: Contract::Lpips, role: Role::LPIPS, name: "network for LPIPS",
        inputs: &[("", F32, &[0, 3, 0, 0]), ("", F32, &[0, 3, 0, 0])], outputs: &[] },
];

impl Contract {
    fn form(self) -> &'static Form {
        FORMS.iter().find(|f| f.contract == self).unwrap_or(&FORMS[0])
    }

    /// Returns what a network of this form can be named for.
    pub(super) fn role(self) -> Role {
        self.form().role
    }

    /// Returns the outputs that are asked for of a file that has these, in order.
    pub(super) fn outputs(self, given: &[Port]) -> Vec<String> {
        match self.form().outputs {
            [] => given.iter().take(1).map(|port| port.name.clone()).collect(),
            named => named.iter().map(|name| name.to_string()).collect(),
        }
    }
}

impl fmt::Display for Contract {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.form().name)
    }
}

/// An input or output of a network.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Port {
    /// Its name.
    pub name: String,
    /// ONNX's number for what it holds.
    pub kind: i32,
    /// Its extents, `None` where any will do; `None` as a whole when not even the number of axes is
    /// said.
    pub dims: Option<Vec<Option<usize>>>,
}

impl Port {
    pub(super) fn new(about: &pb::ValueInfoProto) -> Port {
        use pb::tensor_shape_proto::dimension::Value::DimValue;
        let value = about.r#type.as_ref().and_then(|t| t.value.as_ref());
        let tensor = value.map(|pb::type_proto::Value::TensorType(tensor)| tensor);
        let extent = |d: &pb::tensor_shape_proto::Dimension| match d.value {
            Some(DimValue(extent)) => usize::try_from(extent).ok().filter(|&e| e > 0),
            _ => None,
        };
        let shape = tensor.and_then(|t| t.shape.as_ref());
        let dims = shape.map(|shape| shape.dim.iter().map(extent).collect());
        Port { name: about.name.clone(), kind: tensor.map_or(0, |t| t.elem_type), dims }
    }

    /// `[1, 3, any, any]`.
    pub fn shape_in_words(&self) -> String {
        self.dims.as_ref().map_or("of any shape".into(), |dims| in_words(dims.iter().copied()))
    }

    /// Extent of one axis, where it is fixed.
    pub fn extent(&self, axis: usize) -> Option<usize> {
        self.dims.as_ref().and_then(|d| d.get(axis).copied().flatten())
    }
}

/// `[1, 3, any, any]`.
pub(super) fn in_words(dims: impl Iterator<Item = Option<usize>>) -> String {
    let each: Vec<String> = dims.map(|d| d.map_or("any".into(), |d| d.to_string())).collect();
    format!("[{}]", each.join(", "))
}

/// Returns the form of a file with these inputs and outputs, or why it is none.
pub(super) fn recognize(inputs: &[Port], outputs: &[Port]) -> Result<Contract, String> {
    let mut near = None;
    let gives = |name: &&str| outputs.iter().any(|p| p.name == **name);
    // an output of any name is recognized by its extents
    let fits = |form: &&Form| match (form.contract, outputs.first().map(|port| &port.dims)) {
        (_, None) => false,
        (Contract::Alpha, Some(Some(dims))) => {
            dims.len() > 2 && dims[..dims.len() - 2].iter().all(|d| d.is_none_or(|d| d == 1))
        }
        _ => form.outputs.iter().all(gives),
    };
    for form in FORMS.iter().filter(fits) {
        match misfit(inputs, form.inputs) {
            None => return Ok(form.contract),
            Some(why) => near = near.or(Some(why)),
        }
    }
    let side = |ports: &[Port]| -> String {
        ports.iter().map(|p| format!("{} {}", p.name, p.shape_in_words())).collect::<Vec<_>>().join(", ")
    };
    let why = near.unwrap_or("its inputs and outputs are those of no known form".into());
    Err(format!("{why} ({} → {})", side(inputs), side(outputs)))
}

/// Returns what keeps these from being exactly the inputs wanted.
fn misfit(inputs: &[Port], wanted: &[(&str, i32, &[usize])]) -> Option<String> {
    for (i, (name, kind, extents)) in wanted.iter().enumerate() {
        let any = inputs.get(i).filter(|_| name.is_empty());
        let Some(port) = any.or_else(|| inputs.iter().find(|p| p.name == *name)) else {
            return Some(format!("it lacks the input `{name}`"));
        };
        let (name, kinds) = (&port.name, pb::tensor_proto::DataType::try_from(port.kind));
        if port.kind != *kind {
            let found = kinds.map_or("unknown numbers".into(), |k| k.as_str_name().to_lowercase());
            return Some(format!("`{name}` takes {found}: use the float32 file"));
        }
        let fits = |dims: &Vec<Option<usize>>| {
            let same = |(d, e): (&Option<usize>, &usize)| d.is_none_or(|d| d == *e || *e == 0);
            dims.len() == extents.len() && dims.iter().zip(*extents).all(same)
        };
        if !port.dims.as_ref().is_none_or(fits) {
            let expected = in_words(extents.iter().map(|&e| (e > 0).then_some(e)));
            return Some(format!("`{name}` is {}, expected {expected}", port.shape_in_words()));
        }
    }
    let more = inputs.iter().find(|p| !wanted.iter().any(|(name, ..)| p.name == *name || name.is_empty()));
    let port = more.or(inputs.get(wanted.len()))?;
    Some(format!("it asks for `{}` too, which no known form has", port.name))
}

/// A file that was loaded, for the record of a run.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct NetworkFile {
    /// The name of the setting that named it: "sam", "sam_decoder", "vitmatte", "alpha_net" or
    /// "lpips".
    pub role: &'static str,
    /// The file as named.
    pub path: PathBuf,
    /// Its size.
    pub bytes: u64,
    /// Its SHA-256 in hexadecimal.
    pub sha256: String,
    /// Recognized kind, and the layout of its inputs.
    pub contract: String,
    /// The engine that runs it, with its version.
    pub engine: String,
}

impl NetworkFile {
    pub(super) fn new(
        role: &'static str,
        path: &Path,
        bytes: &[u8],
        contract: impl Display,
        engine: impl Display,
    ) -> NetworkFile {
        NetworkFile {
            role,
            path: path.into(),
            bytes: bytes.len() as u64,
            sha256: Sha256::digest(bytes).iter().map(|b| format!("{b:02x}")).collect(),
            contract: contract.to_string(),
            engine: engine.to_string(),
        }
    }
}

impl Display for NetworkFile {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let NetworkFile { role, path, bytes, sha256, contract, engine } = self;
        let path = path.display();
        write!(f, "{role}: `{path}`, {bytes} bytes, SHA-256 {sha256}, {contract}; {engine}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn port(name: &str, kind: i32, dims: &[usize]) -> Port {
        let dims = dims.iter().map(|&d| (d > 0).then_some(d)).collect();
        Port { name: name.into(), kind, dims: Some(dims) }
    }

    fn recognized(inputs: Vec<Port>, outputs: &[&str]) -> Result<Contract, String> {
        recognize(&inputs, &outputs.iter().map(|n| port(n, F32, &[])).collect::<Vec<_>>())
    }

    #[test]
    fn both_original_encoders_are_told_by_their_axes() {
        let of = |dims: &[usize]| recognized(vec![port("x", F32, dims)], &["image_embeddings"]);
        assert_eq!(of(&[0, 0, 3]), Ok(Contract::OriginalEncoder { picture: true }));
        assert_eq!(of(&[1, 3, 1024, 1024]), Ok(Contract::OriginalEncoder { picture: false }));
        assert!(of(&[1, 4, 64, 64]).unwrap_err().contains("[1, 4, 64, 64]"));
        let two = vec![port("x", F32, &[0, 0, 3]), port("y", F32, &[0, 0, 3])];
        assert!(recognized(two, &["image_embeddings"]).unwrap_err().contains("`y`"));
    }

    #[test]
    fn half_precision_inputs_and_unknown_inputs_are_named() {
        let half = vec![port("pixel_values", 10, &[0, 4, 0, 0])];
        assert!(recognized(half, &["alphas"]).unwrap_err().contains("float16"));
        let more = vec![port("pixel_values", F32, &[0, 4, 0, 0]), port("style", F32, &[1])];
        assert!(recognized(more, &["alphas"]).unwrap_err().contains("`style`"));
    }

    #[test]
    fn what_gives_one_picture_for_one_is_an_alpha_network_and_for_two_a_measure() {
        let picture = || port("any name", F32, &[0, 3, 0, 0]);
        let of = |inputs: Vec<Port>, output: &[usize]| recognize(&inputs, &[port("y", F32, output)]);
        assert_eq!(of(vec![picture()], &[1, 1, 64, 64]), Ok(Contract::Alpha));
        assert_eq!(of(vec![picture()], &[0, 0, 0]), Ok(Contract::Alpha));
        assert!(of(vec![picture()], &[1, 2, 64, 64]).is_err() && of(vec![picture()], &[1, 1000]).is_err());
        assert_eq!(of(vec![picture(), picture()], &[1, 1, 1, 1]), Ok(Contract::Lpips));
        assert!(of(vec![picture(), port("z", F32, &[0, 4, 0, 0])], &[1]).unwrap_err().contains("`z`"));
        let more = [port("first", F32, &[1, 1, 8, 8]), port("side", F32, &[1, 1, 8, 8])];
        assert_eq!(Contract::Alpha.outputs(&more), ["first"]);
    }

    #[test]
    fn an_encoder_with_the_channels_of_vitmatte_is_neither() {
        let odd = vec![port("pixel_values", F32, &[0, 3, 0, 0])];
        assert!(recognized(odd, &["alphas"]).unwrap_err().contains("expected [any, 4, any, any]"));
    }
}
