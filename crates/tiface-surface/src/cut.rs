//! Cut of a closed head mesh by a plane, closed again by a flat face.
//!
//! No vertex may lie on the plane: a cut through vertices leaves triangles without area, and loops
//! that touch. So the plane moves along its normal to the middle of the widest gap between vertices
//! nearby, by a thousandth of the mesh's diagonal at most, and then crosses every triangle in two
//! edges or none: a closed manifold is cut in simple closed loops. What is kept of the triangles
//! lies on the old ones, and the face between the loops on the plane, so nothing comes to intersect
//! that did not before.
//!
//! - `face`: the constrained Delaunay triangulation of the loops; every vertex on them is used, so
//!   the surface is closed whatever lies on a line.
//! - `paint`: the face's chart, in the largest free square of the texture.

mod face;
mod paint;

use crate::files::{HeadMesh, HeadTexture};
use crate::{check_indices, damaged, finite};
use face::Face;
use glam::{DVec3, Vec2, Vec3};
use paint::FaceChart;
use std::collections::HashMap;
use tiface_base::geom::{Atlas, Harmonics, Mesh, Sets, ShellLayer, Shells};
use tiface_base::{Error, Result};

/// A plane that cuts a mesh.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plane {
    /// A point on it.
    pub point: Vec3,
    /// Its normal, of any length but 0, towards what is kept.
    pub normal: Vec3,
}

impl Plane {
    /// Returns the signed distance of a point, positive on the side that is kept.
    pub fn height(&self, point: Vec3) -> f64 {
        (point - self.point).as_dvec3().dot(self.normal.as_dvec3().normalize_or_zero())
    }
}

/// How a mesh was cut.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CutReport {
    /// Distance by which the plane was moved along its normal, to lie between vertices.
    pub moved: f64,
    /// Number of pieces on the kept side that did not hang together with the largest; they are left
    /// out.
    pub dropped: usize,
    /// Number of loops around the face.
    pub loops: usize,
    /// Number of triangles of the face.
    pub face_triangles: usize,
}

/// Farthest that a plane moves, in diagonals of the mesh's box.
const MAX_MOVE: f64 = 1e-3;

/// Returns what of a closed head is above a plane, closed by a flat face, and how it was cut: the
/// largest piece by area. The face takes its color from its rim; it has no view-dependent color, no
/// bumps and no soft layers, and layers fade out towards it. Charts stay where they are; that of
/// the face lies `gutter_px` from them. Parts of a chart that the plane divides may lie closer to
/// each other; the texels between keep the colors of the skin that was there, which belong to both.
///
/// Vertices on the rim belong to both sides of the edge, and keep the normals of the skin.
///
/// # Errors
///
/// Fails if the mesh is damaged or not closed, if the plane does not cross it, if its outline
/// crosses itself there, or if the texture has no room for the face.
pub fn cut(head: &HeadMesh, plane: &Plane, gutter_px: u32) -> Result<(HeadMesh, CutReport)> {
    let mesh = &head.mesh;
    finite(mesh)?;
    check_indices(mesh)?;
    if !mesh.is_closed() {
        return Err(damaged("the mesh is not watertight, so a cut has no inside to close".into()));
    }
    if plane.normal.try_normalize().is_none() || !plane.point.is_finite() {
        return Err(Error::usage(format!("{plane:?} is no plane"), "give it a point and a direction"));
    }
    let mut heights: Vec<f64> = mesh.positions.iter().map(|&p| plane.height(p)).collect();
    let moved = clearance(&heights, MAX_MOVE * f64::from(mesh.bounds().size().length()));
    heights.iter_mut().for_each(|h| *h -= moved);
    let above = heights.iter().filter(|h| **h > 0.0).count();
    if above == 0 || above == heights.len() {
        let side = if above == 0 { "below" } else { "above" };
        let what = format!("the plane does not cross the mesh, which lies {side} it as a whole");
        return Err(Error::usage(what, "choose a plane through the mesh, or leave the cut out"));
    }
    let mut halved = Halved::new(head, &heights);
    let dropped = halved.keep_largest(mesh);
    let normal = plane.normal.as_dvec3().normalize();
    let face = Face::new(&halved.rim_positions(mesh), &halved.rim_edges(), normal)?;
    let loops = halved.loops();
    let first = halved.vertices.len() as u32;
    halved.vertices.extend(face.inner.iter().map(|&p| VertexSource::Face(p)));
    let rim = halved.rim();
    let number = |v: usize| if v < rim.len() { rim[v] } else { first + (v - rim.len()) as u32 };
    let face_triangles: Vec<[u32; 3]> = face.triangles.iter().map(|t| t.map(number)).collect();
    let report = CutReport { moved, dropped, loops, face_triangles: face_triangles.len() };
    let out = assembled(head, halved, &face, &face_triangles, -normal.as_vec3(), gutter_px)?;
    Ok((out, report))
}

