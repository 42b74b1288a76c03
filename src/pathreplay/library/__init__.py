"""The library: inverse problems of objects and arrays in memory, their gradients, and their minimisation."""

from pathreplay.library.gradients import value_and_grad
from pathreplay.library.minimize import Iteration, Result, minimize
from pathreplay.library.problem import Derived, Parameter, Problem, View

__all__ = ["Derived", "Iteration", "Parameter", "Problem", "Result", "View", "minimize", "value_and_grad"]
