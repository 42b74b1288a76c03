"""How far derivatives are from finite differences on Mitsuba's own configurations, in Mitsuba's measure.

There an integrator passes with its picture, its forward derivative value by value against differences, and its reverse
derivative against their sum: 24 configurations, 72 tests. References are made as there, by `path` with 12 000 samples
per pixel and common random numbers on both sides. Steps may be larger, since derivatives are taken all along a step.

    python tests/support/mitsuba_errors.py [--full] [--boundary none] [NAME ...]

prints what is found. Films are small, which is stricter: edges take a larger share of their pixels. `--full` takes
Mitsuba's films, and half an hour.
"""

from __future__ import annotations

import argparse
import gc
import time
from collections.abc import Callable
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_configs import CONFIGS, Config, Limits
from pathreplay.platform.backend import set_variant
from pathreplay.scenes.parameters import get_array
from pathreplay.testing.objective import Objective
from pathreplay.testing.statistics import gap
from pathreplay.testing.stencil import CENTRAL

SMALL = 32
"""Pixels in a row of the film, at most, unless in full."""
REFERENCE_SPP = 12000
FLOOR_PRIMAL, FLOOR_FORWARD, FLOOR_REVERSE = 2e-2, 2e-1, 1e-3
"""Errors are relative to the reference, or to this where it is smaller."""
ADJOINT = 1e-3
"""What reverse mode is given for each value of the image."""
PASSES, LANES = 16, 1 << 22
"""With how many seeds, at least, and how many samples in one of them, at most."""


class Found(NamedTuple):
    """Errors that were found."""

    primal: tuple[float, float]  # mean, maximum
    forward: tuple[float, float]
    reverse: float
    z: float  # forward against differences, sums with weights that differ from pixel to pixel
    transpose: float  # reverse against forward, with these weights and the same random numbers; see `Setup.magnitude`

    def misses(self, limits: Limits) -> list[str]:
        """Which of the three thresholds are exceeded."""
        parts = {
            "primal": self.primal[0] <= limits.mean and self.primal[1] <= limits.most,
            "forward": self.forward[0] <= limits.mean and self.forward[1] <= limits.most,
            "reverse": self.reverse <= limits.reverse,
        }
        return [name for name, held in parts.items() if not held]


