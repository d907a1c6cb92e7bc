"""Lays pictures that check_lobes.mjs and check_lobes.py kept (--save) beside each other, as docs/lobes.jpg and
docs/soft-layers.jpg have them.

    python tools/readers/sheet.py lobes PICTURES OUT.jpg VIEW VIEW
    python tools/readers/sheet.py layers PICTURES OUT.jpg VIEW LEFT TOP RIGHT BOTTOM

`lobes`: of each view the base color and the color with lobes, three.js above, Blender below. `layers`: this part of a view,
before white and before gray: VIEW_bare.png, a render by tools/blender/render.py of `tiface export RUN --no-layers`; then
with layers tiface, three.js and Blender. Needs numpy and Pillow.
"""

import pathlib
import sys

import numpy
import PIL.Image

LOBES = [["base", "three"], ["blender_base", "blender"]]
LAYERS = ["bare", "tiface", "three", "blender"]
LIGHT, WHITE, GRAY = 225, 255, 72
GAP = 4


def picture(folder, view, which, ground, seen=(slice(None), slice(None))):
    rgba = numpy.asarray(PIL.Image.open(folder / f"{view}_{which}.png").convert("RGBA"), float)[tuple(seen)]
    alpha = rgba[..., 3:] / 255
    return numpy.pad(rgba[..., :3] * alpha + ground * (1 - alpha), ((0, GAP), (0, GAP), (0, 0)), constant_values=255)


def lobes(folder, views):
    return [[picture(folder, view, which, LIGHT) for view in views for which in row] for row in LOBES]


def layers(folder, view, box):
    left, top, right, bottom = map(int, box)
    seen = [slice(top, bottom), slice(left, right)]
    return [[picture(folder, view, which, ground, seen) for which in LAYERS] for ground in (WHITE, GRAY)]


def main():
    what, folder, out, *rest = sys.argv[1:]
    folder = pathlib.Path(folder)
    rows = lobes(folder, rest) if what == "lobes" else layers(folder, rest[0], rest[1:])
    sheet = numpy.concatenate([numpy.concatenate(row, 1) for row in rows], 0)
    PIL.Image.fromarray(numpy.round(sheet).astype(numpy.uint8)).save(out, quality=88, optimize=True)


if __name__ == "__main__":
    main()
