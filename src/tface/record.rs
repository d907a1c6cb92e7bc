//! The metadata of a field in a checkpoint: its shape and settings, and the geometry of its grid.

use crate::config::{DensityActivation, VmConfig};
use crate::field::checkpoint::Checkpoint;
use serde::{Deserialize, Serialize};
use tiface_base::Result;
use tiface_kernels::cpu::vm::mask::{BoxMask, Lattice};
use tiface_kernels::cpu::vm::{DecoderShape, Grid, Shading, VmField, samples_across, step_size};

/// Version of the checkpoints' layout.
pub const FORMAT: &str = "tiface-vm-1";

/// Names of the parameters in checkpoints.
pub const NAMES: [&str; 3] = ["density", "color", "network"];

/// Transform from scene to field coordinates, where they differ: `field = scale · scene + offset`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Placement {
    /// Field units in a scene unit.
    pub scale: f32,
    /// The scene's origin in field coordinates.
    pub offset: [f32; 3],
    /// Ray directions are scaled to depth 1 along the optical axis before the decoder sees them,
    /// and steps are so much longer off the axis: what the published ILSH loader does.
    pub depth_directions: bool,
}

fn triple(list: &[usize]) -> [usize; 3] {
    [list[0], list[1], list[2]]
}

/// Returns the grids of density and appearance for a size.
pub fn grids(config: &VmConfig, size: [usize; 3]) -> (Grid, Grid) {
    (Grid { size, rank: triple(&config.density_rank) }, Grid { size, rank: triple(&config.color_rank) })
}

/// Returns the decoder that a configuration describes.
pub fn decoder(config: &VmConfig) -> DecoderShape {
    DecoderShape {
        channels: config.color_rank.iter().sum(),
        features: config.features,
        hidden: config.hidden,
        view_frequencies: config.view_frequencies,
        feature_frequencies: config.feature_frequencies,
    }
}

/// Description of a field without its values, sufficient to render it without the settings of its
/// training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FieldRecord {
    /// Channels of the density's planes.
    pub density_rank: [usize; 3],
    /// Channels of the appearance's planes.
    pub color_rank: [usize; 3],
    /// From features and directions to colors; its channels are those of `color_rank`.
    #[serde(flatten)]
    pub decoder: DecoderShape,
    /// From features to weights.
    #[serde(flatten)]
    pub shading: Shading,
    /// March step as a share of the distance of vertices.
    pub step_ratio: f32,
    /// Rays enter between this and `far`.
    pub near: f32,
    /// See `near`.
    pub far: f32,
    /// Threshold of the alpha mask.
    pub mask_threshold: f32,
    /// Placement in the scene, if its coordinates are not the scene's.
    pub placement: Option<Placement>,
}

impl FieldRecord {
    /// Returns the record of a field in training.
    pub fn new(config: &VmConfig) -> FieldRecord {
        let (density, color) = grids(config, [2; 3]);
        FieldRecord {
            density_rank: density.rank,
            color_rank: color.rank,
            decoder: decoder(config),
            shading: Shading {
                softplus: config.activation == DensityActivation::Softplus,
                shift: config.density_shift as f32,
                distance_scale: config.distance_scale as f32,
                weight_threshold: config.weight_threshold as f32,
                stop: config.stop as f32,
                group_weight: config.group_weight as f32,
            },
            step_ratio: config.step_ratio as f32,
            near: config.near as f32,
            far: config.far as f32,
            mask_threshold: config.mask_threshold as f32,
            placement: config.depth_directions.then_some(Placement {
                scale: 1.0,
                offset: [0.0; 3],
                depth_directions: true,
            }),
        }
    }

