//! Robust bundle adjustment: poses and points that explain where patches were found.
//!
//! Minimizes the sum of `c² log(1 + ‖r‖² / c²)` (Cauchy) over all sightings, where `r` is the
//! distance in pixels between the projection of a point and its sighting, plus a weak prior that
//! keeps cameras near their given poses. Iterates Levenberg–Marquardt with weights
//! `1 / (1 + ‖r‖² / c²)`; points are eliminated, so that the system to solve has six unknowns for
//! each camera (the Schur complement: Triggs, McLauchlan, Hartley, Fitzgibbon 2000, "Bundle
//! Adjustment — A Modern Synthesis"). A camera moves by `R ← R exp(ω)`, `C ← C + t`. The matrix is
//! small and dense.

use glam::{DMat3, DQuat, DVec2, DVec3, Vec3};
use rayon::prelude::*;
use tiface_base::geom::{Camera, Similarity};
use tiface_base::math::{cholesky::solve, rank};

/// Standard deviation of a camera's rotation before any measurement, radians: 0.3°.
const PRIOR_TURN: f64 = 0.3 * std::f64::consts::PI / 180.0;

/// Standard deviation of a camera's position before any measurement, scene units: 3 mm of a head
/// that is 0.3 m high.
const PRIOR_SHIFT: f64 = 0.02;

/// Maximum number of Levenberg–Marquardt steps, rejected ones included.
const STEPS: usize = 25;

/// The iteration ends once a step lowers the cost by less than this share.
const CONVERGED: f64 = 1e-4;

/// Pieces that sums over tracks are split into; a constant, so that their order does not depend on
/// the threads.
const PIECES: usize = 8;

/// Where a point was found in a photograph.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sighting {
    /// Index of the view.
    pub view: usize,
    /// Position in its picture, pixel centers at +0.5.
    pub pixel: DVec2,
}

/// A point of the surface with its sightings.
#[derive(Clone, Debug, PartialEq)]
pub struct Track {
    /// Position, scene units.
    pub position: DVec3,
    /// Unit normal of the surface.
    pub normal: Vec3,
    /// Where it was found; at most once in each view.
    pub sightings: Vec<Sighting>,
}

/// Returns the picture position of a point; `None` behind the camera.
pub fn project(camera: &Camera, point: DVec3) -> Option<DVec2> {
    camera.project_f64(point).map(|(pixel, _)| pixel)
}

/// The residual of a sighting in pixels with its derivatives: columns by ω, t and the point's
/// position.
struct Linear {
    residual: DVec2,
    camera: [DVec2; 6],
    point: [DVec2; 3],
}

impl Linear {
    fn new(camera: &Camera, point: DVec3, pixel: DVec2) -> Option<Linear> {
        let p = camera.local(point);
        let (DVec2 { x, y }, depth) = Camera::ideal(p)?;
        let [[ux, uy], [vx, vy]] = camera.distortion.slopes(x, y);
        // of (x, y) by the three coordinates of p; `map` of an array would be a call an element
        let focal = DVec2::new(camera.fx, camera.fy);
        let picture = |x: f64, y: f64| focal * DVec2::new(ux * x + uy * y, vx * x + vy * y);
        let by_p = [picture(1.0 / depth, 0.0), picture(0.0, -1.0 / depth), picture(x / depth, y / depth)];
        let along = |d: DVec3| d.x * by_p[0] + d.y * by_p[1] + d.z * by_p[2];
        let moved = |e: DVec3| along(camera.rotation.transpose() * e);
        let point = [moved(DVec3::X), moved(DVec3::Y), moved(DVec3::Z)];
        let turned = |e: DVec3| along(p.cross(e));
        let [a, b, c] = [turned(DVec3::X), turned(DVec3::Y), turned(DVec3::Z)];
        let camera_slopes = [a, b, c, -point[0], -point[1], -point[2]];
        let residual = camera.pixel(DVec2::new(x, y)) - pixel;
        Some(Linear { residual, camera: camera_slopes, point })
    }
}

/// A track's equations with its point eliminated.
struct Eliminated {
    /// Inverse of the damped normal matrix of the point.
    inverse: DMat3,
    /// Gradient by the point.
    gradient: DVec3,
    /// For each sighting by a free camera: its unknowns' place, and the weighted residual and
    /// derivatives.
    free: Vec<(usize, f64, Linear, [DVec3; 6])>,
}

