//! What is doubtful of a result, for a person and for a program.

use std::fmt;
use tiface_base::error::counted;

/// Something doubtful about a result that was made nevertheless. As text it says what was found;
/// [`Warning::hint`] says what to do about it.
#[derive(Clone, Debug, PartialEq)]
pub enum Warning {
    /// The field was not finite at this number of nodes near the surface.
    NotFinite(usize),
    /// Parts of the surface were removed.
    Removed {
        /// Number of small pieces.
        dust: usize,
        /// Number of surfaces within the surface.
        inner_shells: usize,
        /// Number of triangles of both.
        triangles: usize,
    },
    /// The surface is not a closed manifold.
    NotSolid,
    /// Handles were cut, or their holes filled.
    Handles {
        /// Lengths of the loops that were cut, in millimeters.
        cut_mm: Vec<f64>,
        /// Lengths of the loops around holes that were filled, in millimeters.
        filled_mm: Vec<f64>,
        /// Number of handles that were kept.
        left: usize,
    },
    /// More triangles were left than asked for.
    TooManyTriangles {
        /// Number of triangles left.
        left: usize,
        /// Number of triangles asked for.
        asked: usize,
    },
    /// This number of vertices stayed, because the surface is not a manifold there.
    NotManifold(usize),
    /// This number of triangles cross others.
    Crossing(usize),
    /// Every triangle has a piece of the texture of its own.
    NoCharts {
        /// Half the distance between pieces, in texels.
        gutter_px: f64,
        /// Why there are no larger charts.
        reason: String,
    },
    /// The texture was asked for with more texels than photographs resolve.
    FinerThanPhotographs {
        /// Texels across that hold all that photographs resolve.
        sufficient_px: u32,
        /// Texels across asked for.
        asked_px: u32,
    },
    /// This number of triangles have a small chart of their own.
    OwnCharts(usize),
}

impl Warning {
    /// Returns what to do about it, in terms of the options of this crate.
    pub fn hint(&self) -> &'static str {
        match self {
            Warning::NotFinite(_) => "a field must be finite near its zero",
            Warning::Removed { .. } => "what is wanted must be joined to the largest piece",
            Warning::NotSolid => "`files::check` says what is wrong",
            Warning::Handles { .. } => "`ExtractOptions::longest_handle` 0 keeps all",
            Warning::TooManyTriangles { .. } => "`SimplifyConfig::triangles` can be raised to that",
            Warning::NotManifold(_) => "mend these vertices, or extract the surface at another resolution",
            Warning::Crossing(_) => "mend these triangles, or extract the surface at another resolution",
            Warning::NoCharts { .. } => "a larger `AtlasConfig::size_px` or fewer triangles help",
            Warning::FinerThanPhotographs { .. } => "a smaller `AtlasConfig::size_px` suffices",
            Warning::OwnCharts(_) => "fewer triangles help",
        }
    }
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let around = |lengths: &[f64]| {
            let each: Vec<String> = lengths.iter().map(|mm| format!("{mm:.0}")).collect();
            if each.is_empty() { String::new() } else { format!(" ({} mm around)", each.join(", ")) }
        };
        match self {
            Warning::NotFinite(nodes) => {
                write!(f, "the field was NaN or infinite at {} near the surface", counted(*nodes, "node"))
            }
            Warning::Removed { dust, inner_shells, triangles } => {
                let [dust, shells] = [counted(*dust, "small piece"), counted(*inner_shells, "inner shell")];
                write!(f, "removed {dust} and {shells} ({})", counted(*triangles, "triangle"))
            }
            Warning::NotSolid => write!(f, "the mesh is not a closed manifold"),
            Warning::Handles { cut_mm, filled_mm, left } => write!(
                f,
                "the surface had loops: {} cut{}, {} filled{}, {left} left",
                cut_mm.len(),
                around(cut_mm),
                counted(filled_mm.len(), "hole"),
                around(filled_mm),
            ),
            Warning::TooManyTriangles { left, asked } => write!(
                f,
                "{left} triangles are left instead of {asked}: fewer would change the topology, fold the surface \
                 or make it cross itself"
            ),
            Warning::NotManifold(vertices) => {
                write!(f, "vertices where the surface is no manifold, which stayed: {vertices}")
            }
            Warning::Crossing(triangles) => {
                write!(f, "triangles that cross others, as in the input: {triangles}")
            }
            Warning::NoCharts { gutter_px, reason } => write!(
                f,
                "every triangle has a piece of the texture of its own, {gutter_px:.1} texels of gutter: \
                 {reason}"
            ),
            Warning::FinerThanPhotographs { sufficient_px: px, asked_px } => write!(
                f,
                "a texture of {px} × {px} texels holds all that the photographs resolve, {asked_px} × {asked_px} \
                 were asked for: no part of it is finer, the rest is left empty"
            ),
            Warning::OwnCharts(triangles) => write!(
                f,
                "{} could not stay in a larger chart and got a chart of their own",
                counted(*triangles, "triangle")
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_warning_counts_what_was_found_and_gives_lengths_in_whole_millimeters() {
        let both = Warning::Handles { cut_mm: vec![44.6, 12.0], filled_mm: Vec::new(), left: 1 };
        let said = "the surface had loops: 2 cut (45, 12 mm around), 0 holes filled, 1 left";
        assert_eq!(both.to_string(), said);
        let removed = Warning::Removed { dust: 1, inner_shells: 2, triangles: 30 };
        assert_eq!(removed.to_string(), "removed 1 small piece and 2 inner shells (30 triangles)");
        assert_eq!(Warning::OwnCharts(1).to_string().split(" could").next(), Some("1 triangle"));
    }
}
