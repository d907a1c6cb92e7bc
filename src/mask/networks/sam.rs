//! SAM: from clicks to a hard mask, with the files of a user (Kirillov et al. 2023; SlimSAM,
//! MobileSAM).
//!
//! ```text
//! photograph: longest side to S, normalize, pad to S × S → encoder → embedding
//! clicks:     times S / longest side
//! embedding, clicks → decoder → logits of S/4 × S/4
//! logits: bilinear to S × S → cut off the padding → bilinear to the photograph → > 0
//! ```
//!
//! The split export pads the prompt itself; the original decoder wants the point (0, 0) with label
//! −1 at the end when no box is given. S and the embedding's width are read from the files.

use super::processor::{self, IMAGENET, Normal};
use crate::mask::clicks::{self, Click};
use crate::onnx::{Contract, NetworkArray, NetworkSession, Role, file_error};
use image::RgbImage;
use image::imageops::{self, FilterType};
use std::path::Path;
use tiface_base::image::{Gray, Photo, bilinear};
use tiface_base::{Error, Result};

/// Pixels of the photograph under one cell of the embedding.
const CELL: usize = 16;
/// The side of every public file, used if neither network nor processor file gives another one.
const USUAL_SIDE: usize = 1024;
/// Clicks on one photograph; each is a token of the decoder.
const MAX_CLICKS: usize = 256;
const EMBEDDING: &str = "image_embeddings";
const POSITION: &str = "image_positional_embeddings";

/// An encoder and a decoder that fit together.
pub(super) struct Sam {
    pub(super) encoder: NetworkSession,
    pub(super) decoder: NetworkSession,
    /// S: the side of the square the encoder sees.
    pub(super) side: usize,
    normal: Normal,
}

/// The encoder's embedding of a photograph, and the photograph's position in the square.
pub(super) struct Embedding {
    /// `image_embeddings`, and for the split export `image_positional_embeddings`.
    arrays: Vec<NetworkArray>,
    /// Width and height inside the square.
    new: (usize, usize),
    /// Width and height of the photograph.
    old: (usize, usize),
}

/// The candidates of the decoder.
pub(super) struct Candidates {
    /// `[candidates]`: how good each thinks it is (estimated IoU).
    pub scores: Vec<f32>,
    /// `[candidates, S/4, S/4]` logits.
    pub logits: Vec<f32>,
    /// Which of them is the mask.
    pub best: usize,
}

impl Sam {
    pub(super) fn open(encoder: &Path, decoder: &Path, array_bytes: u64) -> Result<Sam> {
        let mut encoder = NetworkSession::open(Role::SAM, encoder, array_bytes)?;
        let mut decoder = NetworkSession::open(Role::SAM_DECODER, decoder, array_bytes)?;
        let mismatch = |problem: String| {
            let problem = format!("does not fit to `{}`: {problem}", decoder.file.path.display());
            Err(file_error(&encoder.file.path, &problem, "take encoder and decoder from the same export"))
        };
        if matches!(encoder.contract, Contract::OriginalEncoder { .. })
            && matches!(decoder.contract, Contract::SamDecoder { .. })
        {
            return mismatch(format!("the decoder wants `{POSITION}`, which the encoder does not give"));
        }
        let processor = processor::find(&encoder.file.path, "sam")?;
        let takes = &encoder.inputs[0];
        if takes.extent(2).zip(takes.extent(3)).is_some_and(|(rows, columns)| rows != columns) {
            return mismatch(format!("the encoder's input {} is not square", takes.shape_in_words()));
        }
        let fixed = match encoder.contract {
            Contract::OriginalEncoder { picture: true } => None,
            _ => takes.extent(2).or(takes.extent(3)),
        };
        let grid = decoder.input_extent(EMBEDDING, 2).or(decoder.input_extent(EMBEDDING, 3));
        let side = fixed
            .or(processor.as_ref().and_then(|p| p.side))
            .or(grid.map(|g| g.saturating_mul(CELL)))
            .unwrap_or(USUAL_SIDE);
        if !side.is_multiple_of(CELL) || !(64..=4096).contains(&side) {
            return mismatch(format!("the side is {side} pixels, expected a multiple of 16 from 64 to 4096"));
        }
        if let Some(grid) = grid.filter(|g| g.saturating_mul(CELL) != side) {
            let cells = side / CELL;
            return mismatch(format!(
                "the encoder makes {cells} × {cells} cells, the decoder takes {grid} × {grid}"
            ));
        }
        for session in [&mut encoder, &mut decoder] {
            session.file.contract += &format!(", {side} pixels a side");
        }
        let normal = processor.map_or(IMAGENET, |p| p.normal);
        Ok(Sam { encoder, decoder, side, normal })
    }

    /// Width and height of a photograph inside the square: longest side S, the other rounded.
    pub(super) fn fitted(&self, width: usize, height: usize) -> (usize, usize) {
        let scale = self.side as f64 / width.max(height) as f64;
        let fit = |old: usize| ((old as f64 * scale + 0.5) as usize).clamp(1, self.side);
        (fit(width), fit(height))
    }

