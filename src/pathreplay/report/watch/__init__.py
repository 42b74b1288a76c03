"""Inspects saved and active runs: a local live page, comparisons, films, and export to TensorBoard."""