/// Returns the middle of the widest gap between heights from `-most` to `most`, the nearest to 0
/// among equals.
fn clearance(heights: &[f64], most: f64) -> f64 {
    let mut near: Vec<f64> = heights.iter().copied().filter(|h| h.abs() < most).collect();
    near.extend([-most, most]);
    near.sort_unstable_by(f64::total_cmp);
    let widest = near.windows(2).max_by(|a, b| {
        let middle = |w: &[f64]| (0.5 * (w[0] + w[1])).abs();
        (a[1] - a[0]).total_cmp(&(b[1] - b[0])).then(middle(b).total_cmp(&middle(a)))
    });
    widest.map_or(0.0, |w| 0.5 * (w[0] + w[1]))
}

/// Where a vertex, or a texture coordinate, of the cut mesh comes from.
#[derive(Clone, Copy)]
enum VertexSource<T> {
    /// One of the mesh.
    Kept(u32),
    /// A point between one above the plane and one below, at this share of the way down.
    Edge([u32; 2], f32),
    /// A point of the face.
    Face(T),
}

impl<T: Copy> VertexSource<T> {
    /// Returns the value of a vertex: `of` has those of the mesh, `own` that of the face.
    fn value<V>(self, of: impl Fn(u32) -> V, mix: impl Fn(V, V, f32) -> V, own: impl Fn(T) -> V) -> V {
        match self {
            VertexSource::Kept(v) => of(v),
            VertexSource::Edge([a, b], t) => mix(of(a), of(b), t),
            VertexSource::Face(value) => own(value),
        }
    }
}

/// What is above a plane, open.
struct Halved {
    vertices: Vec<VertexSource<Vec3>>,
    triangles: Vec<[u32; 3]>,
    uvs: Vec<VertexSource<Vec2>>,
    /// Texture coordinates of the triangles; empty without a texture.
    corners: Vec<[u32; 3]>,
    /// Edges on the plane, along the triangles above it, and the texture coordinate of the first
    /// vertex.
    edges: Vec<([u32; 2], u32)>,
}

/// Points on the edges of one index space, made once for each edge.
struct EdgePoints<'a, T> {
    all: &'a mut Vec<VertexSource<T>>,
    known: &'a mut HashMap<[u32; 2], u32>,
}

impl<T> EdgePoints<'_, T> {
    fn at(&mut self, above: u32, below: u32, t: f32) -> u32 {
        *self.known.entry([above, below]).or_insert_with(|| {
            self.all.push(VertexSource::Edge([above, below], t));
            self.all.len() as u32 - 1
        })
    }
}

