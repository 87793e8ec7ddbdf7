"""A compiled table as an image: the only form in which the carrier executes one. `writer.py` makes it."""
