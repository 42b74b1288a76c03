"""Inverse rendering: parameters, views, losses, objective, optimisers and the loop; the library below jobs."""
