"""Opens USDZ files in Pixar's USD, and compares each with the GLB beside it in trimesh.

    tiface export RUN --format glb,usdz --out DIR/
    python tools/readers/check_usdz.py DIR/head.usdz ...

All validators of `usdchecker` accept it, with those of USDZ: alignment, encapsulation, endings, shaders,
up direction and unit. So do ARKit's lists of types, which `usdchecker` no longer has. As in the GLB:
triangles, bounds to 1e-6 of the size, closed as it is, volume, corners of the texture, pixels of the
picture, and whether the material is unlit, which a USDZ says by emitting the color. Texture coordinates
lie within 0..1. Exits 1 after printing every disagreement.
"""

import io
import json
import pathlib
import re
import sys
import zipfile

import numpy
import PIL.Image
from pxr import Usd, UsdGeom, UsdShade, UsdValidation

from meshes import LoadedMesh, closed_and_volume, with_trimesh
from verdict import exit_code


ARKIT_SHADERS = "UsdPreviewSurface|UsdUVTexture|UsdTransform2d|UsdPrimvarReader_.*"


def is_unlit(glb):
    """Whether the first material of a GLB is marked as unlit."""
    data = glb.read_bytes()
    document = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    return "KHR_materials_unlit" in document["materials"][0].get("extensions", {})


def rules_broken(stage):
    """What validators and the lists of ARKit say of a stage."""
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    names = [validator.GetMetadata().name for validator in validators]
    wrong = [] if "usdUtilsValidators:RootPackageValidator" in names else ["there is no validator of USDZ"]
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    wrong += [error.GetErrorAsString() for error in errors]
    for prim in stage.Traverse():
        if prim.GetTypeName() not in ["Xform", "Mesh", "Material", "Shader"]:
            wrong.append(f"{prim.GetPath()} is of type `{prim.GetTypeName()}`")
        shader = UsdShade.Shader(prim)
        if shader and not re.fullmatch(ARKIT_SHADERS, shader.GetShaderId()):
            wrong.append(f"{prim.GetPath()} is the shader `{shader.GetShaderId()}`")
    return wrong


def picture_of(path, texture):
    """The picture of a texture's shader, out of the package, and its name there."""
    name = texture.GetInput("file").Get().path
    with zipfile.ZipFile(path) as package:
        return numpy.asarray(PIL.Image.open(io.BytesIO(package.read(name))).convert("RGB"))


def source_of(shader, name):
    """The shader that an input is connected to, or None."""
    connected = shader.GetInput(name)
    source = connected.GetConnectedSource() if connected else None
    return UsdShade.Shader(source[0]) if source else None


