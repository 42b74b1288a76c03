"""Caustic design: heights of a glass slab whose caustic is a picture, by light paths and Adam on a pyramid of heights.

Both integrators have the same loop. An iteration renders an image, and differentiates it along other light paths.
"""

from __future__ import annotations

from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.inverse.caustics.heights import caustic_heights
from pathreplay.inverse.caustics.optics import Optics
from pathreplay.inverse.config.parameter_options import Displace
from pathreplay.inverse.parameters.displace import displacement_of
from pathreplay.inverse.parameters.pyramid import Pyramid
from pathreplay.scenes.caustics import caustic_lens

from ..measures.light_paths import backpropagate
from ..measures.methods import METHODS

LENS = "lens.vertex_positions"
WIDTH, DISTANCE, ETA = 1.0, 1.5, 1.5
#: Emitter, two refractions, receiver. The camera does not see the emitter, so that no camera rays are needed.
LIMITS = {"max_depth": 4, "rr_depth": 5, "hide_emitters": True}
FLAT, TRANSPORT = "flat start", "transport start"
#: Samples per pixel of each of the two images from which an error is computed. The standard deviation of an error of
#: 1e-3 is then about 1e-5; with 16 samples it would be 2e-4.
ERROR_SPP = 128
SEED = 2**31

#: Cells along each side of the height map, by problem.
CELLS = {f"caustic of {n} x {n} heights": n for n in (64, 512)}


def picture(n: int) -> np.ndarray:
    """Draw n x n brightnesses: a ring, a disc and bars of three widths on a dark ground."""
    y, x = (np.mgrid[:n, :n] + 0.5) * (2 / n) - 1

    def inside(distance: np.ndarray) -> np.ndarray:
        return np.clip(0.5 - distance / 0.02, 0, 1)

    ring = inside(np.abs(np.hypot(x, y) - 0.75) - 0.06)
    disc = inside(np.hypot(x + 0.2, y + 0.25) - 0.25)
    bars = [inside(np.maximum(np.abs(x - at) - width, np.abs(y - 0.3) - 0.2)) for at, width in BARS]
    return 0.15 + np.maximum.reduce([ring, disc, *bars])


#: Centre and half width.
BARS = ((-0.42, 0.06), (-0.22, 0.06), (0.0, 0.03), (0.1, 0.03), (0.2, 0.03), (0.3, 0.015), (0.35, 0.015), (0.4, 0.015))


def padded(values: np.ndarray) -> mi.Float:
    """Return an array with space behind it.

    Dr.Jit uses the memory of a NumPy array in place, and reads whole packets of numbers, also beyond the end.
    """
    with_space = np.zeros(values.size + 64, np.float32)
    with_space[: values.size] = values.ravel()
    return mi.Float(with_space[: values.size])


class Design:
    """The scene, the target image, and its error for some heights."""

    def __init__(self, cells: int, pixels: int) -> None:
        lens = caustic_lens(pixels, columns=cells, rows=cells, distance=DISTANCE, eta=ETA, receiver_width=WIDTH)
        self.scene = mi.load_dict(lens, optimize=False)
        self.params = mi.traverse(self.scene)
        self.first = padded(np.array(self.params[LENS]))
        along_z = Displace(direction=(0, 0, 1), weights="vertex_weight")
        self.displacement = displacement_of(self.params, LENS, along_z)
        self.pyramid = Pyramid([(cells, cells, 1)], wraps=False)
        self.cells, self.judge = cells, mi.load_dict({"type": "ptracer", **LIMITS})
        self.picture = picture(pixels)
        image = np.array(self.judge.render(self.scene, seed=SEED, spp=ERROR_SPP))
        self.target = self.picture[..., None] * (image.mean() / self.picture.mean())

    def start(self, kind: str) -> np.ndarray:
        """Return initial heights."""
        return np.zeros((self.cells, self.cells, 1), np.float32) if kind == FLAT else self.transported

    @cached_property
    def transported(self) -> np.ndarray:
        """Heights from optimal transport."""
        return caustic_heights(picture(self.cells), Optics(WIDTH, DISTANCE, ETA, WIDTH), (self.cells, self.cells))

    def put(self, heights: np.ndarray, differentiably: bool = False) -> mi.Float:
        """Displace the slab and return its vertices, which are leaves with gradients if ``differentiably``."""
        vertices = self.displacement(self.first, mi.TensorXf(heights))
        dr.set_grad_enabled(vertices, differentiably)
        self.params[LENS] = vertices
        self.params.update()
        return vertices

    def gradient(self, heights: np.ndarray, by_vertices: mi.Float) -> np.ndarray:
        """Return the gradient by the heights from that by the vertices."""
        tensor = mi.TensorXf(heights)
        dr.enable_grad(tensor)
        dr.backward(dr.sum(self.displacement(self.first, tensor) * by_vertices))
        return np.array(dr.grad(tensor))

    def error(self, heights: np.ndarray) -> float:
        """Return the mean squared difference from the target over the mean square of the target, without bias.

        The factors of the square are two independent images.
        """
        self.put(heights)
        a, b = (
            np.array(self.judge.render(self.scene, seed=SEED + k, spp=ERROR_SPP), np.float64) - self.target
            for k in (1, 2)
        )
        return float(np.mean(a * b) / np.mean(np.square(self.target)))


class DesignLoop:
    """A loop of `search.followed` whose values are the heights."""

    def __init__(self, design: Design, integrator: str, start: str, rate: float, spp: int, seed: int) -> None:
        self.design, self.method, self.rate, self.spp, self.seed = design, integrator, rate, spp, seed
        self.integrator = mi.load_dict(METHODS[integrator] | LIMITS)
        self.first = design.start(start)
        self.target = mi.TensorXf(design.target)
        self.reset()

    def reset(self) -> None:
        """Return to the initial heights."""
        self.adam = mi.ad.Adam(lr=self.rate)
        self.adam["levels"] = padded(self.design.pyramid.latent(self.first))
        self.count = 0

    def heights(self) -> np.ndarray:
        """Return the heights."""
        return self.design.pyramid.values(np.array(self.adam["levels"]))

    def step(self) -> None:
        """Take one iteration."""
        design, seed = self.design, 2 * (self.seed * 2**14 + self.count)
        heights = self.heights()
        vertices = design.put(heights, differentiably=True)
        with dr.suspend_grad():
            image = self.integrator.render(design.scene, seed=seed, spp=self.spp)
            adjoint = (image - self.target) * (2 / dr.prod(image.shape))
        backpropagate(self.method, self.integrator, design.scene, design.params, adjoint, seed + 1, self.spp)
        gradient = design.pyramid.gradient(heights, design.gradient(heights, dr.grad(vertices)))
        dr.set_grad(self.adam["levels"], padded(gradient))
        self.adam.step()
        self.count += 1

    def values(self) -> dict[str, np.ndarray]:
        """Wait for the iterations, and return the heights."""
        dr.sync_thread()
        return {"heights": self.heights()}
