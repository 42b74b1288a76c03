"""Drivers, which differentiate light paths: primal, forward, recorded path with reverse sweep, and path replay."""
