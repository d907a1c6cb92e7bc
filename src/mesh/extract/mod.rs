//! The stage: from a signed distance to a closed mesh with normals and colours.

mod cap;
mod clean;
mod handles;
mod holes;
mod loops;
mod marching;
mod marching_bits;
mod marching_cell;
mod polish;
mod sparse;
mod sparse_blocks;
mod verify;

pub use cap::{Cap, Skin};
pub use clean::{CleanReport, clean};
pub use handles::{HandleReport, Patches};
pub use marching::{Surface, Volume, marching};
pub use sparse::{Asking, Grid, Sparse, sparse};
pub use verify::Verified;

use super::MeshError;
use crate::Monitor;
use crate::geom::{Aabb, Mesh, Topology, topology};
use glam::Vec3;
use handles::cut_handles;
use polish::Polish;
use serde::{Deserialize, Serialize};
use std::time::Instant;
use verify::dense_triangles;

/// How the surface is extracted.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MeshConfig {
    /// Cells along the longest side of the box; 2..=8192.
    pub resolution: usize,
    /// Every how many cells the field is asked first: 2, 4 or 8. Smaller finds smaller loose pieces.
    pub coarse_step: usize,
    /// Most points in one call of the field; at least 1.
    pub batch: usize,
    /// Pieces beside the largest stay when they have at least this share of its volume; 0..=1, where 1
    /// keeps the largest alone.
    pub keep_share: f64,
    /// Newton steps that move vertices onto the field's zero; 0..=8, 0 leaves them where they are.
    pub newton_steps: usize,
    /// How far vertices slide towards the middle of their neighbours with the first step; 0..=1.
    pub relax: f32,
    /// Handles are cut, or their holes filled, where they have a loop no longer than this share of the surface's
    /// longest side; 0..=1, 0 leaves them all.
    pub longest_handle: f32,
    /// Also evaluate the whole grid and report what the sparse extraction lost: slow, for checking.
    pub verify: bool,
}

/// The loops of locks and between them, not those of a body: 45 mm of a head with its neck, 300 mm long, which
/// is a strand or a hole as thick as a thumb. A share, since not every capture knows its unit.
pub const LONGEST_HANDLE: f32 = 0.15;

impl Default for MeshConfig {
    fn default() -> MeshConfig {
        MeshConfig {
            resolution: 512,
            coarse_step: 8,
            batch: 1 << 16,
            keep_share: 1.0,
            newton_steps: 2,
            relax: 0.5,
            longest_handle: LONGEST_HANDLE,
            verify: false,
        }
    }
}

impl MeshConfig {
    /// Every value in its range, else [`MeshError::Config`] that names the key.
    pub fn check(&self) -> Result<(), MeshError> {
        let bad = |key, expected, found: String| Err(MeshError::Config { key, expected, found });
        if !(2..=8192).contains(&self.resolution) {
            return bad("resolution", "2..=8192", self.resolution.to_string());
        }
        if ![2, 4, 8].contains(&self.coarse_step) {
            return bad("coarse_step", "2, 4 or 8", self.coarse_step.to_string());
        }
        if self.batch == 0 {
            return bad("batch", "at least 1", self.batch.to_string());
        }
        if !(0.0..=1.0).contains(&self.keep_share) {
            return bad("keep_share", "0..=1", self.keep_share.to_string());
        }
        if self.newton_steps > 8 {
            return bad("newton_steps", "0..=8", self.newton_steps.to_string());
        }
        if !(0.0..=1.0).contains(&self.relax) {
            return bad("relax", "0..=1", self.relax.to_string());
        }
        if !(0.0..=1.0).contains(&self.longest_handle) {
            return bad("longest_handle", "0..=1", self.longest_handle.to_string());
        }
        Ok(())
    }
}

