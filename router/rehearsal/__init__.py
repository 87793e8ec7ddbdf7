"""A program without network, on a clock that is told to go: table tests, and replay against another table."""
