"""What is decided by the device that kernels run on, held against devices that are made up: no GPU is needed."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from media_scenes import cloud, heterogeneous, smooth
from pathreplay import PathreplayError
from pathreplay.adjoint import record
from pathreplay.adjoint.record import LARGEST_RECORD, Layout, deepest, largest_record, record_type, room_for
from pathreplay.integrators import interior
from pathreplay.integrators.film import pixel_passes as pixels
from pathreplay.platform import device
from pathreplay.platform.device import Device

H100 = Device("cuda", "NVIDIA H100 80GB HBM3", 2048 * 132, 80 * 10**9)
LAPTOP = Device("cuda", "GeForce", 1536 * 20, 4 * 10**9)
UNKNOWN, PROCESSOR = Device("cuda"), Device("llvm")
KEY = "ball.bsdf.reflectance.value"


def room() -> mi.Scene:
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    look = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    return mi.load_dict(
        {
            "type": "scene",
            "light": {"type": "constant"},
            "sensor": {"type": "perspective", "to_world": look, "film": film},
            "ball": {"type": "sphere", "bsdf": {"type": "diffuse"}},
        }
    )


def walk_of(scene: mi.Scene, max_depth: int = 6) -> Any:
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": max_depth})
    return integrator._trace_config(scene, scene.sensors()[0])


@pytest.fixture
def pretend(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Makes the kernels' device one that is made up."""

    def be(made_up: Device) -> None:
        for module in (record, interior, pixels):
            monkeypatch.setattr(module, "device_of", lambda variant: made_up)

    return be


@pytest.mark.parametrize("media", [False, True])
def test_the_size_of_a_record_is_that_of_its_type(media: bool) -> None:
    trace = walk_of(mi.load_dict(cloud(heterogeneous(smooth(0.5, 3), 0.8))) if media else room())
    sizes = []
    for moves in (False, True):
        kind = record_type(Layout.of(trace, moves))
        blank = {name: dr.zeros(field.type) for name, field in kind.__dataclass_fields__.items()}
        sizes.append(sum(4 * len(np.ravel(np.array(value))) for value in blank.values()))
    print(f"{sizes} bytes a vertex")
    assert largest_record(trace) == max(sizes) <= (210 if media else LARGEST_RECORD)


@pytest.mark.parametrize(
    ("made_up", "media", "told"), [(H100, False, 462), (H100, True, 133), (LAPTOP, False, 262), (LAPTOP, True, 74)]
)
def test_the_deepest_sweep_is_the_last_that_keeps_its_share(made_up: Device, media: bool, told: int) -> None:
    """Depths that the docs tell: the H100's by the stack of a thread, the laptop's by its memory."""
    scene = mi.load_dict(cloud(heterogeneous(smooth(0.5, 3), 0.8))) if media else room()
    most = deepest(walk_of(scene), made_up)
    assert most == told < deepest(walk_of(scene), PROCESSOR)
    held, more = (largest_record(walk_of(scene)) * room_for(walk_of(scene, depth)) for depth in (most, most + 1))
    assert held <= min(device.LARGEST_LOCAL, device.SHARE * made_up.memory / made_up.lanes) < more


def test_what_cannot_be_asked_has_the_stack_of_a_thread() -> None:
    trace = walk_of(room())
    assert deepest(trace, UNKNOWN) == deepest(trace, H100) < deepest(trace, PROCESSOR) == record.MAX_DEPTH
    assert PROCESSOR.keeps_order and not H100.keeps_order


def gradient(integrator: mi.Integrator, scene: mi.Scene | None = None) -> np.ndarray:
    scene = scene or room()
    params = mi.traverse(scene)
    dr.enable_grad(params[KEY])
    dr.clear_grad(params[KEY])
    params.update()
    integrator.render_backward(scene, params, dr.ones(mi.TensorXf, (4, 4, 3)), seed=3, spp=16)
    return np.array(dr.grad(params[KEY])).ravel()


def test_auto_walks_twice_where_records_would_take_too_much_and_says_so_once(
    pretend: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    recorded = gradient(mi.load_dict({"type": "pathreplay", "max_depth": 1500}))
    pretend(H100)
    capfd.readouterr()
    ours = mi.load_dict({"type": "pathreplay", "max_depth": 1500})
    scene = room()
    for _ in range(2):
        np.testing.assert_allclose(gradient(ours, scene), recorded, rtol=1e-4)
    told = capfd.readouterr().out
    assert told.count("paths are replayed instead") == 1
    assert "records of 1500 vertices per thread do not fit into the memory of NVIDIA H100" in told
    most = deepest(walk_of(room()), H100)
    assert f"up to max_depth = {most} they are recorded" in told
    assert ours.interior._sweeps(walk_of(room(), most)) and not ours.interior._sweeps(walk_of(room(), most + 1))


def test_what_must_be_recorded_is_refused_before_anything_is_launched(pretend: Any) -> None:
    pretend(LAPTOP)
    most = deepest(walk_of(room()), LAPTOP)
    with pytest.raises(PathreplayError, match=rf"more than adjoint = 'recorded' can hold \({most}\)"):
        gradient(mi.load_dict({"type": "pathreplay", "max_depth": 1500, "adjoint": "recorded"}))


def test_pixels_are_swept_where_a_lane_holds_their_paths(pretend: Any) -> None:
    scene, ours = room(), mi.load_dict({"type": "pathreplay", "max_depth": 8})
    assert ours.supports_pixel_sweep(scene, 0, 128)
    pretend(LAPTOP)
    most = LAPTOP.most_records(LARGEST_RECORD, record.MAX_DEPTH) // device.FEWEST_RECORDS
    assert ours.supports_pixel_sweep(scene, 0, most) and not ours.supports_pixel_sweep(scene, 0, most + 1)
    assert 1 < most < 128
