"""The benchmark tasks. Each task lists its jobs, and formats their results as a table."""
