"""Parameters of a problem: variables, reparameterizations, poses, regularizers and derived parameters."""
