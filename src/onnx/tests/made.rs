//! Small ONNX files written by hand, byte by byte: valid ones of each form, and hostile ones.

/// A message of Protocol Buffers under construction.
#[derive(Clone, Default)]
pub(crate) struct Message(pub Vec<u8>);

fn varint(mut v: u64) -> Vec<u8> {
    let mut bytes = Vec::new();
    while v >= 0x80 {
        bytes.push((v & 0x7f) as u8 | 0x80);
        v >>= 7;
    }
    bytes.push(v as u8);
    bytes
}

impl Message {
    pub(crate) fn new() -> Message {
        Message::default()
    }

    pub(crate) fn int(mut self, field: u32, v: i64) -> Message {
        self.0.extend(varint(u64::from(field) << 3));
        self.0.extend(varint(v as u64));
        self
    }

    pub(crate) fn bytes(mut self, field: u32, bytes: &[u8]) -> Message {
        self.0.extend(varint(u64::from(field) << 3 | 2));
        self.0.extend(varint(bytes.len() as u64));
        self.0.extend(bytes);
        self
    }

    pub(crate) fn text(self, field: u32, text: &str) -> Message {
        self.bytes(field, text.as_bytes())
    }

    pub(crate) fn message(self, field: u32, message: &Message) -> Message {
        self.bytes(field, &message.0)
    }

    pub(crate) fn messages(self, field: u32, messages: &[Message]) -> Message {
        messages.iter().fold(self, |m, each| m.message(field, each))
    }
}

/// An input or output: name, ONNX type, extents (0: any).
pub(crate) fn port(name: &str, kind: i64, dims: &[i64]) -> Message {
    let shape = dims.iter().fold(Message::new(), |shape, &d| {
        let dim = if d > 0 { Message::new().int(1, d) } else { Message::new().text(2, "any") };
        shape.message(1, &dim)
    });
    let tensor = Message::new().int(1, kind).message(2, &shape);
    Message::new().text(1, name).message(2, &Message::new().message(1, &tensor))
}

/// The head of a tensor: name, ONNX type, extents.
pub(crate) fn tensor(name: &str, kind: i64, dims: &[i64]) -> Message {
    dims.iter().fold(Message::new(), |m, &d| m.int(1, d)).int(2, kind).text(8, name)
}

pub(crate) fn floats(name: &str, dims: &[i64], values: &[f32]) -> Message {
    let raw: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
    tensor(name, 1, dims).bytes(9, &raw)
}

pub(crate) fn integers(name: &str, values: &[i64]) -> Message {
    let raw: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
    tensor(name, 7, &[values.len() as i64]).bytes(9, &raw)
}

pub(crate) fn node(op: &str, inputs: &[&str], outputs: &[&str], attributes: &[Message]) -> Message {
    let m = inputs.iter().fold(Message::new(), |m, name| m.text(1, name));
    let m = outputs.iter().fold(m, |m, name| m.text(2, name));
    m.text(3, &format!("{}_{}", op.to_lowercase(), outputs.join("_"))).text(4, op).messages(5, attributes)
}

/// One integer without axes.
pub(crate) fn integer(name: &str, value: i64) -> Message {
    tensor(name, 7, &[]).bytes(9, &value.to_le_bytes())
}

/// An attribute that is an integer.
pub(crate) fn int(name: &str, value: i64) -> Message {
    Message::new().text(1, name).int(3, value).int(20, 2)
}

/// An attribute that is a list of integers.
pub(crate) fn ints(name: &str, values: &[i64]) -> Message {
    values.iter().fold(Message::new().text(1, name), |m, &v| m.int(8, v)).int(20, 7)
}

/// An attribute that is a graph.
pub(crate) fn graph_attribute(name: &str, graph: &Message) -> Message {
    Message::new().text(1, name).message(6, graph).int(20, 5)
}

pub(crate) fn graph(
    nodes: &[Message],
    weights: &[Message],
    inputs: &[Message],
    outputs: &[Message],
) -> Message {
    Message::new()
        .messages(1, nodes)
        .text(2, "g")
        .messages(5, weights)
        .messages(11, inputs)
        .messages(12, outputs)
}

/// A whole file of opset 12.
pub(crate) fn model(graph: &Message) -> Vec<u8> {
    let opset = Message::new().text(1, "").int(2, 12);
    Message::new().int(1, 7).text(2, "by hand").message(7, graph).message(8, &opset).0
}

pub(crate) fn vitmatte_ports() -> (Vec<Message>, Vec<Message>) {
    (vec![port("pixel_values", 1, &[0, 4, 0, 0])], vec![port("alphas", 1, &[0, 1, 0, 0])])
}

/// A network of ViTMatte's form with these nodes and weights.
pub(crate) fn vitmatte(nodes: &[Message], weights: &[Message]) -> Vec<u8> {
    let (inputs, outputs) = vitmatte_ports();
    model(&graph(nodes, weights, &inputs, &outputs))
}

/// A valid network of ViTMatte's form: alpha is the weight of the trimap channel times it, 1 × 1.
pub(crate) fn trimap_times(weight: f32) -> Vec<u8> {
    let weights = [floats("w", &[1, 4, 1, 1], &[0.0, 0.0, 0.0, weight])];
    vitmatte(&[node("Conv", &["pixel_values", "w"], &["alphas"], &[])], &weights)
}

/// An encoder of the original form: means of 16 × 16 pixels, mixed into `depth` channels by weights
/// 0, 1, 2 …. `picture`: takes `[H,W,3]`, which must be the whole square; else `[1,3,side,side]`.
pub(crate) fn original_encoder(picture: bool, side: i64, depth: i64) -> Vec<u8> {
    let weights: Vec<f32> = (0..depth * 3).map(|i| i as f32 / (depth * 3) as f32).collect();
    let weights = [floats("w", &[depth, 3, 1, 1], &weights)];
    let mut nodes = Vec::new();
    let square = if picture {
        nodes.push(node("Transpose", &["input_image"], &["chw"], &[ints("perm", &[2, 0, 1])]));
        nodes.push(node("Unsqueeze", &["chw"], &["nchw"], &[ints("axes", &[0])]));
        "nchw"
    } else {
        "input_image"
    };
    let pool = [ints("kernel_shape", &[16, 16]), ints("strides", &[16, 16])];
    nodes.push(node("AveragePool", &[square], &["cells"], &pool));
    nodes.push(node("Conv", &["cells", "w"], &["image_embeddings"], &[]));
    let dims: &[i64] = if picture { &[0, 0, 3] } else { &[1, 3, side, side] };
    let output = port("image_embeddings", 1, &[1, depth, side / 16, side / 16]);
    model(&graph(&nodes, &weights, &[port("input_image", 1, dims)], &[output]))
}

/// A network that gives `weight · mean of the channels + bias`, and something of its training
/// beside it.
pub(crate) fn brightness(side: i64, weight: f32, bias: f32) -> Vec<u8> {
    let weights = [floats("w", &[1, 3, 1, 1], &[weight / 3.0; 3]), floats("b", &[1], &[bias])];
    let nodes = [
        node("Conv", &["picture", "w", "b"], &["alpha"], &[]),
        node("Identity", &["picture"], &["features"], &[]),
    ];
    let outputs = [port("alpha", 1, &[1, 1, side, side]), port("features", 1, &[1, 3, side, side])];
    model(&graph(&nodes, &weights, &[port("picture", 1, &[1, 3, side, side])], &outputs))
}
