"""Runs volumetric integrators that were written in Python for Mitsuba 3.0 under the installed Mitsuba.

The two published integrators for gradients of extinction, differential ratio tracking (2022) and sample matching
(2026), depend on a branch of Mitsuba 3.0 with changes in C++. `load` reads such a file from a checkout, translates the
parts of its syntax tree that have another form now, and executes it. Files of the checkout are not changed. The
translation covers:

- `while loop(active)` with `mi.Loop`, which becomes a loop of `@dr.syntax`;
- functions of Dr.Jit and Mitsuba that were renamed or removed (`_DrJit`);
- `Medium.get_albedo` and `Medium.sample_interaction_drt`, which only the branch has, and phase functions (`_Medium`,
  `_Phase`);
- the values that `sample` returns (`integrator`).
"""

from __future__ import annotations

import ast
import linecache
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi

from pathreplay.errors import PathreplayError

#: State that these integrators keep in objects of their own during a loop: class -> attributes.
PATH_STATE = ("_depth", "_si", "_last_scatter_direction_pdf", "_escaped", "_active", "_ray", "_mei_t", "_mei")
LOOP_STATE = {"DRTPathState": PATH_STATE, "DRTReservoir": ("state", "wsum", "current_weight")}


def load(file: Path) -> dict[str, Callable[[mi.Properties], Any]]:
    """Execute a file that registers integrators.

    Returns:
        The registered factories by plugin name.

    Raises:
        PathreplayError: The file does not exist.
    """
    if not file.is_file():
        raise PathreplayError(f"no integrator at {file}: give the path of a checkout of its repository")
    text = ast.unparse(ast.fix_missing_locations(_Translation().visit(ast.parse(file.read_text()))))
    name = f"<translated {file}>"
    # `dr.syntax` reads the source of a function through `linecache`.
    linecache.cache[name] = (len(text), None, text.splitlines(keepends=True), name)
    registered: dict[str, Callable[[mi.Properties], Any]] = {}
    module = ModuleType(file.stem)
    module.__dict__.update(dr=_DrJit(), mi=_Mitsuba(registered), get_single_medium=_single_medium, syntax=dr.syntax)
    exec(compile(text, name, "exec"), module.__dict__)
    for class_name, fields in LOOP_STATE.items():
        if class_name in module.__dict__:
            _make_traversable(module.__dict__[class_name], fields)
    return registered


def integrator(factory: Callable[[mi.Properties], Any], **options: Any) -> mi.Integrator:
    """Return an integrator of today's interface that samples with one of Mitsuba 3.0."""
    props = mi.Properties()
    for key, value in options.items():
        props[key] = value
    inner = factory(props)

    class Adapted(mi.ad.integrators.common.RBIntegrator):  # type: ignore[misc, name-defined, unused-ignore]
        def sample(self, mode: dr.ADMode, scene: mi.Scene, sampler: mi.Sampler, ray: mi.Ray3f, **more: Any) -> Any:
            radiance, valid, state = inner.sample(mode, scene, sampler, ray, **more)
            return radiance, valid, [], state

    return Adapted(props)


# ------------------------------ Syntax ------------------------------


class _Translation(ast.NodeTransformer):
    """Translates loops, scalar conditions, and media that are reached through interactions."""

    def __init__(self) -> None:
        self.loops: dict[str, ast.expr] = {}  # variable -> label

    def visit_Import(self, node: ast.Import) -> ast.AST | None:
        return None if node.names[0].name in ("drjit", "mitsuba") else node

    def visit_ImportFrom(self, node: ast.ImportFrom) -> ast.AST | None:
        return None if node.module == "util" else node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        self.loops = {}
        self.generic_visit(node)
        if self.loops:
            node.decorator_list.append(ast.Name("syntax", ast.Load()))
        return node

    def visit_Assign(self, node: ast.Assign) -> ast.AST | None:
        value = node.value
        if isinstance(value, ast.Call) and ast.unparse(value.func) == "mi.Loop":
            assert isinstance(node.targets[0], ast.Name)
            self.loops[node.targets[0].id] = value.args[0]
            return None  # `dr.syntax` finds the variables of a loop by itself
        return self.generic_visit(node)

    def visit_While(self, node: ast.While) -> ast.AST:
        self.generic_visit(node)
        test = node.test
        if isinstance(test, ast.Call) and isinstance(test.func, ast.Name) and test.func.id in self.loops:
            node.test = _hint(test.args[0], "label", self.loops[test.func.id])
        return node

    def visit_If(self, node: ast.If) -> ast.AST:
        self.generic_visit(node)
        node.test = _hint(node.test, "mode", ast.Constant("scalar"))
        return node

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        self.generic_visit(node)
        at_interaction = isinstance(node.value, ast.Name) and node.value.id in ("mei", "mei_sub")
        return ast.Name("medium", node.ctx) if at_interaction and node.attr == "medium" else node


def _hint(test: ast.expr, key: str, value: ast.expr) -> ast.Call:
    function = ast.Attribute(ast.Name("dr", ast.Load()), "hint", ast.Load())
    return ast.Call(function, [test], [ast.keyword(key, value)])


def _make_traversable(cls: type, fields: tuple[str, ...]) -> None:
    """Let Dr.Jit see the attributes of a class in loops. It creates copies without arguments and sets attributes."""
    original = cls.__init__

    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:
        if args or kwargs:
            original(self, *args, **kwargs)
            type(self).DRJIT_STRUCT = {name: type(getattr(self, name)) for name in fields if hasattr(self, name)}

    cls.__init__ = __init__  # type: ignore[misc]


