"""Run folders: what a job writes, and the lock of who writes it."""
