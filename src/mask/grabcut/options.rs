//! Every constant of a cut.

/// How masks are cut. Lengths are shares of the picture's height H.
#[derive(Clone, Debug, PartialEq)]
pub struct GrabcutOptions {
    /// Rows of the working size; larger photographs are averaged down to it.
    pub rows: u32,
    /// Radius of what a click makes certain.
    pub seed_radius: f32,
    /// … and at least this many working pixels.
    pub seed_radius_least_px: f32,
    /// Width of the border margins along top and sides that are certainly background.
    pub border_margin: f32,
    /// How far down the border margins at the sides reach; shoulders may touch the rest.
    pub border_sides: f32,
    /// Radius of the discs around head clicks in the start.
    pub start_radius: f32,
    /// Width of the line that joins head clicks in the start.
    pub start_line: f32,
    /// Gaussians per mixture, 1 to 16.
    pub gaussians: usize,
    /// γ: what an edge between equal colours costs.
    pub smoothness: f64,
    /// λ/γ: what contradicting a click or border margin costs.
    pub certainty: f64,
    /// The background's first colours come from pixels this many times nearer to definite background than to the head's clicks;
    /// what lies between would teach it the colours of hair.
    pub start_apart: f32,
    /// Rounds of fitting and cutting from clicks.
    pub rounds: usize,
    /// Holes up to this share of the picture are filled.
    pub hole: f64,
    /// Around the outline, what colours may leave open counts as ambiguous within this distance.
    pub band: f32,
    /// Seed of the k-means start.
    pub seed: u64,
}

impl Default for GrabcutOptions {
    fn default() -> GrabcutOptions {
        GrabcutOptions {
            rows: 512,
            seed_radius: 0.012,
            seed_radius_least_px: 4.0,
            border_margin: 0.012,
            border_sides: 0.6,
            start_radius: 0.06,
            start_line: 0.02,
            start_apart: 2.0,
            gaussians: 5,
            smoothness: 50.0,
            certainty: 9.0,
            rounds: 8,
            hole: 0.01,
            band: 0.023,
            seed: 42,
        }
    }
}
