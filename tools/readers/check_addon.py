"""Installs the extension of tools/blender as a user does, imports a run with it, without a window, and compares what Blender
then has with the run.

    python3.11 -m venv .venv-blender && .venv-blender/bin/pip install -r tools/readers/requirements-blender.txt
    .venv-blender/bin/python tools/readers/check_addon.py RUN

Checked: the zip installs, with the version of the program; every vertex of the head is seen where the run's own cameras see
it, through `mesh/surface.ply`'s world, to 0.05 pixels; vertices have their number of cameras; each view has its photograph;
soft layers are there if the file has them; a picture with the scene as it is then shows the colors of the run's own view
(`render/textured`), to two levels on average where both are opaque; folders that are no runs are refused in a sentence.
Exits 1 after printing every disagreement.
"""

import json
import os
import pathlib
import subprocess
import sys
import tempfile
import tomllib

# nobody's own extensions and preferences
scratch_folder = tempfile.TemporaryDirectory()
os.environ["BLENDER_USER_RESOURCES"] = scratch_folder.name

import bpy  # noqa: E402
import mathutils  # noqa: E402
import numpy  # noqa: E402
from bpy_extras.object_utils import world_to_camera_view  # noqa: E402
from PIL import Image  # noqa: E402

from verdict import exit_code  # noqa: E402

ROOT = pathlib.Path(__file__).resolve().parents[2]
MOST_PX = 0.05
MOST_LEVELS = 2.0


def installed(wrong):
    """Packs the extension, installs it with Blender's own installer, and returns its module."""
    package = pathlib.Path(scratch_folder.name) / "tiface_import.zip"
    subprocess.run([sys.executable, ROOT / "tools/blender/make_extension.py", package], check=True)
    bpy.ops.extensions.package_install_files(repo="user_default", filepath=str(package), enable_on_install=True)
    manifest = tomllib.loads((ROOT / "tools/blender/blender_manifest.toml").read_text())
    version = tomllib.loads((ROOT / "Cargo.toml").read_text())["workspace"]["package"]["version"]
    if manifest["version"] != version:
        wrong.append(f"the extension has version {manifest['version']}, the program {version}")
    return sys.modules["bl_ext.user_default.tiface_import"]


def shown_colors(scene, run, view, wrong):
    """Renders the scene as the import has left it, from the camera of a view, and compares it with the run's own view."""
    own = numpy.asarray(Image.open(run / f"render/textured/{view['name']}.png").convert("RGBA"), float)
    scene.camera = scene.objects[view["name"]]
    scene.render.resolution_x, scene.render.resolution_y = view["camera"]["width"], view["camera"]["height"]
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples = "CPU", 16
    scene.render.film_transparent = True
    scene.render.image_settings.file_format, scene.render.image_settings.color_mode = "PNG", "RGBA"
    scene.render.filepath = str(pathlib.Path(scratch_folder.name) / "shown.png")
    bpy.ops.render.render(write_still=True)
    shown = numpy.asarray(Image.open(scene.render.filepath), float)
    opaque = (shown[..., 3] == 255) & (own[..., 3] == 255)
    off = numpy.abs(shown - own)[opaque][:, :3].mean()
    print(f"{view['name']}: {off:.2f} levels on average over {opaque.sum()} opaque pixels")
    if not (off <= MOST_LEVELS and opaque.sum() > 0.5 * (own[..., 3] == 255).sum()):
        wrong.append(f"{view['name']} is shown {off:.2f} levels off, over {opaque.sum()} opaque pixels")


def matrix(columns):
    return numpy.reshape(columns, (3, 3)).T