impl Halved {
    fn new(head: &HeadMesh, heights: &[f64]) -> Halved {
        let (mesh, atlas) = (&head.mesh, head.texture.as_ref().map(|t| &t.atlas));
        let mut vertices: Vec<_> = (0..mesh.positions.len() as u32).map(VertexSource::Kept).collect();
        let uv_count = atlas.map_or(0, |a| a.uvs.len() as u32);
        let mut uvs: Vec<_> = (0..uv_count).map(VertexSource::Kept).collect();
        let (mut triangles, mut corners, mut edges) = (Vec::new(), Vec::new(), Vec::new());
        let (mut on_edges, mut on_uv_edges) = (HashMap::new(), HashMap::new());
        let is_above = |v: u32| heights[v as usize] > 0.0;
        for (t, triangle) in mesh.triangles.iter().enumerate() {
            let count = triangle.iter().filter(|&&v| is_above(v)).count();
            let own = atlas.map(|a| a.triangles[t]);
            if count == 3 {
                triangles.push(*triangle);
                corners.extend(own);
            }
            if count % 3 == 0 {
                continue;
            }
            // the corner that is alone on its side comes first
            let alone = (0..3).find(|&k| is_above(triangle[k]) == (count == 1)).unwrap_or(0);
            let turned = |t: [u32; 3]| [0, 1, 2].map(|k| t[(alone + k) % 3]);
            let [a, b, c] = turned(*triangle);
            let share = |above: u32, below: u32| {
                let [above, below] = [above, below].map(|v| heights[v as usize]);
                (above / (above - below)) as f32
            };
            let down = |from: u32, to: u32| if count == 1 { [from, to] } else { [to, from] };
            let [ab, ac] = [down(a, b), down(a, c)];
            let [on_b, on_c] = [share(ab[0], ab[1]), share(ac[0], ac[1])];
            let mut points = EdgePoints { all: &mut vertices, known: &mut on_edges };
            let [p, q] = [points.at(ab[0], ab[1], on_b), points.at(ac[0], ac[1], on_c)];
            let uv = own.map(turned).map(|[a, b, c]| {
                let [ab, ac] = [down(a, b), down(a, c)];
                let mut points = EdgePoints { all: &mut uvs, known: &mut on_uv_edges };
                ([a, b, c], [points.at(ab[0], ab[1], on_b), points.at(ac[0], ac[1], on_c)])
            });
            if count == 1 {
                triangles.push([a, p, q]);
                corners.extend(uv.map(|([a, ..], [p, q])| [a, p, q]));
                edges.push(([p, q], uv.map_or(0, |(_, [p, _])| p)));
                continue;
            }
            let at = |v: u32| mesh.positions[v as usize];
            let [on_ab, on_ac] = [at(b).lerp(at(a), on_b), at(c).lerp(at(a), on_c)];
            let is_first = at(b).distance_squared(on_ac) <= at(c).distance_squared(on_ab);
            let halves = |[_, b, c]: [u32; 3], [p, q]: [u32; 2]| {
                if is_first { [[b, c, q], [b, q, p]] } else { [[b, c, p], [c, q, p]] }
            };
            triangles.extend(halves([a, b, c], [p, q]));
            corners.extend(uv.into_iter().flat_map(|(abc, pq)| halves(abc, pq)));
            edges.push(([q, p], uv.map_or(0, |(_, [_, q])| q)));
        }
        Halved { vertices, triangles, uvs, corners, edges }
    }

    fn position(&self, mesh: &Mesh, vertex: u32) -> Vec3 {
        position(mesh, self.vertices[vertex as usize])
    }

    /// Keeps the piece of the largest area, and returns the number of the others.
    fn keep_largest(&mut self, mesh: &Mesh) -> usize {
        let mut sets = Sets::of_pieces(self.vertices.len(), &self.triangles);
        let mut areas: HashMap<u32, f64> = HashMap::new();
        for t in &self.triangles {
            let [a, b, c] = t.map(|v| self.position(mesh, v).as_dvec3());
            *areas.entry(sets.find(t[0])).or_default() += (b - a).cross(c - a).length();
        }
        let largest = areas.iter().max_by(|a, b| a.1.total_cmp(b.1).then(b.0.cmp(a.0)));
        let Some((&largest, _)) = largest else { return 0 };
        let is_kept: Vec<bool> = self.triangles.iter().map(|t| sets.find(t[0]) == largest).collect();
        let mut kept = is_kept.iter();
        self.triangles.retain(|_| kept.next() == Some(&true));
        let mut kept = is_kept.iter();
        self.corners.retain(|_| kept.next() == Some(&true));
        self.edges.retain(|([a, _], _)| sets.find(*a) == largest);
        areas.len() - 1
    }

