"""Inverse rendering: parameters, views, losses, objective, optimisers and the loop. Used by `jobs` and `library`."""