def main():
    run = pathlib.Path(sys.argv[1])
    wrong = []
    bpy.ops.wm.read_factory_settings(use_empty=True)
    tiface_import = installed(wrong)
    if bpy.ops.import_scene.tiface_run(directory=str(run)) != {"FINISHED"}:
        wrong.append("the operator did not finish")
    scene = bpy.context.scene
    views = tiface_import.views_of(run)
    frames = json.loads((run / "mesh/frames.json").read_text())["file_from_world"]
    cameras = {found.name: found for found in scene.objects if found.type == "CAMERA"}
    if sorted(cameras) != sorted(view["name"] for view in views):
        wrong.append(f"cameras {sorted(cameras)}")
    (head,) = [found for found in scene.objects if found.type == "MESH" and found.parent is None]
    local = numpy.empty(3 * len(head.data.vertices), numpy.float32)
    head.data.vertices.foreach_get("co", local)
    picked = local.reshape(-1, 3)[:: max(1, len(local) // 3 // 50)]
    bpy.context.view_layer.update()
    farthest = 0.0
    for view in views:
        given, camera = view["camera"], cameras[view["name"]]
        if any(given["distortion"].values()):
            continue
        width, height = given["width"], given["height"]
        scene.render.resolution_x, scene.render.resolution_y = width, height
        for point in picked:
            in_blender = head.matrix_world @ mathutils.Vector(point)
            seen = world_to_camera_view(scene, camera, in_blender)
            found = numpy.array([seen.x * width, (1 - seen.y) * height])
            # Blender (x, y, z) is (x, z, -y) in the file; then the run's world, and its camera
            in_file = numpy.array([in_blender.x, in_blender.z, -in_blender.y])
            world = matrix(frames["rotation"]).T @ (in_file - frames["translation"]) / frames["scale"]
            x, y, z = matrix(given["rotation"]).T @ (world - given["position"])
            expected = numpy.array([given["cx"] + given["fx"] * x / -z, given["cy"] - given["fy"] * y / -z])
            farthest = max(farthest, numpy.abs(found - expected).max())
            if not (-width < expected[0] < 2 * width and -height < expected[1] < 2 * height):
                wrong.append(f"{view['name']} does not look at the head: {expected}")
                break
        shown = [background.image for background in camera.data.background_images]
        if len(shown) != 1 or tuple(shown[0].size) != (width, height):
            wrong.append(f"{view['name']} has the backgrounds {[tuple(image.size) for image in shown]}")
    # numbers of cameras, as an attribute to mask by
    seen_by = head.data.attributes.get("_SEEN_BY")
    if seen_by is None or seen_by.domain != "POINT" or seen_by.data_type != "FLOAT":
        wrong.append("the head has no number of cameras at its vertices")
    else:
        numbers = numpy.empty(len(seen_by.data), numpy.float32)
        seen_by.data.foreach_get("value", numbers)
        if (numbers % 1).any() or not 0 < numbers.max() <= len(views):
            wrong.append(f"vertices are seen by {numbers.min()} to {numbers.max()} of {len(views)} cameras")
    print(f"{len(cameras)} cameras; {farthest:.4f} pixels at most from where the run sees {len(picked)} vertices")
    if not farthest <= MOST_PX:
        wrong.append(f"vertices are {farthest} pixels off, at most {MOST_PX} expected")
    if scene.view_settings.view_transform != "Standard":
        wrong.append(f"view transform {scene.view_settings.view_transform}")
    if scene.cycles.transparent_max_bounces < tiface_import.TRANSPARENT_BOUNCES:
        wrong.append(f"{scene.cycles.transparent_max_bounces} transparent bounces")
    document, _ = tiface_import.read_glb(run / "mesh/head.glb")
    meshes = [found for found in scene.objects if found.type == "MESH"]
    if len(meshes) != len(document["meshes"]):
        wrong.append(f"{len(meshes)} meshes, {len(document['meshes'])} in the file: soft layers are a mesh of their own")
    shown_colors(scene, run, next(view for view in views if view["split"] == "test"), wrong)
    # what is no run, a run cut short
    with tempfile.TemporaryDirectory() as scratch:
        broken = pathlib.Path(scratch) / "broken"
        (broken / "mesh").mkdir(parents=True)
        (broken / "mesh/head.glb").write_bytes((run / "mesh/head.glb").read_bytes())
        (broken / "cameras.json").write_text("{")
        # and one from before `frames.json`; nothing of them is imported
        old = pathlib.Path(scratch) / "old"
        (old / "mesh").mkdir(parents=True)
        (old / "mesh/head.glb").write_bytes((run / "mesh/head.glb").read_bytes())
        (old / "cameras.json").write_text((run / "cameras.json").read_text())
        before = len(bpy.data.objects)
        for folder, words in ((scratch, "holds no mesh/head.glb"), (broken, "cameras.json"), (old, "frames.json")):
            try:
                tiface_import.import_run(folder)
                wrong.append(f"{folder} was imported")
            except RuntimeError as problem:
                if words not in str(problem):
                    wrong.append(f"{folder}: {problem}")
        if len(bpy.data.objects) != before:
            wrong.append("a refused folder was imported in part")
        # refined and fitted poses count
        moved = {"views": [{"name": "a", "camera": {"fx": 1, "position": [0, 0, 0]}}, {"name": "b", "camera": {"position": [0, 0, 0]}}],
                 "fit": {"cameras": [{"view": "a", "refined": {"position": [1, 2, 3]}}], "held_out": [{"view": "b", "fitted": None}]}}
        (broken / "cameras.json").write_text(json.dumps(moved))
        found = [view["camera"] for view in tiface_import.views_of(broken)]
        if found != [{"fx": 1, "position": [1, 2, 3]}, {"position": [0, 0, 0]}]:
            wrong.append(f"poses {found}")
    bpy.ops.extensions.package_uninstall(repo_index=1, pkg_id="tiface_import")
    if hasattr(bpy.types, "IMPORT_SCENE_OT_tiface_run"):
        wrong.append("the extension stays after it is removed")
    return exit_code(wrong)


if __name__ == "__main__":
    sys.exit(main())
