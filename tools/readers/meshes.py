"""A mesh as a reader loads it, and its shape, for the checks that compare readers."""

import typing

import numpy
import trimesh


class LoadedMesh(typing.NamedTuple):
    """What a reader made of a file."""

    vertices: numpy.ndarray
    faces: numpy.ndarray
    colors: numpy.ndarray | None  # of vertices, 0..1
    uvs: numpy.ndarray | None  # [faces, 3, 2], v up
    picture: numpy.ndarray | None  # [height, width, 3], 8 bit


def with_trimesh(path):
    scene = trimesh.load_scene(path, process=False)
    (node,) = scene.graph.nodes_geometry  # an export holds one mesh
    matrix, name = scene.graph[node]
    mesh = scene.geometry[name]
    colors = uvs = picture = None
    if mesh.visual.kind == "vertex":
        colors = mesh.visual.vertex_colors
    else:  # beside a material, trimesh keeps them as an attribute
        colors = mesh.visual.vertex_attributes.data.get("color")
        if mesh.visual.uv is not None:
            uvs = numpy.asarray(mesh.visual.uv)[mesh.faces]
        material = mesh.visual.material
        image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
        if image is not None and uvs is not None:
            picture = numpy.asarray(image.convert("RGB"))
    if colors is not None:
        scale = 255.0 if numpy.issubdtype(colors.dtype, numpy.integer) else 1.0
        colors = numpy.asarray(colors)[:, :3] / scale
    return LoadedMesh(trimesh.transform_points(mesh.vertices, matrix), mesh.faces, colors, uvs, picture)


def closed_and_volume(vertices, faces):
    _, weld = numpy.unique(vertices, axis=0, return_inverse=True)
    faces = weld.reshape(-1)[faces]
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    edges = numpy.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there, counts = numpy.unique(edges, axis=0, return_counts=True)
    back = numpy.unique(edges[:, ::-1], axis=0)
    closed = len(there) > 0 and (counts == 1).all() and numpy.array_equal(there, back)
    a, b, c = (numpy.unique(vertices, axis=0)[faces[:, k]] for k in range(3))
    return closed, float(numpy.einsum("ij,ij->i", a, numpy.cross(b, c)).sum() / 6)
