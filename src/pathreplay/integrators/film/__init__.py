"""The film: samples, images and their adjoints, and how places on it move."""