/// Cameras, tracks and which cameras move.
#[derive(Clone, Copy)]
struct Problem<'a> {
    given: &'a [Camera],
    /// The place of each camera's six unknowns; `None` for a camera that stays.
    places: &'a [Option<usize>],
    /// Whether points stay.
    fixed_points: bool,
    /// Residual of half weight, pixels.
    scale: f64,
    damping: f64,
}

impl Problem<'_> {
    fn weight(&self, residual: DVec2) -> f64 {
        1.0 / (1.0 + residual.length_squared() / (self.scale * self.scale))
    }

    fn eliminate(&self, cameras: &[Camera], track: &Track) -> Eliminated {
        let (mut normal, mut gradient, mut free) = (DMat3::ZERO, DVec3::ZERO, Vec::new());
        for s in &track.sightings {
            let Some(l) = Linear::new(&cameras[s.view], track.position, s.pixel) else { continue };
            let w = self.weight(l.residual);
            let [x, y, z] = l.point;
            let weighted = |by: DVec2| DVec3::new(w * x.dot(by), w * y.dot(by), w * z.dot(by));
            normal += DMat3::from_cols(weighted(x), weighted(y), weighted(z));
            gradient += weighted(l.residual);
            if let Some(place) = self.places[s.view] {
                let [a, b, c, d, e, f] = l.camera;
                let mixed = [weighted(a), weighted(b), weighted(c), weighted(d), weighted(e), weighted(f)];
                free.push((place, w, l, mixed));
            }
        }
        let damp = 1.0 + self.damping;
        for k in 0..3 {
            normal.col_mut(k)[k] = normal.col(k)[k] * damp + 1e-6;
        }
        let inverse = if self.fixed_points { DMat3::ZERO } else { normal.inverse() };
        Eliminated { inverse, gradient, free }
    }

    /// Returns the step of a track's point after its cameras have moved by `step`.
    fn point_step(&self, cameras: &[Camera], track: &Track, step: &[f64]) -> DVec3 {
        let e = self.eliminate(cameras, track);
        let mut gradient = e.gradient;
        for (place, _, _, mixed) in &e.free {
            (0..6).for_each(|k| gradient += step[place + k] * mixed[k]);
        }
        -(e.inverse * gradient)
    }

    /// Adds a track's part of the reduced system `matrix · step = −vector`, lower half.
    fn add(&self, cameras: &[Camera], track: &Track, matrix: &mut [f64], vector: &mut [f64]) {
        let n = vector.len();
        let e = self.eliminate(cameras, track);
        for (place, w, l, mixed) in &e.free {
            let mut reduced = *mixed;
            reduced.iter_mut().for_each(|m| *m = e.inverse * *m);
            for i in 0..6 {
                let row = &mut matrix[(place + i) * n..][..n];
                for k in 0..=i {
                    row[place + k] += w * l.camera[i].dot(l.camera[k]);
                }
                for (other, _, _, theirs) in e.free.iter().filter(|f| f.0 <= *place) {
                    for k in 0..6 {
                        row[other + k] -= reduced[i].dot(theirs[k]);
                    }
                }
                vector[place + i] += w * l.camera[i].dot(l.residual) - reduced[i].dot(e.gradient);
            }
        }
    }

    /// Adds the prior of the free cameras and their damping.
    fn add_prior(&self, cameras: &[Camera], matrix: &mut [f64], vector: &mut [f64]) {
        let n = vector.len();
        for (camera, (given, place)) in cameras.iter().zip(self.given.iter().zip(self.places)) {
            let Some(place) = *place else { continue };
            let moved = motion(given, camera);
            for k in 0..6 {
                let weight = prior_weight(k);
                let diagonal = &mut matrix[(place + k) * (n + 1)];
                *diagonal = *diagonal * (1.0 + self.damping) + weight;
                vector[place + k] += weight * moved[k];
            }
        }
    }

    /// Returns the reduced system, lower half, and its right side.
    fn system(&self, cameras: &[Camera], tracks: &[Track]) -> (Vec<f64>, Vec<f64>) {
        let n = 6 * self.places.iter().flatten().count();
        let part = |tracks: &[Track]| {
            let (mut matrix, mut vector) = (vec![0.0; n * n], vec![0.0; n]);
            tracks.iter().for_each(|track| self.add(cameras, track, &mut matrix, &mut vector));
            (matrix, vector)
        };
        let parts: Vec<_> = pieces(tracks).map(part).collect();
        let (mut matrix, mut vector) = (vec![0.0; n * n], vec![0.0; n]);
        for (m, v) in parts {
            matrix.iter_mut().zip(m).for_each(|(sum, m)| *sum += m);
            vector.iter_mut().zip(v).for_each(|(sum, v)| *sum += v);
        }
        self.add_prior(cameras, &mut matrix, &mut vector);
        (matrix, vector)
    }

    fn cost(&self, cameras: &[Camera], tracks: &[Track]) -> f64 {
        let square = self.scale * self.scale;
        let of = |track: &Track| -> f64 {
            let cost = |s: &Sighting| match project(&cameras[s.view], track.position) {
                Some(found) => square * (1.0 + found.distance_squared(s.pixel) / square).ln(),
                None => f64::INFINITY,
            };
            track.sightings.iter().map(cost).sum()
        };
        let parts: Vec<f64> = pieces(tracks).map(|tracks| tracks.iter().map(of).sum()).collect();
        let prior = |(camera, given): (&Camera, &Camera)| -> f64 {
            let moved = motion(given, camera);
            (0..6).map(|k| prior_weight(k) * moved[k] * moved[k]).sum()
        };
        parts.iter().sum::<f64>() + cameras.iter().zip(self.given).map(prior).sum::<f64>()
    }

    /// Moves the free cameras and the points until they fit the sightings.
    fn minimize(mut self, cameras: &mut [Camera], tracks: &mut [Track]) {
        let mut cost = self.cost(cameras, tracks);
        for _ in 0..STEPS {
            let (matrix, vector) = self.system(cameras, tracks);
            let candidate = solve(matrix, negated(&vector)).map(|step| {
                let camera = |(camera, place): (&Camera, &Option<usize>)| match place {
                    Some(place) => moved(camera, &step[*place..][..6]),
                    None => camera.clone(),
                };
                let stepped: Vec<Camera> = cameras.iter().zip(self.places).map(camera).collect();
                let point = |t: &Track| Track {
                    position: t.position + self.point_step(cameras, t, &step),
                    ..t.clone()
                };
                let points: Vec<Track> = tracks.par_iter().map(point).collect();
                (self.cost(&stepped, &points), stepped, points)
            });
            match candidate {
                Some((lower, stepped, points)) if lower < cost => {
                    cameras.clone_from_slice(&stepped);
                    tracks.clone_from_slice(&points);
                    let gained = (cost - lower) / cost;
                    cost = lower;
                    self.damping = (0.2 * self.damping).max(1e-9);
                    if gained < CONVERGED {
                        break;
                    }
                }
                _ if self.damping > 1e3 => break,
                _ => self.damping *= 10.0,
            }
        }
    }
}

