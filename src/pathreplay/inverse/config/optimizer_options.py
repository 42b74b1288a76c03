"""Options of optimisers, as a job gives them: which there are, and what they are if none is given."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import model_validator

from pathreplay.inverse.config.tables import Count, Positive, Share, Switch, Table


class Optimizer(Table):
    """An optimiser of Dr.Jit's by ``type``, or SciPy's L-BFGS-B, with its options; None: as `DEFAULTS` has it.

    Those of Dr.Jit's have its names. ``weight_decay`` pulls towards zero what is stepped (with a transform, that is not
    the value itself).
    """

    type: Literal["adam", "adamw", "sgd", "rmsprop", "l-bfgs-b"] = "adam"
    """Optimiser of drjit.opt, or SciPy's L-BFGS-B."""
    beta_1: Share | None = None
    """Decay of the mean of gradients (Adam, AdamW)."""
    beta_2: Share | None = None
    """Decay of the mean of squared gradients (Adam, AdamW)."""
    epsilon: Positive | None = None
    """Added to the root of the second moment (Adam, AdamW, RMSProp)."""
    uniform: Switch | None = None
    """Scale all entries of a variable alike (UniformAdam)."""
    amsgrad: Switch | None = None
    """Use the largest second moment so far."""
    weight_decay: Positive | None = None
    """Pull towards zero in the space of the steps (AdamW)."""
    momentum: Share | None = None
    """Momentum of SGD."""
    nesterov: Switch | None = None
    """Nesterov's momentum (SGD)."""
    alpha: Share | None = None
    """Decay of the mean of squared gradients (RMSProp)."""
    history_size: Count | None = None
    """Corrections that L-BFGS keeps."""
    tolerance: Positive | None = None
    """L-BFGS ends when the loss falls by less than this fraction of the first."""

    @model_validator(mode="after")
    def _of_its_type(self) -> Optimizer:
        known = DEFAULTS[self.type]
        if wrong := self.model_fields_set - set(known) - {"type"}:
            raise ValueError(
                f"optimizer: '{min(wrong)}' is no option of type = '{self.type}', which has {', '.join(known)}; "
                "leave it out, or take another type"
            )
        if self.nesterov and not self.momentum:
            raise ValueError("optimizer: 'nesterov' wants momentum; add momentum = 0.9, or leave it out")
        return self

    @property
    def searches(self) -> bool:
        """Whether it compares losses of iterations, which all see the same noise then."""
        return self.type == "l-bfgs-b"

    def options(self) -> dict[str, Any]:
        """All of its type, those that were not given included."""
        return DEFAULTS[self.type] | self.model_dump(exclude={"type"}, exclude_none=True)


_ADAM = {
    "beta_1": 0.9,
    # The second moment remembers about 1 / (1 - beta_2) steps. Its usual 0.999 outlasts a whole run of a few hundred.
    "beta_2": 0.99,
    "epsilon": 1e-8,
    "uniform": False,
    "amsgrad": False,
}
DEFAULTS: dict[str, dict[str, Any]] = {
    "adam": _ADAM,
    "adamw": {**_ADAM, "weight_decay": 0.01},
    "sgd": {"momentum": 0.0, "nesterov": False},
    "rmsprop": {"alpha": 0.99, "epsilon": 1e-8},
    # The tolerance is a share of the first loss. Below, falls are lost in the rounding of single precision.
    "l-bfgs-b": {"history_size": 10, "tolerance": 1e-6},
}
