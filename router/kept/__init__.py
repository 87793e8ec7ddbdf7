"""Kept programs: the compiled program of the last start, in a file, and the head start from it."""
