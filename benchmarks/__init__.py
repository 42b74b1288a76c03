"""Time, memory and variance of gradients next to Mitsuba's own integrators: `pathreplay bench --help`.

Not installed: it runs from a checkout. The commanding process stays small and measures nothing; every number comes
from a worker process (`measures/worker.py`), so that a baseline that dies is a row of the table, and peak memory is a
job's own.
"""
