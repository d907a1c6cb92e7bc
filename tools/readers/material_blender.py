"""How the two materials of a head look in Blender under light that people have: decibels from its own colors.

    tiface export RUN --material unlit --out unlit.glb
    tiface export RUN --material lit --out lit.glb
    tiface render RUN --with textured
    .venv-blender/bin/python tools/readers/material_blender.py RUN unlit.glb lit.glb [--save DIR]

Each file is opened as a person opens it, its material left as it is, and shown from the first held-out camera: in the
scene that Blender starts with, in the forest that its material preview shows, and in white surroundings; with the view
transform that Blender starts with (AgX) and with Standard, which changes no color. Compared with what `tiface render
--with textured` shows from there, over pixels that both cover. Cycles on the CPU.
"""

import argparse
import json
import pathlib
import sys
import tempfile

import bpy

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "blender"))
from check_lobes import in_file, picture_of, psnr  # noqa: E402
from render import place  # noqa: E402


def surroundings(light):
    """Blender's first scene without its cube; in a forest or in white, without its lamp."""
    bpy.ops.wm.read_factory_settings()
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    if light == "first scene":
        return
    bpy.data.objects.remove(bpy.data.objects["Light"])
    background = bpy.context.scene.world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    if light == "forest":
        files = pathlib.Path(bpy.utils.resource_path("LOCAL")) / "datafiles/studiolights/world/forest.exr"
        picture = bpy.context.scene.world.node_tree.nodes.new("ShaderNodeTexEnvironment")
        picture.image = bpy.data.images.load(str(files))
        bpy.context.scene.world.node_tree.links.new(picture.outputs["Color"], background.inputs["Color"])


def show(glb, light, view, camera, out):
    surroundings(light)
    bpy.ops.import_scene.gltf(filepath=str(glb.resolve()))
    scene = bpy.context.scene
    place(scene.camera, camera)
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = 32
    scene.cycles.use_denoising = False
    scene.render.film_transparent = True
    scene.view_settings.view_transform = view
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_mode = "RGBA"
    scene.render.filepath = str(out.resolve())
    bpy.ops.render.render(write_still=True)


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("run", type=pathlib.Path)
    arguments.add_argument("unlit", type=pathlib.Path)
    arguments.add_argument("lit", type=pathlib.Path)
    arguments.add_argument("--save", type=pathlib.Path)
    arguments = arguments.parse_args()
    described = json.loads((arguments.run / "cameras.json").read_text())
    folder = arguments.run / "render/textured"
    view = next(v for v in described["views"] if (folder / f"{v['name']}.png").exists())
    truth = picture_of(folder / f"{view['name']}.png")
    camera = in_file(view["camera"], described)
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        out = arguments.save or pathlib.Path(scratch)
        out.mkdir(parents=True, exist_ok=True)
        for light in ("first scene", "forest", "white"):
            for transform in ("AgX", "Standard"):
                found = []
                for which in ("unlit", "lit"):
                    target = out / f"{light.replace(' ', '_')}_{transform}_{which}.png"
                    show(getattr(arguments, which), light, transform, camera, target)
                    found.append(psnr(picture_of(target), truth)[0])
                rows.append((light, transform, *found))
    print(f"| light | view transform | unlit | lit |\n|---|---|---|---|")
    for light, transform, unlit, lit in rows:
        print(f"| {light} | {transform} | {unlit:.1f} dB | {lit:.1f} dB |")


if __name__ == "__main__":
    main()
