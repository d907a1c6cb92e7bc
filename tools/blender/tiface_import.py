"""Blender extension that imports a run of tiface: the head, its cameras, and their photographs as backgrounds.

Pack it with `python tools/blender/make_extension.py`, then Edit > Preferences > Get Extensions > Install from Disk, and choose
the zip. Then File > Import > tiface run, and choose the folder of the run. From a script, with this folder in Python's path:

    import tiface_import
    tiface_import.import_run("runs/head")

The mesh (`mesh/head.glb`) keeps its material and soft layers. Where the file holds lobes, the node group "tiface lobes"
turns the base color into that of the direction that a point is seen from,

    base + sum over k of L_k Y_k(d),     L_k = (byte - 128) / 127 * scale[k]

in sRGB-coded values, clamped to 0..1, with real spherical harmonics Y_k of the unit vector d to the viewer in the
file's own axes, however the object is turned. Its "Strength" 0 is the base color alone, which other programs show.

Each view becomes a camera in a collection of its own with the
view's pose and lens; Ctrl+Numpad 0 looks through the active one. Where poses were refined, these are the refined ones, and
those of held-out views the ones fitted alone.
Photographs are drawn behind the head at half strength. Blender's cameras have no lens distortion: a distorted photograph
fits in its middle only, and is named in the message. View transform, clipping and the number of transparent surfaces that a
ray crosses are set so that the head looks as in the photographs.
"""

import collections
import json
import pathlib
import struct
import tomllib

import bpy
import bpy_extras.io_utils
import mathutils

BLENDER_FROM_GLTF = mathutils.Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)))
SENSOR_MM = 36.0
# soft layers are crossed one by one, on both sides of the head
TRANSPARENT_BOUNCES = 32

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


def read_glb(glb):
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


def add_lobes(objects, glb):
    """Gives imported mesh objects the lobes of their GLB: each material that shows the file's base color shows that of
    the view. Returns whether the file holds any."""
    document, picture = read_glb(glb)
    first = document["materials"][document["meshes"][0]["primitives"][0].get("material", 0)] if document.get("materials") else {}
    notes = first.get("extras", {}).get("tiface", {})
    lobes = notes.get("lobes", [])
    if not lobes:
        return False
    images = [image_of(lobe["name"], picture(lobe["texture"]), colors=False) for lobe in lobes]
    base = image_of("base color", picture(first["pbrMetallicRoughness"]["baseColorTexture"]["index"]), colors=True)
    group = lobe_group(images, notes["view_dependent_color"]["scale"])
    for material in {material for found in objects if found.type == "MESH" for material in found.data.materials if material}:
        tree = material.node_tree
        for texel in [node for node in tree.nodes if node.type == "TEX_IMAGE" and node.image == base]:
            texel.extension = "EXTEND"
            taken = [link.to_socket for link in tree.links if link.from_socket == texel.outputs["Color"]]
            seen = tree.nodes.new("ShaderNodeGroup")
            seen.node_tree = group
            seen.location = (texel.location.x + 300, texel.location.y)
            tree.links.new(texel.outputs["Color"], seen.inputs["Base Color"])
            for socket in taken:
                tree.links.new(seen.outputs["Color"], socket)
    return True


def rotation_of(columns):
    """A 3 x 3 matrix that is stored column by column."""
    return mathutils.Matrix([columns[0:3], columns[3:6], columns[6:9]]).transposed()


def read_json(path, key, remedy):
    """The whole of a JSON file that must have a key."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise RuntimeError(f"{path} is missing: {remedy}") from None
    except (OSError, ValueError) as problem:
        raise RuntimeError(f"{path} cannot be read: {problem}") from None
    if not isinstance(value, dict) or key not in value:
        raise RuntimeError(f"{path} has no {key}: {remedy}")
    return value


def views_of(run):
    """The views of a run, with the poses that were refined or, of held-out views, fitted."""
    found = read_json(run / "cameras.json", "views", "choose the folder of a finished run")
    fit = found.get("fit", {})
    poses = {camera["view"]: camera.get("refined") for camera in fit.get("cameras", [])}
    poses |= {camera["view"]: camera.get("fitted") for camera in fit.get("held_out", [])}
    return [view | {"camera": view["camera"] | (poses.get(view["name"]) or {})} for view in found["views"]]


def photograph_of(run, view):
    """The file of a view's photograph, if it is still where the run found it."""
    photo = pathlib.Path(view["photo"])
    try:
        capture = tomllib.loads((run / "config.toml").read_text(encoding="utf-8")).get("capture", {}).get("path", "")
    except (OSError, tomllib.TOMLDecodeError):
        capture = ""
    return next((path for path in (photo, pathlib.Path(capture) / photo, run / photo) if path.is_file()), None)


