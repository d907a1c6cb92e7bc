"""Shows in Blender the colors that change with the view, of a GLB by `tiface mesh --lobes`.

Without a window, into a file to open:

    python3.11 -m venv .venv-blender && .venv-blender/bin/pip install -r tools/readers/requirements-blender.txt
    .venv-blender/bin/python tools/blender/lobes.py head.glb head.blend

or in Blender itself:

    blender --python tools/blender/lobes.py -- head.glb

The head's material becomes its picture, the node group "tiface lobes", and an emission: the pictures hold the light
already. The group turns the base color into that of the direction that a point is seen from,

    base + sum over k of L_k Y_k(d),     L_k = (byte - 128) / 127 * scale[k]

in sRGB-coded values, clamped to 0..1, with real spherical harmonics Y_k of the unit vector d to the viewer in the
file's own axes, however the object is turned. "Strength" 0 is the base color alone. To see colors as they
are stored, set the scene's view transform to Standard, as this script does for its own file.
"""

import json
import pathlib
import struct
import sys

import bpy

# Y_k as sums of a factor times x, y and z, in the order of the file's textures
BASIS = [
    [(0.28209479, "")],
    [(-0.48860251, "y")],
    [(0.48860251, "z")],
    [(-0.48860251, "x")],
    [(1.0925484, "xy")],
    [(-1.0925484, "yz")],
    [(0.9461747, "zz"), (-0.31539157, "")],
    [(-1.0925484, "xz")],
    [(0.5462742, "xx"), (-0.5462742, "yy")],
]


class Nodes:
    """A node tree that is written like arithmetic: every method returns the socket of its result."""

    def __init__(self, tree):
        self.tree = tree

    def node(self, kind, *inputs, output=0, **settings):
        node = self.tree.nodes.new(kind)
        for name, value in settings.items():
            setattr(node, name, value)
        for socket, value in zip(node.inputs, inputs):
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, socket)
            elif value is not None:
                socket.default_value = value
        return node.outputs[output]

    def math(self, operation, *inputs, **settings):
        return self.node("ShaderNodeMath", *inputs, operation=operation, **settings)

    def vector(self, operation, *inputs):
        return self.node("ShaderNodeVectorMath", *inputs, operation=operation)

    def per_channel(self, group, color):
        split = self.node("ShaderNodeSeparateXYZ", color).node
        channels = []
        for channel in split.outputs:
            node = self.tree.nodes.new("ShaderNodeGroup")
            node.node_tree = group
            self.tree.links.new(channel, node.inputs[0])
            channels.append(node.outputs[0])
        return self.node("ShaderNodeCombineXYZ", *channels)


def group_of(name, inputs, output):
    """A new group; returns its nodes, the sockets of its inputs, and what takes its result."""
    tree = bpy.data.node_groups.new(name, "ShaderNodeTree")
    for label, kind, value in inputs:
        socket = tree.interface.new_socket(label, in_out="INPUT", socket_type=kind)
        if value is not None:
            socket.default_value = value
    tree.interface.new_socket(output[0], in_out="OUTPUT", socket_type=output[1])
    given = tree.nodes.new("NodeGroupInput")
    result = tree.nodes.new("NodeGroupOutput")
    return Nodes(tree), list(given.outputs)[: len(inputs)], lambda socket: tree.links.new(socket, result.inputs[0])


def arrange(tree):
    """Every node to the right of what it takes from."""
    column, rows = {}, {}
    links = [(link.from_node.name, link.to_node.name) for link in tree.links]
    for _ in tree.nodes:
        for source, target in links:
            column[target] = max(column.get(target, 0), column.get(source, 0) + 1)
    for node in tree.nodes:
        at = column.get(node.name, 0)
        node.location = (200 * at, -320 * rows.get(at, 0))
        rows[at] = rows.get(at, 0) + 1


def curve(name, limit, slope, power):
    """One number through a line below `limit`, through `power(nodes, value)` above it."""
    nodes, (value,), done = group_of(name, [("Value", "NodeSocketFloat", 0.0)], ("Value", "NodeSocketFloat"))
    above = nodes.math("GREATER_THAN", value, limit)
    low, high = nodes.math("MULTIPLY", value, slope), power(nodes, value)
    apart = nodes.math("SUBTRACT", high, low)
    done(nodes.math("MULTIPLY_ADD", above, apart, low))
    arrange(nodes.tree)
    return nodes.tree


def coded_from_linear():
    def power(nodes, value):
        root = nodes.math("POWER", nodes.math("MAXIMUM", value, 0.0), 1 / 2.4)
        return nodes.math("MULTIPLY_ADD", root, 1.055, -0.055)

    return curve("sRGB from linear", 0.0031308, 12.92, power)


def linear_from_coded():
    def power(nodes, value):
        shifted = nodes.math("MULTIPLY_ADD", value, 1 / 1.055, 0.055 / 1.055)
        return nodes.math("POWER", shifted, 2.4)

    return curve("linear from sRGB", 0.04045, 1 / 12.92, power)


