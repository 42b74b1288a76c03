"""Losses of images by pixels, and by what people or networks see in them."""
