"""Opens one mesh as GLB, OBJ and PLY in Blender, without a window, and compares what it sees.

    cargo run --example textured_sphere -- DIR
    python3.11 -m venv .venv-blender && .venv-blender/bin/pip install -r tools/readers/requirements-blender.txt
    .venv-blender/bin/python tools/readers/check_blender.py DIR/globe.glb [--up 0 0 1] [--unit-m 1] [--lit]

The .obj and .ply are looked for beside the .glb; those that are not there are passed over aloud. Truth
is the box that the GLB's own header gives, moved by its node. Blender is +Z up and turns GLB and OBJ,
(x, y, z) to (x, -z, y), so heads stand upright; it does not turn PLY, which is in the dataset's world.
Checked: the box to 1e-6 of its size, closed after welding equal positions, positive volume. With a
texture: coordinates on every corner, the picture equal to the .png to the pixel, the material of the
GLB unlit (Blender gives it emission), or lit with --lit. Exits 1 after printing every disagreement.
"""

import argparse
import json
import pathlib
import struct
import sys

import bpy
import numpy
import PIL.Image

from axes import turn_to_y_up
from verdict import exit_code

BLENDER_FROM_GLTF = numpy.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], float)


def header_of(glb):
    data = glb.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length])


def box_of(header):
    """The box in glTF's axes, as the file itself says."""
    accessor = header["accessors"][header["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    unit = 65535.0 if accessor.get("normalized") else 1.0
    corners = numpy.array([accessor["min"], accessor["max"]], float) / unit
    (root,) = header["scenes"][0]["nodes"]
    node = header["nodes"][root]
    return corners * node.get("scale", [1, 1, 1]) + node.get("translation", [0, 0, 0])


def opened(path):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    operator = {".glb": bpy.ops.import_scene.gltf, ".obj": bpy.ops.wm.obj_import, ".ply": bpy.ops.wm.ply_import}
    operator[path.suffix](filepath=str(path))
    # soft layers are a child that can be hidden
    (found,) = [o for o in bpy.context.scene.objects if o.type == "MESH" and o.parent is None]
    for layers in found.children:
        print(f"    {layers.name}: {len(layers.data.polygons)} triangles around it")
    return found


def surface(found):
    """Vertices in the world, and triangles over positions welded when equal."""
    mesh = found.data
    local = numpy.empty(3 * len(mesh.vertices), numpy.float32)
    mesh.vertices.foreach_get("co", local)
    local = local.reshape(-1, 3)
    corners = numpy.empty(len(mesh.loops), numpy.int64)
    mesh.loops.foreach_get("vertex_index", corners)
    assert all(p.loop_total == 3 for p in mesh.polygons)
    matrix = numpy.array(found.matrix_world)
    world = local.astype(float) @ matrix[:3, :3].T + matrix[:3, 3]
    _, first, weld = numpy.unique(local, axis=0, return_index=True, return_inverse=True)
    return world, world[first], weld.reshape(-1)[corners].reshape(-1, 3)


def closed_and_volume(points, faces):
    edges = numpy.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there, counts = numpy.unique(edges, axis=0, return_counts=True)
    closed = (counts == 1).all() and numpy.array_equal(there, numpy.unique(edges[:, ::-1], axis=0))
    a, b, c = (points[faces[:, k]] for k in range(3))
    return closed, float(numpy.einsum("ij,ij->i", a, numpy.cross(b, c)).sum() / 6)


def picture_of(image):
    pixels = numpy.empty(4 * image.size[0] * image.size[1], numpy.float32)
    image.pixels.foreach_get(pixels)
    rows = numpy.round(pixels.reshape(image.size[1], image.size[0], 4) * 255).astype(numpy.uint8)
    return rows[::-1, :, :3]  # Blender's first row is the lowest


def shown_picture(material):
    """The picture that reaches the surface as its color, and whether light plays a part."""
    nodes = material.node_tree.nodes
    kinds = {node.type for node in nodes}
    unlit = bool(kinds & {"EMISSION", "BACKGROUND"}) and "BSDF_PRINCIPLED" not in kinds
    normals = {link.from_node for node in nodes if node.type == "NORMAL_MAP" for link in material.node_tree.links
               if link.to_node == node}
    pictures = [n.image for n in nodes if n.type == "TEX_IMAGE" and n not in normals]
    return (pictures[0] if len(pictures) == 1 else None), unlit


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("glb", type=pathlib.Path)
    arguments.add_argument("--up", type=float, nargs=3, default=[0, 0, 1])
    arguments.add_argument("--unit-m", type=float, default=1.0)
    arguments.add_argument("--lit", action="store_true", help="the material of the GLB is lit")
    arguments.add_argument("--picture", type=pathlib.Path, help="instead of the .png beside the .glb")
    arguments = arguments.parse_args()
    header = header_of(arguments.glb)
    textured = "textures" in header
    truth = numpy.sort(box_of(header) @ BLENDER_FROM_GLTF.T, axis=0)
    size = (truth[1] - truth[0]).max()
    wrong = []
    for ending in [".glb", ".obj", ".ply"]:
        path = arguments.glb.with_suffix(ending)
        if not path.exists():
            print(f"passed over: there is no {path.name}")
            continue
        found = opened(path.resolve())
        world, points, faces = surface(found)
        closed, volume = closed_and_volume(points, faces)
        if ending == ".ply":
            world = world @ (BLENDER_FROM_GLTF @ turn_to_y_up(arguments.up)).T * arguments.unit_m
        apart = abs(numpy.array([world.min(axis=0), world.max(axis=0)]) - truth).max() / size
        bad = []
        said = f"{len(world)} vertices {len(faces)} triangles  bounds differ by {apart:.1e}  closed {closed}"
        if apart > 1e-6:
            bad.append(f"box {world.min(axis=0)} to {world.max(axis=0)}, expected {truth[0]} to {truth[1]}")
        if not closed:
            bad.append("not closed")
        if not volume > 0:
            bad.append(f"volume {volume}")
        # a PLY may have colors at its vertices in the texture's place
        bare = ending == ".ply" and b"TextureFile" not in path.read_bytes()[:4096]
        if textured and not bare and not found.data.uv_layers:
            bad.append("no texture coordinates")
        if textured and ending != ".ply":  # Blender knows no pictures in PLY
            image, unlit = shown_picture(found.data.materials[0])
            beside = arguments.picture or arguments.glb.with_suffix(".png")
            expected = numpy.asarray(PIL.Image.open(beside).convert("RGB"))
            same = image is not None and numpy.array_equal(picture_of(image), expected)
            said += f"  picture equal {same}  unlit {unlit}"
            if not same:
                bad.append(f"its picture is not that of {beside.name}")
            if ending == ".glb" and unlit == arguments.lit:
                bad.append("its material is unlit" if unlit else "its material is lit")
        print(f"{path.name:20} in Blender {bpy.app.version_string}: {said}  volume {volume:.9f}")
        wrong += [f"{path.name}: {line}" for line in bad]
    return exit_code(wrong)


if __name__ == "__main__":
    sys.exit(main())
