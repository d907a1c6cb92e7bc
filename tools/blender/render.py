"""Renders a GLB with Blender, without a window, from a given camera: to lay beside a photograph.

    python3.11 -m venv .venv-blender && .venv-blender/bin/pip install -r tools/readers/requirements-blender.txt
    .venv-blender/bin/python tools/blender/render.py head.glb camera.json out.png [--samples 16] [--lobes]

camera.json, lengths in meters and pixels:

    { "world_from_camera": [[4 rows of 4]], "fl_x": 1200, "fl_y": 1200, "cx": 512, "cy": 512,
      "w": 1024, "h": 1024 }

The world is that of the GLB (glTF: +Y up). The camera's axes are OpenGL's: +X right, +Y up, it looks
along -Z. `fl_y` defaults to `fl_x`, the principal point to the middle. Lens distortion is not rendered:
undistort the photograph.

Colors come out as they are stored: every surface emits its base color, with `--lobes` that of the view
(tools/blender/tiface_import.py), and the picture is written in sRGB without tone mapping, straight alpha, transparent where
nothing is. Cycles on the CPU.
"""

import argparse
import json
import pathlib
import sys

import bpy
import mathutils

from tiface_import import add_lobes

BLENDER_FROM_GLTF = mathutils.Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)))


def emit(found):
    """Makes a material of nothing but its base color: a texture, else vertex colors, else gray."""
    materials = [m for m in found.data.materials if m] or [bpy.data.materials.new("bare")]
    found.data.materials.clear()
    for material in materials:
        material.use_nodes = True
        tree = material.node_tree
        base = None
        for node in tree.nodes:
            if node.type == "TEX_IMAGE" and node.image and node.image.colorspace_settings.name == "sRGB":
                base = (node.image, node.interpolation, node.extension)
                break
        tree.nodes.clear()
        out = tree.nodes.new("ShaderNodeOutputMaterial")
        emission = tree.nodes.new("ShaderNodeEmission")
        tree.links.new(emission.outputs[0], out.inputs["Surface"])
        if base:
            texture = tree.nodes.new("ShaderNodeTexImage")
            texture.image, texture.interpolation, texture.extension = base
            tree.links.new(texture.outputs["Color"], emission.inputs["Color"])
        elif found.data.color_attributes:
            colors = tree.nodes.new("ShaderNodeVertexColor")
            colors.layer_name = found.data.color_attributes[0].name
            tree.links.new(colors.outputs["Color"], emission.inputs["Color"])
        found.data.materials.append(material)


def soften(found):
    """Soft layers emit their base color through their opacity."""
    emit(found)
    for material in found.data.materials:
        tree = material.node_tree
        emission = next(node for node in tree.nodes if node.type == "EMISSION")
        out = next(node for node in tree.nodes if node.type == "OUTPUT_MATERIAL")
        opacity = tree.nodes.new("ShaderNodeVertexColor")
        opacity.layer_name = found.data.color_attributes[0].name
        mix = tree.nodes.new("ShaderNodeMixShader")
        tree.links.new(opacity.outputs["Alpha"], mix.inputs[0])
        tree.links.new(tree.nodes.new("ShaderNodeBsdfTransparent").outputs[0], mix.inputs[1])
        tree.links.new(emission.outputs[0], mix.inputs[2])
        tree.links.new(mix.outputs[0], out.inputs["Surface"])


def place(camera, given):
    width, height = given["w"], given["h"]
    fl_x = given["fl_x"]
    fl_y = given.get("fl_y", fl_x)
    lens = camera.data
    lens.sensor_fit = "HORIZONTAL"
    lens.sensor_width = 36.0
    lens.lens = fl_x * lens.sensor_width / width
    # in widths of the picture, to where the middle of the picture looks
    lens.shift_x = (width / 2 - given.get("cx", width / 2)) / width
    lens.shift_y = (given.get("cy", height / 2) - height / 2) * fl_x / fl_y / width
    lens.clip_start, lens.clip_end = 1e-3, 1e3
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    # pixels are as much wider than high as fl_y is longer than fl_x; Blender wants both at least 1
    render.pixel_aspect_x, render.pixel_aspect_y = max(fl_y / fl_x, 1.0), max(fl_x / fl_y, 1.0)
    camera.matrix_world = BLENDER_FROM_GLTF @ mathutils.Matrix(given["world_from_camera"])


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("glb", type=pathlib.Path)
    arguments.add_argument("camera", type=pathlib.Path)
    arguments.add_argument("out", type=pathlib.Path)
    arguments.add_argument("--samples", type=int, default=16)
    arguments.add_argument("--transparent-bounces", type=int, default=8, help="surfaces that a ray may pass; Blender's own default")
    arguments.add_argument("--lobes", action="store_true", help="colors that change with the view")
    arguments = arguments.parse_args()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=str(arguments.glb.resolve()))
    for found in bpy.context.scene.objects:
        if found.type != "MESH":
            continue
        if found.parent is not None and found.parent.type == "MESH":
            soften(found)
        else:
            emit(found)
    if arguments.lobes and not add_lobes(bpy.context.scene.objects, arguments.glb):
        sys.exit(f"{arguments.glb} holds no lobes")
    scene = bpy.context.scene
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    place(camera, json.loads(arguments.camera.read_text()))
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = arguments.samples
    scene.cycles.use_denoising = False
    scene.cycles.use_adaptive_sampling = False
    scene.cycles.max_bounces = 0
    scene.cycles.transparent_max_bounces = arguments.transparent_bounces
    scene.cycles.pixel_filter_type = "BOX"
    scene.cycles.filter_width = 1.0
    scene.render.film_transparent = True
    scene.render.dither_intensity = 0.0
    scene.display_settings.display_device = "sRGB"
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_mode = "RGBA"
    scene.render.image_settings.color_depth = "8"
    scene.render.filepath = str(arguments.out.resolve())
    bpy.ops.render.render(write_still=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
