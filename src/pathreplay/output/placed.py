"""Writes parameter values into a scene description, as properties or as files that properties reference."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.inverse.images.io import exr_bytes
from pathreplay.output.nodes import Described, Node, Owner
from pathreplay.platform import compat
from pathreplay.platform.threads import spare_thread
from pathreplay.platform.traversal import traversed
from pathreplay.scenes.parameters import get_array
from pathreplay.scenes.spectra import coefficient_channels
from pathreplay.scenes.stored import form_of
from pathreplay.scenes.volume_files import UNIT_CUBE, Bounds, vol_bounds, vol_bytes

_PICTURES = ("bitmap", "envmap")
_MADE_BY = ("filename", "bitmap", "grid", "data", "shape_index")
"""Properties that say where the values of a texture, grid or mesh come from."""
_ALSO_PLACES = {
    "sphere": ("center", "radius"),
    "cylinder": ("p0", "p1", "radius"),
    "directional": ("direction",),
    "disk": ("flip_normals",),
}
"""Properties by plugin whose effect `mi.traverse` includes in `to_world`. An exported `to_world` replaces them."""

# Materials and emitters of `mi.Mesh` objects that can be exported, by class name: their plugin and its properties.
_KNOWN: dict[str, tuple[str, tuple[str, ...]]] = {
    "SmoothDiffuse": ("diffuse", ("reflectance",)),
    "SmoothConductor": ("conductor", ("eta", "k", "specular_reflectance")),
    "AreaLight": ("area", ("radiance",)),
}
_BY_IOR = frozenset({"dielectric_ad", "roughdielectric", "roughplastic", "thindielectric"})
"""Plugins whose parameter ``eta`` is given by the properties ``int_ior`` and ``ext_ior``."""
_METALS = {"eta": "k", "k": "eta"}
"""Properties of conductors that replace ``material``. Both must be given."""
_PLAIN_SPECTRA = ("SRGBReflectanceSpectrum", "UniformSpectrum")


class Placing:
    """Writes the current values of a scene into its description.

    ``names`` are file names by parameter key, and ``recovered`` contains the keys of recovered parameters. ``files``
    collects the content of the files that the description needs, by name.
    """

    def __init__(
        self, described: Described, scene: mi.Scene, names: dict[str, str], recovered: Collection[str]
    ) -> None:
        self.described, self.scene, self.names, self.recovered = described, scene, names, recovered
        self.params = traversed(scene)
        self.files: dict[str, bytes] = {}
        self.owners: set[int] = set()
        """Ids of the nodes whose files are in ``files``."""
        self._meshes: dict[str, str] = {}

    def put(self, key: str, owner: Owner) -> None:
        """Write the value of a parameter to its owner. Raises PathreplayError if no property can store the value."""
        node, place = owner.node, owner.place
        plugin = node.props.plugin_name()
        if plugin in _PICTURES and place == "data":
            self._texture(key, node)
        elif plugin == "gridvolume" and place == "data":
            self._volume(key, node)
        elif compat.is_mesh_data(place):
            self._mesh(self.params.properties[key][2], node)
        elif place == "to_world":
            _remove(node.props, *_ALSO_PLACES.get(plugin, ()))
            node.props["to_world"] = mi.ScalarTransform4f(get_array(self.params[key]).astype(np.float64))
        else:
            self._number(key, node, place)

    def meshes(self) -> None:
        """Write each `mi.Mesh` of the description to a file, and describe its material and emitter by properties."""
        for parent in list(self.described.nodes):
            for name in list(parent.props.keys()):
                value = parent.props.get(name) if parent.props.type(name) == mi.Properties.Type.Object else None
                if isinstance(value, mi.Mesh):
                    self._made_mesh(parent, name, value)

    def _texture(self, key: str, node: Node) -> None:
        value = self.params[key]
        if not dr.is_float_v(value):
            self._coarse_texture(key, node)
            return
        if coefficient_channels(self.params, key):
            remedy = "recover it in an rgb variant" if key in self.recovered else "give it as a file"
            raise PathreplayError(
                f"Texture '{key}' consists of smooth spectra in variant {mi.variant()}, which no file format of "
                f"Mitsuba holds; {remedy}"
            )
        self._from_file(
            node, f"textures/{self.names[key]}.exr", exr_bytes(get_array(form_of(self.params, key).see(value)))
        )
        if node.props.plugin_name() == "bitmap":
            node.props["format"] = "fp16" if isinstance(value, mi.TensorXf16) else "variant"

    def _coarse_texture(self, key: str, node: Node) -> None:
        """Write 8-bit texels to a PNG file, whose values Mitsuba decodes from sRGB unless ``raw`` is set."""
        if not node.props.get("bitmap").srgb_gamma():
            node.props["raw"] = True
        stream = mi.MemoryStream()
        mi.Bitmap(self.params[key]).write(stream, mi.Bitmap.FileFormat.PNG)
        self._from_file(node, f"textures/{self.names[key]}.png", bytes(stream.raw_buffer()))

    def _volume(self, key: str, node: Node) -> None:
        bounds = UNIT_CUBE
        if node.props.get("use_grid_bbox", False):
            bounds = self._box(node)
        self._from_file(node, f"volumes/{self.names[key]}.vol", vol_bytes(get_array(self.params[key]), bounds))

    def _box(self, node: Node) -> Bounds:
        grid = node.props.get("grid") if "grid" in node.props else None
        if grid is None:
            grid = mi.VolumeGrid(str(self.described.find_file(node.props.get("filename"))))
        stream = mi.MemoryStream()
        grid.write(stream)  # Python can read the bounding box only from a written file
        return vol_bounds(stream.raw_buffer())

    def _mesh(self, mesh: mi.Mesh, node: Node) -> None:
        file = self._ply(mesh, node.props.id(), node)
        _remove(node.props, *_MADE_BY, "to_world", "flip_tex_coords")
        node.props.set_plugin_name("ply")
        node.props["filename"] = file
        self.owners.add(id(node))

    def _ply(self, mesh: mi.Mesh, name: str, node: Node | None = None) -> str:
        """Add the PLY file of a mesh, unless it was added before, and return the file's name.

        ``node`` is the description of the mesh, or None for an existing object.
        """
        if mesh.id() not in self._meshes:
            stream, params = mi.MemoryStream(), mi.traverse(mesh)
            spectra = {key: mi.Float(params[key]) for key in _spectra(mesh, params)}
            params.update(self._colours(mesh, list(spectra), node))
            try:
                mesh.write_ply(stream)
            finally:
                params.update(spectra)
            file = f"meshes/{self.names.get(mesh.id(), name or f'mesh-{len(self._meshes)}')}.ply"
            self.files[file] = bytes(stream.raw_buffer())
            self._meshes[mesh.id()] = file
        return self._meshes[mesh.id()]

    def _colours(self, mesh: mi.Mesh, keys: list[str], node: Node | None) -> dict[str, mi.Float]:
        """Return the colours in the file of a mesh, for the attributes that spectral variants convert to spectra.

        Raises PathreplayError if an attribute was recovered, or the mesh has no file.
        """
        if not keys:
            return {}
        changed = [key for key in keys if f"{mesh.id()}.{key}" in self.recovered]
        if changed or node is None or "filename" not in node.props:
            remedy = "recover it in an rgb variant" if changed else "give the mesh as a file"
            raise PathreplayError(
                f"Attribute '{mesh.id()}.{(changed or keys)[0]}' consists of smooth spectra in variant {mi.variant()}, "
                f"which no file format of Mitsuba holds; {remedy}"
            )
        source = {"type": node.props.plugin_name(), "filename": str(self.described.find_file(node.props["filename"]))}
        if "shape_index" in node.props:
            source["shape_index"] = node.props["shape_index"]
        with mi.variant_context("scalar_rgb"), spare_thread():
            stored = mi.traverse(mi.load_dict(source))
            colours = {key: np.array(stored[key], np.float32) for key in keys}
        return {key: mi.Float(colour) for key, colour in colours.items()}

    def _made_mesh(self, parent: Node, name: str, mesh: mi.Mesh) -> None:
        properties = mi.Properties("ply")
        properties.set_id(name)
        shape = next((shape for shape in self.scene.shapes() if shape.id() == name), mesh)
        properties["filename"] = self._ply(shape, name)
        if not compat.has_normals(mesh):
            properties["face_normals"] = True
        for part, instance in (("bsdf", shape.bsdf()), ("emitter", shape.emitter())):
            if instance is not None:
                kind = mi.ObjectType.BSDF if part == "bsdf" else mi.ObjectType.Emitter
                properties[part] = self.described.add(self._known(instance, f"{part} of '{name}'"), kind)
        _remove(parent.props, name)
        parent.props[name] = self.described.add(properties, mi.ObjectType.Shape)
        self.owners.add(id(self.described.nodes[-1]))

    def _known(self, instance: mi.Object, what: str) -> mi.Properties:
        """Describe a loaded material or emitter by properties.

        Glass is supported. Diffuse materials, conductors and area lights are supported if their colours are constant.
        Raises PathreplayError for all other objects.
        """
        params = mi.traverse(instance)
        if instance.class_name() == "SmoothDielectric" and params.keys() == {"eta"}:
            properties = mi.Properties("dielectric")
            properties["int_ior"], properties["ext_ior"] = float(params["eta"]), 1.0
            return properties
        plugin, parts = _KNOWN.get(instance.class_name(), ("", ()))
        owners = [params.properties[key][2] for part in parts if (key := f"{part}.value") in params]
        plain = [owner for owner in owners if owner.class_name() in _PLAIN_SPECTRA]
        if not plugin or len(plain) < len(parts):
            raise PathreplayError(
                f"The {what} is an existing {instance.class_name()} object, which cannot be exported; give the mesh by "
                "a file and its materials by dictionaries"
            )
        properties = mi.Properties(plugin)
        for part in parts:
            _set_colour(properties, part, get_array(params[f"{part}.value"]))
        return properties

    def _number(self, key: str, node: Node, place: str) -> None:
        value, plugin = get_array(self.params[key]), node.props.plugin_name()
        if place == "x_fov":
            _remove(node.props, "focal_length")
            node.props["fov_axis"] = "x"
            node.props["fov"] = float(value[0])
        elif plugin in _BY_IOR and place == "eta":
            node.props["int_ior"], node.props["ext_ior"] = float(value[0]), 1.0
        elif place.endswith(".value") or place == "value":
            name = place.split(".")[0]
            if mi.is_spectral and value.size > 1:
                raise PathreplayError(
                    f"Parameter '{key}' is a smooth spectrum in variant {mi.variant()}, which no scene file holds; "
                    "recover it in an rgb variant"
                )
            _set_colour(node.props, name, value)
            if name in _METALS and "material" in node.props:
                _remove(node.props, "material")
                other = _METALS[name]
                _set_colour(node.props, other, get_array(self.params[f"{key.removesuffix(place)}{other}.value"]))
        elif value.size == 1 and "." not in place:
            node.props[place] = float(value.ravel()[0])
        elif value.size == 3 and "." not in place:
            if plugin == "point" and place == "position":
                _remove(node.props, "to_world")
            node.props[place] = mi.ScalarVector3d(*(float(x) for x in value.ravel()))
        else:
            raise PathreplayError(
                f"Parameter '{key}' of {plugin} with {value.size} numbers cannot be written into a scene file; read "
                "its value from parameters.safetensors in the run folder"
            )

    def _from_file(self, node: Node, name: str, data: bytes) -> None:
        _remove(node.props, *_MADE_BY)
        node.props["filename"] = name
        self.owners.add(id(node))
        self.files[name] = data


def _spectra(mesh: mi.Mesh, params: mi.SceneParameters) -> list[str]:
    """Return the keys of the attributes of a mesh that Mitsuba has converted from colours to smooth spectra."""
    counts = {"vertex": mesh.vertex_count(), "face": mesh.face_count()}
    return [
        key
        for key in params.keys()
        if mi.is_spectral and key.endswith("color") and len(params[key]) == 3 * counts.get(key.split("_")[0], 0)
    ]


def _remove(properties: mi.Properties, *names: str) -> None:
    for name in names:
        if name in properties:
            del properties[name]


def _set_colour(properties: mi.Properties, name: str, value: np.ndarray) -> None:
    if value.size == 1:
        properties[name] = float(value.ravel()[0])
    else:
        properties[name] = mi.ScalarColor3d(*(float(x) for x in value.ravel()))


def made_otherwise(node: Node) -> bool:
    """Return whether the values of a texture or grid were given as an object or an array instead of a file."""
    return any(name in node.props for name in ("bitmap", "grid", "data"))


def copied_files(described: Described, placed: Collection[int]) -> dict[str, Path]:
    """Return the paths of the files that the scene references, by new name.

    Nodes whose id is in ``placed`` are omitted: their files have been written. The new names replace the old names in
    the description.
    """
    copies: dict[str, Path] = {}
    for node in described.nodes:
        name = node.props.get("filename", None)
        if not isinstance(name, str) or id(node) in placed:
            continue
        path = described.find_file(name).resolve()
        new_name = next((new for new, old in copies.items() if old == path), None)
        if new_name is None:
            new_name, number = f"files/{path.name}", 0
            while new_name in copies:
                number += 1
                new_name = f"files/{path.stem}-{number}{path.suffix}"
            copies[new_name] = path
        node.props["filename"] = new_name
    return copies