# ------------------------------ Names ------------------------------


class _DrJit:
    """Dr.Jit with the names of version 0.2."""

    neq = staticmethod(lambda a, b: a != b)
    eq = staticmethod(lambda a, b: a == b)
    sqr = staticmethod(lambda a: dr.square(a))

    def backward_from(self, value: Any) -> None:
        """Accept values that depend on no parameter, such as an albedo without gradients."""
        dr.backward_from(value, flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)

    def __getattr__(self, name: str) -> Any:
        return getattr(dr, name)


class _Mitsuba:
    """Mitsuba with a registry of its own."""

    def __init__(self, registered: dict[str, Callable[[mi.Properties], Any]]) -> None:
        self.register_integrator = registered.__setitem__
        self.ad = SimpleNamespace(integrators=mi.ad.integrators, common=mi.ad.integrators.common)

    def __getattr__(self, name: str) -> Any:
        return getattr(mi, name)


def _single_medium(scene: mi.Scene) -> _Medium:
    shapes = scene.shapes()
    if len(shapes) != 1 or shapes[0].interior_medium() is None:
        raise PathreplayError(f"{len(shapes)} shapes: this integrator needs a single one, with a medium inside")
    return _Medium(shapes[0].interior_medium())


class _Phase:
    """A phase function with the interface of Mitsuba 3.0: the value is the density, and weights are 1."""

    def __init__(self, phase: mi.PhaseFunction) -> None:
        self.phase = phase

    def __setitem__(self, mask: mi.Bool, value: Any) -> None:
        """Ignore that inactive lanes get a null pointer: calls have masks."""

    def eval(self, ctx: mi.PhaseFunctionContext, mei: mi.MediumInteraction3f, wo: mi.Vector3f, active: mi.Bool) -> Any:
        return self.phase.eval_pdf(ctx, mei, wo, active)[1]

    def sample(self, ctx: mi.PhaseFunctionContext, mei: Any, u: mi.Float, v: mi.Point2f, active: mi.Bool) -> Any:
        wo, _, pdf = self.phase.sample(ctx, mei, u, v, active)
        return wo, pdf


class _Medium:
    """A `heterogeneous` medium with the interface of the branch of Mitsuba 3.0."""

    def __init__(self, medium: mi.Medium) -> None:
        self.medium = medium
        parts: dict[str, Any] = {}

        class Parts(mi.TraversalCallback):
            def put(self, name: str, value: Any, flags: Any, cpptype: Any = None) -> None:
                parts[name] = value

        medium.traverse(Parts())
        self.albedo = parts["albedo"]

    def phase_function(self) -> _Phase:
        return _Phase(self.medium.phase_function())

    def get_albedo(self, mei: mi.MediumInteraction3f, active: mi.Bool) -> mi.Spectrum:
        return self.albedo.eval(mei, active)

    def get_majorant(self, mei: mi.MediumInteraction3f, active: mi.Bool) -> mi.Spectrum:
        return self.medium.get_majorant(mei, active)

    def get_scattering_coefficients(self, mei: mi.MediumInteraction3f, active: mi.Bool) -> Any:
        return self.medium.get_scattering_coefficients(mei, active)

    def sample_interaction(self, ray: mi.Ray3f, u: mi.Float, channel: int, active: mi.Bool) -> Any:
        return self.medium.sample_interaction(ray, u, mi.UInt32(channel), active)

    @dr.syntax
    def sample_interaction_drt(self, ray: mi.Ray3f, sampler: mi.Sampler, channel: int, active: mi.Bool) -> Any:
        """Sample a point of the ray with a density proportional to an estimate of the transmittance up to it.

        Ratio tracking divides the ray into steps of constant estimated transmittance. A reservoir selects one of them
        in proportion to transmittance x length, and the point is uniform in the selected step.

        Returns:
            The interaction without coefficients, and the reciprocal of the density (times the transmittance).
        """
        inside, near, far = self.medium.intersect_aabb(ray)
        traversed = mi.Bool(active) & inside
        t = dr.select(traversed, dr.maximum(near, 0), 0)
        end = dr.minimum(far, ray.maxt)
        mei = dr.zeros(mi.MediumInteraction3f, dr.width(ray))
        mei.wi, mei.sh_frame = -ray.d, mi.Frame3f(-ray.d)
        mei.time, mei.wavelengths = ray.time, ray.wavelengths
        mei.mint = mi.Float(t)
        majorant = self.medium.get_majorant(mei, traversed)[channel]
        transmittance, total = mi.Float(1), mi.Float(0)
        start, length = mi.Float(t), mi.Float(0)
        going = mi.Bool(traversed)
        while dr.hint(going, label="transmittance reservoir"):
            free = -dr.log(1 - sampler.next_1d(going)) / majorant
            step = dr.minimum(free, end - t)
            weight = transmittance * step
            total += weight
            taken = sampler.next_1d(going) * total < weight
            start[taken] = t
            length[taken] = step
            t += free
            going &= t < end
            mei.t = mi.Float(t)
            mei.p = ray(t)
            sigma_t = dr.detach(self.medium.get_scattering_coefficients(mei, going)[2])
            transmittance[going] *= 1 - sigma_t[channel] / majorant
        chosen = start + sampler.next_1d(traversed) * length
        mei.t = dr.select(traversed & (chosen <= end), chosen, dr.inf)
        mei.p = ray(chosen)
        return mei, mi.Spectrum(total)
