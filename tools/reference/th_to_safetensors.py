"""A published TensoRF or T-Face checkpoint (`.th`) as the file that `tface.import` and `baseline.import` name.

    python tools/reference/th_to_safetensors.py official.th official.safetensors

Needs torch 2.6 and numpy 1.25, or later; nothing in the `.th` file is executed. `convert` takes the loaded dictionary
with numpy arrays in it and needs numpy only.

A `.th` file holds `kwargs` (what the Python constructor takes), `state_dict` (planes, lines, basis and the color network)
and, once an alpha mask was made, `alphaMask.shape`, `.mask` (packed bits, the highest first) and `.aabb`. Plane i spans
the axes (0, 1), (0, 2), (1, 2) as width and height, line i the one that is left: `TensorVMSplit` of TensoRF (Chen et al.
2022). `checkpoint.safetensors` of a run's stage holds the same under other names, little-endian and row-major; `C`
channels are `density_rank` or `color_rank` of plane i, and `field` is the JSON text of that name in `__metadata__`.

| ours | published |
|---|---|
| `model.density`: planes 0, 1, 2 as `[H, W, C]`, then lines 0, 1, 2 as `[N, C]` | `state_dict`: `density_plane.i` `[1, C, H, W]`, `density_line.i` `[1, C, N, 1]` |
| `model.color`, likewise | `app_plane.i`, `app_line.i` |
| `model.network`: seven matrices, one after the other | `basis_mat.weight`, then weight and bias of `renderModule.mlp.0`, `.2`, `.4` |
| `bounds` `[2, 3]`, `size` `[3]` | `kwargs`: `aabb`, `gridSize` |
| `field`: `density_rank`, `color_rank`, `features`, `hidden` | `density_n_comp`, `appearance_n_comp`, `app_dim`, `featureC` |
| `view_frequencies`, `feature_frequencies` | `view_pe`, `fea_pe`; `pos_pe` has no effect and `shadingMode` is `MLP_Fea` |
| `softplus`, `shift` | `fea2denseAct` (`softplus` or `relu`), `density_shift` |
| `distance_scale`, `weight_threshold`, `step_ratio` | `distance_scale`, `rayMarch_weight_thres`, `step_ratio` |
| `near`, `far`, `mask_threshold` | `near_far`, `alphaMask_thres` |
| `mask.bits` over `mask.size` cells, x slowest, bit `i % 64` of word `i / 64` | `alphaMask.mask` over vertices, z slowest |

A cell of our mask is set where one of its eight corners is, and the cells go one further than the vertices on every side,
as the published lookup, which pads with zeros, does: a vertex is one whose eight cells are all set, and the published
box is a cell smaller on every side. Where `field.placement` is null, positions are the scene's: where `frame` is
`world`, they are the dataset's times `tface.import_scale` (1 / 0.3 in the published loader). With `scene_from_world` of a
run's `cameras.json` and k = that scale over its own, `aabb` is k · (`bounds` − its translation) and
`distance_scale` is ours / k.
"""

import argparse
import json
import struct

import numpy

NETWORK = ["basis_mat.weight"] + [f"renderModule.mlp.{i}.{kind}" for i in (0, 2, 4) for kind in ("weight", "bias")]


def factors(state, name, size, rank):
    """Planes and lines with their channels last, one after the other."""
    out = []
    for kind, shapes in [
        ("plane", [(size[1], size[0]), (size[2], size[0]), (size[2], size[1])]),
        ("line", [(size[2], 1), (size[1], 1), (size[0], 1)]),
    ]:
        for i, shape in enumerate(shapes):
            values = numpy.asarray(state.pop(f"{name}_{kind}.{i}"))
            if values.shape != (1, rank[i], *shape):
                raise ValueError(f"{name}_{kind}.{i} has shape {values.shape}, expected {(1, rank[i], *shape)}")
            out.append(values[0].transpose(1, 2, 0).ravel())
    return numpy.concatenate(out)


def mask_cells(checkpoint):
    """The alpha mask as cells: their box, how many there are along each axis, and their bits."""
    shape = [int(n) for n in checkpoint["alphaMask.shape"]][-3:]
    bits = numpy.unpackbits(numpy.asarray(checkpoint["alphaMask.mask"], numpy.uint8), count=int(numpy.prod(shape)))
    vertices = numpy.pad(bits.reshape(shape).transpose(2, 1, 0), 1)  # [nx + 2, ny + 2, nz + 2]
    cells = sum(numpy.roll(vertices, (-x, -y, -z), (0, 1, 2)) for x in (0, 1) for y in (0, 1) for z in (0, 1))
    cells = cells[:-1, :-1, :-1] > 0
    low, high = numpy.asarray(checkpoint["alphaMask.aabb"], numpy.float32)
    unit = (high - low) / (numpy.array(shape[::-1], numpy.float32) - 1)
    words = numpy.packbits(cells.ravel(), bitorder="little")
    words = numpy.pad(words, (0, -len(words) % 8)).view("<u8")
    return numpy.stack([low - unit, high + unit]), numpy.array(cells.shape, "<u8"), words


