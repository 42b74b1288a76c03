"""Measurements: the definition of jobs, the worker process, the measured passes, and statistics of their samples."""