    /// Returns the vertices on the rim, in the order of the edges.
    fn rim(&self) -> Vec<u32> {
        self.edges.iter().map(|([a, _], _)| *a).collect()
    }

    fn rim_positions(&self, mesh: &Mesh) -> Vec<Vec3> {
        self.edges.iter().map(|([a, _], _)| self.position(mesh, *a)).collect()
    }

    /// Returns the edges of the face, in the numbers of [`Halved::rim`]: against those above.
    fn rim_edges(&self) -> Vec<[usize; 2]> {
        let number: HashMap<u32, usize> = self.rim().into_iter().zip(0..).collect();
        self.edges.iter().map(|([a, b], _)| [number[b], number[a]]).collect()
    }

    fn loops(&self) -> usize {
        let mut sets = Sets::new(self.edges.len());
        let edges = self.rim_edges();
        edges.iter().for_each(|&[a, b]| sets.join(a as u32, b as u32));
        (0..self.edges.len() as u32).filter(|&v| sets.find(v) == v).count()
    }
}

/// Returns the position of a vertex.
fn position(mesh: &Mesh, source: VertexSource<Vec3>) -> Vec3 {
    let exact = |v: u32| mesh.positions[v as usize].as_dvec3();
    let mix = |a: DVec3, b: DVec3, t: f32| a.lerp(b, f64::from(t));
    source.value(exact, mix, |p| p.as_dvec3()).as_vec3()
}

/// Puts a cut mesh together.
fn assembled(
    head: &HeadMesh,
    halved: Halved,
    face: &Face,
    face_triangles: &[[u32; 3]],
    down: Vec3,
    gutter_px: u32,
) -> Result<HeadMesh> {
    let from = &head.mesh;
    let painted = head.texture.as_ref().map(|texture| textured(from, &halved, texture, face, gutter_px));
    let texture = painted.transpose()?;
    let rim_colors = paint::rim_of_colors(from, &halved);
    let Halved { vertices, mut triangles, .. } = halved;
    triangles.extend(face_triangles);
    let (vertices, triangles) = used(&vertices, &triangles);
    let each = |of: &dyn Fn(VertexSource<Vec3>) -> Vec3| vertices.iter().map(|&v| of(v)).collect::<Vec<_>>();
    let has = |count: usize| count > 0;
    let mut mesh = Mesh { positions: each(&|v| position(from, v)), triangles, ..Mesh::default() };
    if has(from.normals.len()) {
        let normal = |v: u32| from.normals[v as usize];
        mesh.normals = each(&|v| v.value(normal, |a, b, t| a.lerp(b, t).normalize_or(down), |_| down));
    }
    if let Some(rim) = &rim_colors {
        let color = |v: u32| Vec3::from(from.colors[v as usize]);
        let colors = each(&|v| v.value(color, |a, b, t| a.lerp(b, t), |p| Vec3::from(rim.color(p))));
        mesh.colors = colors.iter().map(Vec3::to_array).collect();
    }
    if has(from.seen_by.len()) {
        // no camera sees the face
        let seen = |v: &VertexSource<Vec3>| v.value(|v| from.seen_by[v as usize], |a, b, _| a.min(b), |_| 0);
        mesh.seen_by = vertices.iter().map(seen).collect();
    }
    let number =
        |of: &[f32], v: VertexSource<Vec3>| v.value(|v| of[v as usize], |a, b, t| a + t * (b - a), |_| 0.0);
    let layer = |layer: &ShellLayer| ShellLayer {
        offsets: vertices.iter().map(|&v| number(&layer.offsets, v)).collect(),
        // none of a layer's triangles is the face's: it ends where the vertices on the rim have no
        // opacity
        alphas: (vertices.iter())
            .map(|&v| if let VertexSource::Kept(v) = v { layer.alphas[v as usize] } else { 0.0 })
            .collect(),
    };
    let bottom = mesh.positions.iter().map(|p| p.dot(down)).fold(f32::MIN, f32::max);
    // what is opaque under the layers stays above the face, at least half as high as the mesh
    let depth = |depths: &[f32], v: u32| {
        let (p, n, depth) = (from.positions[v as usize], from.normals[v as usize], depths[v as usize]);
        let sinks = -n.dot(down);
        if sinks > 0.0 { depth.min(0.5 * (bottom - p.dot(down)) / sinks) } else { depth }
    };
    let shells = head.shells.as_ref().map(|Shells { layers, depths }| Shells {
        layers: layers.iter().map(layer).collect(),
        depths: match depths.is_empty() {
            true => Vec::new(),
            // neither does the face sink in where the rim has no layer
            false => (vertices.iter())
                .map(|&v| if let VertexSource::Kept(v) = v { depth(depths, v) } else { 0.0 })
                .collect(),
        },
    });
    let harmonics = head.harmonics.as_ref().map(|harmonics| {
        let n = harmonics.functions;
        let one = |k: usize, v: VertexSource<Vec3>| {
            let of = |v: u32| Vec3::from(harmonics.coefficients[v as usize * n + k]);
            v.value(of, |a, b, t| a.lerp(b, t), |_| Vec3::ZERO).to_array()
        };
        let coefficients = vertices.iter().flat_map(|&v| (0..n).map(move |k| (k, v)));
        Harmonics { coefficients: coefficients.map(|(k, v)| one(k, v)).collect(), ..harmonics.clone() }
    });
    Ok(HeadMesh { mesh, world_from_scene: head.world_from_scene, texture, harmonics, shells })
}

