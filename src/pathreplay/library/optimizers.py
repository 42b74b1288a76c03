"""Adapters for optimisers of `mitsuba.ad`, objects with a step method, and functions like `scipy.optimize.minimize`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError, shown
from pathreplay.inverse.config.optimizer_options import DEFAULTS, Optimizer
from pathreplay.inverse.loop.loop import optimiser_of
from pathreplay.inverse.optim.adaptive import Optimiser, State
from pathreplay.inverse.parameters.exposures import EXPOSURE
from pathreplay.inverse.parameters.pose import PART_NAMES
from pathreplay.inverse.parameters.response import RESPONSE
from pathreplay.inverse.parameters.values import Array, Arrays
from pathreplay.inverse.parameters.variables import latents
from pathreplay.inverse.problem.problem import Problem
from pathreplay.platform.owned_arrays import with_space
from pathreplay.scenes.parameters import resolve_keys
from pathreplay.types import Json


class Stepper(Protocol):
    """An optimiser object of the user.

    Runs can be resumed if the object also has ``state_dict()``, which returns arrays by name, and
    ``load_state_dict(arrays)``.
    """

    def step(
        self, values: Arrays, gradients: Arrays, learning_rates: Mapping[str, float], loss: float
    ) -> Mapping[str, Array]:
        """Return the values after a step: arrays by name, in the shapes of ``values``."""


class OfMitsuba(Optimiser):
    """`Optimiser` that is an object of `mitsuba.ad` or `drjit.opt`.

    Parameters with a learning rate of their own use it. Other parameters use the optimiser's learning rate, to which
    the schedule and the stages of the problem apply as well.
    """

    def __init__(self, optimizer: Any, values: Arrays, problem: Problem) -> None:
        if any(True for _ in optimizer.keys()):
            raise PathreplayError("optimizer: it already has variables; give an optimizer without variables")
        self._optimizer, self._steps = optimizer, dict.fromkeys(values, 0)
        self.use(problem)
        for key, value in values.items():
            optimizer[key] = mi.TensorXf(with_space(value))

    def use(self, problem: Problem) -> None:
        """Take the learning rates of this problem, before schedule and stages, for the next steps."""
        self._own = _rated(problem)
        self._problem_rates = {v.key: v.learning_rate for v in problem.variables}

    def step(
        self, values: Arrays, gradients: Arrays, rates: Mapping[str, float], loss: float = 0.0
    ) -> dict[str, Array]:
        optimizer = self._optimizer
        known = optimizer.state
        for key, value in values.items():
            anew = optimizer[key].shape != value.shape
            self._steps[key] = 1 if anew else self._steps[key] + 1
            optimizer[key] = mi.TensorXf(with_space(value))
            dr.set_grad(optimizer[key], mi.TensorXf(with_space(gradients[key])))
        optimizer.state = {key: known[key] for key in values}  # other variables keep their state
        before = {key: optimizer.learning_rate(key) for key in values}
        optimizer.set_learning_rate({key: self._rate(key, rates[key]) for key in values})
        optimizer.step()
        optimizer.set_learning_rate(before)
        known |= optimizer.state
        optimizer.state = known
        return {key: np.array(dr.detach(optimizer[key])).reshape(value.shape) for key, value in values.items()}

    def _rate(self, key: str, rate: float) -> float | dr.ArrayBase:
        """Return the learning rate of a variable, for the problem's current ``rate``.

        A parameter with its own learning rate uses ``rate``. All others use the rate of the optimizer, which the
        problem's schedule and stages scale.
        """
        if key in self._own:
            return rate
        own_rate, common_rate = self._optimizer.learning_rate(key), self._optimizer.learning_rate()
        found: float | dr.ArrayBase = common_rate if own_rate is None else own_rate
        return found * (rate / self._problem_rates[key])

    def state(self) -> State:
        """See `Optimiser`. The arrays, named NUMBER:KEY, are Dr.Jit's state of the variables, such as moments."""
        kept = {key: _leaves(self._optimizer.state[key][3:]) for key in self._steps}
        arrays = {f"{n}:{key}": np.array(leaf) for key, leaves in kept.items() for n, leaf in enumerate(leaves)}
        return State(dict(self._steps), arrays)

    def restore(self, state: State, values: Arrays) -> None:
        arrays = dict(state.arrays)
        for key, value in values.items():
            self._optimizer[key] = mi.TensorXf(with_space(value))
            about = self._optimizer.state[key]
            like = _leaves(about[3:])
            found = [arrays.pop(f"{n}:{key}") for n in range(len(like))]
            if any(np.array(leaf).shape != array.shape for leaf, array in zip(like, found, strict=True)):
                raise ValueError(f"the state of '{key}' has the wrong shape")
            kept = _with_leaves(
                about[3:], iter([type(leaf)(with_space(a)) for leaf, a in zip(like, found, strict=True)])
            )
            self._optimizer.state[key] = (*about[:3], *kept)
        if arrays:
            raise ValueError(f"'{min(arrays)}' is not a state array of this optimizer")
        self._steps = dict(state.steps)


