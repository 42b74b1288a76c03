"""The optimisation loop: steps, events, checkpoints and convergence diagnostics."""
