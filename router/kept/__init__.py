"""The compiled program of the last start, kept in a file, and the head start that it gives."""
