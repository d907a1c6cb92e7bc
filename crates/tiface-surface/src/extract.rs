//! From a signed distance to a closed mesh with normals and colors.

mod blocks;
mod cap;
mod clean;
mod dense;
mod handles;
mod loops;
mod marching;
mod marching_cell;
mod node_grid;
mod polish;
mod sparse;

pub use cap::{Cap, RimVertex};
pub use clean::{CleanReport, clean};
pub use dense::extract_dense;
pub use handles::HandleReport;
pub use marching::{LevelSet, Volume, marching};
pub use sparse::{Sparse, sparse};

use super::smooth::{SmoothReport, smooth};
use super::{Warning, check_len, evaluate, setting};
use glam::Vec3;
use handles::cut_handles;
pub use node_grid::NodeGrid;
use polish::Polish;
use serde::{Deserialize, Serialize};
use std::time::Instant;
use tiface_base::error::{Cause, counted};
use tiface_base::geom::{Aabb, Mesh, SdfField, Topology, topology};
use tiface_base::{Error, Monitor, Result};

/// Options of the extraction.
#[derive(Clone, Debug, PartialEq)]
pub struct ExtractOptions {
    /// Cells along the longest side of the box; 2..=8192.
    pub resolution: usize,
    /// Cell step of the first evaluation of the field: 2, 4 or 8. Smaller steps find smaller loose
    /// pieces.
    pub coarse_step: usize,
    /// Handles are cut, or their holes filled, where they have a loop no longer than this share of
    /// the surface's longest side; 0..=1, 0 leaves them all.
    pub longest_handle: f32,
    /// Whether the noise of a learned field is taken out of the surface
    /// ([`smooth()`](crate::smooth)).
    pub smooth: bool,
}

/// The loops of locks and between them, not those of a body: 45 mm of a head with its neck, 300 mm
/// long, which is a strand or a hole as thick as a thumb. A share, because not every capture has a
/// known unit.
pub const MAX_HANDLE: f32 = 0.15;

/// Maximum number of points in one call of a field.
pub(super) const BATCH: usize = 1 << 16;

/// Newton steps that move vertices onto the field's zero.
const NEWTON_STEPS: usize = 2;

/// Share by which vertices move towards the mean of their neighbors in the first step.
const RELAX: f32 = 0.5;

impl Default for ExtractOptions {
    fn default() -> ExtractOptions {
        ExtractOptions { resolution: 512, coarse_step: 8, longest_handle: MAX_HANDLE, smooth: false }
    }
}

/// A report of [`extract`].
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MeshReport {
    /// Cells along x, y, z.
    pub cells: [usize; 3],
    /// Cell edge, in units of the bounds.
    pub cell_size: f32,
    /// Lower and upper corner of the grid: where caps lie.
    pub grid: [[f32; 3]; 2],
    /// Nodes at which the field was evaluated.
    pub nodes_evaluated: usize,
    /// Share of all nodes at which the field was evaluated, 0..=1.
    pub share_evaluated: f64,
    /// Nodes outside the hull, taken as outside without being evaluated.
    pub nodes_outside_hull: usize,
    /// Nodes whose value was not finite.
    pub non_finite: usize,
    /// Inside nodes on the faces of the box, where the surface was capped.
    pub capped: usize,
    /// The report of cleaning.
    pub clean: CleanReport,
    /// Mean |f| / |∇f| over vertices before they moved, in cells.
    pub off_surface_before: f64,
    /// Mean |f| / |∇f| after they moved, in cells.
    pub off_surface_after: f64,
    /// Number of vertices that a step moved less than the Newton step, because a face would have
    /// folded.
    pub held_back: usize,
    /// Handles that were cut, filled or left.
    pub handles: HandleReport,
    /// The report of smoothing, if the surface was smoothed.
    #[serde(default)]
    pub smoothed: Option<SmoothReport>,
    /// The finished mesh: closed, manifold, pieces, Euler number.
    pub topology: Topology,
    /// Enclosed volume, in units of the bounds cubed.
    pub volume: f64,
    /// Wall time.
    pub seconds: f64,
}

impl MeshReport {
    /// Returns the box of the grid.
    pub fn bounds(&self) -> Aabb {
        let [min, max] = self.grid.map(Vec3::from);
        Aabb { min, max }
    }

    /// Fills in the measurements of the finished mesh.
    fn measure(&mut self, mesh: &Mesh, begin: Instant) {
        self.topology = topology(&mesh.positions, &mesh.triangles);
        self.handles.left = self.topology.genus.map_or(0, |g| g as usize);
        self.volume = mesh.signed_volume();
        self.seconds = begin.elapsed().as_secs_f64();
    }

