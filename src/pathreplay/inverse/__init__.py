"""Recover scene parameters from pictures: problem, loop, run folder, report."""
