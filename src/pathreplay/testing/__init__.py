"""Independent estimates of a gradient, and a verdict on it."""

from pathreplay.testing.gradient import GradientCheck, check_gradient
from pathreplay.testing.picture import DerivativeImages, derivative_images

__all__ = ["DerivativeImages", "GradientCheck", "check_gradient", "derivative_images"]
