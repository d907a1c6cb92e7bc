//! Real spherical harmonics up to degree 3 (16 values): the view-direction encoding of Instant-NGP.

use glam::{Mat3, Vec3};

/// The first function: it is the same in every direction.
pub const Y0: f32 = 0.282_094_79;

/// Functions up to degree 2.
pub const COEFFICIENTS_OF_DEGREE_2: usize = 9;

/// Returns the number of functions up to a degree.
#[inline]
pub fn functions(degree: u32) -> usize {
    ((degree + 1) * (degree + 1)) as usize
}

/// Returns the 16 basis functions at the unit direction `d`, in the order and with the signs of
/// tiny-cuda-nn's degree-4 encoding.
#[inline(always)]
pub fn sh16([x, y, z]: [f32; 3]) -> [f32; 16] {
    let (xy, yz, xz) = (x * y, y * z, x * z);
    let (x2, y2, z2) = (x * x, y * y, z * z);
    [
        Y0,
        -0.488_602_51 * y,
        0.488_602_51 * z,
        -0.488_602_51 * x,
        1.092_548_4 * xy,
        -1.092_548_4 * yz,
        0.946_174_7 * z2 - 0.315_391_57,
        -1.092_548_4 * xz,
        0.546_274_2 * (x2 - y2),
        0.590_043_6 * y * (y2 - 3.0 * x2),
        2.890_611_4 * xy * z,
        0.457_045_8 * y * (1.0 - 5.0 * z2),
        0.373_176_34 * z * (5.0 * z2 - 3.0),
        0.457_045_8 * x * (1.0 - 5.0 * z2),
        1.445_305_7 * z * (x2 - y2),
        0.590_043_6 * x * (3.0 * y2 - x2),
    ]
}

/// `Σ_k c_k Y_k(d)` of up to 16 coefficients, per channel.
#[inline]
pub fn combine(coefficients: &[[f32; 3]], d: [f32; 3]) -> [f32; 3] {
    let mut out = [0f32; 3];
    for (c, y) in coefficients.iter().zip(sh16(d)) {
        (0..3).for_each(|k| out[k] += c[k] * y);
    }
    out
}

/// Returns the matrix `M` for which `Y_k(R d) = Σ_j M[k][j] Y_j(d)` with the rotation `R`, of up to
/// [`COEFFICIENTS_OF_DEGREE_2`] functions: coefficients `c` of `R d` are the coefficients
/// `Σ_k c_k M[k]` of `d`.
pub fn rotated(functions: usize, rotation: Mat3) -> Vec<Vec<f32>> {
    // the means over the corners of an icosahedron are those over the sphere up to degree 5, and
    // products have degree 4
    let golden = 0.5 * (1.0 + 5f32.sqrt());
    let signs = [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)];
    let corners: Vec<Vec3> = signs
        .into_iter()
        .flat_map(|(s, t)| {
            let (a, b) = (s, t * golden);
            [Vec3::new(0.0, a, b), Vec3::new(b, 0.0, a), Vec3::new(a, b, 0.0)].map(Vec3::normalize)
        })
        .collect();
    let area = 4.0 * std::f32::consts::PI / corners.len() as f32;
    let integral = |k: usize, j: usize| {
        let product = |d: &Vec3| sh16((rotation * *d).to_array())[k] * sh16(d.to_array())[j];
        area * corners.iter().map(product).sum::<f32>()
    };
    (0..functions).map(|k| (0..functions).map(|j| integral(k, j)).collect()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_published_values_at_one_two_three() {
        let n = 14f32.sqrt();
        let got = sh16([1.0 / n, 2.0 / n, 3.0 / n]);
        let golden = [
            0.2820948, -0.2611690, 0.3917535, -0.1305845, 0.1560783, -0.4682350, 0.2928636, -0.2341175,
            -0.1170588, 0.0225280, 0.3310922, -0.5409528, 0.0641157, -0.2704764, -0.2483191, 0.1239038,
        ];
        for (g, w) in got.iter().zip(golden) {
            assert!((g - w as f32).abs() < 2e-7, "{g} {w}");
        }
    }

    #[test]
    fn rotated_functions_are_sums_of_the_functions() {
        let rotation = Mat3::from_euler(glam::EulerRot::XYZ, 0.4, -1.1, 2.5);
        let matrix = rotated(COEFFICIENTS_OF_DEGREE_2, rotation);
        for d in [Vec3::X, Vec3::new(0.6, 0.0, -0.8), Vec3::new(-0.48, 0.64, 0.6)] {
            let (expected, own) = (sh16((rotation * d).to_array()), sh16(d.to_array()));
            for (row, expected) in matrix.iter().zip(expected) {
                let sum: f32 = row.iter().zip(own).map(|(m, y)| m * y).sum();
                assert!((sum - expected).abs() < 1e-5, "{sum} {expected}");
            }
        }
    }
}