class Setup(Objective):
    """A loaded config, of which several parameters may move at once."""

    def __init__(self, config: Config, size: int) -> None:
        gc.collect()  # earlier scenes would be traced, too
        scene = mi.load_dict(config.scene(size), optimize=False)
        super().__init__(scene, mi.traverse(scene), config.keys[0], config.move)
        self.place = 0.0  # where derivatives are taken
        self.values = {key: type(self.params[key])(self.params[key]) for key in config.keys}

    def put(self, t: mi.Float) -> None:
        for key, value in self.values.items():
            self.params[key] = self.move(value, t + self.place)
        self.params.update()

    def along(self, integrator: mi.Integrator, places: np.ndarray, seed: int, spp: int) -> np.ndarray:
        """Forward derivatives at places, each with its seed and ``spp`` samples in all."""
        found = []
        for k, place in enumerate(places):
            self.place = float(place)
            found.append(self.forward(integrator, seed + k, spp // len(places)))
        self.place = 0.0
        return np.array(found)

    def collect(self, t: mi.Float) -> float:
        for key in self.values:
            dr.enqueue(dr.ADMode.Backward, self.params[key])
        dr.traverse(dr.ADMode.Backward)
        return float(dr.grad(t)[0])

    def magnitude(self, integrator: mi.Integrator, seed: int, spp: int) -> float:
        """That of the reverse derivative, number by number of the parameters: some of it is rounding."""
        self.put(mi.Float(0))
        dr.enable_grad(*(self.params[key] for key in self.values))
        self.params.update()
        integrator.render_backward(self.scene, self.params, self.adjoint, self.sensor, seed=seed, spp=spp)
        magnitude = 0.0
        for key, value in self.values.items():
            begin, end = (get_array(self.move(value, mi.Float(t))) for t in (-0.5, 0.5))
            magnitude += float(np.abs(get_array(dr.grad(self.params[key])) * (end - begin)).sum())
        self.put(mi.Float(0))
        return magnitude

    def passes(self, spp: int) -> int:
        size = self.sensor.film().crop_size()
        return max(PASSES, -(-spp * int(size[0] * size[1]) // LANES))

    def pictures(self, picture: Callable[[int, int], np.ndarray], spp: int, seed: int) -> np.ndarray:
        """picture(seed, samples per pixel) of several passes with ``spp`` samples in all."""
        passes = self.passes(spp)
        return np.array([picture(seed + k, spp // passes) for k in range(passes)])


def measure(config: Config, full: bool = False, boundary: str = "all", part: int = 1, seed: int = 1) -> Found:
    """Errors of pathreplay's picture, forward and reverse derivative, with seeds from ``seed`` on.

    References use 1/``part`` of their samples. Their noise adds to the errors; the limits stay the same.
    """
    size = config.res if full else min(SMALL, config.res)
    setup = Setup(config, size)
    plain = mi.load_dict({"type": "path", "max_depth": config.depth})
    ours = mi.load_dict({"type": "pathreplay", "max_depth": config.depth, "boundary": boundary})

    wide = config.res // size
    reference_spp, spp = REFERENCE_SPP * wide ** min(config.rise, 1) // part, config.spp * wide**config.rise
    places = config.step * ((np.arange(n := setup.passes(spp)) + 0.5) / n - 0.5)

    def difference(seed: int, spp: int) -> np.ndarray:
        return setup.difference(plain, CENTRAL, config.step / 2, seed, spp)

    expected = setup.pictures(lambda seed, spp: setup.image(plain, seed, spp), reference_spp, 1000).mean(axis=0)
    slopes = setup.pictures(difference, reference_spp, 2000)
    image = setup.pictures(lambda seed, spp: setup.image(ours, seed, spp), spp, seed).mean(axis=0)
    tangents = setup.along(ours, places, seed, spp)
    slope, tangent = slopes.mean(axis=0), tangents.mean(axis=0)

    setup.weigh(np.full(image.shape, ADJOINT / image.size))
    gradient, sum_of_slope = setup.backward(ours, seed, config.reverse_spp * wide**2), setup.dot(slope)
    reverse = abs(gradient - sum_of_slope) / max(abs(sum_of_slope), FLOOR_REVERSE)

    # Grey, since the weights take part in the choice of vertices; more at the right, or what moves would cancel.
    weights = np.random.default_rng(0).uniform(0, 1, (*image.shape[:2], 1)) * np.linspace(0, 1, image.shape[1])[:, None]
    setup.weigh(np.broadcast_to(weights, image.shape) / image.size)
    ahead_sums, sums = (np.array([setup.dot(x) for x in samples]) for samples in (tangents, slopes))
    ahead_sums -= np.polyfit(places, ahead_sums, 1)[0] * places  # no noise, and its mean is zero
    z = gap(ahead_sums, sums).z
    ahead, back = setup.forward(ours, seed, 16), setup.backward(ours, seed, 16)
    scale = max(setup.dot(np.abs(ahead)), setup.magnitude(ours, seed, 16))
    transpose = abs(setup.dot(ahead) - back) / (scale or 1)
    setup.put(mi.Float(0))
    primal, forward = relative(image, expected, FLOOR_PRIMAL), relative(tangent, slope, FLOOR_FORWARD)
    return Found(primal, forward, reverse, z, transpose)


def relative(found: np.ndarray, expected: np.ndarray, floor: float) -> tuple[float, float]:
    """Mean and maximum of the relative error."""
    error = np.abs(found - expected) / np.maximum(np.abs(expected), floor)
    return float(error.mean()), float(error.max())


HEAD = (
    f"{'configuration':28s} {'primal mean':>11s} {'max':>7s} {'forward mean':>12s} {'max':>7s} {'reverse':>9s} "
    f"{'z':>5s} {'fwd=rev':>8s} | {'mean <':>7s} {'max <':>6s} {'reverse <':>9s}"
)


def row(name: str, found: Found, limits: Limits) -> str:
    """A line of the table."""
    primal, forward = found.primal, found.forward
    errors = f"{primal[0]:11.4f} {primal[1]:7.3f} {forward[0]:12.4f} {forward[1]:7.3f} {found.reverse:9.5f}"
    held = f"{limits.mean:7g} {limits.most:6g} {limits.reverse:9g}"
    misses = found.misses(limits)
    verdict = f"misses {', '.join(misses)}" if misses else ""
    return f"{name:28s} {errors} {found.z:+5.1f} {found.transpose:8.0e} | {held} {verdict}"


def main() -> None:
    """Print the table; without names all of it."""
    parser = argparse.ArgumentParser(description="Errors on Mitsuba's own configurations, and its limits.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of a configuration: {', '.join(CONFIGS)}")
    parser.add_argument("--full", action="store_true", help="films of Mitsuba's size")
    parser.add_argument("--boundary", default="all", help="which boundary terms: all, primary or none")
    given = parser.parse_args()
    set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    print(HEAD)
    for name in given.names or CONFIGS:
        begun = time.time()
        found = measure(CONFIGS[name], given.full, boundary=given.boundary)
        print(f"{row(name, found, CONFIGS[name].limits)} ({time.time() - begun:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
