"""The replay driver: sample a path again with the same random numbers, and subtract the radiance of each vertex.

This is path replay backpropagation (Vicini, Speierer, Jakob 2021). The first pass stores only the radiance L_0 of the
path. The second pass subtracts from L_0 the contributions of the vertices that it has visited. The remainder is the
radiance from the rest of the path. Memory does not depend on depth. If the path moves with the parameters,
`replay_attached` recovers the adjoint of the ray as well.
"""

from __future__ import annotations

from functools import cache

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import NonFiniteCounter, backward
from pathreplay.adjoint.null_branching import Branch, branch_backward
from pathreplay.adjoint.primal import path_radiance
from pathreplay.adjoint.ray_jacobian import Recovery, has_smooth_lobes
from pathreplay.adjoint.record import deepest
from pathreplay.adjoint.replay_attached import replay_attached
from pathreplay.errors import PathreplayError
from pathreplay.transport.motion import along_moving_paths, path_moves
from pathreplay.transport.path import PathState
from pathreplay.transport.start import CameraStart
from pathreplay.transport.step import repeat_step
from pathreplay.transport.vertex import TraceConfig, reciprocal


def replay(
    trace: TraceConfig,
    start: CameraStart,
    δL: mi.Spectrum,
    lost: NonFiniteCounter,
    recovery: Recovery = Recovery(),  # noqa: B008 (it is frozen)
) -> bool:
    """Back-propagate the adjoint radiance ``δL`` into the parameters and into the ``start``.

    Returns whether the path moves with the parameters. If the path moves, ``recovery`` describes how ray adjoints are
    recovered, and ``lost`` counts the paths with a non-finite ray adjoint. If paths move in a scene with smooth lobes,
    a warning is logged once. Not differentiated: visibility and, with ``attach='none'``, all motion. Weights that are
    exactly zero are not differentiated either; the sweep driver differentiates such weights. Raises PathreplayError if
    a path moves in a scene with media.
    """
    # With null branching, paths continue after a zero weight, as in the sweep driver. The extra path of null branching
    # then has the same random numbers in both drivers.
    path = PathState.begin(trace, start, sustained=trace.branch)
    moves = path_moves(trace, start, path.at)
    if not moves:
        _replay_still(trace, start, path, δL)
    elif trace.media is not None:
        raise PathreplayError(
            "adjoint = 'replay' does not support parameters that move paths in scenes with media: use "
            f"adjoint = 'recorded', with max_depth of at most {deepest(trace)}"
        )
    else:
        if has_smooth_lobes(trace):
            _warn_of_smooth_lobes()
        replay_attached(along_moving_paths(trace, moves), start, path, δL, lost, recovery)
    return moves


@cache
def _warn_of_smooth_lobes() -> None:
    """Warn once per process that the noise of the gradient grows with every smooth bounce."""
    mi.Log(
        mi.LogLevel.Warn,
        "pathreplay: adjoint = 'replay' follows moving paths over smooth BSDFs, where the Jacobian of the ray is "
        "singular: added noise keeps the gradient unbiased, but its variance grows with every such bounce. "
        "adjoint = 'recorded' has no such limit, and is faster",
    )


@dr.syntax
def _replay_still(trace: TraceConfig, start: CameraStart, path: PathState, δL: mi.Spectrum) -> None:
    """Replay a path that does not move with the parameters.

    At each vertex, β_{i+1} L_{i+1} = β_i L_i - β_i e_i is known. A change dw_i of the weight changes the radiance by
    β_{i+1} L_{i+1} dw_i / w_i.
    """
    sampler, ray0 = start.sampler, path.at.ray
    L = path_radiance(trace, sampler.clone(), dr.copy(path))[0]  # β_i L_i, updated at each vertex
    branch = Branch.none(trace)

    while dr.hint(path.active, exclude=[trace], label="pathreplay: replay"):
        u, step = path.choose(trace, sampler)
        L -= path.β * step.e
        if dr.hint(trace.branch, mode="scalar"):
            branch = branch.offer(path, step)

        onward, v = path.advance(trace, u, step)
        with dr.resume_grad():
            again = repeat_step(trace, v, False, path.active)
            Lo = path.β * again.e + L * again.w * dr.detach(reciprocal(again.w))
            backward(dr.sum(δL * Lo))
        path = onward

    if dr.hint(trace.branch, mode="scalar"):
        branch_backward(trace, branch, sampler, ray0, δL)