fn pieces(tracks: &[Track]) -> impl IndexedParallelIterator<Item = &[Track]> {
    tracks.par_chunks(tracks.len().div_ceil(PIECES).max(1))
}

/// Returns the right side of a step down a gradient.
fn negated(gradient: &[f64]) -> Vec<f64> {
    gradient.iter().map(|v| -v).collect()
}

fn prior_weight(unknown: usize) -> f64 {
    let deviation = if unknown < 3 { PRIOR_TURN } else { PRIOR_SHIFT };
    1.0 / (deviation * deviation)
}

/// Returns ω and t that bring a camera from one pose to another, for small rotations.
fn motion(from: &Camera, to: &Camera) -> [f64; 6] {
    let turn = from.rotation.transpose() * to.rotation;
    let (x, y, z) = (turn.x_axis, turn.y_axis, turn.z_axis);
    let t = to.position - from.position;
    [0.5 * (y.z - z.y), 0.5 * (z.x - x.z), 0.5 * (x.y - y.x), t.x, t.y, t.z]
}

/// Returns a camera moved by ω and t.
fn moved(camera: &Camera, step: &[f64]) -> Camera {
    let turn = DMat3::from_quat(DQuat::from_scaled_axis(DVec3::new(step[0], step[1], step[2])));
    let position = camera.position + DVec3::new(step[3], step[4], step[5]);
    Camera { rotation: orthonormal(camera.rotation * turn), position, ..camera.clone() }
}

/// Returns a rotation without the rounding errors that products of many add up.
fn orthonormal(m: DMat3) -> DMat3 {
    let x = m.x_axis.normalize();
    let z = x.cross(m.y_axis).normalize();
    DMat3::from_cols(x, z.cross(x), z)
}

