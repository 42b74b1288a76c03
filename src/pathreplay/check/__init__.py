"""Independent estimates of a gradient, and the verdict on one."""
