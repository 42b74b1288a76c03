"""Start of caustic design: optimal transport of light to an image, and the surface that refracts it there."""
