"""Other ways to differentiate a path tracer, for comparison only: nothing else depends on them."""