/// What [`extract`] found and did.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MeshReport {
    /// Cells along x, y, z.
    pub cells: [usize; 3],
    /// Cell edge, in units of the bounds.
    pub cell_size: f32,
    /// Lower and upper corner of the grid: where caps lie.
    pub grid: [[f32; 3]; 2],
    /// Nodes the field was asked for.
    pub nodes_evaluated: usize,
    /// The same as a share of all nodes, 0..=1.
    pub share_evaluated: f64,
    /// Nodes outside the hull, taken as outside without asking.
    pub nodes_outside_hull: usize,
    /// 99th percentile of the field's gradient norm over coarse nodes; 1 for a true distance.
    pub gradient_norm: f32,
    /// Nodes whose value was not finite.
    pub non_finite: usize,
    /// Inside nodes on the faces of the box, where the surface was capped.
    pub capped: usize,
    /// The dense extraction beside this one, if `verify` was asked.
    pub verified: Option<Verified>,
    /// What cleaning removed.
    pub clean: CleanReport,
    /// Mean |f| / |∇f| over vertices before they moved, in cells.
    pub off_surface_before: f64,
    /// The same after.
    pub off_surface_after: f64,
    /// Vertices that some step moved less than asked, because a face would have been spoiled.
    pub held_back: usize,
    /// Handles that were cut, filled or left.
    #[serde(default)]
    pub handles: HandleReport,
    /// The finished mesh: closed, manifold, pieces, Euler number.
    pub topology: Topology,
    /// Enclosed volume, in units of the bounds cubed.
    pub volume: f64,
    /// Wall time.
    pub seconds: f64,
}

impl MeshReport {
    /// The box of the grid.
    pub fn bounds(&self) -> Aabb {
        let [min, max] = self.grid.map(Vec3::from);
        Aabb { min, max }
    }

    /// What a person should hear about, one sentence each; `cap`: has the cap stayed?
    pub fn warnings(&self, cap: bool) -> Vec<String> {
        let mut out = Vec::new();
        if self.capped > 0 {
            let state = if cap { "was closed by a cap" } else { "is open" };
            out.push(format!(
                "the surface {state} where the kept region ends ({} nodes): the frames cut the body there, or the box is too small",
                self.capped
            ));
        }
        if self.non_finite > 0 {
            out.push(format!("the field was NaN or infinite at {} nodes near the surface", self.non_finite));
        }
        if self.clean.dropped_triangles > 0 {
            out.push(format!(
                "{} small pieces and {} inner shells were removed ({} triangles)",
                self.clean.dust, self.clean.inner_shells, self.clean.dropped_triangles
            ));
        }
        if !self.topology.is_solid() {
            out.push("the mesh is not a closed manifold".into());
        }
        out
    }
}