    /// Returns the photograph as the encoder takes it.
    pub(super) fn pixels(&self, photo: &Photo) -> NetworkArray {
        let (w, h) = self.fitted(photo.width as usize, photo.height as usize);
        let rgb = resized(photo, w, h);
        if let Contract::OriginalEncoder { picture: true } = self.encoder.contract {
            return NetworkArray::new(&[h, w, 3], rgb.iter().flatten().map(|&v| f32::from(v)).collect());
        }
        normalized(&rgb, w, self.side, &self.normal)
    }

    /// Runs the encoder.
    pub(super) fn embed(&self, photo: &Photo) -> Result<Embedding> {
        let old = (photo.width as usize, photo.height as usize);
        let pixels = self.pixels(photo);
        let arrays = self.encoder.run(&[(&self.encoder.inputs[0].name, pixels)])?;
        let (cells, depth) = (Some(self.side / CELL), self.decoder.input_extent(EMBEDDING, 1));
        for (i, array) in arrays.iter().enumerate() {
            self.encoder.expect(i, array, &[Some(1), depth, cells, cells])?;
        }
        Ok(Embedding { arrays, new: self.fitted(old.0, old.1), old })
    }

    /// Returns the decoder's inputs for these clicks.
    pub(super) fn prompt(
        &self,
        embedding: &Embedding,
        clicks: &[Click],
    ) -> Vec<(&'static str, NetworkArray)> {
        let (new, old) = (embedding.new, embedding.old);
        let (sx, sy) = (new.0 as f64 / old.0 as f64, new.1 as f64 / old.1 as f64);
        let placed = |c: &Click| [(f64::from(c.x) * sx) as f32, (f64::from(c.y) * sy) as f32];
        let mut points: Vec<f32> = clicks.iter().flat_map(placed).collect();
        let array = |i: usize| embedding.arrays[i].clone();
        let label = |c: &Click| f32::from(u8::from(c.head));
        let n = clicks.len();
        if let Contract::SamDecoder { labels } = self.decoder.contract {
            let mut inputs = vec![
                ("input_points", NetworkArray::new(&[1, 1, n, 2], points)),
                (EMBEDDING, array(0)),
                (POSITION, array(1)),
            ];
            if labels {
                inputs.push((
                    "input_labels",
                    NetworkArray::new(&[1, 1, n], clicks.iter().map(label).collect()),
                ));
            }
            return inputs;
        }
        // no box: the original code fills its place with this point
        points.extend([0.0, 0.0]);
        let labels = clicks.iter().map(label).chain([-1.0]).collect();
        let quarter = self.side / 4;
        vec![
            (EMBEDDING, array(0)),
            ("point_coords", NetworkArray::new(&[1, n + 1, 2], points)),
            ("point_labels", NetworkArray::new(&[1, n + 1], labels)),
            ("mask_input", NetworkArray::new(&[1, 1, quarter, quarter], vec![0.0; quarter * quarter])),
            ("has_mask_input", NetworkArray::new(&[1], vec![0.0])),
            ("orig_im_size", NetworkArray::new(&[2], vec![old.1 as f32, old.0 as f32])),
        ]
    }

    /// Runs the decoder.
    pub(super) fn decode(&self, embedding: &Embedding, clicks: &[Click]) -> Result<Candidates> {
        self.check(clicks, embedding.old)?;
        let given = self.decoder.run(&self.prompt(embedding, clicks))?;
        let [scores, logits] = <[NetworkArray; 2]>::try_from(given)
            .map_err(|_| self.decoder.unusable("masks", "the engine left outputs out"))?;
        let split = matches!(self.decoder.contract, Contract::SamDecoder { .. });
        let lead = if split { vec![Some(1); 2] } else { vec![Some(1)] };
        let quarter = Some(self.side / 4);
        self.decoder.expect(0, &scores, &[&lead[..], &[None]].concat())?;
        self.decoder.expect(
            1,
            &logits,
            &[&lead[..], &[Some(scores.values.len()), quarter, quarter]].concat(),
        )?;
        let best =
            if split { highest(&scores.values, 0) } else { best_of_original(&scores.values, clicks.len()) };
        Ok(Candidates { scores: scores.values, logits: logits.values, best })
    }

    /// One candidate's logits on the photograph's pixels; `[height · width]`.
    pub(super) fn on_photo(&self, embedding: &Embedding, candidates: &Candidates, which: usize) -> Vec<f32> {
        let quarter = self.side / 4;
        let small = &candidates.logits[which * quarter * quarter..][..quarter * quarter];
        enlarged(small, quarter, self.side, embedding.new, embedding.old)
    }

    /// Returns the hard mask (0 or 255) and its score.
    pub(super) fn segment(&self, photo: &Photo, clicks: &[Click]) -> Result<(Gray, f32)> {
        // before the slow part
        self.check(clicks, (photo.width as usize, photo.height as usize))?;
        let embedding = self.embed(photo)?;
        let candidates = self.decode(&embedding, clicks)?;
        let logits = self.on_photo(&embedding, &candidates, candidates.best);
        let values = logits.iter().map(|&l| if l > 0.0 { 255 } else { 0 }).collect();
        let mask = Gray { width: photo.width, height: photo.height, values };
        Ok((mask, candidates.scores[candidates.best]))
    }

