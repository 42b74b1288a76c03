"""The film: samples, images and their adjoints, and the motion of film positions."""
