"""Image losses: per pixel, structural and perceptual."""
