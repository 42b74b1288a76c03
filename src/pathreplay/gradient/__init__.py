"""Drivers that walk a path with the step and differentiate it: primal, forward, sweep, replay."""
