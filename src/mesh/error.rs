//! What can go wrong between a field and its mesh.

use glam::Vec3;

/// Why there is no mesh.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MeshError {
    /// A dense volume whose sizes make no sense.
    #[error(
        "a volume of {} × {} × {} nodes needs {} values (and two nodes along each axis), but has {values}",
        dims[0], dims[1], dims[2], dims.iter().fold(1usize, |n, &d| n.saturating_mul(d))
    )]
    Volume {
        /// Nodes along x, y, z.
        dims: [usize; 3],
        /// Values given.
        values: usize,
    },
    /// More vertices than 32-bit indices can name.
    #[error("the surface has {vertices} vertices, more than 32-bit indices can name")]
    TooLarge {
        /// Vertices found.
        vertices: u64,
    },
    /// The box to mesh in is empty or not finite.
    #[error("the box to mesh in, {min} to {max}, is empty or not finite")]
    Bounds {
        /// Lowest corner.
        min: Vec3,
        /// Highest corner.
        max: Vec3,
    },
    /// A configuration value out of range.
    #[error("`mesh.{key}` is {found}, expected {expected}")]
    Config {
        /// The key.
        key: &'static str,
        /// What it may be.
        expected: &'static str,
        /// What it is.
        found: String,
    },
    /// The field is positive everywhere it was asked.
    #[error(
        "no surface: the field is positive at all {nodes} nodes asked (smallest {smallest:.3e}), nothing is inside"
    )]
    AllOutside {
        /// Nodes evaluated.
        nodes: usize,
        /// The smallest value among them.
        smallest: f32,
    },
    /// The field is negative everywhere it was asked.
    #[error(
        "no surface: the field is negative at all {nodes} nodes asked (largest {largest:.3e}), everything is inside"
    )]
    AllInside {
        /// Nodes evaluated.
        nodes: usize,
        /// The largest value among them.
        largest: f32,
    },
    /// The field gives no number anywhere it was asked.
    #[error("no surface: the field is NaN or infinite at all {nodes} nodes asked")]
    NoneFinite {
        /// Nodes evaluated.
        nodes: usize,
    },
    /// The field answered a batch with the wrong number of values.
    #[error("the {what} was asked at {asked} points and answered {answered}")]
    Answer {
        /// Which function.
        what: &'static str,
        /// Points given.
        asked: usize,
        /// Values returned.
        answered: usize,
    },
    /// Cleaning left nothing.
    #[error("cleaning removed every one of the {pieces} pieces: none encloses a positive volume")]
    NothingKept {
        /// Pieces before.
        pieces: usize,
    },
    /// A mesh with coordinates that are no numbers.
    #[error("{count} vertices of the mesh have a coordinate that is not finite, the first is vertex {first}")]
    NotFinite {
        /// How many.
        count: usize,
        /// The first of them.
        first: usize,
    },
    /// A triangle over a vertex that is not there.
    #[error("triangle {triangle} names vertex {index}, but the mesh has {vertices}")]
    Index {
        /// Which triangle.
        triangle: usize,
        /// The largest index in it.
        index: u32,
        /// How many vertices there are.
        vertices: usize,
    },
    /// A mesh to be textured has nothing to texture.
    #[error("the mesh has no triangles")]
    NoTriangles,
    /// Not a texel for each triangle.
    #[error("{triangles} triangles do not fit into a texture of {size_px} × {size_px} texels")]
    AtlasTooSmall {
        /// Texels across and down.
        size_px: u32,
        /// Triangles of the mesh.
        triangles: usize,
    },
    /// The monitor asked to stop.
    #[error("stopped on request")]
    Stopped,
}

impl MeshError {
    /// The way out, for a person.
    pub fn hint(&self) -> Option<&'static str> {
        match self {
            MeshError::Volume { .. } => Some("values are stored x fastest, then y, then z"),
            MeshError::TooLarge { .. } => Some("lower `mesh.resolution`"),
            MeshError::Bounds { .. } => Some("check the scene box of the capture"),
            MeshError::Config { .. } => None,
            MeshError::AllOutside { .. } => Some(
                "train `iface` longer, check that the box holds the head, or raise `mesh.resolution` for small pieces",
            ),
            MeshError::AllInside { .. } => Some(
                "the field may be inverted (negative must be inside), untrained, or the box may lie within the head",
            ),
            MeshError::NoneFinite { .. } => {
                Some("training diverged: resume `iface` from an earlier checkpoint")
            }
            MeshError::Answer { .. } => Some("a field must return one value a point, in order"),
            MeshError::NothingKept { .. } => Some("the field may be inverted: negative must be inside"),
            MeshError::NotFinite { .. } | MeshError::Index { .. } => {
                Some("the mesh is damaged: export it again, or remove these vertices and triangles")
            }
            MeshError::NoTriangles => Some("check that `mesh` ended with a surface"),
            MeshError::AtlasTooSmall { .. } => {
                Some("a larger texture, or a mesh simplified to fewer triangles")
            }
            MeshError::Stopped => None,
        }
    }
}