    /// Returns where the surface ends with the kept region, as every bust does; `cap` says whether
    /// the cap was kept.
    pub fn end(&self, cap: bool) -> Option<String> {
        let state = if cap { "is closed by a cap" } else { "is open" };
        (self.capped > 0).then(|| {
            format!("the surface {state} where the frames cut the body ({})", counted(self.capped, "node"))
        })
    }

    /// Returns what is doubtful of the surface, handles aside: [`HandleReport::warning`].
    pub fn warnings(&self) -> Vec<Warning> {
        let CleanReport { dust, inner_shells, dropped_triangles: triangles, .. } = self.clean;
        [
            (self.non_finite > 0).then_some(Warning::NotFinite(self.non_finite)),
            (triangles > 0).then_some(Warning::Removed { dust, inner_shells, triangles }),
            (!self.topology.is_solid()).then_some(Warning::NotSolid),
        ]
        .into_iter()
        .flatten()
        .collect()
    }
}

/// Meshes the zero level set of a field within `bounds`.
///
/// The field gets points of the same space as `bounds`, tens of thousands a call, from one thread.
/// Vertices are colored as they are seen along their normals.
///
/// The mesh is closed (capped where the field leaves the box), its vertices moved onto the field's
/// zero, its normals the field's gradient. Handles with a loop no longer than
/// `options.longest_handle` are removed. With `options.smooth` the vertices then leave the field's
/// zero, and normals are those of the smoothed surface.
///
/// ```
/// use glam::Vec3;
/// use tiface_base::geom::Aabb;
/// use tiface_surface::{ExtractOptions, extract};
///
/// let ball = |p: Vec3| p.length() - 0.7;
/// let options = ExtractOptions { resolution: 32, ..ExtractOptions::default() };
/// let (mesh, report) = extract(&ball, Aabb::SCENE, &options, &tiface_base::Quiet)?;
/// assert!(mesh.is_closed() && report.topology.genus == Some(0));
/// assert!(mesh.positions.iter().all(|p| (p.length() - 0.7).abs() < 1e-3));
/// # Ok::<(), tiface_base::Error>(())
/// ```
///
/// # Errors
///
/// A box or option out of range, a field without a surface, answers of the wrong length, a request
/// to stop.
pub fn extract(
    field: &dyn SdfField,
    bounds: Aabb,
    options: &ExtractOptions,
    monitor: &dyn Monitor,
) -> Result<(Mesh, MeshReport)> {
    let begin = Instant::now();
    let share = options.longest_handle;
    setting((0.0..=1.0).contains(&share), "ExtractOptions::longest_handle", "0..=1", share)?;
    let grid = NodeGrid::fit(bounds, options.resolution)?;
    let mut done = 0;
    let mut progress = |values: &[(&str, f64)]| {
        done += 1;
        monitor.step(done, NEWTON_STEPS as u64 + 4, values);
        monitor.check_stop()
    };

    let found = sparse(field, &grid, options.coarse_step, monitor)?;
    check_surface(&found)?;
    let mut report = MeshReport {
        cells: grid.dims.map(|d| d - 1),
        cell_size: grid.spacing,
        grid: [grid.origin.to_array(), grid.point(grid.dims.map(|d| d - 1)).to_array()],
        nodes_evaluated: found.evaluated,
        share_evaluated: found.evaluated as f64 / grid.nodes() as f64,
        nodes_outside_hull: found.skipped,
        non_finite: found.surface.non_finite,
        capped: found.surface.capped,
        ..MeshReport::default()
    };
    let mut mesh = found.surface.mesh;
    progress(&[("nodes", found.evaluated as f64), ("triangles", mesh.triangles.len() as f64)])?;

    report.clean = clean(&mut mesh)?;
    progress(&[("pieces", report.clean.pieces as f64), ("triangles", mesh.triangles.len() as f64)])?;

    let cap = Cap::bare(report.bounds(), grid.spacing);
    let on_faces = |mesh: &Mesh| -> Vec<bool> { mesh.positions.iter().map(|&p| cap.holds(p)).collect() };
    let capped = on_faces(&mesh);
    let gradient = |points: &[Vec3]| evaluate(field, points, BATCH, monitor);
    let polish = Polish::new(&mesh.positions, &mesh.triangles, 0.5 * grid.spacing, capped.clone());
    let (mut values, mut gradients) = gradient(&mesh.positions)?;
    report.off_surface_before = off_surface(&values, &gradients, &capped, grid.spacing);
    for step in 0..NEWTON_STEPS {
        let relax = if step == 0 { RELAX } else { 0.0 };
        report.held_back += polish.step(&mut mesh.positions, &values, &gradients, relax);
        (values, gradients) = gradient(&mesh.positions)?;
        progress(&[("held_back", report.held_back as f64)])?;
    }
    report.off_surface_after = off_surface(&values, &gradients, &capped, grid.spacing);

    let longest = share * mesh.bounds().size().max_element();
    if longest > 0.0 {
        report.handles = cut_handles(&mut mesh, longest, field, monitor)?;
    }
    // vertices whose normal is not the field's slope
    let mut edged = on_faces(&mesh);
    if report.handles.triangles > 0 {
        report.handles.patches(&mesh).as_flattened().iter().for_each(|&v| edged[v as usize] = true);
        gradients = gradient(&mesh.positions)?.1;
    }
    mesh.normals = field_normals(&mesh, &gradients, &edged);
    mesh.colors = colors_along_normals(&mesh, field)?;
    // after the colors, which the field knows at its own zero and along its own normals
    report.smoothed = options.smooth.then(|| smooth(&mut mesh, &edged));
    progress(&[("vertices", mesh.positions.len() as f64)])?;
    report.measure(&mesh, begin);
    progress(&[("euler", report.topology.euler as f64)])?;
    Ok((mesh, report))
}

