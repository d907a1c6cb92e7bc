"""Puts meshes that several programs made of one capture beside each other; prints Markdown.

    python tools/reference/peers.py CAPTURE MESH... [--against SURFACE] [--name NAME...]
    python tools/reference/peers.py CAPTURE --colmap FOLDER    # training views for programs that read COLMAP

CAPTURE has transforms.json (frames with `split`) or transforms_train.json and transforms_test.json, photographs
without distortion, and soft masks (`mask_path`, masks/NAME.png, or alpha); optionally a region of face, ears and
hair (`face_mask_path`, face_masks/NAME.png) and the true surface (gt.ply, or --against). MESH is what trimesh reads,
in the capture's world; a .glb has +Y up and is turned; a folder is a run of ours. What the figures mean, and how other
programs get the capture: tools/reference/peers.md. Needs tools/readers/requirements.txt; one core, seconds a mesh.
"""

import argparse
import json
import pathlib
import sys

import numpy
import open3d
import trimesh
from PIL import Image

POINTS = 60_000  # spread over each surface
SIDE = 3  # rays along each side of a pixel
INSIDE = 128  # a mask counts from here on: half
LEAST_COSINE = 0.26  # flatter than 75 degrees a camera does not count; as in src/metrics/distance.rs
EDGE_PX, SAMPLE_PX, APART_PX, LEAST_SHARE = 3, 6, 10, 0.05  # as in src/metrics/parts.rs


# capture


class View:
    """A photograph with camera and masks."""

    def __init__(self, root, frame, shared):
        get = {**shared, **frame}.get
        if any(get(k) for k in ("k1", "k2", "k3", "k4", "p1", "p2")):
            sys.exit(f"{frame['file_path']}: undistort the photographs first")
        path = root / frame["file_path"]
        path = path if path.suffix else path.with_suffix(".png")
        self.name, picture = path.stem, Image.open(path)
        self.color = numpy.asarray(picture.convert("RGB"))
        self.height, self.width = self.color.shape[:2]
        self.fx = get("fl_x") or 0.5 * self.width / numpy.tan(0.5 * get("camera_angle_x"))
        self.fy, self.cx, self.cy = get("fl_y") or self.fx, get("cx") or self.width / 2, get("cy") or self.height / 2
        pose = numpy.array(frame["transform_matrix"], float)
        self.rotation, self.position = pose[:3, :3], pose[:3, 3]

        def gray(key, folder):
            file = root / (get(key) or f"{folder}/{path.stem}.png")
            return numpy.asarray(Image.open(file).convert("L")) if file.is_file() else None

        self.mask = gray("mask_path", "masks")
        if self.mask is None and "A" in picture.getbands():
            self.mask = numpy.asarray(picture.getchannel("A"))
        if self.mask is None:
            sys.exit(f"{path}: no mask; the outline cannot be judged")
        self.region = gray("face_mask_path", "face_masks")

    def rays(self):
        """[height · width · SIDE², 6], pixel by pixel."""
        steps = (numpy.arange(SIDE) + 0.5) / SIDE
        y, x, v, u = numpy.meshgrid(numpy.arange(self.height), numpy.arange(self.width), steps, steps, indexing="ij")
        local = numpy.stack([(x + u - self.cx) / self.fx, -(y + v - self.cy) / self.fy, -numpy.ones_like(u)], -1)
        way = local.reshape(-1, 3) @ self.rotation.T
        return numpy.concatenate([numpy.broadcast_to(self.position, way.shape), way], 1).astype(numpy.float32)

    def project(self, points):
        """Columns, rows, and whether they are in the frame."""
        p = (points - self.position) @ self.rotation
        depth = numpy.where(p[:, 2] < 0, -p[:, 2], numpy.nan)
        x, y = self.fx * p[:, 0] / depth + self.cx, -self.fy * p[:, 1] / depth + self.cy
        return x, y, (x >= 0) & (y >= 0) & (x < self.width) & (y < self.height)