def lobe_group(images, scale):
    """The node group "tiface lobes" of these pictures."""
    inputs = [("Base Color", "NodeSocketColor", (0.5, 0.5, 0.5, 1.0)), ("Strength", "NodeSocketFloat", 1.0)]
    nodes, (base, strength), done = group_of("tiface lobes", inputs, ("Color", "NodeSocketColor"))
    incoming = nodes.node("ShaderNodeNewGeometry").node.outputs["Incoming"]
    own = nodes.node("ShaderNodeVectorTransform", incoming, vector_type="VECTOR", convert_from="WORLD",
                     convert_to="OBJECT")
    split = nodes.node("ShaderNodeSeparateXYZ", nodes.vector("NORMALIZE", own)).node
    # Blender's importer turns glTF's (x, y, z) to (x, -z, y)
    axes = {"x": split.outputs[0], "y": split.outputs[2], "z": nodes.math("MULTIPLY", split.outputs[1], -1.0)}
    total = None
    for image, size, terms in zip(images, scale, BASIS):
        function = None
        for factor, letters in terms:
            term = factor
            for letter in letters:
                term = nodes.math("MULTIPLY", axes[letter], term)
            function = term if function is None else nodes.math("ADD", function, term)
        texel = nodes.node("ShaderNodeTexImage", image=image, interpolation="Linear", extension="EXTEND")
        decoded = nodes.vector("MULTIPLY_ADD", texel, [255 / 127 * size] * 3, [-128 / 127 * size] * 3)
        scaled = nodes.tree.nodes.new("ShaderNodeVectorMath")
        scaled.operation = "SCALE"
        nodes.tree.links.new(decoded, scaled.inputs["Vector"])
        if isinstance(function, float):
            scaled.inputs["Scale"].default_value = function
        else:
            nodes.tree.links.new(function, scaled.inputs["Scale"])
        total = scaled.outputs[0] if total is None else nodes.vector("ADD", total, scaled.outputs[0])
    strong = nodes.tree.nodes.new("ShaderNodeVectorMath")
    strong.operation = "SCALE"
    nodes.tree.links.new(total, strong.inputs["Vector"])
    nodes.tree.links.new(strength, strong.inputs["Scale"])
    coded = nodes.vector("ADD", nodes.per_channel(coded_from_linear(), base), strong.outputs[0])
    clamped = nodes.vector("MINIMUM", nodes.vector("MAXIMUM", coded, [0.0] * 3), [1.0] * 3)
    done(nodes.per_channel(linear_from_coded(), clamped))
    arrange(nodes.tree)
    return nodes.tree


def read(glb):
    """A GLB's document, and the bytes of a picture by the number of its texture."""
    data = pathlib.Path(glb).read_bytes()
    if data[:4] != b"glTF":
        raise ValueError(f"{glb} is not a GLB")
    (length,) = struct.unpack_from("<I", data, 12)
    document = json.loads(data[20 : 20 + length])
    binary = data[20 + length + 8 :]

    def picture(texture):
        view = document["bufferViews"][document["images"][document["textures"][texture]["source"]]["bufferView"]]
        begin = view.get("byteOffset", 0)
        return binary[begin : begin + view["byteLength"]]

    return document, picture


def image_of(name, data, colors):
    """A picture of the file: that of the importer if it has brought it."""
    packed = (i for i in bpy.data.images if i.packed_file and i.packed_file.data == data)
    image = next(packed, None)
    if image is None:
        image = bpy.data.images.new(name, 8, 8)
        image.pack(data=data, data_len=len(data))
        image.source = "FILE"
    image.colorspace_settings.name = "sRGB" if colors else "Non-Color"
    return image


def add_lobes(found, glb):
    """Gives an imported mesh object a material with the lobes of its GLB. Returns whether the file holds any."""
    document, picture = read(glb)
    first = document["materials"][document["meshes"][0]["primitives"][0]["material"]]
    notes = first.get("extras", {}).get("tiface", {})
    lobes = notes.get("lobes", [])
    if not lobes:
        return False
    images = [image_of(lobe["name"], picture(lobe["texture"]), colors=False) for lobe in lobes]
    base = image_of("base color", picture(first["pbrMetallicRoughness"]["baseColorTexture"]["index"]), colors=True)
    material = bpy.data.materials.new(f"{first['name']} with lobes")
    if bpy.app.version < (5, 0):
        material.use_nodes = True
    material.node_tree.nodes.clear()
    nodes = Nodes(material.node_tree)
    texel = nodes.node("ShaderNodeTexImage", image=base, interpolation="Linear", extension="EXTEND")
    group = material.node_tree.nodes.new("ShaderNodeGroup")
    group.node_tree = lobe_group(images, notes["view_dependent_color"]["scale"])
    material.node_tree.links.new(texel, group.inputs["Base Color"])
    emission = nodes.node("ShaderNodeEmission", group.outputs["Color"])
    out = material.node_tree.nodes.new("ShaderNodeOutputMaterial")
    material.node_tree.links.new(emission, out.inputs["Surface"])
    arrange(material.node_tree)
    found.data.materials.clear()
    found.data.materials.append(material)
    return True


def main(arguments):
    if not 1 <= len(arguments) <= 2:
        print(__doc__)
        return 2
    glb = pathlib.Path(arguments[0]).resolve()
    if len(arguments) == 2:
        bpy.ops.wm.read_factory_settings(use_empty=True)
    before = set(bpy.context.scene.objects)
    bpy.ops.import_scene.gltf(filepath=str(glb))
    meshes = [o for o in bpy.context.scene.objects if o.type == "MESH" and o not in before]
    if not all([add_lobes(found, glb) for found in meshes]):
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
