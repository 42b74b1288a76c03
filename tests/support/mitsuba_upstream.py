"""Mitsuba's own test of its derivatives, with its scenes, its references and its thresholds, for one integrator more.

    python tests/support/mitsuba_upstream.py CHECKOUT [--plugin prb] [--boundary none] [--seed 100] [NAME ...]

takes `src/integrators/tests/test_ad_integrators.py` out of a checkout of Mitsuba 3.9.1 with its data, and prints for
each of the 24 configurations how far picture, forward and reverse derivative are off: 72 tests. The tests in
`test_mitsuba_configs` need no checkout; their scenes are made after these.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_configs import Limits
from mitsuba_errors import ADJOINT, FLOOR_FORWARD, FLOOR_PRIMAL, FLOOR_REVERSE, LANES, relative
from pathreplay.platform.backend import set_variant
from variant import VARIANT

TESTS = "src/integrators/tests/test_ad_integrators.py"
REFERENCE_SPP = 12000
OTHERS = {"guiding", "sppc", "sppi"}
"""Options of projective integrators."""
HEAD = (
    f"{'configuration':58s} {'primal mean':>11s} {'max':>7s} {'forward mean':>12s} {'max':>7s} {'reverse':>9s} "
    f"| {'mean <':>7s} {'max <':>6s} {'reverse <':>9s}"
)


def upstream(checkout: Path) -> ModuleType:
    """The module of Mitsuba's tests; what it imports from Mitsuba's build is made here."""

    def found(name: str) -> str:
        return str(checkout / name)

    def with_checkout(function: Callable[[], Any]) -> Callable[[], Any]:
        def called() -> Any:
            before = mi.file_resolver()
            resolver = mi.FileResolver(before)
            resolver.append(str(checkout))
            mi.set_file_resolver(resolver)
            try:
                return function()
            finally:
                mi.set_file_resolver(before)

        return called

    util = ModuleType("util")
    util.find_resource, util.fresolver_append_path = found, with_checkout  # type: ignore[attr-defined]
    sys.modules["mitsuba.scalar_rgb.test.util"] = util
    spec = importlib.util.spec_from_file_location("upstream", checkout / TESTS)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def passes(picture: Callable[[int, int], Any], pixels: int, spp: int, first: int) -> np.ndarray:
    """The mean picture of passes with ``spp`` samples in all: one pass would be too large for most machines."""
    n = max(-(-spp * pixels // LANES), 1)
    return np.mean([np.array(picture(first + k, spp // n), np.float64) for k in range(n)], axis=0)


def reference(tests: ModuleType, config: Any, kind: str) -> np.ndarray:
    return np.array(mi.TensorXf(mi.Bitmap(f"{tests.output_dir}/test_{config.name}_image_{kind}_ref.exr")), np.float64)


def measure(tests: ModuleType, config: Any, options: dict[str, Any], seed: int) -> tuple[tuple[float, ...], Limits]:
    """Errors as Mitsuba's three tests take them, and what they may be."""
    config.initialize()
    wanted = {key: value for key, value in config.integrator_dict.items() if key not in OTHERS}
    integrator = mi.load_dict(wanted | options)
    size = config.scene.sensors()[0].film().crop_size()
    pixels = int(size[0] * size[1])
    primal, forward = (reference(tests, config, kind) for kind in ("primal", "fwd"))

    image = passes(lambda seed, spp: integrator.render(config.scene, seed=seed, spp=spp), pixels, config.spp, seed)

    def tangent(seed: int, spp: int) -> Any:
        theta = attached(config)
        dr.forward(theta, dr.ADFlag.ClearEdges)
        return dr.detach(integrator.render_forward(config.scene, seed=seed, spp=spp, params=theta))

    ahead = passes(tangent, pixels, config.spp, seed)
    theta = attached(config)
    spp = 256 if type(config) is tests.TranslateTexturedPlaneConfig else 128
    adjoint = dr.full(mi.TensorXf, ADJOINT, forward.shape)
    integrator.render_backward(config.scene, grad_in=adjoint, seed=seed, spp=spp, params=theta)
    gradient, expected = float(dr.grad(theta)[0]) / forward.size, forward.mean() * ADJOINT
    reverse = abs(gradient - expected) / max(abs(expected), FLOOR_REVERSE)
    errors = *relative(image, primal, FLOOR_PRIMAL), *relative(ahead, forward, FLOOR_FORWARD), reverse
    return errors, Limits(config.error_mean_threshold, config.error_max_threshold, config.error_mean_threshold_bwd)