def views(root, split):
    def read(name):
        return json.loads((root / name).read_text())

    whole = root / "transforms.json"
    data = read("transforms.json") if whole.is_file() else {}
    frames = [f for f in data.get("frames", []) if f.get("split") == split]
    if not frames:
        data = read(f"transforms_{split}.json")
        frames = data["frames"]
    shared = {k: v for k, v in data.items() if k != "frames"}
    return [View(root, frame, shared) for frame in frames]


def write_colmap(views, folder):
    """Training views as COLMAP has them undistorted: images/, masks/NAME.mask.png, sparse/*.txt without points."""
    for name in ("images", "masks", "sparse"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    cameras, images = [], []
    for i, v in enumerate(views, 1):
        Image.fromarray(v.color).save(folder / f"images/{v.name}.png")
        Image.fromarray(255 * (v.mask >= INSIDE).astype(numpy.uint8)).save(folder / f"masks/{v.name}.mask.png")
        cameras.append(f"{i} PINHOLE {v.width} {v.height} {v.fx} {v.fy} {v.cx} {v.cy}")
        r = numpy.diag([1, -1, -1]) @ v.rotation.T  # camera from world; y down, z forward
        # the quaternion is the eigenvector of Bar-Itzhack's matrix for its largest eigenvalue
        k = numpy.array([
            [r[0, 0] - r[1, 1] - r[2, 2], r[1, 0] + r[0, 1], r[2, 0] + r[0, 2], r[2, 1] - r[1, 2]],
            [0, r[1, 1] - r[0, 0] - r[2, 2], r[2, 1] + r[1, 2], r[0, 2] - r[2, 0]],
            [0, 0, r[2, 2] - r[0, 0] - r[1, 1], r[1, 0] - r[0, 1]],
            [0, 0, 0, numpy.trace(r)],
        ])
        x, y, z, w = numpy.linalg.eigh(k, UPLO="U")[1][:, 3]
        numbers = " ".join(f"{n:.12g}" for n in (w, x, y, z, *(-r @ v.position)))
        images.append(f"{i} {numbers} {i} {v.name}.png\n")
    (folder / "sparse/cameras.txt").write_text("\n".join(cameras) + "\n")
    (folder / "sparse/images.txt").write_text("\n".join(images) + "\n")
    (folder / "sparse/points3D.txt").write_text("")


# parts of a view; src/metrics/parts.rs says why


def near(these, radius):
    """Pixels within `radius` of one of `these`."""
    height, width = these.shape
    out = these.copy()
    for dy in range(-radius, radius + 1):
        half = int((radius * radius - dy * dy) ** 0.5)
        for dx in range(-half, half + 1):
            to = numpy.s_[max(0, -dy) : height - max(0, dy), max(0, -dx) : width - max(0, dx)]
            of = numpy.s_[max(0, dy) : height - max(0, -dy), max(0, dx) : width - max(0, -dx)]
            out[to] |= these[of]
    return out


def soft_rim(mask):
    """Where the mask and all its neighbors are neither 0 nor 1: hair before the background."""
    height, width = mask.shape
    soft = numpy.pad((mask > 0) & (mask < 255), 1, constant_values=True)
    return numpy.all([soft[y : y + height, x : x + width] for y in range(3) for x in range(3)], 0)


class Tones:
    """Colors of skin and hair, from beside hard and soft rims of the masks."""

    @staticmethod
    def of(views):
        samples = ([], [])
        for v in (v for v in views if v.region is not None):
            head, region, soft = v.mask >= INSIDE, v.region >= INSIDE, soft_rim(v.mask)
            far = near(soft, APART_PX)
            hard = near(~head, 1) & head & ~far & region
            opaque = region & (v.mask == 255)
            samples[0].append(v.color[opaque & near(hard, SAMPLE_PX) & ~far])
            samples[1].append(v.color[opaque & near(soft, SAMPLE_PX)])
        skin, hair = [numpy.concatenate(s) if s else numpy.zeros((0, 3)) for s in samples]
        if min(len(skin), len(hair)) <= LEAST_SHARE * (len(skin) + len(hair)):
            return None
        tones = Tones()
        tones.median = [numpy.median(s, 0) for s in (skin, hair)]
        away = [numpy.median(abs(s - m), 0) for s, m in zip((skin, hair), tones.median)]
        tones.deviation = [numpy.maximum(a, 1) for a in away]
        apart = abs(tones.median[0] - tones.median[1]) > 2 * (tones.deviation[0] + tones.deviation[1])
        return tones if apart.any() else None

    def split(self, view):
        """Skin and hair of a view with a region; hair has its soft rim."""
        skin, hair = [(abs(view.color - m) / d).sum(-1) for m, d in zip(self.median, self.deviation)]
        region, opaque = view.region >= INSIDE, view.mask == 255
        rim = ~opaque & near(soft_rim(view.mask), 1)
        return region & opaque & ~(hair < skin), region & (opaque & (hair < skin) | rim)


# surfaces


class Surface:
    def __init__(self, path):
        scene = trimesh.load(path, process=False)
        if isinstance(scene, trimesh.Scene):  # translucent layers; what is left is the head under them
            soft = [name for name, g in scene.geometry.items()
                    if getattr(getattr(g.visual, "material", None), "alphaMode", None) == "BLEND"]
            scene.delete_geometry(soft)
        mesh = scene.to_mesh() if isinstance(scene, trimesh.Scene) else scene
        if not len(getattr(mesh, "faces", ())):
            sys.exit(f"{path}: no triangles")
        self.points = numpy.asarray(mesh.vertices, float)
        if path.suffix in (".glb", ".gltf"):
            self.points = self.points[:, [0, 2, 1]] * [1, -1, 1]  # +Y up → +Z up
        self.triangles = numpy.asarray(mesh.faces, numpy.uint32)
        self.scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        self.scene.add_triangles(open3d.core.Tensor(self.points.astype(numpy.float32)), open3d.core.Tensor(self.triangles))
        self.uv = self.texture = self.colors = None
        visual = mesh.visual
        if visual.kind == "texture" and visual.uv is not None:
            material = visual.material
            picture = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
            if picture is not None:
                self.uv, self.texture = numpy.asarray(visual.uv), numpy.asarray(picture.convert("RGB"))
        elif visual.kind == "vertex":
            self.colors = numpy.asarray(visual.vertex_colors)[:, :3].astype(float)

    def open_edges(self):
        """Edges that do not have exactly two triangles, equal positions taken as one."""
        _, welded = numpy.unique(self.points.astype(numpy.float32), axis=0, return_inverse=True)
        t = welded.reshape(-1)[self.triangles]
        t = t[(t[:, 0] != t[:, 1]) & (t[:, 1] != t[:, 2]) & (t[:, 2] != t[:, 0])]
        edges = numpy.sort(numpy.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]]), 1)
        return int((numpy.unique(edges, axis=0, return_counts=True)[1] != 2).sum())

    def sample(self):
        """Points spread evenly by area, and their normals; the same places as in src/metrics/distance.rs."""
        a, b, c = (self.points[self.triangles[:, k]] for k in range(3))
        cross = numpy.cross(b - a, c - a)
        area = numpy.linalg.norm(cross, axis=1)
        total, i = numpy.cumsum(area), numpy.arange(POINTS)
        t = numpy.searchsorted(total, (i + 0.5) / POINTS * total[-1], side="right").clip(max=len(area) - 1)
        u, v = (0.5 + 0.7548776662466927 * i) % 1, (0.5 + 0.5698402909980532 * i) % 1
        u, v = numpy.where(u + v > 1, 1 - u, u)[:, None], numpy.where(u + v > 1, 1 - v, v)[:, None]
        return a[t] + u * (b - a)[t] + v * (c - a)[t], cross[t] / numpy.maximum(area[t], 1e-30)[:, None]

    def seen_by(self, view, points, normals):
        """Indices of the points that a view sees, with their pixels."""
        x, y, inside = view.project(points)
        way = view.position - points
        distance = numpy.linalg.norm(way, axis=1)
        way /= distance[:, None]
        i = numpy.flatnonzero(inside & ((way * normals).sum(1) > LEAST_COSINE))
        lift = 1e-4 * numpy.ptp(self.points, axis=0).max()
        rays = numpy.concatenate([points[i] + lift * normals[i], way[i]], 1).astype(numpy.float32)
        hit = self.scene.cast_rays(open3d.core.Tensor(rays), nthreads=1)["t_hit"].numpy()
        i = i[~(hit < distance[i])]
        return i, y[i].astype(int), x[i].astype(int)

    def closest(self, points):
        answer = self.scene.compute_closest_points(open3d.core.Tensor(points.astype(numpy.float32)), nthreads=1)
        return answer["points"].numpy()

    def render(self, view):
        """Opacity, and color over black where the surface has any, [height, width(, 3)], 0..=1."""
        answer = self.scene.cast_rays(open3d.core.Tensor(view.rays()), nthreads=1)
        hit = numpy.flatnonzero(numpy.isfinite(answer["t_hit"].numpy()))
        whole = numpy.zeros(view.width * view.height * SIDE * SIDE)
        whole[hit] = 1
        opacity = whole.reshape(view.height, view.width, -1).mean(-1)
        if self.texture is None and self.colors is None:
            return opacity, None
        corner = self.triangles[answer["primitive_ids"].numpy()[hit]]
        uv = answer["primitive_uvs"].numpy()[hit]
        weight = numpy.stack([1 - uv.sum(1), uv[:, 0], uv[:, 1]], 1)[..., None]
        color = numpy.zeros((len(whole), 3))
        if self.texture is not None:
            color[hit] = bilinear(self.texture, (self.uv[corner] * weight).sum(1))
        else:
            color[hit] = (self.colors[corner] * weight).sum(1)
        return opacity, color.reshape(view.height, view.width, -1, 3).mean(2) / 255


