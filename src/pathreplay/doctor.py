"""Tests each libLLVM and each Mitsuba variant on this machine, and names remedies for failures.

Each test runs in a separate process, because an incompatible libLLVM kills the process that loads it.
"""

from __future__ import annotations

import os
import platform
import sys
from dataclasses import dataclass

from rich.console import Console
from rich.text import Text

from pathreplay import __version__
from pathreplay.errors import plain_line
from pathreplay.platform import llvm
from pathreplay.platform.backend import is_usable_variant
from pathreplay.platform.llvm import ENVIRONMENT_VARIABLE, LlvmLibrary


@dataclass(frozen=True)
class VariantVerdict:
    """Whether a variant of Mitsuba renders and differentiates a small scene on this machine.

    `message` is the reason if the test failed, otherwise "".
    """

    name: str
    works: bool
    message: str


@dataclass(frozen=True)
class DoctorReport:
    """Versions, test results, and remedies.

    `mitsuba` and `drjit` are version numbers. If one of these packages cannot be imported, `mitsuba` contains the
    reason, and `drjit` is "unknown". `remedies` has one line for each failure that the user can fix.
    """

    mitsuba: str
    drjit: str
    libraries: tuple[LlvmLibrary, ...]
    variants: tuple[VariantVerdict, ...]
    remedies: tuple[str, ...]

    @property
    def works(self) -> bool:
        """Whether at least one variant that pathreplay can use runs here."""
        return any(variant.works for variant in self.variants)

    def print(self) -> None:
        """Print the report to stdout, without wrapping lines, so that paths can be copied."""
        console = Console(highlight=False)

        def line(*parts: str | tuple[str, str]) -> None:
            console.print(Text.assemble(*parts), soft_wrap=True)

        def verdict(works: bool) -> tuple[str, str]:
            return ("  ok    ", "green") if works else ("  fails ", "red")

        line(("Versions", "bold"), f"\n  pathreplay {__version__}, Mitsuba {self.mitsuba}, Dr.Jit {self.drjit}")
        line(f"  Python {platform.python_version()} ({sys.executable}), {platform.platform()}")
        line(("libLLVM", "bold"), " (in the order in which they are looked for)")
        for library in self.libraries:
            reason = f": {library.message}" if library.message else ""
            line(verdict(library.works), f"{library.version or '?'}  {library.path}  ({library.origin}){reason}")
        if not self.libraries:
            line("  none found")
        line(("Variants", "bold"))
        for variant in self.variants:
            line(verdict(variant.works), variant.name, f": {variant.message}" if variant.message else "")
        if not self.variants:
            line("  none tried")
        if self.remedies:
            line(("Remedies", "bold"), *("\n  - " + remedy for remedy in self.remedies))
        usable = ", ".join(variant.name for variant in self.variants if variant.works)
        line(("Verdict", "bold"), f": pathreplay runs here ({usable})" if usable else ": pathreplay does not run here")


#: The test program renders a sphere under a constant emitter, which needs ray tracing and virtual calls. Its gradient
#: is positive.
_PROBE = """
import drjit as dr, mitsuba as mi
mi.set_variant(task["variant"])
scene = mi.load_dict({
    "type": "scene",
    "ball": {"type": "sphere", "bsdf": {"type": "diffuse"}},
    "light": {"type": "constant"},
    "sensor": {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 4, "height": 4},
    },
})
params = mi.traverse(scene)
key = next(key for key in params.keys() if "reflectance" in key)
dr.enable_grad(params[key])
params.update()
image = mi.render(scene, params, spp=1, integrator=mi.load_dict({"type": "prb", "max_depth": 2}))
dr.backward(dr.mean(image, axis=None))
gradient = float(dr.sum(dr.ravel(dr.grad(params[key])))[0])
if not 0.0 < gradient < 100.0:
    raise SystemExit(f"wrong result: gradient {gradient}")
"""


def _try_variants(names: list[str], library: LlvmLibrary | None) -> list[VariantVerdict]:
    """Test the variants in order.

    If a variant fails, later variants of the same back end are not tested and count as failed.
    """
    environment = os.environ | ({ENVIRONMENT_VARIABLE: library.path} if library else {})
    preload = llvm.unlinked_siblings(library.path) if library else []
    verdicts = []
    dead = {} if library else {"llvm": "no libLLVM works"}
    for name in names:
        backend = name.split("_")[0]
        message = dead.get(backend)
        if message is None:
            _, message = llvm.run_trial(_PROBE, {"preload": preload, "variant": name}, environment)
            if message:
                dead[backend] = f"not tested, because {name} fails"
        verdicts.append(VariantVerdict(name, not message, message))
    return verdicts


def examine() -> DoctorReport:
    """Try every libLLVM and every variant on this machine (a few seconds). Raises nothing."""
    remedies: list[str] = []
    try:
        import drjit as dr
        import mitsuba as mi

        versions, known = (str(mi.__version__), str(dr.__version__)), list(mi.variants())
    except Exception as error:
        versions, known = (f"cannot be imported ({plain_line(str(error))})", "unknown"), []
        remedies.append("install Mitsuba: pip install 'mitsuba>=3.9.1,<3.10'")
    libraries = tuple(llvm.probe(path, origin) for path, origin in llvm.candidates()) if known else ()
    library = next((library for library in libraries if library.works), None)
    names = sorted(filter(is_usable_variant, known), key=lambda name: (name.split("_")[0] != "llvm", known.index(name)))
    variants = _try_variants(names, library)

    broken = {variant.name.split("_")[0] for variant in variants if not variant.works}
    if "llvm" in broken and library is None:
        remedies.append(f"libLLVM: {llvm.WAY_OUT}")
    if library is not None and any(each.path == llvm.ASKED_FOR and not each.works for each in libraries):
        remedies.append(f"{ENVIRONMENT_VARIABLE} names a libLLVM that fails: unset it, or let it name {library.path}")
    if "cuda" in broken:
        remedies.append(
            "CUDA: needs an NVIDIA GPU and its driver (`nvidia-smi` has to list the GPU); "
            "without one, LLVM does the work on the CPU"
        )
    if "metal" in broken:
        remedies.append("Metal: needs a Mac with Apple silicon; without one, LLVM does the work on the CPU")
    return DoctorReport(*versions, libraries, tuple(variants), tuple(remedies))