/// Moves the `free` cameras and all points until they fit the sightings. `given` are the poses of
/// the prior, and `scale` is the residual of half weight in pixels. Without free cameras the points
/// alone are placed.
pub fn adjust(given: &[Camera], cameras: &mut [Camera], tracks: &mut [Track], free: &[bool], scale: f64) {
    let mut next = 0;
    let place = |free: &bool| {
        next += 6 * usize::from(*free);
        free.then(|| next - 6)
    };
    let places: Vec<Option<usize>> = free.iter().map(place).collect();
    Problem { given, places: &places, fixed_points: false, scale, damping: 1e-4 }.minimize(cameras, tracks);
}

/// Returns the pose that fits points which stay best, seen by the camera of view 0 alone; the prior
/// is the `given` pose.
pub fn resected(given: &Camera, start: &Camera, tracks: &[Track], scale: f64) -> Camera {
    let (given, mut camera, mut tracks) = ([given.clone()], [start.clone()], tracks.to_vec());
    Problem { given: &given, places: &[Some(0)], fixed_points: true, scale, damping: 1e-4 }
        .minimize(&mut camera, &mut tracks);
    let [camera] = camera;
    camera
}

/// Returns the similarity that brings adjusted cameras and points closest to the `given` cameras,
/// in pixels: the adjustment leaves it open. Every camera counts alike and with all points, whether
/// it sees them or not, because its error is of the whole camera; one that is much farther off than
/// the others has little weight.
pub fn gauge(given: &[Camera], adjusted: &[Camera], points: &[DVec3]) -> Similarity {
    const ROUNDS: usize = 10;
    /// Squared errors of half weight, of the median: errors of one kind, however they scatter,
    /// count nearly in full, since the mean of them all is where the world is.
    const USUAL: f64 = 16.0;
    let middle = points.iter().sum::<DVec3>() / points.len().max(1) as f64;
    let mut total = Similarity::IDENTITY;
    for _ in 0..ROUNDS {
        let equations: Vec<Equations> = given
            .par_iter()
            .zip(adjusted)
            .map(|(given, adjusted)| Equations::accumulate(given, adjusted, points, middle, &total))
            .collect();
        let mut squares: Vec<f64> = equations.iter().map(|e| e.mean_square).collect();
        let scale = USUAL * median(&mut squares).max(1e-12);
        let (mut matrix, mut vector) = (vec![0.0; 49], vec![0.0; 7]);
        for e in &equations {
            let w = 1.0 / (1.0 + (e.mean_square / scale).powi(2));
            matrix.iter_mut().zip(&e.matrix).for_each(|(sum, m)| *sum += w * m);
            vector.iter_mut().zip(&e.vector).for_each(|(sum, v)| *sum += w * v);
        }
        let Some(step) = solve(matrix, negated(&vector)) else { break };
        let scale = step[6].exp();
        let turn = DQuat::from_scaled_axis(DVec3::new(step[0], step[1], step[2]));
        let rotation = DMat3::from_quat(turn);
        let translation = middle + DVec3::new(step[3], step[4], step[5]) - scale * (rotation * middle);
        total = Similarity { scale, rotation, translation }.after(&total);
        total.rotation = orthonormal(total.rotation);
        if step.iter().all(|s| s.abs() < 1e-10) {
            break;
        }
    }
    total
}

/// One camera's normal equations for rotation, translation and logarithm of the scale of the world.
struct Equations {
    matrix: [f64; 49],
    vector: [f64; 7],
    mean_square: f64,
}

impl Equations {
    fn accumulate(
        given: &Camera,
        adjusted: &Camera,
        points: &[DVec3],
        middle: DVec3,
        world: &Similarity,
    ) -> Equations {
        let mut e = Equations { matrix: [0.0; 49], vector: [0.0; 7], mean_square: 0.0 };
        for &x in points {
            let Some(wanted) = project(adjusted, x) else { continue };
            let point = world.point_f64(x);
            let Some(l) = Linear::new(given, point, wanted) else { continue };
            let along = |d: DVec3| d.x * l.point[0] + d.y * l.point[1] + d.z * l.point[2];
            let arm = point - middle;
            let [a, b, c] = DVec3::AXES.map(|e| along(e.cross(arm)));
            let slopes = [a, b, c, l.point[0], l.point[1], l.point[2], along(arm)];
            for i in 0..7 {
                (0..=i).for_each(|k| e.matrix[7 * i + k] += slopes[i].dot(slopes[k]));
                e.vector[i] += slopes[i].dot(l.residual);
            }
            e.mean_square += l.residual.length_squared() / points.len() as f64;
        }
        e
    }
}

