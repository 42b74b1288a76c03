"""`gridmedium`: Mitsuba's `heterogeneous` with emission, a differentiable scale, and local majorants.

With V, A and Q the volumes `sigma_t`, `albedo` and `emission`, and s the `scale`,

    σ_t = s V(x),   σ_s = A(x) σ_t,   emitted radiance per unit length = Q(x)   (Q is not scaled) .

If the volume `radiance`, B, is given instead of `emission`, then Q(x) = σ_t B(x). An optically thick medium without
scattering then emits the radiance B.

Mitsuba's integrators use a global majorant and ignore the emission. The integrators of this package call `free_flight`
(local majorants), `transmittance` (residual ratio tracking) and `emission_at`.

The coefficients and the emission are differentiable with respect to V, A, Q, B, s and the position. Majorants,
free-flight distances and the transmittance estimate are detached. The bounding box and the `to_world` of volumes are
*not* differentiated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.platform.device import device_of
from pathreplay.platform.properties import Property
from pathreplay.plugins import grid_traversal
from pathreplay.plugins.supergrid import (
    Bounds,
    all_bounds,
    cheapest,
    constant_bounds,
    find_lattice,
    mean_chord,
    voxel_bounds,
)

#: Half the side of the cube that a `constvolume` fills if a property is given as a number. The cube is larger than any
#: scene, and its coordinates do not overflow. Without a transform, a `constvolume` fills only the unit cube.
FAR = 1e6
#: First and last wavelength (nm) and number of wavelengths of the search for the maximum of a spectrum. Mitsuba returns
#: the mean instead of the maximum of a spectrum that it has made from a colour.
WAVELENGTHS = 360, 830, 512
#: Ratio of the bound to the maximum that was found. Spectra of colours are smooth.
ABOVE = 1.01


SIGMA_T = Property(
    "sigma_t", "volume or float", 1.0, "Extinction per unit length, at least 0.", differentiable="sigma_t.…"
)
SCALE = Property("scale", "float", 1.0, "Factor of `sigma_t`.", differentiable="scale")
ALBEDO = Property(
    "albedo",
    "volume or spectrum",
    0.75,
    "Fraction of the extinction that scatters.",
    differentiable="albedo.…",
)
EMISSION = Property(
    "emission",
    "volume or spectrum",
    None,
    "Radiance emitted per unit length, which `scale` does not scale. Absent: no emission.",
    differentiable="emission.…",
)
RADIANCE = Property(
    "radiance",
    "volume or spectrum",
    None,
    "In place of `emission`: radiance emitted per unit of optical depth, which is the radiance of a thick medium.",
    differentiable="radiance.…",
)
SUPERGRID = Property(
    "supergrid",
    "string or boolean",
    "auto",
    "Local majorants in the cells of a coarse grid, or one global majorant. `auto` selects the cheapest cell size.",
    ("auto", True, False),
)
PHASE = Property(
    "(nested plugin)",
    "phase function",
    None,
    "Any phase function except microflakes (SGGX), which are refused. Absent: isotropic.",
    differentiable="phase_function.…",
)


class GridMedium:
    """A heterogeneous medium on grids, with local majorants. `on_base` combines this template with `mi.Medium`."""

    properties = (SIGMA_T, SCALE, ALBEDO, EMISSION, RADIANCE, SUPERGRID, PHASE)
    phase_function: Callable[[], mi.PhaseFunction]  # a method of `mi.Medium`

    def __init__(self, props: mi.Properties) -> None:
        mi.Medium.__init__(self, props)
        phase = self.phase_function()
        if mi.has_flag(phase.flags(), mi.PhaseFunctionFlags.Microflake):
            raise PathreplayError(
                f"gridmedium: with the phase function {phase.class_name()} the density depends on the "
                "direction, which majorants do not support; use Mitsuba's heterogeneous"
            )
        self.sigma_t = _volume(props, SIGMA_T)
        self.albedo = _volume(props, ALBEDO)
        self.emission_per_extinction = RADIANCE.name in props
        if self.emission_per_extinction and EMISSION.name in props:
            raise PathreplayError("gridmedium: emission and radiance are both given; remove one of them")
        self.emission = _volume(props, RADIANCE if self.emission_per_extinction else EMISSION)
        self.scale = mi.Float(_number(props, SCALE))
        self.supergrid = _choice(props)
        self.m_is_homogeneous = False
        self.parameters_changed([])
        lowest = dr.min(self.levels[-1].lowest)[0]
        if lowest < 0:
            raise PathreplayError(f"gridmedium: sigma_t is {lowest:g} somewhere; give densities of at least 0")

    # ------------------------------------------------ parameters ------------------------------------------------

    def traverse(self, cb: mi.TraversalCallback) -> None:
        for name in ("scale", "albedo", "sigma_t"):
            cb.put(name, getattr(self, name), mi.ParamFlags.Differentiable)
        if self.emission is not None:
            cb.put(
                "radiance" if self.emission_per_extinction else "emission", self.emission, mi.ParamFlags.Differentiable
            )
        cb.put("phase_function", self.phase_function(), mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str]) -> None:
        if keys and "sigma_t" not in keys and "scale" not in keys:
            return
        dr.make_opaque(self.scale)  # a literal is a kernel constant: every update would recompile the kernel
        with dr.suspend_grad():
            if not keys or "sigma_t" in keys:
                self.box = self.sigma_t.bbox()
                self.is_chromatic, self.levels = _look(self.sigma_t, self.supergrid is True)
                self.m_has_spectral_extinction = self.is_chromatic
            self._choose_cells()

    def _choose_cells(self) -> None:
        """Build a table of majorants and a table of control densities for the current scale.

        Each table has the cell size that is cheapest for its purpose.
        """
        scale = dr.detach(self.scale)
        # Emission and the derivative of in-scattering are estimated at tentative collisions. Empty cells therefore also
        # need tentative collisions. Their majorant is the inverse of the mean chord length of the box, which gives one
        # tentative collision on average along a ray of this length.
        with dr.resume_grad():
            params = mi.traverse(self.sigma_t)
            moves = dr.grad_enabled(self.scale) or any(dr.grad_enabled(params[key]) for key in params.keys())
        chord = mean_chord(self.box)
        least = 1 / chord if chord > 0 and (moves or self.emission is not None) else 0.0
        majorants = [(dr.maximum(grid_traversal.majorants(level, scale), least),) for level in self.levels]
        self.flight_cells = self._cheapest_cells(majorants)
        self.shadow_cells = self._cheapest_cells([grid_traversal.control(level, scale) for level in self.levels])
        self.majorant = mi.Float(majorants[-1][0])
        dr.make_opaque(self.majorant)

    def _cheapest_cells(self, values: Sequence[tuple[mi.Float, ...]]) -> grid_traversal.Cells:
        """Return the cells of the cheapest level in ``self.levels``, with the values of this level.

        ``values`` has one tuple per level. The last entry of a tuple contains the collision rates of the cells.
        """
        rates = [dr.mean(numbers[-1]) for numbers in values]
        dr.eval(values, rates)
        last = len(values) - 1
        first = last if self.supergrid is False else 0
        last = max(last - 1, 0) if self.supergrid is True else last
        allowed = slice(first, last + 1)
        collisions = [float(rate[0]) for rate in rates[allowed]]
        chosen = first + cheapest(self.levels[allowed], collisions, mean_chord(self.box))
        return grid_traversal.make_cells(self.levels[chosen], values[chosen])

    @property
    def constants(self) -> tuple[object, ...]:
        """Values that kernels treat as constants. A recorded kernel becomes invalid if one of them changes."""
        cells = self.flight_cells, self.shadow_cells
        box = *map(float, self.box.min), *map(float, self.box.max)
        return self.is_chromatic, box, *((table.shape, tuple(table.to_cell.ravel().tolist())) for table in cells)

    def to_string(self) -> str:
        lines = [f"sigma_t = {self.sigma_t}", f"albedo = {self.albedo}", f"emission = {self.emission}"]
        cells = " x ".join(str(n - 2) for n in self.flight_cells.shape)
        lines += [f"scale = {self.scale}", f"cells = {cells}"]
        return "GridMedium[\n  " + ",\n".join(lines).replace("\n", "\n  ") + "\n]"

    # ---------------------------------------- interface of Mitsuba's media ----------------------------------------

    def get_majorant(self, mei: mi.MediumInteraction3f, active: mi.Bool | bool = True) -> mi.UnpolarizedSpectrum:
        return mi.UnpolarizedSpectrum(self.majorant)

    def get_scattering_coefficients(
        self, mei: mi.MediumInteraction3f, active: mi.Bool | bool = True
    ) -> tuple[mi.Spectrum, mi.Spectrum, mi.Spectrum]:
        σ_t = self.scale * self.sigma_t.eval(mei, active)
        return σ_t * self.albedo.eval(mei, active), self.majorant - σ_t, σ_t

    def intersect_aabb(self, ray: mi.Ray3f) -> tuple[mi.Bool, mi.Float, mi.Float]:
        near, far = grid_traversal.through(self.box, ray)
        return near <= far, near, far

    # ------------------------------------------ interface of pathreplay ------------------------------------------

    def free_flight(self, ray: mi.Ray3f, u: mi.Float, active: mi.Bool | bool = True) -> tuple[mi.Float, mi.Float]:
        """Sample the distance to the next tentative collision. Return the distance and the local majorant, detached.

        The distance t solves ∫_0^t m ds = -log(1 - u), with ``u`` in [0, 1). The local majorant m is at least σ_t in
        all channels, and 0 outside the medium's bounding box. If there is no solution below ray.maxt, the distance is
        infinite and the majorant 0.
        """
        with dr.suspend_grad():
            return grid_traversal.free_flight(self.flight_cells, self.box, dr.detach(ray), dr.detach(u), active)

    def transmittance(
        self, ray: mi.Ray3f, sampler: mi.Sampler, active: mi.Bool | bool = True
    ) -> mi.UnpolarizedSpectrum:
        """Return an unbiased estimate of exp(-∫_0^{ray.maxt} σ_t ds) for each channel. The estimate is detached."""
        with dr.suspend_grad():
            ray, scale = dr.detach(ray), dr.detach(self.scale)

            def density(t: mi.Float, active: mi.Bool) -> mi.UnpolarizedSpectrum:
                at = dr.zeros(mi.Interaction3f)
                at.p, at.time, at.wavelengths = ray(t), ray.time, ray.wavelengths
                return scale * dr.detach(self.sigma_t.eval(at, active))

            return grid_traversal.transmittance(self.shadow_cells, self.box, ray, density, sampler, active)

    def emission_at(self, mei: mi.MediumInteraction3f, active: mi.Bool | bool = True) -> mi.UnpolarizedSpectrum:
        """Return the radiance emitted per unit length at an interaction. The result is 0 without emission.

        If ``emission_per_extinction`` is set, the result is the radiance emitted per unit of optical depth instead.
        """
        return mi.UnpolarizedSpectrum(0) if self.emission is None else self.emission.eval(mei, _recordable(active))


def _recordable(active: mi.Bool | bool) -> mi.Bool | bool:
    """Return the mask for a volume lookup that a frozen function may record outside of a virtual call.

    On a GPU the mask is True, so that all lanes look up the volume. For masked lanes, Dr.Jit 1.5 replaces the texture
    by a null pointer. When a frozen function records a kernel with this pointer, Dr.Jit aborts the process.
    """
    return True if device_of(mi.variant()).is_gpu else active


# ---------------------------------------------- reading the properties ----------------------------------------------


def _volume(props: mi.Properties, declared: Property[object]) -> Any:
    """Read a volume, or return None. Textures, colours and numbers become a very large `constvolume`."""
    name = declared.name
    value = props[name] if name in props else declared.default
    if value is None or isinstance(value, mi.Volume):
        return value
    if isinstance(value, (str, bool)) or (isinstance(value, mi.Object) and not isinstance(value, mi.Texture)):
        raise PathreplayError(f"gridmedium: {name} is {value!r:.40}; give a volume, a colour or a number")
    constant = mi.Properties("constvolume")
    constant["value"] = value
    constant["to_world"] = mi.ScalarTransform4f().scale(2 * FAR).translate(-0.5)
    return mi.PluginManager.instance().create_object(constant)


def _number(props: mi.Properties, declared: Property[object]) -> float:
    value = props.get(declared.name, declared.default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value < float("inf"):
        raise PathreplayError(f"gridmedium: {declared.name} is {value}; give a finite number, at least 0")
    return float(value)


def _choice(props: mi.Properties) -> bool | str:
    value = props.get(SUPERGRID.name, SUPERGRID.default)
    if value != "auto" and not isinstance(value, bool):
        raise PathreplayError(f"gridmedium: supergrid is {value!r}; use true, false or 'auto'")
    return value


# ----------------------------------------------- bounds of the density -----------------------------------------------


def _look(volume: mi.Volume, needs_grid: bool) -> tuple[bool, list[Bounds]]:
    """Return whether the channels of a volume may differ, and bounds of the volume's values.

    The bounds are a list with one `Bounds` object per cell size, from the smallest to the largest cells.
    """
    params = mi.traverse(volume)
    values = [dr.detach(params[key]) for key in params.keys()]
    if volume.class_name() == "GridVolume":
        channels = values[0].shape[-1]
        if channels not in (1, 3, 4):
            raise PathreplayError(f"gridmedium: sigma_t has {channels} channels; give a grid with 1 or 3")
        if (lattice := find_lattice(volume, values[0].shape)) is not None:
            return channels > 1 and not mi.is_monochromatic, all_bounds(voxel_bounds(lattice, values[0]))
    if needs_grid:
        raise PathreplayError(
            f"gridmedium: sigma_t ({volume.class_name()}) has no accessible voxels; give a gridvolume, or leave "
            "supergrid at 'auto'"
        )
    grey = all(dr.is_diff_v(value) and not dr.is_vector_v(value) and dr.width(value) == 1 for value in values)
    lowest, highest = 0.0, float(volume.max())
    if volume.class_name() == "ConstVolume" and not mi.is_spectral:
        here = dr.detach(volume.eval(dr.zeros(mi.Interaction3f)))
        lowest, highest = float(dr.min(here)[0]), float(dr.max(here)[0])
    grey = mi.is_monochromatic or (bool(values) and grey)
    if volume.class_name() == "ConstVolume" and mi.is_spectral and not grey:
        highest = max(highest, ABOVE * _largest_in_spectrum(volume))
    return not grey, [constant_bounds(volume, lowest, (lowest + highest) / 2, highest)]


def _largest_in_spectrum(volume: mi.Volume) -> float:
    """Return the largest value of a volume without spatial variation, at the wavelengths of `WAVELENGTHS`."""
    λ = dr.linspace(mi.Float, *WAVELENGTHS)
    at = dr.zeros(mi.Interaction3f, dr.width(λ))
    at.wavelengths = type(at.wavelengths)(λ)
    return float(dr.max(dr.detach(volume.eval(at)), axis=None)[0])
