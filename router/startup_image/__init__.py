"""Startup images: the image of the last start in a file, and the head start from it."""
