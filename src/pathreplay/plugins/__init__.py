"""Plugins that Mitsuba lacks: a smooth dielectric with a differentiable index, and a grid medium."""