def bilinear(texture, uv):
    """Of a texture whose v points up, as trimesh has it."""
    height, width = texture.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    x0, y0 = numpy.floor(x).astype(int), numpy.floor(y).astype(int)
    out = 0
    for dy in range(2):
        for dx in range(2):
            weight = abs(1 - dx - (x - x0)) * abs(1 - dy - (y - y0))
            out = out + weight[:, None] * texture[(y0 + dy).clip(0, height - 1), (x0 + dx).clip(0, width - 1)]
    return out


# figures


def psnr(square, where):
    return -10 * numpy.log10(square[where].mean()) if where.any() and square[where].any() else numpy.nan


def pictures(surface, test, tones):
    """Means over the test views: coverage, and how its colors look in parts."""
    rows = []
    for v in test:
        opacity, color = surface.render(v)
        head, covered = v.mask >= INSIDE, opacity >= 0.5
        target = numpy.round(v.color * (v.mask / 255.0)[..., None]) / 255
        row = {"missing": (head & ~covered).sum(), "extra": (covered & ~head).sum()}
        row["cap"] = psnr(numpy.where(covered[..., None], 0, target) ** 2, head)
        if v.region is not None:
            row["uncovered"] = 100 * (~covered)[v.region >= INSIDE].mean()
        if color is not None:
            square = (numpy.round(255 * color) / 255 - target) ** 2
            row["masked"] = psnr(square, head)
            row["opaque"] = psnr(square, v.mask == 255)
            row["edge"] = psnr(square, near(head, EDGE_PX) & near(~head, EDGE_PX))
            if tones and v.region is not None:
                row["skin"], row["hair"] = [psnr(square, part) for part in tones.split(v)]
        rows.append(row)
    mean = {}
    for key in rows[0]:
        values = [r[key] for r in rows if key in r and numpy.isfinite(r[key])]
        mean[key] = numpy.mean(values) if values else numpy.nan
    return mean


