"""Opens one mesh as GLB, OBJ and PLY in trimesh and open3d and compares what they see.

    cargo run --no-default-features --example sphere_to_glb -- DIR
    python tools/readers/check_export.py DIR/sphere.glb [--up 0 0 1]

The .obj and .ply are looked for beside the .glb. GLB and OBJ are +Y up; PLY is in the dataset's world,
whose up direction is --up and whose unit is --unit-m metres. In every reader and every file: the same
bounds to 1e-6 of the size, closed after welding equal positions, positive volume, colours present
and alike. Exits 1 after printing every disagreement.
"""

import argparse
import pathlib
import sys

import numpy
import open3d
import trimesh


def turn_to_y_up(up):
    """The smallest rotation that brings `up` to +Y."""
    up = numpy.asarray(up, float) / numpy.linalg.norm(up)
    if up[1] < -1 + 1e-12:
        return numpy.diag([1.0, -1.0, -1.0])
    x, y, z = numpy.cross(up, [0, 1, 0])
    skew = numpy.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return numpy.eye(3) + skew + skew @ skew / (1 + up[1])


def with_trimesh(path):
    scene = trimesh.load_scene(path, process=False)
    (node,) = scene.graph.nodes_geometry  # an export holds one mesh
    matrix, name = scene.graph[node]
    mesh = scene.geometry[name]
    if mesh.visual.kind == "vertex":
        colors = mesh.visual.vertex_colors
    else:  # beside a material, trimesh keeps them as an attribute
        colors = mesh.visual.vertex_attributes.data.get("color")
    if colors is not None:
        scale = 255.0 if numpy.issubdtype(colors.dtype, numpy.integer) else 1.0
        colors = numpy.asarray(colors)[:, :3] / scale
    return trimesh.transform_points(mesh.vertices, matrix), mesh.faces, colors


def with_open3d(path):
    mesh = open3d.io.read_triangle_mesh(str(path))
    colors = numpy.asarray(mesh.vertex_colors) if mesh.has_vertex_colors() else None
    return numpy.asarray(mesh.vertices), numpy.asarray(mesh.triangles), colors


def closed_and_volume(vertices, faces):
    _, weld = numpy.unique(vertices, axis=0, return_inverse=True)
    faces = weld.reshape(-1)[faces]
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    edges = numpy.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there, counts = numpy.unique(edges, axis=0, return_counts=True)
    back = numpy.unique(edges[:, ::-1], axis=0)
    closed = len(there) > 0 and (counts == 1).all() and numpy.array_equal(there, back)
    a, b, c = (numpy.unique(vertices, axis=0)[faces[:, k]] for k in range(3))
    return closed, float(numpy.einsum("ij,ij->i", a, numpy.cross(b, c)).sum() / 6)


def linear(coded):
    return numpy.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("glb", type=pathlib.Path)
    arguments.add_argument("--up", type=float, nargs=3, default=[0, 0, 1])
    arguments.add_argument("--unit-m", type=float, default=1.0)
    arguments = arguments.parse_args()
    turn = turn_to_y_up(arguments.up) * arguments.unit_m
    wrong, expected = [], None
    for ending in [".ply", ".glb", ".obj"]:
        path = arguments.glb.with_suffix(ending)
        for reader in [with_trimesh, with_open3d]:
            name = f"{path.name} in {reader.__name__[5:]}"
            vertices, faces, colors = reader(path)
            placed = vertices @ turn.T if ending == ".ply" else vertices
            low, high = placed.min(axis=0), placed.max(axis=0)
            closed, volume = closed_and_volume(numpy.asarray(vertices), numpy.asarray(faces))
            if expected is None:
                expected = (low, high)
            size = (expected[1] - expected[0]).max()
            apart = max(abs(low - expected[0]).max(), abs(high - expected[1]).max()) / size
            has_colors = colors is not None and colors.std(axis=0).max() > 0.01
            print(
                f"{name:24} {len(vertices)} vertices {len(faces)} triangles  bounds differ by {apart:.1e}"
                f"  closed {closed}  volume {volume:.9f}  colours {has_colors}"
            )
            if apart > 1e-6:
                wrong.append(f"{name}: box {low} to {high}, expected {expected[0]} to {expected[1]}")
            if not closed:
                wrong.append(f"{name}: not closed")
            if not volume > 0:
                wrong.append(f"{name}: volume {volume}")
            if not has_colors:
                wrong.append(f"{name}: no colours")
                continue
            # the mean colour; in a GLB it is stored in linear light
            ply = with_open3d(arguments.glb.with_suffix(".ply"))[2]
            mean = (linear(ply) if ending == ".glb" else ply).mean(axis=0)
            if abs(colors.mean(axis=0) - mean).max() > 0.01:
                wrong.append(f"{name}: mean colour {colors.mean(axis=0)}, expected {mean}")
    for line in wrong:
        print("WRONG", line)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