/// Meshes the zero level set of `sdf` (negative inside) within `bounds`.
///
/// All closures get points of the same space as `bounds`, at most `config.batch` a call, from one
/// thread. `sdf_gradient` answers values and gradients; `color` answers sRGB-coded colours for points
/// with unit normals. Points for which `inside_hull` is false count as outside without being asked.
///
/// The mesh is closed (capped where the field leaves the box), its vertices moved onto the field's zero,
/// its normals the field's gradient. Handles with a loop no longer than `config.longest_handle` are gone.
///
/// # Errors
///
/// A box or configuration out of range, a field without a surface ([`MeshError::AllOutside`],
/// [`MeshError::AllInside`], [`MeshError::NoneFinite`]), answers of the wrong length, a request to stop.
pub fn extract(
    sdf: impl Fn(&[Vec3]) -> Vec<f32> + Sync,
    sdf_gradient: impl Fn(&[Vec3]) -> (Vec<f32>, Vec<Vec3>) + Sync,
    color: impl Fn(&[Vec3], &[Vec3]) -> Vec<[f32; 3]> + Sync,
    bounds: Aabb,
    inside_hull: Option<&(dyn Fn(Vec3) -> bool + Sync)>,
    config: &MeshConfig,
    monitor: &dyn Monitor,
) -> Result<(Mesh, MeshReport), MeshError> {
    let begin = Instant::now();
    config.check()?;
    let grid = Grid::fit(bounds, config.resolution)?;
    let steps = config.newton_steps as u64 + 4;
    let mut done = 0;
    let mut tell = |values: &[(&str, f64)]| {
        done += 1;
        monitor.step(done, steps, values);
        if monitor.stop() { Err(MeshError::Stopped) } else { Ok(()) }
    };

    let outside = inside_hull.map(|inside| move |p: Vec3| !inside(p));
    let outside = outside.as_ref().map(|o| o as &dyn Fn(Vec3) -> bool);
    let asking = Asking { coarse_step: config.coarse_step, batch: config.batch };
    let found = sparse(&sdf, outside, &grid, asking, &|| monitor.stop())?;
    has_surface(&found)?;
    let verified = match config.verify {
        true => Some(Verified {
            dense_triangles: dense_triangles(&sdf, outside, &grid, config.batch, &|| monitor.stop())?,
            sparse_triangles: found.surface.triangles.len(),
        }),
        false => None,
    };
    let mut report = MeshReport {
        cells: grid.dims.map(|d| d - 1),
        cell_size: grid.spacing,
        grid: [grid.origin.to_array(), grid.point(grid.dims.map(|d| d - 1)).to_array()],
        nodes_evaluated: found.evaluated,
        share_evaluated: found.evaluated as f64 / grid.nodes() as f64,
        nodes_outside_hull: found.skipped,
        gradient_norm: found.gradient_norm,
        non_finite: found.surface.non_finite,
        capped: found.surface.capped,
        verified,
        ..MeshReport::default()
    };
    let mut mesh =
        Mesh { positions: found.surface.positions, triangles: found.surface.triangles, ..Mesh::default() };
    tell(&[("nodes", found.evaluated as f64), ("triangles", mesh.triangles.len() as f64)])?;

    report.clean = clean(&mut mesh, config.keep_share)?;
    tell(&[("pieces", report.clean.pieces as f64), ("triangles", mesh.triangles.len() as f64)])?;

    let capped: Vec<bool> = mesh.positions.iter().map(|&p| on_border(&grid, p)).collect();
    let gradient = |points: &[Vec3]| answers(points, config.batch, &sdf_gradient);
    let polish = Polish::new(&mesh.positions, &mesh.triangles, 0.5 * grid.spacing, capped.clone());
    let (mut values, mut gradients) = gradient(&mesh.positions)?;
    report.off_surface_before = off_surface(&values, &gradients, &capped, grid.spacing);
    for step in 0..config.newton_steps {
        let relax = if step == 0 { config.relax } else { 0.0 };
        report.held_back += polish.step(&mut mesh.positions, &values, &gradients, relax);
        (values, gradients) = gradient(&mesh.positions)?;
        tell(&[("held_back", report.held_back as f64)])?;
    }
    report.off_surface_after = off_surface(&values, &gradients, &capped, grid.spacing);

    let longest = config.longest_handle * mesh.bounds().size().max_element();
    if longest > 0.0 {
        let values = |points: &[Vec3]| values_at(points, config.batch, &sdf);
        report.handles = cut_handles(&mut mesh, longest, &values, &|| monitor.stop())?;
    }
    // vertices whose normal is not the field's slope
    let mut edged: Vec<bool> = mesh.positions.iter().map(|&p| on_border(&grid, p)).collect();
    if let Some(patches) = Patches::of(&mesh, &report.handles) {
        patches.corners().for_each(|v| edged[v as usize] = true);
        gradients = gradient(&mesh.positions)?.1;
    }

    mesh.normals = mesh.angle_weighted_normals();
    for (i, normal) in mesh.normals.iter_mut().enumerate() {
        let g = gradients[i];
        if !edged[i] && g.is_finite() && g.length() >= 1e-6 {
            *normal = g.normalize();
        }
    }
    mesh.colors = Vec::with_capacity(mesh.positions.len());
    for (points, normals) in mesh.positions.chunks(config.batch).zip(mesh.normals.chunks(config.batch)) {
        let colors = color(points, normals);
        if colors.len() != points.len() {
            let (asked, answered) = (points.len(), colors.len());
            return Err(MeshError::Answer { what: "color", asked, answered });
        }
        let tame = |c: f32| if c.is_finite() { c.clamp(0.0, 1.0) } else { 0.0 };
        mesh.colors.extend(colors.iter().map(|c| c.map(tame)));
    }
    tell(&[("vertices", mesh.positions.len() as f64)])?;

    report.topology = topology(&mesh.positions, &mesh.triangles);
    report.handles.left = report.topology.genus.map_or(0, |g| g as usize);
    report.volume = mesh.signed_volume();
    report.seconds = begin.elapsed().as_secs_f64();
    tell(&[("euler", report.topology.euler as f64)])?;
    Ok((mesh, report))
}

