"""What is optimised: variables, their reparameterizations, poses, regularizers, and what is derived from them."""
