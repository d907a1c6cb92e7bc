//! LPIPS (Zhang et al. 2018), by a network that the user brings as an ONNX file: AlexNet or VGG
//! with the published weights, exported with two pictures as its inputs.
//!
//! Its input is `2 c − 1` of colors in 0..1 (`normalize=True` of the published package), rounded to
//! 8 bits. If a network returns a map, its mean counts. Nothing is downloaded.

use super::{picture, rounded};
use crate::onnx::{NetworkArray, NetworkFile, NetworkSession, Role};
use std::path::Path;
use std::sync::{Mutex, PoisonError};
use tiface_base::image::{Image, Photo};
use tiface_base::{Error, Result};

/// A network that measures the perceptual distance of two pictures.
pub struct Lpips {
    /// The network; the lock serializes its runs, because each has arrays of a whole photograph.
    session: Mutex<NetworkSession>,
    file: NetworkFile,
}

impl Lpips {
    /// Opens the network's file, whose arrays may take `memory_gib` each; returns `None` for an
    /// empty path.
    ///
    /// # Errors
    /// Fails if a file cannot be read, is no valid ONNX file, or does not take two pictures.
    pub fn open(path: &Path, memory_gib: f64) -> Result<Option<Lpips>> {
        if path.as_os_str().is_empty() {
            return Ok(None);
        }
        let array_bytes = (memory_gib * f64::from(1u32 << 30)) as u64;
        let session = NetworkSession::open(Role::LPIPS, path, array_bytes)?;
        let file = session.file.clone();
        Ok(Some(Lpips { session: Mutex::new(session), file }))
    }

    /// Returns the record of the loaded network.
    pub fn file(&self) -> &NetworkFile {
        &self.file
    }

    /// Returns the distance of a render from a photograph of its size, 0 for identical ones.
    ///
    /// # Errors
    /// Fails if the network requires another size, fails itself, or returns a non-finite number.
    pub fn distance(&self, render: &Image, photo: &Photo) -> Result<f64> {
        let session = self.session.lock().unwrap_or_else(PoisonError::into_inner);
        let (w, h) = (render.width as usize, render.height as usize);
        for (port, axis, found) in [(0, 2, h), (0, 3, w), (1, 2, h), (1, 3, w)] {
            if session.inputs[port].extent(axis).is_some_and(|fixed| fixed != found) {
                return Err(Error::cannot(
                    format!(
                        "`{}` takes {}, but the view is {w} × {h} pixels",
                        self.file.path.display(),
                        session.inputs[port].shape_in_words()
                    ),
                    "export the network with width and height left open",
                ));
            }
        }
        let names = [session.inputs[0].name.as_str(), session.inputs[1].name.as_str()];
        let pictures = [planes(&rounded(render)), planes(&picture(photo))];
        let inputs: Vec<(&str, NetworkArray)> = names.into_iter().zip(pictures).collect();
        let values = &session.run(&inputs)?[0].values;
        match values.len() {
            0 => Err(session.unusable(names[0], "it is empty")),
            n => Ok(values.iter().map(|&v| f64::from(v)).sum::<f64>() / n as f64),
        }
    }
}