def convert(checkpoint):
    """The bytes of our file, from the dictionary of a `.th` file with numpy arrays for its tensors."""
    kwargs, state = checkpoint["kwargs"], dict(checkpoint["state_dict"])
    if kwargs["shadingMode"] != "MLP_Fea" or kwargs["fea2denseAct"] not in ("relu", "softplus"):
        raise ValueError(f"not a field of T-Face: shadingMode {kwargs['shadingMode']}, fea2denseAct {kwargs['fea2denseAct']}")
    if "density_plane.0" not in state:
        raise ValueError("not a field of planes and lines: train with `--model_name TensorVMSplit`")
    integers = lambda key: [int(n) for n in kwargs[key]]
    size, density_rank, color_rank = (integers(k) for k in ("gridSize", "density_n_comp", "appearance_n_comp"))
    near, far = (float(x) for x in kwargs["near_far"])
    field = {
        "density_rank": density_rank, "color_rank": color_rank, "features": int(kwargs["app_dim"]),
        "hidden": int(kwargs["featureC"]), "view_frequencies": int(kwargs["view_pe"]),
        "feature_frequencies": int(kwargs["fea_pe"]), "softplus": kwargs["fea2denseAct"] == "softplus",
        "shift": float(kwargs["density_shift"]), "distance_scale": float(kwargs["distance_scale"]),
        "weight_threshold": float(kwargs["rayMarch_weight_thres"]), "stop": 0.0,
        "step_ratio": float(kwargs["step_ratio"]), "near": near, "far": far,
        "mask_threshold": float(kwargs["alphaMask_thres"]), "placement": None,
    }
    tensors = {
        "bounds": numpy.asarray(kwargs["aabb"], "<f4").reshape(2, 3),
        "model.density": factors(state, "density", size, density_rank),
        "model.color": factors(state, "app", size, color_rank),
        "model.network": numpy.concatenate([numpy.asarray(state.pop(name)).ravel() for name in NETWORK]),
        "size": numpy.array(size, "<u8"),
    }
    if state:
        raise ValueError(f"unknown entries of state_dict: {', '.join(state)}")
    if "alphaMask.aabb" in checkpoint:
        tensors |= zip(["mask.bounds", "mask.size", "mask.bits"], mask_cells(checkpoint))
    metadata = {"format": "tiface-vm-1", "frame": "world", "field": json.dumps(field)}
    header, data = {"__metadata__": metadata}, b""
    # words of eight bytes first, so that each array is aligned
    for name, values in sorted(tensors.items(), key=lambda item: (item[1].dtype.kind != "u", item[0])):
        values = values.astype("<u8" if values.dtype.kind == "u" else "<f4")
        begin, data = len(data), data + values.tobytes()
        kind = "U64" if values.dtype.kind == "u" else "F32"
        header[name] = {"dtype": kind, "shape": list(values.shape), "data_offsets": [begin, len(data)]}
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + data


def load(path):
    """The dictionary of a `.th` file, its tensors as numpy arrays. Only plain data and numpy's arrays are unpickled."""
    import torch

    # numpy 2 calls its own parts otherwise than numpy 1, in whose time the published checkpoints were written
    made = (numpy._core if numpy.__version__ >= "2" else numpy.core).multiarray._reconstruct
    names = [(made, f"numpy.{core}.multiarray._reconstruct") for core in ("core", "_core")]
    torch.serialization.add_safe_globals([numpy.ndarray, numpy.dtype, numpy.dtypes.UInt8DType, *names])
    plain = lambda value: value.cpu().numpy() if isinstance(value, torch.Tensor) else value
    checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    tables = {key: {k: plain(v) for k, v in checkpoint[key].items()} for key in ("kwargs", "state_dict")}
    return {key: plain(value) for key, value in checkpoint.items()} | tables


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkpoint", help="the published .th file")
    parser.add_argument("out", help="the .safetensors file to write")
    options = parser.parse_args()
    converted = convert(load(options.checkpoint))
    with open(options.out, "wb") as file:
        file.write(converted)