class Truth:
    """Points of the true surface, by how many training cameras see them and what they are."""

    def __init__(self, path, train, tones):
        self.surface = Surface(path)
        self.points, self.normals = self.surface.sample()
        self.seen = numpy.zeros(POINTS, int)
        regions = all(v.region is not None for v in train)
        names = ["skin", "hair"] if tones else ["region"] if regions else []
        votes = {name: numpy.zeros(POINTS) for name in names}
        for v in train:
            i, y, x = self.surface.seen_by(v, self.points, self.normals)
            self.seen[i] += 1
            if v.region is not None:
                parts = tones.split(v) if tones else [v.region >= INSIDE]
                for name, part in zip(names, parts):
                    votes[name][i] += part[y, x]
        # of the views that see a point, more than half have to agree
        self.parts = {name: (self.seen >= 3) & (vote > self.seen / 2) for name, vote in votes.items()}

    def distances(self, surface, train):
        """In thousandths of the capture's unit: millimeters of a capture in meters."""
        points, normals = surface.sample()
        seen = numpy.zeros(POINTS, int)
        for v in train:
            seen[surface.seen_by(v, points, normals)[0]] += 1
        there = points[seen >= 3]
        there = 1e3 * numpy.linalg.norm(self.surface.closest(there) - there, axis=1) if len(there) else [numpy.nan]
        way = surface.closest(self.points) - self.points
        back = 1e3 * numpy.linalg.norm(way, axis=1)
        signed = numpy.copysign(back, (way * self.normals).sum(1))

        def median(values, which):
            return numpy.median(values[which]) if which.any() else numpy.nan

        out = {"mean": numpy.mean(there), "median": numpy.median(there)}
        for name, which in self.parts.items():
            out[name], out[name + "_signed"] = median(back, which), median(signed, which)
        by = (self.seen == 1, self.seen == 2, (self.seen == 3) | (self.seen == 4), self.seen >= 5)
        out["by_views"] = [median(back, which) for which in by]
        return out


