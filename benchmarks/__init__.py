"""Compares time, memory and variance of gradients with Mitsuba's own integrators: `pathreplay bench --help`.

The benchmarks are not installed; they run from a checkout. The main process stays small and measures nothing. All
numbers come from worker processes (`measures/worker.py`), so that a baseline that crashes becomes a table row, and peak
memory is that of a single job.
"""