fn has_surface(found: &Sparse) -> Result<(), MeshError> {
    let nodes = found.evaluated;
    let (smallest, largest) = found.range;
    if smallest > largest {
        // Nothing finite; but nothing asked either when the hull is empty.
        return Err(if nodes > 0 {
            MeshError::NoneFinite { nodes }
        } else {
            MeshError::AllOutside { nodes, smallest: f32::INFINITY }
        });
    }
    if largest < 0.0 && found.skipped == 0 && found.surface.non_finite == 0 {
        return Err(MeshError::AllInside { nodes, largest });
    }
    if found.surface.triangles.is_empty() {
        return Err(MeshError::AllOutside { nodes, smallest });
    }
    Ok(())
}

/// Cap vertices lie within a thousandth of a cell of the box.
fn on_border(grid: &Grid, p: Vec3) -> bool {
    let far = grid.point(grid.dims.map(|d| d - 1));
    let near = grid.spacing / 256.0;
    (p - grid.origin).min_element() < near || (far - p).min_element() < near
}

fn answers(
    points: &[Vec3],
    batch: usize,
    field: &(impl Fn(&[Vec3]) -> (Vec<f32>, Vec<Vec3>) + Sync),
) -> Result<(Vec<f32>, Vec<Vec3>), MeshError> {
    let (mut values, mut gradients) = (Vec::with_capacity(points.len()), Vec::with_capacity(points.len()));
    for points in points.chunks(batch) {
        let (f, g) = field(points);
        if f.len() != points.len() || g.len() != points.len() {
            let (asked, answered) = (points.len(), f.len().min(g.len()));
            return Err(MeshError::Answer { what: "gradient", asked, answered });
        }
        values.extend(f);
        gradients.extend(g);
    }
    Ok((values, gradients))
}

fn values_at(
    points: &[Vec3],
    batch: usize,
    sdf: &(impl Fn(&[Vec3]) -> Vec<f32> + Sync),
) -> Result<Vec<f32>, MeshError> {
    let mut values = Vec::with_capacity(points.len());
    for points in points.chunks(batch) {
        values.extend(sdf(points));
    }
    match (points.len(), values.len()) {
        (asked, answered) if asked != answered => {
            Err(MeshError::Answer { what: "signed distance", asked, answered })
        }
        _ => Ok(values),
    }
}

/// Mean first-order distance to the surface, in cells, over vertices that are not capped.
fn off_surface(values: &[f32], gradients: &[Vec3], capped: &[bool], cell: f32) -> f64 {
    let distances = (0..values.len())
        .filter(|&i| !capped[i])
        .map(|i| f64::from(values[i].abs() / gradients[i].length().max(1e-6) / cell))
        .filter(|d| d.is_finite());
    let (sum, n) = distances.fold((0.0, 0usize), |(s, n), d| (s + d, n + 1));
    if n > 0 { sum / n as f64 } else { 0.0 }
}

