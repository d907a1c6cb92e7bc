//! From the builder's binary tree to the wide one that rays walk.

use super::{Bvh, GROWTH, LEAF, Leaf, WideNode};
use crate::geom::{Aabb, Mesh};
use glam::Vec4;
use obvhs::bvh2::Bvh2;

impl Bvh {
    /// Turns the builder's binary tree into our wide one, with boxes from the real corners.
    pub(super) fn widen(&mut self, tree: &Bvh2, mesh: &Mesh, kept: &[u32]) {
        // Boxes bottom up: `order` lists parents before children.
        let mut order = vec![0usize];
        let mut next = 0;
        while next < order.len() {
            let node = &tree.nodes[order[next]];
            if !node.is_leaf() {
                order.extend([node.first_index as usize, node.first_index as usize + 1]);
            }
            next += 1;
        }
        let members = |n: usize| {
            let (first, count) = (tree.nodes[n].first_index as usize, tree.nodes[n].prim_count as usize);
            tree.primitive_indices[first..first + count].iter().map(|&p| kept[p as usize])
        };
        let mut boxes = vec![Aabb::EMPTY; tree.nodes.len()];
        for &n in order.iter().rev() {
            let node = &tree.nodes[n];
            boxes[n] = if node.is_leaf() {
                Aabb::around(members(n).flat_map(|t| mesh.corners(t)))
            } else {
                let (a, b) = (boxes[node.first_index as usize], boxes[node.first_index as usize + 1]);
                Aabb { min: a.min.min(b.min), max: a.max.max(b.max) }
            };
        }
        let grown = (GROWTH * self.reach).max(f32::MIN_POSITIVE);
        // Work: which of our nodes stands for which of theirs, and how deep it is.
        let mut work = vec![(0usize, 0usize, 1usize)];
        self.nodes.push(WideNode::EMPTY);
        let mut depth = 1;
        while let Some((ours, theirs, level)) = work.pop() {
            depth = depth.max(level);
            let mut children = vec![theirs];
            // Open the largest box until there are four.
            while children.len() < 4 {
                let largest = (0..children.len())
                    .filter(|&k| !tree.nodes[children[k]].is_leaf())
                    .max_by(|&a, &b| half_area(boxes[children[a]]).total_cmp(&half_area(boxes[children[b]])));
                let Some(k) = largest else { break };
                let first = tree.nodes[children[k]].first_index as usize;
                children[k] = first;
                children.insert(k + 1, first + 1);
            }
            for (lane, &n) in children.iter().enumerate() {
                let b = boxes[n].grown(grown);
                for axis in 0..3 {
                    self.nodes[ours].bounds[0][axis][lane] = b.min[axis];
                    self.nodes[ours].bounds[1][axis][lane] = b.max[axis];
                }
                let triangles: Vec<u32> =
                    if tree.nodes[n].is_leaf() { members(n).collect() } else { Vec::new() };
                self.nodes[ours].child[lane] = match triangles.len() {
                    0 => {
                        self.nodes.push(WideNode::EMPTY);
                        work.push((self.nodes.len() - 1, n, level + 1));
                        self.nodes.len() as u32 - 1
                    }
                    1..=4 => self.add_leaf(mesh, &triangles),
                    _ => self.add_crowd(mesh, &triangles, grown),
                };
            }
        }
        self.stack = 3 * (depth + 2) + 1;
    }

    fn add_leaf(&mut self, mesh: &Mesh, triangles: &[u32]) -> u32 {
        let mut leaf = Leaf { corners: [[Vec4::ZERO; 3]; 3], triangle: [triangles[0]; 4] };
        for lane in 0..4 {
            leaf.triangle[lane] = *triangles.get(lane).unwrap_or(&triangles[0]);
            for (k, p) in mesh.corners(leaf.triangle[lane]).into_iter().enumerate() {
                for axis in 0..3 {
                    leaf.corners[k][axis][lane] = p[axis];
                }
            }
        }
        self.leaves.push(leaf);
        LEAF | (self.leaves.len() as u32 - 1)
    }

    /// More than four triangles in one of the builder's leaves: a chain of nodes, three leaves each.
    fn add_crowd(&mut self, mesh: &Mesh, triangles: &[u32], grown: f32) -> u32 {
        let ours = self.nodes.len();
        self.nodes.push(WideNode::EMPTY);
        let (here, rest) = triangles.split_at(triangles.len().min(12));
        let mut parts: Vec<&[u32]> = here.chunks(4).collect();
        if !rest.is_empty() {
            parts.push(rest);
        }
        for (lane, part) in parts.into_iter().enumerate() {
            let b = Aabb::around(part.iter().flat_map(|&t| mesh.corners(t))).grown(grown);
            for axis in 0..3 {
                self.nodes[ours].bounds[0][axis][lane] = b.min[axis];
                self.nodes[ours].bounds[1][axis][lane] = b.max[axis];
            }
            let child =
                if part.len() <= 4 { self.add_leaf(mesh, part) } else { self.add_crowd(mesh, part, grown) };
            self.nodes[ours].child[lane] = child;
        }
        ours as u32
    }
}

fn half_area(b: Aabb) -> f32 {
    let s = b.size();
    s.x * s.y + s.y * s.z + s.z * s.x
}