def add_camera(view, collection, file_from_world):
    """Adds the camera of a view and returns its object."""
    given = view["camera"]
    lens = bpy.data.cameras.new(view["name"])
    width, height = given["width"], given["height"]
    lens.sensor_fit = "HORIZONTAL"
    lens.sensor_width = SENSOR_MM
    lens.lens = given["fx"] * SENSOR_MM / width
    # in widths of the picture, to where the middle of the picture looks
    lens.shift_x = (width / 2 - given["cx"]) / width
    lens.shift_y = (given["cy"] - height / 2) * given["fx"] / given["fy"] / width
    lens.clip_start, lens.clip_end = 1e-3, 1e3
    scale, rotation = file_from_world["scale"], rotation_of(file_from_world["rotation"])
    position = scale * (rotation @ mathutils.Vector(given["position"])) + mathutils.Vector(file_from_world["translation"])
    pose = (rotation @ rotation_of(given["rotation"])).to_4x4()
    pose.translation = position
    camera = bpy.data.objects.new(view["name"], lens)
    camera.matrix_world = BLENDER_FROM_GLTF @ pose
    camera.empty_display_size = lens.display_size = 0.05
    collection.objects.link(camera)
    return camera


def add_background(camera, photograph):
    """Shows a photograph behind the head, from its camera."""
    background = camera.data.background_images.new()
    background.image = bpy.data.images.load(str(photograph), check_existing=True)
    background.frame_method = "STRETCH"
    background.display_depth = "BACK"
    background.alpha = 0.5
    camera.data.show_background_images = True


def set_scene(scene, views):
    """Shows unlit colors as they are stored, in pictures of the size and the pixels that most photographs have."""
    scene.display_settings.display_device = "sRGB"
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"
    scene.view_settings.exposure, scene.view_settings.gamma = 0.0, 1.0
    scene.view_settings.use_curve_mapping = False
    if hasattr(scene, "cycles"):
        scene.cycles.transparent_max_bounces = max(scene.cycles.transparent_max_bounces, TRANSPARENT_BOUNCES)
    shapes = collections.Counter(
        (view["camera"]["width"], view["camera"]["height"], view["camera"]["fy"] / view["camera"]["fx"]) for view in views
    )
    if shapes:
        ((width, height, tall), _), = shapes.most_common(1)
        scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = width, height, 100
        # Blender wants both at least 1
        scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = max(tall, 1.0), max(1 / tall, 1.0)


def import_run(folder, cameras=True, photographs=True):
    """Imports a run into the current scene. Returns the imported objects of the mesh, the cameras, and remarks."""
    run = pathlib.Path(bpy.path.abspath(str(folder))).resolve()
    glb = run / "mesh/head.glb"
    if not glb.is_file():
        raise RuntimeError(f"{run} holds no mesh/head.glb: choose the folder of a finished run")
    views, file_from_world = [], None
    if cameras:
        views = views_of(run)
        remedy = "make it with `tiface mesh RUN --fresh mesh`, or import without cameras"
        file_from_world = read_json(run / "mesh/frames.json", "file_from_world", remedy)["file_from_world"]
    known = set(bpy.data.objects)
    bpy.ops.import_scene.gltf(filepath=str(glb))
    head = [found for found in bpy.data.objects if found not in known]
    add_lobes(head, glb)
    if not cameras:
        set_scene(bpy.context.scene, [])
        return head, [], []
    collection = bpy.data.collections.new(f"cameras of {run.name}")
    bpy.context.scene.collection.children.link(collection)
    added, distorted, lost = [], [], []
    for view in views:
        camera = add_camera(view, collection, file_from_world)
        added.append(camera)
        if not photographs:
            continue
        photograph = photograph_of(run, view)
        if photograph is None:
            lost.append(view["name"])
            continue
        add_background(camera, photograph)
        if any(view["camera"]["distortion"].values()):
            distorted.append(view["name"])
    set_scene(bpy.context.scene, views)
    bpy.context.scene.camera = next(iter(added), None)
    remarks = [
        f"{len(names)} photographs {what}, the first is {names[0]}"
        for names, what in ((lost, "were not found"), (distorted, "are distorted and fit in their middle only"))
        if names
    ]
    return head, added, remarks


class ImportTifaceRun(bpy.types.Operator, bpy_extras.io_utils.ImportHelper):
    """Import a head of tiface with its cameras and photographs"""

    bl_idname = "import_scene.tiface_run"
    bl_label = "Import tiface run"
    bl_options = {"REGISTER", "UNDO"}

    directory: bpy.props.StringProperty(subtype="DIR_PATH")
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})
    cameras: bpy.props.BoolProperty(name="Cameras", description="Add a camera for each view", default=True)
    photographs: bpy.props.BoolProperty(
        name="Photographs", description="Show each photograph behind the head, from its camera", default=True
    )

    def execute(self, context):
        try:
            _, cameras, remarks = import_run(self.directory, self.cameras, self.photographs)
        except RuntimeError as problem:
            self.report({"ERROR"}, str(problem))
            return {"CANCELLED"}
        except (AttributeError, KeyError, TypeError) as problem:
            self.report({"ERROR"}, f"{self.directory} has damaged files: {problem!r}")
            return {"CANCELLED"}
        for remark in remarks:
            self.report({"WARNING"}, remark)
        self.report({"INFO"}, f"head with {len(cameras)} cameras")
        return {"FINISHED"}


def menu(self, context):
    self.layout.operator(ImportTifaceRun.bl_idname, text="tiface run")


def register():
    bpy.utils.register_class(ImportTifaceRun)
    bpy.types.TOPBAR_MT_file_import.append(menu)


def unregister():
    bpy.types.TOPBAR_MT_file_import.remove(menu)
    bpy.utils.unregister_class(ImportTifaceRun)
