//! Colors as programs count them: 0 to 1, 0 to 255 or 0 to 65535; at vertices or on faces.

/// Above this, colors cannot be light that is a little too bright: they count to 255.
const BRIGHTEST: f32 = 2.0;

/// Brings colors to 0..=1: those that count to 255 or 65535 are divided, all are clamped. Returns a
/// sentence about it if any was above 1. `what` names the colors.
pub(super) fn bring_into_range(colors: &mut [[f32; 3]], what: &str) -> Option<String> {
    let values = colors.as_flattened_mut();
    let highest = values.iter().copied().fold(0.0, f32::max);
    let are_whole = values.iter().all(|v| v.fract() == 0.0);
    let top = match highest {
        ..=1.0 => 1.0,
        ..=255.0 if are_whole || highest > BRIGHTEST => 255.0,
        ..=65535.0 if are_whole => 65535.0,
        _ => 1.0,
    };
    values.iter_mut().for_each(|v| *v = (*v / top).clamp(0.0, 1.0));
    if highest <= 1.0 {
        None
    } else if top == 1.0 {
        Some(format!("{what} reach {highest}, above 1: they are clamped"))
    } else {
        Some(format!("{what} reach {highest}: they are read as 0 to {top}, divided by {top}"))
    }
}

/// Returns the mean color of the triangles around each vertex; black for a vertex without
/// triangles.
pub(super) fn at_vertices(
    vertices: usize,
    triangles: &[[u32; 3]],
    color_of: impl Fn(usize) -> [f32; 3],
) -> Vec<[f32; 3]> {
    let mut sums = vec![([0.0; 3], 0.0); vertices];
    for (t, triangle) in triangles.iter().enumerate() {
        let color = color_of(t);
        for &v in triangle {
            let (sum, count): &mut ([f32; 3], f32) = &mut sums[v as usize];
            sum.iter_mut().zip(color).for_each(|(s, c)| *s += c);
            *count += 1.0;
        }
    }
    sums.into_iter().map(|(sum, count)| sum.map(|s| s / count.max(1.0))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colors_that_count_to_255_are_divided_and_said() {
        let mut colors = vec![[255.0, 51.0, 0.0], [1.0, 0.0, 102.0]];
        let said = bring_into_range(&mut colors, "vertex colors").unwrap();
        assert_eq!(said, "vertex colors reach 255: they are read as 0 to 255, divided by 255");
        assert_eq!(colors[0], [1.0, 0.2, 0.0]);
        let mut deep = vec![[65535.0, 13107.0, 0.0]];
        assert!(bring_into_range(&mut deep, "c").unwrap().contains("0 to 65535"));
        assert_eq!(deep, [[1.0, 0.2, 0.0]]);
    }

    #[test]
    fn colors_in_range_stay_and_bright_light_is_clamped() {
        let mut colors = vec![[0.5, 1.0, 0.0]];
        assert_eq!(bring_into_range(&mut colors, "c"), None);
        assert_eq!(colors, [[0.5, 1.0, 0.0]]);
        let mut bright = vec![[0.5, 1.25, -0.5]];
        assert_eq!(bring_into_range(&mut bright, "c").unwrap(), "c reach 1.25, above 1: they are clamped");
        assert_eq!(bright, [[0.5, 1.0, 0.0]]);
    }

    #[test]
    fn a_vertex_between_two_faces_has_their_mean() {
        let faces = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]];
        let found = at_vertices(5, &[[0, 1, 2], [1, 2, 3]], |t| faces[t]);
        assert_eq!(found, [faces[0], [0.5, 0.0, 0.5], [0.5, 0.0, 0.5], faces[1], [0.0; 3]]);
    }
}