/// Returns the median of some numbers, 0 without any.
pub fn median(values: &mut [f64]) -> f64 {
    rank::median(values, f64::total_cmp).unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use tiface_base::geom::{Distortion, Projection};

    fn aimed(azimuth: f64, lens: Distortion) -> Camera {
        let turn = DMat3::from_rotation_y(azimuth) * DMat3::from_rotation_x(-0.3 * azimuth);
        Camera {
            width: 400,
            height: 500,
            fx: 900.0,
            fy: 950.0,
            cx: 201.0,
            cy: 248.0,
            distortion: lens,
            rotation: turn,
            position: turn * DVec3::new(0.02, -0.01, 6.0),
        }
    }

    fn lenses() -> [Distortion; 3] {
        let bent = Distortion { k1: -0.1, k2: 0.02, p1: 1e-3, p2: -2e-3, ..Distortion::default() };
        let fisheye = Distortion { projection: Projection::Fisheye, k1: 0.01, ..Distortion::default() };
        [Distortion::default(), bent, fisheye]
    }

    #[test]
    fn derivatives_of_a_projection_are_its_finite_differences() {
        const STEP: f64 = 1e-6;
        for lens in lenses() {
            let camera = aimed(0.7, lens);
            let (point, pixel) = (DVec3::new(0.4, -0.6, 0.3), DVec2::new(150.0, 300.0));
            let at = Linear::new(&camera, point, pixel).unwrap();
            assert_eq!(at.residual, project(&camera, point).unwrap() - pixel);
            let close = |measured: DVec2, derived: DVec2, what: &str| {
                let off = measured.distance(derived);
                assert!(off < 1e-5 * (1.0 + derived.length()), "{what}: {measured}, {derived}");
            };
            for k in 0..6 {
                let mut step = [0.0; 6];
                let mut at_step = |d: f64| {
                    step[k] = d;
                    project(&moved(&camera, &step), point).unwrap()
                };
                let measured = (at_step(STEP) - at_step(-STEP)) / (2.0 * STEP);
                close(measured, at.camera[k], &format!("camera {k}"));
            }
            for (k, axis) in DVec3::AXES.into_iter().enumerate() {
                let at_step = |d: f64| project(&camera, point + d * axis).unwrap();
                let measured = (at_step(STEP) - at_step(-STEP)) / (2.0 * STEP);
                close(measured, at.point[k], &format!("point {k}"));
            }
        }
    }

    #[test]
    fn the_gradient_of_the_cost_is_the_right_side_before_elimination() {
        // of one camera with fixed points: the right side is half the cost's slope
        let given = aimed(0.2, lenses()[1]);
        let camera = moved(&given, &[1e-3, -2e-3, 5e-4, 2e-3, 1e-3, -3e-3]);
        let track = |i: usize| Track {
            position: DVec3::new((i % 3) as f64 - 1.0, (i / 3) as f64 - 1.0, 0.1 * i as f64),
            normal: Vec3::Z,
            sightings: vec![Sighting { view: 0, pixel: DVec2::new(200.0, 250.0) }],
        };
        let tracks: Vec<Track> = (0..9).map(track).collect();
        let problem = Problem {
            given: std::slice::from_ref(&given),
            places: &[Some(0)],
            fixed_points: true,
            scale: 40.0,
            damping: 0.0,
        };
        let mut vector = vec![0.0; 6];
        for t in &tracks {
            let l = Linear::new(&camera, t.position, t.sightings[0].pixel).unwrap();
            (0..6).for_each(|k| vector[k] += problem.weight(l.residual) * l.camera[k].dot(l.residual));
        }
        problem.add_prior(std::slice::from_ref(&camera), &mut [0.0; 36], &mut vector);
        for k in 0..6 {
            const STEP: f64 = 1e-6;
            let mut step = [0.0; 6];
            let mut cost = |d: f64| {
                step[k] = d;
                problem.cost(&[moved(&camera, &step)], &tracks)
            };
            let measured = (cost(STEP) - cost(-STEP)) / (4.0 * STEP);
            assert!(
                (measured - vector[k]).abs() < 1e-3 * (1.0 + vector[k].abs()),
                "{k}: {measured}, {vector:?}"
            );
        }
    }

    /// Returns cameras around the origin, and points with their exact sightings.
    fn exact() -> (Vec<Camera>, Vec<Track>) {
        let cameras: Vec<Camera> = (0..8).map(|i| aimed(0.3 * (f64::from(i) - 3.5), lenses()[1])).collect();
        let track = |i: usize| {
            let (a, z) = (i as f64 * 2.399_963, 1.0 - 2.0 * (i as f64 + 0.5) / 200.0);
            let position = DVec3::new((1.0 - z * z).sqrt() * a.cos(), (1.0 - z * z).sqrt() * a.sin(), z);
            let sighting = |view: usize| Some(Sighting { view, pixel: project(&cameras[view], position)? });
            Track { position, normal: position.as_vec3(), sightings: (0..8).filter_map(sighting).collect() }
        };
        let tracks = (0..200).map(track).collect();
        (cameras, tracks)
    }

    /// Returns cameras moved by about two pixels, each otherwise.
    fn disturbed(cameras: &[Camera]) -> Vec<Camera> {
        let step = |i: usize| [0, 1, 2, 3, 4, 5].map(|k| ((7 * i + 3 * k) % 11) as f64 / 5.0 - 1.0);
        let scaled = |(i, c): (usize, &Camera)| {
            let mut step = step(i);
            (0..6).for_each(|k| step[k] *= if k < 3 { 1.5e-3 } else { 6e-3 });
            moved(c, &step)
        };
        cameras.iter().enumerate().map(scaled).collect()
    }

    fn positions(tracks: &[Track]) -> Vec<DVec3> {
        tracks.iter().map(|t| t.position).collect()
    }

    fn largest_error(cameras: &[Camera], exact: &[Camera], tracks: &[Track]) -> f64 {
        let off = |t: &Track, v: usize| {
            project(&cameras[v], t.position).unwrap().distance(project(&exact[v], t.position).unwrap())
        };
        tracks.iter().flat_map(|t| (0..exact.len()).map(move |v| off(t, v))).fold(0.0, f64::max)
    }

    #[test]
    fn disturbed_cameras_find_back_and_a_tenth_of_wrong_sightings_does_not_matter() {
        let (exact, mut tracks) = exact();
        let given = disturbed(&exact);
        assert!(largest_error(&given, &exact, &tracks) > 2.0);
        let truth = tracks.clone();
        for (i, t) in tracks.iter_mut().enumerate() {
            t.position += 0.02 * DVec3::new((i % 3) as f64 - 1.0, (i % 5) as f64 - 2.0, 0.5);
            if i % 10 == 0 {
                t.sightings[i / 10 % 8].pixel += DVec2::new(9.0, -5.0);
            }
        }
        let mut cameras = given.clone();
        for scale in [1.0, 0.2, 0.05] {
            adjust(&given, &mut cameras, &mut tracks, &[true; 8], scale);
        }
        // the world is where it was, once the gauge of the exact cameras is taken
        let world = gauge(&exact, &cameras, &positions(&tracks));
        let cameras: Vec<Camera> = cameras.iter().map(|c| c.transformed(&world)).collect();
        let error = largest_error(&cameras, &exact, &truth);
        assert!(error < 0.05, "{error}");
    }

    #[test]
    fn cameras_that_stay_are_not_moved_and_one_alone_fits_them() {
        let (exact, mut tracks) = exact();
        let given = disturbed(&exact);
        let mut cameras = exact.clone();
        cameras[2] = given[2].clone();
        let free: Vec<bool> = (0..8).map(|v| v == 2).collect();
        let start = cameras.clone();
        adjust(&start, &mut cameras, &mut tracks, &free, 1.0);
        assert!((0..8).all(|v| v == 2 || cameras[v] == exact[v]));
        assert!(largest_error(&cameras, &exact, &tracks) < 1e-2);
    }

    #[test]
    fn the_gauge_is_the_similarity_that_was_applied() {
        let (exact, mut tracks) = exact();
        let world = Similarity {
            scale: 1.02,
            rotation: DMat3::from_rotation_z(0.01) * DMat3::from_rotation_x(-0.02),
            translation: DVec3::new(0.01, -0.02, 0.03),
        };
        let moved: Vec<Camera> = exact.iter().map(|c| c.transformed(&world)).collect();
        tracks.iter_mut().for_each(|t| t.position = world.point_f64(t.position));
        let found = gauge(&exact, &moved, &positions(&tracks));
        let back = found.after(&world);
        assert!((back.scale - 1.0).abs() < 1e-9 && back.translation.length() < 1e-9, "{back:?}");
    }
}
