"""Scenes: loading, built-in scenes, parameters by key, and checks of scene files."""
