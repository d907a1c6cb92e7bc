"""Shows a head with lobes in Blender, by tools/blender/lobes.py, from the held-out cameras of its run, and compares
with what `tiface render --with textured` shows from there.

    tiface render RUN --with textured
    python3.11 -m venv .venv-blender && .venv-blender/bin/pip install -r tools/readers/requirements-blender.txt
    .venv-blender/bin/python tools/readers/check_lobes.py RUN [--views 1] [--samples 4] [--save DIR]

Compared are pixels that the head covers in both pictures. Checked: PSNR above 35 dB. --save keeps the pictures, and
those of the base color alone: NAME_{blender,blender_base}.png. Exits 1 after printing every disagreement.
"""

import argparse
import json
import pathlib
import subprocess
import sys
import tempfile

import numpy
import PIL.Image

from axes import turn_to_y_up
from verdict import exit_code

RENDER = pathlib.Path(__file__).resolve().parents[1] / "blender/render.py"
LEAST = 35.0


def in_file(camera, described):
    """A camera of the run in the file's axes and meters: +Y up."""
    turn = turn_to_y_up(described["up"])
    pose = numpy.eye(4)
    pose[:3, :3] = turn @ numpy.reshape(camera["rotation"], (3, 3)).T  # columns are stored
    pose[:3, 3] = turn @ camera["position"] * described["unit_m"]
    return {"world_from_camera": pose.tolist(), "fl_x": camera["fx"], "fl_y": camera["fy"],
            "cx": camera["cx"], "cy": camera["cy"], "w": camera["width"], "h": camera["height"]}


def picture_of(path):
    return numpy.asarray(PIL.Image.open(path).convert("RGBA")).astype(float)


def psnr(a, b):
    both = (a[..., 3] == 255) & (b[..., 3] == 255)
    return 10 * numpy.log10(255**2 / ((a - b)[both][:, :3] ** 2).mean()), both.mean()


def outline(a, b):
    """The same of the pixels that the head covers in part: its outline, and what is soft around it. Over black."""
    partly = ((a[..., 3] > 0) & (a[..., 3] < 255)) | ((b[..., 3] > 0) & (b[..., 3] < 255))
    over = [p[..., :3] * p[..., 3:] / 255 for p in (a, b)]
    return 10 * numpy.log10(255**2 / ((over[0] - over[1])[partly] ** 2).mean())


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("run", type=pathlib.Path)
    arguments.add_argument("--views", type=int, default=1)
    arguments.add_argument("--samples", type=int, default=4)
    arguments.add_argument("--save", type=pathlib.Path)
    arguments = arguments.parse_args()
    described = json.loads((arguments.run / "cameras.json").read_text())
    folder = arguments.run / "render/textured"
    views = [v for v in described["views"]
             if (folder / f"{v['name']}.png").exists() and not any(v["camera"]["distortion"].values())]
    wrong = [] if views else [f"{folder} has no picture of an undistorted camera"]
    with tempfile.TemporaryDirectory() as scratch:
        out = arguments.save or pathlib.Path(scratch)
        out.mkdir(parents=True, exist_ok=True)
        for view in views[: arguments.views]:
            name = view["name"]
            camera = pathlib.Path(scratch) / "camera.json"
            camera.write_text(json.dumps(in_file(view["camera"], described)))
            found = {}
            kinds = [("blender", ["--lobes"])] + ([("blender_base", [])] if arguments.save else [])
            for which, option in kinds:
                target = out / f"{name}_{which}.png"
                subprocess.run(
                    [sys.executable, RENDER, arguments.run / "mesh/head.glb", camera, target, "--samples",
                     str(arguments.samples), *option], check=True, stdout=subprocess.DEVNULL)
                pictures = picture_of(target), picture_of(folder / f"{name}.png")
                found[which] = (*psnr(*pictures), outline(*pictures))
            said = ", ".join(f"{which} {db:.1f} dB" for which, (db, *_) in found.items())
            lobes, share, rim = found["blender"]
            print(f"view {name}: {said} from tiface, over {100 * share:.0f} % of the picture; {rim:.1f} dB at its outline")
            if share < 0.02:
                wrong.append(f"{name}: the head is not in the picture")
            if not lobes > LEAST:
                wrong.append(f"{name}: expected more than {LEAST} dB")
    return exit_code(wrong)


if __name__ == "__main__":
    sys.exit(main())
