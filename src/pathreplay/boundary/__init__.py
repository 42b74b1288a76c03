"""Boundary terms: what moving edges add to a gradient."""
