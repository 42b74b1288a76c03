"""Find the sensors whose images can depend on a parameter."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import drjit as dr
import mitsuba as mi

from pathreplay.platform.traversal import known_values
from pathreplay.transport.facts.nodes import nodes_of


def reached_sensors(
    scene: mi.Scene, sensors: Sequence[mi.Sensor], params: mi.SceneParameters, keys: Iterable[str]
) -> list[bool]:
    """Return for each sensor whether its image can depend on one of the ``keys`` of ``params``.

    A parameter of a camera affects only the images of that camera. Any other parameter is assumed to affect all images,
    for example a parameter of a medium that a camera shares with a shape.
    """
    owners = {params.properties[key][2] for key in keys}
    below = {sensor: nodes_of(sensor) | {sensor} for sensor in {*scene.sensors(), *sensors}}
    others = (*scene.shapes(), *scene.emitters())
    if owners.difference(*below.values()) or any(not owners.isdisjoint(nodes_of(other)) for other in others):
        return [True] * len(sensors)
    return [not owners.isdisjoint(below[sensor]) for sensor in sensors]


def unreached_note(scene: mi.Scene, sensor: mi.Sensor) -> str:
    """Format the message that no parameter with gradients reaches the paths of a sensor.

    Returns "" if all parameters with gradients belong to other cameras. The gradient of this image is then zero.
    """
    params = mi.traverse(scene)
    with dr.resume_grad():
        keys = [key for key, value in known_values(params) if dr.grad_enabled(value)]
    if keys and not reached_sensors(scene, [sensor], params, keys)[0]:
        return ""
    named = ", ".join(f"'{key}'" for key in keys[:3]) + (" ..." if len(keys) > 3 else "")
    have = f"although {named} {'has' if len(keys) == 1 else 'have'} gradients" if keys else "and none has gradients"
    return (
        f"no parameter with gradients reaches the light paths of sensor '{sensor.id()}', {have}: check that the key is "
        "differentiable (mi.traverse(scene)), that params.update() was called after dr.enable_grad, and that attach is "
        "not 'none' if the parameter moves something"
    )
