"""Integrators: one pass over an image, the terms of its gradient, and the `pathreplay` plugin."""