def _leaves(tree: object) -> list[dr.ArrayBase]:
    """Return the arrays of nested tuples, in order."""
    if isinstance(tree, tuple):
        return [leaf for branch in tree for leaf in _leaves(branch)]
    return [tree] if dr.is_array_v(tree) else []


def _with_leaves(tree: object, leaves: Iterator[dr.ArrayBase]) -> Any:
    """Replace the arrays of nested tuples by ``leaves``, in order."""
    if isinstance(tree, tuple):
        return tuple(_with_leaves(branch, leaves) for branch in tree)
    return next(leaves) if dr.is_array_v(tree) else tree


class OfUser(Optimiser):
    """`Optimiser` that is an object with a step method: see `Stepper`."""

    def __init__(self, stepper: Stepper, values: Arrays) -> None:
        self._stepper: Any = stepper  # typed Any, because state_dict() and load_state_dict() are optional
        self._steps = dict.fromkeys(values, 0)

    def step(
        self, values: Arrays, gradients: Arrays, rates: Mapping[str, float], loss: float = 0.0
    ) -> dict[str, Array]:
        """See `Optimiser`. Raises PathreplayError if a value is missing or has the wrong shape."""
        # The object may change its arguments in place. Values also belong to earlier iterations and states.
        copies = {key: np.array(value) for key, value in values.items()}
        found = self._stepper.step(copies, gradients, rates, loss)
        stepped = {}
        for key, value in values.items():
            if not isinstance(found, Mapping) or key not in found:
                raise PathreplayError(f"optimizer: step() returned no value of '{key}'; return arrays by name")
            stepped[key] = np.array(found[key], np.float32)
            if stepped[key].shape != value.shape:
                raise PathreplayError(
                    f"optimizer: step() returned '{key}' with the shape {stepped[key].shape}, not {value.shape}; keep "
                    "the shape"
                )
            self._steps[key] += 1
        return stepped

    def state(self) -> State:
        """See `Optimiser`. Raises PathreplayError if the object has no ``state_dict``."""
        self._require_state()
        kept = {f"own:{name}": np.array(array) for name, array in self._stepper.state_dict().items()}
        return State(dict(self._steps), kept)

    def restore(self, state: State, values: Arrays) -> None:
        """See `Optimiser`. Raises PathreplayError if the object has no ``load_state_dict``."""
        self._require_state()
        self._stepper.load_state_dict(
            {name.removeprefix("own:"): np.array(array) for name, array in state.arrays.items()}
        )
        self._steps = dict(state.steps)

    def _require_state(self) -> None:
        if not all(hasattr(self._stepper, name) for name in ("state_dict", "load_state_dict")):
            raise PathreplayError(
                f"optimizer: {type(self._stepper).__name__} has no state_dict() and load_state_dict(), which "
                "checkpoints and steps need; add them, or use another optimizer"
            )


