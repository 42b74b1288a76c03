"""Optimisers: first-order optimisers of Dr.Jit, and SciPy's L-BFGS-B."""
