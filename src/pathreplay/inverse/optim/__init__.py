"""Optimisers: adaptive steps by gradients, and L-BFGS with a line search."""
