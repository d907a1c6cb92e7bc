"""A small TensoRF checkpoint as arrays, converted for the program, and what the published formulas give for it.

    python tools/reference/tensorf_checkpoint.py tests/reference            writes vm_g5.safetensors, vm_g5.json
    python tools/reference/tensorf_checkpoint.py --check tests/reference    compares with those that are there

The field is a fixture given by formulas: every parameter is a sine or a line of its indices. th_to_safetensors.py
converts it, and tests of the program compare what it renders with vm_g5.json. The features, colors and rays are computed
here in float64 from the formulas of TensoRF (Chen et al. 2022) in plain numpy. Printed values are compared with digits of
the published arithmetic in float32 that were computed apart from this script. Where torch is installed, a checkpoint that
it has saved and loaded again must be converted to the same bytes.

Needs numpy.
"""

import json
import pathlib
import sys
import tempfile

import numpy
import th_to_safetensors

AABB = numpy.array([[-1.5, -1.67, -1.0], [1.5, 1.67, 1.0]], numpy.float32)
GRID = [5, 6, 7]
RANK = [2, 1, 1]
PLANE_AXES = [(0, 1), (0, 2), (1, 2)]
LINE_AXIS = [2, 1, 0]
KWARGS = {
    "aabb": AABB, "gridSize": GRID, "density_n_comp": RANK, "appearance_n_comp": RANK,
    "app_dim": 27, "density_shift": -10, "alphaMask_thres": 0.0001, "distance_scale": 25,
    "rayMarch_weight_thres": 0.0001, "fea2denseAct": "relu", "near_far": [3.5, 7.0], "step_ratio": 0.5,
    "shadingMode": "MLP_Fea", "pos_pe": 0, "view_pe": 0, "fea_pe": 0, "featureC": 128,
}
MASK_AABB = numpy.array([[-1.2, -1.4, -0.9], [1.4, 1.5, 0.8]], numpy.float32)
Z, Y, X = numpy.ogrid[:4, :3, :5]
MASK = (Z >= 2) & ((X + Y) % 3 != 0)  # [nz, ny, nx]


def parameters():
    """Every parameter by its name in the checkpoint, float32."""
    out = {}
    c = numpy.arange(2.0)[:, None, None]
    for i in range(3):
        (w_axis, h_axis), rank = PLANE_AXES[i], RANK[i]
        h, w = numpy.arange(GRID[h_axis])[:, None], numpy.arange(GRID[w_axis])
        k = numpy.arange(GRID[LINE_AXIS[i]])
        out[f"density_plane.{i}"] = (0.1 * (c + 1) * (i + 1) + 0.03 * h + 0.01 * w)[None, :rank]
        out[f"app_plane.{i}"] = (0.2 * (c + 1) * (i + 1) - 0.02 * h + 0.05 * w)[None, :rank]
        out[f"density_line.{i}"] = (0.2 * (c[:, :, 0] + 1) - 0.02 * k * (i + 1))[None, :rank, :, None]
        out[f"app_line.{i}"] = (0.3 * (c[:, :, 0] + 1) - 0.01 * k * (i + 1))[None, :rank, :, None]
    sine = lambda rows, columns: numpy.sin(0.7 * numpy.arange(rows)[:, None] + 1.3 * numpy.arange(columns) + 1)
    out["basis_mat.weight"] = 2 * sine(27, sum(RANK))
    for layer, (rows, columns) in zip([0, 2, 4], [(128, 30), (128, 128), (3, 128)]):
        out[f"renderModule.mlp.{layer}.weight"] = 0.4 * sine(rows, columns)
        out[f"renderModule.mlp.{layer}.bias"] = 0.01 * numpy.cos(numpy.arange(rows))
    return {name: value.astype(numpy.float32) for name, value in out.items()}


def checkpoint(values):
    return {
        "kwargs": KWARGS, "state_dict": values, "alphaMask.shape": (1, 1, *MASK.shape),
        "alphaMask.mask": numpy.packbits(MASK.reshape(-1)), "alphaMask.aabb": MASK_AABB,
    }


def through_torch(values):
    """The converted checkpoint after torch has saved and loaded it as the published code does; None without torch."""
    try:
        import torch
    except ImportError:
        print("skipped: torch is not installed, no .th file was read")
        return None
    state = {name: torch.tensor(value) for name, value in values.items()}
    saved = checkpoint(values) | {
        "kwargs": KWARGS | {"aabb": torch.tensor(AABB)}, "state_dict": state,
        "alphaMask.shape": torch.Size((1, 1, *MASK.shape)), "alphaMask.aabb": torch.tensor(MASK_AABB),
    }
    with tempfile.NamedTemporaryFile(suffix=".th") as file:
        torch.save(saved, file.name)
        return th_to_safetensors.convert(th_to_safetensors.load(file.name))


def corners(u, n):
    """Indices and weights of the two nodes around u in -1..1, the outermost nodes standing at -1 and 1."""
    x = (u + 1) / 2 * (n - 1)
    low = min(max(int(numpy.floor(x)), 0), n - 2)
    return [(low, 1 - (x - low)), (low + 1, x - low)]


