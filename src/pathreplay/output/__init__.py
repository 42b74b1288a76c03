"""Output files: rendered images, and the results of a run in formats that other programs read."""
