"""Measures the outline of a head in rendered views, where hair ends: `outline.py CAPTURE RUN [RUN ...]`.

CAPTURE is a folder with `masks`, `head_only` (the head over black, without the light of the stage in its soft pixels)
and `face_masks`; RUN has `render/METHOD/NAME.png` of its held-out views, straight alpha. Of each method it prints

- band: PSNR, dB, against `head_only` over black, of the pixels of the head within 3 pixels of the mask's outline;
- alpha: root mean square error of opacity there;
- step: with the view over white, and the profile of brightness along the outline's normal, mean over arcs of 24
  pixels, every quarter of a pixel: the largest change over half a pixel, beyond the mesh's own edge (from 1 to 12
  pixels outside the mask's outline), minus T-Face's largest change of the same arc; 1/255, mean over the arcs, and the
  largest of any arc. Rings of layers show here, strands that all methods have do not.

Needs numpy, scipy and Pillow.
"""

import pathlib
import sys

import numpy as np
from PIL import Image
from scipy import ndimage

BAND_PX = 3
ARC_PX = 24
REACH_PX = (1.0, 12.0)
SPACING_PX = 0.25


def gray(path):
    return np.asarray(Image.open(path).convert("L"), float) / 255


def view(path):
    """Color premultiplied, and opacity, both 0..1."""
    rgba = np.asarray(Image.open(path).convert("RGBA"), float) / 255
    return rgba[..., :3] * rgba[..., 3:], rgba[..., 3]


def signed_distance(mask):
    inside = mask >= 0.5
    return ndimage.distance_transform_edt(~inside) - ndimage.distance_transform_edt(inside)


def head_part(capture, name, mask):
    """Pixels nearer to the head than to neck and garment, by the mask of the face."""
    face = gray(capture / "face_masks" / f"{name}.png") >= 0.5
    body = (mask >= 0.5) & ~face
    return ndimage.distance_transform_edt(~face) < ndimage.distance_transform_edt(~body)


def band(capture, name, seen):
    mask = gray(capture / "masks" / f"{name}.png")
    color, alpha = seen
    truth = np.asarray(Image.open(capture / "head_only" / f"{name}.png").convert("RGB"), float) / 255
    near = (np.abs(signed_distance(mask)) <= BAND_PX + 0.5) & head_part(capture, name, mask)
    return ((color - truth)[near] ** 2).mean(-1), (alpha - mask)[near] ** 2


def arcs(capture, name):
    """Points of the head's outline and their outward normals, in arcs."""
    mask = gray(capture / "masks" / f"{name}.png")
    smooth = ndimage.gaussian_filter(mask, 2.0)
    down, across = np.gradient(smooth)
    edge = (signed_distance(smooth) > 0) & (signed_distance(smooth) <= 1.0) & head_part(capture, name, mask)
    ys, xs = np.nonzero(edge)
    normals = -np.stack([down[ys, xs], across[ys, xs]], 1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-9
    left = set(range(len(ys)))
    points = np.stack([ys, xs], 1).astype(float)
    while left:
        start = min(left)
        near = [i for i in left if np.linalg.norm(points[i] - points[start]) <= ARC_PX]
        left.difference_update(near)
        if len(near) >= ARC_PX // 2:
            yield points[near], normals[near]


def profile(white, points, normals):
    """Mean brightness along the normals, 1/255, and the distances."""
    away = np.arange(REACH_PX[0], REACH_PX[1] + 1e-9, SPACING_PX)
    at = points[:, None] + away[None, :, None] * normals[:, None]
    values = ndimage.map_coordinates(white, at.reshape(-1, 2).T, order=1, mode="nearest").reshape(at.shape[:2])
    return 255 * values.mean(0)


def largest_change(values):
    step = round(0.5 / SPACING_PX)
    return np.abs(values[step:] - values[:-step]).max()


def steps(capture, name, seen, reference):
    white = [(color + (1 - alpha)[..., None]).mean(-1) for color, alpha in (seen, reference)]
    for points, normals in arcs(capture, name):
        ours, theirs = (largest_change(profile(w, points, normals)) for w in white)
        yield ours - theirs


def main():
    capture = pathlib.Path(sys.argv[1])
    print(f"{'run':24} {'method':9} {'band dB':>8} {'alpha':>7} {'step':>6} {'worst':>6}")
    for run in map(pathlib.Path, sys.argv[2:]):
        for folder in sorted(p for p in (run / "render").iterdir() if any(p.glob("*.png"))):
            errors, opacities, rings = [], [], []
            for path in sorted(folder.glob("*.png")):
                seen = view(path)
                error, opacity = band(capture, path.stem, seen)
                errors.append(error)
                opacities.append(opacity)
                reference = run / "render/tface" / path.name
                if reference.exists():
                    rings.extend(steps(capture, path.stem, seen, view(reference)))
            dB = np.mean([-10 * np.log10(e.mean()) for e in errors])
            alpha = np.sqrt(np.concatenate(opacities).mean())
            mean, worst = (np.mean(rings), np.max(rings)) if rings else (np.nan, np.nan)
            print(f"{str(run)[-24:]:24} {folder.name:9} {dB:8.2f} {alpha:7.4f} {mean:6.1f} {worst:6.1f}")


if __name__ == "__main__":
    main()
