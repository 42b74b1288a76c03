"""Boundary terms: contributions of moving edges to gradients."""
