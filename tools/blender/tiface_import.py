"""Blender add-on that imports a run of tiface: the head, its cameras, and their photographs as backgrounds.

Install: Edit > Preferences > Add-ons > Install from Disk, choose this file, switch it on. Then File > Import > tiface run, and
choose the folder of the run. From a script:

    import tiface_import
    tiface_import.import_run("runs/head")

The mesh (`mesh/head.glb`) keeps its material and soft layers. Each view becomes a camera in a collection of its own with the
view's pose and lens; Ctrl+Numpad 0 looks through the active one. Where poses were refined, these are the refined ones, and
those of held-out views the ones fitted alone.
Photographs are drawn behind the head at half strength. Blender's cameras have no lens distortion: a distorted photograph
fits in its middle only, and is named in the message. View transform, clipping and the number of transparent surfaces that a
ray crosses are set so that the head looks as in the photographs.
"""

import collections
import json
import pathlib
import tomllib

import bpy
import bpy_extras.io_utils
import mathutils

bl_info = {
    "name": "tiface run",
    "author": "tiface",
    "version": (0, 1, 0),
    "blender": (4, 2, 0),
    "location": "File > Import > tiface run",
    "description": "Import a head with its cameras and photographs",
    "category": "Import-Export",
}

BLENDER_FROM_GLTF = mathutils.Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)))
SENSOR_MM = 36.0
# soft layers are crossed one by one, on both sides of the head
TRANSPARENT_BOUNCES = 32


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
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"
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


if __name__ == "__main__":
    register()
