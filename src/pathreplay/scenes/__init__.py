"""Scenes: loading and looking through files, the built-in ones, and parameters by their keys."""
