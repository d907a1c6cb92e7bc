//! One click of a person on a photograph.

/// One click of a person on a photograph.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Click {
    /// Column, as a pixel index: 0 is the center of the leftmost pixels (`prompts.json`'s convention).
    pub x: f32,
    /// Row, as a pixel index: 0 is the center of the top pixels.
    pub y: f32,
    /// Is the head there?
    pub head: bool,
}

impl Click {
    /// The same point of the photograph on a picture of it at another size; sizes are width and height.
    pub fn moved(&self, from: (u32, u32), to: (u32, u32)) -> Click {
        let moved = |v: f32, from: u32, to: u32| ((v as f64 + 0.5) * to as f64 / from as f64 - 0.5) as f32;
        Click { x: moved(self.x, from.0, to.0), y: moved(self.y, from.1, to.1), head: self.head }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clicks_keep_their_place() {
        // the first of four pixels has its center at 1/8 of the width, which is a quarter into the first of two
        let moved = Click { x: 0.0, y: 3.0, head: true }.moved((4, 4), (2, 2));
        assert_eq!((moved.x, moved.y), (-0.25, 1.25));
    }
}
