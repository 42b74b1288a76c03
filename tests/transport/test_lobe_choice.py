"""BSDFs of the user that sample another delta lobe than the one they are asked for."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from page_code import blocks
from pathreplay.transport.facts.lobe_choice import LobeChoice
from places import ROOT
from truth import lit_room

PAGE = (ROOT / "docs" / "bsdfs.md").read_text(encoding="utf-8")
ETA = "object.bsdf.eta"


@pytest.fixture(autouse=True)
def _plugins() -> None:
    """The example of the page, and the same BSDF with a `sample` that ignores ctx, as in Mitsuba's tutorial."""
    names: dict[str, Any] = {}
    exec(next(block.code for block in blocks(PAGE, "python") if "TintedDielectric" in block.code), names)

    class Ignoring(names["TintedDielectric"]):
        def sample(self, ctx: mi.BSDFContext, *where: Any) -> Any:
            return names["TintedDielectric"].sample(self, mi.BSDFContext(), *where)

    mi.register_bsdf("ignoring", Ignoring)


@pytest.mark.parametrize(("plugin", "found"), [("ignoring", ("Ignoring 'glass'",)), ("tinted_dielectric", ())])
def test_a_bsdf_that_ignores_the_component_is_named_once_it_has_gradients(plugin: str, found: tuple[str, ...]) -> None:
    bsdf = mi.load_dict({"type": plugin, "id": "glass", "tint": [0.2, 0.9, 0.2]})
    choice = LobeChoice([bsdf])
    assert choice.find() == ()
    dr.enable_grad(mi.traverse(bsdf)["eta"])
    assert choice.find() == choice.find() == found


def test_weights_over_a_detached_probability_are_right_either_way(monkeypatch: pytest.MonkeyPatch) -> None:
    """The gradient by eta is that of the BSDF that obeys; the warning still names the one that does not."""
    told: list[str] = []
    gradients = []
    for plugin in ("tinted_dielectric", "ignoring"):
        scene = mi.load_dict(lit_room({"type": plugin, "tint": [0.2, 0.9, 0.2]}))
        integrator = mi.load_dict({"type": "pathreplay", "max_depth": 4, "boundary": "none"})
        monkeypatch.setattr(integrator, "_warn_once", told.append)
        params = mi.traverse(scene)
        dr.enable_grad(params[ETA])
        params.update()
        integrator.render_backward(scene, params, dr.ones(mi.TensorXf, (16, 16, 3)), seed=1, spp=4)
        gradients.append(np.array(dr.grad(params[ETA])))
    assert np.all(gradients[0] != 0)
    np.testing.assert_allclose(gradients[1], gradients[0], rtol=1e-4)
    assert [line.split(" ignores ")[0] for line in told if "BSDFContext.component" in line] == ["Ignoring 'bsdf'"]