/// Returns the field's slopes as normals; angle-weighted ones where vertices are `edged` or the
/// slope is unusable.
fn field_normals(mesh: &Mesh, gradients: &[Vec3], edged: &[bool]) -> Vec<Vec3> {
    let mut normals = mesh.angle_weighted_normals();
    for (i, normal) in normals.iter_mut().enumerate() {
        let g = gradients[i];
        if !edged[i] && g.is_finite() && g.length() >= 1e-6 {
            *normal = g.normalize();
        }
    }
    normals
}

/// Returns the colors of the vertices as seen along their normals; non-finite values become 0.
fn colors_along_normals(mesh: &Mesh, field: &dyn SdfField) -> Result<Vec<[f32; 3]>> {
    let mut out = Vec::with_capacity(mesh.positions.len());
    for (points, normals) in mesh.positions.chunks(BATCH).zip(mesh.normals.chunks(BATCH)) {
        let away: Vec<Vec3> = normals.iter().map(|n| -*n).collect();
        let colors = field.color(points, normals, &away);
        check_len("color", points.len(), colors.len())?;
        let tame = |c: f32| if c.is_finite() { c.clamp(0.0, 1.0) } else { 0.0 };
        out.extend(colors.iter().map(|c| c.map(tame)));
    }
    Ok(out)
}

/// Refuses an extraction that met no surface.
fn check_surface(found: &Sparse) -> Result<()> {
    let nodes = found.evaluated;
    let (smallest, largest) = found.range;
    if smallest > largest && nodes > 0 {
        return Err(no_surface(
            Cause::NowhereFinite,
            format!("the field is NaN or infinite at all {nodes} nodes evaluated"),
        ));
    }
    if largest < 0.0 && found.skipped == 0 && found.surface.non_finite == 0 && nodes > 0 {
        let how =
            format!("negative at all {nodes} nodes evaluated (largest {largest:.3e}), everything is inside");
        return Err(no_surface(Cause::AllInside, format!("the field is {how}")));
    }
    // with an empty hull nothing is evaluated: then the smallest is infinite
    if found.surface.mesh.triangles.is_empty() {
        let how =
            format!("positive at all {nodes} nodes evaluated (smallest {smallest:.3e}), nothing is inside");
        return Err(no_surface(Cause::AllOutside, format!("the field is {how}")));
    }
    Ok(())
}

/// Returns the error for a field without a surface, and how that shows.
fn no_surface(cause: Cause, how: String) -> Error {
    let hint = match cause {
        Cause::NowhereFinite => "a field must return finite numbers",
        Cause::AllInside => {
            "a field must be negative inside alone, and the bounds must reach out of the surface"
        }
        _ => "check that the bounds hold the surface, or raise the resolution for small pieces",
    };
    Error::cannot(format!("no surface: {how}"), hint).with_cause(cause)
}

