//! The flat face that closes a cut: a constrained Delaunay triangulation of its loops (Chew 1989),
//! with points within it (Ruppert 1995), so that colors at vertices do not run in streaks.

use glam::{DVec2, DVec3, Vec3};
use spade::{
    AngleLimit, ConstrainedDelaunayTriangulation, Point2, RefinementParameters, Triangulation,
    handles::FixedVertexHandle,
};
use std::collections::HashSet;
use tiface_base::{Error, Result};

/// Smallest angle that points within the face are added for, degrees; Ruppert's method ends up to
/// 20.7.
const ANGLE: f64 = 20.0;

/// A face, seen from below.
pub(super) struct Face {
    /// Positions of vertices within the face, after those on the rim.
    pub inner: Vec<Vec3>,
    /// All vertices in the coordinates of the face.
    pub flat: Vec<DVec2>,
    /// Triangles; first the vertices on the rim are numbered.
    pub triangles: Vec<[usize; 3]>,
    origin: DVec3,
    axes: [DVec3; 2],
}

impl Face {
    /// Returns the face within closed loops of `edges`, whose left is inside as seen from below.
    ///
    /// # Errors
    ///
    /// Fails if two edges cross or two vertices are at one place.
    pub fn new(rim: &[Vec3], edges: &[[usize; 2]], up: DVec3) -> Result<Face> {
        let origin = rim.iter().map(|p| p.as_dvec3()).sum::<DVec3>() / rim.len() as f64;
        let x = up.any_orthonormal_vector();
        let axes = [x, x.cross(up)];
        let flat: Vec<DVec2> =
            rim.iter().map(|p| DVec2::from(axes.map(|axis| axis.dot(p.as_dvec3() - origin)))).collect();
        let mut face = Face { inner: Vec::new(), flat, triangles: Vec::new(), origin, axes };
        face.triangulate(edges)?;
        face.inner = face.flat[rim.len()..].iter().map(|&p| face.at(p)).collect();
        Ok(face)
    }

    /// Returns a point of the face.
    pub fn at(&self, flat: DVec2) -> Vec3 {
        (self.origin + flat.x * self.axes[0] + flat.y * self.axes[1]).as_vec3()
    }

    fn triangulate(&mut self, edges: &[[usize; 2]]) -> Result<()> {
        let crossed = || {
            let hint = "move the plane a little; `check` counts where the mesh intersects itself";
            Error::cannot("the outline of the cut crosses itself", hint)
        };
        let mut plane = ConstrainedDelaunayTriangulation::<Point2<f64>>::new();
        let mut handles: Vec<FixedVertexHandle> = Vec::with_capacity(self.flat.len());
        for (k, p) in self.flat.iter().enumerate() {
            let handle = plane.insert(Point2::new(p.x, p.y)).map_err(|_| crossed())?;
            if handle.index() != k {
                return Err(crossed());
            }
            handles.push(handle);
        }
        for &[a, b] in edges {
            if plane.try_add_constraint(handles[a], handles[b]).len() != 1 {
                return Err(crossed());
            }
        }
        let refine = RefinementParameters::<f64>::new()
            .exclude_outer_faces(true)
            .keep_constraint_edges()
            .with_angle_limit(AngleLimit::from_deg(ANGLE))
            .with_max_additional_vertices(self.flat.len());
        plane.refine(refine);
        let added = plane.vertices().skip(self.flat.len()).map(|v| v.position());
        self.flat.extend(added.map(|p| DVec2::new(p.x, p.y)));

        // what is to the left of the loops, and what no loop parts from it
        let mut inside: HashSet<usize> = HashSet::new();
        let mut open = Vec::new();
        for &[a, b] in edges {
            let edge = plane.get_edge_from_neighbors(handles[a], handles[b]).ok_or_else(crossed)?;
            open.push(edge.face().as_inner().ok_or_else(crossed)?);
        }
        while let Some(face) = open.pop() {
            if !inside.insert(face.fix().index()) {
                continue;
            }
            self.triangles.push(face.vertices().map(|v| v.fix().index()));
            for edge in face.adjacent_edges().into_iter().filter(|e| !e.is_constraint_edge()) {
                open.push(edge.rev().face().as_inner().ok_or_else(crossed)?);
            }
        }
        Ok(())
    }
}
