"""Independent estimates of a gradient, and the verdict on one."""

from pathreplay.testing.gradient import GradientCheck, check_gradient

__all__ = ["GradientCheck", "check_gradient"]