/// Returns the mean first-order distance to the surface, in cells, over vertices that are not
/// capped.
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
    use crate::fixtures::Painted;
    use tiface_base::Quiet;

    fn mesh_of(f: impl Fn(Vec3) -> f32 + Sync, config: &ExtractOptions) -> Result<(Mesh, MeshReport)> {
        let paint = |_: &[Vec3], n: &[Vec3], _: &[u32], _: &[Vec3]| {
            n.iter().map(|n| (0.5 * *n + 0.5).to_array()).collect()
        };
        extract(&Painted { shape: f, paint }, Aabb::SCENE, config, &Quiet)
    }

    fn coarse() -> ExtractOptions {
        ExtractOptions { resolution: 48, ..ExtractOptions::default() }
    }

    #[test]
    fn a_sphere_comes_out_round_colored_and_closed() {
        let (mesh, report) = mesh_of(|p| p.length() - 0.7, &coarse()).unwrap();
        assert!(report.topology.is_solid());
        assert_eq!((report.topology.euler, report.topology.pieces), (2, 1));
        // On the surface to a thousandth of a cell; normals and colors radial.
        for (i, p) in mesh.positions.iter().enumerate() {
            assert!((p.length() - 0.7).abs() < 1e-3 * report.cell_size);
            assert!(mesh.normals[i].distance(p.normalize()) < 1e-3);
            assert!((Vec3::from(mesh.colors[i]) * 2.0 - 1.0).distance(mesh.normals[i]) < 1e-5);
        }
        // 4/3 π 0.7³ = 1.4368; inscribed, so a little less.
        assert!((1.43..1.4368).contains(&report.volume), "{}", report.volume);
        assert!(report.warnings().is_empty() && report.end(true).is_none(), "{:?}", report.warnings());
    }

    #[test]
    fn moving_leaves_no_slivers_and_turns_no_face() {
        let slivers = |m: &Mesh| {
            let poor = (0..m.triangles.len() as u32).filter(|&t| {
                let [a, b, c] = m.corners(t);
                let sum = (b - a).length_squared() + (c - b).length_squared() + (a - c).length_squared();
                2.0 * 3f32.sqrt() * (b - a).cross(c - a).length() / sum < 0.1
            });
            poor.count() as f64 / m.triangles.len() as f64
        };
        let f = |p: Vec3| p.length() - 0.7;
        let grid = NodeGrid::fit(Aabb::SCENE, coarse().resolution).unwrap();
        let before = sparse(&f, &grid, 8, &Quiet).unwrap().surface.mesh;
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
        // the cut of a bust is told, and is no warning
        assert!(report.capped > 0 && report.warnings().is_empty(), "{:?}", report.warnings());
        assert!(report.end(true).unwrap().contains("closed by a cap"));
        assert!(report.end(false).unwrap().contains("is open"));
        let low = mesh.bounds().min.y;
        assert!(low >= -1.0 && low < -1.0 + 1e-3 * report.cell_size);
        let middle = (0..mesh.positions.len())
            .filter(|&i| mesh.positions[i].y == low && mesh.positions[i].x.hypot(mesh.positions[i].z) < 0.2);
        assert!(middle.clone().count() > 10);
        assert!(middle.clone().all(|i| mesh.normals[i].distance(-Vec3::Y) < 1e-3));
    }

    #[test]
    fn floaters_and_a_hollow_are_removed_and_counted() {
        // the floater is wider than a coarse cell of the sparse grid, which may miss smaller ones
        let f = |p: Vec3| {
            let shell = (p.length() - 0.6).max(0.3 - p.length());
            shell.min(p.distance(Vec3::splat(0.75)) - 0.2)
        };
        let (_, report) = mesh_of(f, &coarse()).unwrap();
        assert_eq!((report.clean.pieces, report.clean.dust, report.clean.inner_shells), (3, 1, 1));
        assert_eq!((report.topology.pieces, report.topology.euler), (1, 2));
    }

    #[test]
    fn a_field_without_a_surface_is_a_named_error_with_a_hint() {
        let err = |f: fn(Vec3) -> f32| mesh_of(f, &coarse()).unwrap_err();
        let all = [
            (err(|_| 1.0), "nothing is inside"),
            (err(|p| p.length() - 9.0), "everything is inside"),
            (err(|_| f32::NAN), "NaN or infinite"),
            (err(|_| f32::INFINITY), "NaN or infinite"),
            (err(|_| -0.0), "nothing is inside"),
        ];
        for (e, name) in all {
            assert!(e.to_string().contains(name), "{e} is not {name}");
            assert!(!e.hint().is_empty());
        }
    }

    #[test]
    fn a_bad_option_is_named() {
        let bad = ExtractOptions { longest_handle: 2.0, ..coarse() };
        assert!(
            mesh_of(|p| p.length() - 0.5, &bad)
                .unwrap_err()
                .to_string()
                .contains("`ExtractOptions::longest_handle` is 2")
        );
    }
}
