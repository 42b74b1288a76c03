"""Inspects runs: a local page that follows a run, comparisons, films, and export to TensorBoard."""
