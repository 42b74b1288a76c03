"""Inverse problems that are solved by several loops, which task `quality` compares by their held-out error."""