/// Returns the texture of a cut mesh: the old one, with a chart of the face in a free place.
fn textured(
    mesh: &Mesh,
    halved: &Halved,
    texture: &HeadTexture,
    face: &Face,
    gutter_px: u32,
) -> Result<HeadTexture> {
    let (mut uvs, mut corners) = (halved.uvs.clone(), halved.corners.clone());
    let all = |uvs: &[VertexSource<Vec2>]| -> Vec<Vec2> {
        let of = |v: u32| texture.atlas.uvs[v as usize];
        uvs.iter().map(|uv| uv.value(of, |a, b, t| a.lerp(b, t), |uv| uv)).collect()
    };
    let Atlas { width, height, .. } = texture.atlas;
    let open = Atlas { uvs: all(&uvs), triangles: corners.clone(), width, height };
    let chart = FaceChart::place(&open, mesh_area(mesh, halved), face, gutter_px)?;
    let first = uvs.len() as u32;
    uvs.extend(face.flat.iter().map(|&p| VertexSource::Face(chart.uv(p))));
    corners.extend(face.triangles.iter().map(|t| t.map(|v| first + v as u32)));
    let (uvs, triangles) = used(&uvs, &corners);
    let rim = paint::rim_of_texture(mesh, halved, &open, &texture.color);
    let atlas = Atlas { uvs: all(&uvs), triangles, width, height };
    Ok(HeadTexture { atlas, ..chart.painted(texture, face, &rim) })
}

/// Returns the area of what is kept.
fn mesh_area(mesh: &Mesh, halved: &Halved) -> f64 {
    let area = |t: &[u32; 3]| {
        let [a, b, c] = t.map(|v| halved.position(mesh, v).as_dvec3());
        0.5 * (b - a).cross(c - a).length()
    };
    halved.triangles.iter().map(area).sum()
}

/// Returns the sources that triangles use, in their order, and the triangles in their numbers.
fn used<T: Copy>(all: &[VertexSource<T>], triangles: &[[u32; 3]]) -> (Vec<VertexSource<T>>, Vec<[u32; 3]>) {
    let mut to = vec![u32::MAX; all.len()];
    triangles.as_flattened().iter().for_each(|&v| to[v as usize] = 0);
    let mut kept = Vec::new();
    for (source, slot) in all.iter().zip(&mut to).filter(|(_, slot)| **slot == 0) {
        *slot = kept.len() as u32;
        kept.push(*source);
    }
    (kept, triangles.iter().map(|t| t.map(|v| to[v as usize])).collect())
}

#[cfg(test)]
mod tests;