def adapted(optimizer: Any, problem: Problem, values: Arrays) -> Optimiser:
    """Convert the user's optimizer object, or a function like `scipy.optimize.minimize`, to an `Optimiser`."""
    if not hasattr(optimizer, "step"):
        return optimiser_of(problem, values, problem.config.optimizer, optimizer)
    if hasattr(optimizer, "set_learning_rate") and hasattr(optimizer, "keys"):
        return OfMitsuba(optimizer, latents(problem.variables, values), problem)
    return OfUser(optimizer, values)


def _rated(problem: Problem) -> set[str]:
    """Return the variables whose parameters, exposures or response have their own learning rates."""
    config = problem.config
    fitted = {EXPOSURE: config.exposure, RESPONSE: config.response}
    keys = [v.key for v in problem.variables if v.key not in fitted]
    owners = {key: key.rpartition(":")[0] if key.endswith(PART_NAMES) else key for key in keys}
    entries = [e for e in config.parameters if e.learning_rate or e.rotation_learning_rate]
    rated = resolve_keys(dict.fromkeys(owners.values()), [entry.key for entry in entries])
    own = {key for key, owner in owners.items() if owner in rated}
    return own | {key for key, options in fitted.items() if options is not None and options.learning_rate}


def options_of(optimizer: object, known: Optimizer) -> tuple[Json | None, object]:
    """Split the argument ``optimizer`` of `minimize` into options of a job and an object of the user.

    For a name or a mapping, the object is None. For a function, the options are those of ``l-bfgs-b``. For an object,
    the options are None: those of the job apply. If the job's optimizer ``known`` is a search, in which all iterations
    have the same random numbers, the options for an object are those of ``adam``. Both are None if ``optimizer`` is
    None. Raises PathreplayError for any other argument.
    """
    if optimizer is None or isinstance(optimizer, str):
        return None if optimizer is None else {"type": optimizer}, None
    if isinstance(optimizer, Mapping) and "type" in optimizer:
        return dict(optimizer), None
    if isinstance(optimizer, type):
        raise PathreplayError(f"optimizer: {optimizer.__name__} is a class; create an object of it")
    if hasattr(optimizer, "step"):
        return {"type": "adam"} if known.searches else None, optimizer
    if callable(optimizer):
        return {"type": "l-bfgs-b"}, optimizer  # `LineSearch` runs such functions in place of L-BFGS-B
    raise PathreplayError(
        f"optimizer: {type(optimizer).__name__} has no step(); give a name such as 'adam', an optimizer of "
        "mitsuba.ad, an object with step(values, gradients, learning_rates, loss), or a function like "
        "scipy.optimize.minimize"
    )


def require_no_options(name: str, settings: Mapping[str, object], optimizer: object, known: Optimizer) -> None:
    """Check that no setting of a run is an option of its optimizer.

    Args:
        name: start of the message.
        settings: settings of the run by key of a job.
        optimizer: argument ``optimizer`` of `minimize`.
        known: the optimizer of the job.

    Raises:
        PathreplayError: a setting belongs into the mapping that describes the optimizer.
    """
    found = next((key for key in settings if any(key in options for options in DEFAULTS.values())), None)
    if found is None:
        return
    options, own = options_of(optimizer, known)
    if own is not None:
        raise PathreplayError(f"{name}: '{found}' is an option of the optimizer; give it to the optimizer object")
    kinds = [kind for kind, of_kind in DEFAULTS.items() if found in of_kind]
    options = {"type": known.type} if options is None else options
    kept = options if options["type"] in kinds else {"type": kinds[0]}
    others = "".join(
        f', "{key}": {shown(value)}' for key, value in {**kept, found: settings[found]}.items() if key != "type"
    )
    mapping = f'{{"type": "{kept["type"]}"{others}}}'
    raise PathreplayError(f"{name}: '{found}' is an option of the optimizer; write optimizer={mapping}")
