"""The Python library: inverse problems with scenes and images in memory, gradients of their loss, and optimisation."""

from pathreplay.library.descriptions import Derived, Parameter, View
from pathreplay.library.gradients import value_and_grad
from pathreplay.library.iterations import Iteration
from pathreplay.library.minimize import Result, minimize
from pathreplay.library.problem import Problem, load_job
from pathreplay.library.steps import State, init, step

__all__ = [
    "Derived",
    "Iteration",
    "Parameter",
    "Problem",
    "Result",
    "State",
    "View",
    "init",
    "load_job",
    "minimize",
    "step",
    "value_and_grad",
]
