"""Shows in Blender the colors that change with the view, of a GLB by `tiface`.

Without a window, into a file to open:

    python3.11 -m venv .venv-blender && .venv-blender/bin/pip install -r tools/readers/requirements-blender.txt
    .venv-blender/bin/python tools/blender/lobes.py head.glb head.blend

or in Blender itself:

    blender --python tools/blender/lobes.py -- head.glb

The node group "tiface lobes" is put between the base color of the head and of its soft layers and what takes it, as the
add-on beside this script does (tiface_import.py). "Strength" 0 is the base color alone. To see colors as they are
stored, set the scene's view transform to Standard, as this script does for its own file.
"""

import pathlib
import sys

import bpy

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent))
from tiface_import import add_lobes  # noqa: E402


def main(arguments):
    if not 1 <= len(arguments) <= 2:
        print(__doc__)
        return 2
    glb = pathlib.Path(arguments[0]).resolve()
    if len(arguments) == 2:
        bpy.ops.wm.read_factory_settings(use_empty=True)
    before = set(bpy.context.scene.objects)
    bpy.ops.import_scene.gltf(filepath=str(glb))
    if not add_lobes([found for found in bpy.context.scene.objects if found not in before], glb):
        print(f"{glb.name} holds no lobes: write it with `tiface mesh --lobes 2`")
        return 1
    if len(arguments) == 2:
        bpy.context.scene.view_settings.view_transform = "Standard"
        bpy.ops.wm.save_as_mainfile(filepath=str(pathlib.Path(arguments[1]).resolve()), compress=True)
    return 0


if __name__ == "__main__":
    given = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    ended = main(given)
    if bpy.app.background:
        sys.exit(ended)
