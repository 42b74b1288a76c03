"""Initial surfaces for caustic design: optimal transport of light to an image, and the surface that casts it."""