    fn check(&self, clicks: &[Click], (width, height): (usize, usize)) -> Result<()> {
        // contradictions are searched at the size that was clicked on: reduced, two clicks may
        // share a pixel
        clicks::check_places("the photograph", clicks, width as u32, height as u32)?;
        if clicks.len() > MAX_CLICKS {
            return Err(Error::cannot(
                format!("the photograph has {} clicks, the limit is {MAX_CLICKS}", clicks.len()),
                format!("keep the {MAX_CLICKS} that matter most"),
            ));
        }
        let behind = clicks.iter().position(|c| !c.head);
        match behind.filter(|_| self.decoder.contract == (Contract::SamDecoder { labels: false })) {
            None => Ok(()),
            Some(i) => Err(file_error(
                &self.decoder.file.path,
                &format!("takes no labels, but click {} is on the background", i + 1),
                "use a decoder with `input_labels`, or leave the clicks on the background out",
            )),
        }
    }
}

/// Returns the photograph's colors at `width` × `height`, antialiased bilinear, as SAM's processors
/// resize.
pub(super) fn resized(photo: &Photo, width: usize, height: usize) -> Vec<[u8; 3]> {
    let picture = RgbImage::from_raw(photo.width, photo.height, photo.rgb.as_flattened().to_vec())
        .expect("as many colors as pixels, as checked");
    let resized = imageops::resize(&picture, width as u32, height as u32, FilterType::Triangle);
    resized.as_chunks::<3>().0.to_vec()
}

/// Logits of `quarter` × `quarter` at the `side` of the square, then without its padding at the
/// photograph's size: both bilinear, as PyTorch's without antialiasing.
pub(super) fn enlarged(
    logits: &[f32],
    quarter: usize,
    side: usize,
    new: (usize, usize),
    old: (usize, usize),
) -> Vec<f32> {
    let size = |(w, h): (usize, usize)| (w as u32, h as u32);
    let (quarter, side) = (quarter as u32, side as u32);
    let square = bilinear(logits, quarter, (quarter, quarter), (side, side), |v| v);
    bilinear(&square, side, size(new), size(old), |v| v)
}

/// `[1, 3, side, side]`: normalized colors in the upper left, zeros right and below.
pub(super) fn normalized(rgb: &[[u8; 3]], width: usize, side: usize, normal: &Normal) -> NetworkArray {
    NetworkArray::new(&[1, 3, side, side], normal.planes(rgb, width, (side, side), 3))
}

/// Returns the first of the highest scores from `begin` on.
fn highest(scores: &[f32], begin: usize) -> usize {
    (begin..scores.len()).fold(begin, |best, i| if scores[i] > scores[best] { i } else { best })
}

/// Returns the index of the mask to use. The original decoder gives one mask for several points and
/// three for one: with two or more clicks the first is meant, with one the best of the others.
fn best_of_original(scores: &[f32], clicks: usize) -> usize {
    match scores.len() {
        4 if clicks >= 2 => 0,
        4 => highest(scores, 1),
        _ => highest(scores, 0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halving_averages_over_a_triangle_four_pixels_wide() {
        // new pixel 0 lies at 1, reach 2: old 0.5, 1.5, 2.5 weigh 0.75, 0.75, 0.25 of 1.75
        // 0 · 0.43 + 70 · 0.43 + 140 · 0.14 = 50; new pixel 1 mirrors it: 0.25, 0.75, 0.75 → 160
        let line = |values: &[u8]| {
            let rgb = values.iter().map(|&v| [v; 3]).collect();
            Photo { width: values.len() as u32, height: 1, rgb, alpha: None }
        };
        assert_eq!(resized(&line(&[0, 70, 140, 210]), 2, 1), [[50; 3], [160; 3]]);
        // quarter pixels, the edge repeated
        assert_eq!(resized(&line(&[0, 100]), 4, 1), [[0; 3], [25; 3], [75; 3], [100; 3]]);
    }

    #[test]
    fn the_best_of_four_depends_on_how_many_clicks_there_were() {
        let scores = [0.9, 0.2, 0.8, 0.8];
        assert_eq!(best_of_original(&scores, 2), 0);
        assert_eq!(best_of_original(&scores, 1), 2);
        assert_eq!(best_of_original(&scores[1..], 5), 1);
        assert_eq!(best_of_original(&scores[..1], 1), 0);
    }

    #[test]
    fn normalized_colors_lie_in_the_corner_and_zeros_around_them() {
        // 2 × 1 pixels in a square of 3: red (255 − 0.485 · 255) / (0.229 · 255) = 2.2489
        let tensor = normalized(&[[255, 0, 0], [0, 0, 0]], 2, 3, &IMAGENET);
        let values = tensor.values;
        assert!((values[0] - 2.248_908).abs() < 1e-5 && (values[1] + 2.117_904).abs() < 1e-5);
        assert_eq!(values[2..9], [0.0; 7]);
    }
}
