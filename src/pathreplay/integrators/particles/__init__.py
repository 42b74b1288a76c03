"""Integrators of light paths: their term, and the plugin that traces all light from the emitters."""
