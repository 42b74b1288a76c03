"""Gradient checks: compare a gradient with finite differences, and give a verdict on the gradient."""

from pathreplay.testing.gradient import GradientCheck, check_gradient
from pathreplay.testing.picture import DerivativeImages, derivative_images

__all__ = ["DerivativeImages", "GradientCheck", "check_gradient", "derivative_images"]