#[cfg(test)]
mod handles_tests;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Quiet;

    fn mesh_of(f: impl Fn(Vec3) -> f32 + Sync, config: &MeshConfig) -> Result<(Mesh, MeshReport), MeshError> {
        let gradient = |p: Vec3| {
            let d = |e: Vec3| (f(p + 1e-3 * e) - f(p - 1e-3 * e)) / 2e-3;
            Vec3::new(d(Vec3::X), d(Vec3::Y), d(Vec3::Z))
        };
        extract(
            |p| p.iter().map(|&p| f(p)).collect(),
            |p| p.iter().map(|&p| (f(p), gradient(p))).unzip(),
            |_, n| n.iter().map(|n| (0.5 * *n + 0.5).to_array()).collect(),
            Aabb::SCENE,
            None,
            config,
            &Quiet,
        )
    }

    fn coarse() -> MeshConfig {
        MeshConfig { resolution: 48, ..MeshConfig::default() }
    }

    #[test]
    fn a_sphere_comes_out_round_coloured_and_closed() {
        let (mesh, report) = mesh_of(|p| p.length() - 0.7, &coarse()).unwrap();
        assert!(report.topology.is_solid());
        assert_eq!((report.topology.euler, report.topology.pieces), (2, 1));
        // On the surface to a thousandth of a cell; normals and colours radial.
        for (i, p) in mesh.positions.iter().enumerate() {
            assert!((p.length() - 0.7).abs() < 1e-3 * report.cell_size);
            assert!(mesh.normals[i].distance(p.normalize()) < 1e-3);
            assert!((Vec3::from(mesh.colors[i]) * 2.0 - 1.0).distance(mesh.normals[i]) < 1e-5);
        }
        // 4/3 π 0.7³ = 1.4368; inscribed, so a little less.
        assert!((1.43..1.4368).contains(&report.volume), "{}", report.volume);
        assert!(report.warnings(true).is_empty(), "{:?}", report.warnings(true));
    }

    #[test]
    fn moving_leaves_no_slivers_and_turns_no_face() {
        let plain = MeshConfig { newton_steps: 0, ..coarse() };
        let slivers = |m: &Mesh| {
            let poor = (0..m.triangles.len() as u32).filter(|&t| {
                let [a, b, c] = m.corners(t);
                let sum = (b - a).length_squared() + (c - b).length_squared() + (a - c).length_squared();
                2.0 * 3f32.sqrt() * (b - a).cross(c - a).length() / sum < 0.1
            });
            poor.count() as f64 / m.triangles.len() as f64
        };
        let f = |p: Vec3| p.length() - 0.7;
        let (before, _) = mesh_of(f, &plain).unwrap();
        let (after, _) = mesh_of(f, &coarse()).unwrap();
        assert!(slivers(&after) < 0.2 * slivers(&before), "{} {}", slivers(&before), slivers(&after));
        for t in 0..after.triangles.len() as u32 {
            let [a, b, c] = after.corners(t);
            assert!((b - a).cross(c - a).dot(a + b + c) > 0.0);
        }
    }

    #[test]
    fn a_neck_through_the_floor_is_capped_flat_with_its_normal_down() {
        let f = |p: Vec3| (p.x.hypot(p.z) - 0.3).max(p.y - 0.5);
        let (mesh, report) = mesh_of(f, &coarse()).unwrap();
        assert!(report.topology.is_solid());
        assert!(report.capped > 0 && report.warnings(true).len() == 1);
        let low = mesh.bounds().min.y;
        assert!(low >= -1.0 && low < -1.0 + 1e-3 * report.cell_size);
        let middle = (0..mesh.positions.len())
            .filter(|&i| mesh.positions[i].y == low && mesh.positions[i].x.hypot(mesh.positions[i].z) < 0.2);
        assert!(middle.clone().count() > 10);
        assert!(middle.clone().all(|i| mesh.normals[i].distance(-Vec3::Y) < 1e-3));
    }

    #[test]
    fn floaters_and_a_hollow_are_removed_and_counted() {
        let f = |p: Vec3| {
            let shell = (p.length() - 0.6).max(0.3 - p.length());
            shell.min(p.distance(Vec3::splat(0.8)) - 0.1)
        };
        let (_, report) = mesh_of(f, &coarse()).unwrap();
        assert_eq!((report.clean.pieces, report.clean.dust, report.clean.inner_shells), (3, 1, 1));
        assert_eq!((report.topology.pieces, report.topology.euler), (1, 2));
    }

    #[test]
    fn a_field_without_a_surface_is_a_named_error_with_a_way_out() {
        let err = |f: fn(Vec3) -> f32| mesh_of(f, &coarse()).unwrap_err();
        let all = [
            (err(|_| 1.0), "AllOutside"),
            (err(|p| p.length() - 9.0), "AllInside"),
            (err(|_| f32::NAN), "NoneFinite"),
            (err(|_| f32::INFINITY), "NoneFinite"),
            (err(|_| -0.0), "AllOutside"),
        ];
        for (e, name) in all {
            assert!(format!("{e:?}").starts_with(name), "{e:?} is not {name}");
            assert!(e.hint().is_some());
        }
    }

    #[test]
    fn a_bad_configuration_names_its_key() {
        let bad = MeshConfig { keep_share: 2.0, ..coarse() };
        assert!(mesh_of(|p| p.length() - 0.5, &bad).unwrap_err().to_string().contains("keep_share"));
    }
}
