"""The entries of the gallery: jobs of examples/, each with the view to show."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Entry:
    """A result of the gallery."""

    name: str
    title: str
    text: str
    config: str
    """Path of the job in examples/."""
    view: str = ""
    """Name of the view to show; the first one if empty."""
    prepare: str = ""
    """Path of the script in examples/ that writes the files of the job."""
    checkouts: tuple[str, ...] = ()
    """Arguments of the script: folders of other repositories, by name. An option of the gallery gives each path."""

    @property
    def commands(self) -> tuple[str, ...]:
        """Return the commands for a reader."""
        prepare = (" ".join((f"python examples/{self.prepare}", *self.checkouts)),) if self.prepare else ()
        return (*prepare, f"pathreplay optimize examples/{self.config}")


ENTRIES = (
    Entry(
        "cornell-photo",
        "A photograph on a wall",
        "The picture on the back wall, the colours of both side walls and the light, from two images.",
        "cornell-photo/config.toml",
        view="overview",
    ),
    Entry(
        "one-photo",
        "A room in one photo",
        "The colours of floor, walls and ball, the roughness of the ball, and the lamp, from one 8-bit photo.",
        "one-photo/config.toml",
        prepare="one-photo/make_photo.py",
    ),
    Entry(
        "capture",
        "A capture of a glossy ball",
        "The texture and roughness of a ball and the sky around it, from twenty images and their cameras.",
        "capture/config.toml",
        prepare="capture/make_capture.py",
    ),
    Entry(
        "real-sky",
        "A bottle under a real sky",
        "The texture of a scanned bottle and the photographed sky around it, from eight images.",
        "real-sky/config.toml",
        view="test",
        prepare="real-sky/make_assets.py",
        checkouts=("OPENEXR_IMAGES", "PYRENDER"),
    ),
    Entry(
        "glass-ball",
        "A glass ball",
        "The index of refraction and the position of a ball, from the refracted borders of the panels behind it.",
        "glass-ball/config.toml",
    ),
    Entry(
        "glass-pane",
        "An uneven pane of glass",
        "The index and the surface normals of a pane, from three images of the room behind it.",
        "glass-pane/config.toml",
        view="front",
    ),
    Entry(
        "cloud",
        "A cloud",
        "The density of a cloud, coarse to fine, from six images with multiple scattering.",
        "cloud/config.toml",
    ),
    Entry(
        "mirror-camera",
        "A mirror and a camera",
        "The poses of a mirror and of a camera that looks at it, from two images.",
        "mirror-camera/config.toml",
        view="camera",
    ),
    Entry(
        "camera-by-edges",
        "A camera pose from edges",
        "The pose of a camera that sees panels of uniform colour: the image changes only at their borders.",
        "camera-by-edges/config.toml",
    ),
    Entry(
        "silhouette-in-mirror",
        "A silhouette and its mirror image",
        "The pose of a black body, from its outline and from the outline of its mirror image.",
        "silhouette-in-mirror/config.toml",
    ),
    Entry(
        "mesh-by-shadows",
        "A mesh from silhouettes and shadows",
        "The shape of a black body, from its outlines and its soft shadow in four images; it starts as a sphere.",
        "mesh-by-shadows/config.toml",
    ),
    Entry(
        "shape-optimization",
        "A mesh from shading",
        "The shape of a body from eight images: Mitsuba's tutorial on shape optimization, as a job.",
        "tutorials/shape_optimization.toml",
        prepare="tutorials/make_assets.py",
    ),
    Entry(
        "caustic-lens",
        "A lens that casts a photograph",
        "The surface of a slab of glass whose caustic is a photograph.",
        "caustic-lens/config.toml",
    ),
)