/// Returns `2 c − 1` as `[1, 3, height, width]`.
fn planes(image: &Image) -> NetworkArray {
    let pixels = image.width as usize * image.height as usize;
    let mut values = vec![0.0; 3 * pixels];
    for (i, color) in image.data.chunks_exact(image.channels).enumerate() {
        for c in 0..3 {
            values[c * pixels + i] = 2.0 * color[c] - 1.0;
        }
    }
    NetworkArray::new(&[1, 3, image.height as usize, image.width as usize], values)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::onnx::tests::made::{floats, graph, ints, model, node, port};

    /// LPIPS of one layer in the published form: features `r = relu(W x)`, each pixel's divided by
    /// their length, their squared differences weighted by `l`, averaged over the picture.
    fn network() -> Vec<u8> {
        let weights =
            [floats("w", &[2, 3, 1, 1], &W), floats("l", &[1, 2, 1, 1], &L), floats("ε", &[1], &[1e-10])];
        let axes = |list: &[i64]| [ints("axes", list)];
        let mut nodes = Vec::new();
        for side in ["a", "b"] {
            let name = |what: &str| format!("{what}_{side}");
            nodes.push(node("Conv", &[side, "w"], &[&name("f")], &[]));
            nodes.push(node("Relu", &[&name("f")], &[&name("r")], &[]));
            nodes.push(node("ReduceL2", &[&name("r")], &[&name("n")], &axes(&[1])));
            nodes.push(node("Add", &[&name("n"), "ε"], &[&name("m")], &[]));
            nodes.push(node("Div", &[&name("r"), &name("m")], &[&name("u")], &[]));
        }
        nodes.push(node("Sub", &["u_a", "u_b"], &["d"], &[]));
        nodes.push(node("Mul", &["d", "d"], &["s"], &[]));
        nodes.push(node("Conv", &["s", "l"], &["y"], &[]));
        nodes.push(node("ReduceMean", &["y"], &["distance"], &axes(&[2, 3])));
        let inputs = [port("a", 1, &[1, 3, 0, 0]), port("b", 1, &[1, 3, 0, 0])];
        model(&graph(&nodes, &weights, &inputs, &[port("distance", 1, &[1, 1, 1, 1])]))
    }

    const W: [f32; 6] = [0.5, 0.25, 0.25, -0.3, 0.9, 0.2];
    const L: [f32; 2] = [0.7, 1.3];

    /// Returns the same in f64.
    fn expected(a: &[[u8; 3]], b: &[[u8; 3]]) -> f64 {
        let features = |color: &[u8; 3]| {
            let x = color.map(|v| 2.0 * f64::from(v) / 255.0 - 1.0);
            let r = [0, 1].map(|k| (0..3).map(|c| f64::from(W[3 * k + c]) * x[c]).sum::<f64>().max(0.0));
            let length = r[0].hypot(r[1]) + 1e-10;
            r.map(|v| v / length)
        };
        let one = |(a, b): (&[u8; 3], &[u8; 3])| {
            let (a, b) = (features(a), features(b));
            (0..2).map(|k| f64::from(L[k]) * (a[k] - b[k]).powi(2)).sum::<f64>()
        };
        a.iter().zip(b).map(one).sum::<f64>() / a.len() as f64
    }

    #[test]
    fn a_network_of_the_published_form_gives_its_arithmetic() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("lpips.onnx");
        std::fs::write(&path, network()).unwrap();
        let colors = |step: usize| -> Vec<[u8; 3]> {
            (0..20 * 12).map(|i| [(i * step) as u8, (i * 7 + step) as u8, (250 - i) as u8]).collect()
        };
        let (ours, theirs) = (colors(3), colors(11));
        let mut render = Image::new(20, 12, 4);
        for (pixel, rgb) in render.data.as_chunks_mut::<4>().0.iter_mut().zip(&ours) {
            // a third of a step off: the trip through 8 bits takes it away
            *pixel = [rgb[0], rgb[1], rgb[2], 255].map(|v| (f32::from(v) + 0.3) / 255.0);
        }
        let photo = |rgb: &[[u8; 3]]| Photo { width: 20, height: 12, rgb: rgb.to_vec(), alpha: None };
        let expected = expected(&ours, &theirs);
        assert!(expected > 0.05);
        let lpips = Lpips::open(&path, 1.0).unwrap().unwrap();
        let found = lpips.distance(&render, &photo(&theirs)).unwrap();
        assert!((found - expected).abs() < 1e-6 * expected.max(1.0), "{found} against {expected}");
        assert!(lpips.distance(&render, &photo(&ours)).unwrap() < 1e-9);
    }

    #[test]
    fn a_network_of_one_picture_is_no_lpips() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("alpha.onnx");
        let nodes = [node("ReduceMean", &["x"], &["y"], &[ints("axes", &[1])])];
        let one = graph(&nodes, &[], &[port("x", 1, &[1, 3, 0, 0])], &[port("y", 1, &[1, 1, 0, 0])]);
        std::fs::write(&path, model(&one)).unwrap();
        let Err(e) = Lpips::open(&path, 1.0) else { panic!("it opened") };
        assert!(
            e.to_string().contains("is a network for alphas, but was given as the network for LPIPS"),
            "{e}"
        );
    }
}
