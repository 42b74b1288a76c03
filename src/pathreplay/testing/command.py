"""User interface of gradient checks: progress, printed results, and a JSON file for other programs."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from rich.console import Console
from rich.text import Text

from pathreplay.errors import PathreplayError
from pathreplay.platform.atomic_files import write_whole
from pathreplay.platform.progress_bar import Told, progress_bar
from pathreplay.platform.traversal import traversed
from pathreplay.scenes.parameters import resolve_differentiable
from pathreplay.testing.gradient import GradientCheck, check_gradient
from pathreplay.testing.picture import derivative_images
from pathreplay.testing.reference import Spec, integrator_under_test

FORMATS = ("png", "pdf", "svg")
_STYLES = {"pass": "green", "zero": "green", "fail": "bold red", "inconclusive": "yellow"}


def check_all(
    scene: mi.Scene,
    patterns: Sequence[str],
    *,
    integrator: Spec = None,
    max_depth: int | None = None,
    boundary: Mapping[str, object] | None = None,
    **options: Any,
) -> Iterator[GradientCheck]:
    """Yield the result of ``check_gradient(scene, key, **options)`` for each key that matches the patterns.

    Progress is shown on standard error. ``boundary`` contains additional properties of the integrator `pathreplay`.
    Raises the same errors as :func:`check_gradient` and :func:`resolve_differentiable`.
    """
    tested = integrator_under_test(integrator, scene, max_depth, boundary)
    keys = resolve_differentiable(traversed(scene), patterns, tested)
    for i, key in enumerate(keys):
        with _progress(f"{key} ({i + 1}/{len(keys)})", "compiling and measuring the first gradient") as progress:
            result = check_gradient(scene, key, integrator=tested, progress=progress, **options)
        yield result


def _progress(what: str, second: str = "") -> AbstractContextManager[Told]:
    """Show the progress of ``what``. Without a terminal, a line announces its ``second`` step, if that may be long."""

    def line(done: int, total: int) -> str:
        if done == 0:
            return f"checking {what}"
        return f"{what}: {second}" if second and done == 1 else f"{what}: {done} of {total} renderings"

    return progress_bar(what, line, (0, 1) if second else (0,))


def print_checks(results: Iterable[GradientCheck]) -> list[GradientCheck]:
    """Print the compared integrators, then for each parameter the verdict, both estimates and an explanation.

    Each result is printed as soon as it arrives. Returns all results.
    """
    console = Console(highlight=False, soft_wrap=True)
    printed: list[GradientCheck] = []
    for result in results:
        if not printed:
            console.print(
                f"{result.integrator} ({result.mode}) against finite differences of {result.reference_integrator}: "
                f"{result.seeds} seeds, {result.spp} spp (differences {result.fd_spp} spp)\n"
            )
        printed.append(result)
        verdict = Text(f"{result.verdict.upper():<6}", style=_STYLES[result.verdict])
        reference_error = math.hypot(result.reference_se, result.step_error)
        console.print(verdict, Text(result.key, style="bold"))
        console.print(f"       gradient   {_with_error(result.gradient, result.gradient_se)}")
        console.print(f"       reference  {_with_error(result.reference, reference_error)}")
        console.print(f"       z = {result.z:+.2f}   {result.reason}\n")
    counts = Counter(result.verdict for result in printed)
    console.print(f"{len(printed)} checked: " + ", ".join(f"{n} {verdict}" for verdict, n in counts.items()))
    return printed


def format_of(path: Path) -> str:
    """Return the format of a picture by the suffix of its name."""
    return path.suffix.removeprefix(".").lower()


def require_picture(path: Path) -> None:
    """Raise PathreplayError unless the suffix of a picture's name is one of `FORMATS`."""
    if format_of(path) not in FORMATS:
        raise PathreplayError(f"--picture is '{path}': give a name that ends in .png, .pdf or .svg")


def pictured(
    scene: mi.Scene,
    keys: Sequence[str],
    *,
    integrator: Spec = None,
    max_depth: int | None = None,
    boundary: Mapping[str, object] | None = None,
    **options: Any,
) -> list[tuple[str, str, np.ndarray, np.ndarray]]:
    """Return the key, the integrator's name, the derivative image and the finite differences of each parameter.

    Progress is shown on standard error. Raises the same errors as :func:`derivative_images`.
    """
    tested = integrator_under_test(integrator, scene, max_depth, boundary)
    rows = []
    with _progress("derivative images") as progress:
        for i, key in enumerate(keys):
            progress(i, len(keys))
            images = derivative_images(scene, key, integrator=tested, **options)
            rows.append((key, images.integrator, images.gradient, images.reference))
    return rows


def _with_error(value: float, error: float) -> str:
    """Format a value and its error, for example '+0.03199 ± 0.00015', with two significant digits of the error."""
    if not (math.isfinite(value) and math.isfinite(error)):
        return f"{value:+.4g}"
    if error == 0:
        return f"{value:+.5g} ± 0"
    digits = 1 - math.floor(math.log10(error))
    if not 0 <= digits <= 7:
        return f"{value:+.3e} ± {error:.1e}"
    return f"{value:+.{digits}f} ± {error:.{digits}f}"


def write_checks(results: Sequence[GradientCheck], path: Path) -> None:
    """Write all fields of the checks, including samples, as a JSON list; NaN and infinity become null.

    Raises PathreplayError if the file cannot be written: see `write_whole`.
    """
    records = [{**asdict(result), "passed": result.passed, "variant": mi.variant()} for result in results]
    finite = json.loads(json.dumps(records), parse_constant=lambda name: None)
    write_whole(path, json.dumps(finite, indent=2).encode() + b"\n", "--json")