    /// Checks that the field can be rendered, and otherwise returns the reason.
    pub fn validate(&self) -> Result<(), &'static str> {
        let (d, s) = (&self.decoder, &self.shading);
        let numbers =
            [s.shift, s.distance_scale, s.weight_threshold, s.stop, s.group_weight, self.mask_threshold];
        let ranks = [self.density_rank, self.color_rank];
        if ranks.iter().any(|r| r.iter().all(|n| *n == 0) || r.iter().any(|n| *n > 4096)) {
            return Err("its planes have no channels, or more than 4096");
        }
        if !(1e-2..=100.0).contains(&self.step_ratio) {
            return Err("its step ratio is not within 0.01 and 100");
        }
        if d.view_frequencies > 16 || d.feature_frequencies > 16 {
            return Err("its encodings have more than 16 frequencies");
        }
        if d.hidden == 0 || !d.hidden.is_multiple_of(8) || d.hidden > 4096 || d.features > 4096 {
            return Err("its decoder is wider than 4096, or its hidden layers are no multiple of 8 wide");
        }
        let finite = |v: &f32| v.is_finite();
        if s.weight_threshold < 0.0 || s.group_weight < 0.0 {
            return Err("its thresholds of weights are negative");
        }
        if !numbers.iter().chain([&self.near, &self.far]).all(finite) || self.near > self.far {
            return Err("its numbers are not finite, or near lies behind far");
        }
        if let Some(p) = &self.placement
            && !(p.scale.is_normal() && p.scale > 0.0 && p.offset.iter().all(finite))
        {
            return Err("it is placed by a scale that is not positive, or by numbers that are not finite");
        }
        Ok(())
    }

    /// Returns the field over a box, with as many samples a ray as the box's diagonal needs.
    pub fn field(&self, bounds: [[f32; 3]; 2], size: [usize; 3], mask: Option<BoxMask>) -> VmField {
        let extent: [f32; 3] = std::array::from_fn(|a| bounds[1][a] - bounds[0][a]);
        let step = step_size(extent, size, self.step_ratio);
        VmField {
            density: Grid { size, rank: self.density_rank },
            color: Grid { size, rank: self.color_rank },
            decoder: DecoderShape { channels: self.color_rank.iter().sum(), ..self.decoder },
            lattice: Lattice {
                min: bounds[0],
                max: bounds[1],
                step,
                samples: samples_across(extent, step),
                near: self.near,
                far: self.far,
            },
            shading: self.shading,
            mask,
        }
    }

    /// Writes only the record into a checkpoint.
    pub fn write(&self, into: &mut Checkpoint) {
        into.set("field", serde_json::to_string(self).expect("plain numbers become JSON"));
    }

    /// Writes the record and the grid's geometry into a checkpoint.
    pub fn save(
        &self,
        bounds: [[f32; 3]; 2],
        size: [usize; 3],
        mask: Option<&BoxMask>,
        into: &mut Checkpoint,
    ) {
        let words = |s: [usize; 3]| s.map(|n| n as u64).to_vec();
        self.write(into);
        into.put_floats("bounds", &[2, 3], bounds.concat());
        into.put_words("size", words(size));
        if let Some(mask) = mask {
            let (low, high) = mask.bounds();
            into.put_floats("mask.bounds", &[2, 3], [low, high].concat());
            into.put_words("mask.size", words(mask.size()));
            into.put_words("mask.bits", mask.bits().to_vec());
        }
    }

    /// Reads the record from a checkpoint.
    pub fn restore(from: &Checkpoint) -> Result<FieldRecord> {
        let record: FieldRecord = serde_json::from_str(from.text("field")?)
            .map_err(|e| from.mismatch(format!("its `field` cannot be understood: {e}")))?;
        record.validate().map_err(|why| from.mismatch(why.into()))?;
        Ok(record)
    }
}

fn bounds(from: &mut Checkpoint, name: &str) -> Result<[[f32; 3]; 2]> {
    let v = from.floats(name, &[2, 3])?;
    let b = [[v[0], v[1], v[2]], [v[3], v[4], v[5]]];
    let sound = (0..3).all(|a| b[0][a].is_finite() && b[1][a].is_finite() && b[0][a] < b[1][a]);
    if sound { Ok(b) } else { Err(from.mismatch(format!("`{name}` is no box: {b:?}"))) }
}

fn size(from: &mut Checkpoint, name: &str, min: u64) -> Result<[usize; 3]> {
    let v = from.words(name)?;
    match v[..] {
        [x, y, z] if [x, y, z].iter().all(|n| (min..=1 << 16).contains(n)) => {
            Ok([x as usize, y as usize, z as usize])
        }
        _ => Err(from.mismatch(format!("`{name}` is no grid size: {v:?}"))),
    }
}

/// Reads the geometry of a field's grid from a checkpoint: box, size in vertices, and mask.
pub fn geometry(from: &mut Checkpoint) -> Result<([[f32; 3]; 2], [usize; 3], Option<BoxMask>)> {
    let (box_, vertices) = (bounds(from, "bounds")?, size(from, "size", 2)?);
    if !from.has("mask.bounds") {
        return Ok((box_, vertices, None));
    }
    let [low, high] = bounds(from, "mask.bounds")?;
    let cells = size(from, "mask.size", 1)?;
    let mask = BoxMask::from_bits(low, high, cells, from.words("mask.bits")?)
        .ok_or_else(|| from.mismatch("the alpha mask has another number of cells".into()))?;
    Ok((box_, vertices, Some(mask)))
}
