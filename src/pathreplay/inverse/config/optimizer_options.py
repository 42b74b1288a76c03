"""Optimisers of a job, their options, and default values of the options."""

from __future__ import annotations

from typing import Literal

from pydantic import model_validator

from pathreplay.inverse.config.tables import Count, Positive, Share, Switch, Table
from pathreplay.types import Json


class Optimizer(Table):
    """An optimiser and its options. An option that is None has its value in `DEFAULTS`.

    The options of Dr.Jit's optimisers have the names that Dr.Jit gives them. ``weight_decay`` acts on the variable in
    which the optimiser takes its steps. If the parameter has a ``parameterization``, this variable is not the value of
    the parameter.
    """

    type: Literal["adam", "adamw", "sgd", "rmsprop", "l-bfgs-b", "levenberg-marquardt"] = "adam"
    """Optimiser of drjit.opt, SciPy's L-BFGS-B, or Levenberg-Marquardt for up to 200 numbers."""
    iterate_averaging: Switch | None = None
    """Lower the noise of the result by a mean of recent iterates, except for values that still move steadily (Adam,
    AdamW, SGD, RMSProp; default: true)."""
    beta_1: Share | None = None
    """Decay rate of the first moment (Adam, AdamW)."""
    beta_2: Share | None = None
    """Decay rate of the second moment (Adam, AdamW)."""
    epsilon: Positive | None = None
    """Constant added to the square root of the second moment (Adam, AdamW, RMSProp)."""
    uniform: Switch | None = None
    """Normalise all entries of a variable by their largest second moment (UniformAdam)."""
    amsgrad: Switch | None = None
    """Use the maximum of all second moments so far (AMSGrad)."""
    weight_decay: Positive | None = None
    """Decoupled weight decay of the variable in which the optimiser takes its steps (AdamW)."""
    momentum: Share | None = None
    """Momentum (SGD)."""
    nesterov: Switch | None = None
    """Use Nesterov momentum (SGD)."""
    alpha: Share | None = None
    """Decay rate of the second moment (RMSProp)."""
    history_size: Count | None = None
    """Number of corrections that L-BFGS-B keeps."""
    tolerance: Positive | None = None
    """Stopping threshold as a fraction of the initial loss. L-BFGS-B stops when a step lowers the loss by less than
    this. Levenberg-Marquardt stops when the remaining noise of the recovered values raises the loss by less than this
    (default: never)."""
    damping: Positive | None = None
    """Initial damping of Levenberg-Marquardt, relative to the diagonal of the Gauss-Newton matrix."""

    @model_validator(mode="after")
    def _of_its_type(self) -> Optimizer:
        known = DEFAULTS[self.type]
        if wrong := self.model_fields_set - set(known) - {"type"}:
            raise ValueError(
                f"optimizer: '{min(wrong)}' is not an option of type = '{self.type}', which has {', '.join(known)}; "
                "remove it, or use another type"
            )
        if self.nesterov and not self.momentum:
            raise ValueError("optimizer: 'nesterov' needs momentum; add momentum = 0.9, or remove 'nesterov'")
        return self

    @property
    def searches(self) -> bool:
        """Whether the optimiser compares losses of different iterations.

        All iterations of such an optimiser use the same random numbers, so that their losses are comparable.
        """
        return self.type in ("l-bfgs-b", "levenberg-marquardt")

    @property
    def is_second_order(self) -> bool:
        """Whether the optimiser needs the Gauss-Newton model of the loss."""
        return self.type == "levenberg-marquardt"

    def options(self) -> Json:
        """Return all options of this type of optimiser, with default values for options that are not given."""
        return DEFAULTS[self.type] | self.model_dump(exclude={"type"}, exclude_none=True)


_ADAM = {
    "beta_1": 0.9,
    # The second moment averages over about 1 / (1 - beta_2) steps. With the usual value of 0.999, these are more steps
    # than most runs have.
    "beta_2": 0.99,
    "epsilon": 1e-8,
    "uniform": False,
    "amsgrad": False,
    "iterate_averaging": True,
}
DEFAULTS: dict[str, dict[str, float | bool]] = {
    "adam": _ADAM,
    "adamw": {**_ADAM, "weight_decay": 0.01},
    "sgd": {"momentum": 0.0, "nesterov": False, "iterate_averaging": True},
    "rmsprop": {"alpha": 0.99, "epsilon": 1e-8, "iterate_averaging": True},
    # The tolerance is relative to the initial loss. Smaller decreases are within the rounding error of float32.
    "l-bfgs-b": {"history_size": 10, "tolerance": 1e-6},
    "levenberg-marquardt": {"damping": 1e-2, "tolerance": 0.0},
}
