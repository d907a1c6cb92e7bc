//! Squared distances along a line: the step that exact distance transforms of pictures and volumes
//! make along each axis (Felzenszwalb & Huttenlocher 2012).

/// Scratch memory for the lower envelope of the parabolas that stand over the values of a line, one
/// for each value.
pub struct LowerEnvelope {
    /// Position of each parabola of the envelope.
    apex: Vec<usize>,
    /// Start of each parabola of the envelope.
    from: Vec<f64>,
    out: Vec<f32>,
}

impl LowerEnvelope {
    /// Allocates memory for lines of up to `width` values.
    pub fn new(width: usize) -> LowerEnvelope {
        LowerEnvelope { apex: vec![0; width], from: vec![0.0; width + 1], out: vec![0.0; width] }
    }

    /// Replaces each value of a line by the minimum over all positions of `value + distance²`.
    pub fn transform(&mut self, row: &mut [f32]) {
        let mut k = 0;
        self.apex[0] = 0;
        self.from[0] = f64::NEG_INFINITY;
        for q in 1..row.len() {
            let f = |x: usize| row[x] as f64 + (x * x) as f64;
            loop {
                let p = self.apex[k];
                let meet = (f(q) - f(p)) / (2 * (q - p)) as f64;
                if meet > self.from[k] {
                    k += 1;
                    self.apex[k] = q;
                    self.from[k] = meet;
                    break;
                }
                // the parabola at p is never the lowest, so it is dropped; the first one starts at
                // −∞ and always stays
                k -= 1;
            }
        }
        self.from[k + 1] = f64::INFINITY;
        let mut k = 0;
        for x in 0..row.len() {
            while self.from[k + 1] < x as f64 {
                k += 1;
            }
            let d = x.abs_diff(self.apex[k]) as f32;
            self.out[x] = d * d + row[self.apex[k]];
        }
        row.copy_from_slice(&self.out);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_gets_its_squared_distances() {
        let mut line = [9.0, 1e6, 0.0, 1e6, 1e6, 1e6];
        LowerEnvelope::new(6).transform(&mut line);
        assert_eq!(line, [4.0, 1.0, 0.0, 1.0, 4.0, 9.0]);
    }
}
