"""Measures the outline of a head in rendered views, where hair ends.

    outline.py band CAPTURE RUN [RUN ...]
    outline.py steps PICTURES TFACE_PICTURES [--zoom 4]

`band`: CAPTURE is a folder with `masks`, `face_masks` and `head_only` (the head over black, without the light of the
stage in its soft pixels); RUN has `render/METHOD/NAME.png` of its held-out views. Of each method, over the pixels of
the head within 3 pixels of the mask's outline: PSNR against `head_only`, dB, mean of the views; and the root mean
square error of opacity.

`steps`: two folders of pictures from the same cameras, by any method and by T-Face, straight alpha, enlarged `zoom`
times against the photographs (`tiface render RUN --cameras FILE --with tface,textured`). Both are laid over white.
Along the normals of the outline, where T-Face's opacity is 1/2, the brightness is a profile, mean over an arc of 12
pixels of a photograph. A step is its largest change over half such a pixel, from 1 to 16 pixels outside the outline:
there T-Face's strands end, and layers end. Prints the mean of the arcs, 1/255, of both, and of the difference.

Needs numpy, scipy and Pillow.
"""

import argparse
import pathlib

import numpy as np
from PIL import Image
from scipy import ndimage

BAND_PX = 3
ARC_PX = 12
REACH_PX = (1.0, 16.0)
SAMPLES_PER_PX = 4


def gray(path):
    return np.asarray(Image.open(path).convert("L"), float) / 255


def view(path):
    """Color premultiplied, and opacity, both 0..1."""
    rgba = np.asarray(Image.open(path).convert("RGBA"), float) / 255
    return rgba[..., :3] * rgba[..., 3:], rgba[..., 3]


def signed_distance(inside):
    return ndimage.distance_transform_edt(~inside) - ndimage.distance_transform_edt(inside)


def head_part(face, mask):
    """Pixels nearer to the head than to neck and garment, by the mask of the face."""
    body = (mask >= 0.5) & ~face
    return ndimage.distance_transform_edt(~face) < ndimage.distance_transform_edt(~body)


def band(capture, path):
    mask = gray(capture / "masks" / path.name)
    color, alpha = view(path)
    truth = np.asarray(Image.open(capture / "head_only" / path.name).convert("RGB"), float) / 255
    face = gray(capture / "face_masks" / path.name) >= 0.5
    near = (np.abs(signed_distance(mask >= 0.5)) <= BAND_PX + 0.5) & head_part(face, mask)
    return -10 * np.log10(((color - truth)[near] ** 2).mean()), (alpha - mask)[near] ** 2


def print_bands(capture, runs):
    print(f"{'run':24} {'method':9} {'band dB':>8} {'opacity':>8}")
    for run in runs:
        for folder in sorted(p for p in (run / "render").iterdir() if any(p.glob("*.png"))):
            found = [band(capture, path) for path in sorted(folder.glob("*.png"))]
            opacity = np.sqrt(np.concatenate([squares for _, squares in found]).mean())
            print(f"{str(run)[-24:]:24} {folder.name:9} {np.mean([db for db, _ in found]):8.2f} {opacity:8.4f}")


def arcs(opacity, zoom):
    """Points of an outline and its outward normals, in arcs."""
    smooth = ndimage.gaussian_filter(opacity, 2.0 * zoom)
    down, across = np.gradient(smooth)
    distance = signed_distance(smooth >= 0.5)
    border = np.zeros(opacity.shape, bool)
    border[2:-2, 2:-2] = True
    points = np.argwhere((distance > 0) & (distance <= 1.0) & border).astype(float)
    rows, columns = points.astype(int).T
    normals = -np.stack([down[rows, columns], across[rows, columns]], 1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-9
    left = np.ones(len(points), bool)
    while left.any():
        near = left & (np.linalg.norm(points - points[left.argmax()], axis=1) <= ARC_PX * zoom)
        left &= ~near
        if near.sum() >= ARC_PX * zoom // 2:
            yield points[near], normals[near]


def largest_step(white, points, normals, zoom):
    """The largest change of the mean brightness along the normals over half a pixel of a photograph, 1/255."""
    away = zoom * np.arange(*REACH_PX, 1 / SAMPLES_PER_PX)
    at = points[:, None] + away[None, :, None] * normals[:, None]
    inside = ((at >= 0) & (at <= np.array(white.shape) - 1)).all((1, 2))
    if inside.sum() < len(points) // 2:
        return None
    at = at[inside]
    values = ndimage.map_coordinates(white, at.reshape(-1, 2).T, order=1).reshape(at.shape[:2]).mean(0)
    half = SAMPLES_PER_PX // 2
    return 255 * np.abs(values[half:] - values[:-half]).max()


def print_steps(pictures, references, zoom):
    found = []
    for path in sorted(references.glob("*.png")):
        both = [view(pictures / path.name), view(path)]
        white = [(color + (1 - alpha)[..., None]).mean(-1) for color, alpha in both]
        for points, normals in arcs(both[1][1], zoom):
            steps = [largest_step(w, points, normals, zoom) for w in white]
            if None not in steps:
                found.append(steps)
    ours, theirs = np.array(found).T
    print(f"{len(found)} arcs: {ours.mean():.1f}, T-Face {theirs.mean():.1f}, difference {(ours - theirs).mean():.1f}, "
          f"nine in ten below {np.percentile(ours - theirs, 90):.1f}")


def main():
    arguments = argparse.ArgumentParser()
    commands = arguments.add_subparsers(dest="command", required=True)
    bands = commands.add_parser("band")
    bands.add_argument("capture", type=pathlib.Path)
    bands.add_argument("runs", type=pathlib.Path, nargs="+")
    steps = commands.add_parser("steps")
    steps.add_argument("pictures", type=pathlib.Path)
    steps.add_argument("references", type=pathlib.Path)
    steps.add_argument("--zoom", type=float, default=1.0)
    given = arguments.parse_args()
    if given.command == "band":
        print_bands(given.capture, given.runs)
    else:
        print_steps(given.pictures, given.references, given.zoom)


if __name__ == "__main__":
    main()
