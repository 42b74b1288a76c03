"""Views and their targets: images, captures, and lenses."""