def components(values, kind, u):
    """plane · line of every component at u, component-major."""
    out = []
    for i in range(3):
        plane = values[f"{kind}_plane.{i}"][0].astype(numpy.float64)
        line = values[f"{kind}_line.{i}"][0, :, :, 0].astype(numpy.float64)
        w_axis, h_axis = PLANE_AXES[i]
        at_h, at_w = corners(u[h_axis], plane.shape[1]), corners(u[w_axis], plane.shape[2])
        on_plane = sum(wh * ww * plane[:, h, w] for h, wh in at_h for w, ww in at_w)
        on_line = sum(wk * line[:, k] for k, wk in corners(u[LINE_AXIS[i]], line.shape[1]))
        out.append(on_plane * on_line)
    return numpy.concatenate(out)


def normalized(p):
    low, high = AABB.astype(numpy.float64)
    return (p - low) * 2 / (high - low) - 1


def density_feature(values, u):
    return components(values, "density", u).sum()


def features(values, u):
    return values["basis_mat.weight"].astype(numpy.float64) @ components(values, "app", u)


def color(values, feature, direction):
    x = numpy.concatenate([feature, direction])
    for layer in [0, 2, 4]:
        x = values[f"renderModule.mlp.{layer}.weight"].astype(numpy.float64) @ x
        x = x + values[f"renderModule.mlp.{layer}.bias"]
        x = numpy.maximum(x, 0) if layer < 4 else 1 / (1 + numpy.exp(-x))
    return x


def maybe_occupied(p):
    """Trilinear, nothing beyond the mask's box, more than 0."""
    low, high = MASK_AABB.astype(numpy.float64)
    u = (p - low) * 2 / (high - low) - 1
    total = 0.0
    sides = [[], [], []]
    for axis in range(3):
        n = MASK.shape[2 - axis]
        x = (u[axis] + 1) / 2 * (n - 1)
        low_node = int(numpy.floor(x))
        pairs = [(low_node, 1 - (x - low_node)), (low_node + 1, x - low_node)]
        sides[axis] = [(k, weight) for k, weight in pairs if 0 <= k < n]
    for x, wx in sides[0]:
        for y, wy in sides[1]:
            for z, wz in sides[2]:
                total += wx * wy * wz * MASK[z, y, x]
    return total > 0


EXTENT = (AABB[1] - AABB[0]).astype(numpy.float64)
UNITS = EXTENT / (numpy.array(GRID) - 1)
STEP = UNITS.mean() * 0.5
SAMPLES = int(numpy.linalg.norm(EXTENT) / STEP) + 1


def render(values, origin, direction, masked):
    """Color on black, opacity and depth of one ray, as at test time."""
    slabs = numpy.where(direction == 0, 1e-6, direction)
    low, high = AABB.astype(numpy.float64)
    start = numpy.minimum((high - origin) / slabs, (low - origin) / slabs).max()
    t = numpy.clip(start, *KWARGS["near_far"]) + STEP * numpy.arange(SAMPLES)
    delta = numpy.append(numpy.diff(t), 0.0)
    transmittance, acc, rgb, depth = 1.0, 0.0, numpy.zeros(3), 0.0
    for t_k, delta_k in zip(t, delta):
        p = origin + t_k * direction
        inside = ((p >= low) & (p <= high)).all()
        sigma = 0.0
        if inside and (not masked or maybe_occupied(p)):
            sigma = max(density_feature(values, normalized(p)), 0.0)
        alpha = 1 - numpy.exp(-sigma * delta_k * KWARGS["distance_scale"])
        weight = transmittance * alpha
        transmittance *= 1 - alpha + 1e-10
        acc += weight
        depth += weight * t_k
        if weight > KWARGS["rayMarch_weight_thres"]:
            rgb = rgb + weight * color(values, features(values, normalized(p)), direction)
    # the published depth adds the direction's z where it meant the far end
    return {"black": rgb, "white": rgb + 1 - acc, "opacity": acc, "depth": depth + (1 - acc) * direction[2]}


def regularizers(values):
    tv = l1 = 0.0
    for i in range(3):
        x = values[f"density_plane.{i}"].astype(numpy.float64)
        c, h, w = x.shape[1:]
        down, across = (numpy.diff(x, axis=axis) ** 2 for axis in (2, 3))
        tv += 0.01 * 2 * (down.sum() / (c * (h - 1) * w) + across.sum() / (c * h * (w - 1)))
        l1 += numpy.abs(x).mean() + numpy.abs(values[f"density_line.{i}"].astype(numpy.float64)).mean()
    line = values["density_line.0"][0, :, :, 0].astype(numpy.float64)
    products = line @ line.T
    return tv, l1, numpy.abs(products[~numpy.eye(len(products), dtype=bool)]).mean()


