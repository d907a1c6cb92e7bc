//! Matrices of small networks: zero-padded to the size of the blocks of [`super::simd::gemm`], with
//! their transposes, and as parts of one flat vector of weights.

/// A zero-padded matrix and its transpose.
#[derive(Debug)]
pub struct Matrix {
    /// `[rows, columns]` of the padded sizes.
    pub m: Vec<f32>,
    /// `[columns, rows]` of the padded sizes.
    pub t: Vec<f32>,
}

impl Matrix {
    /// Creates a matrix from row-major `values` of shape `[rows, columns]`, zero-padded to the
    /// shape `padded`.
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

/// Splits the flat vector of a network's weights into row-major matrices of the given shapes.
pub fn split<const N: usize>(mut flat: &[f32], shapes: [(usize, usize); N]) -> [&[f32]; N] {
    shapes.map(|(rows, columns)| {
        flat.split_off(..rows * columns).expect("the vector has the weights of all matrices")
    })
}

/// Adds matrices to those of a flat vector. Each part is a matrix with the distance of its rows, in
/// floats.
pub fn add_to(mut flat: &mut [f32], shapes: &[(usize, usize)], parts: &[(&[f32], usize)]) {
    for (&(rows, columns), &(part, stride)) in shapes.iter().zip(parts) {
        let matrix = flat.split_off_mut(..rows * columns).expect("a gradient for each weight");
        for (row, g) in matrix.chunks_exact_mut(columns).zip(part.chunks(stride)) {
            row.iter_mut().zip(g).for_each(|(a, b)| *a += b);
        }
    }
}
