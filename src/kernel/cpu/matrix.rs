//! Matrices of small networks as the matrix blocks of a tile read them: in both orders, padded.

/// A matrix and its transpose, with zeros around.
#[derive(Debug)]
pub struct Matrix {
    /// `[rows, columns]` of the padded sizes.
    pub m: Vec<f32>,
    /// `[columns, rows]` of the padded sizes.
    pub t: Vec<f32>,
}

impl Matrix {
    /// From row-major `values` of shape `[rows, columns]`, grown to the padded shape.
    pub fn new(values: &[f32], (rows, columns): (usize, usize), padded: (usize, usize)) -> Matrix {
        let mut m = vec![0.0; padded.0 * padded.1];
        let mut t = m.clone();
        for r in 0..rows {
            for c in 0..columns {
                m[r * padded.1 + c] = values[r * columns + c];
                t[c * padded.0 + r] = values[r * columns + c];
            }
        }
        Matrix { m, t }
    }
}

/// Returns `values` with zeros behind, `len` in all.
pub fn padded(values: &[f32], len: usize) -> Vec<f32> {
    let mut p = values.to_vec();
    p.resize(len, 0.0);
    p
}

/// Cuts the flat vector of a network's weights into matrices of these shapes.
pub fn split<const N: usize>(mut flat: &[f32], shapes: [(usize, usize); N]) -> [&[f32]; N] {
    shapes
        .map(|(rows, columns)| flat.split_off(..rows * columns).expect("a weight for each of the network's"))
}

/// Adds matrices, whose rows are `stride` floats apart, to those of a flat vector.
pub fn add_to(mut flat: &mut [f32], shapes: &[(usize, usize)], parts: &[(&[f32], usize)]) {
    for (&(rows, columns), &(part, stride)) in shapes.iter().zip(parts) {
        let own = flat.split_off_mut(..rows * columns).expect("a gradient for each weight");
        for (row, g) in own.chunks_exact_mut(columns).zip(part.chunks(stride)) {
            row.iter_mut().zip(g).for_each(|(a, b)| *a += b);
        }
    }
}