def made_again(tests: ModuleType, config: Any, seed: int) -> tuple[float, float]:
    """How far the forward reference is from itself, made by its own recipe with another seed."""
    config.initialize()
    plain = mi.load_dict({"type": "path", "max_depth": config.integrator_dict["max_depth"]})
    ends = []
    for side in (-0.5, 0.5):
        config.update(mi.Float(side * config.ref_fd_epsilon))
        ends.append(np.array(plain.render(config.scene, seed=seed, spp=REFERENCE_SPP), np.float64))
    slope = (ends[1] - ends[0]) / config.ref_fd_epsilon
    return relative(slope, reference(tests, config, "fwd"), FLOOR_FORWARD)


def attached(config: Any) -> mi.Float:
    """The parameter that moves the scene, with gradients."""
    theta = mi.Float(0.0)
    dr.enable_grad(theta)
    config.update(theta)
    return theta


def row(name: str, errors: tuple[float, ...], limits: Limits) -> str:
    """A line of the table."""
    allowed = limits.mean, limits.most, limits.mean, limits.most, limits.reverse
    kinds = "primal", "primal", "forward", "forward", "reverse"
    misses = sorted({kind for kind, error, most in zip(kinds, errors, allowed, strict=True) if not error <= most})
    found = f"{errors[0]:11.4f} {errors[1]:7.3f} {errors[2]:12.4f} {errors[3]:7.3f} {errors[4]:9.5f}"
    verdict = f" misses {', '.join(misses)}" if misses else ""
    return f"{name:58s} {found} | {limits.mean:7g} {limits.most:6g} {limits.reverse:9g}{verdict}"


def main() -> None:
    """Print the table; without names all of it."""
    parser = argparse.ArgumentParser(description="Mitsuba's own tests of derivatives, for another integrator.")
    parser.add_argument("checkout", type=Path, help="folder of Mitsuba 3.9.1 with resources/data")
    parser.add_argument("names", nargs="*", metavar="NAME", help="of a configuration, such as 'crop_window'")
    parser.add_argument("--plugin", default="pathreplay", help="the integrator")
    parser.add_argument("--boundary", default="all", help="of pathreplay: all, primary or none")
    parser.add_argument("--boundary-spp", type=int, default=0, help="of pathreplay: lines per pixel")
    parser.add_argument("--share", type=float, default=1.0, help="of Mitsuba's samples: fewer are harder to pass with")
    parser.add_argument("--seed", type=int, default=0, help="the first of the passes' seeds")
    parser.add_argument("--again", type=int, default=0, metavar="N", help="only make references again, with N seeds")
    given = parser.parse_intermixed_args()
    set_variant(VARIANT)
    mi.set_log_level(mi.LogLevel.Error)
    tests = upstream(given.checkout.resolve())
    ours = {"boundary": given.boundary, "boundary_spp": given.boundary_spp} if given.plugin == "pathreplay" else {}
    options = {"type": given.plugin, **ours}
    kinds = (
        tests.BASIC_CONFIGS_LIST + tests.CONTINUOUS_BUT_NON_STATIC_GEOM_CONFIGS_LIST + tests.DISCONTINUOUS_CONFIGS_LIST
    )
    if not given.again:
        print(HEAD, flush=True)
    for config in (kind() for kind in kinds):
        if given.names and config.name not in given.names:
            continue
        for seed in range(1, given.again + 1):
            mean, most = made_again(tests, config, seed)
            limits = f"{config.error_mean_threshold:g} and {config.error_max_threshold:g}"
            print(f"{config.name:58s} reference, seed {seed}: mean {mean:.4f}, max {most:.3f} for {limits}", flush=True)
        if given.again:
            continue
        begun = time.time()
        config.spp = round(config.spp * given.share)
        errors, limits = measure(tests, config, options, given.seed)
        print(f"{row(config.name, errors, limits)} ({time.time() - begun:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
