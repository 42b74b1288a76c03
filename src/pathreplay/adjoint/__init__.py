"""Ways to differentiate a path: primal, forward, recorded paths with a reverse sweep, path replay."""
