"""The two passes of the sweep drivers: record a path, and sweep back from its last vertex to the first."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import NonFiniteCounter, RayDerivative, backward_step
from pathreplay.adjoint.baseline import BaselineStats
from pathreplay.adjoint.null_branching import Branch
from pathreplay.adjoint.record import Layout, read_back, record, room_for
from pathreplay.samplers.sampler import Sampler
from pathreplay.transport.arrive import background
from pathreplay.transport.path import PathState
from pathreplay.transport.vertex import TraceConfig


@dr.syntax
def record_path(
    trace: TraceConfig,
    sampler: Sampler,
    path: PathState,
    layout: Layout,
    records: dr.Local[object],
    first: mi.UInt32,
    lost: NonFiniteCounter,
) -> tuple[dr.Local[object], mi.UInt32, mi.Spectrum, mi.Spectrum, Branch]:
    """Record a path; ``first`` is the index of its first record.

    Returns five values: the records, their number, the radiance L of the path, the radiance that arrives at the last
    recorded vertex from the environment, and the `Branch`. L includes the throughput, and the radiance from the
    environment does not. The radiance from the environment is zero unless ``layout.fixed``. ``lost`` counts the paths
    that were truncated because their record was full.

    All lanes of a packet must write to the same index. Otherwise Dr.Jit 1.5 loses writes to local memory.
    """
    trace = replace(trace, background_apart=layout.fixed)
    L, beyond = mi.Spectrum(0), mi.Spectrum(0)  # radiance of the path so far; radiance from the environment
    count = mi.UInt32(0)  # number of vertices and null boundaries
    branch, left = Branch.none(trace), mi.Bool(False)
    if dr.hint(trace.background_apart, mode="scalar"):
        path, left = path.leave()

    while dr.hint(path.active, exclude=[trace, layout, lost], label="pathreplay: record"):
        u, step = path.choose(trace, sampler)
        onward, v = path.advance(trace, u, step)
        records[first + count] = record(layout, v)
        if dr.hint(trace.branch, mode="scalar"):
            branch = branch.offer(path, step)
        L += path.β * step.e
        path = onward
        count += 1
        if dr.hint(trace.media is not None, mode="scalar"):
            full = path.active & (count >= room_for(trace))
            lost.add(full)
            path.active &= ~full
        if dr.hint(trace.background_apart, mode="scalar"):
            path, gone = path.leave()
            left |= gone

    if dr.hint(trace.background_apart, mode="scalar"):
        beyond = background(trace, path.at, left)
        L += path.β * beyond
    return records, count, L, beyond, branch


@dataclass
class RecordedPath:
    """Part of a recorded path: ``count`` consecutive vertices, stored from index ``first`` on."""

    layout: Layout
    records: dr.Local[object]
    first: mi.UInt32
    count: mi.UInt32
    last: mi.UInt32  # index of the last record of the whole path
    ray0: mi.Ray3f  # provides time and wavelengths


@dataclass
class PathAdjoint:
    """The state of the reverse pass: the radiance along the current ray, and adjoints."""

    δL: mi.Spectrum  # adjoint of the radiance of the path
    L: mi.Spectrum  # radiance along the ray
    q: RayDerivative  # adjoint of the ray; zero where the path ends


@dr.syntax
def sweep_path(
    trace: TraceConfig,
    path: RecordedPath,
    adjoint: PathAdjoint,
    lost: NonFiniteCounter,
    seen: BaselineStats | None = None,
    rays_only: bool = False,
) -> PathAdjoint:
    """Back-propagate from the last recorded vertex to the first.

    ``adjoint`` refers to the ray that leaves the last vertex, and the result to the ray that arrives at the first
    vertex. With ``rays_only``, no parameter receives a gradient.
    """
    layout, records, first, count, last = path.layout, path.records, path.first, path.count, path.last
    ray0, δL, L, q = path.ray0, adjoint.δL, adjoint.L, adjoint.q
    broken = mi.Bool(False)  # the adjoint of a ray was not finite

    while dr.hint(count > 0, exclude=[trace, layout, ray0, lost, seen, rays_only], label="pathreplay: sweep"):
        count -= 1
        v = read_back(layout, records, first + count, last, ray0)
        L, q, breaks = backward_step(trace, v, layout.moves, δL, L, q, mi.Bool(True), rays_only)
        if dr.hint(seen is not None, mode="scalar"):
            seen.learn(v, L)  # type: ignore[union-attr]
        if dr.hint(layout.moves, mode="scalar"):
            lost.add(breaks & ~broken)
            broken |= breaks

    return PathAdjoint(δL, L, q)