def table(rows):
    """Rows of (heading, text) pairs of equal headings."""
    print("| " + " | ".join(h for h, _ in rows[0]) + " |")
    print("|" + " --- |" * len(rows[0]))
    for row in rows:
        print("| " + " | ".join(text for _, text in row) + " |")
    print()


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("capture", type=pathlib.Path)
    parser.add_argument("meshes", type=pathlib.Path, nargs="*", metavar="mesh")
    parser.add_argument("--colmap", type=pathlib.Path, help="write the training views here, for other programs")
    parser.add_argument("--against", type=pathlib.Path, help="the true surface, instead of CAPTURE/gt.ply")
    parser.add_argument("--name", nargs="*", default=[], help="what to call the meshes, in their order")
    options = parser.parse_args()
    train = views(options.capture, "train")
    if options.colmap:
        write_colmap(train, options.colmap)
    if not options.meshes:
        return
    test = views(options.capture, "test")
    tones = Tones.of(train)
    truth_file = options.against or options.capture / "gt.ply"
    truth = Truth(truth_file, train, tones) if truth_file.is_file() else None

    def text(values, key, digits=2, sign=False):
        value = values.get(key, numpy.nan)
        return format(value, f"{'+' if sign else ''}.{digits}f") if numpy.isfinite(value) else "–"

    shape, seen, looks = [], [], []
    for k, path in enumerate(options.meshes):
        name = options.name[k] if k < len(options.name) else str(path)
        surface = Surface(path / "mesh/surface.ply" if path.is_dir() else path)
        look = pictures(surface, test, tones)
        row = [("mesh", name), ("triangles", f"{len(surface.triangles):,}"), ("open edges", f"{surface.open_edges():,}")]
        if truth:
            d = truth.distances(surface, train)
            row.append(("3 cameras, mean / median", f"{text(d, 'mean')} / {text(d, 'median')}"))
            for kind in truth.parts:
                row.append((f"{kind} (signed)", f"{text(d, kind)} ({text(d, kind + '_signed', sign=True)})"))
            by = [format(v, ".2f") if numpy.isfinite(v) else "–" for v in d["by_views"]]
            seen.append([("seen by", name), *zip(("1", "2", "3 or 4", "5 or more"), by)])
        row.append(("missing + extra", f"{look['missing']:.0f} + {look['extra']:.0f}"))
        row.append(("cap, dB", text(look, "cap")))
        row.append(("region uncovered", text(look, "uncovered", 1) + " %"))
        shape.append(row)
        parts = [(key, text(look, key)) for key in ("masked", "opaque", "edge", "skin", "hair")]
        looks.append([("PSNR of its colors", name), *parts])
    table(shape)
    if truth:
        table(seen)
    table(looks)


if __name__ == "__main__":
    main()