# digits of the published arithmetic, float32
GOLDEN = {
    "density feature A": 0.1918000, "density feature B": 0.1737500, "density feature C": 0.2303020,
    "density feature D": 0.1112000,
    "features A": [0.0851920, -0.1967875, -0.3862147, -0.3939991],
    "features B": [0.1845370, -0.1454780, -0.4070723, -0.4772142],
    "color A": [0.5037433, 0.5024657, 0.4994218], "color B": [0.5036540, 0.5021638, 0.4990493],
    "step": 0.2918889, "samples": 17,
    "ray 0 black": [0.5031043, 0.5020230, 0.4993656], "ray 0 white": [0.5031812, 0.5020999, 0.4994425],
    "ray 0 depth": 3.6129913,
    "ray 1 black": [0.5033032, 0.5021623, 0.4993564], "ray 1 white": [0.5034794, 0.5023384, 0.4995325],
    "ray 1 depth": 3.6014051,
    "dense alpha": [0.0567065, 0.0319369, 0.0532861], "tv": 6.0e-5, "l1": 1.4060, "ortho": 0.3444,
}


def expected(values):
    """What the formulas give, and the same under the names of GOLDEN."""
    points = {"A": (0, 0, 0), "B": (0.25, -0.5, 0.75), "C": (-0.9, 0.3, -0.1), "D": (1, 1, 1)}
    rays = [((0.1, -0.2, 4.5), (0.02, 0.05, -1.0)), ((0.3, 0.4, 4.2), (-0.1, 0.02, -1.0))]
    direction = numpy.array([0.02, 0.05, -1.0])
    found, out = {}, {"step": STEP, "samples": SAMPLES, "view_direction": direction, "points": [], "rays": []}
    for name, point in points.items():
        u = numpy.array(point, numpy.float64)
        feature = features(values, u)
        one = {"normalized": u, "density_feature": density_feature(values, u), "features": feature}
        one["color"] = color(values, feature, direction)
        out["points"].append(one)
        found[f"density feature {name}"] = one["density_feature"]
        found[f"features {name}"] = feature[:4]
        found[f"color {name}"] = one["color"]
    for i, (origin, toward) in enumerate(rays):
        origin, toward = numpy.array(origin), numpy.array(toward)
        plain = render(values, origin, toward, masked=False)
        one = {"origin": origin, "direction": toward, "without_mask": plain}
        one["with_mask"] = render(values, origin, toward, masked=True)
        out["rays"].append(one)
        found |= {f"ray {i} {key}": plain[key] for key in ["black", "white", "depth"]}
    nodes = [(0, 0, 0), (4, 5, 6), (2, 3, 4)]
    at = lambda node: numpy.array(node) / (numpy.array(GRID) - 1) * 2 - 1
    alpha = [1 - numpy.exp(-max(density_feature(values, at(n)), 0) * STEP) for n in nodes]
    out["dense_alpha"] = [{"node": n, "alpha": a} for n, a in zip(nodes, alpha)]
    out["tv_density"], out["l1_density"], out["ortho_density_line_0"] = regularizers(values)
    found |= {"step": STEP, "samples": SAMPLES, "dense alpha": alpha}
    found |= {"tv": out["tv_density"], "l1": out["l1_density"], "ortho": out["ortho_density_line_0"]}
    return out, found


def plain(value):
    """For json: numpy's numbers and arrays as Python's."""
    if isinstance(value, dict):
        return {key: plain(v) for key, v in value.items()}
    if isinstance(value, (list, tuple, numpy.ndarray)):
        return [plain(v) for v in value]
    return int(value) if isinstance(value, (int, numpy.integer)) else round(float(value), 12)


def same(found, path):
    """Is a file what was found, but for the last bits of sines, which machines compute differently?"""
    there = path.read_bytes()
    head = 8 + int.from_bytes(there[:8], "little")
    numbers = lambda data: numpy.frombuffer(data, "<f4", offset=head).astype(numpy.float64)
    near = len(found) == len(there) and numpy.abs(numpy.nan_to_num(numbers(found) - numbers(there))).max() <= 2.4e-7
    return near and found[:head] == there[:head]


def main(folder, check):
    values = parameters()
    converted = th_to_safetensors.convert(checkpoint(values))
    out, found = expected(values)
    text = json.dumps(plain(out), indent=1) + "\n"
    if not check:
        (folder / "vm_g5.safetensors").write_bytes(converted)
        (folder / "vm_g5.json").write_text(text)
    results = [("the converted file", same(converted, folder / "vm_g5.safetensors"))]
    saved = through_torch(values)
    results += [("the same through torch", saved == converted)] if saved else []
    for name, golden in GOLDEN.items():
        # float32 arithmetic and printing to as many digits as there are
        tolerance = {"tv": 5e-7, "l1": 5e-5, "ortho": 5e-5}.get(name, 2e-7 * max(1, numpy.max(numpy.abs(golden))))
        difference = numpy.max(numpy.abs(numpy.array(found[name]) - golden))
        results.append((" ".join([f"{name:18}", *(f"{x:.7f}" for x in numpy.atleast_1d(found[name]))]), difference <= tolerance))
    for name, good in results:
        print("ok   " if good else "WRONG", name)
    return all(good for _, good in results)


if __name__ == "__main__":
    sys.exit(0 if main(pathlib.Path(sys.argv[-1]), "--check" in sys.argv) else 1)
