"""Independent estimates of a gradient, and a verdict on it."""

from pathreplay.testing.gradient import GradientCheck, check_gradient

__all__ = ["GradientCheck", "check_gradient"]
