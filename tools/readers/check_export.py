"""Opens one mesh as GLB, OBJ and PLY in trimesh and open3d and compares what they see.

    cargo run --example textured_sphere -- DIR
    python tools/readers/check_export.py DIR/globe.glb [--up 0 0 1]

The .obj and .ply are looked for beside the .glb. GLB and OBJ are +Y up; PLY is in the dataset's world,
whose up direction is --up and whose unit is --unit-m meters. In every reader and every file: the same
bounds to 1e-6 of the size, closed after welding equal positions, positive volume. Files without a
texture: colors present and alike. Files with one: its pixels are those of the .png beside them, and
texture coordinates agree corner by corner, save where a reader drops them (open3d does in PLY), which
is said. Exits 1 after printing every disagreement.
"""

import argparse
import pathlib
import sys

import numpy
import open3d
import PIL.Image

from axes import turn_to_y_up
from meshes import LoadedMesh, closed_and_volume, with_trimesh
from verdict import exit_code


def with_open3d(path):
    mesh = open3d.io.read_triangle_mesh(str(path))
    colors = numpy.asarray(mesh.vertex_colors) if mesh.has_vertex_colors() else None
    faces = numpy.asarray(mesh.triangles)
    uvs = numpy.asarray(mesh.triangle_uvs).reshape(-1, 3, 2) if mesh.has_triangle_uvs() else None
    pictures = [numpy.asarray(t) for t in mesh.textures if not t.is_empty()]
    picture = pictures[0][::-1, :, :3] if pictures else None  # open3d keeps the lowest row first
    return LoadedMesh(numpy.asarray(mesh.vertices), faces, colors, uvs, picture)


def linear(coded):
    return numpy.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)


def colors_wrong(path, loaded, expected):
    """Mean colors against the PLY's; in a GLB they are stored in linear light."""
    if loaded.colors is None or loaded.colors.std(axis=0).max() < 0.01:
        return ["no colors"]
    mean = (linear(expected) if path.suffix == ".glb" else expected).mean(axis=0)
    if abs(loaded.colors.mean(axis=0) - mean).max() > 0.01:
        return [f"mean color {loaded.colors.mean(axis=0)}, expected {mean}"]
    return []


def texture_wrong(path, reader, loaded, expected_uvs):
    if path.suffix == ".ply" and reader is with_open3d:
        print("    open3d drops texture coordinates from PLY, as it always does")
        return []
    if loaded.uvs is None:
        return ["no texture coordinates"]
    wrong = []
    if expected_uvs is not None:
        apart = abs(loaded.uvs - expected_uvs).max() if loaded.uvs.shape == expected_uvs.shape else numpy.inf
        print(f"    texture coordinates differ by {apart:.1e}")
        if apart > 1e-6:
            wrong.append(f"texture coordinates differ by {apart}")
    truth = numpy.asarray(PIL.Image.open(path.with_suffix(".png")))
    if loaded.picture is None:
        wrong.append("no picture")
    elif not numpy.array_equal(loaded.picture, truth):
        wrong.append(f"picture {loaded.picture.shape} is not that of {path.with_suffix('.png').name}")
    else:
        print(f"    picture {truth.shape[1]} x {truth.shape[0]} equal to the pixel")
    return wrong


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("glb", type=pathlib.Path)
    arguments.add_argument("--up", type=float, nargs=3, default=[0, 0, 1])
    arguments.add_argument("--unit-m", type=float, default=1.0)
    arguments = arguments.parse_args()
    turn = turn_to_y_up(arguments.up) * arguments.unit_m
    textured = b"TEXCOORD_0" in arguments.glb.read_bytes()
    ply_colors = None if textured else with_open3d(arguments.glb.with_suffix(".ply")).colors
    wrong, expected, uvs = [], None, None
    for ending in [".ply", ".glb", ".obj"]:
        path = arguments.glb.with_suffix(ending)
        if textured and not path.exists():
            print(f"passed over: there is no {path.name}")
            continue
        for reader in [with_trimesh, with_open3d]:
            name = f"{path.name} in {reader.__name__[5:]}"
            loaded = reader(path)
            vertices, faces = loaded.vertices, loaded.faces
            placed = vertices @ turn.T if ending == ".ply" else vertices
            low, high = placed.min(axis=0), placed.max(axis=0)
            closed, volume = closed_and_volume(numpy.asarray(vertices), numpy.asarray(faces))
            if expected is None:
                expected = (low, high)
            size = (expected[1] - expected[0]).max()
            apart = max(abs(low - expected[0]).max(), abs(high - expected[1]).max()) / size
            print(
                f"{name:24} {len(vertices)} vertices {len(faces)} triangles  bounds differ by {apart:.1e}"
                f"  closed {closed}  volume {volume:.9f}  colors {loaded.colors is not None}"
                f"  texture {loaded.uvs is not None}"
            )
            bad = []
            if apart > 1e-6:
                bad.append(f"box {low} to {high}, expected {expected[0]} to {expected[1]}")
            if not closed:
                bad.append("not closed")
            if not volume > 0:
                bad.append(f"volume {volume}")
            if textured and ending == ".ply" and b"TextureFile" not in path.read_bytes()[:4096]:
                # closed as it is, with colors at its vertices in the texture's place
                bad += [] if loaded.colors is not None else ["neither a texture nor colors"]
            elif textured:
                bad += texture_wrong(path, reader, loaded, uvs)
            else:
                bad += colors_wrong(path, loaded, ply_colors)
            if uvs is None:
                uvs = loaded.uvs
            wrong += [f"{name}: {line}" for line in bad]
    return exit_code(wrong)


if __name__ == "__main__":
    sys.exit(main())