def with_pxr(path):
    """The mesh, which of its inputs shows the color, and what is wrong with its stage."""
    stage = Usd.Stage.Open(str(path))
    wrong = rules_broken(stage)
    if (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) != ("Y", 1.0):
        wrong.append("not in meters with +Y up")
    (prim,) = [p for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)]
    mesh = UsdGeom.Mesh(prim)
    if set(mesh.GetFaceVertexCountsAttr().Get()) != {3} or mesh.GetSubdivisionSchemeAttr().Get() != "none":
        wrong.append("not plain triangles")
    to_world = numpy.asarray(UsdGeom.XformCache().GetLocalToWorldTransform(prim))
    points = numpy.asarray(mesh.GetPointsAttr().Get(), float)
    extent = numpy.asarray(mesh.GetExtentAttr().Get())
    if not numpy.array_equal(extent, numpy.float32([points.min(axis=0), points.max(axis=0)])):
        wrong.append(f"extent {extent}")
    faces = numpy.asarray(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    normals = numpy.asarray(mesh.GetNormalsAttr().Get(), float)
    if mesh.GetNormalsInterpolation() != "vertex" or normals.shape != points.shape:
        wrong.append(f"{len(normals)} normals for {len(points)} vertices")
    elif abs(numpy.linalg.norm(normals, axis=1) - 1).max() > 1e-5:
        wrong.append("normals are not unit")
    coordinates = UsdGeom.PrimvarsAPI(prim).GetPrimvar("st")
    uvs = picture = None
    if coordinates and coordinates.IsDefined():
        uvs = numpy.asarray(coordinates.ComputeFlattened()).reshape(-1, 3, 2)
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    surface, _, _ = material.ComputeSurfaceSource()
    shown = [name for name in ["diffuseColor", "emissiveColor"] if source_of(surface, name)]
    if len(shown) != 1:
        wrong.append(f"the color is that of {shown}")
    elif uvs is not None:
        picture = picture_of(path, source_of(surface, shown[0]))
    if shown == ["emissiveColor"] and tuple(surface.GetInput("diffuseColor").Get()) != (0, 0, 0):
        wrong.append("an unlit surface reflects light")
    vertices = numpy.c_[points, numpy.ones(len(points))] @ to_world
    return LoadedMesh(vertices[:, :3], faces, None, uvs, picture), shown, wrong


def differences(usdz, glb, shown, is_unlit):
    """What a USDZ shows otherwise than the GLB of the same head."""
    wrong = []
    if (shown == ["emissiveColor"]) != is_unlit:
        wrong.append(f"the color is that of {shown}, but the GLB is {'unlit' if is_unlit else 'lit'}")
    if usdz.faces.shape != glb.faces.shape:
        return [*wrong, f"{len(usdz.faces)} triangles, expected {len(glb.faces)}"]
    corners, expected = usdz.vertices[usdz.faces], glb.vertices[glb.faces]
    size = numpy.ptp(expected.reshape(-1, 3), axis=0).max()
    apart = abs(corners - expected).max() / size
    volumes = [closed_and_volume(m.vertices, m.faces)[1] for m in [usdz, glb]]
    # as it is, without welding: an edge is there once in each direction
    edges = numpy.sort(usdz.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    closed = (numpy.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    print(f"    corners differ by {apart:.1e}  closed {closed}  volume {volumes[0]:.9f}, {volumes[1]:.9f}")
    if apart > 1e-6:
        wrong.append(f"corners differ by {apart} of the size")
    if not closed or not volumes[0] > 0:
        wrong.append("neither closed nor around a volume")
    if (usdz.uvs is None) != (glb.uvs is None):
        return [*wrong, "texture coordinates are in one file alone"]
    if usdz.uvs is not None:
        apart = abs(usdz.uvs - glb.uvs).max()
        print(f"    texture coordinates {usdz.uvs.min():.4f} to {usdz.uvs.max():.4f}, differ by {apart:.1e}")
        if apart > 1e-6 or usdz.uvs.min() < 0 or usdz.uvs.max() > 1:
            wrong.append(f"texture coordinates differ by {apart}")
        if not numpy.array_equal(usdz.picture, glb.picture):
            wrong.append(f"picture {usdz.picture.shape} is not that of the GLB, {glb.picture.shape}")
        else:
            print(f"    picture {usdz.picture.shape[1]} x {usdz.picture.shape[0]} equal to the pixel")
    return wrong


def main():
    paths = [pathlib.Path(word) for word in sys.argv[1:]]
    wrong = [] if paths else ["which files?"]
    for path in paths:
        loaded, shown, bad = with_pxr(path)
        glb = path.with_suffix(".glb")
        print(f"{path.name} in USD {'.'.join(map(str, Usd.GetVersion()))}: {path.stat().st_size} bytes,"
              f" {len(loaded.vertices)} vertices {len(loaded.faces)} triangles, color as {shown}")
        bad += differences(loaded, with_trimesh(glb), shown, is_unlit(glb))
        wrong += [f"{path.name}: {line}" for line in bad]
    return exit_code(wrong)


if __name__ == "__main__":
    sys.exit(main())
