"""Optimisers: first-order optimisers of Dr.Jit, SciPy's L-BFGS-B, and Levenberg-Marquardt."""
