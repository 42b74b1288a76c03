"""Compares time, memory and variance of gradients with Mitsuba's own integrators: `pathreplay bench --help`.

The benchmarks are not installed; they run from a checkout. The main process stays small and measures nothing. All
numbers come from worker processes (`measures/worker.py`). A baseline that crashes therefore becomes a table row, and
peak memory is measured for a single job.
"""
